"""Read measurements: CSV or arrays in, a checked and labelled table in canonical units out.

Every table that is read is labelled here, whatever its file is called; the label goes wherever the
table goes, and a command says of which such data it has read.
"""

from __future__ import annotations

import csv
import hashlib
import io
import logging
import math
import os
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import batched, islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.data.files import decoded, writable
from calib.data.quantities import OUTPUTS, QUANTITIES
from calib.data.registry import Registry
from calib.data.table import CHECKED, MAX_TEXT_ROWS, Column, Table, match_headers, names_quantity
from calib.errors import CalibError

type Array = NDArray[np.float64]


def _no_csv(found: str, where: str, hint: str) -> CalibError:
    allowed = "a CSV file in UTF-8: a line of column names, then one line per row"
    return CalibError(found, where=where, expected=allowed, hint=hint)


@dataclass(frozen=True)
class CsvFile:
    """A file that was found readable as CSV.

    Lines are counted from 1, the hash is of the bytes; rows that are not blank come with the number
    of their line, and cells that are not checked for their number.
    """

    source: str
    header: tuple[str, ...]
    header_line: int
    delimiter: str
    sha256: str
    rows: Iterator[tuple[int, list[str]]]


def open_csv(path: str | os.PathLike[str]) -> CsvFile:
    """Read a file and its header line.

    Raises
    ------
    CalibError
        If it cannot be read, is not text in UTF-8, is empty or has no line of column names.
    """
    source = os.fspath(path)
    raw = _read_bytes(source)
    source = writable(source)
    text = _decode(raw, source)
    delimiter = _delimiter(text)
    rows = _rows(text, delimiter, source)
    line, header = next(rows, (0, []))
    if not header:
        raise _no_csv("the file is empty", source, "`calib template MODEL` writes an example")
    if all(map(_is_number, header)):
        raise _no_csv(
            "the first line holds numbers, not column names", f"{source}, line {line}",
            "put a line of column names such as slip_ratio,drawbar_pull_kn on top",
        )  # fmt: skip
    names = tuple(cell.strip() for cell in header)
    return CsvFile(source, names, line, delimiter, hashlib.sha256(raw).hexdigest(), rows)


def _read_bytes(source: str) -> bytes:
    try:
        return Path(source).read_bytes()
    except FileNotFoundError:
        near = sorted(p.name for p in Path(source).parent.glob("*.csv"))[:5]
        beside = f"; its folder holds {', '.join(near)}" if near else ""
        raise _no_csv("there is no such file", source, f"check the path{beside}") from None
    except IsADirectoryError:
        hint = "name a CSV file inside it"
        raise _no_csv("this is a folder, not a file", source, hint) from None
    except (OSError, ValueError) as error:
        hint = "check the path and the permissions"
        raise _no_csv(f"the file cannot be read ({error})", source, hint) from None


def _decode(raw: bytes, source: str) -> str:
    hint = "save it again as CSV in UTF-8 (Excel: `CSV UTF-8`)"
    try:
        text = decoded(raw)
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        found = f"byte 0x{raw[error.start]:02x} is not {error.encoding.upper()}"
        raise _no_csv(found, f"{source}, line {line}", hint) from None
    if raw.startswith(b"PK\x03\x04") or "\x00" in text:
        raise _no_csv("this is a binary file, such as a workbook, not text", source, hint)
    return text


def _delimiter(text: str) -> str:
    """Return the one of comma, semicolon and tab that the first line has most of."""
    first = next((line for line in io.StringIO(text) if line.strip()), "")
    return max(",;\t", key=first.count)


def _rows(text: str, delimiter: str, source: str) -> Iterator[tuple[int, list[str]]]:
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter, strict=True)
    try:
        for row in reader:
            if any(map(str.strip, row)):
                yield reader.line_num, row
    except csv.Error as error:
        raise _no_csv(
            f"the line cannot be split into cells ({error})", f"{source}, line {reader.line_num}",
            "look for a quotation mark that is opened and not closed",
        ) from None  # fmt: skip


def _is_number(cell: str) -> bool:
    try:
        float(cell.replace(",", "."))
    except ValueError:
        return False
    return True


type Lines = Sequence[int] | NDArray[np.int64]

