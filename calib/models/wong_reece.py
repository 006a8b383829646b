"""A rigid wheel on soil: stresses along the contact, integrated to load, pull and torque.

Wong & Reece (1967), part I, driven wheel. Angles are from the vertical, theta1 where soil is
entered and 0 where it is left. With p = k1 + k2 b, the normal stress is

    sigma = p (r/b)^n (cos theta - cos theta1)^n          theta_m <= theta <= theta1
    theta_m = (c1 + c2 s) theta1, and mirrored in proportion below it,

the shear stress is that of Janosi & Hanamoto (1961), tau = (c + sigma tan phi)(1 - exp(-j/K)) with
j = r [theta1 - theta - (1 - s)(sin theta1 - sin theta)], and the entry angle is the one at which
the stresses carry the load.

Time goes into sines and into memory. Wheels are worked through in blocks that stay in the
processor's cache, nodes along the first axis, in the same memory; sines are matrix products of
their series.

Drawbar pull, torque and sinkage of a driven rigid wheel: Wong & Reece (1967), part I.

The stresses and their integration are in `calib.models.wong_reece`. The three models share their
soil: eight parameters, of which pull, torque or sinkage alone determine but a few. What is known
of the soil is best fixed in a prior file. A braked wheel (slip below zero) has no value.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, partial
from math import factorial

import numpy as np
from numpy.typing import NDArray

from calib.models.base import Array, Columns, Model, References, Rows

type Indices = NDArray[np.intp]

# In each half of the contact; for a first step from the guess fewer will do.
_N_NODES, _ROUGH = 8, 3
# Of sine and cosine: 1e-13 at the largest angle.
_TERMS = 8
_LARGEST = 1.5
_LN_ENTRY = (float(np.log(1e-4)), float(np.log(_LARGEST)))
# Further steps that nearly all wheels need at most, and all.
_USUAL, _MAX_ITERATIONS = 3, 60
# Of the load's relative error times the last step in ln theta1; the next secant step leaves about
# a tenth of it.
_TOLERANCE, _ROUNDING = 1e-10, 1e-12
# Wheels whose arrays of 8 nodes stay in a cache of two megabytes.
_BLOCK = 3072
_N_WORK = 10


@dataclass(frozen=True)
class Wheel:
    """Soil and wheel, arrays that broadcast.

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
    """Where a wheel stands: pull (kN), torque (kN m) and sinkage (m), as it broadcasts."""

    pull: Array
    torque: Array
    sinkage: Array


def wheels(columns: Columns, rows: Rows) -> Wheel:
    """Take parameters k1, k2, n, c, phi (degrees), K (mm), c1, c2, and conditions."""
    k1, k2, n, c, phi, K, c1, c2 = columns
    return Wheel(
        k1, k2, n, c, np.tan(np.radians(phi)), K / 1000.0, c1, c2,
        rows["tyre_diameter_m"] / 2.0, rows["tyre_width_m"], rows["normal_load_kn"],
        rows["slip_ratio"],
    )  # fmt: skip


@dataclass(frozen=True)
class _Rule:
    """Gauss and Legendre's rule in u^2 on [0, 1], with series of sin(a x) and cos(a x) - 1.

    The stress rises as distance to the power n from either end of the contact: in u, the root of
    that distance, it is smooth for the exponents of soils.

    Parameters
    ----------
    node, weight : ndarray, shape (m, 1)
        The nodes x.
    sine, cosine : ndarray, shape (m, terms)
        Coefficients of a, a^3, ... and of a^2, a^4, ...
    """

    node: Array
    weight: Array
    sine: Array
    cosine: Array


@cache
def _rule(size: int) -> _Rule:
    u, weight = np.polynomial.legendre.leggauss(size)
    u = 0.5 * (u[:, None] + 1.0)
    node, order = u * u, np.arange(_TERMS)
    over = [1.0 / factorial(j) for j in range(1, 2 * _TERMS + 1)]
    sine = (-1.0) ** order * node ** (2 * order + 1) * over[::2]
    cosine = -((-1.0) ** order) * node ** (2 * order + 2) * over[1::2]
    return _Rule(node, weight[:, None] * u, sine, cosine)


