"""A rigid wheel on soil: stresses along the contact, integrated to load, pull and torque.

Wong & Reece (1967), part I, driven wheel. Angles are from the vertical, theta1 where soil is
entered and 0 where it is left. With p = k1 + k2 b, the normal stress is

    sigma = p (r/b)^n (cos theta - cos theta1)^n          theta_m <= theta <= theta1
    theta_m = (c1 + c2 s) theta1, and mirrored in proportion below it,

the shear stress is that of Janosi & Hanamoto (1961), tau = (c + sigma tan phi)(1 - exp(-j/K)) with
j = r [theta1 - theta - (1 - s)(sin theta1 - sin theta)], and the entry angle is the one at which
the stresses carry the load.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from calib.models.base import Array, Conditions

N_NODES = 8
_LN_ANGLE = (float(np.log(1e-4)), float(np.log(1.5)))
_MAX_ITERATIONS = 60
# Steps after which cells are asked whether they have a solution.
_PATIENCE = 8
_TOLERANCE = 1e-9


@dataclass(frozen=True)
class Wheel:
    """Soil and wheel, arrays that broadcast to (k, n, 1).

    k1, k2, n, c, tan_phi, K, c1 and c2 in kPa, kPa/m, 1, kPa, 1, m, 1 and 1; radius, width, load
    and slip in m, m, kN and as a fraction.
    """

    k1: Array
    k2: Array
    n: Array
    c: Array
    tan_phi: Array
    K: Array
    c1: Array
    c2: Array
    radius: Array
    width: Array
    load: Array
    slip: Array


@dataclass(frozen=True)
class Contact:
    """Where a wheel stands: load, pull (kN), torque (kN m) and sinkage (m), shape (k, n)."""

    load: Array
    pull: Array
    torque: Array
    sinkage: Array


def wheels(theta: Array, conditions: Conditions) -> Wheel:
    """Lay parameters k1, k2, n, c, phi (degrees), K (mm), c1, c2 out beside conditions."""
    k1, k2, n, c, phi, K, c1, c2 = (theta[:, j, None, None] for j in range(8))
    rows = {name: np.atleast_2d(v)[:, :, None] for name, v in conditions.items()}
    return Wheel(
        k1, k2, n, c, np.tan(np.radians(phi)), K / 1000.0, c1, c2,
        rows["tyre_diameter_m"] / 2.0, rows["tyre_width_m"], rows["normal_load_kn"],
        rows["slip_ratio"],
    )  # fmt: skip


@cache
def _nodes() -> tuple[Array, Array]:
    """Return Gauss-Legendre nodes and weights in u^2 on [0, 1].

    The stress rises as distance to the power n from either end of the contact: in u, the root of
    that distance, it is smooth for the exponents of soils.
    """
    x, weight = np.polynomial.legendre.leggauss(N_NODES)
    u = 0.5 * (x + 1.0)
    return u * u, u * weight


def _halves(entry: Array, wheel: Wheel) -> Iterator[tuple[Array, Array, Array, Array, Array]]:
    """Yield sine and cosine, stresses and lengths of front and rear, for entry angles (..., 1)."""
    part, weight = _nodes()
    turning = np.minimum(wheel.c1 + wheel.c2 * wheel.slip, 0.999) * entry
    front = entry - (entry - turning) * part
    sine_entry, cosine_entry = np.sin(entry), np.cos(entry)
    sine, cosine = np.sin(front), np.cos(front)
    rise = np.maximum(cosine - cosine_entry, 0.0) * wheel.radius / wheel.width
    normal = (wheel.k1 + wheel.k2 * wheel.width) * rise**wheel.n
    strength = wheel.c + normal * wheel.tan_phi
    rear = turning * part
    for angle, length, sin, cos in (
        (front, entry - turning, sine, cosine),
        (rear, turning, np.sin(rear), np.cos(rear)),
    ):
        moved = entry - angle - (1.0 - wheel.slip) * (sine_entry - sin)
        shear = -strength * np.expm1(moved * (-wheel.radius / wheel.K))
        yield sin, cos, normal, shear, weight * length


def _load(entry: Array, wheel: Wheel) -> Array:
    """Return the load (kN) that wheels carry at entry angles, both (..., 1)."""
    lifted = sum(
        np.vecdot(normal * cosine + shear * sine, measure)
        for sine, cosine, normal, shear, measure in _halves(entry, wheel)
    )
    return np.asarray(wheel.radius * wheel.width * np.asarray(lifted)[..., None])


def _evaluate(entry: Array, wheel: Wheel) -> Contact:
    """Integrate the stresses for entry angles, shape (k, n, 1)."""
    lifted = pulled = turned = np.zeros(entry.shape[:2])
    for sine, cosine, normal, shear, measure in _halves(entry, wheel):
        lifted = lifted + np.vecdot(normal * cosine + shear * sine, measure)
        pulled = pulled + np.vecdot(shear * cosine - normal * sine, measure)
        turned = turned + np.vecdot(shear, measure)
    radius, area = wheel.radius[..., 0], (wheel.radius * wheel.width)[..., 0]
    sinkage = radius * (1.0 - np.cos(entry[..., 0]))
    return Contact(area * lifted, area * pulled, area * radius * turned, sinkage)


def contact(wheel: Wheel) -> Contact:
    """Find where each wheel carries its load, and what it then pulls.

    NaN for a braked wheel (slip below zero, part II of the source), and where the soil does not
    carry the wheel although it has sunk to its axle. The load grows about as the entry angle to the
    power 2n + 1: on logarithms the secant method takes some five steps, kept inside a shrinking
    bracket.

    References
    ----------
    Wong & Reece (1967), J. Terramechanics 4(1), 81-98, doi:10.1016/0022-4898(67)90105-X.
    """
    fields = [np.asarray(v) for v in vars(wheel).values()]
    shape = np.broadcast_shapes(*(v.shape for v in fields))
    flat = [np.broadcast_to(v, shape).reshape(-1, 1) for v in fields]
    return _evaluate(_entry(Wheel(*flat)).reshape(shape), wheel)


def _entry(wheel: Wheel) -> Array:
    """Solve for the entry angles of wheels, shape (cells, 1); NaN where there is none."""
    entry = np.full(wheel.load.shape, np.nan)
    cells = np.flatnonzero(wheel.slip[:, 0] >= 0.0)
    low, high = (np.full((cells.size, 1), edge) for edge in _LN_ANGLE)
    left, x = _some(wheel, cells), np.full((cells.size, 1), np.log(0.4))
    slope = 2.0 * left.n + 1.0
    value = np.log(_load(np.exp(x), left) / left.load)
    for step in range(_MAX_ITERATIONS):
        low, high = np.where(value < 0.0, x, low), np.where(value < 0.0, high, x)
        new = x - value / slope
        new = np.where((new > low) & (new < high), new, 0.5 * (low + high))
        found = np.log(_load(np.exp(new), left) / left.load)
        with np.errstate(all="ignore"):
            secant = (found - value) / (new - x)
        slope = np.where(np.isfinite(secant) & (secant > 0.1), secant, slope)
        x, value = new, found
        done = np.abs(value[:, 0]) <= _TOLERANCE
        entry[cells[done]] = np.exp(x[done])
        stays = ~done
        if step == _PATIENCE:  # those that are still sought may have no solution
            stays &= (_load(np.exp(np.full_like(x, _LN_ANGLE[1])), left) > left.load)[:, 0]
        # Cells that are found leave: their neighbours do not change them, nor cost them time.
        cells, left = cells[stays], _some(left, np.flatnonzero(stays))
        low, high, x, value, slope = (v[stays] for v in (low, high, x, value, slope))
        if not cells.size:
            break
    return entry


def _some(wheel: Wheel, cells: NDArray[np.intp]) -> Wheel:
    return Wheel(*(v[cells] for v in vars(wheel).values()))