MAX_SHOWN = 5
_MISSING = frozenset({"", "nan", "na", "n/a", "null", "none"})
# Squares and cubes of larger numbers leave the range of double precision.
_LARGEST = 1e100
_THOUSANDS = re.compile(r"[-+]?[1-9]\d{0,2},\d{3}")
_MINUS = "\N{MINUS SIGN}"
# What instruments and databases write where there is no value; of the positive ones from 9999 on.
_NINES = [10.0**d - 1.0 + more for d in range(2, 7) for more in (0.0, 0.9, 0.99)]
_CODES = np.array([
    *(-x for x in _NINES), *(x for x in _NINES if x >= 9999.0), -999.25, -32768.0,
])  # fmt: skip
# The driven wheel's slip of SAE J670 has no upper bound.
_OTHER_SLIP = (
    "slip is s = 1 - v/(ωr) here, at most 1: if it was recorded as κ = ωr/v - 1, convert every "
    "row, s = κ/(1 + κ)"
)


@dataclass(frozen=True, order=True)
class _Problem:
    line: int
    column: str
    found: str
    expected: str
    hint: str


@dataclass
class Problems:
    """What is wrong with a table, collected to be told at once.

    The source is a file, or the label of arrays; its rows are counted in ``"line"`` or ``"row"``.
    """

    source: str
    place: str = "line"
    total: int = 0
    _kept: dict[str, list[_Problem]] = field(default_factory=dict)

    def add(self, line: int, column: str, found: str, expected: str, hint: str) -> None:
        """Note a problem; the first few of each column are kept, the rest counted."""
        self.total += 1
        kept = self._kept.setdefault(column, [])
        if len(kept) < MAX_SHOWN:
            kept.append(_Problem(line, column, found, expected, hint))

    def raise_any(self) -> None:
        """Raise what was noted, up to five problems in the order of the lines, if anything."""
        if not self.total:
            return
        shown = sorted(p for kept in self._kept.values() for p in kept)[:MAX_SHOWN]
        if self.total == 1:
            only = shown[0]
            raise CalibError(
                only.found,
                where=f"{self.source}, {self._at(only)}",
                expected=only.expected,
                hint=only.hint,
            )
        rows = [f"  {self._at(p)}: {p.found}; expected: {p.expected}" for p in shown]
        if self.total > len(shown):
            rows.append(f"  and {self.total - len(shown)} more")
        raise CalibError(
            "\n".join([f"{self.total} problems in the data", *rows]),
            where=self.source,
            hint="".join(f"\n    - {hint}" for hint in dict.fromkeys(p.hint for p in shown)),
        )

    def _at(self, problem: _Problem) -> str:
        column = f", column {problem.column!r}" if problem.column else ""
        return f"{self.place} {problem.line}{column}"


@dataclass
class Decimals:
    """The first decimal comma and the first decimal point of a file, as (line, column, cell).

    A file that has both could mean 1,234 either way, so it is refused; so is one whose commas are
    all such that they may separate thousands.
    """

    comma: tuple[int, str, str] | None = None
    point: tuple[int, str, str] | None = None
    certain: bool = False

    def complain(self, problems: Problems) -> None:
        """Note a problem if the file has both, or commas that can be either."""
        if self.comma and self.point:
            line, column, cell = self.comma
            other = f"{self.point[2]!r} in line {self.point[0]}, column {self.point[1]!r}"
            problems.add(
                line, column, f"{cell!r} has a decimal comma, but {other} has a decimal point",
                "one decimal sign in the whole file",
                "write every number with a decimal point, without thousands separators",
            )  # fmt: skip
        elif self.comma and not self.certain:
            line, column, cell = self.comma
            problems.add(
                line, column, f"{cell!r} may be {cell.replace(',', '')} or "
                f"{cell.replace(',', '.')}, and no comma of the file tells which",
                "numbers of one reading",
                "write every number with a decimal point, without thousands separators",
            )  # fmt: skip