@dataclass(frozen=True)
class _Cells:
    """What the integrals need of wheels, each of shape (cells,).

    Parameters
    ----------
    n, c, tan_phi, radius, load : ndarray
        As of a `Wheel`.
    turn : ndarray
        theta_m / theta1.
    scale : ndarray
        p^(1/n) r/b: sigma is (scale (cos theta - cos theta1))^n.
    stiff, rest : ndarray
        r/K, and (1 - s) r/K.
    area : ndarray
        r b.
    """

    n: Array
    c: Array
    tan_phi: Array
    radius: Array
    load: Array
    turn: Array
    scale: Array
    stiff: Array
    rest: Array
    area: Array

    @classmethod
    def of(cls, w: Wheel) -> _Cells:
        """Without a value where the slip is below zero."""
        slip = np.where(w.slip >= 0.0, w.slip, np.nan)
        stiff = w.radius / w.K
        parts = (
            w.n, w.c, w.tan_phi, w.radius, w.load, np.minimum(w.c1 + w.c2 * slip, 0.999),
            (w.k1 + w.k2 * w.width) ** (1.0 / w.n) * w.radius / w.width, stiff,
            (1.0 - slip) * stiff, w.radius * w.width,
        )  # fmt: skip
        return cls(*(v.ravel() for v in np.broadcast_arrays(*parts)))

    def some(self, which: Indices) -> _Cells:
        """Some of the cells."""
        return _Cells(*(v[which] for v in vars(self).values()))

    def guess(self) -> tuple[Array, Array]:
        """Return ln theta1, and the slope of ln load over it, by a formula for small angles.

        Nothing depends on its numbers but how many steps follow: they were fitted to soils drawn
        from the priors.
        """
        power = 2.0 * self.n + 1.0
        spread = (1.0 - self.turn) * (2.0 + self.turn) / 3.0
        x = np.log(self.load / self.area) - self.n * np.log(0.5 * self.scale)
        x = (x - self.n**0.7 * np.log(spread)) / power
        angle = np.exp(np.minimum(x, 0.0))
        friction, bent = 0.4 * self.tan_phi * angle, power * angle**2 / 12.0
        cohesion = 0.3 * self.c * self.area * angle / self.load
        x -= (friction - bent + cohesion) / (power + friction - 2.0 * bent)
        slope = np.maximum(power + friction - 2.0 * bent - cohesion, 0.5)
        return np.clip(x, *_LN_ENTRY), slope


def _forces(entry: Array, cells: _Cells, work: Array, nodes: int = _N_NODES) -> Array:
    """Integrate the stresses: load, pull and torque over radius (kN) in the first of 4 rows."""
    rule, size = _rule(nodes), entry.size
    sin, cos, sin_rear, cos_rear, rise, strength, tau, tau_rear, spare, powers = (
        part[: rows * size].reshape(rows, size)
        for part, rows in zip(work, [nodes] * (_N_WORK - 1) + [_TERMS], strict=True)
    )
    sin_entry, cos_entry = np.sin(entry), np.cos(entry)
    rear = cells.turn * entry
    front = entry - rear
    # Of angles from the entry on, and from the vertical on; cosines less one.
    for length, sines, cosines in ((front, sin, cos), (rear, sin_rear, cos_rear)):
        square = length * length
        powers[0] = length
        for j in range(1, _TERMS):
            np.multiply(powers[j - 1], square, out=powers[j])
        np.matmul(rule.sine, powers, out=sines)
        powers *= length
        np.matmul(rule.cosine, powers, out=cosines)
    # In front: rise is cos theta - cos theta1, and fall sin theta1 - sin theta.
    np.multiply(cos, cos_entry, out=rise)
    rise += np.multiply(sin, sin_entry, out=spare)
    sin *= cos_entry
    cos *= sin_entry
    fall = np.subtract(sin, cos, out=sin)
    sigma = np.multiply(rise, cells.scale, out=cos)
    np.log(sigma, out=sigma)
    sigma *= cells.n
    np.exp(sigma, out=sigma)
    sigma *= rule.weight
    np.multiply(sigma, cells.tan_phi, out=strength)
    strength += np.multiply(rule.weight, cells.c, out=spare)
    # Both tau are the negative of the shear stress.
    np.multiply(fall, cells.rest, out=tau)
    tau -= np.multiply(rule.node, front * cells.stiff, out=spare)
    np.multiply(rule.node, rear * cells.stiff, out=tau_rear)
    tau_rear -= np.multiply(sin_rear, cells.rest, out=spare)
    tau_rear += cells.rest * sin_entry - cells.stiff * entry
    for part in (tau, tau_rear):
        np.expm1(part, out=part)
        part *= strength

    def dot(a: Array, b: Array) -> Array:
        return np.asarray(np.add.reduce(np.multiply(a, b, out=spare), axis=0))

    normal, shear, shear_rear = (np.add.reduce(part, axis=0) for part in (sigma, tau, tau_rear))
    forces = np.empty((4, size))
    load = front * (normal * cos_entry + dot(sigma, rise) - shear * sin_entry + dot(tau, fall))
    load += rear * (normal + dot(sigma, cos_rear) - dot(tau_rear, sin_rear))
    pull = front * (dot(sigma, fall) - normal * sin_entry - shear * cos_entry - dot(tau, rise))
    pull -= rear * (shear_rear + dot(tau_rear, cos_rear) + dot(sigma, sin_rear))
    np.multiply(cells.area, load, out=forces[0])
    np.multiply(cells.area, pull, out=forces[1])
    np.multiply(-cells.area, front * shear + rear * shear_rear, out=forces[2])
    return forces


