"""One wheel on one soil: the vertical force balance and the forces that follow from it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from challenge.soil import Soil, bearing_pressure, give, shear_stress
from challenge.tyre import CONTACT_WIDTH_M, Tyre

type Array = NDArray[np.float64]

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(6)
_NODES, _WEIGHTS = 0.5 * (_NODES + 1.0), 0.5 * _WEIGHTS
_SHALLOW_M, _DEEP_M = 1e-4, 0.25
_ITERATIONS = 60
_TOLERANCE = 1e-9


@dataclass(frozen=True)
class Contact:
    """Wheel and soil in vertical equilibrium; arrays of shape ``(N,)`` unless stated.

    Attributes
    ----------
    soil : Soil
        The soil with columns of shape ``(N, 1)``.
    slip : array
        True slip ratio.
    load_kn, support_kn : array
        Vertical load and the soil's answer to it, equal but for the solver's tolerance.
    sinkage_m : array
        Depth of the flat part of the contact below the undisturbed surface.
    length_m : array
        Length of the flat part.
    entry_m : array
        Length of the arc ahead of the flat part.
    flat_pressure_kpa : array
        Normal pressure under the flat part.
    thrust_kn, resistance_kn : array
        Shear force along the contact, and the force that compacts the soil.
    """

    soil: Soil
    slip: Array
    load_kn: Array
    support_kn: Array
    sinkage_m: Array
    length_m: Array
    entry_m: Array
    flat_pressure_kpa: Array
    thrust_kn: Array
    resistance_kn: Array

    @property
    def pull_kn(self) -> Array:
        """Thrust less compaction resistance, shape ``(N,)``."""
        return self.thrust_kn - self.resistance_kn


@dataclass(frozen=True)
class _Profile:
    """Forces on the contact at a trial sinkage; shapes ``(N,)``."""

    vertical: Array
    thrust: Array
    resistance: Array
    entry: Array
    flat_pressure: Array


def _profile(soil: Soil, tyre: Tyre, slip: Array, length: Array, sinkage: Array) -> _Profile:
    """Integrate pressure and shear over the arc and the flat part by Gauss-Legendre."""
    half, depth, slip_col = length[:, None] / 2.0, sinkage[:, None], slip[:, None]
    radius = tyre.radius_m
    axle = np.sqrt(radius**2 - half**2)
    entry = np.sqrt(radius**2 - np.clip(axle - depth, 0.02, None) ** 2) - half
    giving = give(soil, slip_col)
    arc = half + entry * _NODES
    rise = axle - np.sqrt(radius**2 - arc**2)
    slope = arc / np.sqrt(radius**2 - arc**2)
    pressure = bearing_pressure(soil, depth - rise, giving)
    shear = shear_stress(soil, pressure, slip_col * (half + entry - arc))
    span = CONTACT_WIDTH_M * entry * _WEIGHTS
    flat = bearing_pressure(soil, depth, giving)
    flat_shear = shear_stress(soil, flat, slip_col * (entry + 2.0 * half * _NODES))
    flat_span = CONTACT_WIDTH_M * 2.0 * half
    vertical = flat[:, 0] * flat_span[:, 0] + np.sum(span * (pressure + shear * slope), axis=1)
    thrust = np.sum(flat_span * _WEIGHTS * flat_shear, axis=1) + np.sum(span * shear, axis=1)
    resistance = np.sum(span * pressure * slope, axis=1)
    return _Profile(vertical, thrust, resistance, entry[:, 0], flat[:, 0])


def solve_increasing(
    function: Callable[[Array], Array], low: Array, high: Array, tolerance: float = _TOLERANCE
) -> Array:
    """Return the root of a vectorised increasing function by secants kept in a bracket.

    Parameters
    ----------
    function : callable
        Maps ``(N,)`` to ``(N,)``, each element increasing in its own argument.
    low, high : array
        Brackets, shape ``(N,)``; where the root lies outside, the nearer end is returned.
    tolerance : float
        Largest step at which to stop.

    Returns
    -------
    array
        Roots, shape ``(N,)``.
    """
    low, high = low.astype(np.float64), high.astype(np.float64)
    f_low, f_high = function(low), function(high)
    ends = np.where(f_low >= 0.0, low, high)
    outside = (f_low >= 0.0) | (f_high <= 0.0)
    old, f_old, now, f_now = low, f_low, high, f_high
    for _ in range(_ITERATIONS):
        slope = (f_now - f_old) / np.where(now == old, 1.0, now - old)
        step = f_now / np.where(slope > 0.0, slope, 1.0)
        # Off the bracket, or on a slope that says nothing, halving is the safe move.
        safe = (slope > 0.0) & (now - step > low) & (now - step < high)
        old, f_old, now = now, f_now, np.where(safe, now - step, 0.5 * (low + high))
        f_now = function(now)
        low, high = np.where(f_now > 0.0, low, now), np.where(f_now > 0.0, now, high)
        if np.max(np.where(outside, 0.0, np.abs(now - old)), initial=0.0) < tolerance:
            break
    return np.where(outside, ends, now)


def settle(soil: Soil, tyre: Tyre, slip: Array, inflation_kpa: Array, load_kn: Array) -> Contact:
    """Return the contact in vertical equilibrium.

    A flat patch, as long as on firm ground, at the depth where the soil carries the load, and an
    arc of the undeflected carcass ahead of it: the flexible-tyre idealisation of Wong [1]_ with
    the pressures and shear of the arc kept. Shear displacement is slip times distance from
    the point where the tyre meets the soil.

    Parameters
    ----------
    soil : Soil
        Floats or arrays of shape ``(N,)``.
    tyre : Tyre
        The tyre.
    slip, inflation_kpa, load_kn : array
        Conditions, shape ``(N,)``.

    References
    ----------
    .. [1] J. Y. Wong, Theory of Ground Vehicles, 4th ed., Wiley 2008, sections 2.4-2.5.
    """
    soil = soil.columns(slip.size)
    length = tyre.contact_length(inflation_kpa, load_kn)

    def excess(log_depth: Array) -> Array:
        return np.log(_profile(soil, tyre, slip, length, np.exp(log_depth)).vertical / load_kn)

    bounds = np.full(slip.shape, np.log(_SHALLOW_M)), np.full(slip.shape, np.log(_DEEP_M))
    sinkage = np.exp(solve_increasing(excess, *bounds))
    got = _profile(soil, tyre, slip, length, sinkage)
    return Contact(
        soil=soil,
        slip=slip,
        load_kn=load_kn,
        support_kn=got.vertical,
        sinkage_m=sinkage,
        length_m=length,
        entry_m=got.entry,
        flat_pressure_kpa=got.flat_pressure,
        thrust_kn=got.thrust,
        resistance_kn=got.resistance,
    )
