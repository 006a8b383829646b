"""What a model or simulator gave, as plain numbers in a unit: converted rightly, or refused.

Every way in goes through `real_array`: functions, programs, servers and tables of runs.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.data.units import convert
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


def _refused(what: str, unit: str, mend: str = "") -> CalibError:
    plain = "real numbers" if unit == _ONE else f"real numbers in {unit}"
    return CalibError(
        what, allowed=f"{plain}, or what has a unit of its own; NaN for no value",
        mend=mend or f"return {plain} with a decimal point, or NaN where there is no value",
    )  # fmt: skip
