"""The joint forward model of a hypothesis: simulator in the lab, with effects in the field.

The vector psi of a hypothesis stacks, all with (truncated) normal or uniform priors:

    simulator parameters of each output (internal coordinates)
    inadequacy of each simulator, in the lab and the field alike
    parameters of each effect
    form errors of each effect: what it adds is its formula's times max(1 + sum_j c_j b_j(x), 0)
    shifts of the simulator's parameters in the field (parameter_shift only)
    coefficients of a free smooth discrepancy (unknown only)

What hypotheses add to the simulators' predictions: their effects, form errors, discrepancies.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from calib.data.quantities import columns_of
from calib.gap.campaigns import Campaigns
from calib.gap.constants import FORM_ERROR, MISFIT
from calib.gap.discrepancy import THRESHOLDS, Discrepancy, ShiftMap, shift_map
from calib.gap.effects import Effect, View
from calib.gap.hypotheses import Hypothesis
from calib.inference.priors import Prior, Priors
from calib.models.base import Array

# Effects to leave out, by their place, of those asked for, by their place.
type LeftOut = Mapping[int, Collection[int]]
type _Rows = slice | NDArray[np.int64]


class FieldPrediction:
    """Field rows under hypotheses on the same campaigns, with form errors that may change later.

    An effect is evaluated once for all hypotheses that have it: for few rows at a time a call takes
    longer than its arithmetic. The conditions that truly held do not depend on the form errors.
    """

    @np.errstate(all="ignore")
    def __init__(
        self,
        asked: Sequence[tuple[Forward, Array]],
        view: View,
        plain: dict[str, Array],
        idle: LeftOut | None = None,
    ) -> None:
        self._view, self._plain = view, plain
        ends = np.cumsum([len(psi) for _, psi in asked]).tolist()
        self._parts = [
            (forward, slice(end - len(psi), end))
            for (forward, psi), end in zip(asked, ends, strict=True)
        ]
        self._acting = _acting(self._parts, [psi for _, psi in asked], view, plain, idle or {})
        self._added: dict[str, list[Array | None]] = {}
        if self._acting:
            forward = asked[0][0]
            shared = np.concatenate([psi[:, : forward.n_shared] for _, psi in asked])
            self._added = {
                o: _added(forward, shared, o, view, self._acting, plain[o]) for o in plain
            }

    @np.errstate(all="ignore")
    def at(self, psi: Sequence[Array], without: int | None = None) -> dict[str, Array]:
        """Predict with the form errors and discrepancies in psi of each, shapes (k, d).

        Without what one of the effects adds, by its place, though the others see that it acts.
        """
        acting = {
            j: (a, self._factors(a, psi))
            for j, a in enumerate(self._acting)
            if a.having[0][1] != without
        }
        changed = dict(self._plain)
        for name, role in self._parts[0][0].roles.items():
            of_it = [
                (a, factors[name], self._added[name][j])
                for j, (a, factors) in acting.items()
                if name in factors
            ]
            if of_it:
                changed[name] = _changed(self._plain[name], role, of_it)
        for (forward, rows), own in zip(self._parts, psi, strict=True):
            threshold = own[:, forward.threshold :].ravel()  # of one that sets in, else empty
            for name, part in forward.smooth_slices.items():
                if changed[name] is self._plain[name]:
                    changed[name] = changed[name].copy()
                smooth = forward.discrepancy.at(own[:, part], threshold, self._view, name)
                changed[name][rows] += smooth
        return changed

    def _factors(self, acting: _Acting, psi: Sequence[Array]) -> dict[str, Array]:
        """By how much an effect departs from its formula in each output that it touches.

        One plus what its form errors say, but for what is known of it: its sign, and where it is
        nothing.
        """
        forwards = [f for f, _ in self._parts]
        part, place = acting.having[0]
        basis = forwards[part].form(self._view)[place]
        found = {}
        for name, role in forwards[part].roles.items():
            if role in acting.effect.outputs:
                form = [psi[j][:, forwards[j].form_slices[name][i]] for j, i in acting.having]
                factor = (form[0] if len(form) == 1 else np.concatenate(form)) @ basis.T
                factor += 1.0
                found[name] = np.maximum(factor, 0.0, out=factor)
        return found


@dataclass(frozen=True)
class _Acting:
    """An effect in some rows: its natural parameters there, and what it sees.

    Which hypotheses have it, and its place in each.
    """

    effect: Effect
    having: Sequence[tuple[int, int]]
    rows: _Rows
    phi: Array
    view: View


def _acting(
    parts: Sequence[tuple[Forward, slice]],
    psi: Sequence[Array],
    view: View,
    plain: Mapping[str, Array],
    idle: LeftOut,
) -> list[_Acting]:
    """Effects, each once: what happens first, then what instruments make of it, by name."""
    places: dict[str, list[tuple[int, int]]] = {}
    for j, (forward, _) in enumerate(parts):
        for i, effect in enumerate(forward.hypothesis.effects):
            if i not in idle.get(j, ()):
                places.setdefault(effect.name, []).append((j, i))
    found: list[_Acting] = []
    if not places:
        return found
    outputs = parts[0][0].data.outputs
    base = {o.role: o.problem.bound.from_response(plain[o.name]) for o in outputs}
    for having in places.values():
        j, i = having[0]
        hypothesis = parts[j][0].hypothesis
        phi = np.concatenate([psi[j][:, parts[j][0].phi_slices[i]] for j, i in having])
        rows: _Rows = parts[j][1]
        if len(having) > 1:
            of_each = (parts[j][1] for j, _ in having)
            rows = np.concatenate([np.arange(part.start, part.stop) for part in of_each])
        natural = hypothesis.effect_priors[i].to_natural(phi)
        found.append(_Acting(hypothesis.effects[i], having, rows, natural, _seen(view, base, rows)))
    return sorted(found, key=lambda a: (a.effect.instrument, a.effect.name))


def _added(
    forward: Forward,
    shared: Array,
    name: str,
    view: View,
    acting: Sequence[_Acting],
    plain: Array,
) -> list[Array | None]:
    """What each effect adds to one output by the conditions that truly held, by its formula."""
    role, simulated = forward.roles[name], forward.simulated[name]
    t, misfit = shared[:, forward.theta_slices[name]], shared[:, forward.misfit_slices[name]]
    recorded = simulated.conditions(view)
    conditions = {known: recorded[column] for known, column in simulated.columns.items()}
    truly: dict[str, Array] = {}
    ahead = plain.copy()
    added: list[Array | None] = []
    for a in acting:
        added.append(None)
        if role not in a.effect.outputs:
            continue
        given = {
            known: truly[known][a.rows] if known in truly else values
            for known, values in conditions.items()
        }
        found = a.effect.on_conditions(a.phi, role, given, a.view)
        if found is given:
            continue
        at = {simulated.columns[known]: values for known, values in found.items()}
        there = simulated.predict_beyond(t[a.rows], misfit[a.rows], at)
        added[-1] = there - ahead[a.rows]
        ahead[a.rows] = there
        for known, values in found.items():
            if values is not given[known]:
                if known not in truly:
                    truly[known] = np.tile(conditions[known], (len(plain), 1))
                truly[known][a.rows] = values
    return added


def _changed(
    plain: Array, role: str, acting: Sequence[tuple[_Acting, Array, Array | None]]
) -> Array:
    """One output with effects in it, each with its factors and what it adds by conditions.

    What an effect adds to the output, given those before it, departs from its formula by a factor
    of its own.
    """
    mean = plain.copy()
    for a, factor, added in acting:
        if added is not None:
            mean[a.rows] += added * factor
    for a, factor, _ in acting:
        here = mean[a.rows]
        changed = a.effect.on_output(a.phi, role, here, a.view)
        if changed is not here:
            change = changed - here
            change *= factor
            if any(k.at_most and k.output == role for k in a.effect.known):
                np.maximum(change, -a.effect.most(a.phi, role, here, a.view), out=change)
            change += here
            mean[a.rows] = change
    return mean


def _seen(view: View, base: Mapping[str, Array], rows: _Rows) -> View:
    """What an effect can see of some rows of what simulators predict."""
    return view.with_base({role: values[rows] for role, values in base.items()})


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
        if hypothesis.shift > 0.0:
            current, relative = shift_map(data.outputs, hypothesis.shift_as)
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
        if self.shift is not None:
            return self.lab(psi), self.field(psi, self.data.view)
        lab, plain = self.plain(psi)
        return lab, fields_of_all([(self, psi)], self.data.view, plain)

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

    @_SILENT
    def field_and_plain(self, psi: Array, view: View) -> tuple[dict[str, Array], dict[str, Array]]:
        """Predict as `field` and as `simulator` do."""
        plain = self.simulator(psi, view)
        return fields_of_all([(self, psi)], view, plain), plain


@_SILENT
def fields_of_all(
    asked: Sequence[tuple[Forward, Array]],
    view: View,
    plain: dict[str, Array],
    idle: LeftOut | None = None,
) -> dict[str, Array]:
    """Predict field rows under hypotheses on the same campaigns.

    Parameters
    ----------
    asked : sequence of (Forward, ndarray)
        With psi of each, shape (k, d).
    plain : dict of str to ndarray, shape (sum of k, n)
        What the simulators predict there; those with a shift are evaluated anew.
    idle : mapping of int to collection of int, optional
        Effects to leave out, by their place, of one of those asked, by its place.
    """
    shifted = [part for part in asked if part[0].shift is not None]
    if shifted:
        there = _shifted_of_all(shifted, view)
        if len(shifted) < len(asked):
            of_it = np.concatenate([np.full(len(psi), f.shift is not None) for f, psi in asked])
            plain = {name: values.copy() for name, values in plain.items()}
            for name, values in there.items():
                plain[name][of_it] = values
        else:
            plain = there
    return FieldPrediction(asked, view, plain, idle).at([psi for _, psi in asked])


def _shifted_of_all(asked: Sequence[tuple[Forward, Array]], view: View) -> dict[str, Array]:
    """Predict field rows with the simulators at the shifted parameters of hypotheses."""
    some, _ = asked[0]
    shared = np.concatenate([psi[:, : some.n_shared] for _, psi in asked])
    shifts = [(f.shift, psi[:, f.shift_slice]) for f, psi in asked if f.shift is not None]
    errors = np.concatenate([shift @ by.radius_error for by, shift in shifts])
    found: dict[str, Array] = {}
    for name, s in some.simulated.items():
        moved = np.concatenate([shift @ by.parameters[name].T for by, shift in shifts])
        found[name] = s.predict(
            shared[:, some.theta_slices[name]] + moved,
            shared[:, some.misfit_slices[name]],
            _shifted(errors, s.conditions(view)),
        )
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
    said, middle = f"uniform({lower:g}, {upper:g})", 0.5 * (lower + upper)
    return Prior(name, "1", "", "", said, False, middle, np.inf, lower, upper)


@lru_cache(maxsize=256)
def _named(effect: str, priors: Priors) -> tuple[Prior, ...]:
    """Priors of an effect's free parameters under names that no other effect's have."""
    return tuple(replace(p, name=f"{effect}.{p.name}") for p in priors.free)


@lru_cache(maxsize=1024)
def _normal(name: str, sd: float) -> Prior:
    return Prior(name, "1", "", "", f"normal(0, {sd:g})", False, 0.0, sd)
