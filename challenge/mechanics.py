"""Noise-free readings of a campaign: conditions in, drawbar pull and rut depth out."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from challenge.contact import Contact, settle, solve_increasing
from challenge.density import ConeLaw
from challenge.mechanism import Conditions, Mechanism, Readings
from challenge.soil import Soil
from challenge.tyre import REFERENCE_LOAD_KN, Tyre

type Array = NDArray[np.float64]

_TRANSFER_STEPS = 8


@dataclass(frozen=True)
class Reality:
    """One soil, one tyre and the mechanisms that act on them.

    Attributes
    ----------
    soil : Soil
        The soil under the wheel.
    tyre : Tyre
        The tyre.
    cone : ConeLaw
        How the same soil resists a cone penetrometer.
    mechanisms : tuple of Mechanism
        What acts beyond soil and tyre; empty in the lab.
    rolling : Reality, optional
        The reality in which zero slip was defined; itself by default. A field campaign keeps
        the rolling radius of the lab.
    """

    soil: Soil
    tyre: Tyre
    cone: ConeLaw
    mechanisms: tuple[Mechanism, ...] = ()
    rolling: Reality | None = field(default=None, repr=False)

    def with_mechanisms(self, *mechanisms: Mechanism) -> Reality:
        """Return this reality with mechanisms acting and the rolling radius kept."""
        return replace(self, mechanisms=mechanisms, rolling=self.rolling or self)


def _pull_at(reality: Reality, slip: Array, inflation: Array) -> Array:
    load = np.full(slip.shape, REFERENCE_LOAD_KN)
    return settle(reality.soil, reality.tyre, slip, inflation, load).pull_kn


def self_propelled_slip(reality: Reality, inflation_kpa: Array) -> Array:
    """Return the slip against the unloaded radius at which the pull vanishes, shape ``(N,)``.

    Recorded slips count from there, as in the source paper: a wheel without drawbar pull slips
    just enough to overcome its own resistance. Solved at the distinct pressures only.
    """
    distinct, back = np.unique(inflation_kpa, return_inverse=True)
    low, high = np.full(distinct.shape, -0.01), np.full(distinct.shape, 0.3)
    zero = solve_increasing(lambda s: _pull_at(reality, s, distinct), low, high, 1e-8)
    return np.asarray(zero[back], dtype=np.float64)


def simulate(reality: Reality, recorded: Conditions, zero: Array | None = None) -> Readings:
    """Return the noise-free readings at recorded conditions.

    Mechanisms act in the order of cause: what the conditions really were, what that made of
    the soil, the forces on the wheel, and what the instruments made of them.

    Parameters
    ----------
    reality : Reality
        Soil, tyre and mechanisms.
    recorded : Conditions
        The conditions as written down, arrays of shape ``(N,)``.
    zero : array, optional
        `self_propelled_slip` at these conditions, where it is known already.

    Returns
    -------
    dict
        ``drawbar_pull`` in kN, ``rut_depth`` in mm and ``bulk_density`` in g/cm^3, ``(N,)`` each.
    """
    true, soil, cone = recorded, reality.soil, reality.cone
    for mechanism in reality.mechanisms:
        true = mechanism.true_conditions(true)
    for mechanism in reality.mechanisms:
        soil = mechanism.changed_soil(soil, true)
    if zero is None:
        zero = self_propelled_slip(reality.rolling or reality, recorded.inflation_kpa)
    contact, pull = _forces(reality, soil, true, zero)
    readings: Readings = {
        "drawbar_pull": pull,
        "rut_depth": 1e3 * contact.sinkage_m,
        "bulk_density": cone.density(true.cone_index_kpa, true.water_content),
    }
    for mechanism in reality.mechanisms:
        readings = mechanism.shown(readings, recorded, contact)
    return readings


def _forces(reality: Reality, soil: Soil, true: Conditions, zero: Array) -> tuple[Contact, Array]:
    """Balance the wheel; with load transfer, pull and load are iterated to agreement."""
    slip = 1.0 - (1.0 - true.slip) * (1.0 - zero)
    transfer = sum(m.load_transfer for m in reality.mechanisms)
    load = true.load_kn
    for _ in range(_TRANSFER_STEPS if transfer else 1):
        contact = settle(soil, reality.tyre, slip, true.inflation_kpa, load)
        pull = contact.pull_kn + sum(m.force(contact, true) for m in reality.mechanisms)
        load = np.maximum(true.load_kn + transfer * pull, 0.2 * true.load_kn)
    return contact, pull
