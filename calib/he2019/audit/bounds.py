"""Bounds on what the printed digits allow: interval arithmetic, pull curves, costs.

*Intervals* are rounded outward by a few units in the last place, more than NumPy's functions err.
Expressions in which every variable occurs once give exact extremes; others give an enclosure,
which subdivision narrows (Moore, Kearfott & Cloud 2009, Introduction to Interval Analysis).

*Pull.* With E <= 1 and slip x >= 0 the argument g = (1 - E) u + E arctan u, u = Bx, rises with u
and falls with E, so its extremes over a box are at two corners; for 1 < C < 2 the angle C arctan g
stays in 0 to pi. Tables 3 and 4 print B, and every coefficient occurs once. Table 5 gives K = BCD,
so C and D occur twice (u = Kx/(CD)) and are cut into cells. K fixes the sign of u together with D:
the pull is the same for D and -D, and zero in the limit D = 0.

*Costs.* The data y are not printed, but Table 4 prints a curve f and its cost r^2 = |y - f|^2. By
the triangle inequality another curve g at the distance d = g - f costs

    (|d| - r)^2 <= |y - g|^2 <= (|d| + r)^2

whatever the data. If f is their least-squares optimum, the residuals are orthogonal to its
derivatives, and only the part d' of d that these do not span matters:

    |d|^2 + r^2 - 2 r |d'| <= |y - g|^2 <= |d|^2 + r^2 + 2 r |d'|.

Both need the slips of the tests, which are assumed; neither needs the pulls.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import brentq

from calib.he2019.published import Published
from calib.he2019.reconstruction import (
    NOMINAL_SLIPS,
    SLIP_SHIFT,
    magic_formula_jacobian,
    normalised_basis,
)
from calib.models.base import Array
from calib.models.magic_formula import magic_formula, sine_of
from calib.report.reference import Figure, FittedTable


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
    # NumPy's vectorised functions are within 4 units in the last place.
    steps = np.copysign(8.0, towards) * np.spacing(np.where(finite, np.abs(x), 0.0))
    return np.asarray(np.where(finite, x + steps, np.nextafter(x, towards)))


def exact(value: ArrayLike) -> Interval:
    """Return the interval of a number that is exactly representable."""
    array = np.asarray(value, dtype=np.float64)
    return Interval(array, array)


def printed(figure: Figure) -> Interval:
    """Return all numbers that print as a figure does."""
    return _outward(figure.value - figure.half_unit, figure.value + figure.half_unit)


def _increasing(
    function: Callable[[Array], Array], above: float | None = None, below: float | None = None
) -> Callable[[Interval], Interval]:
    """Return an increasing function of intervals that lie inside its domain."""

    def of(x: Interval) -> Interval:
        if (above is not None and np.any(x.lower <= above)) or (
            below is not None and np.any(x.upper >= below)
        ):
            raise ValueError(f"the interval leaves {above} to {below}, where this is taken")
        return _outward(function(x.lower), function(x.upper))

    return of


arctan, exp, log = _increasing(np.arctan), _increasing(np.exp), _increasing(np.log, 0.0)
tan = _increasing(np.tan, 0.0, 0.5 * np.pi)


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


def root_of_rest(r_squared: Interval) -> Interval:
    """Return sqrt(1 - R^2)."""
    low, high = (np.asarray(np.sqrt(1.0 - end)) for end in (r_squared.upper, r_squared.lower))
    return Interval(low, high)


# Boxes of the Magic Formula's coefficients


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
    D, K, E = (quadratic(published, NAMES[what], pressure) for what in ("D", "BCD", "E"))
    return Coefficients(K, printed(published.pressure.estimates["b0"]), D, E)


def _argument(u: Interval, E: Interval) -> Interval:
    """Return g over u >= 0 and E <= 1."""
    if np.any(E.upper > 1.0):
        raise ValueError("with E above 1 the argument does not rise with slip")

    def at(point_u: Array, point_E: Array) -> Interval:
        a, e = exact(point_u), exact(np.broadcast_to(point_E, point_u.shape))
        return a - e * (a - arctan(a))

    # u = infinity stands for D = 0: the argument is infinite too.
    finite = np.isfinite(u.upper)
    upper = at(np.where(finite, u.upper, 0.0), E.lower).upper
    return Interval(np.maximum(at(u.lower, E.upper).lower, 0.0), np.where(finite, upper, np.inf))


def pull(slip_percent: Array, box: Coefficients) -> Interval:
    """Return the exact extremes of the pull (kN) at slips (n,) where B is printed."""
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
    C_cells = 2
    D_edges = np.linspace(0.0 if holds_zero else ends[0], ends[1], cells + 1)
    C_edges = np.linspace(float(box.C.lower), float(box.C.upper), C_cells + 1)
    x = np.asarray(slip_percent, dtype=np.float64)[:, None, None]
    D = Interval(D_edges[None, :-1, None], D_edges[None, 1:, None])
    C = Interval(C_edges[None, None, :-1], C_edges[None, None, 1:])
    shape = (x.size, cells, C_cells)
    rise, product = box.stiffness * exact(x), C * D
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


def largest_pull(box: Coefficients) -> Interval:
    """Return the largest pull (kN) over all slips, however large.

    It is D if E is at most 1. Above 1 the largest argument falls as E rises, and where it stays
    below tan(pi/(2C)) everywhere in the box the pull never reaches D.
    """
    if np.all(box.E.upper <= 1.0):
        return box.D
    low, high = (_largest_argument(float(E)) for E in (box.E.upper, box.E.lower))
    top = Interval(np.asarray(low * (1.0 - 1e-12)), np.asarray(high * (1.0 + 1e-12)))
    return box.D * sin(box.C * arctan(top))


def peak_slip(box: Coefficients) -> Interval | None:
    """Return the slip (%) of the peak; None without one, ValueError if only a part has one."""
    target = tan(exact(0.5 * np.pi) / box.C)  # where the sine reaches one
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


# Costs of curves on data that are not printed


ASSUMED_SLIPS = 100.0 * (np.array(NOMINAL_SLIPS) + SLIP_SHIFT)
"""Slips in percent at which the 14 tests of each pressure are assumed."""

NAMES: Mapping[str, tuple[str, str, str]] = MappingProxyType(
    {"D": ("c1", "c2", "c3"), "BCD": ("c4", "c5", "c6"), "E": ("c7", "c8", "c9")}
)
COEFFICIENTS = (*NAMES["D"], *NAMES["BCD"], *NAMES["E"], "b0")
"""Of Eqs 12-15, in the order of every array of them here."""


@dataclass(frozen=True, eq=False)
class Reference:
    """Table 4's curve (kN) at n slips, an orthonormal basis (n, 4) of its derivatives, its cost."""

    psi: int
    curve: Array
    span: Array
    cost: float

    def bounds(self, pull: Array, *, optimal: bool) -> tuple[Array, Array]:
        """Return the least and the largest cost (kN^2) of curves (k, n), each of shape (k,).

        `optimal` takes Table 4 for the least-squares optimum of the data.
        """
        apart = pull - self.curve
        squared = np.einsum("kn,kn->k", apart, apart)
        r = np.sqrt(self.cost)
        if not optimal:
            return (np.sqrt(squared) - r) ** 2, (np.sqrt(squared) + r) ** 2
        inside = apart @ self.span
        beyond = np.sqrt(np.maximum(squared - np.einsum("kj,kj->k", inside, inside), 0.0))
        least = squared + self.cost - 2.0 * r * beyond
        return least, least + 4.0 * r * beyond