@dataclass
class CellReader:
    """Read batches of cells of one numeric column.

    Parameters
    ----------
    problems : Problems
        Where complaints go.
    missing_ok : bool
        Whether empty and NaN cells become NaN instead of complaints.
    used : bool
        Whether the column will be used, which a logarithmic output must be fit for.
    decimals : Decimals or None
        None where a comma separates the cells and so cannot be a decimal sign.
    """

    column: Column
    problems: Problems
    missing_ok: bool
    used: bool
    decimals: Decimals | None

    def read(self, cells: Sequence[str], lines: Lines) -> Array:
        """Return the values of cells in the canonical unit, shape (n,)."""
        joined = "".join(cells)
        self._note_point(joined, cells, lines)
        unreadable: set[int] = set()
        try:
            # float() takes 1_000 for a number, a reader of the file would not.
            if "_" in joined:
                raise ValueError
            values = np.fromiter(map(float, cells), dtype=np.float64, count=len(cells))
        except ValueError:
            values = self._read_one_by_one(cells, lines, unreadable)
        return check_values(
            self.column, values, lines, self.problems,
            missing_ok=self.missing_ok, used=self.used, cells=cells, skip=unreadable,
        )  # fmt: skip

    def _note_point(self, joined: str, cells: Sequence[str], lines: Lines) -> None:
        if self.decimals and self.decimals.point is None and "." in joined:
            i = next(i for i, cell in enumerate(cells) if "." in cell)
            self.decimals.point = (int(lines[i]), self.column.header, cells[i])

    def _read_one_by_one(self, cells: Sequence[str], lines: Lines, unreadable: set[int]) -> Array:
        values = np.full(len(cells), np.nan)
        for i, cell in enumerate(cells):
            try:
                values[i] = self._parse(cell, int(lines[i]))
            except ValueError as error:
                unreadable.add(i)
                found, hint = error.args
                name = self.column.header
                self.problems.add(int(lines[i]), name, found, self.column.expected, hint)
        return values

    def _parse(self, cell: str, line: int) -> float:
        text = cell.strip().replace(_MINUS, "-")
        if text.lower() in _MISSING:
            return math.nan
        if "," in text:
            if self.decimals is None or text.count(",") > 1 or "." in text:
                raise ValueError(
                    f"{cell!r} has a comma inside a number",
                    "write numbers with a decimal point and no thousands separators, such as "
                    "1234 or 0.5 (decimal commas are read where semicolons separate the cells)",
                )
            self.decimals.comma = self.decimals.comma or (line, self.column.header, cell)
            self.decimals.certain |= _THOUSANDS.fullmatch(text) is None
            text = text.replace(",", ".")
        try:
            if "_" in text:
                raise ValueError
            return float(text)
        except ValueError:
            raise ValueError(
                f"{cell!r} is not a number",
                "write one plain number, such as 0.05; the unit belongs in the column name",
            ) from None


def check_values(
    column: Column, values: Array, lines: Lines, problems: Problems, *,
    missing_ok: bool, used: bool, cells: Sequence[str] = (), skip: set[int] | None = None,
) -> Array:  # fmt: skip
    """Convert values (n,) to the canonical unit and note those that are not expected.

    Parameters
    ----------
    lines : sequence of int, shape (n,)
        Where the values are.
    missing_ok : bool
        Whether NaN is expected.
    used : bool
        Whether a logarithmic output must be positive.
    cells : sequence of str
        The values as written, for messages.
    skip : set of int, optional
        Positions already complained about.
    """
    with np.errstate(over="ignore"):
        canonical = column.to_canonical(values)
    fine = np.abs(canonical) <= _LARGEST
    if used or not column.quantity.log_scale:
        fine &= column.quantity.range.holds(canonical)
    if missing_ok:
        fine |= np.isnan(canonical)
    fine[list(skip or ())] = True
    bad = np.flatnonzero(~fine)
    for i in bad[:MAX_SHOWN].tolist():
        cell = cells[i] if len(cells) else f"{values[i]:g}"
        found, hint = _complaint(column, float(values[i]), cell, values)
        problems.add(int(lines[i]), column.header, found, column.expected, hint)
    problems.total += max(0, bad.size - MAX_SHOWN)
    return canonical


def check_codes(
    column: Column, canonical: Array, lines: Lines, problems: Problems, *, missing_ok: bool
) -> None:
    """Note codes for missing values, -999 and the like, among values (n,) that can be readings.

    A code is taken for a reading if it is no farther from the other values than these are from one
    another, or if the header says that its values were checked.
    """
    written = column.written(canonical)
    there = np.isfinite(written)
    coded = there & _is_code(written)
    if column.checked or column.quantity.role == "bookkeeping" or not coded.any():
        return
    others = written[there & ~coded]
    low, high = (float(f(others)) for f in (np.min, np.max)) if others.size else (np.inf, -np.inf)
    apart = np.maximum(low - written, written - high) > max(high - low, 0.0)
    among = f", where the others are {low:g} to {high:g}" if others.size else ""
    # Those that cannot be readings have been noted.
    possible = column.quantity.range.holds(canonical)
    for i in np.flatnonzero(coded & apart & possible).tolist():
        problems.add(
            int(lines[i]), column.header,
            f"{written[i]:g} looks like a code for a missing value{among}",
            "an empty cell" if missing_ok else "a measured value", _mend_code(column, missing_ok),
        )  # fmt: skip


