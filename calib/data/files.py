"""Files and numbers as people write them: CSV dialects, encodings, TOML, JSON, short numbers."""

from __future__ import annotations

import codecs
import contextlib
import csv
import json
import math
import os
import re
import tomllib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.data.quantities import convert
from calib.errors import FAULTS, CalibError


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
