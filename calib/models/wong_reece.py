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

The entry angle is found by the secant method on logarithms.
"""

from __future__ import annotations

from functools import cache, partial
from typing import NamedTuple

import numpy as np

from calib.models.base import Array, Columns, Model, References, Rows

# Of each half of the contact; fewer do for the first step.
_N_NODES, _ROUGH = 8, 3
_LARGEST = 1.5
_LN_ENTRY = (float(np.log(1e-4)), float(np.log(_LARGEST)))
# Steps after which the wheels left are checked for a solution, and the most steps.
_USUAL, _MAX_ITERATIONS = 3, 60
# Of the load's relative error times the last step in ln theta1; the next secant step leaves about
# a tenth of it.
_TOLERANCE, _ROUNDING = 1e-10, 1e-12
# Wheels solved together, which bounds the memory.
_BLOCK = 8192
_MM_PER_M = 1000.0


class Contact(NamedTuple):
    """Where a wheel stands: pull (kN), torque (kN m) and sinkage (m), each (k, n)."""

    pull: Array
    torque: Array
    sinkage: Array


class _Cells(NamedTuple):
    """What the integrals need of wheels and soils, each of shape (cells,).

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

    def guess(self) -> tuple[Array, Array]:
        """Return ln theta1 and the slope of ln load over it, by a formula for small angles.

        Its numbers, fitted to soils drawn from the priors, only affect how many steps follow.
        """
        power = 2.0 * self.n + 1.0
        spread = (1.0 - self.turn) * (2.0 + self.turn) / 3.0
        x = np.log(self.load / self.area) - self.n * np.log(0.5 * self.scale)
        x = (x - self.n**0.7 * np.log(spread)) / power
        angle = np.exp(np.minimum(x, 0.0))
        friction, bent = 0.4 * self.tan_phi * angle, power * angle**2 / 12.0
        cohesion = 0.3 * self.c * self.area * angle / self.load
        x -= (friction - bent + cohesion) / (power + friction - 2.0 * bent)
        return x, np.maximum(power + friction - 2.0 * bent - cohesion, 0.5)


@cache
def _rule(size: int) -> tuple[Array, Array]:
    """Return nodes and weights (m, 1) of Gauss and Legendre's rule in the root of [0, 1].

    The stress rises as distance to the power n from either end of the contact: it is smooth in the
    root of that distance.
    """
    u, weight = np.polynomial.legendre.leggauss(size)
    u = 0.5 * (u[:, None] + 1.0)
    return u * u, weight[:, None] * u


def _sines(angle: Array) -> tuple[Array, Array]:
    """Return sin and 1 - cos, by the tangent of the half, NumPy's fastest function of the three."""
    half = np.tan(0.5 * angle)
    sine = 2.0 * half / (1.0 + half * half)
    return sine, half * sine


def _forces(entry: Array, cells: _Cells, nodes: int = _N_NODES) -> Array:
    """Integrate the stresses: load, pull and torque over radius (kN), shape (3, cells)."""
    node, weight = _rule(nodes)
    sin_entry, cos_entry = np.sin(entry), np.cos(entry)
    rear = cells.turn * entry
    front = entry - rear
    # From the entry on: cos theta - cos theta1, and sin theta1 - sin theta.
    sine, versine = _sines(node * front)
    rise = sin_entry * sine - cos_entry * versine
    fall = cos_entry * sine + sin_entry * versine
    sin_rear, versine = _sines(node * rear)
    sigma = weight * np.exp(cells.n * np.log(cells.scale * rise))
    strength = weight * cells.c + sigma * cells.tan_phi
    # The negative of the shear stress, from j/K in front of theta_m and behind it.
    tau = strength * np.expm1(cells.rest * fall - node * (cells.stiff * front))
    slid = cells.rest * sin_entry - cells.stiff * entry
    tau_rear = strength * np.expm1(slid + node * (cells.stiff * rear) - cells.rest * sin_rear)
    normal, shear, shear_rear = (v.sum(axis=0) for v in (sigma, tau, tau_rear))
    load = front * (normal * cos_entry - shear * sin_entry + (sigma * rise + tau * fall).sum(0))
    load += rear * (normal - (sigma * versine + tau_rear * sin_rear).sum(0))
    pull = front * ((sigma * fall - tau * rise).sum(0) - normal * sin_entry - shear * cos_entry)
    pull -= rear * (shear_rear + (sigma * sin_rear - tau_rear * versine).sum(0))
    return cells.area * np.stack([load, pull, -front * shear - rear * shear_rear])


