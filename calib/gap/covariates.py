"""Conditions and covariates scaled to the range of both campaigns."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from calib.data.quantities import QUANTITIES, columns_of
from calib.gap.effects import View
from calib.models.base import Array

if TYPE_CHECKING:
    from calib.gap.campaigns import Campaigns


# What something may vary with by itself, where it is not just one physical role: the first of them
# that is recorded and varies.
_OVER = {
    "water": ("water", "water_by_volume"), "pressure": ("pressure", "ground_pressure"),
    "low_pressure": ("pressure",),
}  # fmt: skip
# Roles of which a discrepancy knows what they may do.
_KNOWN = ("slip", "order", "speed", "passes", "load", "cone", "ground_pressure",
          "water_by_volume", *_OVER)  # fmt: skip


def columns_over(what: str) -> tuple[str, ...]:
    """Return the columns of what something may vary with, the one to be preferred first."""
    return tuple(c for role in _OVER.get(what, (what,)) for c in columns_of(role) or (role,))


def other_conditions(view: View) -> tuple[str, ...]:
    """Return the roles of recorded conditions of which nothing more is known."""
    recorded = [QUANTITIES[c] for c in view.conditions if c in QUANTITIES]
    roles = [q.physical for q in recorded if q.role == "condition" and q.physical not in _KNOWN]
    return tuple(dict.fromkeys(roles))


class Covariates:
    """Covariates of a pair of campaigns on a scale of -1..1."""

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
        """What something varies with (see `columns_over`), scaled, shape (n,); None if nothing."""
        columns = (self.scaled(view, name) for name in columns_over(what))
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
        if name not in view.conditions or name not in self._ranges:
            return None  # of conditions to predict, what the campaigns do not have explains nothing
        values, reference = view.conditions[name], self._ranges[name]
        if name in QUANTITIES and QUANTITIES[name].of_factors:
            values, reference = (
                np.log(np.maximum(values, 1e-6)),
                np.log(np.maximum(reference, 1e-6)),
            )
        if np.ptp(reference) < 1e-9 * max(1.0, abs(reference).max()):
            return None
        mid, half = 0.5 * (reference.max() + reference.min()), 0.5 * np.ptp(reference)
        return np.clip((values - mid) / half, -1.5, 1.5)
