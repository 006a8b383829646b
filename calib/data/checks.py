"""Values that are unusual or as in another unit than their column says; columns misspelt.

A whole column that is as in another unit is refused where a model is to be fitted to it, and only
warned of elsewhere; the user can say that it is right (`calib.data.table.CHECKED`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePath

import numpy as np
from numpy.typing import NDArray

from calib.data.files import plain_number
from calib.data.quantities import QUANTITIES, Quantity, columns_of, convert
from calib.data.table import CHECKED, Table, accepted_headers, columns_meant
from calib.errors import CalibError

type Array = NDArray[np.float64]

# A psi is so many kPa; levels of a design that are so far apart to this part are no coincidence.
_PSI, _NEAR, _FEW_LEVELS = 6.894757, 2e-3, 6
_MOST_NAMED = 5
# A column is too large if all but the largest tenth of it is.
_MOST = 0.9
# Refused are values that are, all of them, so many times beyond the usual, or the calibrated ones:
# tyres of 3 psi are rare, tyres of 2 psi that would be usual in bar are in bar; and a model is used
# beyond its range on purpose, by a factor.
_FAR_FROM_USUAL, _FAR_FROM_KNOWN = 2.0, 10.0
# Nearer to the unit of the header than this none is taken for it; units as near to each other as
# that (bar, atm and kgf/cm2) are told as one.
_OTHER, _SAME = 2.0, 1.2
# A column that may be left out is asked after when its name is so like a known one.
_ALIKE = 0.8
# The pull of a wheel is a part of its load: small forces that agree on that are of a small wheel.
_PULL_OVER_LOAD, _OF_SMALL_WHEELS = (0.01, 3.0), ("force", "torque")


def unit_notes(table: Table, quantity: Quantity, values: Array) -> list[str]:
    """Say which values (n,) of a condition are unusual, or as in another unit than the others."""
    return [*_unusual(table, quantity, values), *_mixed_units(table, quantity, values)]


@dataclass(frozen=True)
class _Odd:
    """A column that would be of usual size in another unit.

    What was found in it, in its own unit; in which unit it would be usual, or what else may be the
    matter; and whether no value of it is usual as it is.
    """

    name: str
    found: str
    hints: str
    whole: bool


def column_notes(table: Table) -> Iterator[str]:
    """Say which whole columns would be of usual size in another unit, as N that are typed as kN.

    A small wheel's forces are not taken for such if the table has its load and its pull, and no
    column whose header says that it was checked.

    Parameters
    ----------
    table : Table
    """
    for odd in _odd_columns(table):
        yield (
            f"{source_of(table)}, {table.header_of(odd.name)}: {odd.found}: {odd.hints}; check the "
            "unit in the column name"
        )


def check_units(table: Table, names: Iterable[str]) -> None:
    """Raise a CalibError if a column that will be used is, as a whole, as in another unit.

    Parameters
    ----------
    table : Table
    names : iterable of str
        Canonical names of the columns that will be used.
    """
    used = set(names)
    for odd in _odd_columns(table):
        if odd.whole and odd.name in used:
            raise _another_unit(table, odd.name, f"{odd.found}: {odd.hints}")
    for name in used & set(table) & set(QUANTITIES):
        usual = QUANTITIES[name].usual
        values = table[name][np.isfinite(table[name])]
        if usual is None or not values.size or table.column(name).checked:
            continue
        low, high = usual[0] / _FAR_FROM_USUAL, usual[1] * _FAR_FROM_USUAL
        far = bool((values < low).all() or (values > high).all())
        # Asked last, for the rarer units are pint's, which takes longer to start than a diagnosis.
        read = usual_in(table, name, values, *usual) if far else ""
        if read:
            raise _another_unit(
                table, name, f"all values are far from {_between(table, name, *usual)}, where they "
                f"usually lie, and all would lie there if the readings are in {read}",
            )  # fmt: skip


def check_conditions(table: Table, known: Mapping[str, Array]) -> None:
    """Raise a CalibError for conditions far from all calibrated ones, but not in another unit.

    Parameters
    ----------
    table : Table
        Conditions at which to predict.
    known : mapping of str to ndarray
        Those of the calibration, in the canonical unit.
    """
    for name, values in known.items():
        low, high = float(values.min()), float(values.max())
        far = bool((np.abs(table[name]) > _FAR_FROM_KNOWN * max(abs(low), abs(high))).all())
        # What may be zero may be as near to it as one likes.
        if QUANTITIES[name].range.low_open:
            far |= bool((table[name] < low / _FAR_FROM_KNOWN).all())
        read = usual_in(table, name, table[name], low, high) if far else ""
        if read and not table.column(name).checked:
            raise _another_unit(
                table, name, "all values are more than ten times beyond the calibrated ones, "
                f"{_between(table, name, low, high)}, and all would lie among them if the readings "
                f"are in {read}",
            )  # fmt: skip


def _another_unit(table: Table, name: str, found: str) -> CalibError:
    header, quantity = table.header_of(name), QUANTITIES[name]
    load = ""
    if (
        quantity.role == "output" and quantity.kind in _OF_SMALL_WHEELS and quantity.largest
        and float(np.nanmax(np.abs(table[name]))) < quantity.largest[0]
        and not any(column in table for column in columns_of("load"))
    ):  # fmt: skip
        # Without it, they would be compared with those of a vehicle's wheel.
        load = ", and add the load of the small wheel that they are of: the column normal_load_kn"
    return CalibError(
        found, where=f"{table.source}, column {header!r}",
        expected=f"the unit of the readings in the column name: {', '.join(quantity.units)}",
        hint="correct the unit in the column name; if the values are right as they are, say so "
        f"there: '{header} {CHECKED}'{load}",
    )  # fmt: skip


def _between(table: Table, name: str, low: float, high: float) -> str:
    """Say a range in the unit of the file."""
    column = table.column(name)
    ends = column.written(np.array([low, high]))
    return f"{plain_number(ends[0], 4)} to {plain_number(ends[1], 4)} {column.unit_word}".rstrip()


def fits_load(pull: float, load: float) -> bool:
    """Whether a largest pull can be that of a wheel under a load, of one unit."""
    low, high = _PULL_OVER_LOAD
    return low * load < pull < high * load


def _odd_columns(table: Table) -> Iterator[_Odd]:
    known = [n for n in table if n in QUANTITIES and np.isfinite(table[n]).any()]
    sizes = {name: float(np.nanmax(np.abs(table[name]))) for name in known}
    pull, load = (
        max((sizes[c] for c in columns_of(role) if c in sizes), default=0.0)
        for role in ("pull", "load")
    )
    fits = fits_load(pull, load)
    for name, size in sizes.items():
        quantity = QUANTITIES[name]
        if quantity.largest is None:
            continue
        low, high = quantity.largest
        if fits and quantity.kind in _OF_SMALL_WHEELS and size < low:
            continue
        if low <= size <= high or table.column(name).checked:
            continue
        factor = 1e-3 if size > high else 1e3
        hints = [
            f"about 1000 times too {'large' if size > high else 'small'}, as where a unit and its "
            "thousandth (kN and N, MPa and kPa, m and mm) were mixed up"
        ] * (low <= factor * size <= high)
        read = usual_in(table, name, np.array([size]), low, high)
        hints += [f"as where the readings are in {read}"] * bool(read)
        sizes_of = np.abs(table[name][np.isfinite(table[name])])
        # One row that is far too large is that row's fault, not the column's.
        alone = size > high and float(np.quantile(sizes_of, _MOST)) < high
        if hints and not alone:
            column = table.column(name)
            written = f"{plain_number(float(column.written(size)), 4)} {column.unit_word}".rstrip()
            yield _Odd(
                name, f"the largest {quantity.word} is {written}, and "
                f"{_between(table, name, low, high)} is usual", "; ".join(hints),
                # Of what is too large, small values (at little slip) are usual in any unit.
                size < low or float(np.median(sizes_of)) > high,
            )  # fmt: skip


def usual_in(table: Table, name: str, values: Array, low: float, high: float) -> str:
    """Name the units in which a column's readings would all lie within a range; "" if in none.

    Parameters
    ----------
    table : Table
        Whose header says in which unit the readings were taken to be.
    name : str
        Canonical name of the column.
    values : ndarray, shape (n,)
        In the canonical unit, as is the range.
    low, high : float
    """
    quantity = QUANTITIES[name]
    own = float(convert(1.0, table.column(name).unit, quantity.unit))
    told: dict[str, float] = {}
    for unit in quantity.units.values():
        factor = float(convert(1.0, unit, quantity.unit)) / own
        known = any(max(factor / f, f / factor) < _SAME for f in told.values())
        if not known and max(factor, 1.0 / factor) >= _OTHER:
            read = factor * values
            if ((low <= read) & (read <= high)).all():
                told[_written(unit)] = factor
    return " or ".join(told)


def beyond_notes(table: Table, known: Mapping[str, Array]) -> Iterator[str]:
    """Say which values lie beyond known ones, and in which unit they would lie among them.

    Parameters
    ----------
    table : Table
    known : mapping of str to ndarray
        Values of the same columns in the canonical unit, those that a model was calibrated at.
    """
    for name, values in known.items():
        low, high = float(values.min()), float(values.max())
        off = np.maximum(low - table[name], table[name] - high)
        beyond = off > 1e-9 * max(abs(low), abs(high))
        if not beyond.any():
            continue
        read = usual_in(table, name, table[name][beyond], low, high)
        farthest = float(table.column(name).written(table[name][np.argmax(off)]))
        reach = "as far off as" if beyond.sum() > 1 else "="
        unit = f"; inside if the readings are in {read}; check the unit in the column name"
        yield (
            f"{table.source}, {lines_of(table, beyond)}: {table.header_of(name)} {reach} "
            f"{plain_number(farthest, 4)}, calibrated from {_between(table, name, low, high)}"
            f"{unit if read else ''}"
        )


def _written(unit: str) -> str:
    return {"dimensionless": "fractions"}.get(unit, unit.replace("**", ""))


def spelling_notes(table: Table) -> Iterator[str]:
    """Ask after columns that are not used, and are named nearly as one that the table lacks."""
    for guess in columns_meant(table.ignored, [n for n in QUANTITIES if n not in table], _ALIKE):
        yield f"{source_of(table)}: a column is not used: {guess}"


def _unusual(table: Table, quantity: Quantity, values: Array) -> Iterable[str]:
    if quantity.usual is None or table.column(quantity.canonical).checked:
        return
    low, high = quantity.usual
    odd = (values < low) | (values > high)
    if odd.any():
        read = usual_in(table, quantity.canonical, values, low, high)
        where = f", and all would be inside if the readings are in {read}" if read else ""
        yield (
            f"{source_of(table)}, {lines_of(table, odd)}: {word_of(table, quantity)} is outside "
            f"{_between(table, quantity.canonical, low, high)}, where it usually lies{where}; "
            "check the unit in the column name"
        )


def stretches(values: Array) -> list[tuple[float, float]]:
    """Return from where to where values go: a range, or two if a gap is wider than all the rest.

    Of a few levels nothing is expected between them.
    """
    levels = np.unique(values)
    low, high = float(levels[0]), float(levels[-1])
    if levels.size > _FEW_LEVELS:
        i = int(np.argmax(np.diff(levels)))
        if levels[i + 1] - levels[i] > 0.5 * (high - low):
            return [(low, float(levels[i])), (float(levels[i + 1]), high)]
    return [(low, high)]


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
        f"{source_of(table)}, {lines_of(table, odd)}: {word_of(table, quantity)} is 6.895 times "
        f"{way} than in other rows, as where psi and kPa were mixed up; check the unit"
    )


def word_of(table: Table, quantity: Quantity) -> str:
    """Name a quantity in a sentence, and its column where this has another name than usual."""
    header = table.header_of(quantity.canonical)
    usual = header in accepted_headers(quantity)
    return quantity.word if usual else f"{quantity.word} ({header!r})"


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


def check_enough(table: Table, n_parameters: int, *, model: str = "the model") -> None:
    """Check that there are more rows than parameters to estimate, those of the noise among them.

    Raises
    ------
    CalibError
        Naming the model, if the rows cannot show any noise about a fit.
    """
    if len(table) > n_parameters:
        return
    rows = "1 row" if len(table) == 1 else f"{len(table)} rows"
    raise CalibError(
        f"{rows} cannot calibrate {model}, which has {n_parameters} parameters to "
        "estimate, those of the noise among them",
        where=table.source,
        expected=f"at least {n_parameters + 1} rows",
        hint="add measurements, or choose a model with fewer parameters",
    )


def check_settings(table: Table, conditions: Sequence[str]) -> None:
    """Raise a CalibError if no condition varies: the rows then repeat a single measurement.

    They tell one number, and leave every parameter but one to its prior. Where only some of the
    conditions are constant, what depends on these is the prior's, which a warning says.
    """
    values = {name: table[name] for name in conditions}
    if any(np.ptp(v) > 1e-12 * np.abs(v).max() for v in values.values()):
        return
    at = ", ".join(
        f"{table.header_of(name)} = {float(table.column(name).written(v[0])):g}"
        for name, v in values.items()
    )
    raise CalibError(
        f"all rows are at one setting of the conditions, {at}", where=table.source,
        expected="at least two settings: what the model says of any other would be the prior's",
        hint="add measurements at other values, or check that the right column was written",
    )  # fmt: skip


def check_varies(table: Table, column: str) -> None:
    """Raise a CalibError if the values of a column are all equal, up to rounding."""
    values = table[column][~np.isnan(table[column])]
    if values.size and np.ptp(values) > 1e-12 * np.abs(values).max():
        return
    found = "there is no value"
    if values.size:
        value = table.column(column).written(values[0]) if column in QUANTITIES else values[0]
        found = f"all {values.size} values are {value:g}"
    raise CalibError(
        found, where=f"{table.source}, column {table.header_of(column)!r}",
        expected="at least two different values: a constant column tells a model nothing",
        hint="check that the right column was written, or add measurements",
    )  # fmt: skip
