"""Which explanations of several causes are tried: sets of effects, and what is not listed.

Pairs that hold one of the best single effects come first. The best sets of each number of causes
are then enlarged by one effect and changed, one effect in the place of another or one left out,
until all that are best have been: a stepwise search in both directions. A set is fitted again where
another that is changed promises as much, for its posterior may have many modes.

Alone an effect may have to be larger than its prior says, to make up for others that act as well.
Sets are looked for with the priors that their effects had alone, for wide ones miss nothing. Where
its effects are not as large in a set, their usual priors count, else both do. How promising a set
is, is told with what usual priors would add: two effects with wide ones are up to ten nats behind.

Where fits of hypotheses begin: at the lab's calibration, or where parts of them have led.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from calib.gap.campaigns import Campaigns
from calib.gap.constants import SEARCH, WIDE
from calib.gap.effects import Effect
from calib.gap.fit import Fit, Start, finished, truncated_fits
from calib.gap.forward import Forward
from calib.gap.gauss_newton import Residuals, residuals_of_all
from calib.gap.hypotheses import Hypothesis, joined, resized, unknowns, with_residual_discrepancy
from calib.gap.noise import Noise
from calib.gap.odds import Odds, with_prior
from calib.inference.priors import Priors
from calib.inference.random import even_points
from calib.models.base import Array


@dataclass(frozen=True)
class CandidateSet:
    """A set of causes that may be worth a fit.

    Parameters
    ----------
    expected : float
        Log of evidence times prior, by the best guess and one step of the other parameters, if the
        posterior is as broad as that of the set it was made from.
    starts : ndarray, shape (k, d)
        Starting points, the best first.
    first : int
        How many of the guesses are the best of a part that the set was made from.
    """

    forward: Forward
    expected: float
    starts: Array
    noise: Mapping[str, Noise]
    first: int = 1

    @property
    def hypothesis(self) -> Hypothesis:
        """Which causes."""
        return self.forward.hypothesis

    @property
    def start(self) -> Start:
        """Where a fit begins."""
        return Start(self.forward, self.starts, self.noise, len(self.starts))

    def with_starts_of(self, other: CandidateSet) -> CandidateSet:
        """Return the better of two estimates for one set, with the starting points of both."""
        one, two = sorted((self, other), key=lambda p: -p.expected)
        parts = (
            one.starts[: one.first],
            two.starts[: two.first],
            one.starts[one.first :],
            two.starts[two.first :],
        )
        return replace(one, starts=np.concatenate(parts), first=one.first + two.first)

    def parted(self) -> tuple[CandidateSet, CandidateSet]:
        """Split the starting points: the best of the parts it was made from, and the others."""
        first, others = self.starts[: self.first], self.starts[self.first :]
        return replace(self, starts=first), replace(self, starts=others)


class StartingPoints:
    """Starting points for fits of the hypotheses of one case.

    Parameters
    ----------
    lab_mode : mapping of str to ndarray
        Internal parameters of each simulator as the lab calibrated it.
    noise : mapping of str to Noise
        Of the laboratory.
    """

    def __init__(
        self, data: Campaigns, lab_mode: Mapping[str, Array], noise: Mapping[str, Noise], odds: Odds
    ) -> None:
        self.data, self.lab_mode, self.noise = data, lab_mode, noise
        self.odds = odds

    def fit(self, hypotheses: Sequence[Hypothesis]) -> dict[str, tuple[Fit, ...]]:
        """Fit from the lab's calibration, by name."""
        truncated = truncated_fits([self.begun(h) for h in hypotheses])
        fits: dict[str, tuple[Fit, ...]] = {}
        for found in finished(truncated):
            name = found.forward.hypothesis.name
            fits[name] = (*fits.get(name, ()), found)
        return fits

    def begun(self, hypothesis: Hypothesis) -> Start:
        """Start at the lab's calibration, with several draws of the effects' priors."""
        forward, start = self._forward(hypothesis)
        if hypothesis.onset_over is not None:
            start = self._onset_start(forward, start)
        if not hypothesis.effects:
            return Start(forward, start[None], self.noise)
        starts = self._spread(forward, start, SEARCH.guesses, range(len(hypothesis.effects)))
        return Start(forward, np.concatenate([start[None], starts]), self.noise, SEARCH.started)

    def start_from(self, hypothesis: Hypothesis, members: Sequence[Fit], count: int) -> Start:
        """Start from fits of parts of a hypothesis; effects that they lack by their priors."""
        if not members:
            return self.begun(hypothesis)
        forward, start = self._forward(hypothesis)
        parts = [start[None]]
        for member in members:
            led = _led(forward, start, member)
            known = {e.name for e in member.forward.hypothesis.effects}
            lacking = [i for i, e in enumerate(hypothesis.effects) if e.name not in known]
            size = SEARCH.guesses // len(members) if lacking else 1
            parts.append(self._spread(forward, led, size, lacking))
        return Start(forward, np.concatenate(parts), self.noise, count)

    def beside(
        self, kept: Hypothesis, found: Fit, added: Sequence[Hypothesis], size: int = SEARCH.guesses
    ) -> list[CandidateSet]:
        """Guess at sets of what is kept of one that was fitted and one effect more.

        All other parameters take a Gauss-Newton step from each guess, or part of one where a whole
        one goes too far: what they can take up is no reason to add an effect. What is kept of a
        larger set is guessed at by itself as well.

        Parameters
        ----------
        kept : Hypothesis
            Some of the effects that were fitted, or all of them.
        added : sequence of Hypothesis
            Single effects.
        size : int
            How many guesses at the effect that is added are compared.
        """
        forward, start = self._forward(kept)
        psi = _led(forward, start, found)[None]
        problem, ended = Residuals(self.data, forward), Residuals(self.data, found.forward)
        sets = []
        for h in added:
            larger, larger_start = self._forward(joined(kept, h))
            last = [e.name for e in larger.hypothesis.effects].index(h.name)
            begun = self._spread(larger, _led(larger, larger_start, found), size, [last])
            there = Residuals(self.data, larger)
            sets.append((there, there.clip(begun)))
        if 1 < len(kept.effects) < len(found.forward.hypothesis.effects):
            sets.append((problem, problem.clip(psi)))
        asked = [
            (ended, found.psi[None]),
            (problem, problem.clip(psi)),
            (problem, problem.around(psi)),
        ]
        at_end, raw, moved, *guessed = residuals_of_all([*asked, *sets])
        sds = problem.sds(found.noise)
        slope = problem.jacobian(psi, raw, moved)[0] / sds
        hessian = slope @ slope.T + np.diag(problem.precision**2 + 1e-6 / problem.width**2)
        off = (psi[0] - problem.loc) * problem.precision**2
        stepped = []
        for (there, begun), left in zip(sets, guessed, strict=True):
            gradient = (left / sds) @ slope.T + off
            step = -np.linalg.solve(hessian, gradient.T).T
            costs = there.costs(begun, left, sds) + 0.5 * (gradient * step).sum(axis=1)
            best = there.best(costs, begun, SEARCH.stepped)
            own, here = _places(forward, there.forward)
            starts = np.repeat(begun[best][None], 3, axis=0)
            starts[:, :, here] += np.array([1.0, 0.3, 0.0])[:, None, None] * step[best][:, own]
            stepped.append((there, there.clip(starts.reshape(-1, starts.shape[-1]))))
        cost = float(ended.costs(found.psi[None], at_end, sds)[0])
        promises = []
        for (there, starts), left in zip(stepped, residuals_of_all(stepped), strict=True):
            costs = there.costs(starts, left, sds)
            best = there.best(costs, starts, SEARCH.started_in_set)
            least = float(costs[best[0]])
            gained = cost - least if np.isfinite(least) else -np.inf
            expected = self._expected(there.forward.hypothesis, found, gained)
            promises.append(CandidateSet(there.forward, expected, starts[best], found.noise))
        return promises

    def _expected(self, hypothesis: Hypothesis, found: Fit, gained: float) -> float:
        """Log of evidence times prior of a set with a density so much higher than one's fitted."""
        was, odds = found.forward.hypothesis, self.odds
        share = float(np.log(hypothesis.share / was.share))
        prior = odds.ln_prior(hypothesis.name) - odds.ln_prior(was.name)
        return with_prior(found, odds) + gained + prior + share

    def _forward(self, hypothesis: Hypothesis) -> tuple[Forward, Array]:
        scale = {o: n.sigma for o, n in self.noise.items()}
        forward = Forward(self.data, hypothesis, scale, self.lab_mode)
        start = np.array([p.loc for p in forward.priors.free])
        for o in self.data.outputs:
            start[forward.theta_slices[o.name]] = self.lab_mode[o.name]
        return forward, start

    def _onset_start(self, forward: Forward, start: Array) -> Array:
        """The threshold, and the step and bend there, that the lab's residuals show best."""
        lower, upper = (
            getattr(forward.priors.free[forward.threshold], e) for e in ("lower", "upper")
        )
        thresholds = np.linspace(lower, upper, SEARCH.thresholds)
        plain = forward.simulator(start[None], self.data.view)
        left = np.zeros(SEARCH.thresholds)
        starts = np.repeat(start[None], SEARCH.thresholds, axis=0)
        starts[:, forward.threshold] = thresholds
        for o in self.data.outputs:
            if o.name not in forward.smooth_slices:
                continue
            sigma = self.noise[o.name].sigma
            residual = (o.field - plain[o.name][0, o.rows]) / sigma
            shapes = np.stack(
                forward.discrepancy.onset(self.data.view, o.name, thresholds), axis=-1
            )
            part = forward.smooth_slices[o.name]
            precision = np.diag(
                [forward.priors.free[i].scale ** -2.0 for i in range(part.start, part.stop)]
            )
            for i, basis in enumerate(shapes[:, o.rows] / sigma):
                found = np.linalg.solve(basis.T @ basis + precision, basis.T @ residual)
                starts[i, part] = found
                left[i] += np.square(residual - basis @ found).sum() + found @ precision @ found
        best: Array = starts[int(np.argmin(left))]
        return best

    def _spread(self, forward: Forward, start: Array, size: int, which: Sequence[int]) -> Array:
        """Guesses that differ in the parameters of some of the effects, by their priors."""
        hypothesis = forward.hypothesis
        ends = np.cumsum([0, *(len(hypothesis.effect_priors[i].free) for i in which)]).tolist()
        even = even_points(size, ends[-1])
        starts = np.repeat(start[None], size, axis=0)
        for i, first, last in zip(which, ends[:-1], ends[1:], strict=True):
            effect, priors = hypothesis.effects[i], hypothesis.effect_priors[i]
            drawn = priors.ppf(even[:, first:last])
            if type(effect).begun is not Effect.begun:
                natural = effect.begun(
                    priors.to_natural(drawn), self._left(forward, start), self.data.view
                )
                drawn = priors.to_internal(natural)
            starts[:, forward.phi_slices[i]] = drawn
        return starts

    def _left(self, forward: Forward, start: Array) -> dict[str, Array]:
        """Field residuals at a starting point, by the role of the output."""
        predicted = forward.field(start[None], self.data.view)
        left = {}
        for o in self.data.outputs:
            left[o.role] = np.full(predicted[o.name].shape[1], np.nan)
            left[o.role][o.rows] = o.field - predicted[o.name][0, o.rows]
        return left


