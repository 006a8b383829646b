"""Read a file of any usual kind into one frame of columns as they are called there.

pandas does the reading. What it is not told by the file is found here: the encoding, the separator,
which line names the columns, and the units, which stand in the names, below them or beside them.
"""

from __future__ import annotations

import csv
import hashlib
import io
import os
import re
import tomllib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

import numpy as np

from calib.data.files import decoded, number_in, writable
from calib.data.quantities import UNITS
from calib.data.table import CHECKED, normal, parse_header
from calib.errors import CalibError

if TYPE_CHECKING:
    from pandas import DataFrame

_NAMES = tomllib.loads(Path(__file__).with_name("names.toml").read_text(encoding="utf-8"))
# Units as rigs write them, to pint's spelling; those of column names are known besides.
SPELLINGS: Mapping[str, str] = _NAMES["units"]
# Headers of the loggers that were looked at have fewer lines than this.
_HEAD = 500
_EXTRA = "pip install 'terracalib[import]'"
_SUFFIXES = frozenset(suffix for units in UNITS.values() for suffix in units)
# A percent sign before a separator is a unit.
_COMMENT = re.compile(r"^\s*(#|//|%(?!\s*[,;\t|]))")


@dataclass(frozen=True, eq=False)
class RawTable:
    """The columns of a file, nothing converted.

    Parameters
    ----------
    frame : pandas.DataFrame
        Columns by their names in the file; the index is the line, or the row from 1 where the file
        has no lines, and its name is that word.
    units : mapping of str to str
        Units of columns as the file spells them; columns of which it says nothing are left out.
    notes : sequence of str
        How it was read.
    sheet : str
        The sheet that was read, if there are several.
    source, sha256 : str
        Path as given; hash of the bytes of the file.
    """

    frame: DataFrame
    units: Mapping[str, str]
    notes: Sequence[str] = ()
    sheet: str = ""
    source: str = ""
    sha256: str = ""


def read_raw(path: str | os.PathLike[str], sheet: str = "") -> RawTable:
    """Read a CSV or text file, a workbook, a MATLAB file up to version 7, or Parquet.

    Parameters
    ----------
    path : path-like
        The kind follows from the ending of its name; all that have no other are text.
    sheet : str
        That of a workbook which has several.

    Returns
    -------
    RawTable

    Raises
    ------
    CalibError
        If it cannot be read, or it is not clear which of its sheets or lines are meant.
    """
    source = writable(os.fspath(path))
    try:
        raw = Path(path).read_bytes()
    except OSError as error:
        raise CalibError(
            f"the file cannot be read ({error.strerror})",
            where=source,
            expected="a CSV or text file, a workbook, a .mat file or Parquet",
            hint="check the path and the permissions",
        ) from None
    reader = _READERS.get(Path(path).suffix.lower(), _text)
    try:
        found = reader(raw, sheet)
    except CalibError as error:
        raise error.within(source) from None
    except ImportError as error:
        raise CalibError(
            f"a package that reads such files is not installed ({error})",
            where=source,
            hint=f"install it: {_EXTRA}; or save the file as CSV",
        ) from None
    # Four libraries fail on damaged files in ways of their own.
    except Exception as error:
        raise CalibError(
            f"the file is damaged or not what its name says ({error})",
            where=source,
            hint="save it again, or as CSV",
        ) from None
    frame = found.frame.dropna(how="all")
    if frame.empty:
        raise CalibError("there are no rows", where=source, hint="check which file was meant")
    return replace(found, frame=frame, source=source, sha256=hashlib.sha256(raw).hexdigest())


def is_unit(text: str) -> bool:
    """Whether a text is a unit as rigs write them, in brackets or not; an empty one is."""
    bare = text.strip().strip("[]()<>").strip().lower()
    return bare in SPELLINGS or normal(bare) in _SUFFIXES


def _is_number(cell: str) -> bool:
    with suppress(ValueError):
        return not (cell.endswith(",") or np.isnan(number_in(cell, decimal_comma=True)))
    return False


def _split(line: str, delimiter: str) -> list[str]:
    """Split a line into cells; an empty delimiter stands for any white space."""
    if not delimiter:
        return line.split()
    cells = next(csv.reader([line], delimiter=delimiter)) if '"' in line else line.split(delimiter)
    return [cell.strip() for cell in cells]


