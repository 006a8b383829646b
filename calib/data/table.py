"""The table of measurements, and the plain numbers that a model or simulator must return.

Every way in goes through `real_array`: functions, programs, servers and tables of runs.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.data.headers import CHECKED, Column, columns_meant, missing_columns, parse_header
from calib.data.quantities import QUANTITIES, convert
from calib.errors import FAULTS, CalibError

type Array = NDArray[np.float64]

# What `float` takes beyond it ("1_000", digits of other scripts) is no number of a simulator's.
# Fortran writes exponents with a D.
_NUMBER = re.compile(
    r"[-+]?(?:(?:\d+\.?\d*|\.\d+)(?:[eEdD][-+]?\d+)?|nan|inf(?:inity)?)", re.ASCII | re.IGNORECASE
)
_ONE = "dimensionless"


def real_array(found: Any, unit: str = _ONE) -> Array:
    """Return numbers in a unit, in memory of their own and in the shape in which they came.

    What carries a unit is converted from it, and what carries none is in `unit`. What is masked or
    missing (None, NA) within an array is NaN: it has no value.

    Raises
    ------
    CalibError
        If it is none of real numbers, cannot be converted, or its order is not that of the rows.
    """
    if found is None:
        raise _refused("it is nothing (None)", unit)
    # Overflow of a wider type is infinite, which is no value.
    with np.errstate(all="ignore"):
        return _real(found, unit)


def number_of(text: str) -> float:
    """Return the number that a text is, with a decimal point; a CalibError if it is none."""
    stripped = text.strip()
    if not _NUMBER.fullmatch(stripped):
        raise _refused(f"the text {text!r} is no number", _ONE)
    return float(stripped.lower().replace("d", "e") if "n" not in stripped.lower() else stripped)


def _real(found: Any, unit: str) -> Array:
    if type(found) is np.ndarray:
        return _of_array(found, unit)
    if found is None or type(found).__name__ == "NAType":
        return np.array(np.nan)
    if isinstance(found, str):
        return np.array(number_of(found))
    if type(found) in (int, float):
        return _of_scalar(found, unit)
    _check_order(found, unit)
    own = _unit_of(found)
    if own is not None:
        return convert(_real(_without_unit(found), _ONE), own, unit)
    mask = getattr(found, "mask", None)
    if isinstance(mask, np.ndarray | np.bool_):
        return np.where(mask, np.nan, _real(np.where(mask, 0, np.asarray(found)), unit))
    if isinstance(found, Sequence) and not isinstance(found, bytes | bytearray):
        return _of_parts(found, unit)
    inner = _inner(found)
    if inner is not None:
        return _real(inner, unit)
    if isinstance(found, bool) or not hasattr(found, "__float__"):
        raise _refused(f"it is of the type {type(found).__name__}", unit)
    return _of_scalar(found, unit)


def _of_scalar(found: Any, unit: str) -> Array:
    try:
        return np.array(float(found))
    except (*FAULTS, ArithmeticError) as error:
        what = f"{type(found).__name__} is no number of double precision ({error})"
        raise _refused(what, unit) from None


def _of_array(found: np.ndarray[Any, Any], unit: str) -> Array:
    match found.dtype.kind:
        case "f" | "i" | "u":
            return found.astype(np.float64)
        case "c":
            missing = np.isnan(found)
            imaginary = np.abs(np.where(missing, 0.0, found.imag))
            if imaginary.any():
                raise _refused(
                    f"it is complex, with imaginary parts up to {imaginary.max():g}", unit
                )
            return np.where(missing, np.nan, found.real).astype(np.float64)
        case "O" | "U":
            return _of_parts(found.ravel().tolist(), unit).reshape(found.shape)
        case _:
            raise _refused(f"it is of the type {found.dtype}", unit)


def _of_parts(found: Sequence[Any], unit: str) -> Array:
    if {type(part) for part in found} <= {float, int}:
        with suppress(OverflowError):
            return np.array(found, dtype=np.float64)
    parts = [_real(part, unit) for part in found]
    shapes = {part.shape for part in parts}
    if len(shapes) > 1:
        raise _refused("its rows differ in length", unit)
    return np.stack(parts) if parts else np.empty(0)


def _inner(found: Any) -> Any:
    """Return the array that something stands for, if any."""
    if isinstance(found, np.ndarray | np.generic | complex):
        return np.asarray(found)
    # Labelled arrays hold others, which may have units; a conversion would lose them.
    held = getattr(found, "data", None) if hasattr(found, "dims") else None
    if held is not None and type(held) is not type(found):
        return held
    if not hasattr(found, "__array__"):
        return None
    try:
        return np.asarray(found)
    except (*FAULTS, ArithmeticError) as error:
        raise _refused(f"{type(found).__name__} is no array of numbers ({error})", _ONE) from None


def _unit_of(found: Any) -> str | None:
    """Return the unit that something carries, as quantities of Pint, Astropy and unyt do."""
    attributes = getattr(found, "attrs", None)
    noted = attributes if isinstance(attributes, Mapping) else {}
    for name in ("units", "unit"):
        unit = noted.get(name, getattr(found, name, None))
        if unit is not None and not callable(unit):
            return _ONE if str(unit) in ("", "1") else str(unit)
    return None


def _without_unit(found: Any) -> Any:
    for name in ("magnitude", "value"):
        inner = getattr(found, name, None)
        if inner is not None and not callable(inner):
            return inner
    if isinstance(found, np.ma.MaskedArray):
        return np.ma.array(np.asarray(found), mask=np.ma.getmaskarray(found))
    inner = _inner(found)
    if inner is None:
        raise _refused(f"{type(found).__name__} has a unit, but no numbers", _ONE)
    return inner


def _check_order(found: Any, unit: str) -> None:
    """Check that the labels of what is labelled, as in pandas, are those of the rows in order."""
    labels, axes = getattr(found, "indexes", None), getattr(found, "axes", None)
    if isinstance(labels, Mapping):
        axes = list(labels.values())
    for axis in axes if isinstance(axes, list) else []:
        with suppress(*FAULTS):
            if np.array_equal(np.asarray(axis), np.arange(len(axis))):
                continue
        raise _refused(
            f"its rows are labelled {', '.join(map(str, list(axis)[:3]))}, not 0, 1, 2 in order",
            unit, "return them in the order of the conditions, without labels (to_numpy)",
        )  # fmt: skip


def _refused(what: str, unit: str, hint: str = "") -> CalibError:
    plain = "real numbers" if unit == _ONE else f"real numbers in {unit}"
    return CalibError(
        what, expected=f"{plain}, or what has a unit of its own; NaN for no value",
        hint=hint or f"return {plain} with a decimal point, or NaN where there is no value",
    )  # fmt: skip


MAX_TEXT_ROWS = 10_000


@dataclass(frozen=True, eq=False)
class Table:
    """Rows of one data set; every quantity in its canonical unit.

    Parameters
    ----------
    columns : mapping of str to ndarray, shape (n,)
        Canonical name to values; copied and made read-only.
    source : str
        Path as given, or a label.
    lines : ndarray of int, shape (n,)
        Line of each row in the file, the header being line 1; rows from 0 for arrays.
    header : tuple of str
        Column names as in the file.
    text : tuple of tuple of str
        Cells as in the file, numbers with a decimal point, row by row; empty for more than 10,000
        rows, to save memory.
    sha256 : str
        Of the bytes of the file, or of the canonical columns. A subset keeps that of the whole.
    label : str
        What to call the data wherever they are shown, such as ``"reconstructed"``.
    ignored : tuple of str
        Column names that name no known quantity.
    extra : mapping of str to tuple of str
        The cells of these; empty where `text` is.
    """

    columns: Mapping[str, NDArray[np.float64]]
    source: str
    lines: NDArray[np.int64]
    header: tuple[str, ...]
    text: tuple[tuple[str, ...], ...]
    sha256: str
    label: str = ""
    ignored: tuple[str, ...] = ()
    extra: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        frozen = {name: np.array(values, dtype=np.float64) for name, values in self.columns.items()}
        lines = np.array(self.lines, dtype=np.int64)
        for array in (*frozen.values(), lines):
            array.setflags(write=False)
        object.__setattr__(self, "columns", MappingProxyType(frozen))
        object.__setattr__(self, "lines", lines)

    def __reduce__(self) -> tuple[object, ...]:
        # A mapping proxy does not pickle, and worker processes are handed tables.
        return Table, (
            dict(self.columns), self.source, self.lines, self.header, self.text, self.sha256,
            self.label, self.ignored, self.extra,
        )  # fmt: skip

    def __len__(self) -> int:
        return len(self.lines)

    def __contains__(self, name: object) -> bool:
        return name in self.columns

    def __iter__(self) -> Iterator[str]:
        return iter(self.columns)

    def __getitem__(self, name: str) -> NDArray[np.float64]:
        """Return the column of a canonical name, shape (n,)."""
        if name not in self.columns:
            raise CalibError(
                f"there is no column {name!r}", where=self.source,
                expected=", ".join(self.columns), hint="add the column to the data",
            )  # fmt: skip
        return self.columns[name]

    @cached_property
    def _headers(self) -> Mapping[str, Column]:
        columns = [parse_header(header) for header in self.header]
        return {c.quantity.canonical: c for c in columns if c is not None}

    def column(self, name: str) -> Column:
        """Return a quantity's column as the file has it: what messages about its values name.

        Parameters
        ----------
        name : str
            Its canonical name, which stands for the header where the file has none.
        """
        quantity = QUANTITIES[name]
        return self._headers.get(name) or Column(name, quantity, quantity.unit)

    def header_of(self, name: str) -> str:
        """Return the header of a canonical column as it stands in the file."""
        return self.column(name).header if name in QUANTITIES else name

    def to_write[T](self, columns: Mapping[str, T]) -> dict[str, T]:
        """Return columns of this table, by canonical name, under the headers to write them with.

        What was said to be checked is so for whoever reads the file.
        """
        sure = {name for name, column in self._headers.items() if column.checked}
        return {f"{n} {CHECKED}" if n in sure else n: v for n, v in columns.items()}

    def whole(self) -> dict[str, NDArray[np.float64] | tuple[str, ...]]:
        """Return all columns under the headers to write them with, those of no known name too."""
        return {**self.to_write(self.columns), **self.extra}

    def as_in_file(self, columns: Mapping[str, ArrayLike]) -> dict[str, ArrayLike]:
        """Return columns of this table, by canonical name, with its file's headers and units.

        Read again they are the same values, wherever a number in the file's unit gives them.
        """
        found: dict[str, ArrayLike] = {}
        for name, values in columns.items():
            column = self._headers.get(name)
            if column is None:
                found[name] = values
            elif column.unit == column.quantity.unit:
                found[column.header] = values
            else:
                found[column.header] = _written_exactly(column, np.asarray(values))
        return found

    def must_have(self, *names: str) -> None:
        """Raise a CalibError unless there are columns of these canonical names."""
        if missing := [name for name in names if name not in self.columns]:
            raise missing_columns(missing, self.header, self.ignored, self.source)

    def take(self, rows: NDArray[np.bool_] | NDArray[np.int64] | Sequence[int]) -> Table:
        """Return some of the rows, by a mask (n,) or by indices from 0 in the order wanted."""
        index = np.arange(len(self))[np.asarray(rows, dtype=None if len(rows) else np.int64)]
        return replace(
            self,
            columns={name: values[index] for name, values in self.columns.items()},
            lines=self.lines[index],
            text=tuple(self.text[i] for i in index) if self.text else (),
            extra={name: tuple(cells[i] for i in index) for name, cells in self.extra.items()},
        )


def _written_exactly(column: Column, values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return values in a column's unit with the fewest digits that give them back."""
    written = column.written(values)
    for digits in (17, 16, 15):
        shorter = np.array([float(f"{v:.{digits}g}") for v in written])
        written = np.where(column.to_canonical(shorter) == values, shorter, written)
    return written