def _solve(cells: _Cells) -> Array:
    """Return pull, torque over radius and ln theta1 where the load is carried, shape (3, cells).

    The load grows about as the entry angle to the power 2n + 1: on logarithms the secant method
    takes few steps, kept inside a shrinking bracket. The last step need not be evaluated: pull and
    torque are taken along their own secants as far. NaN where the soil cannot carry the wheel.
    """
    found = np.full((3, cells.load.size), np.nan)
    left = np.arange(cells.load.size)
    x, slope = cells.guess()
    x = np.clip(x, *_LN_ENTRY)
    rough = _forces(np.exp(x), cells, _ROUGH)[0]
    x = np.clip(x - np.log(rough / cells.load) / slope, *_LN_ENTRY)
    low, high = (np.full_like(x, edge) for edge in _LN_ENTRY)
    before = np.full((4, x.size), np.nan)
    for step in range(_MAX_ITERATIONS):
        load, pull, torque = _forces(np.exp(x), cells)
        here = np.stack([np.log(load / cells.load), pull, torque, x])
        moved = here - before
        off = np.abs(here[0])
        # Not farther along a secant than it is long, but for rounding.
        done = off <= np.maximum(np.abs(moved[0]), _ROUNDING)
        done &= off * np.abs(moved[3]) <= _TOLERANCE
        on = np.where(moved[0] == 0.0, 0.0, -here[0] / moved[0])
        found[:, left[done]] = (here[1:] + on * moved[1:])[:, done]
        stays = ~done
        if step == _USUAL:
            stays &= _forces(np.full_like(x, _LARGEST), cells)[0] > cells.load
        if not stays.all():
            left, cells = left[stays], _Cells(*(v[stays] for v in cells))
            low, high, slope = low[stays], high[stays], slope[stays]
            here, moved = here[:, stays], moved[:, stays]
        if not left.size:
            break
        value, x, before = here[0], here[3], here
        secant = moved[0] / moved[3]
        slope = np.where(secant > 0.1, secant, slope)
        low, high = np.where(value < 0.0, x, low), np.where(value < 0.0, high, x)
        x = x - value / slope
        x = np.where((x > low) & (x < high), x, 0.5 * (low + high))
    return found


def contact(columns: Columns, rows: Rows) -> Contact:
    """Find where each wheel carries its load, and what it then pulls.

    Parameters k1, k2, n, c, phi (degrees), K (mm), c1 and c2 are columns (k, 1). NaN for a braked
    wheel, and where the soil does not carry the wheel although it has sunk to its axle.

    References
    ----------
    Wong & Reece (1967), J. Terramechanics 4(1), 81-98, doi:10.1016/0022-4898(67)90105-X.
    """
    k1, k2, n, c, phi, K, c1, c2 = columns
    radius, width = rows["tyre_diameter_m"] / 2.0, rows["tyre_width_m"]
    slip = np.where(rows["slip_ratio"] >= 0.0, rows["slip_ratio"], np.nan)
    turn = np.minimum(c1 + c2 * slip, 0.999)
    stiff = _MM_PER_M * radius / K
    with np.errstate(all="ignore"):
        parts = np.broadcast_arrays(
            n, c, np.tan(np.radians(phi)), rows["normal_load_kn"], turn,
            (k1 + k2 * width) ** (1.0 / n) * radius / width, stiff, (1.0 - slip) * stiff,
            radius * width,
        )  # fmt: skip
        cells = _Cells(*(v.ravel() for v in parts))
        found = np.full((3, cells.load.size), np.nan)
        driven = np.flatnonzero(np.isfinite(cells.turn))
        for i in range(0, driven.size, _BLOCK):
            some = driven[i : i + _BLOCK]
            found[:, some] = _solve(_Cells(*(v[some] for v in cells)))
        pull, torque, entry = found.reshape(3, *parts[0].shape)
        return Contact(pull, radius * torque, radius * (1.0 - np.cos(np.exp(entry))))