def _text(raw: bytes, sheet: str) -> RawTable:
    import pandas as pd

    notes = []
    try:
        text = decoded(raw)
    except UnicodeDecodeError:
        text = raw.decode("cp1252", "replace")
        notes.append("read as Windows-1252, for it is not UTF-8")
    if "\x00" in text:
        raise CalibError(
            "this is a binary file, not text",
            expected="CSV or text, or a name that ends in .xlsx, .ods, .mat or .parquet",
            hint="export it as CSV from the program that wrote it",
        )
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    head = [_COMMENT.sub("", line, count=1) for line in lines[:_HEAD]]

    def numbers(delimiter: str) -> int:
        cells = [c for line in head for c in _split(line, delimiter) if c]
        return sum(_is_number(c) - (not any(map(str.isalnum, c))) for c in cells)

    # Of equals the comma comes last: 1,5;2,5 has as many numbers between commas.
    delimiter = max((";", "\t", "|", "", ","), key=numbers)
    rows = [_split(line, delimiter) for line in head]
    layout = _layout(rows, notes)
    body = ["" if _COMMENT.match(line) else line for line in lines[layout.first :]]
    cells = [cell for row in rows[layout.first :] for cell in row if _is_number(cell)]
    commas = sum("," in cell for cell in cells) > sum("." in cell for cell in cells)
    decimal = "," if commas else "."
    if commas:
        notes.append("numbers have a decimal comma")
    names = [*layout.names, *[f"column {k}" for k in range(_extra_cells(body, delimiter, layout))]]
    frame = pd.read_csv(
        io.StringIO("\n".join(body)), sep=delimiter or r"\s+", header=None, names=names,
        index_col=False, decimal=decimal, skip_blank_lines=False, skipinitialspace=True,
        na_values=["none"],
    )  # fmt: skip
    frame = frame[layout.names]
    frame.index = pd.Index(np.arange(len(frame)) + layout.first + 1, name="line")
    return RawTable(frame, layout.units, notes)


@dataclass(frozen=True)
class _Layout:
    """Names of columns, their units, and the row, from 0, at which the numbers begin."""

    names: list[str]
    units: dict[str, str]
    first: int
    line: int


def _layout(rows: Sequence[Sequence[str]], notes: list[str]) -> _Layout:
    """Find the names above the numbers: the data are the rows of the usual width and content."""
    counts = [sum(map(_is_number, row)) for row in rows]
    widths = Counter[int]()
    for row, count in zip(rows, counts, strict=True):
        widths[len(row)] += count
    width = max(widths, key=widths.__getitem__, default=0)
    there = [i for i, row in enumerate(rows) if any(row)]
    usual = [counts[i] for i in there if len(rows[i]) == width and counts[i]]
    # In a block above the names few cells are numbers, in some rows of data cells are empty.
    data = {i for i in there if len(rows[i]) == width and 2 * counts[i] > median(usual or [1])}

    def heads(i: int) -> bool:
        words = list(filter(None, rows[i]))
        return not counts[i] and (2 * len(words) > width or all(map(is_unit, words)))

    # Loggers write tables about the channels first, so the last names count; repeated ones are no
    # new table, and a text in the only column is no name.
    starts = [(k, i) for k, i in pairwise(there) if i in data and k not in data and heads(k)]
    if not starts:
        raise CalibError(
            "no line names the columns" if data else "there are no rows of numbers",
            expected="a line of column names, one of units if there is one, then rows of numbers",
            hint="write the names of the columns, separated as the numbers are, above them",
        )
    last = rows[starts[-1 if width > 1 else 0][0]]
    line, first = next((k, i) for k, i in starts if rows[k] == last)
    above = [i for i in there if i < line]
    below: Sequence[str] = ()
    if above and len(rows[above[-1]]) > 1 and all(map(is_unit, filter(None, rows[line]))):
        below, line = rows[line], above.pop()
        notes.append(f"units stand in line {line + 2}")
    if above:
        notes.append(f"the names stand in line {line + 1}, below other lines")
    cells = list(rows[line])
    while cells and not cells[-1]:
        cells.pop()
    names = _unique(cells)
    units = {name: unit for name in names if (unit := _unit_in(name))}
    units |= {n: u.strip("[]()<>") for n, u in zip(names, below, strict=False) if u.strip("[]()<>")}
    return _Layout(names, units, first, line)


def _unique(cells: Sequence[str]) -> list[str]:
    seen, names = Counter[str](), []
    for k, cell in enumerate(cells):
        name = " ".join(cell.split()) or f"column {k + 1}"
        seen[name] += 1
        names.append(name if seen[name] == 1 else f"{name} ({seen[name]})")
    return names


def _unit_in(name: str) -> str:
    """Return the unit that a name ends in: in brackets, behind a stroke or an underscore."""
    bare = re.sub(rf"\s*{re.escape(CHECKED)}\s*$", "", name, flags=re.IGNORECASE)
    if found := re.search(r"[\[(<]([^\])>]*)[\])>]\s*$", bare):
        return found[1].strip()
    with suppress(CalibError):
        if (column := parse_header(name)) is not None:
            units = column.quantity.units.items()
            return next((suffix for suffix, unit in units if unit == column.unit), "")
    found = re.search(r"(?: / |_)([^\s_]+)$", bare)
    return found[1] if found and is_unit(found[1]) else ""


