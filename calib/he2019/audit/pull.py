"""Exact extremes of the Magic Formula over boxes of coefficients.

With E <= 1 and slip x >= 0 the argument g = (1 - E) u + E arctan u, u = Bx, rises with u and falls
with E, so over a box its extremes are at two corners; for 1 < C < 2 the angle C arctan g stays in
0 to pi. Tables 3 and 4 print B, and every coefficient occurs once: extremes are exact. Table 5
gives K = BCD, so C and D occur twice (u = Kx/(CD)): their ranges are cut into cells, which leaves
an enclosure a little too wide, never too narrow. K fixes the sign of u together with D: the pull
is the same for D and -D, and its limit at D = 0 is zero.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from calib.he2019.audit.intervals import Interval, arctan, exact, printed, sin, tan
from calib.he2019.datasets.published import FittedTable, Published
from calib.models.base import Array

_C_CELLS = 2


class Coefficients(NamedTuple):
    """Intervals of B (1/%) or K (kN/%), C, D (kN) and E."""

    stiffness: Interval
    C: Interval
    D: Interval
    E: Interval


def coefficients(table: FittedTable) -> Coefficients:
    """Return all coefficients that print as in Table 3 or 4."""
    return Coefficients(*(printed(table.estimates[name]) for name in "BCDE"))


def quadratic(published: Published, names: tuple[str, str, str], pressure: float) -> Interval:
    """Return all values of c + c' p + c'' p^2 that the printed digits allow."""
    c, linear, bend = (printed(published.pressure.estimates[name]) for name in names)
    p = exact(pressure)
    return c + linear * p + bend * (p * p)


def pressure_box(published: Published, pressure: float) -> Coefficients:
    """Return K, C, D and E at a pressure that Table 5's digits allow (Eqs 12-15)."""
    return Coefficients(
        quadratic(published, ("c4", "c5", "c6"), pressure),
        printed(published.pressure.estimates["b0"]),
        quadratic(published, ("c1", "c2", "c3"), pressure),
        quadratic(published, ("c7", "c8", "c9"), pressure),
    )


def _argument(u: Interval, E: Interval) -> Interval:
    """Return g over u >= 0 and E <= 1."""
    if np.any(E.upper > 1.0):
        raise ValueError("with E above 1 the argument does not rise with slip")

    def at(point_u: Array, point_E: Array) -> Interval:
        a, e = exact(point_u), exact(point_E)
        return a - e * (a - arctan(a))

    # u = infinity stands for D = 0: the argument is infinite too.
    finite = np.where(np.isfinite(u.upper), u.upper, 0.0)
    lower = at(u.lower, np.broadcast_to(E.upper, u.lower.shape)).lower
    upper = at(finite, np.broadcast_to(E.lower, finite.shape)).upper
    return Interval(np.maximum(lower, 0.0), np.where(np.isfinite(u.upper), upper, np.inf))


def pull(slip_percent: Array, box: Coefficients) -> Interval:
    """Return the exact extremes of the pull (kN) where B is printed (Tables 3 and 4).

    For slips (n,) not negative, B and D positive, C between 1 and 2, E at most 1; else a
    ValueError.
    """
    u = box.stiffness * exact(slip_percent)
    return box.D * sin(box.C * arctan(_argument(u, box.E)))


def pull_from_slope(slip_percent: Array, box: Coefficients, *, cells: int = 400) -> Interval:
    """Return an enclosure of the pull (kN) where K = BCD is printed (Table 5).

    D and C are cut into cells. For K positive, C between 1 and 2, E at most 1, D of either sign;
    else a ValueError.
    """
    if np.any(box.stiffness.lower <= 0.0):
        raise ValueError("the slope must be positive")
    holds_zero = bool(box.D.lower <= 0.0 <= box.D.upper)
    ends = sorted(abs(float(end)) for end in (box.D.lower, box.D.upper))
    D_edges = np.linspace(0.0 if holds_zero else ends[0], ends[1], cells + 1)
    C_edges = np.linspace(float(box.C.lower), float(box.C.upper), _C_CELLS + 1)
    x = np.asarray(slip_percent, dtype=np.float64)[:, None, None]
    D = Interval(D_edges[None, :-1, None], D_edges[None, 1:, None])
    C = Interval(C_edges[None, None, :-1], C_edges[None, None, 1:])
    shape = (x.size, cells, _C_CELLS)
    rise = box.stiffness * exact(x)
    product = C * D
    with np.errstate(divide="ignore", invalid="ignore"):
        low = np.broadcast_to(rise.lower / product.upper, shape)
        # At zero slip the pull is zero whatever D is.
        high = np.where(x > 0.0, rise.upper / np.maximum(product.lower, 0.0), 0.0)
    steps = 8.0 * np.spacing(np.where(np.isfinite(high), high, 0.0))
    u = Interval(np.maximum(low * (1.0 - 1e-14), 0.0), np.broadcast_to(high + steps, shape))
    angle = C * arctan(_argument(u, box.E))
    y = D * sin(Interval(np.maximum(angle.lower, 0.0), np.minimum(angle.upper, np.pi)))
    return Interval(np.maximum(y.lower.min(axis=(1, 2)), 0.0), y.upper.max(axis=(1, 2)))


def _largest_argument(E: float) -> float:
    """Return the largest g over u >= 0 where E > 1: at u^2 = 1/(E - 1)."""
    return float(-np.sqrt(E - 1.0) + E * np.arctan(1.0 / np.sqrt(E - 1.0)))


def peak_argument(C: Interval) -> Interval:
    """Return tan(pi/(2C)), the argument at which the sine reaches one."""
    return tan(exact(0.5 * np.pi) / C)


def largest_pull(box: Coefficients) -> Interval:
    """Return the largest pull (kN) over all slips, however large.

    With E at most 1 it is D. With E above 1 the argument has a maximum, which falls as E rises;
    where that stays below tan(pi/(2C)) everywhere in the box, the pull never reaches D.
    """
    if np.all(box.E.upper <= 1.0):
        return box.D
    top = Interval(
        np.asarray(_largest_argument(float(box.E.upper)) * (1.0 - 1e-12)),
        np.asarray(_largest_argument(float(box.E.lower)) * (1.0 + 1e-12)),
    )
    return box.D * sin(box.C * arctan(top))


def peak_slip(box: Coefficients) -> Interval | None:
    """Return the slip (%) of the peak, or None if no coefficients of the box have one.

    ValueError if a part of the box has a peak and another has none.
    """
    target = peak_argument(box.C)
    low_E, high_E = float(box.E.lower), float(box.E.upper)
    if high_E > 1.0:
        if low_E > 1.0 and _largest_argument(low_E) * (1.0 + 1e-12) < float(target.lower):
            return None
        raise ValueError("only a part of the box has a peak")
    lowest = _peak_u(float(target.lower), low_E) * (1.0 - 1e-10)
    highest = _peak_u(float(target.upper), high_E) * (1.0 + 1e-10)
    return Interval(np.asarray(lowest), np.asarray(highest)) / box.stiffness


def _peak_u(target: float, E: float) -> float:
    def excess(u: float) -> float:
        return float(u - E * (u - np.arctan(u)) - target)

    high = 1.0
    while excess(high) < 0.0:
        high *= 2.0
    return float(brentq(excess, 0.0, high, xtol=1e-14, rtol=1e-14))
