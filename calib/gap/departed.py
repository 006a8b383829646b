"""What hypotheses add to the simulators' predictions: their effects, form errors, discrepancies."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from calib.gap.effects import Effect, View
from calib.models.base import Array

if TYPE_CHECKING:
    from calib.gap.forward import Forward

__all__ = ["departed_of_all"]


@np.errstate(all="ignore")
def departed_of_all(
    asked: Sequence[tuple[Forward, Array]], view: View, plain: dict[str, Array],
    idle: Collection[int] = (),
) -> dict[str, Array]:  # fmt: skip
    """Add to what simulators predict what hypotheses on the same campaigns say.

    An effect is asked once for all hypotheses that have it: of few rows at a time asking takes
    longer than the arithmetic.

    Parameters
    ----------
    asked : sequence of (Forward, ndarray)
        With psi of each, shape (k, d); one below the other they are the rows of `plain`.
    view : View
    plain : dict of str to ndarray, shape (sum of k, n)
    idle : collection of int
        Effects to leave out, by their place.
    """
    changed = dict(plain)
    ends = np.cumsum([len(psi) for _, psi in asked]).tolist()
    parts = [
        (forward, psi, slice(end - len(psi), end))
        for (forward, psi), end in zip(asked, ends, strict=True)
    ]
    acting = _acting(parts, view, plain, idle)
    if acting:
        forward = asked[0][0]
        shared = np.concatenate([psi[:, : forward.n_shared] for _, psi in asked])
        changed = {o: _changed(forward, shared, o, view, acting, plain[o]) for o in plain}
    for forward, psi, rows in parts:
        threshold = psi[:, forward.threshold :].ravel()  # of one that sets in, else empty
        for name, part in forward.smooth_slices.items():
            if changed[name] is plain[name]:
                changed[name] = plain[name].copy()
            changed[name][rows] += forward.discrepancy.at(psi[:, part], threshold, view, name)
    return changed


type _Part = tuple[Forward, Array, slice]


@dataclass(frozen=True)
class _Acting:
    """An effect in some rows: its natural parameters there, and what it sees.

    Factors by which it departs from its formula, by output.
    """

    effect: Effect
    rows: slice | NDArray[np.int64]
    phi: Array
    factors: Mapping[str, Array]
    view: View

    def apart(self, moved: NDArray[np.int64]) -> Iterator[tuple[int, _Acting]]:
        """Part the rows by what was moved there before."""
        before = moved[self.rows]
        if before.size and (before == before[0]).all():
            yield int(before[0]), self
            return
        places = np.arange(moved.size)[self.rows]
        for some, mask in [(before == mask, mask) for mask in np.unique(before).tolist()]:
            factors = {name: factor[some] for name, factor in self.factors.items()}
            view = _seen(self.view, self.view.base, some)
            yield mask, _Acting(self.effect, places[some], self.phi[some], factors, view)


def _acting(
    parts: Sequence[_Part], view: View, plain: Mapping[str, Array], idle: Collection[int]
) -> list[_Acting]:
    """Effects, each once: what happens first, then what instruments make of it, by name."""
    places: dict[str, list[tuple[_Part, int]]] = {}
    for part in parts:
        for i, effect in enumerate(part[0].hypothesis.effects):
            if i not in idle:
                places.setdefault(effect.name, []).append((part, i))
    found: list[_Acting] = []
    if not places:
        return found
    outputs = parts[0][0].data.outputs
    base = {o.role: o.problem.bound.from_response(plain[o.name]) for o in outputs}
    for having in sorted(places.values(), key=_rank):
        (forward, _, _), i = having[0]
        effect, basis = forward.hypothesis.effects[i], forward.form(view)[i]
        phi = np.concatenate([psi[:, f.phi_slices[j]] for (f, psi, _), j in having])
        # One plus what its form errors say: by how much it departs from its formula, but for what
        # is known of it: its sign, and where it is nothing.
        factors = {}
        for name, role in forward.roles.items():
            if role in effect.outputs:
                form = [psi[:, f.form_slices[name][j]] for (f, psi, _), j in having]
                factor = (form[0] if len(form) == 1 else np.concatenate(form)) @ basis.T
                factor += 1.0
                factors[name] = np.maximum(factor, 0.0, out=factor)
        rows: slice | NDArray[np.int64] = having[0][0][2]
        if len(having) > 1:
            rows = np.concatenate([np.arange(p.start, p.stop) for (_, _, p), _ in having])
        natural = forward.hypothesis.effect_priors[i].to_natural(phi)
        found.append(_Acting(effect, rows, natural, factors, _seen(view, base, rows)))
    return found


def _rank(having: Sequence[tuple[_Part, int]]) -> tuple[bool, str]:
    (forward, _, _), i = having[0]
    effect = forward.hypothesis.effects[i]
    return effect.instrument, effect.name


def _changed(
    forward: Forward, shared: Array, name: str, view: View, effects: Sequence[_Acting],
    plain: Array,
) -> Array:  # fmt: skip
    """One output with the effects in it.

    What an effect adds to the output, given those before it, departs from its formula by a factor
    of its own.
    """
    acting = [a for a in effects if name in a.factors]
    if not acting:
        return plain
    role, simulated = forward.roles[name], forward.simulated[name]
    t, misfit = shared[:, forward.theta_slices[name]], shared[:, forward.misfit_slices[name]]
    recorded = simulated.conditions(view)
    conditions = {known: recorded[column] for known, column in simulated.columns.items()}
    bits = {known: 1 << i for i, known in enumerate(conditions)}
    truly: dict[str, Array] = {}
    # Which conditions are no longer the recorded ones; with those a simulator has less to do.
    moved = np.zeros(len(plain), dtype=np.int64)
    location, ahead = plain.copy(), plain.copy()
    for a in acting:
        for mask, some in a.apart(moved):
            rows = some.rows
            given = {
                known: truly[known][rows] if mask & bits[known] else values
                for known, values in conditions.items()
            }
            found = some.effect.on_conditions(some.phi, role, given, some.view)
            if found is given:
                continue
            there = simulated.predict_beyond(
                t[rows], misfit[rows], {simulated.columns[known]: v for known, v in found.items()}
            )
            added = there - ahead[rows]
            added *= some.factors[name]
            location[rows] += added
            ahead[rows] = there
            for known in (known for known, values in found.items() if values is not given[known]):
                if known not in truly:
                    truly[known] = np.empty(plain.shape)
                truly[known][rows] = found[known]
                moved[rows] |= bits[known]
    for a in acting:
        here = location[a.rows]
        changed = a.effect.on_output(a.phi, role, here, a.view)
        if changed is not here:
            change = changed - here
            change *= a.factors[name]
            if any(k.at_most_all and k.output == role for k in a.effect.known):
                np.maximum(change, -np.maximum(here, 0.0), out=change)
            change += here
            location[a.rows] = change
    return location


def _seen(view: View, base: Mapping[str, Array], rows: slice | NDArray[Any]) -> View:
    """What an effect can see of some rows of what simulators predict."""
    return view.with_base({role: values[rows] for role, values in base.items()})
