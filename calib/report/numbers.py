"""Numbers as a reader needs them: as many digits as their uncertainty warrants, and no more.

One rule for page, figures, tables and terminal. The last digit shown is the coarser of two:

- the second significant digit of the uncertainty, to which the value is rounded as well
  (JCGM 100:2008, 7.2.6);
- the first place that is not finer than the Monte Carlo error, so that other random numbers would
  move the last digit shown by about one.

At least one digit of the uncertainty always stays.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from decimal import Decimal
from typing import TYPE_CHECKING, Any

from calib.report.constants import DECADES, LOPSIDED

if TYPE_CHECKING:
    from calib.inference.calibration import ParameterSummary

NOTHING = "\N{EN DASH}"
MINUS = "\N{MINUS SIGN}"
TIMES = "\N{MULTIPLICATION SIGN}"
RAISED = "\N{SUPERSCRIPT MINUS}⁰¹²³⁴⁵⁶⁷⁸⁹"


def finite(value: Any) -> Any:
    """Return what JSON can hold of a value: null for what is undefined, plain numbers and lists."""
    if isinstance(value, Mapping):
        return {key: finite(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [finite(v) for v in value]
    if hasattr(value, "item"):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def place_of(value: float, digits: int) -> int:
    """Return the power of ten of a significant digit: 0.0996 has its second at 10^-2."""
    return _exponent(value, digits) - digits + 1


def last_place(uncertainty: float, mcse: float = 0.0) -> int:
    """Return the power of ten of the last digit to be shown.

    The uncertainty, positive, is a standard deviation, or another distance within which the value
    is not known; a Monte Carlo standard error of zero or NaN is none.
    """
    second = place_of(uncertainty, 2)
    if not (math.isfinite(mcse) and mcse > 0.0):
        return second
    return min(max(second, math.ceil(math.log10(mcse))), second + 1)


def format_value(mean: float, sd: float, mcse: float = 0.0) -> str:
    """Write a value and its uncertainty, such as ``1.648 ± 0.025``.

    A power of ten is set apart where numbers are large or small; a dash stands where a value is not
    finite.
    """
    if not math.isfinite(mean) or not math.isfinite(sd):
        return NOTHING
    if sd <= 0.0:
        return format_number(mean, 6)
    last = last_place(sd, mcse)
    power = _power((mean, sd), last)
    pair = f"{_rounded(mean, last, power)} ± {_rounded(sd, last, power)}"
    return pair if power == 0 else f"({pair}){_times(power)}"


def format_interval(
    lower: float,
    upper: float,
    uncertainty: float | tuple[float, float],
    mcse: tuple[float, float] = (0.0, 0.0),
) -> str:
    """Write an interval, each end to the last digit that it warrants.

    Ends whose last digits are neighbours share the coarser of them; an end that is nothing at its
    last digit is written 0. The uncertainty of both ends, or of each, is the standard deviation of
    what lies in the interval, or an end's distance from its centre.
    """
    scales = uncertainty if isinstance(uncertainty, tuple) else (uncertainty, uncertainty)
    if not all(math.isfinite(x) for x in (lower, upper, *scales)):
        return NOTHING
    if min(scales) <= 0.0:
        return f"{format_number(lower)} to {format_number(upper)}"
    first, second = interval_places(scales, mcse)
    if first != second:
        return f"{format_at(lower, first)} to {format_at(upper, second)}"
    power = _power((lower, upper), first)
    low, high = (_rounded(v, first, power) if _shows(v, first) else "0" for v in (lower, upper))
    pair = f"{low} to {high}"
    return pair if power == 0 else f"({pair}){_times(power)}"


def interval_places(scales: tuple[float, float], mcse: tuple[float, float]) -> tuple[int, int]:
    """Return the powers of ten of the last digits of an interval's ends."""
    first, second = (last_place(u, e) for u, e in zip(scales, mcse, strict=True))
    coarser = max(first, second)
    return (coarser, coarser) if abs(first - second) <= 1 else (first, second)


def format_number(value: float, digits: int = 3) -> str:
    """Write a number to a number of significant digits, trailing zeros kept."""
    if not math.isfinite(value):
        return NOTHING
    return "0" if value == 0.0 else format_at(value, place_of(value, digits))


def format_like(value: float, printed: str) -> str:
    """Write a number with the decimals, and the exponent, of a printed one."""
    if not math.isfinite(value):
        return NOTHING
    mantissa, _, exponent = printed.lower().partition("e")
    power = int(exponent) if exponent else 0
    last = int(Decimal(mantissa).as_tuple().exponent) + power
    text = _rounded(value, last, power)
    return f"{text}{_times(power)}" if exponent else text


def format_as_printed(value: float, printed: str) -> str:
    """Write a number with the decimals of a printed one, or the digits of one with an exponent.

    To three digits where the decimals would leave none of a number that is far smaller.
    """
    mantissa, _, exponent = printed.lower().partition("e")
    if exponent:
        return format_number(value, len(Decimal(mantissa).as_tuple().digits))
    text = format_like(value, printed)
    return text if any(c in "123456789" for c in text) else format_number(value, 3)