def contact(wheel: Wheel) -> Contact:
    """Find where each wheel carries its load, and what it then pulls.

    Returns
    -------
    Contact
        NaN for a braked wheel (slip below zero, part II of the source), and where the soil does
        not carry the wheel although it has sunk to its axle.

    References
    ----------
    Wong & Reece (1967), J. Terramechanics 4(1), 81-98, doi:10.1016/0022-4898(67)90105-X.
    """
    shape = np.broadcast_shapes(*(np.shape(v) for v in vars(wheel).values()))
    with np.errstate(all="ignore"):
        cells = _Cells.of(wheel)
        found = np.full((3, cells.load.size), np.nan)
        work = np.empty((_N_WORK, _N_NODES * min(_BLOCK, cells.load.size)))
        # The few that take longer are gone on with together; some of them have no solution.
        left = _solve(np.flatnonzero(np.isfinite(cells.turn)), cells, work, found, _USUAL)
        most = [_forces(np.full(v.size, _LARGEST), cells.some(v), work)[0] for v in _blocks(left)]
        bears = np.concatenate([[], *most]) > cells.load[left]
        _solve(left[bears], cells, work, found, _MAX_ITERATIONS)
        pull, torque, entry = found.reshape(3, *shape)
        return Contact(pull, wheel.radius * torque, wheel.radius * (1.0 - np.cos(np.exp(entry))))


def _blocks(which: Indices) -> list[Indices]:
    return [which[i : i + _BLOCK] for i in range(0, which.size, _BLOCK)]


def _solve(which: Indices, cells: _Cells, work: Array, found: Array, steps: int) -> Indices:
    """Write pull, torque over radius and ln theta1, (3, cells), and return where there is none yet.

    The load grows about as the entry angle to the power 2n + 1: on logarithms the secant method
    takes few steps, kept inside a shrinking bracket, and the last one need not be evaluated: pull
    and torque are taken along their own secants as far.
    """
    left = [np.flatnonzero([])]
    for where in _blocks(which):
        some = cells.some(where)
        x, slope = some.guess()
        rough = _forces(np.exp(x), some, work, _ROUGH)[0]
        x = np.clip(x - np.log(rough / some.load) / slope, *_LN_ENTRY)
        low, high = (np.full_like(x, edge) for edge in _LN_ENTRY)
        before = np.full((4, x.size), np.nan)
        for _ in range(steps):
            here = _forces(np.exp(x), some, work)
            value = np.log(here[0] / some.load)
            here[0], here[3] = value, x
            moved = here - before
            # A secant is to be followed no farther than it is long, but for rounding.
            gained = np.maximum(np.abs(moved[0]), _ROUNDING)
            off = np.abs(value)
            done = np.flatnonzero((off <= gained) & (off * np.abs(moved[3]) <= _TOLERANCE))
            if done.size:
                on = np.where(moved[0] == 0.0, 0.0, -value / moved[0])[done]
                found[:, where[done]] = here[1:, done] + on * moved[1:, done]
                if done.size == where.size:
                    where = where[:0]
                    break
                stays = np.delete(np.arange(where.size), done)
                where, some = where[stays], some.some(stays)
                low, high, x, slope, value = (v[stays] for v in (low, high, x, slope, value))
                here, moved = here[:, stays], moved[:, stays]
            secant = moved[0] / moved[3]
            slope = np.where(secant > 0.1, secant, slope)
            low, high = np.where(value < 0.0, x, low), np.where(value < 0.0, high, x)
            x = x - value / slope
            x = np.where((x > low) & (x < high), x, 0.5 * (low + high))
            before = here
        left.append(where)
    return np.concatenate(left)


