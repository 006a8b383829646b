"""Conditions and covariates scaled to the range of both campaigns."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from calib.gap.case import Campaigns
from calib.gap.effects import View
from calib.models.base import Array

__all__ = ["Covariates"]


class Covariates:
    """Covariates of a pair of campaigns on a scale of -1..1.

    Parameters
    ----------
    data : Campaigns
    """

    def __init__(self, data: Campaigns) -> None:
        self.data = data

    @cached_property
    def _ranges(self) -> dict[str, Array]:
        lab = self.data.case.lab.columns
        return {
            name: np.concatenate([values, lab.get(name, values)])
            for name, values in self.data.view.conditions.items()
        }

    def scaled(self, view: View, name: str, transform: str = "") -> Array | None:
        """A condition, or its logarithm, shape (n,); None where it is lacking or constant."""
        if name not in view.conditions:
            return None
        values, reference = view.conditions[name], self._ranges[name]
        if transform == "log":
            values, reference = (
                np.log(np.maximum(values, 1e-6)),
                np.log(np.maximum(reference, 1e-6)),
            )
        if np.ptp(reference) < 1e-9 * max(1.0, abs(reference).max()):
            return None
        mid, half = 0.5 * (reference.max() + reference.min()), 0.5 * np.ptp(reference)
        return np.clip((values - mid) / half, -1.5, 1.5)

    def pressure(self, view: View) -> Array | None:
        """Inflation pressure, or else that on the ground, scaled to -1..1."""
        found = self.scaled(view, "inflation_pressure_psi")
        return self.scaled(view, "average_ground_pressure_kpa") if found is None else found
