"""The joint forward model of a hypothesis: simulator in the lab, with effects in the field.

The vector psi of a hypothesis stacks, all with (truncated) normal or uniform priors:

    simulator parameters of each output (internal coordinates)
    inadequacy of each simulator, in the lab and the field alike
    parameters of each effect
    form errors of each effect: what it adds is its formula's times max(1 + sum_j c_j b_j(x), 0)
    shifts of the simulator's parameters in the field (parameter_shift only)
    coefficients of a free smooth discrepancy (unknown only)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property, lru_cache

import numpy as np

from calib.data.quantities import columns_of
from calib.gap.campaigns import Campaigns
from calib.gap.departed import Idle, departed_of_all
from calib.gap.discrepancy import THRESHOLDS, Bases, Discrepancy
from calib.gap.effects import Effect, View
from calib.gap.hypothesis import Hypothesis
from calib.gap.shifts import ShiftMap, shift_map
from calib.inference.priors import Prior, Priors
from calib.models.base import Array

# Relative size by which a formula may misrepresent its effect along one direction: the effect's
# size, its tilt and bend over slip, its tilt over other conditions. Estimated from the true
# effects in 690 single-effect cases of `calib challenge make` (seeds 271828, 577215, 314159,
# 173205, 602214), pull and rut: 0.13 and 0.12 over slip, 0.08 and 0.06 its bend, 0.12 and 0.06
# over pressure, 0.28 and 0.16 where a gauge's error takes a simulator to pressures it was not
# fitted at (less since it goes on straight there, see `Simulated.predict_beyond`), 0.18 and 0.17
# over what the effect is named for; density: 0.16 over cone index, 0.06 over water content.
FORM_ERROR = {
    "size": 0.2, "slip": 0.15, "bend": 0.1, "pressure": 0.13, "cone": 0.15, "water": 0.1,
    "shape": 0.18, "extrapolation": 0.2,
}  # fmt: skip
# Inadequacy of a simulator at the end of the lab's range of a condition, in noise sds.
MISFIT = 1.0
_NONE: Idle = {}
# A prediction without a value is none, whatever the warnings.
_SILENT = np.errstate(all="ignore")


class Forward:
    """Predictions and priors of a hypothesis on a pair of campaigns.

    Parameters
    ----------
    noise : mapping of str to float
        Typical noise sd of each output on the scale of the response; the unit of a free
        discrepancy.
    lab_mode : mapping of str to ndarray, optional
        Internal parameters of the simulators as the lab calibrated them; for a discrepancy that
        varies with the level of the output.
    shift : ShiftMap, optional
        What the coordinates of a shift do, as `shift_map` once gave.
    bases : dict, optional
        Where to keep what free discrepancies of the same case and `lab_mode` share.
    """

    def __init__(
        self,
        data: Campaigns,
        hypothesis: Hypothesis,
        noise: Mapping[str, float],
        lab_mode: Mapping[str, Array] | None = None,
        shift: ShiftMap | None = None,
        bases: Bases | None = None,
    ) -> None:
        self.data = data
        self.hypothesis = hypothesis
        self.noise = noise
        self.simulated = data.simulated
        self.roles = {o.name: o.role for o in data.outputs}
        entries: list[Prior] = []
        self.theta_slices = {name: _append(entries, s.priors) for name, s in self.simulated.items()}
        self.misfit_slices = {
            name: _append(
                entries,
                [_normal(f"{name}.misfit", MISFIT * noise[name])] * s.n_bends
                + [_normal(f"{name}.emulator", 1.0)] * s.n_errors,
            )
            for name, s in self.simulated.items()
        }
        self.phi_slices = [
            _append(entries, _named(e.name, p))
            for e, p in zip(hypothesis.effects, hypothesis.effect_priors, strict=True)
        ]
        self.covariates = data.covariates
        self.discrepancy = Discrepancy(data, hypothesis, lab_mode or {}, bases)
        forms = [self._form_of_field(e) for e in hypothesis.effects]
        self._field_form = [basis for basis, _ in forms]
        # Of each effect in each output that it touches; elsewhere it has none.
        self.form_slices: dict[str, list[slice]] = {
            o.name: [
                _append(
                    entries,
                    [_normal(f"{o.name}.{e.name}.form", sd) for sd in sds if o.role in e.outputs],
                )
                for e, (_, sds) in zip(hypothesis.effects, forms, strict=True)
            ]
            for o in data.outputs
        }
        self.shift_slice = slice(len(entries), len(entries))
        self.shift: ShiftMap | None = None
        if hypothesis.shift > 0.0:
            kind, kept = hypothesis.shift_as, data.shift_maps
            if kind not in kept:
                kept[kind] = shift_map(data.outputs, kind)
            current, relative = kept[kind]
            self.shift = current if shift is None else shift
            shifts = [_normal("field.shift", hypothesis.shift * sd) for sd in relative]
            self.shift_slice = _append(entries, shifts)
        self.smooth_slices: dict[str, slice] = {}
        for o in data.outputs:
            if o.name in hypothesis.smooth_outputs:
                sd = hypothesis.smooth * noise[o.name]
                weights = self.discrepancy.sds(o.name).tolist()
                amplitudes = [_normal(f"{o.name}.smooth", sd * w) for w in weights]
                self.smooth_slices[o.name] = _append(entries, amplitudes)
        self.threshold = len(entries)
        self.smooth = slice(self.shift_slice.stop, self.threshold)
        if hypothesis.onset_over is not None:
            entries.append(_uniform("threshold", *THRESHOLDS))
        self.priors = Priors(tuple(entries))

    @cached_property
    def n_shared(self) -> int:
        """Length of the first part of psi, which is that of the simulators."""
        return int(max(part.stop for part in self.misfit_slices.values()))

    @property
    def n_dim(self) -> int:
        """Length of psi."""
        return len(self.priors.free)

    def form(self, view: View) -> list[Array]:
        """Basis of each effect's form error, shapes (n, m)."""
        if view.conditions is self.data.view.conditions:
            return self._field_form
        return [self._form_basis(e, view)[0] for e in self.hypothesis.effects]

    def _form_of_field(self, effect: Effect) -> tuple[Array, list[float]]:
        """What `_form_basis` gives for the field's rows, worked out once for all hypotheses."""
        kept = self.data.forms
        if effect not in kept:
            kept[effect] = self._form_basis(effect, self.data.view)
        return kept[effect]

    def _form_basis(self, effect: Effect, view: View) -> tuple[Array, list[float]]:
        """Basis of an effect's form error, shape (n, m), and the sds of its coefficients."""
        n = view.slip().size
        basis: list[tuple[str, Array]] = []
        if "size" in effect.form:
            basis.append(("size", np.ones(n)))
        slip = self.covariates.over(view, "slip")
        if "slip" in effect.form and slip is not None:
            basis += [("slip", slip), ("bend", 1.5 * slip**2 - 0.5)]
        for kind in ("pressure", "extrapolation", "cone", "water"):
            over = "pressure" if kind == "extrapolation" else kind
            values = self.covariates.over(view, over) if kind in effect.form else None
            if values is not None:
                basis.append((kind, values))
        values = effect.shape(view) if "shape" in effect.form else None
        reference = effect.shape(self.data.view) if values is not None else None
        if values is not None and reference is not None and np.ptp(reference) > 1e-9:
            mid = 0.5 * (reference.max() + reference.min())
            u = np.clip((values - mid) / (0.5 * np.ptp(reference)), -1.5, 1.5)
            basis.append(("shape", u))
        if not basis:
            return np.empty((n, 0)), []
        return np.stack([b for _, b in basis], axis=1), [FORM_ERROR[kind] for kind, _ in basis]

    def _predict(self, psi: Array, output: str, conditions: Mapping[str, Array]) -> Array:
        """Simulator and its inadequacy at conditions (n,), on the scale of the response."""
        t, misfit = psi[:, self.theta_slices[output]], psi[:, self.misfit_slices[output]]
        # Guesses and differences mostly leave the parameters of a simulator as in the row before.
        new = (t[1:] != t[:-1]).any(axis=1) | (misfit[1:] != misfit[:-1]).any(axis=1)
        if new.all():
            return self.simulated[output].predict(t, misfit, conditions)
        new = np.append(True, new)
        found = self.simulated[output].predict(t[new], misfit[new], conditions)
        return np.asarray(found[np.cumsum(new) - 1])

    @_SILENT
    def lab(self, psi: Array) -> dict[str, Array]:
        """Predict the lab rows on the scale of the response, shapes (k, n_lab)."""
        return {name: self._predict(psi, name, s.lab) for name, s in self.simulated.items()}

    @_SILENT
    def simulator(self, psi: Array, view: View) -> dict[str, Array]:
        """Predict with the calibrated simulator alone, on the scale of the response."""
        return {
            name: self._predict(psi, name, s.conditions(view)) for name, s in self.simulated.items()
        }

    @_SILENT
    def campaigns(self, psi: Array) -> tuple[dict[str, Array], dict[str, Array]]:
        """Predict the lab rows and the field rows, as `lab` and `field` do."""
        if self.shift is not None:
            return self.lab(psi), self.field(psi, self.data.view)
        lab, plain = self.plain(psi)
        return lab, self.departed(psi, self.data.view, plain)

    @_SILENT
    def plain(self, psi: Array) -> tuple[dict[str, Array], dict[str, Array]]:
        """Predict the lab rows and the field rows by the simulators alone.

        Of psi only the first `n_shared` coordinates are used, which all hypotheses have in common.
        """
        # One simulator for both: half as many calls, of which a fit makes thousands.
        lab, plain = {}, {}
        for o in self.data.outputs:
            both = self._predict(psi, o.name, self.simulated[o.name].both)
            n_lab = o.problem.response.size
            lab[o.name], plain[o.name] = both[:, :n_lab], both[:, n_lab:]
        return lab, plain

    @_SILENT
    def field(self, psi: Array, view: View) -> dict[str, Array]:
        """Predict field rows with the hypothesis in force."""
        return self.without(psi, view)

    @property
    def causes(self) -> tuple[str, ...]:
        """What acts: effects by name, ``parameter_shift``, and ``unknown`` for a discrepancy."""
        names = [e.name for e in self.hypothesis.effects]
        names += ["parameter_shift"] if self.shift is not None else []
        return (*names, *(["unknown"] if self.smooth_slices else []))

    def left_out(self, psi: Array, *causes: str) -> tuple[Array, list[int]]:
        """Psi without some of `causes`, and effects that are idle then, by their place."""
        rest = psi.copy()
        if "parameter_shift" in causes:
            rest[:, self.shift_slice] = 0.0
        if "unknown" in causes:
            for part in self.smooth_slices.values():
                rest[:, part] = 0.0
        return rest, [i for i, e in enumerate(self.hypothesis.effects) if e.name in causes]

    def without(self, psi: Array, view: View, *left_out: str) -> dict[str, Array]:
        """Predict field rows with all of `causes` in force but some."""
        rest, idle = self.left_out(psi, *left_out)
        plain = {} if self.shift is not None else self.simulator(psi, view)
        return fields_of_all([(self, rest)], view, plain, {0: idle})

    def departed(self, psi: Array, view: View, plain: dict[str, Array]) -> dict[str, Array]:
        """Add effects and discrepancies to what simulators predict."""
        return departed_of_all([(self, psi)], view, plain)

    @_SILENT
    def field_and_plain(self, psi: Array, view: View) -> tuple[dict[str, Array], dict[str, Array]]:
        """Predict as `field` and as `simulator` do."""
        plain = self.simulator(psi, view)
        return fields_of_all([(self, psi)], view, plain), plain