def _is_code(written: Array) -> NDArray[np.bool_]:
    # Rounded, for a conversion of units there and back may cost the last bit.
    return np.isin(np.round(written, 6), _CODES)


def _mend_code(column: Column, missing_ok: bool) -> str:
    """Say what to do about a code for a missing value."""
    cell = "leave the cell empty" if missing_ok else "delete the row"
    return f"{cell}; if it is a reading, say so in the column name: '{column.header} {CHECKED}'"


def _complaint(column: Column, value: float, cell: str, values: Array) -> tuple[str, str]:
    """Say what is wrong with a value, one of a column's, and how to fix it."""
    if not math.isfinite(value):
        what = f"{cell.strip()!r} is not a finite number" if cell.strip() else "an empty cell"
        return (
            what,
            "fill in the measured value, or delete the row (the column, if all of it is empty)",
        )
    quantity = column.quantity
    if _is_code(np.array(value)):
        what = f"{cell.strip()!r} is outside the range of {quantity.stem}"
        return what, "if it stands for a missing value, delete the row or leave the cell empty"
    if abs(value) > _LARGEST:
        return f"{cell.strip()!r} is too large for a reading", quantity.hint
    what = f"{cell.strip()!r} is outside the range of {quantity.stem}"
    hint = quantity.hint
    if quantity.kind == "slip" and value > 0.0:
        hint = _OTHER_SLIP
    if "percent" in quantity.units and column.unit == "dimensionless" and abs(value) <= 100.0:
        # Renamed for the sake of a few, the others would be a hundredth of what they are.
        name = f"{quantity.stem}_percent"
        if float(np.nanmedian(np.abs(values))) > 1.0:
            hint = f"did you mean {name}? Then rename the column; otherwise: {hint}"
        else:
            hint += f"; or if all values are percent, rename the column {name}"
    return what, hint


def label_codes(
    column: Column, cells: Sequence[str], lines: Lines, problems: Problems, *, missing_ok: bool
) -> Array:
    """Turn labels into numbers.

    Whole numbers stay as they are; otherwise the codes count the sorted labels from 0, so that
    the order of the rows does not matter. The codes of two tables are not comparable.
    """
    labels = [cell.strip() for cell in cells]
    empty = np.array([not label for label in labels], dtype=np.bool_)
    for i in [] if missing_ok else np.flatnonzero(empty).tolist():
        problems.add(
            int(lines[i]), column.header, "an empty cell", "any label", "fill in the label"
        )
    try:
        codes = np.array([float(label or 0) for label in labels], dtype=np.float64)
    except ValueError:
        codes = np.full(len(labels), np.nan)
    if not (np.isfinite(codes) & (codes == np.round(codes))).all():
        codes = np.unique(labels, return_inverse=True)[1].astype(np.float64)
    codes[empty] = np.nan
    return codes


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
        """Have it recognised."""
        KNOWN_DATA.add(self)


KNOWN_DATA: Registry[KnownData] = Registry("data set", lambda known: known.label)


# Labels of what has been read, since a command cleared them.
SEEN: dict[str, None] = {}


def label_of(table: Table) -> str:
    """Return what a table must be called, from its rows alone; empty if it is nothing known."""
    if len(table) > MAX_TEXT_ROWS or not any(column in table for column in OUTPUTS.values()):
        return ""
    return next((k.label for k in KNOWN_DATA.values() if k.holds(table)), "")


def labelled(table: Table) -> Table:
    """Return a table with the label that it has, or that its rows ask for, else as it is."""
    label = table.label or label_of(table)
    if label in KNOWN_DATA:
        SEEN[label] = None
    return table if label == table.label else replace(table, label=label)


def common_label(*tables: Table | None) -> str:
    """Return what must be said of what is made of tables; empty if nothing."""
    return ", ".join(dict.fromkeys(t.label for t in tables if t is not None and t.label))


def said_of(label: str) -> str:
    """Return the sentences that go with labels, without their citations."""
    known = [KNOWN_DATA[name].methods for name in label.split(", ") if name in KNOWN_DATA]
    return re.sub(r" ?\[@[^]]*\]", "", " ".join(known))


_BATCH = 65_536
_WITH_COMMA = re.compile(r"\s*[-+]?\d*,\d+(e[-+]?\d+)?\s*", re.IGNORECASE)
# An instrument's lines before the column names are fewer.
_PREAMBLE = 100

