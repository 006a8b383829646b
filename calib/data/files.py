"""Files and numbers as people write them: CSV dialects, encodings, TOML, JSON, short numbers."""

from __future__ import annotations

import codecs
import contextlib
import csv
import hashlib
import io
import json
import math
import os
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from calib.errors import FAULTS, CalibError


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
    cells = {name: _format(values) for name, values in columns.items()}
    lengths = {name: len(column) for name, column in cells.items()}
    if len(set(lengths.values())) > 1:
        raise CalibError(
            f"the columns differ in length: {lengths}", where=os.fspath(path),
            expected="columns of one length", hint="pass arrays of shape (n,)",
        )  # fmt: skip
    target = Path(path)
    # In the folder of the target, so that the final step only renames.
    scratch = target.with_name(f".{target.name}.{os.getpid()}.tmp")
    try:
        with scratch.open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(cells)
            writer.writerows(zip(*cells.values(), strict=True))
        scratch.replace(target)
    except OSError as error:
        raise CalibError(
            f"the file cannot be written ({error.strerror})", where=str(target),
            expected="a file in an existing folder that you may write to",
            hint="make the folder, change its permissions or name another file",
        ) from None  # fmt: skip
    finally:
        with contextlib.suppress(OSError):
            scratch.unlink(missing_ok=True)


def _format(values: ArrayLike | Sequence[str]) -> list[str]:
    array: np.ndarray[Any, np.dtype[Any]] = np.atleast_1d(np.asarray(values))
    if array.dtype.kind not in "fiub":
        return [str(value) for value in array.tolist()]
    if array.dtype.kind != "f":
        return [str(int(value)) for value in array.tolist()]
    return ["" if math.isnan(value) else repr(value) for value in array.tolist()]


# By the marks that such texts begin with; UTF-16's is the beginning of UTF-32's.
_ENCODINGS = {
    codecs.BOM_UTF32_LE: "utf-32", codecs.BOM_UTF32_BE: "utf-32",
    codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16",
}  # fmt: skip


# Of a file that is not valid TOML.
MEND_TOML = "correct that line; names with other characters than A-Z a-z 0-9 _ - stand in quotes"


def decoded(raw: bytes, errors: str = "strict") -> str:
    """Return a text without its byte-order mark: in UTF-8, unless the mark says otherwise.

    Raises
    ------
    UnicodeDecodeError
        If it is not so encoded, unless `errors`, as of `bytes.decode`, says what to do then.
    """
    marked = (name for mark, name in _ENCODINGS.items() if raw.startswith(mark))
    return raw.decode(next(marked, "utf-8-sig"), errors)


def writable(name: str) -> str:
    """Return a name of a file that may be in no encoding as one that a text can hold."""
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


# From here on the digits before a power of ten are fewer than the zeros that it saves.
_LARGE = 1e5


def plain_number(value: float, digits: int = 3) -> str:
    """Write a number to some significant digits, without zeros that say nothing.

    An exponent is written only where the number, rounded, is 100,000 or more, or below 0.0001.
    """
    text = f"{value:.{digits}g}"
    if "e" not in text or not math.isfinite(value):
        return text
    rounded = float(text)
    return f"{rounded:.0f}" if 1.0 <= abs(rounded) < _LARGE else text
