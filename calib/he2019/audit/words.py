"""Numbers in the sentences of an audit."""

from __future__ import annotations

import math


def number(value: float, digits: int = 3) -> str:
    """Write a number to some significant digits, without an exponent where that is readable."""
    if value == 0.0 or not math.isfinite(value):
        return f"{value:g}"
    size = int(f"{abs(value):.{digits - 1}e}".partition("e")[2])
    if not -4 <= size < 6:
        return f"{value:.{digits - 1}e}"
    rounded = round(value, digits - 1 - size)
    return f"{rounded:.{max(0, digits - 1 - size)}f}"


def percent(fraction: float, digits: int = 3) -> str:
    """Write a fraction as a percentage."""
    return f"{number(100.0 * fraction, digits)} %"
