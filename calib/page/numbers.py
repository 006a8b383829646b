"""Numbers as a reader needs them: as many digits as their uncertainty warrants, and no more."""

from __future__ import annotations

import math
from decimal import Decimal

__all__ = ["NOTHING", "TIMES", "format_interval", "format_like", "format_number", "format_value"]

NOTHING = "\N{EN DASH}"
_MINUS = "\N{MINUS SIGN}"
TIMES = "\N{MULTIPLICATION SIGN}"
_SUPERSCRIPTS = str.maketrans("-0123456789", "\N{SUPERSCRIPT MINUS}⁰¹²³⁴⁵⁶⁷⁸⁹")
# Powers of ten outside this range are written as such.
_PLAIN = range(-3, 5)


def format_value(mean: float, sd: float) -> str:
    """Write a mean and its standard deviation to two significant digits of the latter.

    Parameters
    ----------
    mean, sd : float

    Returns
    -------
    str
        Such as ``1.648 ± 0.025``, with a power of ten set apart where numbers are large or
        small; a dash where a value is not finite.
    """
    if not math.isfinite(mean) or not math.isfinite(sd):
        return NOTHING
    if sd <= 0.0:
        return format_number(mean, 6)
    last, power = _scale(mean, sd)
    pair = f"{_rounded(mean, last, power)} ± {_rounded(sd, last, power)}"
    return pair if power == 0 else f"({pair}){_times(power)}"


def format_interval(lower: float, upper: float, sd: float) -> str:
    """Write an interval to the decimals that `format_value` gives a value of that sd."""
    if not (math.isfinite(lower) and math.isfinite(upper) and math.isfinite(sd)):
        return NOTHING
    if sd <= 0.0:
        return f"{format_number(lower)} to {format_number(upper)}"
    last, power = _scale(max(abs(lower), abs(upper)), sd)
    pair = f"{_rounded(lower, last, power)} to {_rounded(upper, last, power)}"
    return pair if power == 0 else f"({pair}){_times(power)}"


def format_number(value: float, digits: int = 3) -> str:
    """Write a number to a number of significant digits, trailing zeros kept."""
    if not math.isfinite(value):
        return NOTHING
    if value == 0.0:
        return "0"
    size = _exponent(value, digits)
    power = 0 if size in _PLAIN else size
    text = _rounded(value, size - digits + 1, power)
    return text if power == 0 else f"{text}{_times(power)}"


def format_like(value: float, printed: str) -> str:
    """Write a number with the decimals, and the exponent, of a printed one."""
    if not math.isfinite(value):
        return NOTHING
    mantissa, _, exponent = printed.lower().partition("e")
    power = int(exponent) if exponent else 0
    last = int(Decimal(mantissa).as_tuple().exponent) + power
    text = _rounded(value, last, power)
    return f"{text}{_times(power)}" if exponent else text


def _times(power: int) -> str:
    return f"{TIMES}10{str(power).translate(_SUPERSCRIPTS)}"


def _exponent(value: float, digits: int) -> int:
    """Power of ten of the first digit, after rounding to some digits: 0.0996 is 0.10 to two."""
    return int(f"{abs(value):.{digits - 1}e}".partition("e")[2])


def _scale(value: float, sd: float) -> tuple[int, int]:
    """Power of ten of the last digit shown, and the one to factor out."""
    size = _exponent(sd, 2)
    largest = max(size, _exponent(value, 3) if value else size)
    return size - 1, 0 if largest in _PLAIN and size < _PLAIN.stop else largest


def _rounded(value: float, last: int, power: int) -> str:
    """Write value/10^power, rounded at the digit of 10^last."""
    decimals = power - last
    shown = Decimal(repr(float(value))).scaleb(-power)
    text = f"{shown:.{decimals}f}" if decimals >= 0 else f"{round(shown, decimals):.0f}"
    zero = Decimal(text) == 0
    return text.lstrip("-") if zero else text.replace("-", _MINUS)