def _led(forward: Forward, start: Array, member: Fit) -> Array:
    """Return a start, moved to where a fit of some parts of a hypothesis has led."""
    theirs, ours = _places(member.forward, forward)
    led = start.copy()
    led[ours] = member.psi[theirs]
    return led


def _places(old: Forward, new: Forward) -> tuple[Array, Array]:
    """Places of the parameters that two hypotheses share, in the psi of each."""
    pairs = [(slice(0, old.n_shared), slice(0, new.n_shared))]
    place = {e.name: i for i, e in enumerate(new.hypothesis.effects)}
    for i, e in enumerate(old.hypothesis.effects):
        if e.name in place:
            j = place[e.name]
            pairs.append((old.phi_slices[i], new.phi_slices[j]))
            pairs += [(old.form_slices[o][i], new.form_slices[o][j]) for o in old.form_slices]
    if old.shift is not None and new.shift is not None:
        pairs.append((old.shift_slice, new.shift_slice))
    theirs, ours = (
        np.concatenate([np.arange(pair[k].start, pair[k].stop) for pair in pairs]) for k in (0, 1)
    )
    return theirs, ours


# A hypothesis, and fits of parts of it.
type _Started = tuple[Hypothesis, list[Fit]]


def search_sets(
    guesses: StartingPoints, single: Sequence[str], fits: Mapping[str, tuple[Fit, ...]]
) -> dict[str, tuple[Fit, ...]]:
    """Fit what is not listed, by itself and beside the best explanations, and sets of effects."""
    n = guesses.odds
    first = (group[0].forward.hypothesis for group in fits.values())
    usual = {h.name: h.effect_priors[0] for h in first if h.effects}
    sized = partial(_as_sized, guesses, usual)
    best = {name: max(group, key=partial(with_prior, odds=n)) for name, group in fits.items()}
    alone = sorted((best[m] for m in best if m != "none"), key=lambda f: -with_prior(f, n))
    others: list[_Started] = [(h, []) for h in unknowns(guesses.data)]
    others += _with_residual_discrepancies(guesses, alone[: SEARCH.leading])
    alone_best = max(with_prior(f, n) for f in best.values())
    pairs = _pairs(guesses, usual, single, best, alone_best - SEARCH.unpromising)
    n_others = len(others)
    truncated = truncated_fits(
        [
            *(guesses.start_from(h, members, 1) for h, members in others),
            *(p.parted()[0].start for p in pairs),
        ]
    )
    ended_at = [max(with_prior(f, n) for f in group) for group in truncated]
    listed = max([alone_best, *ended_at[n_others:]])
    leading = max([listed, *ended_at[:n_others]])
    promise = partial(_promise, usual, n)
    truncated[n_others:] = _begun_again(promise, pairs, truncated[n_others:], listed)
    unlisted = sized(_finished(promise, truncated[:n_others], leading - SEARCH.hopeless), leading)
    sets = sized(_finished(promise, truncated[n_others:], listed - SEARCH.hopeless), listed)
    # What is unlisted takes up what any listed causes leave: these are compared without it.
    listed = max(with_prior(f, n) for f in (*best.values(), *sets))
    sets += _stepwise(guesses, [best[m] for m in single], usual, sets, listed)
    sets = _best_of_each(sets)
    leading = max(leading, *(with_prior(f, n) for f in (*unlisted, *sets)))
    top = _leading(sets, leading - SEARCH.searched, n, SEARCH.leading_sets)
    beside = _with_residual_discrepancies(guesses, top)
    truncated = truncated_fits([guesses.start_from(h, of, 1) for h, of in beside])
    ended = sized(_finished(promise, truncated, leading - SEARCH.hopeless), leading)
    everything = _best_of_each([*unlisted, *sets, *ended])
    by_name: dict[str, tuple[Fit, ...]] = {}
    for found in everything:
        name = found.forward.hypothesis.name
        by_name[name] = (*by_name.get(name, ()), found)
    return by_name


