"""Read measurements: CSV or arrays in, a checked and labelled table in canonical units out.

Every table that is read is labelled here, whatever its file is called; the label goes wherever the
table goes, and a command says of which such data it has read. Files are split by the standard
library: pandas does not say on which line a row stood.
"""

from __future__ import annotations

import hashlib
import logging
import math
import os
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from os import PathLike
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.arguments import takes
from calib.data.files import IMPORT, CsvFile, number_in, open_csv, with_points
from calib.data.quantities import OUTPUTS, QUANTITIES, UNITS
from calib.data.registry import Registry
from calib.data.table import (
    CHECKED,
    MAX_TEXT_ROWS,
    Column,
    Table,
    match_headers,
    names_quantity,
    normal,
)
from calib.errors import CalibError

type Array = NDArray[np.float64]


class Frame(Protocol):
    """What a pandas DataFrame has."""

    def items(self) -> Iterable[tuple[Any, Any]]:
        """Return columns by name."""


# What stands for a table: columns by names with units, as in a file.
type Tabular = Table | Mapping[str, ArrayLike] | Frame | str | os.PathLike[str]

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class KnownData:
    """A data set that must be called what it is.

    Parameters
    ----------
    words : str
        What it is, in a sentence.
    methods : str
        What a paper must say of it, a sentence with marks (`calib.report.markup`).
    holds : callable
        ``table -> bool``: whether all rows of a table are rows of it.
    """

    label: str
    words: str
    methods: str
    holds: Callable[[Table], bool]

    def register(self) -> None:
        """Register it."""
        KNOWN_DATA.add(self)


KNOWN_DATA: Registry[KnownData] = Registry("data set", lambda known: known.label)
# Labels of all that has been read, until a command clears them.
SEEN: dict[str, None] = {}


def label_of(table: Table) -> str:
    """Return what a table must be called, from its rows alone; empty if it is nothing known."""
    if len(table) > MAX_TEXT_ROWS or not any(column in table for column in OUTPUTS.values()):
        return ""
    return next((k.label for k in KNOWN_DATA.values() if k.holds(table)), "")


def _labelled(table: Table, ignored: tuple[str, ...]) -> Table:
    """Return a table with its label, or the one that its rows ask for, and its other columns."""
    label = table.label or label_of(table)
    if label in KNOWN_DATA:
        SEEN[label] = None
    at = {name: table.header.index(name) for name in ignored if table.text}
    extra = {name: tuple(row[i] for row in table.text) for name, i in at.items()}
    return replace(table, label=label, ignored=ignored, extra=extra)


def common_label(*tables: Table | None) -> str:
    """Return what must be said of what is made of tables; empty if nothing."""
    return ", ".join(dict.fromkeys(t.label for t in tables if t is not None and t.label))


def said_of(label: str) -> str:
    """Return the sentences that go with labels, without their citations."""
    known = [KNOWN_DATA[name].methods for name in label.split(", ") if name in KNOWN_DATA]
    return re.sub(r" ?\[@[^]]*\]", "", " ".join(known))


class Fault(NamedTuple):
    """Something wrong in a table; an empty column stands for the whole row."""

    line: int
    column: str
    found: str
    expected: str
    hint: str


def _raise_any(problems: Sequence[Fault], source: str, place: str = "line") -> None:
    """Raise the first problems in the order of the lines, and the number of all, if any."""
    if not problems:
        return

    def at(problem: Fault) -> str:
        column = f", column {problem.column!r}" if problem.column else ""
        return f"{place} {problem.line}{column}"

    each = [
        CalibError(p.found, where=f"{source}, {at(p)}", expected=p.expected, hint=p.hint)
        for p in sorted(problems)
    ]
    if len(each) == 1:
        raise each[0]
    shown = sorted(problems)[:5]
    rows = [f"  {at(p)}: {p.found}; expected: {p.expected}" for p in shown]
    rows += [f"  and {len(problems) - 5} more"] * (len(problems) > 5)
    hints = list(dict.fromkeys(p.hint for p in shown))
    error = CalibError(
        "\n".join([f"{len(problems)} problems in the data", *rows]),
        where=source,
        hint=hints[0] if len(hints) == 1 else "".join(f"\n    - {hint}" for hint in hints),
    )
    error.each = tuple(each)
    raise error