def ascii_text(text: str) -> str:
    """Return a number that was written for people as programs read it; nothing for a dash."""
    if text == NOTHING:
        return ""
    digits, _, power = text.partition(f"{TIMES}10")
    exponent = f"e{int(lowered(power)):+03d}" if power else ""
    return digits.replace(MINUS, "-") + exponent


def lowered(raised: str) -> str:
    """Return raised digits and signs as plain ones."""
    return raised.translate(str.maketrans(RAISED, "-0123456789"))


def ascii_number(value: float, last: int) -> str:
    """Write a number rounded at the digit of 10^last for programs; nothing where not finite."""
    return ascii_text(format_at(value, last))


def format_at(value: float, last: int) -> str:
    """Write a number rounded at the digit of 10^last; 0 where nothing of it is left."""
    if not math.isfinite(value):
        return NOTHING
    if not _shows(value, last):
        return "0"
    power = _power((value,), last)
    text = _rounded(value, last, power)
    return text if power == 0 else f"{text}{_times(power)}"


def _shows(value: float, last: int) -> bool:
    """Whether anything of a value is left when it is rounded at the digit of 10^last."""
    return Decimal(_rounded(value, last, 0).replace(MINUS, "-")) != 0


def _times(power: int) -> str:
    return f"{TIMES}10{str(power).translate(str.maketrans('-0123456789', RAISED))}"


def _exponent(value: float, digits: int) -> int:
    """Power of ten of the first digit, after rounding to some digits: 0.0996 is 0.10 to two."""
    return int(f"{abs(Decimal(repr(float(value)))):.{digits - 1}e}".partition("e")[2])


def _power(values: tuple[float, ...], last: int) -> int:
    """Power of ten to factor out of numbers whose last digit is that of 10^last."""
    # Of the rounded numbers: 97 to the tens is 10 x 10, written 1.0 x 100.
    rounded = (round(Decimal(repr(float(v))), -last) for v in values)
    largest = max([last, *(v.adjusted() for v in rounded if v)])
    return 0 if -3 <= largest <= 4 else largest


def _rounded(value: float, last: int, power: int) -> str:
    """Write value/10^power, rounded at the digit of 10^last."""
    decimals = power - last
    shown = Decimal(repr(float(value))).scaleb(-power)
    text = f"{shown:.{decimals}f}" if decimals >= 0 else f"{round(shown, decimals):.0f}"
    zero = Decimal(text) == 0
    return text.lstrip("-") if zero else text.replace("-", MINUS)


def skewed(s: ParameterSummary) -> bool:
    """Whether mean and sd would mislead.

    They do where the HDI reaches more than twice as far on one side of the median as on the
    other, or spans more than a factor of 30, or where heavy tails make the sd more than half as
    long as the HDI (a quarter if normal).
    """
    near, far = sorted((s.median - s.hdi_lower, s.hdi_upper - s.median))
    low, high = sorted((abs(s.hdi_lower), abs(s.hdi_upper)))
    one_sign = s.hdi_lower * s.hdi_upper > 0.0
    tails = s.sd > 0.5 * (s.hdi_upper - s.hdi_lower)
    return tails or far > LOPSIDED * near or (one_sign and high > DECADES * low)


def end_scales(s: ParameterSummary) -> tuple[float, float]:
    """Distances that set the digits of the HDI's ends: sd or distance to the median, the smaller.

    The sd of a skewed parameter is that of its long tail, which would round the other end away; of
    a tail of many decades it says nothing at all, not even how near an end may be to the median.
    """
    floor = 1e-3 * min(s.sd, s.hdi_upper - s.hdi_lower)
    return (
        min(s.sd, max(s.median - s.hdi_lower, floor)),
        min(s.sd, max(s.hdi_upper - s.median, floor)),
    )


def centre_place(s: ParameterSummary) -> int:
    """Return the power of ten of the median's last digit."""
    return last_place(min(end_scales(s)), s.mcse_median)


def centre_text(s: ParameterSummary) -> str:
    """Write mean and sd, or the median where these would mislead."""
    if not skewed(s):
        return format_value(s.mean, s.sd, s.mcse_mean)
    return f"median {format_at(s.median, centre_place(s))}"


def end_places(s: ParameterSummary) -> tuple[int, int]:
    """Return the powers of ten of the last digits of the HDI's ends."""
    return interval_places(end_scales(s), (s.mcse_hdi_lower, s.mcse_hdi_upper))


def interval_text(s: ParameterSummary) -> str:
    """Write the HDI."""
    return format_interval(
        s.hdi_lower, s.hdi_upper, end_scales(s), (s.mcse_hdi_lower, s.mcse_hdi_upper)
    )
