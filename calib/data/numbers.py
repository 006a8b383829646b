"""Numbers in a sentence: few digits, and no exponent where a person reads one faster without."""

from __future__ import annotations

import math

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
