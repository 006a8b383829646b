"""Values that are unusual or as in another unit than their column says; columns misspelt."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import PurePath

import numpy as np
from numpy.typing import NDArray

from calib.data.headers import meant
from calib.data.quantities import QUANTITIES, Quantity, columns_of
from calib.data.table import Table

type Array = NDArray[np.float64]

# A psi is so many kPa; levels of a design that are so far apart to this part are no coincidence.
_PSI, _NEAR, _FEW_LEVELS = 6.894757, 2e-3, 6
_MOST_NAMED = 5
# A column is too large if all but the largest tenth of it is.
_MOST = 0.9
# A column that may be left out is asked after when its name is so like a known one.
_ALIKE = 0.8
# The pull of a wheel is a part of its load: small forces that agree on that are of a small wheel.
_PULL_OVER_LOAD, _OF_SMALL_WHEELS = (0.01, 3.0), ("force", "torque")


def unit_notes(table: Table, quantity: Quantity, values: Array) -> list[str]:
    """Say which values (n,) of a condition are unusual, or as in another unit than the others."""
    return [*_unusual(table, quantity, values), *_mixed_units(table, quantity, values)]


def column_notes(table: Table) -> Iterator[str]:
    """Say which whole columns are a thousand times too large or small, as N that are typed as kN.

    A small wheel's forces are not taken for such if the table has its load and its pull.

    Parameters
    ----------
    table : Table
    """
    known = [n for n in table if n in QUANTITIES and np.isfinite(table[n]).any()]
    sizes = {name: float(np.nanmax(np.abs(table[name]))) for name in known}
    pull, load = (
        max((sizes[c] for c in columns_of(role) if c in sizes), default=0.0)
        for role in ("pull", "load")
    )
    low, high = _PULL_OVER_LOAD
    fits = low * load < pull < high * load
    for name, size in sizes.items():
        quantity = QUANTITIES[name]
        if quantity.largest is None:
            continue
        low, high = quantity.largest
        if fits and quantity.kind in _OF_SMALL_WHEELS and size < low:
            continue
        factor = 1e-3 if size > high else 1e3
        if low <= size <= high or not low <= factor * size <= high:
            continue
        # One row that is far too large is that row's fault, not the column's.
        if size > high and float(np.nanquantile(np.abs(table[name]), _MOST)) < high:
            continue
        yield (
            f"{source_of(table)}, {name}: the largest {quantity.word} is {size:g} "
            f"{quantity.unit.replace('**', '')}, and {low:g} to {high:g} is usual: about 1000 "
            f"times too {'large' if size > high else 'small'}, as where a unit and its thousandth "
            "(kN and N, MPa and kPa, m and mm) were mixed up; check the unit in the column name"
        )


def spelling_notes(table: Table) -> Iterator[str]:
    """Ask after columns that are not used, and are named nearly as one that the table lacks."""
    for guess in meant(table.ignored, [n for n in QUANTITIES if n not in table], _ALIKE):
        yield f"{source_of(table)}: a column is not used: {guess}"


def _unusual(table: Table, quantity: Quantity, values: Array) -> Iterable[str]:
    if quantity.usual is None:
        return
    low, high = quantity.usual
    odd = (values < low) | (values > high)
    if odd.any():
        yield (
            f"{source_of(table)}, {lines_of(table, odd)}: {quantity.word} is outside {low:g} to "
            f"{high:g} {quantity.unit}, where it usually lies; check the unit in the column name"
        )


def mixed_units(quantity: Quantity, values: Array) -> tuple[NDArray[np.bool_], str]:
    """Return which rows' pressures are others' in another unit, and whether larger or smaller.

    Values (n,) are of a few levels; among many, ratios come about by chance.
    """
    levels, none = np.unique(values), np.zeros(values.size, dtype=np.bool_)
    if quantity.kind != "pressure" or not 2 <= levels.size <= _FEW_LEVELS or levels[0] <= 0.0:
        return none, ""
    ratio = levels[None, :] / levels[:, None]
    pairs = np.abs(ratio / _PSI - 1.0) < _NEAR
    small, large = (np.isin(values, levels[pairs.any(axis=axis)]) for axis in (1, 0))
    # The fewer rows are the mistaken ones.
    return (large, "larger") if large.sum() < small.sum() else (small, "smaller")


def _mixed_units(table: Table, quantity: Quantity, values: Array) -> Iterable[str]:
    odd, way = mixed_units(quantity, values)
    if not odd.any():
        return
    yield (
        f"{source_of(table)}, {lines_of(table, odd)}: {quantity.word} is 6.895 times {way} than in "
        "other rows, as where psi and kPa were mixed up; check the unit"
    )


def source_of(table: Table) -> str:
    """Return the name of a table's file."""
    # Not the path: the page goes to others.
    return PurePath(table.source).name


def lines_of(table: Table, rows: NDArray[np.bool_]) -> str:
    """Name the lines of some rows, the first few of many."""
    lines: list[int] = table.lines[rows].tolist()
    named = ", ".join(map(str, lines[:_MOST_NAMED]))
    more = f" and {len(lines) - _MOST_NAMED} more" if len(lines) > _MOST_NAMED else ""
    return f"{'line' if len(lines) == 1 else 'lines'} {named}{more}"