def _extra_cells(body: Sequence[str], delimiter: str, layout: _Layout) -> int:
    """Return how many empty cells rows have behind the last name; other rows are refused."""
    wanted, extra = len(layout.names), 0
    for i, line in enumerate(body):
        quick = delimiter and '"' not in line
        n = line.count(delimiter) + 1 if quick else len(_split(line, delimiter))
        if n == wanted or not line.strip(" ;,\t|"):
            continue
        if n < wanted or any(_split(line, delimiter)[wanted:]):
            raise CalibError(
                f"the row has {n} cells, the line of names, {layout.line + 1}, has {wanted}",
                where=f"line {layout.first + i + 1}",
                expected=f"{wanted} cells: {', '.join(layout.names)}",
                hint="leave the cell of what was not measured empty, but keep its separator; names "
                "and numbers must not hold the separator",
            )
        extra = max(extra, n - wanted)
    return extra


def _workbook(raw: bytes, sheet: str) -> RawTable:
    import pandas as pd

    found = pd.read_excel(io.BytesIO(raw), sheet_name=None, header=None, engine="calamine")
    sheets = {str(name): cells for name, cells in found.items()}
    there = [name for name, cells in sheets.items() if not cells.empty]
    if sheet not in there and (sheet or len(there) != 1):
        raise CalibError(
            f"there is no sheet {sheet!r}" if sheet else f"there are {len(there)} sheets",
            expected=", ".join(map(repr, there)) or "a sheet that is not empty",
            hint="name one: --sheet, or sheet = in the mapping",
        )
    sheet = sheet or there[0]
    cells = sheets[sheet]
    head = [
        ["" if cell is None or cell != cell else str(cell).strip() for cell in row]
        for row in cells.head(_HEAD).itertuples(index=False, name=None)
    ]
    notes: list[str] = []
    layout = _layout(head, notes)
    frame = cells.iloc[layout.first :, : len(layout.names)].infer_objects()
    frame.columns = pd.Index(layout.names)
    frame.index = pd.Index(frame.index + 1, name="line")
    return RawTable(frame, layout.units, notes, sheet if len(there) > 1 else "")


def _matlab(raw: bytes, sheet: str) -> RawTable:
    import pandas as pd
    from scipy.io import loadmat

    try:
        content = loadmat(io.BytesIO(raw), simplify_cells=True)
    except NotImplementedError:
        raise CalibError(
            "the file is of MATLAB 7.3, which is another format (HDF5)",
            expected="a .mat file up to version 7",
            hint="save it as save('name.mat', '-v7'), or as CSV by writetable",
        ) from None
    flat = dict(_flat({k: v for k, v in content.items() if not k.startswith("__")}))
    columns = {n: v for n, v in flat.items() if len(v) > 1 and v.dtype.kind in "fiubUO"}
    lengths = Counter(len(v) for v in columns.values() if v.dtype.kind in "fiu")
    if not lengths:
        raise CalibError(
            "there are no columns of numbers",
            expected="vectors of one length, alone or as fields of a struct",
            hint="in MATLAB make a struct of a table, s = table2struct(t, 'ToScalar', true), and "
            "save it; or use writetable",
        )
    length = lengths.most_common(1)[0][0]
    # As the tyre test consortium has them, names and units stand beside the columns.
    beside = {n: f"{n.removesuffix('name')}units" for n in columns if n.endswith("name")}
    units = {
        str(name): str(unit)
        for names, of in beside.items()
        for name, unit in zip(columns[names], columns.get(of, ()), strict=False)
    }
    words = {*beside, *beside.values()}
    frame = pd.DataFrame(
        {name: v for name, v in columns.items() if len(v) == length and name not in words}
    )
    frame.index = pd.Index(frame.index + 1, name="row")
    other = [n for n, v in columns.items() if len(v) != length and v.dtype.kind in "fiu"]
    notes = [f"of another length than most, not read: {', '.join(other)}"] if other else []
    return RawTable(frame, {n: u for n, u in units.items() if n in frame and u}, notes)


def _flat(content: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the columns of nested structs; of a matrix each column by its number."""
    for name, value in content.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}.")
        elif isinstance(value, np.ndarray | list):
            array = np.asarray(value)
            if array.ndim == 1:
                yield f"{prefix}{name}", array
            elif array.ndim == 2:
                yield from (
                    (f"{prefix}{name}[{k + 1}]", array[:, k]) for k in range(array.shape[1])
                )


def _parquet(raw: bytes, sheet: str) -> RawTable:
    import pandas as pd

    frame = pd.read_parquet(io.BytesIO(raw)).reset_index(drop=True)
    frame.columns = pd.Index(_unique([str(name) for name in frame.columns]))
    frame.index = pd.Index(frame.index + 1, name="row")
    return RawTable(frame, {name: unit for name in frame if (unit := _unit_in(str(name)))})


_READERS: Mapping[str, Callable[[bytes, str], RawTable]] = {
    **dict.fromkeys((".xlsx", ".xlsm", ".xlsb", ".xls", ".ods"), _workbook),
    ".mat": _matlab,
    ".parquet": _parquet,
}
