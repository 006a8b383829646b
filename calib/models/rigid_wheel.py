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

from dataclasses import dataclass
from functools import cache

import numpy as np

from calib.models.base import Array, Conditions

__all__ = ["Contact", "Wheel", "contact", "wheels"]

N_NODES = 12
_LN_ANGLE = (float(np.log(1e-4)), float(np.log(1.5)))
_MAX_ITERATIONS = 60
_TOLERANCE = 1e-10


@dataclass(frozen=True)
class Wheel:
    """Soil and wheel, arrays that broadcast to (k, n, 1).

    Parameters
    ----------
    k1, k2, n, c, tan_phi, K, c1, c2 : ndarray
        In kPa, kPa/m, 1, kPa, 1, m, 1, 1.
    radius, width, load, slip : ndarray
        In m, m, kN, as a fraction.
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


def _evaluate(entry: Array, wheel: Wheel) -> Contact:
    """Integrate the stresses for entry angles, shape (k, n, 1)."""
    part, weight = _nodes()
    turning = np.minimum(wheel.c1 + wheel.c2 * wheel.slip, 0.999) * entry
    front = entry - (entry - turning) * part
    rise = np.maximum(np.cos(front) - np.cos(entry), 0.0) * wheel.radius / wheel.width
    normal = (wheel.k1 + wheel.k2 * wheel.width) * rise**wheel.n
    lifted = pulled = turned = np.zeros(entry.shape[:2])
    for angle, length in ((front, entry - turning), (turning * part, turning)):
        sine, cosine = np.sin(angle), np.cos(angle)
        moved = entry - angle - (1.0 - wheel.slip) * (np.sin(entry) - sine)
        mobilised = -np.expm1(-wheel.radius * moved / wheel.K)
        shear = (wheel.c + normal * wheel.tan_phi) * mobilised
        measure = weight * length
        lifted = lifted + ((normal * cosine + shear * sine) * measure).sum(axis=-1)
        pulled = pulled + ((shear * cosine - normal * sine) * measure).sum(axis=-1)
        turned = turned + (shear * measure).sum(axis=-1)
    radius, area = wheel.radius[..., 0], (wheel.radius * wheel.width)[..., 0]
    sinkage = radius * (1.0 - np.cos(entry[..., 0]))
    return Contact(area * lifted, area * pulled, area * radius * turned, sinkage)


def contact(wheel: Wheel) -> Contact:
    """Find where each wheel carries its load, and what it then pulls.

    Parameters
    ----------
    wheel : Wheel

    Returns
    -------
    Contact
        NaN for a braked wheel (slip below zero, part II of the source), and where the soil does
        not carry the wheel although it has sunk to its axle.

    Notes
    -----
    The load grows about as the entry angle to the power 2n + 1: on logarithms the secant method
    takes some five steps, kept inside a shrinking bracket.

    References
    ----------
    Wong & Reece (1967), J. Terramechanics 4(1), 81-98, doi:10.1016/0022-4898(67)90105-X.
    """
    fields = vars(wheel).values()
    shape = np.broadcast_shapes(*(np.shape(v) for v in fields))
    ln_load = np.log(np.broadcast_to(wheel.load, shape))
    low, high = (np.full(shape, edge) for edge in _LN_ANGLE)

    def excess(ln_entry: Array) -> Array:
        return np.log(_evaluate(np.exp(ln_entry), wheel).load)[..., None] - ln_load

    slope = np.broadcast_to(2.0 * wheel.n + 1.0, shape)
    carried = (excess(high) > 0.0) & (np.broadcast_to(wheel.slip, shape) >= 0.0)
    x = np.full(shape, np.log(0.4))
    value = excess(x)
    for _ in range(_MAX_ITERATIONS):
        low, high = np.where(value < 0.0, x, low), np.where(value < 0.0, high, x)
        step = x - value / slope
        new = np.where((step > low) & (step < high), step, 0.5 * (low + high))
        # What is found stays, so that it does not depend on what it is found with.
        new = np.where(np.abs(value) > _TOLERANCE, new, x)
        found = excess(new)
        moved = new - x
        with np.errstate(all="ignore"):
            secant = (found - value) / moved
        slope = np.where(np.isfinite(secant) & (secant > 0.1), secant, slope)
        x, value = new, found
        if not np.any(np.abs(value[carried]) > _TOLERANCE):
            break
    return _evaluate(np.where(carried, np.exp(x), np.nan), wheel)