def references(published: Published, slips: Array = ASSUMED_SLIPS) -> tuple[Reference, ...]:
    """Return Table 4, pressure by pressure, at some slips (percent)."""
    return tuple(
        Reference(
            psi, magic_formula(slips, **t.values),
            normalised_basis(magic_formula_jacobian(slips, **t.values)), t.quality["cost"].value,
        )
        for psi, t in published.genetic.items()
    )  # fmt: skip


def printed_coefficients(published: Published) -> Array:
    """Return Table 5 as printed, shape (10,)."""
    return np.array([published.pressure.estimates[name].value for name in COEFFICIENTS])


def pressure_curves(coefficients: Array, pressures: Array, slips: Array) -> Array:
    """Evaluate Eqs 3-5 and 12-15 with c1 to c9 and b0, shape (k, 10), as they are printed.

    Pressures (m,) in psi and slips (n,) in percent give pulls (k, m, n) in kN; infinite where K or
    D is not positive.
    """
    powers = np.vander(pressures, 3, increasing=True)
    D, K, E = (np.asarray(coefficients[:, j : j + 3] @ powers.T)[:, :, None] for j in (0, 3, 6))
    C = coefficients[:, 9, None, None]
    with np.errstate(all="ignore"):
        pull: Array = D * sine_of(K / (C * D) * slips, C, 1.0 - E)
    pull[~((D > 0.0) & (K > 0.0) & np.isfinite(pull))] = np.inf
    return pull


def joint_bounds(
    coefficients: Array, known: tuple[Reference, ...], slips: Array, *, optimal: bool
) -> tuple[Array, Array]:
    """Return least and largest costs (Eq 16), (k,), of c1 to b0, (k, 10); infinite if undefined."""
    pull = pressure_curves(coefficients, np.array([float(r.psi) for r in known]), slips)
    fine = np.isfinite(pull).all(axis=(1, 2))
    least, largest = (np.full(pull.shape[0], np.inf) for _ in range(2))
    if fine.any():
        each = [r.bounds(pull[fine, i], optimal=optimal) for i, r in enumerate(known)]
        least[fine] = sum(low for low, _ in each)
        largest[fine] = sum(high for _, high in each)
    return least, largest