def unusually_large(found: Fit, effect: int, priors: Priors) -> bool:
    """Whether an effect of a fit, by its place, is larger than its usual priors say."""
    sizes = found.psi[found.forward.phi_slices[effect]]
    far = SEARCH.unusually_large
    return any(abs(t - p.loc) > far * p.scale for t, p in zip(sizes, priors.free, strict=True))


def _as_sized(
    guesses: StartingPoints, usual: Mapping[str, Priors], fits: Sequence[Fit], leading: float
) -> list[Fit]:
    """Fits, and those in play once more with the priors that their effects' sizes ask for."""
    promise = partial(_promise, usual, guesses.odds)
    there = {f.forward.hypothesis for f in fits}
    asked: list[_Started] = []
    for found in fits:
        h = found.forward.hypothesis
        if not h.effects or promise([found]) < leading - SEARCH.searched:
            continue
        large = [
            e.name
            for i, e in enumerate(h.effects)
            if e.name not in guesses.data.case.context.sizes
            and unusually_large(found, i, usual[e.name])
        ]
        for some in ([], large):
            other = resized(h, usual, some)
            if other not in there:
                there.add(other)
                asked.append((other, [found]))
    truncated = truncated_fits([guesses.start_from(h, of, 1) for h, of in asked])
    return [*fits, *_finished(promise, truncated, leading - SEARCH.behind_resized)]