def _check_first_line(file: CsvFile, where: str) -> None:
    """Refuse a file with other lines above the column names, or units in the line below them."""
    # The separator was taken from the first line, so other lines may have another.
    named = {
        line: sum(map(names_quantity, re.split("[,;\t]", ",".join(row))))
        for line, row in file.rows[:100]
    }
    line = max(named, key=named.__getitem__, default=0)
    if line and named[line] > sum(map(names_quantity, file.header)):
        raise CalibError(
            f"the first line, {','.join(file.header)!r}, names fewer quantities than line {line}",
            where=where,
            expected="the line of column names first, then one line per row",
            hint=f"delete what stands above line {line}, or {IMPORT.format(source=file.source)}",
        )
    line, cells = file.rows[0] if file.rows else (0, [])
    if any(normal(cell) in units for cell in cells for units in UNITS.values()):
        raise CalibError(
            f"the line below the column names, {','.join(cells)!r}, holds units",
            where=f"{file.source}, line {line}",
            expected="units in the column names, such as slip_percent or Rut depth [mm]",
            hint=f"write them there and delete the line, or {IMPORT.format(source=file.source)}",
        )


@dataclass(frozen=True)
class _Values:
    """Numbers of one column (n,) while they are checked: as written, NaN where there is none."""

    column: Column
    written: Array
    lines: Sequence[int]
    missing_ok: bool
    # A logarithmic output must be positive only where it is used; codes are looked for only there.
    used: bool
    cells: Sequence[str] = ()
    unreadable: Mapping[int, tuple[str, str]] = field(default_factory=dict)

    @cached_property
    def canonical(self) -> Array:
        with np.errstate(over="ignore"):
            return self.column.to_canonical(self.written)

    def problem(self, i: int, found: str, hint: str, expected: str = "") -> Fault:
        expected = expected or self.column.expected
        return Fault(int(self.lines[i]), self.column.header, found, expected, hint)

    def problems(self) -> Iterator[Fault]:
        yield from _impossible(self)
        if self.used:
            yield from _codes(self)


def _impossible(of: _Values) -> Iterator[Fault]:
    """Values that are not finite, too large for a reading or outside the quantity's range."""
    quantity = of.column.quantity
    # Squares and cubes of larger numbers leave the range of double precision.
    small = np.abs(of.canonical) <= 1e100
    fine = small.copy()
    if of.used or not quantity.log_scale:
        fine &= quantity.range.holds(of.canonical)
    if of.missing_ok:
        fine |= np.isnan(of.canonical)
    fine[list(of.unreadable)] = True
    for i in np.flatnonzero(~fine).tolist():
        value = float(of.written[i])
        cell = of.cells[i].strip() if len(of.cells) else f"{value:g}"
        found = f"{cell!r} is outside the range of {quantity.stem}"
        if not math.isfinite(value):
            found = f"{cell!r} is not a finite number" if cell else "an empty cell"
            hint = (
                "fill in the measured value, or delete the row (the column, if all of it is empty)"
            )
        elif _is_code(np.array(value)):
            hint = "if it stands for a missing value, delete the row or leave the cell empty"
        elif not small[i] and not of.column.kappa:
            found, hint = f"{cell!r} is too large for a reading", quantity.hint
        else:
            hint = _range_hint(of, value)
        yield of.problem(i, found, hint)


def _range_hint(of: _Values, value: float) -> str:
    """Say what may be the matter with a value outside the range."""
    quantity, hint = of.column.quantity, of.column.quantity.hint
    if of.column.kappa:
        return "slip goes down to s = 1 - v/(ωr) = -1, which is κ = -0.5: leave the row out"
    if quantity.kind == "slip" and value > 0.0:
        # The driven wheel's slip of SAE J670 has no upper bound.
        hint = (
            "slip is s = 1 - v/(ωr) here, at most 1: if it was recorded as κ = ωr/v - 1, rename "
            f"the column {quantity.stem}_kappa_ratio or {quantity.stem}_kappa_percent"
        )
    if "percent" in quantity.units and of.column.unit == "dimensionless" and abs(value) <= 100.0:
        # Renamed for the sake of a few, the others would be a hundredth of what they are.
        name = f"{quantity.stem}_percent"
        if float(np.nanmedian(np.abs(of.written))) > 1.0:
            return f"did you mean {name}? Then rename the column; otherwise: {hint}"
        return f"{hint}; or if all values are percent, rename the column {name}"
    return hint


def _is_code(written: Array) -> NDArray[np.bool_]:
    """Whether values are written where there is none: -99.9, 9999 and the like, -32768."""
    nines = [10.0**digits - 1.0 + more for digits in range(2, 7) for more in (0.0, 0.9, 0.99)]
    large = [x for x in nines if x >= 9999.0]
    # Rounded, for a conversion of units there and back may cost the last bit.
    return np.isin(np.round(written, 6), [*np.negative(nines), *large, -999.25, -32768.0])


