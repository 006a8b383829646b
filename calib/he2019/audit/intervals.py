"""Interval arithmetic on arrays, rounded outward: the result holds every value its inputs allow.

Each operation is followed by a step of a few units in the last place away from the interval, more
than NumPy's functions err. Expressions in which every variable occurs once give exact extremes
(up to that step); others give an enclosure, which subdivision narrows. No library in use here
does this on whole arrays.

References
----------
Moore, Kearfott & Cloud (2009), Introduction to Interval Analysis, SIAM, chapters 2 and 5.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from calib.models.base import Array
from calib.report.reference import Figure

# NumPy's vectorised functions are within 4 units in the last place.
_ULPS = 8.0


@dataclass(frozen=True, eq=False)
class Interval:
    """Closed intervals, elementwise; ends of one shape, `lower` never above `upper`."""

    lower: Array
    upper: Array

    def __post_init__(self) -> None:
        if np.any(self.lower > self.upper) or np.isnan(self.lower).any():
            raise ValueError("an interval's lower end must not exceed its upper end")

    def __add__(self, other: Interval) -> Interval:
        return _outward(self.lower + other.lower, self.upper + other.upper)

    def __sub__(self, other: Interval) -> Interval:
        return _outward(self.lower - other.upper, self.upper - other.lower)

    def __neg__(self) -> Interval:
        return Interval(-self.upper, -self.lower)

    def __mul__(self, other: Interval) -> Interval:
        with np.errstate(over="ignore", invalid="ignore"):
            corners = [a * b for a in (self.lower, self.upper) for b in (other.lower, other.upper)]
        # Infinity stands for an end beyond the largest number: times zero it is zero.
        finite = [np.where(np.isnan(corner), 0.0, corner) for corner in corners]
        return _outward(np.minimum.reduce(finite), np.maximum.reduce(finite))

    def __truediv__(self, other: Interval) -> Interval:
        if np.any((other.lower <= 0.0) & (other.upper >= 0.0)):
            raise ValueError("an interval that holds zero cannot divide")
        with np.errstate(over="ignore"):
            return self * _outward(1.0 / other.upper, 1.0 / other.lower)

    @property
    def middle(self) -> Array:
        """Midpoint."""
        return np.asarray(0.5 * (self.lower + self.upper))

    @property
    def half_width(self) -> Array:
        """Half the width, rounded up."""
        return np.asarray(np.nextafter(0.5 * (self.upper - self.lower), np.inf))

    def holds(self, value: ArrayLike) -> bool:
        """Whether all values lie inside."""
        inside = np.less_equal(self.lower, value) & np.greater_equal(self.upper, value)
        return bool(np.all(inside))


def _outward(lower: ArrayLike, upper: ArrayLike) -> Interval:
    return Interval(_step(lower, -np.inf), _step(upper, np.inf))


def _step(end: ArrayLike, towards: float) -> Array:
    x = np.asarray(end, dtype=np.float64)
    finite = np.isfinite(x)
    steps = np.copysign(_ULPS, towards) * np.spacing(np.where(finite, np.abs(x), 0.0))
    return np.asarray(np.where(finite, x + steps, np.nextafter(x, towards)))


def exact(value: ArrayLike) -> Interval:
    """Return the interval of a number that is exactly representable."""
    array = np.asarray(value, dtype=np.float64)
    return Interval(array, array)


def printed(figure: Figure) -> Interval:
    """Return all numbers that print as a figure does."""
    return _outward(figure.value - figure.half_unit, figure.value + figure.half_unit)


def _increasing(function: Callable[[Array], Array], x: Interval) -> Interval:
    return _outward(function(x.lower), function(x.upper))


def arctan(x: Interval) -> Interval:
    """Arc tangent."""
    return _increasing(np.arctan, x)


def exp(x: Interval) -> Interval:
    """Exponential."""
    return _increasing(np.exp, x)


def log(x: Interval) -> Interval:
    """Natural logarithm of positive intervals."""
    if np.any(x.lower <= 0.0):
        raise ValueError("an interval that is not positive has no logarithm")
    return _increasing(np.log, x)


def tan(x: Interval) -> Interval:
    """Tangent on 0 to pi/2, both excluded."""
    if np.any((x.lower <= 0.0) | (x.upper >= 0.5 * np.pi)):
        raise ValueError("the tangent is taken between 0 and pi/2")
    return _increasing(np.tan, x)


def square(x: Interval) -> Interval:
    """Square, in which the variable occurs once: never negative."""
    ends = np.minimum(x.lower**2, x.upper**2), np.maximum(x.lower**2, x.upper**2)
    inside = (x.lower <= 0.0) & (x.upper >= 0.0)
    out = _outward(np.where(inside, 0.0, ends[0]), ends[1])
    return Interval(np.maximum(out.lower, 0.0), out.upper)


def sin(x: Interval) -> Interval:
    """Sine on 0 to pi, where it rises to one at pi/2 and falls again."""
    if np.any((x.lower < -1e-12) | (x.upper > np.pi)):
        raise ValueError("the sine is taken between 0 and pi")
    ends = np.sin(x.lower), np.sin(x.upper)
    top = (x.lower <= 0.5 * np.pi) & (x.upper >= 0.5 * np.pi)
    out = _outward(np.minimum(*ends), np.where(top, 1.0, np.maximum(*ends)))
    return Interval(out.lower, np.minimum(out.upper, 1.0))