_MM_PER_M = 1000.0


def _pull(columns: Columns, rows: Rows, references: References, work: Array) -> Array:
    return contact(wheels(columns, rows)).pull


def _torque(columns: Columns, rows: Rows, references: References, work: Array) -> Array:
    return contact(wheels(columns, rows)).torque


def _ln_sinkage(columns: Columns, rows: Rows, references: References, work: Array) -> Array:
    return np.log(_MM_PER_M * contact(wheels(columns, rows)).sinkage)


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
        "one output determines but a few: the others are the prior's. A minute for a dozen rows."
    ),
)  # fmt: skip

WONG_REECE_PULL = _model(
    name="wong_reece_pull",
    title="Wong-Reece rigid wheel: drawbar pull",
    output="drawbar_pull_kn",
    location=_pull,
    response="identity",
    latex=(r"$P = r b \int (\tau \cos\theta - \sigma_\mathrm{n} \sin\theta) d\theta$", *_STRESS),
    letters="[$P] the pull (kN), " + _LETTERS,
    example="""\
slip_ratio,normal_load_kn,tyre_width_m,tyre_diameter_m,drawbar_pull_kn
0.05,2,0.2,0.8,0.07713
0.12,2,0.2,0.8,0.2987
0.2,2,0.2,0.8,0.3535
0.35,2,0.2,0.8,0.4524
0.5,2,0.2,0.8,0.4773
0.05,4,0.3,1,0.3569
0.12,4,0.3,1,0.7811
0.2,4,0.3,1,0.9191
0.35,4,0.3,1,1.011
0.5,4,0.3,1,1.116
0.05,6,0.3,1.2,0.9344
0.12,6,0.3,1.2,1.062
0.2,6,0.3,1.2,1.446
0.35,6,0.3,1.2,1.487
0.5,6,0.3,1.2,1.585
""",
)

WONG_REECE_TORQUE = _model(
    name="wong_reece_torque",
    title="Wong-Reece rigid wheel: torque",
    output="driving_torque_knm",
    location=_torque,
    response="identity",
    latex=(r"$T = r^2 b \int \tau d\theta$", *_STRESS),
    letters="[$T] the torque (kN m), " + _LETTERS,
    example="""\
slip_ratio,normal_load_kn,tyre_width_m,tyre_diameter_m,driving_torque_knm
0.05,2,0.2,0.8,0.2416
0.12,2,0.2,0.8,0.3144
0.2,2,0.2,0.8,0.3552
0.35,2,0.2,0.8,0.3896
0.5,2,0.2,0.8,0.3966
0.05,4,0.3,1,0.6503
0.12,4,0.3,1,0.795
0.2,4,0.3,1,0.8841
0.35,4,0.3,1,1.01
0.5,4,0.3,1,1.002
0.05,6,0.3,1.2,1.379
0.12,6,0.3,1.2,1.625
0.2,6,0.3,1.2,1.632
0.35,6,0.3,1.2,1.855
0.5,6,0.3,1.2,1.818
""",
)

WONG_REECE_SINKAGE = _model(
    name="wong_reece_sinkage",
    title="Wong-Reece rigid wheel: sinkage",
    output="rut_depth_mm",
    location=_ln_sinkage,
    response="log",
    latex=(r"$z = r(1 - \cos\theta_1)$", *_STRESS),
    letters="[$z] the sinkage (m), " + _LETTERS,
    example="""\
slip_ratio,normal_load_kn,tyre_width_m,tyre_diameter_m,rut_depth_mm
0.05,2,0.2,0.8,50.75
0.12,2,0.2,0.8,50.94
0.2,2,0.2,0.8,43.72
0.35,2,0.2,0.8,51.84
0.5,2,0.2,0.8,53.88
0.05,4,0.3,1,60.41
0.12,4,0.3,1,51.03
0.2,4,0.3,1,60.12
0.35,4,0.3,1,53.54
0.5,4,0.3,1,59.33
0.05,6,0.3,1.2,66.07
0.12,6,0.3,1.2,79.62
0.2,6,0.3,1.2,75.05
0.35,6,0.3,1.2,90.03
0.5,6,0.3,1.2,81.4
""",
)