def _best_of_each(fits: Sequence[Fit]) -> list[Fit]:
    """Of several fits of a hypothesis that of the most evidence."""
    best: dict[Hypothesis, Fit] = {}
    for f in sorted(fits, key=lambda f: -f.log_evidence):
        best.setdefault(f.forward.hypothesis, f)
    return list(best.values())


def _with_residual_discrepancies(guesses: StartingPoints, causes: Sequence[Fit]) -> list[_Started]:
    return [
        (h, [f])
        for f in causes
        for h in with_residual_discrepancy(guesses.data, f.forward.hypothesis)
    ]


def _pairs(
    guesses: StartingPoints,
    usual: Mapping[str, Priors],
    single: Sequence[str],
    best: Mapping[str, Fit],
    least: float,
) -> list[CandidateSet]:
    """Estimate pairs with one of the best single effects, from either member if both are."""
    found: dict[str, CandidateSet] = {}
    for m in _pair_seeds(single, best):
        added = [best[other].forward.hypothesis for other in single if other != m]
        for p in guesses.beside(best[m].forward.hypothesis, best[m], added, SEARCH.guesses_of_pair):
            other = found.get(p.hypothesis.name)
            found[p.hypothesis.name] = p if other is None else other.with_starts_of(p)
    return [p for p in found.values() if _expected(usual, p) > least]