@_SILENT
def fields_of_all(
    asked: Sequence[tuple[Forward, Array]], view: View, plain: dict[str, Array], idle: Idle = _NONE
) -> dict[str, Array]:
    """Predict field rows with hypotheses on the same campaigns in force, as `departed_of_all` does.

    Simulators of those with a shift are at other parameters than in `plain`.
    """
    shifted = [part for part in asked if part[0].shift is not None]
    if not shifted:
        return departed_of_all(asked, view, plain, idle)
    there = _shifted_of_all(shifted, view)
    if len(shifted) < len(asked):
        of_it = np.concatenate([np.full(len(psi), f.shift is not None) for f, psi in asked])
        plain = {name: values.copy() for name, values in plain.items()}
        for name, values in there.items():
            plain[name][of_it] = values
        there = plain
    return departed_of_all(asked, view, there, idle)


def _shifted_of_all(asked: Sequence[tuple[Forward, Array]], view: View) -> dict[str, Array]:
    """Predict field rows with the simulators at the shifted parameters of hypotheses.

    Parameters
    ----------
    asked : sequence of (Forward, ndarray)
        On the same campaigns, each with a shift, and psi of each, shape (k, d).
    """
    some, _ = asked[0]
    shared = np.concatenate([psi[:, : some.n_shared] for _, psi in asked])
    shifts = [(f.shift, psi[:, f.shift_slice]) for f, psi in asked if f.shift is not None]
    errors = np.concatenate([shift @ by.radius_error for by, shift in shifts])
    found: dict[str, Array] = {}
    for name, s in some.simulated.items():
        moved = np.concatenate([shift @ by.parameters[name].T for by, shift in shifts])
        found[name] = s.predict(
            shared[:, some.theta_slices[name]] + moved, shared[:, some.misfit_slices[name]],
            _shifted(errors, s.conditions(view)),
        )  # fmt: skip
    return found