def _pull(columns: Columns, rows: Rows, references: References) -> Array:
    return contact(columns, rows).pull


def _torque(columns: Columns, rows: Rows, references: References) -> Array:
    return contact(columns, rows).torque


def _ln_sinkage(columns: Columns, rows: Rows, references: References) -> Array:
    return np.log(_MM_PER_M * contact(columns, rows).sinkage)


_LETTERS = (
    "[$W] the load (kN), [$s] the slip, [$b] and [$r] width and radius of the wheel (m), [$theta] "
    "the angle from the vertical, [$theta_1] where the wheel enters and [$theta_m] where the "
    "normal stress [$sigma_n] (kPa) is largest (below, it falls in proportion to zero), [$tau] "
    "the shear stress (kPa), [$j] the slip displacement (mm)"
)
_STRESS = (
    r"$\sigma_\mathrm{n} = (k_1 + k_2 b)(r/b)^n (\cos\theta - \cos\theta_1)^n$",
    r"$\tau = (c + \sigma_\mathrm{n} \tan\phi)[1 - \exp(-j/K)]$",
    r"$\theta_\mathrm{m} = (c_1 + c_2 s)\theta_1$",
    r"$W = r b \int (\sigma_\mathrm{n} \cos\theta + \tau \sin\theta) d\theta$",
)

_model = partial(
    Model,
    conditions=("slip_ratio", "normal_load_kn", "tyre_width_m", "tyre_diameter_m"),
    parameters=("k1", "k2", "n", "c", "phi", "K", "c1", "c2"),
    reported={
        "k1": "kPa", "k2": "kPa/m", "n": "1", "c": "kPa", "phi": "degree", "K": "mm", "c1": "1",
        "c2": "1",
    },
    source="Wong & Reece (1967), J. Terramechanics 4(1), 81-98, doi:10.1016/0022-4898(67)90105-X",
    joined=("k1", "k2", "tyre_width_m"),
    slow=True,
    applies=(
        "Driven rigid wheels, or tyres so hard that they do not flatten, on one homogeneous soil, "
        "at slips of zero or more and loads that the soil can carry. Eight parameters of which "
        "one output determines only a few: the others are the prior's. A minute for a dozen rows."
    ),
)  # fmt: skip

WONG_REECE_PULL = _model(
    name="wong_reece_pull",
    title="Wong-Reece rigid wheel: drawbar pull",
    output="drawbar_pull_kn",
    mean_response=_pull,
    response="identity",
    latex=(r"$P = r b \int (\tau \cos\theta - \sigma_\mathrm{n} \sin\theta) d\theta$", *_STRESS),
    letters="[$P] the pull (kN), " + _LETTERS,
)

WONG_REECE_TORQUE = _model(
    name="wong_reece_torque",
    title="Wong-Reece rigid wheel: torque",
    output="driving_torque_knm",
    mean_response=_torque,
    response="identity",
    latex=(r"$T = r^2 b \int \tau d\theta$", *_STRESS),
    letters="[$T] the torque (kN m), " + _LETTERS,
)

WONG_REECE_SINKAGE = _model(
    name="wong_reece_sinkage",
    title="Wong-Reece rigid wheel: sinkage",
    output="rut_depth_mm",
    mean_response=_ln_sinkage,
    response="log",
    latex=(r"$z = r(1 - \cos\theta_1)$", *_STRESS),
    letters="[$z] the sinkage (m), " + _LETTERS,
)
