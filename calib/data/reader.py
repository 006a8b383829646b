"""Read measurements: CSV or arrays in, a checked and labelled table in canonical units out.

Every table that is read is labelled here, whatever its file is called; the label goes wherever the
table goes, and a command says of which such data it has read.
"""

from __future__ import annotations

import hashlib
import logging
import os
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import batched, islice
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.data.cells import CellReader, Decimals, Problems, check_codes, check_values, label_codes
from calib.data.files import CsvFile, open_csv
from calib.data.headers import Column, match_headers, names_quantity
from calib.data.quantities import OUTPUTS, QUANTITIES
from calib.data.registry import Registry
from calib.data.table import MAX_TEXT_ROWS, Table
from calib.errors import CalibError


@dataclass(frozen=True)
class KnownData:
    """A data set that must be called what it is.

    Parameters
    ----------
    words : str
        What it is, in a sentence.
    methods : str
        What a paper must say of it, a sentence with marks (`calib.report.publish.markup`).
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
