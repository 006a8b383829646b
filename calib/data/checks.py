"""Checks of tables: units in doubt, columns misspelt, rows to fit and to hold out.

A whole column that looks as if it were in another unit is refused where a model is to be fitted to
it or to predict at it; elsewhere there is a warning. The user can say that the column is right
(`calib.data.table.CHECKED`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from numbers import Real
from pathlib import PurePath
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib.arguments import takes
from calib.data.files import plain_number
from calib.data.quantities import QUANTITIES, Quantity, columns_of, convert
from calib.data.reader import Tabular, as_table
from calib.data.table import CHECKED, Table, accepted_headers, columns_meant, parse_header
from calib.errors import CalibError

type Array = NDArray[np.float64]

# Levels up to which values are taken for a design's; test_checks, test_assumptions.
FEW_LEVELS = 6
# Factor beyond calibrated conditions from which values that would fit in another unit are refused:
# a model is used beyond its range on purpose, by a factor; test_checks.
FAR_FROM_KNOWN = 10.0
# Dimensions of which small wheels have less than vehicles' wheels.
OF_SMALL_WHEELS = ("force", "torque")


class _Odd(NamedTuple):
    """A column that would be of usual size in another unit."""

    name: str
    found: str
    # Whether no value of it is usual as it is.
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
        where = f"{source_of(table)}, {table.header_of(odd.name)}"
        yield f"{where}: {odd.found}; check the unit in the column name"


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
            raise _another_unit(table, odd.name, odd.found)
    for name in used & set(table) & set(QUANTITIES):
        usual = QUANTITIES[name].usual
        values = table[name][np.isfinite(table[name])]
        if usual is None or not values.size or table.column(name).checked:
            continue
        # Tyres of 3 psi are rare, tyres of 2 psi that would be usual in bar are in bar.
        low, high = usual[0] / 2.0, usual[1] * 2.0
        far = bool((values < low).all() or (values > high).all())
        # Asked last, for the rarer units are pint's, which takes longer to start than a diagnosis.
        read = usual_in(table, name, values, *usual) if far else ""
        if read:
            found = (
                f"all values are far from {table.column(name).words(*usual)}, where they usually"
            )
            found += f" lie, and all would lie there if the readings are in {read}"
            raise _another_unit(table, name, found)


def check_conditions(table: Table, known: Mapping[str, Array]) -> None:
    """Raise a CalibError for conditions that look, as a whole, as if they were in another unit.

    Either their size is unusual and that of the calibrated ones is not, or they are far from all
    calibrated ones and would lie among them in another unit.

    Parameters
    ----------
    table : Table
        Conditions at which to predict.
    known : mapping of str to ndarray
        Those of the calibration, in the canonical unit.
    """
    odd = {o.name: o.found for o in _odd_columns(table) if o.whole}
    for name, values in known.items():
        low, high = float(values.min()), float(values.max())
        least, most = QUANTITIES[name].largest or (-np.inf, np.inf)
        # If the calibrated ones are as unusual, the user has already said that they are right.
        if name in odd and least <= max(abs(low), abs(high)) <= most:
            raise _another_unit(table, name, odd[name])
        far = bool((np.abs(table[name]) > FAR_FROM_KNOWN * max(abs(low), abs(high))).all())
        # What may be zero may be as near to it as one likes.
        if QUANTITIES[name].range.low_open:
            far |= bool((table[name] < low / FAR_FROM_KNOWN).all())
        read = usual_in(table, name, table[name], low, high) if far else ""
        if read and not table.column(name).checked:
            found = "all values are more than ten times beyond the calibrated ones, "
            found += f"{table.column(name).words(low, high)}, and all would lie among them if the "
            raise _another_unit(table, name, f"{found}readings are in {read}")


def _another_unit(table: Table, name: str, found: str) -> CalibError:
    header, quantity = table.header_of(name), QUANTITIES[name]
    hint = (
        "correct the unit in the column name; if the values are right as they are, say so there: "
    )
    hint += f"'{header} {CHECKED}'"
    small = quantity.role == "output" and quantity.kind in OF_SMALL_WHEELS and quantity.largest
    if (
        small
        and float(np.nanmax(np.abs(table[name]))) < small[0]
        and not any(column in table for column in columns_of("load"))
    ):
        # Without it, they would be compared with those of a vehicle's wheel.
        hint += ", and add the load of the small wheel that they are of: the column normal_load_kn"
    return CalibError(
        found,
        where=f"{table.source}, column {header!r}",
        expected=f"the unit of the readings in the column name: {', '.join(quantity.units)}",
        hint=hint,
    )


def fits_load(pull: float, load: float) -> bool:
    """Whether a largest pull is plausible for a wheel under a load in the same unit."""
    return 0.01 * load < pull < 3.0 * load


def _odd_columns(table: Table) -> Iterator[_Odd]:
    known = [n for n in table if n in QUANTITIES and np.isfinite(table[n]).any()]
    sizes = {name: float(np.nanmax(np.abs(table[name]))) for name in known}
    pull, load = (
        max((sizes[c] for c in columns_of(role) if c in sizes), default=0.0)
        for role in ("pull", "load")
    )
    small_wheel = fits_load(pull, load)
    for name, size in sizes.items():
        quantity, column = QUANTITIES[name], table.column(name)
        low, high = quantity.largest or (-np.inf, np.inf)
        if low <= size <= high or column.checked:
            continue
        if small_wheel and quantity.kind in OF_SMALL_WHEELS and size < low:
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
        alone = size > high and float(np.quantile(sizes_of, 0.9)) < high
        if hints and not alone:
            found = f"the largest {quantity.word} is {column.words(size)}, and "
            found += f"{column.words(low, high)} is usual: {'; '.join(hints)}"
            # Of what is too large, small values (at little slip) are usual in any unit.
            yield _Odd(name, found, size < low or float(np.median(sizes_of)) > high)


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
    named: dict[str, float] = {}
    for unit in quantity.units.values():
        factor = float(convert(1.0, unit, quantity.unit)) / own
        # Units as near to each other as bar, atm and kgf/cm2 are named once, and none that is
        # near the unit of the header.
        known = any(max(factor / f, f / factor) < 1.2 for f in named.values())
        if not known and max(factor, 1.0 / factor) >= 2.0:
            read = factor * values
            if ((low <= read) & (read <= high)).all():
                named["fractions" if unit == "dimensionless" else unit.replace("**", "")] = factor
    return " or ".join(named)


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
        farthest, read = float(table[name][np.argmax(off)]), ""
        calibrated = f"{plain_number(low, 4)} to {plain_number(high, 4)}"
        if name in QUANTITIES:
            column = table.column(name)
            farthest, calibrated = float(column.written(farthest)), column.words(low, high)
            read = usual_in(table, name, table[name][beyond], low, high)
        reach = "as far off as" if beyond.sum() > 1 else "="
        unit = f"; inside if the readings are in {read}; check the unit in the column name"
        yield (
            f"{table.source}, {lines_of(table, beyond)}: {table.header_of(name)} {reach} "
            f"{plain_number(farthest, 4)}, calibrated from {calibrated}"
            f"{unit if read else ''}"
        )


def spelling_notes(table: Table) -> Iterator[str]:
    """Ask after columns that are not used, and are named nearly as one that the table lacks."""
    for guess in columns_meant(table.ignored, [n for n in QUANTITIES if n not in table], 0.8):
        yield f"{source_of(table)}: a column is not used: {guess}"


def unit_notes(table: Table, quantity: Quantity, values: Array) -> Iterator[str]:
    """Say which values (n,) of a condition are unusual, or as in another unit than the others."""
    name, source, word = quantity.canonical, source_of(table), word_of(table, quantity)
    low, high = quantity.usual or (-np.inf, np.inf)
    odd = (values < low) | (values > high)
    if odd.any() and not table.column(name).checked:
        read = usual_in(table, name, values, low, high)
        where = f", and all would be inside if the readings are in {read}" if read else ""
        yield (
            f"{source}, {lines_of(table, odd)}: {word} is outside "
            f"{table.column(name).words(low, high)}, where it usually lies{where}; check the unit "
            "in the column name"
        )
    odd, way = mixed_units(quantity, values)
    if odd.any():
        yield (
            f"{source}, {lines_of(table, odd)}: {word} is 6.895 times {way} than in other rows, as "
            "where psi and kPa were mixed up; check the unit"
        )


def stretches(values: Array) -> list[tuple[float, float]]:
    """Return from where to where values go: a range, or two if a gap is wider than all the rest.

    Of a few levels nothing is expected between them.
    """
    levels = np.unique(values)
    low, high = float(levels[0]), float(levels[-1])
    if levels.size > FEW_LEVELS:
        i = int(np.argmax(np.diff(levels)))
        if levels[i + 1] - levels[i] > 0.5 * (high - low):
            return [(low, float(levels[i])), (float(levels[i + 1]), high)]
    return [(low, high)]


def mixed_units(quantity: Quantity, values: Array) -> tuple[NDArray[np.bool_], str]:
    """Return which rows' pressures are others' in another unit, and whether larger or smaller.

    Values (n,) are of a few levels; among many, ratios come about by chance.
    """
    levels, none = np.unique(values), np.zeros(values.size, dtype=np.bool_)
    if quantity.kind != "pressure" or not 2 <= levels.size <= FEW_LEVELS or levels[0] <= 0.0:
        return none, ""
    ratio = levels[None, :] / levels[:, None]
    # A psi is so many kPa.
    pairs = np.abs(ratio / 6.894757 - 1.0) < 2e-3
    small, large = (np.isin(values, levels[pairs.any(axis=axis)]) for axis in (1, 0))
    # The fewer rows are the mistaken ones.
    return (large, "larger") if large.sum() < small.sum() else (small, "smaller")


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
    named = ", ".join(map(str, lines[:5]))
    more = f" and {len(lines) - 5} more" if len(lines) > 5 else ""
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


@takes(quantity_header=str, value=(Real, Sequence, np.ndarray))
def hold_out(
    table: Tabular,
    quantity_header: str,
    value: float | Sequence[float] | NDArray[np.float64],
    rel_tol: float = 1e-3,
) -> tuple[Table, Table]:
    """Set aside the rows at one value of a quantity, or at several.

    Parameters
    ----------
    table : Table, mapping of str to array_like, or pandas.DataFrame
    quantity_header : str
        A column name in any unit, such as ``"inflation_pressure_psi"``; the data may have it in
        another one.
    value : float or sequence of float
        The value to hold out, or several of them, in that unit.
    rel_tol : float
        Relative difference up to which a row counts as at that value. 30 psi written as
        207 kPa differs by 7e-4.

    Returns
    -------
    rest, held : Table

    Raises
    ------
    CalibError
        If no row has such a value, listing those present, if every row has one, or if the value
        scatters, as a gauge's does, so that rows nearly at it would be fitted.

    Examples
    --------
    >>> import calib
    >>> pulls = calib.load_he2019("drawbar_pull")
    >>> fitted, held_out = calib.hold_out(pulls, "inflation_pressure_psi", 30)
    >>> len(fitted), len(held_out)
    (28, 14)
    >>> fitted, held_out = calib.hold_out(pulls, "inflation_pressure_psi", [18, 30])
    >>> len(fitted), len(held_out)
    (14, 28)
    """
    wanted = [*value] if isinstance(value, Sequence | np.ndarray) else [value]
    if not wanted or not all(isinstance(v, Real) for v in wanted):
        raise CalibError(
            f"value = {value!r}", where="calib.hold_out", expected="a number, or some in a list",
            hint="correct value",
        )  # fmt: skip
    table, column = as_table(table), parse_header(quantity_header)
    if column is None or column.quantity.canonical not in table:
        guess = columns_meant(
            [quantity_header], [n for n in table if n in QUANTITIES], shortened=True
        )
        raise CalibError(
            f"there is no column to hold {quantity_header!r} out by", where=table.source,
            expected=", ".join(table),
            hint=" Or ".join([*guess, "name one of these quantities, with a unit"]),
        )  # fmt: skip
    values = table[column.quantity.canonical]
    largest, absent = float(np.nanmax(np.abs(values))), []
    held, near = np.zeros((2, len(table)), dtype=bool)
    for one in wanted:
        at = float(column.to_canonical(one))
        apart, size = np.abs(values - at), rel_tol * (abs(at) or largest)
        here = apart <= size
        held |= here
        near |= (apart <= 10.0 * size) & (at != 0.0)
        absent += [] if here.any() else [f"{one:g}"]
    if not absent and (near & ~held).any():
        left = column.written(values[near & ~held])
        raise CalibError(
            f"rows nearly at the value, such as {float(left[0]):.6g}, would be fitted: "
            f"{len(left)}, beside {int(held.sum())} held out",
            where=f"{table.source}, column {quantity_header!r}",
            expected="a value that is set, and the same in all rows of a test",
            hint="hold out by run (a column run that numbers the tests), or round the column",
        )  # fmt: skip
    if not absent and not held.all():
        return table.take(~held), table.take(held)
    where = f"{table.source}, column {quantity_header!r}"
    if not absent:
        plain = " or ".join(f"{v:g}" for v in wanted)
        raise CalibError(
            f"every row is at {plain}, so nothing would be left to fit",
            where=where,
            expected="values that only some of the rows have",
            hint="hold out something else",
        )
    levels = column.written(np.unique(values[~np.isnan(values)]))
    present = list(dict.fromkeys(f"{v:.6g}" for v in levels))
    present[12:] = [f"and {len(present) - 12} more"] * (len(present) > 12)
    raise CalibError(
        f"no row is at {' or '.join(absent)}",
        where=where,
        expected=f"one of the values present: {', '.join(present)}",
        hint="hold out one of these, or check the unit",
    )