def _codes(of: _Values) -> Iterator[Fault]:
    """Codes for missing values among values that can be readings.

    A code is taken for a reading if it is no farther from the other values than these are from one
    another, or if the header says that its values were checked.
    """
    column = of.column
    written = column.written(of.canonical)
    there = np.isfinite(written)
    coded = there & _is_code(written)
    if column.checked or column.quantity.role == "bookkeeping" or not coded.any():
        return
    others = written[there & ~coded]
    low, high = (others.min(), others.max()) if others.size else (np.inf, -np.inf)
    apart = np.maximum(low - written, written - high) > max(high - low, 0.0)
    among = f", where the others are {low:g} to {high:g}" if others.size else ""
    remedy = "leave the cell empty" if of.missing_ok else "delete the row"
    # Those that cannot be readings have been noted.
    for i in np.flatnonzero(coded & apart & column.quantity.range.holds(of.canonical)).tolist():
        yield of.problem(
            i,
            f"{written[i]:g} looks like a code for a missing value{among}",
            f"{remedy}; if it is a reading, say so in the column name: '{column.header} {CHECKED}'",
            "an empty cell" if of.missing_ok else "a measured value",
        )


def _decimal_signs(
    columns: Sequence[tuple[str, Sequence[str]]], lines: Sequence[int]
) -> list[Fault]:
    """Decimal commas beside decimal points, or commas that may all separate thousands."""
    found: dict[str, list[tuple[int, str, str]]] = {
        sign: [
            (line, header, cell)
            for header, cells in columns
            for line, cell in zip(lines, cells, strict=True)
            if sign in cell and cell.count(",") < 2 and not ("," in cell and "." in cell)
        ]
        for sign in ",."
    }
    if not found[","]:
        return []
    line, column, cell = found[","][0]
    hint = "write every number with a decimal point, without thousands separators"
    if found["."]:
        at, name, other = found["."][0]
        said = f"{other!r} in line {at}, column {name!r} has a decimal point"
        said = f"{cell!r} has a decimal comma, but {said}"
        return [Fault(line, column, said, "one decimal sign in the whole file", hint)]
    if all(re.fullmatch(r"[-+]?[1-9]\d{0,2},\d{3}", text.strip()) for _, _, text in found[","]):
        said = f"{cell!r} may be {cell.replace(',', '')} or {cell.replace(',', '.')}"
        said += ", and no comma of the file tells which"
        return [Fault(line, column, said, "numbers of one reading", hint)]
    return []


def _labels(
    column: Column, cells: Sequence[str], lines: Sequence[int], missing_ok: bool
) -> tuple[Array, list[Fault]]:
    """Turn labels into numbers.

    Whole numbers stay as they are; otherwise the codes count the sorted labels from 0, so that
    the order of the rows does not matter. The codes of two tables are not comparable.
    """
    labels = [cell.strip() for cell in cells]
    empty = np.array([not label for label in labels], dtype=np.bool_)
    problems = [
        Fault(int(lines[i]), column.header, "an empty cell", "any label", "fill in the label")
        for i in ([] if missing_ok else np.flatnonzero(empty).tolist())
    ]
    try:
        codes = np.array([float(label or 0) for label in labels], dtype=np.float64)
    except ValueError:
        codes = np.full(len(labels), np.nan)
    if not (np.isfinite(codes) & (codes == np.round(codes))).all():
        codes = np.unique(labels, return_inverse=True)[1].astype(np.float64)
    codes[empty] = np.nan
    return codes, problems


def _checked(
    columns: Sequence[Column],
    parts: Sequence[Sequence[str] | Array],
    lines: Sequence[int],
    required: Sequence[str],
    allow_missing: Collection[str],
    decimal_comma: bool = False,
) -> tuple[dict[str, Array], list[Fault]]:
    """Return the canonical values of columns, of cells or numbers, and what is wrong with them."""
    values, problems = {}, []
    for column in columns:
        name, part = column.quantity.canonical, parts[column.position]
        missing_ok, used = name in allow_missing, not required or name in required
        if column.quantity.kind == "label":
            values[name], bad = _labels(column, [*map(str, part)], lines, missing_ok)
            problems += bad
            continue
        if isinstance(part, np.ndarray):
            found = _Values(column, part.astype(np.float64), lines, missing_ok, used)
        else:
            written, unreadable = np.full(len(part), np.nan), {}
            for i, cell in enumerate(part):
                try:
                    written[i] = number_in(cell, decimal_comma)
                except ValueError as error:
                    unreadable[i] = error.args
            found = _Values(column, written, lines, missing_ok, used, part, unreadable)
        problems += [found.problem(i, *said) for i, said in found.unreadable.items()]
        problems += found.problems()
        values[name] = found.canonical
    return values, problems