def _pair_seeds(single: Sequence[str], best: Mapping[str, Fit]) -> list[str]:
    return sorted(single, key=lambda m: -best[m].log_evidence)[: SEARCH.pair_seeds]


def _begun_again(
    promise: Callable[[Sequence[Fit]], float],
    pairs: Sequence[CandidateSet],
    truncated: Sequence[list[Fit]],
    leading: float,
) -> list[list[Fit]]:
    """Fit the pairs that are in play from more starting points."""
    others = {
        i: p.parted()[1]
        for i, p in enumerate(pairs)
        if promise(truncated[i]) > leading - SEARCH.searched
    }
    in_play = [i for i, p in others.items() if len(p.starts)]
    more = truncated_fits([others[i].start for i in in_play])
    searched = [list(group) for group in truncated]
    for i, group in zip(in_play, more, strict=True):
        searched[i] += group
    return searched


def _stepwise(
    guesses: StartingPoints,
    single: Sequence[Fit],
    usual: Mapping[str, Priors],
    pairs: Sequence[Fit],
    listed: float,
) -> list[Fit]:
    """Sets made of the best by enlargement and exchange, until nothing best is left to change.

    One that is found to be better than it was when it was changed is changed again.
    """
    n, promise = guesses.odds, partial(_promise, usual, guesses.odds)
    alone = [f.forward.hypothesis for f in single]
    known, reached, made_from = list(pairs), dict[str, float](), dict[str, float]()
    _note(reached, [f for f in pairs if promise([f]) > listed - SEARCH.searched], promise)
    while True:
        best = [
            f
            for size in range(2, SEARCH.most_causes + 1)
            for f in _leading(
                _of_size(known, size), listed - SEARCH.near_best, n, SEARCH.sets_changed
            )
            if with_prior(f, n) > made_from.get(f.forward.hypothesis.name, -np.inf) + SEARCH.better
        ]
        if not best:
            return known[len(pairs) :]
        made_from |= {f.forward.hypothesis.name: with_prior(f, n) for f in best}
        promises = [*_enlarged(guesses, best, alone), *_exchanged(guesses, best, alone)]
        made = _as_sized(guesses, usual, _fitted(usual, n, promises, reached, listed), listed)
        _note(reached, made, promise)
        listed = max([listed, *(with_prior(f, n) for f in made)])
        known += made


def _note(
    reached: dict[str, float], fits: Sequence[Fit], promise: Callable[[Sequence[Fit]], float]
) -> None:
    """Record the best score reached by each set."""
    for f in fits:
        name = f.forward.hypothesis.name
        reached[name] = max(reached.get(name, -np.inf), promise([f]))


