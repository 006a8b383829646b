"""Conditions and covariates scaled to the range of both campaigns."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from calib.gap.effects import View
from calib.models.base import Array

if TYPE_CHECKING:
    from calib.gap.case import Campaigns

__all__ = ["OVER", "Covariates"]

# What something may vary with by itself: the first of the columns that is recorded and varies.
OVER = {
    "slip": ("slip_ratio",), "order": ("run_order",), "speed": ("speed_m_s",),
    "passes": ("pass_number",), "load": ("normal_load_kn",), "cone": ("cone_index_kpa",),
    "water": ("gravimetric_water_content", "volumetric_water_content"),
    "pressure": ("inflation_pressure_psi", "average_ground_pressure_kpa"),
    "low_pressure": ("inflation_pressure_psi",),
}  # fmt: skip
# Conditions of which factors count, not differences.
_LOGS = frozenset({"speed_m_s", "pass_number", "normal_load_kn", "cone_index_kpa"})


class Covariates:
    """Covariates of a pair of campaigns on a scale of -1..1.

    Parameters
    ----------
    data : Campaigns
    """

    def __init__(self, data: Campaigns) -> None:
        self.data = data
        self._of_field: dict[str, Array | None] = {}

    @cached_property
    def _ranges(self) -> dict[str, Array]:
        lab = self.data.case.lab.columns
        return {
            name: np.concatenate([values, lab.get(name, values)])
            for name, values in self.data.view.conditions.items()
        }

    def over(self, view: View, what: str) -> Array | None:
        """What something varies with, a key of `OVER`, scaled, shape (n,); None if nothing does."""
        columns = (self.scaled(view, name) for name in OVER[what])
        return next((u for u in columns if u is not None), None)

    def scaled(self, view: View, name: str) -> Array | None:
        """A condition, or its logarithm, shape (n,); None where it is lacking or constant."""
        if view.conditions is not self.data.view.conditions:
            return self._scaled(view, name)
        # The field's own, which all hypotheses ask for, are worked out once.
        if name not in self._of_field:
            self._of_field[name] = self._scaled(view, name)
        return self._of_field[name]

    def _scaled(self, view: View, name: str) -> Array | None:
        if name not in view.conditions:
            return None
        values, reference = view.conditions[name], self._ranges[name]
        if name in _LOGS:
            values, reference = (
                np.log(np.maximum(values, 1e-6)),
                np.log(np.maximum(reference, 1e-6)),
            )
        if np.ptp(reference) < 1e-9 * max(1.0, abs(reference).max()):
            return None
        mid, half = 0.5 * (reference.max() + reference.min()), 0.5 * np.ptp(reference)
        return np.clip((values - mid) / half, -1.5, 1.5)