@takes(path=PathLike)
def read_table(
    path: str | os.PathLike[str],
    *,
    required: Sequence[str] = (),
    allow_missing: Collection[str] = (),
    label: str = "",
) -> Table:
    """Read a CSV file whose column names carry units.

    Commas, semicolons or tabs separate the cells; a decimal comma is read where commas do not.

    Parameters
    ----------
    required : sequence of str
        Canonical names of the columns that will be used. If none are named, all count as used.
    allow_missing : collection of str
        Canonical names of the columns in which an empty cell or NaN is kept as NaN.
    label : str
        Kept in the table.

    Returns
    -------
    Table

    Raises
    ------
    CalibError
        Naming file, line, column, what was found, what is expected and how to fix it.

    Examples
    --------
    >>> import calib
    >>> table = calib.read_table("my.csv", required=["slip_ratio"])  # doctest: +SKIP
    >>> table["slip_ratio"]  # doctest: +SKIP
    """
    file = open_csv(path)
    where, width = f"{file.source}, line {file.header_line}", len(file.header)
    try:
        columns, ignored = match_headers(file.header, where=where, required=required)
    except CalibError:
        _check_first_line(file, where)
        raise
    if not columns:
        _check_first_line(file, where)
    comma_ok = file.delimiter != ","
    whole = [pair for pair in file.rows if len(pair[1]) == width]
    lines = [line for line, _ in whole]
    cells: list[tuple[str, ...]] = list(zip(*(row for _, row in whole), strict=True))
    cells = cells or [()] * width
    numeric = [(c.header, cells[c.position]) for c in columns if c.quantity.kind != "label"]
    values, problems = _checked(columns, cells, lines, required, allow_missing, comma_ok)
    problems += _ragged(file)
    problems += _decimal_signs(numeric, lines) if comma_ok else []
    _raise_any(problems, file.source)
    if not whole:
        raise CalibError(
            "there are column names but no rows",
            where=file.source,
            expected="at least one row below the column names",
            hint="add the measurements",
        )
    _log.debug("%s: %d rows of %s", file.source, len(lines), ", ".join(values))
    if comma_ok and any("," in cell for _, part in numeric for cell in part):
        labels = {c.position for c in columns if c.quantity.kind == "label"}
        cells = [part if i in labels else with_points(part) for i, part in enumerate(cells)]
    text = tuple(zip(*cells, strict=True)) if len(lines) <= MAX_TEXT_ROWS else ()
    table = Table(values, file.source, np.array(lines), file.header, text, file.sha256, label)
    return _labelled(table, ignored)


def _ragged(file: CsvFile) -> Iterator[Fault]:
    """Rows of more or fewer cells than there are column names."""
    width = len(file.header)
    hint = "complete the row, or delete the cells too many"
    if file.delimiter == ",":
        hint += " (a decimal comma splits a number in two: write a decimal point)"
    for line, row in file.rows:
        if len(row) != width:
            found = f"the row has {len(row)} cells, the line of column names {width}"
            yield Fault(line, "", found, f"{width} cells", hint)


def read_for_model(path: str | os.PathLike[str], used: Sequence[str]) -> Table:
    """Read a file, as `read_table`, of which only some columns, canonical names, will be used.

    These must be there, whole; the others may have empty cells.
    """
    unused = [name for name in QUANTITIES if name not in used]
    return read_table(path, required=used, allow_missing=unused)


