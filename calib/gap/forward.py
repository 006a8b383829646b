"""The joint forward model of a hypothesis: simulator in the lab, with effects in the field.

The vector psi of a hypothesis stacks, all with (truncated) normal or uniform priors:

    simulator parameters of each output (internal coordinates)
    inadequacy of each simulator, in the lab and the field alike
    parameters of each effect
    form errors: the effect's size departs from its formula by 1 + sum_j c_j b_j(x)
    shifts of the simulator's parameters in the field (parameter_shift only)
    coefficients of a free smooth discrepancy (unknown only)
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from scipy.special import expit

from calib.gap.case import Campaigns, OutputData
from calib.gap.effects import Effect, View
from calib.gap.effects.base import RUT
from calib.models.base import Array
from calib.priors import Prior, Priors
from calib.sampling.mode import prior_widths

__all__ = ["FORM_ERROR", "Forward", "Hypothesis", "OnsetOver", "SmoothOver"]

type SmoothOver = Literal["slip", "level", "sinkage", "order", "all"]
type OnsetOver = Literal["slip", "level", "sinkage", "order", "low_pressure"]

# Relative size by which a formula may misrepresent its effect along one direction.
FORM_ERROR = 0.3
# Inadequacy of a simulator at the end of the lab's range of a condition, in noise sds.
MISFIT = 1.0
MISFIT_OUTPUTS = ("bulk_density",)
# Where a discrepancy may set in, and how sharply, on a covariate scaled to -1..1.
_THRESHOLDS = (-0.85, 0.9)
_ONSET_WIDTH = 0.06
# Shifts of how a parameter varies with pressure or slip, relative to those of its value.
SHIFT_DIFFERENCE = 0.2


@dataclass(frozen=True)
class Hypothesis:
    """What may cause the gap.

    Parameters
    ----------
    name : str
        Contract name, pairs in alphabetical order.
    effects : tuple of Effect
    effect_priors : tuple of Priors
    shift : float
        Prior sd of parameter shifts in units of the parameters' own prior sds; 0 for none.
    smooth : float
        Prior sd of a free discrepancy, in units of the noise; 0 for none.
    smooth_outputs : tuple of str
        Outputs that have the free discrepancy.
    smooth_over : {"slip", "level", "sinkage", "order", "all"}
        What it may vary with: slip, the level of the predicted output (as a saturating
        instrument would), the predicted rut depth (as layered soil would), the order of the runs
        (as weather or another stretch of ground would), or every condition.
    smooth_decay : float
        Number of half waves from which the discrepancy's coefficients fall off.
    onset_over : {"slip", "level", "sinkage", "order", "low_pressure"}, optional
        Instead of smooth, the discrepancy may set in beyond a threshold of one of these: a step
        and a change of slope there. Below a threshold of inflation pressure, where a limp tyre may
        creep on its rim or buckle: a step, and a part of the output's level.
    share : float
        Part of the prior probability of its name.
    """

    name: str
    effects: tuple[Effect, ...] = ()
    effect_priors: tuple[Priors, ...] = ()
    shift: float = 0.0
    smooth: float = 0.0
    smooth_outputs: tuple[str, ...] = ()
    smooth_over: SmoothOver = "all"
    smooth_decay: float = 4.0
    onset_over: OnsetOver | None = None
    share: float = 1.0


class Forward:
    """Predictions and priors of a hypothesis on a pair of campaigns.

    Parameters
    ----------
    data : Campaigns
    hypothesis : Hypothesis
    noise : mapping of str to float
        Typical noise sd of each output on the scale of the response; the unit of a free
        discrepancy.
    lab_mode : mapping of str to ndarray, optional
        Internal parameters of the simulators as the lab calibrated them; for a discrepancy that
        varies with the level of the output.
    """

    def __init__(
        self,
        data: Campaigns,
        hypothesis: Hypothesis,
        noise: Mapping[str, float],
        lab_mode: Mapping[str, Array] | None = None,
    ) -> None:
        self.lab_mode = lab_mode or {}
        self.data = data
        self.hypothesis = hypothesis
        self.noise = noise
        entries: list[Prior] = []
        self.theta_slices: dict[str, slice] = {}
        for o in data.outputs:
            self.theta_slices[o.name] = _append(entries, o.priors.free, o.name)
        self.misfit_slices: dict[str, slice] = {}
        self._misfit_ranges: dict[str, tuple[tuple[str, float, float], ...]] = {}
        for o in data.outputs:
            self._misfit_ranges[o.name] = ranges = _misfit_ranges(o)
            m = len(ranges) * (len(ranges) + 1) // 2
            bends = [_normal("misfit", MISFIT * noise[o.name])] * m
            self.misfit_slices[o.name] = _append(entries, bends, o.name)
        self.phi_slices = [
            _append(entries, p.free, e.name)
            for e, p in zip(hypothesis.effects, hypothesis.effect_priors, strict=True)
        ]
        # Worked out once for the field rows, which every step of a fit predicts.
        self._field_form = self._form_basis(data.view)
        self._field_smooth = {
            name: self._smooth_basis(data.view, name) for name in hypothesis.smooth_outputs
        }
        self.form_slices: dict[str, slice] = {}
        for o in data.outputs:
            m = self._field_form.shape[1]
            self.form_slices[o.name] = _append(entries, [_normal("form", FORM_ERROR)] * m, o.name)
        self.shift_slices: dict[str, slice] = {}
        self._shift_maps: dict[str, Array] = {}
        for o in data.outputs:
            if hypothesis.shift > 0.0:
                widths = prior_widths(o.priors)
                self._shift_maps[o.name], relative = _shift_map(o.priors.names)
                shifts = [
                    _normal("shift", hypothesis.shift * w * r)
                    for w, r in zip(widths, relative, strict=True)
                ]
                self.shift_slices[o.name] = _append(entries, shifts, o.name)
        self.smooth_slices: dict[str, slice] = {}
        for o in data.outputs:
            if o.name in hypothesis.smooth_outputs:
                weights = self._field_smooth[o.name][1]
                sd = hypothesis.smooth * noise[o.name]
                self.smooth_slices[o.name] = _append(
                    entries, [_normal("smooth", sd * w) for w in weights], o.name
                )
        self.threshold = len(entries)
        if hypothesis.onset_over is not None:
            entries.append(_uniform("threshold", *_THRESHOLDS))
        self.priors = Priors(tuple(entries))

    @property
    def n_dim(self) -> int:
        """Length of psi."""
        return len(self.priors.free)

    @cached_property
    def _ranges(self) -> dict[str, Array]:
        lab = self.data.case.lab.columns
        return {
            name: np.concatenate([values, lab.get(name, values)])
            for name, values in self.data.view.conditions.items()
        }

    def _scaled(self, view: View, name: str, transform: str = "") -> Array | None:
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

    def _pressure(self, view: View) -> Array | None:
        """Inflation pressure, or else that on the ground, scaled to -1..1."""
        found = self._scaled(view, "inflation_pressure_psi")
        return self._scaled(view, "average_ground_pressure_kpa") if found is None else found

    def _form(self, view: View) -> Array:
        same = view.conditions is self.data.view.conditions
        return self._field_form if same else self._form_basis(view)

    def _discrepancy(self, psi: Array, view: View, name: str) -> Array:
        """Free discrepancy of an output, shape (k, n)."""
        amplitudes = psi[:, self.smooth_slices[name]]
        if self.hypothesis.onset_over is None:
            return amplitudes @ self._smooth(view, name).T
        step, bend = self.onset(view, name, psi[:, self.threshold])
        return amplitudes[:, :1] * step + amplitudes[:, 1:2] * bend

    def onset(self, view: View, output: str, threshold: Array) -> tuple[Array, Array]:
        """Step and bend of a discrepancy that sets in at thresholds (k,), shapes (k, n).

        Below a pressure it is a step and a part of the output's level instead.
        """
        u = self.onset_covariate(view, output)
        beyond = (u - threshold[:, None]) / _ONSET_WIDTH
        step = expit(beyond)
        if self.hypothesis.onset_over == "low_pressure":
            # A limp tyre may lose a part of the pull, and more of it the more it pulls.
            return step, step * self._known(self._level(view, output))
        return step, _ONSET_WIDTH * np.logaddexp(0.0, beyond)

    def onset_covariate(self, view: View, output: str) -> Array:
        """What a sudden discrepancy sets in over, scaled to -1..1, shape (n,)."""
        over = self.hypothesis.onset_over
        if over == "low_pressure":
            return -self._known(self._pressure(view))
        if over in ("level", "sinkage"):
            return self._known(self._level(view, output if over == "level" else RUT))
        return self._known(self._scaled(view, "slip_ratio" if over == "slip" else "run_order"))

    def _known(self, u: Array | None) -> Array:
        if u is None:
            raise ValueError(f"nothing to set in over: {self.hypothesis.onset_over}")
        return u

    def _smooth(self, view: View, output: str) -> Array:
        same = view.conditions is self.data.view.conditions
        return (self._field_smooth[output] if same else self._smooth_basis(view, output))[0]

    def _form_basis(self, view: View) -> Array:
        """Basis of the form error, shape (n, m)."""
        wanted = {kind for e in self.hypothesis.effects for kind in e.form}
        n = view.slip().size
        basis: list[Array] = []
        slip = self._scaled(view, "slip_ratio")
        pressure = self._pressure(view)
        if "size" in wanted:
            basis.append(np.ones(n))
        if "slip" in wanted and slip is not None:
            basis += [slip, 1.5 * slip**2 - 0.5]
        if "pressure" in wanted and pressure is not None:
            basis.append(pressure)
        for kind, name, transform in (
            ("cone", "cone_index_kpa", "log"),
            ("water", "gravimetric_water_content", ""),
            ("water", "volumetric_water_content", ""),
        ):
            values = self._scaled(view, name, transform) if kind in wanted else None
            if values is not None:
                basis.append(values)
        if "shape" in wanted:
            for e in self.hypothesis.effects:
                values = e.shape(view) if "shape" in e.form else None
                reference = e.shape(self.data.view) if values is not None else None
                if values is not None and reference is not None and np.ptp(reference) > 1e-9:
                    mid = 0.5 * (reference.max() + reference.min())
                    basis.append(np.clip((values - mid) / (0.5 * np.ptp(reference)), -1.5, 1.5))
        return np.stack(basis, axis=1) if basis else np.empty((n, 0))

    def _smooth_basis(self, view: View, output: str) -> tuple[Array, Array]:
        """Basis of an output's free discrepancy, shape (n, m), and its coefficients' sds."""
        over = self.hypothesis.smooth_over
        if self.hypothesis.onset_over is not None:
            # Its shape depends on the threshold; here are its two amplitudes.
            return np.empty((0, 2)), np.array([1.0, 2.0])
        if over in ("level", "sinkage"):
            terms = self._cosines(self._level(view, output if over == "level" else RUT), 8, 0.8)
        elif over == "order":
            terms = self._cosines(self._scaled(view, "run_order"), 12, 0.7)
        else:
            terms = self._condition_terms(view, everything=over == "all")
        n = next(iter(view.conditions.values())).size
        basis = [np.ones(n)] + [b for b, _ in terms]
        return np.stack(basis, axis=1), np.array([1.0] + [w for _, w in terms])

    def _condition_terms(self, view: View, *, everything: bool) -> list[tuple[Array, float]]:
        slip = self._scaled(view, "slip_ratio")
        pressure = self._pressure(view)
        slips = self._cosines(slip, 10, 0.7)
        terms = list(slips)
        if everything:
            terms += self._cosines(self._scaled(view, "run_order"), 6, 0.5)
        if pressure is not None:
            terms.append((pressure, 0.7))
            terms += [(pressure * b, 0.6 * w) for b, w in slips[:4]]
        for name, transform in (
            ("speed_m_s", "log"), ("pass_number", "log"), ("gravimetric_water_content", ""),
            ("normal_load_kn", "log"), ("cone_index_kpa", "log"),
            ("volumetric_water_content", ""),
        ):  # fmt: skip
            u = self._scaled(view, name, transform)
            if u is not None and everything:
                terms += self._cosines(u, 3, 0.4)
                if slip is not None:
                    terms.append((u * slip, 0.4))
        return terms

    def _cosines(self, u: Array | None, most: int, scale: float) -> list[tuple[Array, float]]:
        """Cosines of a covariate scaled to -1..1, and the sds of their coefficients."""
        if u is None:
            return []
        angle = 0.5 * np.pi * (np.clip(u, -1.2, 1.2) + 1.0)
        return [
            (
                np.sqrt(2.0) * np.cos(j * angle),
                scale / (1.0 + (j / self.hypothesis.smooth_decay) ** 2),
            )
            for j in range(1, most + 1)
        ]

    def _level(self, view: View, output: str) -> Array | None:
        """Predicted level of an output, scaled to the field's range."""
        if output not in self.lab_mode:
            return None
        o = next(o for o in self.data.outputs if o.name == output)
        theta = o.priors.to_natural(self.lab_mode[output][None])

        def predicted(conditions: Mapping[str, Array]) -> Array:
            selected = o.problem.bound.model.select(conditions)
            return np.asarray(o.problem.bound.location(theta, selected)[0])

        reference = predicted(self.data.view.conditions)
        low, high = float(np.nanmin(reference)), float(np.nanmax(reference))
        level = np.nan_to_num(predicted(view.conditions), nan=low)
        return np.clip((level - low) / max(high - low, 1e-12) * 2.0 - 1.0, -1.5, 1.5)

    def theta(self, psi: Array, output: str, *, field: bool) -> Array:
        """Natural simulator parameters, shape (k, d)."""
        index = [o.name for o in self.data.outputs].index(output)
        o = self.data.outputs[index]
        t = psi[:, self.theta_slices[output]]
        if field and output in self.shift_slices:
            t = t + psi[:, self.shift_slices[output]] @ self._shift_maps[output].T
        return o.priors.to_natural(t)

    def _predict(
        self, o: OutputData, theta: Array, psi: Array, conditions: Mapping[str, Array]
    ) -> Array:
        """Simulator and its inadequacy at conditions, on the scale of the response."""
        location = o.problem.bound.location(theta, conditions)
        misfit = psi[:, self.misfit_slices[o.name]]
        if not misfit.shape[1]:
            return location
        scaled = [
            np.clip((_LOGS.get(name, _same)(conditions[name]) - mid) / half, -2.5, 2.5)
            for name, mid, half in self._misfit_ranges[o.name]
        ]
        column = 0
        for i, u in enumerate(scaled):
            for j, v in enumerate(scaled[: i + 1]):
                bend = u * v - (1.0 / 3.0 if i == j else 0.0)
                location = location + misfit[:, column : column + 1] * bend
                column += 1
        return location

    def lab(self, psi: Array) -> dict[str, Array]:
        """Predict the lab rows on the scale of the response, shapes (k, n_lab)."""
        return {
            o.name: self._predict(
                o, self.theta(psi, o.name, field=False), psi, o.problem.conditions
            )
            for o in self.data.outputs
        }

    def simulator(self, psi: Array, view: View) -> dict[str, Array]:
        """Predict with the calibrated simulator alone, on the scale of the response."""
        return {
            o.name: self._predict(
                o, self.theta(psi, o.name, field=False), psi,
                o.problem.bound.model.select(view.conditions),
            )
            for o in self.data.outputs
        }  # fmt: skip

    def field(self, psi: Array, view: View) -> dict[str, Array]:
        """Predict field rows with the hypothesis in force, on the scale of the response."""
        plain: dict[str, Array] = {}
        for o in self.data.outputs:
            theta = self.theta(psi, o.name, field=True)
            conditions = o.problem.bound.model.select(view.conditions)
            plain[o.name] = self._predict(o, theta, psi, conditions)
        if self.hypothesis.effects:
            plain = self._with_effects(psi, view, plain)
        if self.smooth_slices:
            plain = {
                name: location + self._discrepancy(psi, view, name)
                if name in self.smooth_slices
                else location
                for name, location in plain.items()
            }
        return plain

    def _with_effects(self, psi: Array, view: View, plain: dict[str, Array]) -> dict[str, Array]:
        outputs = {o.name: o for o in self.data.outputs}
        base = {name: outputs[name].problem.bound.from_response(v) for name, v in plain.items()}
        view = replace(view, base=base)
        phis = [
            p.to_natural(psi[:, s])
            for p, s in zip(self.hypothesis.effect_priors, self.phi_slices, strict=True)
        ]
        form = self._form(view)
        changed = {}
        for name, o in outputs.items():
            original: dict[str, Array] = o.problem.bound.model.select(view.conditions)
            conditions = original
            for effect, phi in zip(self.hypothesis.effects, phis, strict=True):
                conditions = effect.on_conditions(phi, name, conditions, view)
            location = plain[name]
            if conditions is not original:
                theta = self.theta(psi, name, field=True)
                location = self._predict(o, theta, psi, conditions)
            for effect, phi in zip(self.hypothesis.effects, phis, strict=True):
                location = effect.on_output(phi, name, location, view)
            if form.shape[1]:
                factor = 1.0 + psi[:, self.form_slices[name]] @ form.T
                location = plain[name] + (location - plain[name]) * factor
            changed[name] = location
        return changed


