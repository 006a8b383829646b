"""A rigid wheel on soil: stresses along the contact, integrated to load, pull and torque.

Wong & Reece (1967), part I, driven wheel. Angles are from the vertical, theta1 where soil is
entered and 0 where it is left. With p = k1 + k2 b, the normal stress is

    sigma = p (r/b)^n (cos theta - cos theta1)^n          theta_m <= theta <= theta1
    theta_m = (c1 + c2 s) theta1, and mirrored in proportion below it,

the shear stress is that of Janosi & Hanamoto (1961), tau = (c + sigma tan phi)(1 - exp(-j/K)) with
j = r [theta1 - theta - (1 - s)(sin theta1 - sin theta)], and the entry angle is the one at which
the stresses carry the load.

Pull, torque and sinkage are three models of one soil: of its eight parameters each output alone
determines but a few, so what is known of the soil is best fixed in a prior file. A braked wheel
(slip below zero, part II of the source) has no value.
"""

from __future__ import annotations

from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np

from calib.models.base import Array, Conditions
from calib.models.card import Equation, from_cards

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)


class Contact(NamedTuple):
    """Where a wheel stands: pull (kN), torque (kN m) and sinkage (m), each (k, n)."""

    pull: Array
    torque: Array
    sinkage: Array


class _Wheels(NamedTuple):
    """What the integrals need of wheels and soils, each (k, n).

    `turn` is theta_m/theta1, `scale` p^(1/n) r/b, so that sigma is (scale (cos theta - cos
    theta1))^n, `stiff` r/K, `rest` (1 - s) r/K and `area` r b.
    """

    n: Array
    c: Array
    tan_phi: Array
    load: Array
    turn: Array
    scale: Array
    stiff: Array
    rest: Array
    area: Array

    def excess(self, ln_entry: Array) -> Array:
        """Return ln of the load that is carried over the load."""
        return np.asarray(np.log(_forces(np.exp(ln_entry), self)[0] / self.load))


def _forces(entry: Array, wheels: _Wheels) -> tuple[Array, Array, Array]:
    """Integrate the stresses: load (kN), pull (kN) and torque over radius (kN).

    The stress rises as distance to the power n from either end of the contact, so it is smooth in
    the root of that distance, in which Gauss and Legendre's rule is taken: 8 nodes on either half
    leave about 1e-6 of the load.
    """
    u, weight = (v.reshape(-1, *[1] * entry.ndim) for v in (0.5 * (_NODES + 1.0), _WEIGHTS))
    node, weight = u * u, weight * u
    sin_entry, cos_entry = np.sin(entry), np.cos(entry)
    rear = wheels.turn * entry
    front = entry - rear
    # From the entry on: cos theta - cos theta1, and sin theta1 - sin theta.
    sine, versine = np.sin(node * front), 2.0 * np.sin(0.5 * node * front) ** 2
    rise = sin_entry * sine - cos_entry * versine
    fall = cos_entry * sine + sin_entry * versine
    sin_rear, versine = np.sin(node * rear), 2.0 * np.sin(0.5 * node * rear) ** 2
    sigma = weight * np.exp(wheels.n * np.log(wheels.scale * rise))
    strength = weight * wheels.c + sigma * wheels.tan_phi
    # The negative of the shear stress, from j/K.
    tau = strength * np.expm1(wheels.rest * fall - wheels.stiff * (node * front))
    slid = wheels.stiff * (node * rear - entry) + wheels.rest * (sin_entry - sin_rear)
    tau_rear = strength * np.expm1(slid)
    normal, shear, shear_rear = (v.sum(axis=0) for v in (sigma, tau, tau_rear))
    load = front * (normal * cos_entry - shear * sin_entry + (sigma * rise + tau * fall).sum(0))
    load += rear * (normal - (sigma * versine + tau_rear * sin_rear).sum(0))
    pull = front * ((sigma * fall - tau * rise).sum(0) - normal * sin_entry - shear * cos_entry)
    pull -= rear * (shear_rear + (sigma * sin_rear - tau_rear * versine).sum(0))
    area = wheels.area
    return area * load, area * pull, -area * (front * shear + rear * shear_rear)


def _entry_angle(wheels: _Wheels) -> Array:
    """Return the entry angle at which the load is carried; NaN where the soil cannot carry it."""
    from scipy.optimize.elementwise import find_root  # late: a tenth of a second

    found: Any = find_root(
        lambda x, *each: _Wheels(*each).excess(x), (np.log(1e-4), np.log(1.5)), args=tuple(wheels),
        tolerances={"xatol": 1e-10},
    )  # fmt: skip
    return np.where(found.success, np.exp(found.x), np.nan)


def contact(
    x: Conditions,
    *,
    k1: Array,
    k2: Array,
    n: Array,
    c: Array,
    phi: Array,
    K: Array,
    c1: Array,
    c2: Array,
) -> Contact:
    """Find where each wheel carries its load, and what it then pulls.

    Parameters, phi in degrees and K in mm, are columns (k, 1). NaN for a braked wheel, and where
    the soil does not carry the wheel although it has sunk to its axle.

    References
    ----------
    Wong & Reece (1967), J. Terramechanics 4(1), 81-98, doi:10.1016/0022-4898(67)90105-X.
    """
    radius, width = x["tyre_diameter_m"] / 2.0, x["tyre_width_m"]
    slip = np.where(x["slip_ratio"] >= 0.0, x["slip_ratio"], np.nan)
    stiff = 1000.0 * radius / K
    with np.errstate(all="ignore"):
        wheels = _Wheels(
            *np.broadcast_arrays(
                n,
                c,
                np.tan(np.radians(phi)),
                x["normal_load_kn"],
                np.minimum(c1 + c2 * slip, 0.999),
                (k1 + k2 * width) ** (1.0 / n) * radius / width,
                stiff,
                (1.0 - slip) * stiff,
                radius * width,
            )
        )
        entry = _entry_angle(wheels)
        _, pull, torque = _forces(entry, wheels)
        return Contact(pull, radius * torque, radius * (1.0 - np.cos(entry)))


def _ln_sinkage(found: Contact) -> Array:
    return np.asarray(np.log(1000.0 * found.sinkage))


MODELS = from_cards(
    "wong_reece",
    wong_reece_pull=Equation(attrgetter("pull"), whole=contact),
    wong_reece_torque=Equation(attrgetter("torque"), whole=contact),
    wong_reece_sinkage=Equation(_ln_sinkage, whole=contact),
)
