"""Values of a condition that are unusual, or as in another unit than the others."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import PurePath

import numpy as np
from numpy.typing import NDArray

from calib.data.quantities import Quantity
from calib.data.table import Table

type Array = NDArray[np.float64]

# A psi is so many kPa; levels of a design that are so far apart to this part are no coincidence.
_PSI, _NEAR, _FEW_LEVELS = 6.894757, 2e-3, 6
_MOST_NAMED = 5


def unit_notes(table: Table, quantity: Quantity, values: Array) -> list[str]:
    """Say which values (n,) of a condition are unusual, or as in another unit than the others."""
    return [*_unusual(table, quantity, values), *_mixed_units(table, quantity, values)]


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
