"""Files and numbers as people write them: CSV dialects, encodings, TOML, JSON, short numbers."""

from __future__ import annotations

import codecs
import csv
import hashlib
import io
import json
import math
import os
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.errors import FAULTS, CalibError

# What reads files that are none of calib's own.
IMPORT = "have it read as it is: calib import {source} --out imported.csv"


@dataclass(frozen=True)
class CsvFile:
    """A file that can be read as CSV.

    Lines are counted from 1, the hash is of the bytes. Rows that are not blank come with the number
    of their line; the number of their cells is not checked.
    """

    source: str
    header: tuple[str, ...]
    header_line: int
    delimiter: str
    sha256: str
    rows: Sequence[tuple[int, list[str]]]


def _no_csv(found: str, where: str, hint: str) -> CalibError:
    expected = "a CSV file in UTF-8: a line of column names, then one line per row"
    return CalibError(found, where=where, expected=expected, hint=hint)


def open_csv(path: str | os.PathLike[str]) -> CsvFile:
    """Read a file and split it into cells.

    Raises
    ------
    CalibError
        If it cannot be read, is not text in UTF-8, is empty or has no line of column names.
    """
    source = os.fspath(path)
    raw = _read_bytes(source)
    source = writable(source)
    text = _decode(raw, source)
    first = next((line for line in io.StringIO(text) if line.strip()), "")
    delimiter = max(",;\t", key=first.count)
    (line, header), *rows = [*_rows(text, delimiter, source)] or [(0, [])]
    if not header:
        raise _no_csv("the file is empty", source, "`calib template MODEL` writes an example")
    if all(re.fullmatch(r"\s*[-+]?[\d.,]+(e[-+]?\d+)?\s*", cell, re.I) for cell in header):
        raise _no_csv(
            "the first line holds numbers, not column names",
            f"{source}, line {line}",
            "put a line of column names such as slip_ratio,drawbar_pull_kn on top",
        )
    names = tuple(cell.strip() for cell in header)
    return CsvFile(source, names, line, delimiter, hashlib.sha256(raw).hexdigest(), rows)


def _read_bytes(source: str) -> bytes:
    try:
        return Path(source).read_bytes()
    except FileNotFoundError:
        near = sorted(p.name for p in Path(source).parent.glob("*.csv"))[:5]
        holds = f"; its folder holds {', '.join(near)}" if near else ""
        raise _no_csv("there is no such file", source, f"check the path{holds}") from None
    except IsADirectoryError:
        hint = "name a CSV file inside it"
        raise _no_csv("this is a folder, not a file", source, hint) from None
    except (OSError, ValueError) as error:
        hint = "check the path and the permissions"
        raise _no_csv(f"the file cannot be read ({error})", source, hint) from None


def _decode(raw: bytes, source: str) -> str:
    hint = "save it again as CSV in UTF-8 (Excel: `CSV UTF-8`), or "
    hint += IMPORT.format(source=source)
    try:
        text = decoded(raw)
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        found = f"byte 0x{raw[error.start]:02x} is not {error.encoding.upper()}"
        raise _no_csv(found, f"{source}, line {line}", hint) from None
    if raw.startswith(b"PK\x03\x04") or "\x00" in text:
        raise _no_csv("this is a binary file, such as a workbook, not text", source, hint)
    return text


def _rows(text: str, delimiter: str, source: str) -> Iterator[tuple[int, list[str]]]:
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter, strict=True)
    try:
        for row in reader:
            if any(map(str.strip, row)):
                yield reader.line_num, row
    except csv.Error as error:
        raise _no_csv(
            f"the line cannot be split into cells ({error})",
            f"{source}, line {reader.line_num}",
            "look for a quotation mark that is opened and not closed",
        ) from None


def write_table(
    path: str | os.PathLike[str],
    columns: Mapping[str, ArrayLike | Sequence[str]],
) -> None:
    """Write columns as CSV, whole or not at all.

    Parameters
    ----------
    path : path-like
        File to write; its folder must exist. An existing file is replaced.
    columns : mapping of str to (n,) array
        Column name, with its unit, to values. Text is written as it is, whole numbers without
        a point, others with as many digits as reading them back takes, NaN as an empty cell.

    Raises
    ------
    CalibError
        If the columns differ in length or the file cannot be written.
    """
    try:
        text = table_csv(columns)
    except CalibError as error:
        raise error.within(os.fspath(path)) from None
    target = Path(path)
    # In the folder of the target, so that the final step only renames.
    scratch = target.with_name(f".{target.name}.{os.getpid()}.tmp")
    try:
        scratch.write_text(text, encoding="utf-8", newline="")
        scratch.replace(target)
    except OSError as error:
        raise CalibError(
            f"the file cannot be written ({error.strerror})", where=str(target),
            expected="a file in an existing folder that you may write to",
            hint="make the folder, change its permissions or name another file",
        ) from None  # fmt: skip
    finally:
        with suppress(OSError):
            scratch.unlink(missing_ok=True)