def hold_out(
    table: Table, quantity_header: str, value: float, rel_tol: float = 1e-3
) -> tuple[Table, Table]:
    """Set aside the rows at one value of a quantity.

    Parameters
    ----------
    table : Table
    quantity_header : str
        A column name in any unit, such as ``"inflation_pressure_psi"``; the data may have it in
        another one.
    value : float
        The value to hold out, in that unit.
    rel_tol : float
        Relative difference up to which a row counts as at that value. 30 psi written as
        207 kPa differs by 7e-4.

    Returns
    -------
    rest, held : Table

    Raises
    ------
    CalibError
        If no row has that value, listing those present, or if every row has it.
    """
    column = parse_header(quantity_header)
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
    wanted = float(column.to_canonical(value))
    scale = abs(wanted) or float(np.nanmax(np.abs(values)))
    held = np.abs(values - wanted) <= rel_tol * scale
    if held.any() and not held.all():
        return table.take(~held), table.take(held)
    present = ", ".join(_distinct(values / column.to_canonical(1.0)))
    where = f"{table.source}, column {quantity_header!r}"
    if held.any():
        raise CalibError(
            f"every row is at {value:g}, so nothing would be left to fit", where=where,
            expected="a value that only some of the rows have", hint="hold out something else",
        )  # fmt: skip
    raise CalibError(
        f"no row is at {value:g}", where=where, expected=f"one of the values present: {present}",
        hint="hold out one of these, or check the unit",
    )  # fmt: skip


def _distinct(values: NDArray[np.float64], most: int = 12) -> list[str]:
    names = list(dict.fromkeys(f"{v:.6g}" for v in np.unique(values[~np.isnan(values)])))
    return names if len(names) <= most else [*names[:most], f"and {len(names) - most} more"]


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