def _shifted(radius_error: Array, conditions: dict[str, Array]) -> dict[str, Array]:
    """Conditions as they truly are: with a shift the zero of slip is another, errors (k,)."""
    column = next((c for c in columns_of("slip") if c in conditions), None)
    if not radius_error.any() or column is None:
        return conditions
    slip = 1.0 - (1.0 - conditions[column]) * (1.0 - radius_error[:, None])
    return {**conditions, column: slip}


def _append(entries: list[Prior], new: Sequence[Prior]) -> slice:
    start = len(entries)
    entries += new
    return slice(start, len(entries))


def _uniform(name: str, lower: float, upper: float) -> Prior:
    return Prior(
        name, "1", "", "", f"uniform({lower:g}, {upper:g})", False, 0.5 * (lower + upper), np.inf,
        lower, upper,
    )  # fmt: skip


@lru_cache(maxsize=256)
def _named(effect: str, priors: Priors) -> tuple[Prior, ...]:
    """Priors of an effect's free parameters under names that no other effect's have."""
    return tuple(replace(p, name=f"{effect}.{p.name}") for p in priors.free)


@lru_cache(maxsize=1024)
def _normal(name: str, sd: float) -> Prior:
    return Prior(name, "1", "", "", f"normal(0, {sd:g})", False, 0.0, sd)