def table_csv(columns: Mapping[str, ArrayLike | Sequence[str]]) -> str:
    """Return what `write_table` writes; a CalibError if the columns differ in length."""
    cells = {name: _format(values) for name, values in columns.items()}
    lengths = {name: len(column) for name, column in cells.items()}
    if len(set(lengths.values())) > 1:
        raise CalibError(
            f"the columns differ in length: {lengths}",
            expected="columns of one length",
            hint="pass arrays of shape (n,)",
        )
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(cells)
    writer.writerows(zip(*cells.values(), strict=True))
    return text.getvalue()


def _format(values: ArrayLike | Sequence[str]) -> list[str]:
    array: np.ndarray[Any, np.dtype[Any]] = np.atleast_1d(np.asarray(values))
    if array.dtype.kind not in "fiub":
        return [str(value) for value in array.tolist()]
    if array.dtype.kind != "f":
        return [str(int(value)) for value in array.tolist()]
    return ["" if math.isnan(value) else repr(value) for value in array.tolist()]


# Of a file that is not valid TOML.
TOML_HINT = "correct that line; names with other characters than A-Z a-z 0-9 _ - stand in quotes"


def decoded(raw: bytes, errors: str = "strict") -> str:
    """Return a text without its byte-order mark: in UTF-8, unless the mark says otherwise.

    Raises
    ------
    UnicodeDecodeError
        If it is not so encoded, unless `errors`, as of `bytes.decode`, says what to do then.
    """
    # UTF-16's mark is the beginning of UTF-32's.
    if raw.startswith((codecs.BOM_UTF32_LE, codecs.BOM_UTF32_BE)):
        return raw.decode("utf-32", errors)
    if raw.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return raw.decode("utf-16", errors)
    return raw.decode("utf-8-sig", errors)


def writable(name: str) -> str:
    """Return a file name as printable text, even if it is not valid in any encoding."""
    return name.encode("utf-8", "backslashreplace").decode()


class _Readable(Protocol):
    def read_bytes(self) -> bytes: ...


def read_text(path: _Readable) -> str:
    """Return the text of a file as `decoded` does, with the line ends of Unix."""
    return decoded(path.read_bytes()).replace("\r\n", "\n")


def read_toml(path: Path) -> dict[str, Any]:
    """Return the content of a TOML file; errors of `read_text` and `tomllib` come out as such."""
    return tomllib.loads(read_text(path))


def read_json(path: Path) -> dict[str, Any]:
    """Return a JSON object; empty where the file is missing or damaged."""
    try:
        return inside(json.loads(read_text(path)))
    except FAULTS:
        return {}


def inside(document: Any, *keys: str) -> dict[str, Any]:
    """Return the object below some keys of a document; empty where there is none."""
    for key in keys:
        document = document.get(key) if isinstance(document, dict) else None
    return document if isinstance(document, dict) else {}


def plain_number(value: float, digits: int = 3) -> str:
    """Write a number to some significant digits, without zeros that say nothing.

    An exponent is written only where the number, rounded, is 100,000 or more, or below 0.0001.
    """
    text = f"{value:.{digits}g}"
    if "e" not in text or not math.isfinite(value):
        return text
    rounded = float(text)
    return f"{rounded:.0f}" if 1.0 <= abs(rounded) < 1e5 else text


type Array = NDArray[np.float64]


def number_in(cell: str, decimal_comma: bool) -> float:
    """Return the number in a cell; a ValueError of what was found and a hint if there is none."""
    with suppress(ValueError):
        if "_" not in cell:  # `float` takes 1_000 for a number, a reader of the file would not
            return float(cell)
    text = cell.strip().replace("\N{MINUS SIGN}", "-")
    if text.lower() in {"", "na", "n/a", "null", "none"}:
        return math.nan
    if "," in text and (not decimal_comma or text.count(",") > 1 or "." in text):
        raise ValueError(
            f"{cell!r} has a comma inside a number",
            "write numbers with a decimal point and no thousands separators, such as "
            "1234 or 0.5 (decimal commas are read where semicolons separate the cells)",
        )
    with suppress(ValueError):
        if "_" not in text:
            return float(text.replace(",", "."))
    raise ValueError(
        f"{cell!r} is not a number",
        "write one plain number, such as 0.05; the unit belongs in the column name",
    )


def with_points(cells: Sequence[str]) -> tuple[str, ...]:
    """Give numbers, of columns that are not used too, the decimal sign of what is written."""
    number = re.compile(r"\s*[-+]?\d*,\d+(e[-+]?\d+)?\s*", re.IGNORECASE)
    return tuple(c.replace(",", ".") if number.fullmatch(c) else c for c in cells)
