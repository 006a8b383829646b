"""The joint forward model of a hypothesis: simulator in the lab, with effects in the field.

The vector psi of a hypothesis stacks, all with (truncated) normal or uniform priors:

    simulator parameters of each output (internal coordinates)
    inadequacy of each simulator, in the lab and the field alike
    parameters of each effect
    form errors of each effect: what it adds is its formula's times max(1 + sum_j c_j b_j(x), 0)
    shifts of the simulator's parameters in the field (parameter_shift, or along a condition)
    coefficients of a free smooth discrepancy (unknown only)

What hypotheses add to the simulators' predictions: their effects, form errors, discrepancies.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from calib.data.quantities import columns_of
from calib.gap.campaigns import Campaigns
from calib.gap.constants import FORM_ERROR, MISFIT, WIDE
from calib.gap.discrepancy import THRESHOLDS, Discrepancy, ShiftMap, shift_map
from calib.gap.effects import Effect, View
from calib.gap.hypotheses import Hypothesis, widened
from calib.inference.priors import Prior, Priors
from calib.inference.random import latin
from calib.models.base import Array

# Values of a condition at which shifted simulators are evaluated at most; linear between them.
_MOST_VALUES = 9

# A prediction without a value is none, whatever the warnings.
_SILENT = np.errstate(all="ignore")


class FieldPrediction:
    """Field rows under a hypothesis, with form errors that may change later.

    The conditions that truly held do not depend on them.

    Parameters
    ----------
    forward : Forward
    psi : ndarray, shape (k, d)
    plain : dict of str to ndarray, shape (k, n)
        What the simulators predict there.
    idle : collection of int, optional
        Effects that do not act, by their place.
    """

    @_SILENT
    def __init__(
        self,
        forward: Forward,
        psi: Array,
        view: View,
        plain: dict[str, Array],
        idle: Collection[int] = (),
    ) -> None:
        self._forward, self._view, self._plain = forward, view, plain
        base = {
            o.role: o.problem.bound.from_response(plain[o.name])
            for o in (forward.data.outputs if forward.hypothesis.effects else ())
        }
        self._acting = _acting(forward, psi, view.with_base(base), idle)
        self._added = {
            o: _added(forward, psi, o, view, self._acting, plain[o])
            for o in (plain if self._acting else ())
        }

    @_SILENT
    def at(self, psi: Array, without: int | None = None) -> dict[str, Array]:
        """Predict with the form errors and discrepancies in psi, shape (k, d).

        Without what one of the effects adds, by its place, though the others see that it acts.
        """
        forward = self._forward
        forms = forward.form(self._view)
        changed = dict(self._plain)
        for name, role in forward.roles.items():
            of_it = []
            for a, added in zip(self._acting, self._added.get(name, ()), strict=False):
                if a.place != without and role in a.effect.outputs:
                    form = psi[:, forward.form_slices[name][a.place]]
                    of_it.append((a, np.maximum(1.0 + form @ forms[a.place].T, 0.0), added))
            if of_it:
                changed[name] = _changed(self._plain[name], role, of_it)
        threshold = psi[:, forward.threshold :].ravel()  # of one that sets in, else empty
        for name, part in forward.smooth_slices.items():
            smooth = forward.discrepancy.at(psi[:, part], threshold, self._view, name)
            changed[name] = changed[name] + smooth
        return changed


@dataclass(frozen=True)
class _Acting:
    """An effect, its place, its natural parameters and what it sees."""

    effect: Effect
    place: int
    phi: Array
    view: View


def _acting(forward: Forward, psi: Array, view: View, idle: Collection[int]) -> list[_Acting]:
    """Effects: what happens first, then what instruments make of it, by name."""
    h = forward.hypothesis
    found = [
        _Acting(effect, i, priors.to_natural(psi[:, part]), view)
        for i, (effect, priors, part) in enumerate(
            zip(h.effects, h.effect_priors, forward.phi_slices, strict=True)
        )
        if i not in idle
    ]
    return sorted(found, key=lambda a: (a.effect.instrument, a.effect.name))


def _added(
    forward: Forward,
    psi: Array,
    name: str,
    view: View,
    acting: Sequence[_Acting],
    plain: Array,
) -> list[Array | None]:
    """What each effect adds to one output by the conditions that truly held, by its formula."""
    role, simulated = forward.roles[name], forward.simulated[name]
    recorded = simulated.conditions(view)
    conditions = {known: recorded[column] for known, column in simulated.columns.items()}
    ahead = plain
    added: list[Array | None] = []
    for a in acting:
        added.append(None)
        if role not in a.effect.outputs:
            continue
        found = a.effect.on_conditions(a.phi, role, dict(conditions), a.view)
        if all(found[known] is values for known, values in conditions.items()):
            continue
        at = {simulated.columns[known]: values for known, values in found.items()}
        there = forward.shifted(psi, name, view, at, simulated.predict_beyond)
        added[-1] = there - ahead
        ahead, conditions = there, found
    return added


def _changed(
    plain: Array, role: str, acting: Sequence[tuple[_Acting, Array, Array | None]]
) -> Array:
    """One output with effects in it, each with its factors and what it adds by conditions.

    What an effect adds to the output, given those before it, departs from its formula by a factor
    of its own.
    """
    mean = plain.copy()
    for _, factor, added in acting:
        if added is not None:
            mean += added * factor
    for a, factor, _ in acting:
        changed = a.effect.on_output(a.phi, role, mean, a.view)
        if changed is not mean:
            change = (changed - mean) * factor
            if any(k.at_most and k.output == role for k in a.effect.known):
                change = np.maximum(change, -a.effect.most(a.phi, role, mean, a.view))
            mean = mean + change
    return mean


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
    """

    def __init__(
        self,
        data: Campaigns,
        hypothesis: Hypothesis,
        noise: Mapping[str, float],
        lab_mode: Mapping[str, Array] | None = None,
        shift: ShiftMap | None = None,
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
        self.discrepancy = Discrepancy(data, hypothesis, lab_mode or {})
        forms = [self._form_basis(e, data.view) for e in hypothesis.effects]
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
        self._along = next((e for e in hypothesis.effects if e.name == hypothesis.shift_over), None)
        if hypothesis.shift > 0.0:
            there = [o for o in data.outputs if not self._along or o.role in self._along.outputs]
            current, relative = shift_map(there, hypothesis.shift_as)
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

    @cached_property
    def _sizes(self) -> list[tuple[slice, Priors, Priors]]:
        """Effects whose size is not known: their place, usual priors and wide ones."""
        h, known = self.hypothesis, self.data.case.context.sizes
        return [
            (part, priors, widened(priors))
            for e, priors, part in zip(h.effects, h.effect_priors, self.phi_slices, strict=True)
            if e.name not in known and priors.free
        ]

    def _ln_odds_wide(self, psi: Array) -> list[Array]:
        """Log odds that each size is of its wide prior, shape (k,); 0 outside bounds."""
        odds = np.log(WIDE) - np.log1p(-WIDE)
        found = []
        for part, usual, wide in self._sizes:
            ln_usual, ln_wide = (p.log_prob(psi[:, part]) for p in (usual, wide))
            inside = np.isfinite(ln_usual)
            found.append(odds + np.where(inside, ln_wide, 0.0) - np.where(inside, ln_usual, 0.0))
        return found

    def log_prior(self, psi: Array) -> Array:
        """Log prior density, shape (k,): of sizes a mixture of the usual priors and wide ones."""
        value = self.priors.log_prob(psi)
        for ln_odds in self._ln_odds_wide(psi):
            value += np.log1p(-WIDE) + np.logaddexp(0.0, ln_odds)
        return value

    def ln_usual(self, psi: Array) -> Array:
        """Log probability that all sizes are of their usual priors, shape (k,)."""
        found = [-np.logaddexp(0.0, ln_odds) for ln_odds in self._ln_odds_wide(psi)]
        return np.sum(found, axis=0) if found else np.zeros(len(psi))

    def prior_draws(self, rng: np.random.Generator, size: int) -> Array:
        """Draw from the prior by a Latin hypercube, shape (size, d)."""
        u = latin(rng, size, self.n_dim)
        psi = self.priors.ppf(u)
        for part, _, wide in self._sizes:
            rows = rng.random(size) < WIDE
            psi[rows, part] = wide.ppf(u[rows, part])
        return psi

    def form(self, view: View) -> list[Array]:
        """Basis of each effect's form error, shapes (n, m)."""
        if view.conditions is self.data.view.conditions:
            return self._field_form
        return [self._form_basis(e, view)[0] for e in self.hypothesis.effects]

    def _form_basis(self, effect: Effect, view: View) -> tuple[Array, list[float]]:
        """Basis of an effect's form error, shape (n, m), and the sds of its coefficients."""
        n = view.slip().size
        basis: list[tuple[str, Array]] = []
        if "size" in effect.form:
            basis.append(("size", np.ones(n)))
        slip = self.data.scaled(view, "slip")
        if "slip" in effect.form and slip is not None:
            basis += [("slip", slip), ("bend", 1.5 * slip**2 - 0.5)]
        for kind in ("pressure", "extrapolation", "cone", "water"):
            over = "pressure" if kind == "extrapolation" else kind
            values = self.data.scaled(view, over) if kind in effect.form else None
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
        # Consecutive vectors often share the simulator's parameters: it is called once for them.
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
        lab, plain = self.plain(psi)
        return lab, self.acting(psi, self.data.view, plain).at(psi)

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
        names += ["parameter_shift"] if self.shift is not None and not self._along else []
        return (*names, *(["unknown"] if self.smooth_slices else []))

    @_SILENT
    def without(self, psi: Array, view: View, *left_out: str) -> dict[str, Array]:
        """Predict field rows with all of `causes` in force but some."""
        rest = psi.copy()
        if (self.hypothesis.shift_over or "parameter_shift") in left_out:
            rest[:, self.shift_slice] = 0.0
        if "unknown" in left_out:
            for part in self.smooth_slices.values():
                rest[:, part] = 0.0
        idle = [i for i, e in enumerate(self.hypothesis.effects) if e.name in left_out]
        plain = {} if self.shift is not None else self.simulator(psi, view)
        return self.acting(rest, view, plain, idle).at(rest)

    @_SILENT
    def acting(
        self, psi: Array, view: View, plain: dict[str, Array], idle: Collection[int] = ()
    ) -> FieldPrediction:
        """Prepare field rows, of which `plain` is what the simulators say without a shift."""
        if self.shift is not None:
            plain = {
                name: self.shifted(psi, name, view, s.conditions(view), s.predict)
                for name, s in self.simulated.items()
            }
        return FieldPrediction(self, psi, view, plain, idle)

    def along(self, view: View) -> Array | None:
        """Return what a shift is multiplied by, shape (n,); None if it is all over the field.

        The condition, in a unit in which it is at most one in the field: where it has one value
        there, parameters shift along it by as much as by themselves.
        """
        u, own = (self._along.shape(v) if self._along else None for v in (view, self.data.view))
        return None if u is None or own is None else u / max(1.0, float(np.abs(own).max()))

    def shifted(
        self,
        psi: Array,
        name: str,
        view: View,
        conditions: dict[str, Array],
        predict: Callable[[Array, Array, dict[str, Array]], Array],
    ) -> Array:
        """Predict one output with a shift, along a condition if it goes with it, shape (k, n)."""
        t, misfit = psi[:, self.theta_slices[name]], psi[:, self.misfit_slices[name]]
        if self.shift is None or name not in self.shift.parameters:
            return predict(t, misfit, conditions)
        shift = psi[:, self.shift_slice]
        moved, error = shift @ self.shift.parameters[name].T, shift @ self.shift.radius_error
        along = self.along(view)
        if along is None:
            return predict(t + moved, misfit, _shifted(error, conditions))
        values = np.unique(along)
        if values.size > _MOST_VALUES:
            values = np.linspace(values[0], values[-1], _MOST_VALUES)
        mean = np.zeros((len(psi), along.size))
        for u, one in zip(values, np.eye(values.size), strict=True):
            weight = np.interp(along, values, one)
            rows = np.flatnonzero(weight)
            here = {column: v[..., rows] for column, v in conditions.items()}
            there = predict(t + u * moved, misfit, _shifted(u * error, here))
            mean[:, rows] += weight[rows] * there
        return mean

    @_SILENT
    def field_and_plain(self, psi: Array, view: View) -> tuple[dict[str, Array], dict[str, Array]]:
        """Predict as `field` and as `simulator` do."""
        plain = self.simulator(psi, view)
        return self.acting(psi, view, plain).at(psi), plain


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
    said, middle = f"uniform({lower:g}, {upper:g})", 0.5 * (lower + upper)
    return Prior(name, "1", "", "", said, False, middle, np.inf, lower, upper)


@lru_cache(maxsize=256)
def _named(effect: str, priors: Priors) -> tuple[Prior, ...]:
    """Priors of an effect's free parameters under names that no other effect's have."""
    return tuple(replace(p, name=f"{effect}.{p.name}") for p in priors.free)


@lru_cache(maxsize=1024)
def _normal(name: str, sd: float) -> Prior:
    return Prior(name, "1", "", "", f"normal(0, {sd:g})", False, 0.0, sd)
