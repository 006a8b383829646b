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


# Effects to leave out, by their place, of those asked for, by their place.
type Idle = Mapping[int, Collection[int]]
_NONE: Idle = {}
type _Rows = slice | NDArray[np.int64]
# Rows of the predictions, which they are of those of an effect, and what it adds in them.
type _Added = tuple[_Rows, slice | NDArray[np.bool_], Array]


def departed_of_all(
    asked: Sequence[tuple[Forward, Array]], view: View, plain: dict[str, Array], idle: Idle = _NONE
) -> dict[str, Array]:  # fmt: skip
    """Add to what simulators predict what hypotheses on the same campaigns say.

    An effect is asked once for all hypotheses that have it: of few rows at a time asking takes
    longer than the arithmetic.

    Parameters
    ----------
    asked : sequence of (Forward, ndarray)
        With psi of each, shape (k, d); one below the other they are the rows of `plain`.
    plain : dict of str to ndarray, shape (sum of k, n)
    idle : mapping of int to collection of int
        Effects to leave out of one of those asked, by their place.
    """
    return Departed(asked, view, plain, idle).at([psi for _, psi in asked])


class Departed:
    """What `departed_of_all` adds, with form errors that may be others later.

    The conditions that truly held do not depend on these: simulators are asked once.
    """

    @np.errstate(all="ignore")
    def __init__(
        self, asked: Sequence[tuple[Forward, Array]], view: View, plain: dict[str, Array],
        idle: Idle = _NONE,
    ) -> None:  # fmt: skip
        self._view, self._plain = view, plain
        ends = np.cumsum([len(psi) for _, psi in asked]).tolist()
        self._parts = [
            (forward, slice(end - len(psi), end))
            for (forward, psi), end in zip(asked, ends, strict=True)
        ]
        self._acting = _acting(self._parts, [psi for _, psi in asked], view, plain, idle)
        self._added: dict[str, list[list[_Added]]] = {}
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

    def apart(self, moved: NDArray[np.int64]) -> Iterator[tuple[int, _Rows, Any, Array, View]]:
        """Part the rows by what was moved there before: that, rows, which, phi and view."""
        before = moved[self.rows]
        if before.size and (before == before[0]).all():
            yield int(before[0]), self.rows, slice(None), self.phi, self.view
            return
        places = np.arange(moved.size)[self.rows]
        for mask in np.unique(before).tolist():
            some = before == mask
            view = _seen(self.view, self.view.base, some)
            yield mask, places[some], some, self.phi[some], view


def _acting(
    parts: Sequence[tuple[Forward, slice]], psi: Sequence[Array], view: View,
    plain: Mapping[str, Array], idle: Idle,
) -> list[_Acting]:  # fmt: skip
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
    forward: Forward, shared: Array, name: str, view: View, acting: Sequence[_Acting],
    plain: Array,
) -> list[list[_Added]]:  # fmt: skip
    """What each effect adds to one output by the conditions that truly held, by its formula."""
    role, simulated = forward.roles[name], forward.simulated[name]
    t, misfit = shared[:, forward.theta_slices[name]], shared[:, forward.misfit_slices[name]]
    recorded = simulated.conditions(view)
    conditions = {known: recorded[column] for known, column in simulated.columns.items()}
    bits = {known: 1 << i for i, known in enumerate(conditions)}
    truly: dict[str, Array] = {}
    # Which conditions are no longer the recorded ones; with those a simulator has less to do.
    moved = np.zeros(len(plain), dtype=np.int64)
    ahead = plain
    added: list[list[_Added]] = []
    for a in acting:
        added.append([])
        if role not in a.effect.outputs:
            continue
        for mask, rows, some, phi, seen in a.apart(moved):
            given = {
                known: truly[known][rows] if mask & bits[known] else values
                for known, values in conditions.items()
            }
            found = a.effect.on_conditions(phi, role, given, seen)
            if found is given:
                continue
            there = simulated.predict_beyond(
                t[rows], misfit[rows], {simulated.columns[known]: v for known, v in found.items()}
            )
            added[-1].append((rows, some, there - ahead[rows]))
            if ahead is plain:
                ahead = plain.copy()
            ahead[rows] = there
            for known in (known for known, values in found.items() if values is not given[known]):
                if known not in truly:
                    truly[known] = np.empty(plain.shape)
                truly[known][rows] = found[known]
                moved[rows] |= bits[known]
    return added


def _changed(
    plain: Array, role: str, acting: Sequence[tuple[_Acting, Array, Sequence[_Added]]]
) -> Array:
    """One output with effects in it, each with its factors and what it adds by conditions.

    What an effect adds to the output, given those before it, departs from its formula by a factor
    of its own.
    """
    location = plain.copy()
    for _, factor, added in acting:
        for rows, some, change in added:
            location[rows] += change * factor[some]
    for a, factor, _ in acting:
        here = location[a.rows]
        changed = a.effect.on_output(a.phi, role, here, a.view)
        if changed is not here:
            change = changed - here
            change *= factor
            if any(k.at_most and k.output == role for k in a.effect.known):
                np.maximum(change, -a.effect.most(a.phi, role, here, a.view), out=change)
            change += here
            location[a.rows] = change
    return location


def _seen(view: View, base: Mapping[str, Array], rows: _Rows | NDArray[np.bool_]) -> View:
    """What an effect can see of some rows of what simulators predict."""
    return view.with_base({role: values[rows] for role, values in base.items()})