def _same(values: Array) -> Array:
    return values


def _ln(values: Array) -> Array:
    return np.asarray(np.log(np.maximum(values, 1e-6)))


# Conditions whose effect is even on the logarithm.
_LOGS = {"cone_index_kpa": _ln, "average_ground_pressure_kpa": _ln}


def _misfit_ranges(o: OutputData) -> tuple[tuple[str, float, float], ...]:
    """Conditions over which a simulator may be bent, with middle and half range in the lab."""
    if o.name not in MISFIT_OUTPUTS:
        return ()
    found = []
    for name, values in o.problem.conditions.items():
        values = _LOGS.get(name, _same)(values)
        half = 0.5 * float(np.ptp(values))
        if half > 1e-9 * max(1.0, float(np.abs(values).max())):
            found.append((name, 0.5 * float(values.max() + values.min()), half))
    return tuple(found)


def _shift_map(names: tuple[str, ...]) -> tuple[Array, list[float]]:
    """Map shift coordinates to shifts of parameters, and the relative sds of the coordinates.

    Another soil changes the traction curve at all pressures, and the exponent of sinkage at all
    slips, much alike: the values at the two end pressures share one shift, and differ by less, as
    the bends between them and the exponent's growth with slip (n1) do.
    """
    matrix = np.eye(len(names))
    varies = [name.endswith("_bend") or name == "n1" for name in names]
    relative = [SHIFT_DIFFERENCE if v else 1.0 for v in varies]
    for i, name in enumerate(names):
        if name.endswith("_lo") and f"{name[:-3]}_hi" in names:
            j = names.index(f"{name[:-3]}_hi")
            matrix[i, j], matrix[j, i], matrix[j, j] = -1.0, 1.0, 1.0
            relative[j] = SHIFT_DIFFERENCE
    return matrix, relative


def _append(entries: list[Prior], new: list[Prior] | tuple[Prior, ...], prefix: str) -> slice:
    start = len(entries)
    entries += [replace(p, name=f"{prefix}.{p.name}") for p in new]
    return slice(start, len(entries))


def _uniform(name: str, lower: float, upper: float) -> Prior:
    return Prior(
        name, "1", "", "", f"uniform({lower:g}, {upper:g})", False, 0.5 * (lower + upper), np.inf,
        lower, upper,
    )  # fmt: skip


def _normal(name: str, sd: float) -> Prior:
    return Prior(name, "1", "", "", f"normal(0, {sd:g})", False, 0.0, sd)