_log = logging.getLogger(__name__)


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
    """
    file = open_csv(path)
    where = f"{file.source}, line {file.header_line}"
    try:
        columns, ignored = match_headers(file.header, where=where, required=required)
    except CalibError:
        _check_first_line(open_csv(path), where)
        raise
    if not columns:
        _check_first_line(open_csv(path), where)
    problems = Problems(file.source)
    parts = _Parts(columns, file, problems, _wants(required), allow_missing)
    for batch in batched(file.rows, _BATCH):
        parts.add(batch)
    values = parts.finish()
    problems.raise_any()
    if not parts.lines:
        raise CalibError(
            "there are column names but no rows", where=file.source,
            expected="at least one row below the column names", hint="add the measurements",
        )  # fmt: skip
    _log.debug("%s: %d rows of %s", file.source, len(parts.lines), ", ".join(values))
    return labelled(
        Table(
            values, file.source, np.array(parts.lines), file.header, tuple(parts.text),
            file.sha256, label, ignored, _cells(file.header, parts.text, ignored),
        )
    )  # fmt: skip


def _check_first_line(file: CsvFile, where: str) -> None:
    """Refuse a file whose column names stand below other lines."""
    first = ",".join(file.header)
    # What separates the cells was told by the first line.
    named = {
        line: sum(map(names_quantity, re.split("[,;\t]", ",".join(row))))
        for line, row in islice(file.rows, _PREAMBLE)
    }
    line = max(named, key=named.__getitem__, default=0)
    if line and named[line] > sum(map(names_quantity, file.header)):
        raise CalibError(
            f"the first line, {first!r}, names fewer quantities than line {line}", where=where,
            expected="the line of column names first, then one line per row",
            hint=f"delete what stands above line {line}",
        )  # fmt: skip


def _wants(required: Sequence[str]) -> frozenset[str]:
    return frozenset(required or QUANTITIES)


class _Parts:
    """The columns of a file while it is read in batches, which keeps the memory bounded."""

    def __init__(
        self, columns: Sequence[Column], file: CsvFile, problems: Problems,
        used: frozenset[str], allow_missing: Collection[str],
    ) -> None:  # fmt: skip
        self._width = len(file.header)
        self._problems = problems
        self._delimiter = file.delimiter
        self._decimals = None if file.delimiter == "," else Decimals()
        self._missing = allow_missing
        self._used = used
        self._readers = {
            c.quantity.canonical: CellReader(
                c, problems, c.quantity.canonical in allow_missing,
                c.quantity.canonical in used, self._decimals,
            )
            for c in columns if c.quantity.kind != "label"
        }  # fmt: skip
        self._columns = {c.quantity.canonical: c for c in columns}
        self._numbers: dict[str, list[NDArray[np.float64]]] = {n: [] for n in self._readers}
        self._labels: dict[str, list[str]] = {
            n: [] for n in self._columns if n not in self._readers
        }
        self.lines: list[int] = []
        self.text: list[tuple[str, ...]] = []

    def add(self, batch: Sequence[tuple[int, list[str]]]) -> None:
        whole = [pair for pair in batch if len(pair[1]) == self._width]
        if len(whole) < len(batch):
            self._complain_ragged(batch)
        if not whole:
            return
        lines = [line for line, _ in whole]
        cells = list(zip(*(row for _, row in whole), strict=True))
        for name, reader in self._readers.items():
            part = reader.read(cells[self._columns[name].position], lines)
            self._numbers[name].append(part)
        for name, labels in self._labels.items():
            labels.extend(cells[self._columns[name].position])
        self.lines += lines
        small = len(self.lines) <= MAX_TEXT_ROWS
        self.text = [*self.text, *(tuple(row) for _, row in whole)] if small else []

    def _complain_ragged(self, batch: Sequence[tuple[int, list[str]]]) -> None:
        hint = "complete the row, or delete the cells too many"
        if self._delimiter == ",":
            hint += " (a decimal comma splits a number in two: write a decimal point)"
        for line, row in batch:
            if len(row) != self._width:
                found = f"the row has {len(row)} cells, the line of column names {self._width}"
                self._problems.add(line, "", found, f"{self._width} cells", hint)

    def finish(self) -> dict[str, NDArray[np.float64]]:
        if self._decimals:
            self._decimals.complain(self._problems)
            if self._decimals.comma:
                self._write_points()
        done = {n: np.concatenate(p) if p else np.empty(0) for n, p in self._numbers.items()}
        for name, values in done.items():
            if name in self._used:
                check_codes(
                    self._columns[name], values, self.lines, self._problems,
                    missing_ok=name in self._missing,
                )  # fmt: skip
        for name, labels in self._labels.items():
            done[name] = label_codes(
                self._columns[name], labels, self.lines, self._problems,
                missing_ok=name in self._missing,
            )  # fmt: skip
        return {name: done[name] for name in self._columns}

    def _write_points(self) -> None:
        """Give numbers, of columns that are not used too, the decimal sign of what is written."""
        labels = {self._columns[name].position for name in self._labels}
        self.text = [
            tuple(
                cell.replace(",", ".") if i not in labels and _WITH_COMMA.fullmatch(cell) else cell
                for i, cell in enumerate(row)
            )
            for row in self.text
        ]


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

    Returns
    -------
    Table
        Its `text` holds the shortest decimals of the values as given.

    Raises
    ------
    CalibError
        As `read_table` does, with rows counted from 0; also for columns of unequal length.
    """
    arrays = {name: np.asarray(values) for name, values in columns.items()}
    n = _common_length(arrays, source)
    matched, ignored = match_headers(tuple(arrays), where=source, required=required)
    problems, rows, used = Problems(source, place="row"), np.arange(n), _wants(required)
    done: dict[str, NDArray[np.float64]] = {}
    for column in matched:
        name, array = column.quantity.canonical, arrays[column.header]
        missing_ok = name in allow_missing
        if column.quantity.kind == "label":
            cells = [str(value) for value in array.tolist()]
            done[name] = label_codes(column, cells, rows, problems, missing_ok=missing_ok)
            continue
        done[name] = check_values(
            column, _as_floats(array, column, source), rows, problems,
            missing_ok=missing_ok, used=name in used,
        )  # fmt: skip
        if name in used:
            check_codes(column, done[name], rows, problems, missing_ok=missing_ok)
    problems.raise_any()
    text = _texts(arrays, n) if n <= MAX_TEXT_ROWS else ()
    return labelled(
        Table(
            done, source, rows, tuple(arrays), text, _sha256(done), label, ignored,
            _cells(tuple(arrays), text, ignored),
        )
    )  # fmt: skip


