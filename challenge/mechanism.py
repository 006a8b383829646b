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


@dataclass(frozen=True)
class Family:
    """One physical variant of an effect, its strength left open.

    What it does takes the strength first.

    Attributes
    ----------
    variant : str
        Which of the effect's physical forms this is.
    sentence : callable
        What happens at a strength, for the key.
    low, high : float
        Smallest and largest strength in size that are physically sensible.
    signs : tuple of float
        Directions that occur.
    conditions : callable, optional
        Recorded conditions to true ones.
    soil : callable, optional
        Soil at the true conditions.
    force : callable, optional
        Extra longitudinal force on the wheel in kN, positive forward, shape ``(N,)``.
    readings : callable, optional
        Readings to what the instruments show, of those that are not as they were.
    load_transfer : float
        Change of the normal load per drawbar pull, over the strength.
    """

    variant: str
    sentence: Callable[[float], str]
    low: float
    high: float
    signs: tuple[float, ...] = (1.0,)
    conditions: Callable[[float, Conditions], Conditions] | None = None
    soil: Callable[[float, Soil, Conditions], Soil] | None = None
    force: Callable[[float, Contact, Conditions], Array] | None = None
    readings: Callable[[float, Readings, Conditions, Contact], Readings] | None = None
    load_transfer: float = 0.0

    def at(self, strength: float) -> Mechanism:
        """Return the mechanism at a strength."""
        return Mechanism(self, strength)


@dataclass(frozen=True)
class Mechanism:
    """One physical cause at one strength."""

    family: Family
    strength: float

    @property
    def sentence(self) -> str:
        """What happens, for the key."""
        return self.family.sentence(self.strength)

    @property
    def load_transfer(self) -> float:
        """Change of the normal load per drawbar pull."""
        return self.family.load_transfer * self.strength

    def true_conditions(self, recorded: Conditions) -> Conditions:
        """Return the true conditions behind recorded ones."""
        act = self.family.conditions
        return recorded if act is None else act(self.strength, recorded)

    def changed_soil(self, soil: Soil, true: Conditions) -> Soil:
        """Return the soil as it is at the true conditions."""
        act = self.family.soil
        return soil if act is None else act(self.strength, soil, true)

    def force(self, contact: Contact, true: Conditions) -> Array | float:
        """Return the extra longitudinal force in kN, positive forward, shape ``(N,)``."""
        act = self.family.force
        return 0.0 if act is None else act(self.strength, contact, true)

    def shown(self, readings: Readings, recorded: Conditions, contact: Contact) -> Readings:
        """Return what the instruments show."""
        act = self.family.readings
        changed = {} if act is None else act(self.strength, readings, recorded, contact)
        return readings | changed


def bump(x: Array, centre: float, width: float) -> Array:
    """Return a normal curve of height one, any shape."""
    return np.asarray(np.exp(-0.5 * ((x - centre) / width) ** 2))


def step(x: Array, centre: float, width: float) -> Array:
    """Return a logistic curve from zero to one, any shape."""
    return np.asarray(1.0 / (1.0 + np.exp(-(x - centre) / width)))


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
