"""The features of a pull-slip curve and the Magic Formula coefficients they give (Eqs 6-9).

    C = 2 - (2/pi) arcsin(ys/D)                                     (Eq 7)
    D = ym                                                          (Eq 8)
    B = tan(theta)/(C D)                                            (Eq 6)
    E = [B xm - tan(pi/(2 C))]/[B xm - arctan(B xm)]                (Eq 9)

with the peak (xm, ym), the asymptote ys and the initial slope tan(theta). The source does not say
how it read these features; the rules used here are those of `read_features`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from calib.errors import CalibError
from calib.models.base import Array

_FEWEST_LEVELS = 4
# More distinct slips than this are averaged in groups, or noise would decide where the peak is.
_MOST_LEVELS = 40
_GROUPS = 20


class Features(NamedTuple):
    """What the geometric method reads off a curve of pull (kN) against slip (%).

    Initial slope tan(theta) (kN/%), slip and pull of the peak xm and ym, pull at the largest slips
    ys. Features are counted from `zero`, the slip at which the pull is zero; `has_peak` says
    whether the pull falls again inside the range.
    """

    slope: float
    x_peak: float
    peak: float
    asymptote: float
    zero: float = 0.0
    has_peak: bool = True


class Coefficients(NamedTuple):
    """B (1/%), C, D (kN) and E of the Magic Formula."""

    B: float
    C: float
    D: float
    E: float


def coefficients(features: Features, C_without_peak: float = 1.5) -> Coefficients:
    """Evaluate Eqs 6-9 of He, Sandu & Osorio (2019), doi:10.1016/j.jterra.2019.07.003.

    Where the range holds no peak the asymptote cannot be seen, and C is given.
    """
    D = features.peak
    if features.has_peak:
        C = 2.0 - 2.0 / np.pi * np.arcsin(np.clip(features.asymptote / D, -1.0, 1.0))
    else:
        C = C_without_peak
    B = features.slope / (C * D)
    bx = B * features.x_peak
    E = (bx - np.tan(0.5 * np.pi / C)) / (bx - np.arctan(bx))
    return Coefficients(float(B), float(C), float(D), float(E))


def read_features(
    slip_percent: Array,
    pull: Array,
    *,
    slope_slip_percent: float = 5.0,
    find_zero: bool = False,
    where: str | None = None,
) -> Features:
    """Read the features of a measured curve, slips and pulls of shape (n,).

    - Initial slope: the least-squares line through the origin and the rows of slips up to
      `slope_slip_percent`, or through the two smallest positive slips if there are fewer; if that
      line falls, through all rows up to the highest. With `find_zero` it is not forced through the
      origin, and slips count from where it is zero, as the source redefined its zero of slip.
    - Peak: its pull is the highest one measured, repeats being averaged, which on the embedded
      data is the published D; its slip is that of the vertex of the parabola through the highest
      point and its neighbours. If the highest point is the last one, the range holds no peak.
    - Asymptote: the pull at the largest slip.

    Raises
    ------
    CalibError
        If there are fewer than four distinct positive slips or the pull is nowhere positive or
        does not rise.
    """
    slope, zero = _initial_line(slip_percent, pull, slope_slip_percent, find_zero, where)
    x, y = _levels(slip_percent - zero, pull)
    if x.size < _FEWEST_LEVELS or y.max() <= 0.0 or slope <= 0.0:
        raise CalibError(
            "the geometric method cannot read this curve: it finds "
            f"{x.size} positive slips, a largest pull of {y.max() if x.size else 0.0:g} kN and an "
            f"initial slope of {slope:g} kN/%",
            where=where,
            allowed="at least 4 distinct positive slips, with a positive pull that rises from zero",
            mend="use another method, such as least_squares",
        )
    top = int(y.argmax())
    x_peak, peak = float(x[top]), float(y[top])
    if 0 < top < x.size - 1:
        a, b, _ = np.polyfit(x[top - 1 : top + 2] - x_peak, y[top - 1 : top + 2], 2)
        if a < 0.0:
            x_peak -= float(b / (2.0 * a))
    return Features(slope, x_peak, peak, float(y[-1]), zero, top < x.size - 1)


def _initial_line(
    x: Array, y: Array, up_to: float, find_zero: bool, where: str | None
) -> tuple[float, float]:
    positive = np.sort(x[x > 0.0])
    if positive.size < 2:
        raise CalibError(
            f"the geometric method finds {positive.size} positive slips",
            where=where,
            allowed="at least 4 distinct positive slips",
            mend="use another method, such as least_squares",
        )
    slope = zero = 0.0
    for limit in (max(up_to, float(positive[1])), float(x[y.argmax()])):
        near = np.abs(x) <= limit
        if find_zero and np.unique(x[near]).size > 1:
            slope, pull_at_zero = np.polyfit(x[near], y[near], 1)
            zero = -pull_at_zero / slope if slope > 0.0 else 0.0
        elif (x[near] != 0.0).any():
            slope = float(x[near] @ y[near]) / float(x[near] @ x[near])
        if slope > 0.0:
            break
    return float(slope), float(zero)


def _levels(x: Array, y: Array) -> tuple[Array, Array]:
    """Average repeats at positive slips; average groups of neighbours where slips are many."""
    x, y = x[x > 0.0], y[x > 0.0]
    levels, which = np.unique(np.round(x, 9), return_inverse=True)
    if levels.size <= _MOST_LEVELS:
        return levels, np.bincount(which, y) / np.bincount(which)
    groups = np.array_split(np.argsort(x, kind="stable"), _GROUPS)
    return np.array([x[g].mean() for g in groups]), np.array([y[g].mean() for g in groups])
