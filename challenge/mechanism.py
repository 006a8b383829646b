"""What a mechanism is: one physical cause with a strength, acting where it acts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from challenge.contact import Contact
from challenge.soil import Soil

type Array = NDArray[np.float64]
type Readings = dict[str, Array]

DRAWBAR, RUT, DENSITY = "drawbar_pull", "rut_depth", "bulk_density"
NONE, UNKNOWN, SHIFT = "none", "unknown", "parameter_shift"


@dataclass(frozen=True)
class Conditions:
    """Conditions of a campaign, one entry per run; arrays of shape ``(N,)``.

    Attributes
    ----------
    run_order : array
        Order in which the runs were made, from 0.
    slip : array
        Slip ratio from the self-propelled point.
    inflation_kpa, load_kn, speed_m_s, pass_number, water_content : array
        Inflation pressure, normal load, speed, pass in the same rut, water per dry mass.
    cone_index_kpa : array
        Cone index beside the rut.
    """

    run_order: Array
    slip: Array
    inflation_kpa: Array
    load_kn: Array
    speed_m_s: Array
    pass_number: Array
    water_content: Array
    cone_index_kpa: Array

    @property
    def size(self) -> int:
        """Number of runs."""
        return int(self.slip.size)

    def varies(self, name: str) -> bool:
        """Whether a condition takes more than one value."""
        return bool(np.ptp(getattr(self, name)) > 0.0)

    def elapsed(self) -> Array:
        """Return the time since the campaign began as a fraction of it, shape ``(N,)``."""
        return np.asarray(self.run_order / max(self.size - 1, 1), dtype=np.float64)


CONDITION_NAMES = tuple(field.name for field in fields(Conditions))


def _same_conditions(conditions: Conditions) -> Conditions:
    return conditions


def _same_soil(soil: Soil, conditions: Conditions) -> Soil:
    del conditions
    return soil


def _no_force(contact: Contact, conditions: Conditions) -> Array:
    del conditions
    return np.zeros_like(contact.slip)


def _same_readings(readings: Readings, conditions: Conditions, contact: Contact) -> Readings:
    del conditions, contact
    return readings


@dataclass(frozen=True)
class Mechanism:
    """One physical cause at one strength.

    Attributes
    ----------
    effect : str
        Name of the effect in the contract.
    sentence : str
        What happens, for the key.
    conditions : callable
        Recorded conditions to true ones.
    soil : callable
        Soil at the true conditions.
    force : callable
        Extra longitudinal force on the wheel in kN, positive forward, shape ``(N,)``.
    load_transfer : float
        Change of the normal load per drawbar pull.
    readings : callable
        Readings to what the instruments show.
    """

    effect: str
    sentence: str
    conditions: Callable[[Conditions], Conditions] = _same_conditions
    soil: Callable[[Soil, Conditions], Soil] = _same_soil
    force: Callable[[Contact, Conditions], Array] = _no_force
    load_transfer: float = 0.0
    readings: Callable[[Readings, Conditions, Contact], Readings] = _same_readings


@dataclass(frozen=True)
class Family:
    """A mechanism with its strength left open, one physical variant of an effect.

    Attributes
    ----------
    effect, variant : str
        The effect's name in the contract and which of its physical forms this is.
    at : callable
        Mechanism at a strength.
    low, high : float
        Smallest and largest strength in size that are physically sensible.
    signs : tuple of float
        Directions that occur.
    """

    effect: str
    variant: str
    at: Callable[[float], Mechanism]
    low: float
    high: float
    signs: tuple[float, ...] = (1.0,)


@dataclass(frozen=True)
class EffectKind:
    """An effect of the contract and what a design needs for it to act.

    Attributes
    ----------
    name : str
        Name in the contract.
    draw : callable
        Draws one of the effect's physical variants.
    outputs : tuple of str
        Outputs it touches, of which the design needs at least one.
    varies : tuple of str
        Conditions that have to vary in the field for it to act.
    """

    name: str
    draw: Callable[[np.random.Generator], Family]
    outputs: tuple[str, ...] = (DRAWBAR, RUT)
    varies: tuple[str, ...] = ()
