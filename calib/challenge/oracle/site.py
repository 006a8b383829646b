"""Many realities on one field at once: the wheel is settled for all of them together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from itertools import batched

import numpy as np
from numpy.typing import NDArray

from calib.challenge.contact import Contact, settle
from calib.challenge.density import ConeLaw
from calib.challenge.mechanics import Reality
from calib.challenge.mechanism import DENSITY, DRAWBAR, RUT, Conditions, Readings
from calib.challenge.soil import Soil
from calib.challenge.stage import Stage

type Array = NDArray[np.float64]

_NUMBERS = tuple(field.name for field in fields(Soil) if not field.name.endswith("_law"))
_TRANSFER_STEPS, _SETTLED_KN = 8, 1e-7
_TOGETHER = 40  # few enough for the intermediate arrays to stay in the processor's cache


@dataclass(frozen=True)
class _Cause:
    """A reality as it meets the wheel: true conditions, the soil, what they give the wheel."""

    reality: Reality
    true: Conditions
    soil: Soil

    @property
    def transfer(self) -> float:
        return sum(m.load_transfer for m in self.reality.mechanisms)

    def settles_as(self, stage: Stage) -> bool:
        """Whether the wheel stands in the ground as it does without any mechanism."""
        same = (
            self.true.slip is stage.field.slip,
            self.true.inflation_kpa is stage.field.inflation_kpa,
            self.true.load_kn is stage.field.load_kn,
            self.soil is stage.reality.soil,
            self.reality.tyre is stage.reality.tyre,
        )
        return all(same) and not self.transfer


class Site:
    """The field of a stage.

    Parameters
    ----------
    stage : Stage
        Design and undisturbed reality.

    Attributes
    ----------
    stage : Stage
        As given.
    size : int
        Readings in the field, ``M``: the outputs in their order, rows within.
    """

    def __init__(self, stage: Stage) -> None:
        self.stage = stage
        self.size = len(stage.design.outputs) * stage.field.size
        self._slip = self._true_slip(stage.field)
        self._cone = stage.reality.cone
        self._undisturbed = self._cone.density(
            stage.field.cone_index_kpa, stage.field.water_content
        )
        self._contact = settle(
            stage.reality.soil, stage.reality.tyre, self._slip,
            stage.field.inflation_kpa, stage.field.load_kn,
        )  # fmt: skip

    def _true_slip(self, true: Conditions) -> Array:
        return np.asarray(1.0 - (1.0 - true.slip) * (1.0 - self.stage.field_zero))

    def residual(self, readings: Readings) -> Array:
        """Return readings less those without mechanism, in noise sd, shape ``(M,)``."""
        return self.stage.gap(readings)

    def gaps(self, realities: Sequence[Reality]) -> Array:
        """Return what realities add to the readings, in noise sd.

        Parameters
        ----------
        realities : sequence of Reality
            Soils that differ in numbers, not in laws, from the stage's.

        Returns
        -------
        array
            Shape ``(len(realities), M)``; the same as `Stage.gap` of `Stage.in_field`.
        """
        causes = [self._cause(reality) for reality in realities]
        moved = [i for i, cause in enumerate(causes) if not cause.settles_as(self.stage)]
        still = [i for i in moved if not causes[i].transfer]
        shifting = [i for i in moved if causes[i].transfer]
        contacts: dict[int, Contact] = {}
        for group in (still, shifting):
            for few in batched(group, _TOGETHER):
                contacts |= zip(few, self._settle([causes[i] for i in few]), strict=True)
        found = np.empty((len(causes), self.size))
        for i, cause in enumerate(causes):
            found[i] = self.stage.gap(self._read(cause, contacts.get(i, self._contact)))
        return found

    def moves(self, reality: Reality) -> bool:
        """Whether the wheel has to be settled anew in a reality."""
        return not self._cause(reality).settles_as(self.stage)

    def _cause(self, reality: Reality) -> _Cause:
        true, soil = self.stage.field, reality.soil
        for mechanism in reality.mechanisms:
            true = mechanism.conditions(true)
        for mechanism in reality.mechanisms:
            soil = mechanism.soil(soil, true)
        return _Cause(reality, true, soil)

    def _settle(self, causes: Sequence[_Cause]) -> list[Contact]:
        """Settle the wheel for all causes; load and pull are iterated where they interact."""
        n = self.stage.field.size
        slip = np.concatenate([self._true_slip(cause.true) for cause in causes])
        inflation = np.concatenate([cause.true.inflation_kpa for cause in causes])
        given = np.concatenate([cause.true.load_kn for cause in causes])
        lengths = np.repeat([cause.reality.tyre.length_factor for cause in causes], n)
        tyre = replace(self.stage.reality.tyre, length_factor=lengths)  # type: ignore[arg-type]
        soil, transfer = stacked([c.soil for c in causes], n), causes[0].transfer
        load, near = given, np.tile(self._contact.sinkage_m, len(causes))
        for _ in range(_TRANSFER_STEPS if transfer else 1):
            together = settle(soil, tyre, slip, inflation, load, near)
            parts = [_part(together, i * n, (i + 1) * n) for i in range(len(causes))]
            if not transfer:
                break
            added = [c.transfer * _pull(c, part) for c, part in zip(causes, parts, strict=True)]
            near = together.sinkage_m
            old, load = load, np.maximum(given + np.concatenate(added), 0.2 * given)
            if np.max(np.abs(load - old)) < _SETTLED_KN:
                break
        return parts

    def _density(self, cone: ConeLaw, true: Conditions) -> Array:
        field = self.stage.field
        probed = true.cone_index_kpa is field.cone_index_kpa
        if probed and true.water_content is field.water_content and cone is self._cone:
            return self._undisturbed
        return cone.density(true.cone_index_kpa, true.water_content)

    def _read(self, cause: _Cause, contact: Contact) -> Readings:
        readings: Readings = {
            DRAWBAR: _pull(cause, contact),
            RUT: 1e3 * contact.sinkage_m,
            DENSITY: self._density(cause.reality.cone, cause.true),
        }
        for mechanism in cause.reality.mechanisms:
            readings = mechanism.readings(readings, self.stage.field, contact)
        return readings


def _pull(cause: _Cause, contact: Contact) -> Array:
    forces = sum(m.force(contact, cause.true) for m in cause.reality.mechanisms)
    return np.asarray(contact.pull_kn + forces, dtype=np.float64)


def stacked[L: (Soil, ConeLaw)](laws: Sequence[L], n: int) -> L:
    """Return laws one below the other, ``n`` rows each; numbers alone, their words must agree."""
    changed: dict[str, Array] = {}
    for field in fields(laws[0]):
        if not isinstance(getattr(laws[0], field.name), str):
            rows = np.empty((len(laws), n))
            for i, law in enumerate(laws):
                rows[i] = getattr(law, field.name)
            changed[field.name] = rows.ravel()
    return replace(laws[0], **changed)  # type: ignore[arg-type]


def _part(contact: Contact, first: int, last: int) -> Contact:
    """Return some rows of a contact."""
    rows = slice(first, last)
    soil = replace(contact.soil, **{name: getattr(contact.soil, name)[rows] for name in _NUMBERS})
    arrays = {f.name: getattr(contact, f.name)[rows] for f in fields(Contact) if f.name != "soil"}
    return Contact(soil=soil, **arrays)