def table_from_arrays(
    columns: Mapping[str, ArrayLike],
    *,
    source: str = "arrays",
    label: str = "",
    required: Sequence[str] = (),
    allow_missing: Collection[str] = (),
    lines: Sequence[int] | NDArray[np.int64] | None = None,
    place: str = "row",
) -> Table:
    """Make a table of arrays, with the checks of a file.

    Parameters
    ----------
    columns : mapping of str to array_like, shape (n,)
        Column names with units, as in a file, to values.
    source, label : str
        Names for messages and for whoever shows the table.
    required, allow_missing
        As for `read_table`.
    lines : sequence of int, shape (n,), optional
        Where each row stands in what it was taken from; from 0 by default.
    place : str
        What messages call that.

    Returns
    -------
    Table
        Its `text` holds the shortest decimals of the values as given.

    Raises
    ------
    CalibError
        As `read_table` does, with rows counted from 0; also for columns of unequal length.

    Examples
    --------
    >>> import calib
    >>> table = calib.table_from_arrays({"slip_percent": [5, 20], "drawbar_pull_lbf": [90, 210]})
    >>> table["drawbar_pull_kn"].round(3).tolist()
    [0.4, 0.934]
    """
    arrays = {name: np.asarray(values) for name, values in columns.items()}
    n = _common_length(arrays, source)
    rows = range(n) if lines is None else [int(line) for line in lines]
    matched, ignored = match_headers(tuple(arrays), where=source, required=required)
    for column in matched:
        kind = arrays[column.header].dtype
        if column.quantity.kind != "label" and kind.kind not in "fiu":
            odd = next((i for i, v in enumerate(arrays[column.header]) if _is_text(v)), None)
            raise CalibError(
                f"the values are of type {kind}, not numbers"
                + ("" if odd is None else f" (row {odd}: {str(arrays[column.header][odd])!r})"),
                where=f"{source}, column {column.header!r}",
                expected=column.expected,
                hint="pass an array of numbers, as from pandas.to_numeric",
            )
    header = tuple(arrays)
    values, problems = _checked(matched, [*arrays.values()], rows, required, allow_missing)
    _raise_any(problems, source, place)
    digest = hashlib.sha256()
    for name in sorted(values):
        digest.update(f"{name}\0".encode())
        digest.update(values[name].astype("<f8").tobytes())
    text: tuple[tuple[str, ...], ...] = ()
    if len(rows) <= MAX_TEXT_ROWS:
        cells = (map(str, array.tolist()) for array in arrays.values())
        text = tuple(zip(*cells, strict=True))
    table = Table(values, source, np.array(rows), header, text, digest.hexdigest(), label)
    return _labelled(table, ignored)


def as_table(data: Tabular, *, allow_missing: Sequence[str] = ()) -> Table:
    """Return a table as it is; read a file; make a table of a mapping or a data frame.

    Parameters
    ----------
    data : Table, path of a CSV, mapping of str to array_like, or pandas.DataFrame
        Column names with units, as in a file, to values.
    allow_missing : sequence of str
        Canonical columns in which a value may be missing.

    Raises
    ------
    CalibError
        As `table_from_arrays` and `read_table` do; also for anything else, or a column given twice.

    Examples
    --------
    >>> as_table({"slip_percent": [5.0, 20.0]})["slip_ratio"].tolist()
    [0.05, 0.2]
    """
    if isinstance(data, Table):
        return data
    if isinstance(data, str | os.PathLike):
        return read_table(data, allow_missing=allow_missing)
    if not hasattr(data, "items"):
        raise CalibError(
            f"{type(data).__name__} is no table",
            expected="a table, the path of a CSV, a dictionary of columns, or a pandas DataFrame",
            hint="give columns by their names with units",
        )
    pairs = [(str(name), values) for name, values in data.items()]
    twice = [name for name, count in Counter(name for name, _ in pairs).items() if count > 1]
    if twice:
        raise CalibError(
            f"a column is given twice: {twice[0]}",
            expected="each column once",
            hint="drop one of them",
        )
    table = table_from_arrays(dict(pairs), allow_missing=allow_missing)
    return replace(table, index=index_of(data) or ())


def _is_text(value: object) -> bool:
    try:
        float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        return True
    return False


def index_of(data: object) -> tuple[object, ...] | None:
    """Return the labels of a data frame's rows, or of a table made of one; None of others."""
    if isinstance(data, Table):
        return data.index or None
    return tuple(data.index) if hasattr(data, "iloc") and hasattr(data, "index") else None


def _common_length(arrays: Mapping[str, NDArray[Any]], source: str) -> int:
    shapes = {name: array.shape for name, array in arrays.items()}
    lengths = set(shapes.values())
    if lengths == {(0,)}:
        raise CalibError(
            "the table has no rows",
            where=source,
            expected="at least one row",
            hint="look at what selected the rows",
        )
    if lengths == {()}:
        raise CalibError(
            "the columns are single numbers",
            where=source,
            expected="a list of values in each column",
            hint="write [10.0] for 10.0",
        )
    if len(lengths) != 1 or len(next(iter(lengths))) != 1 or lengths == {(0,)}:
        raise CalibError(
            f"the columns have the shapes {shapes}",
            where=source,
            expected="arrays of one shape (n,) with n of at least 1",
            hint="flatten the arrays and give each column as many values",
        )
    return int(next(iter(lengths))[0])


def has_rows(path: str | os.PathLike[str], table: Table) -> bool:
    """Whether a file has the rows of a table."""
    kept = read_table(path, allow_missing=tuple(OUTPUTS.values())).columns
    return kept.keys() == table.columns.keys() and all(
        np.array_equal(values, table[name], equal_nan=True) for name, values in kept.items()
    )
