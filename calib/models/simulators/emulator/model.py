"""A model whose equation is an emulator."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calib.models.base import Array, Columns, Conditions, Model, References, Rows, not_given
from calib.models.simulators.emulator.emulator import Emulator

__all__ = ["emulated_model", "emulator_of"]


@dataclass(frozen=True)
class _Prepare:
    """The basis curves at conditions: all of them that the emulator needs."""

    emulator: Emulator

    def __call__(self, conditions: Conditions, references: References) -> Rows:
        found = self.emulator.curves_at(conditions)
        return {str(j): np.ascontiguousarray(found[..., j]) for j in range(found.shape[-1])}


@dataclass(frozen=True)
class _Location:
    """Mean curve plus coefficients times curves."""

    emulator: Emulator

    def __call__(self, columns: Columns, rows: Rows, references: References, work: Array) -> Array:
        theta = np.stack([np.ravel(c) for c in columns], axis=-1)
        coefficients = self.emulator.coefficients(theta)
        shape = columns[0].shape
        found = rows["0"] + np.zeros(shape)
        for j, c in enumerate(coefficients.T, start=1):
            found += c.reshape(shape) * rows[str(j)]
        return np.asarray(found)


@dataclass(frozen=True)
class _Uncertain:
    """The prediction, and its error: how much of what is unknown far away, and its curves."""

    emulator: Emulator

    def __call__(self, theta: Array, conditions: Conditions) -> tuple[Array, Array, Array]:
        means, unknown = self.emulator.with_unknown(theta)
        at = self.emulator.curves_at(conditions)
        curves = at[:, 1:] * np.sqrt(self.emulator.variances)
        return at[:, 0] + means @ at[:, 1:].T, unknown, curves


def emulated_model(model: Model, emulator: Emulator) -> Model:
    """Return a model with an emulator in the place of its equation."""
    return replace(
        model, predict=None, prepare=_Prepare(emulator), location=_Location(emulator),
        uncertain=_Uncertain(emulator), report_theta=not_given,
    )  # fmt: skip


def emulator_of(model: Model) -> Emulator | None:
    """Return the emulator behind a model; None if there is none."""
    return model.location.emulator if isinstance(model.location, _Location) else None