def _cells(
    header: Sequence[str], text: Sequence[Sequence[str]], names: Iterable[str]
) -> dict[str, tuple[str, ...]]:
    """Return the cells of some columns."""
    at = {name: header.index(name) for name in names if text}
    return {name: tuple(row[i] for row in text) for name, i in at.items()}


def _common_length(arrays: Mapping[str, NDArray[Any]], source: str) -> int:
    shapes = {name: array.shape for name, array in arrays.items()}
    lengths = set(shapes.values())
    if len(lengths) != 1 or len(next(iter(lengths))) != 1 or lengths == {(0,)}:
        raise CalibError(
            f"the columns have the shapes {shapes}", where=source,
            expected="arrays of one shape (n,) with n of at least 1",
            hint="flatten the arrays and give each column as many values",
        )  # fmt: skip
    return int(next(iter(lengths))[0])


def _as_floats(array: NDArray[Any], column: Column, source: str) -> NDArray[np.float64]:
    if array.dtype.kind not in "fiub":
        raise CalibError(
            f"the values are of type {array.dtype}, not numbers",
            where=f"{source}, column {column.header!r}",
            expected=column.expected,
            hint="pass an array of numbers",
        )
    return array.astype(np.float64)


def _texts(arrays: Mapping[str, NDArray[Any]], n: int) -> tuple[tuple[str, ...], ...]:
    cells = ([str(value) for value in array.tolist()] for array in arrays.values())
    return tuple(zip(*cells, strict=True)) if n else ()


def _sha256(columns: Mapping[str, NDArray[np.float64]]) -> str:
    digest = hashlib.sha256()
    for name in sorted(columns):
        digest.update(f"{name}\0".encode())
        digest.update(columns[name].astype("<f8").tobytes())
    return digest.hexdigest()


def has_rows(path: str | os.PathLike[str], table: Table) -> bool:
    """Whether a file has the rows of a table."""
    kept = read_table(path, allow_missing=tuple(OUTPUTS.values())).columns
    return kept.keys() == table.columns.keys() and all(
        np.array_equal(values, table[name], equal_nan=True) for name, values in kept.items()
    )
