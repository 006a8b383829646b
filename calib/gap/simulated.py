"""A simulator at the rows of both campaigns: what it needs of their conditions is worked out once.

All hypotheses of a case share it: a fit predicts the same rows a thousand times.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from calib.data.quantities import QUANTITIES, role_of
from calib.gap.effects import View
from calib.models.base import Array
from calib.models.simulators.emulator import emulator_of

if TYPE_CHECKING:
    from calib.gap.campaigns import OutputData


# Physical roles of the outputs whose simulators may be bent over their conditions.
_BENT = ("density",)
# Axes of an emulator's error below so many times what it neglects itself are left out.
_FEWER = 3.0


class Simulated:
    """One output's simulator, with its inadequacy.

    Parameters
    ----------
    view : View
        Of the field campaign.
    pressures : tuple of float
        Least and greatest inflation pressure of both campaigns.

    Attributes
    ----------
    lab, field, both : dict of str to ndarray
        The model's conditions at the rows of a campaign; at the lab's, then the field's.
    columns : dict of str to str
        Those conditions, by physical role.
    priors : tuple of Prior
        Of the free parameters, named after the output.
    n_bends : int
        Coefficients of the inadequacy.
    n_errors : int
        Coefficients of an emulator's error, standard normal beforehand, which lab and field share.
        With them the likelihood is that of the calibration (`calib.inference.likelihood`), but
        that the error's size is everywhere that where the posteriors lie: worked out for each of
        a million parameter vectors it would cost more than all the rest.
    """

    def __init__(self, o: OutputData, view: View, pressures: tuple[float, float]) -> None:
        self._bound, self._priors, self._pressures = o.problem.bound, o.priors, pressures
        self._view = view
        self.priors = tuple(replace(p, name=f"{o.name}.{p.name}") for p in o.priors.free)
        self._ranges = _misfit_ranges(o)
        self.n_bends = len(self._ranges) * (len(self._ranges) + 1) // 2
        self.lab = o.problem.conditions
        self.field = self._bound.model.select(view.conditions)
        self.columns = {role_of(c): c for c in self.field}
        self.both = {k: np.concatenate([self.lab[k], v]) for k, v in self.field.items()}
        self._emulator = emulator_of(self._bound.model)
        self._mix = self._error_of(self.both)
        self.n_errors = self._mix.shape[1]
        self._known = [
            (c, (self._bound.prepare(c), self._bends(c))) for c in (self.lab, self.field, self.both)
        ]

    def conditions(self, view: View) -> dict[str, Array]:
        """Return the model's conditions of a view."""
        if view.conditions is self._view.conditions:
            return self.field
        return self._bound.model.select(view.conditions)

    def predict(self, t: Array, misfit: Array, conditions: Mapping[str, Array]) -> Array:
        """Predict on the scale of the response, shape (k, n).

        Parameters
        ----------
        t : ndarray, shape (k, d)
            Internal parameters.
        misfit : ndarray, shape (k, n_bends + n_errors)
            The former in the unit of the response.
        conditions : mapping of str to ndarray, shape (n,) or (k, n)
        """
        prepared = (found for known, found in self._known if known is conditions)
        rows, bends = next(prepared, None) or (None, self._bends(conditions))
        location = self._bound.mean_response(self._priors.to_natural(t), conditions, rows)
        for column, bend in enumerate(bends):
            location = location + misfit[:, column : column + 1] * bend
        return location

    def predict_beyond(self, t: Array, misfit: Array, conditions: Mapping[str, Array]) -> Array:
        """Predict where an effect may have taken the pressure beyond those of both campaigns.

        From there on the prediction goes on straight, as from the one end of their range to the
        other: the parabolas of the Magic Formula's coefficients are not to be trusted outside. Of
        33 true gauge errors (four seeds of the challenge) the rms error is 0.95 noise sds so, 1.5
        along the parabolas.
        """
        column = self._view.column("pressure") or ""
        pressure = conditions.get(column)
        low, high = self._pressures
        if pressure is None or low == high or pressure is self._view.conditions[column]:
            return self.predict(t, misfit, conditions)
        inside = np.clip(pressure, low, high)
        beyond = (pressure - inside) / (high - low)
        if not beyond.any():
            return self.predict(t, misfit, conditions)
        location = self.predict(t, misfit, {**conditions, column: inside})
        # Both ends in one call, each a pressure of all vectors, for the rows that any takes beyond.
        rows = np.flatnonzero(np.atleast_2d(beyond).any(axis=0))
        twice = np.concatenate([rows, rows])
        ends = {name: v[..., twice] for name, v in conditions.items()}
        ends[column] = np.repeat([low, high], rows.size)
        at_low, at_high = np.split(self.predict(t, misfit, ends), 2, axis=1)
        location[:, rows] += (at_high - at_low) * beyond[..., rows]
        return location

    def _error_of(self, conditions: Mapping[str, Array]) -> Array:
        """What the coefficients of the error make of an emulator's curves, shape (j, n_errors)."""
        if self._emulator is None:
            return np.zeros((0, 0))
        root = np.sqrt(self._emulator.typical_variances)
        at = self._emulator.curves_at(conditions)[:, 1:] * root
        at = at[np.isfinite(at).all(axis=1)]
        _, size, axes = np.linalg.svd(at, full_matrices=False)
        # What stays below is less than is ever looked into, of which each axis has its cost.
        kept = size > _FEWER * self._emulator.negligible * np.sqrt(max(len(at), 1))
        return np.asarray(root[:, None] * axes[kept].T)

    def _bends(self, conditions: Mapping[str, Array]) -> list[Array]:
        """What the coefficients of the inadequacy and the error multiply, (n,) or (k, n) each."""
        scaled = [
            np.clip((_even(name, conditions[name]) - mid) / half, -2.5, 2.5)
            for name, mid, half in self._ranges
        ]
        bends = [
            u * v - (1.0 / 3.0 if i == j else 0.0)
            for i, u in enumerate(scaled)
            for j, v in enumerate(scaled[: i + 1])
        ]
        if self._emulator is None or not self.n_errors:
            return bends
        errors = self._emulator.curves_at(conditions)[..., 1:] @ self._mix
        return bends + [errors[..., j] for j in range(self.n_errors)]


def _even(column: str, values: Array) -> Array:
    """A condition on the scale on which what depends on it is even."""
    if column in QUANTITIES and QUANTITIES[column].of_factors:
        return np.asarray(np.log(np.maximum(values, 1e-6)))
    return values


def _misfit_ranges(o: OutputData) -> tuple[tuple[str, float, float], ...]:
    """Conditions over which a simulator may be bent, with middle and half range in the lab."""
    if o.role not in _BENT:
        return ()
    found = []
    for name, values in o.problem.conditions.items():
        values = _even(name, values)
        half = 0.5 * float(np.ptp(values))
        if half > 1e-9 * max(1.0, float(np.abs(values).max())):
            found.append((name, 0.5 * float(values.max() + values.min()), half))
    return tuple(found)