def _of_size(sets: Sequence[Fit], size: int) -> list[Fit]:
    return [f for f in sets if len(f.forward.hypothesis.effects) == size]


def _leading(sets: Sequence[Fit], least: float, odds: Odds, count: int) -> list[Fit]:
    """The best fits of the best sets."""
    best: dict[str, Fit] = {}
    for f in sorted(sets, key=lambda f: -with_prior(f, odds)):
        best.setdefault(f.forward.hypothesis.name, f)
    return [f for f in best.values() if with_prior(f, odds) > least][:count]


def _exchanged(
    guesses: StartingPoints, sets: Sequence[Fit], alone: Sequence[Hypothesis]
) -> list[CandidateSet]:
    """Estimate sets with one effect exchanged for another, or left out."""
    promises = []
    for found in sets:
        names = {e.name for e in found.forward.hypothesis.effects}
        members = [h for h in alone if h.name in names]
        for out in members:
            kept = joined(*(h for h in members if h is not out))
            added = [h for h in alone if h.name not in names]
            promises += guesses.beside(kept, found, added)
    return promises


def _enlarged(
    guesses: StartingPoints, sets: Sequence[Fit], alone: Sequence[Hypothesis]
) -> list[CandidateSet]:
    """Estimate sets with one more effect."""
    promises = []
    for found in sets:
        kept = found.forward.hypothesis
        names = {e.name for e in kept.effects}
        if len(names) < SEARCH.most_causes:
            added = [h for h in alone if h.name not in names]
            promises += guesses.beside(kept, found, added)
    return promises


def _fitted(
    usual: Mapping[str, Priors],
    odds: Odds,
    promises: Sequence[CandidateSet],
    reached: Mapping[str, float],
    listed: float,
) -> list[Fit]:
    """Fit the sets that promise most, and again those that do about as well as was reached."""
    new, again = dict[str, CandidateSet](), dict[str, CandidateSet]()
    expected = [_expected(usual, p) for p in promises]
    for i in np.argsort(expected, kind="stable")[::-1].tolist():
        name = promises[i].hypothesis.name
        if name not in reached:
            if expected[i] > listed - SEARCH.unpromising:
                new.setdefault(name, promises[i])
        elif expected[i] > max(reached[name] - SEARCH.again, listed - SEARCH.behind_resized):
            again.setdefault(name, promises[i])
    chosen = [*list(new.values())[: SEARCH.fitted], *list(again.values())[: SEARCH.fitted_again]]
    truncated = truncated_fits([p.start for p in chosen])
    return _finished(partial(_promise, usual, odds), truncated, listed - SEARCH.behind)


def _finished(
    promise: Callable[[Sequence[Fit]], float], truncated: Sequence[Sequence[Fit]], hopeless: float
) -> list[Fit]:
    """Fit hypotheses fully from their truncated fits, but for those that are hopeless."""
    worth = [i for i, group in enumerate(truncated) if promise(group) > hopeless]
    ended = [max(group, key=lambda f: f.log_evidence) for group in truncated]
    for i, found in zip(worth, finished([truncated[i] for i in worth]), strict=True):
        ended[i] = found
    return ended


def _promise(usual: Mapping[str, Priors], odds: Odds, begun: Sequence[Fit]) -> float:
    """Log of evidence times prior of a hypothesis, by the priors that suit it best."""
    return max(with_prior(f, odds) + _as_usual(usual, f.forward, f.psi) for f in begun)


def _expected(usual: Mapping[str, Priors], promise: CandidateSet) -> float:
    """What a promise expects, by the priors that suit it best."""
    return promise.expected + _as_usual(usual, promise.forward, promise.starts[0])


def _as_usual(usual: Mapping[str, Priors], forward: Forward, psi: Array) -> float:
    """Log gain in prior density if effects have their usual priors where these suit."""
    gained = 0.0
    for e, wide, part in zip(
        forward.hypothesis.effects,
        forward.hypothesis.effect_priors,
        forward.phi_slices,
        strict=True,
    ):
        if wide != usual[e.name]:
            denser = usual[e.name].log_prob(psi[None, part]) - wide.log_prob(psi[None, part])
            gained += max(float(denser[0] - np.log(WIDE)), 0.0)
    return gained
