"""Which hypothesis: fit them all, turn evidence into probabilities."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.special import logsumexp

from calib.errors import CalibError
from calib.gap.ascent import Walk, together
from calib.gap.case import Campaigns, OutputData
from calib.gap.context import Context
from calib.gap.discrepancy import Bases
from calib.gap.effects import EFFECTS, Effect
from calib.gap.fit import Fit, finish, truncated_fit
from calib.gap.forward import Forward
from calib.gap.hypotheses import (
    COVERED,
    LN_PAIR_TO_SINGLE,
    LN_PRIOR,
    REMAINDER,
    covered,
    dependences,
    joined,
    shifts,
    singles,
    split_testable,
    unknowns,
    wider,
    with_remainder,
)
from calib.gap.hypothesis import Hypothesis
from calib.gap.isolate import Isolability, isolability
from calib.gap.noise import Noise
from calib.gap.refine import refine
from calib.gap.relevance import relevance
from calib.inference.defined import check_defined
from calib.inference.random import generator
from calib.inference.sampling.mode import find_mode
from calib.models.base import Array

__all__ = ["Lab", "Odds", "Ranking", "calibrate_lab", "rank"]

# Internal parameters of each simulator, and its noise.
type Lab = tuple[dict[str, Array], dict[str, Noise]]
# A hypothesis, and fits of parts of it.
type _Started = tuple[Hypothesis, list[Fit]]

_N_SCREEN = 96
_N_BEGUN = 5
_N_THRESHOLDS = 24
# Effects of which one is in every pair that is tried, and sets from which larger ones grow.
_N_PAIR_SEEDS, _N_SETS, _MOST_CAUSES = 6, 3, 4
# Guesses from which a set made of another is begun.
_N_BEGUN_LARGER = 2
# Explanations beside which something unlisted is tried as well.
_N_LEADING, _N_LEADING_SETS = 5, 2
# An effect that far out in its prior (sds) is fitted with a wider one as well.
_FAR_OUT = 2.0
# Draws of the prior by which a row is tried.
_N_TRIED = 32
_IDLE = "it changes nothing that the models of this case predict"
# A discrepancy or a pair that is so many nats (prior and all) behind the best hypothesis after a
# truncated fit is given up. Of 1344 discrepancies and 2698 pairs (14 cases) those that ended
# within 8 nats of the best were then less than 13.5 and 10.6 behind.
_HOPELESS = 15.0
# One within so many nats is begun from more guesses: a pair has many modes.
_SEARCHED = 8.0
# Draws for the relevance of a hypothesis: at first, and while it is still in play.
_QUICK, _CAREFUL = 160, 3000
# A hypothesis is in play within so many nats of the best, its variants within so many of its best;
# one that is farther behind than the last of these is not made likely by its relevance.
_IN_PLAY, _BESIDE, _FAR_BEHIND = 4.0, 2.5, 10.0


@dataclass(frozen=True)
class Ranking:
    """All fitted hypotheses.

    Parameters
    ----------
    fits : mapping of str to tuple of Fit
        By name; several where prior scales, or ways to shift or to be unlisted, were averaged over.
    scores : mapping of str to tuple of float
        Log evidence of each fit, for effects that matter, times its share in its hypothesis.
    log_evidence : mapping of str to float
    probability : mapping of str to float
        Sums to one.
    not_testable : mapping of str to str
        Effect to reason.
    lab_mode : mapping of str to ndarray
        Internal parameters of each simulator as the lab calibrated it.
    isolability : Isolability
        What the design could show before its outcomes were looked at.
    odds : Odds
        Probabilities of the hypotheses before the data.
    """

    fits: Mapping[str, tuple[Fit, ...]]
    scores: Mapping[str, tuple[float, ...]]
    log_evidence: Mapping[str, float]
    probability: Mapping[str, float]
    not_testable: Mapping[str, str]
    lab_mode: Mapping[str, Array]
    isolability: Isolability
    odds: Odds

    @property
    def order(self) -> list[str]:
        """Names, most probable first."""
        return sorted(self.probability, key=lambda name: -self.probability[name])

    @property
    def prior(self) -> dict[str, float]:
        """Probability of each hypothesis before the data; sums to one."""
        shares = {
            name: min(sum(f.forward.hypothesis.share for f in group), 1.0)
            for name, group in self.fits.items()
        }
        return probabilities({n: float(np.log(s)) for n, s in shares.items()}, self.odds)

    def best(self, name: str) -> Fit:
        """The most probable fit of a hypothesis."""
        return self.fits[name][int(np.argmax(self.scores[name]))]


def rank(
    data: Campaigns,
    seed: int,
    *,
    effects: Mapping[str, Effect] = EFFECTS,
    lab: Lab | None = None,
    design: Isolability | None = None,
) -> Ranking:
    """Fit every hypothesis and rank them.

    Parameters
    ----------
    data : Campaigns
    seed : int
    effects : mapping of str to Effect, optional
    lab : Lab, optional
        If `calibrate_lab` has been called before.
    design : Isolability, optional
        What the design could show, if it is known from a campaign that has all of these rows.
    """
    able, unable = split_testable(data, {**effects, **dependences(data)})
    lab_mode, noise = lab or calibrate_lab(data, seed)
    single = singles(data, able)
    beside = {h.name for h in single if covered(h.effects[0], able)}
    listed = [h for h in single if h.name not in beside]
    design = design or isolability(data, listed, lab_mode, noise, seed)
    single = [h for h in single if h.name not in design.idle]
    unable |= dict.fromkeys(design.idle, _IDLE)
    single = [replace(h, share=COVERED) if h.name in beside else h for h in single]
    context = data.case.context
    _check_names(context, {*able, *unable})
    single = [context.sized(h) for h in single if h.name not in context.excluded]
    unable |= dict.fromkeys(context.excluded, "it is excluded in the case's [context]")
    beside -= set(context.excluded)
    odds = Odds.of(len(single) - len(beside), context)
    worker = _Worker(data, lab_mode, noise, seed, odds)
    fits = worker.fit([Hypothesis("none"), *shifts(data), *single])
    far = [h for h in single if _far_out(fits[h.name][0])]
    for name, more in worker.fit([wider(h) for h in far]).items():
        fits[name] += more
    fits |= _sets_and_unlisted(worker, [h.name for h in single if h.name not in beside], fits)
    fits, scores = _scored(fits, worker.odds, seed)
    log_evidence = {name: float(logsumexp(values)) for name, values in scores.items()}
    probability = probabilities(log_evidence, worker.odds)
    return Ranking(fits, scores, log_evidence, probability, unable, lab_mode, design, worker.odds)


def _check_names(context: Context, known: set[str]) -> None:
    """Refuse a context that speaks of what nobody knows."""
    strange = [n for n in context.names if n not in known and n != "parameter_shift"]
    strange += [n for n in (*context.excluded, *context.sizes) if n == "parameter_shift"]
    if strange:
        raise CalibError(
            f"the context speaks of {strange[0]}",
            where="[context] of case.toml",
            allowed=", ".join(sorted(known)) + "; parameter_shift may be suspected",
            mend="correct the name, or leave it out",
        )


def _far_out(found: Fit) -> bool:
    """Whether an effect is larger than its prior says."""
    part = found.forward.phi_slices[0]
    priors = found.forward.priors.free[part]
    off = [abs(t - p.loc) / p.scale for t, p in zip(found.psi[part], priors, strict=True)]
    return max(off, default=0.0) > _FAR_OUT


def _sets_and_unlisted(
    worker: _Worker, single: Sequence[str], fits: Mapping[str, tuple[Fit, ...]]
) -> dict[str, tuple[Fit, ...]]:
    """Fit what is not listed, by itself and beside the best explanations, and sets of effects."""
    n = worker.odds
    best = {name: max(group, key=partial(_with_prior, odds=n)) for name, group in fits.items()}
    alone = sorted((best[m] for m in best if m != "none"), key=lambda f: -_with_prior(f, n))
    others: list[_Started] = [(h, []) for h in unknowns(worker.data)]
    others += [
        (h, [f])
        for f in alone[:_N_LEADING]
        for h in with_remainder(worker.data, f.forward.hypothesis)
    ]
    ranked = sorted(single, key=lambda m: -best[m].log_evidence)
    seeds = ranked[:_N_PAIR_SEEDS]
    pairs: list[_Started] = [
        (joined(best[a].forward.hypothesis, best[b].forward.hypothesis), [best[a], best[b]])
        for i, a in enumerate(single)
        for b in single[i + 1 :]
        if (a in seeds or b in seeds) and _apart(best[a], best[b])
    ]
    truncated_fits = together(
        [worker.truncated_joint(h, members, 1) for h, members in others + pairs]
    )
    leading = max(
        _promise(truncated, n) for truncated in (*((f,) for f in best.values()), *truncated_fits)
    )
    first = len(others)
    truncated_fits[first:] = worker.search(pairs, truncated_fits[first:], leading)
    ended = _finished(truncated_fits, leading - _HOPELESS, n)
    leading = max(leading, *(_with_prior(f, n) for f in ended))
    sets = ended[first:]
    # What is unlisted takes up what is left of any listed causes: they are compared without it.
    listed = max(_with_prior(f, n) for f in (*best.values(), *sets))
    grown = _leading(sets, listed, n)
    members = [best[m] for m in single]
    while grown:
        known = [f.forward.hypothesis.name for f in sets if _with_prior(f, n) > listed - _SEARCHED]
        changed = worker.begun(_exchanged(grown, members, known), listed)
        listed = max([listed, *(_with_prior(f, n) for f in changed)])
        grown = _leading([*grown, *changed], listed, n)
        larger: list[Fit] = []
        if len(grown[0].forward.hypothesis.effects) < _MOST_CAUSES:
            larger = worker.begun(_larger(grown, members), listed)
        sets += changed + larger
        listed = max([listed, *(_with_prior(f, n) for f in larger)])
        grown = _leading(larger, listed, n)
    leading = max(leading, listed)
    top = sorted(sets, key=lambda f: -_with_prior(f, n))[:_N_LEADING_SETS]
    top = [f for f in top if _with_prior(f, n) > leading - _SEARCHED]
    beside = _with_remainders(worker.data, top)
    truncated_fits = together([worker.truncated_joint(h, of, 1) for h, of in beside])
    everything = [*ended[:first], *sets, *_finished(truncated_fits, leading - _HOPELESS, n)]
    by_name: dict[str, tuple[Fit, ...]] = {}
    for found_one in everything:
        name = found_one.forward.hypothesis.name
        by_name[name] = (*by_name.get(name, ()), found_one)
    return by_name


def _with_remainders(data: Campaigns, causes: Sequence[Fit]) -> list[_Started]:
    return [(h, [f]) for f in causes for h in with_remainder(data, f.forward.hypothesis)]


def _larger(sets: Sequence[Fit], single: Sequence[Fit]) -> list[_Started]:
    """Sets of one more effect than some; each once, whatever it grew from."""
    found: dict[str, _Started] = {}
    for a in sets:
        names = {e.name for e in a.forward.hypothesis.effects}
        for b in single:
            if b.forward.hypothesis.name not in names and _apart(a, b):
                h = joined(a.forward.hypothesis, b.forward.hypothesis)
                found.setdefault(h.name, (h, [a, b]))
    return list(found.values())


def _leading(sets: Sequence[Fit], listed: float, odds: Odds) -> list[Fit]:
    """Sets from which others are made: the best of those in play."""
    ranked = sorted(sets, key=lambda f: -_with_prior(f, odds))[:_N_SETS]
    return [f for f in ranked if _with_prior(f, odds) > listed - _IN_PLAY]


def _exchanged(
    sets: Sequence[Fit], single: Sequence[Fit], known: Collection[str]
) -> list[_Started]:
    """Sets with one effect of some in the place of another, but for those that are known."""
    found: dict[str, _Started] = {}
    alone = {f.forward.hypothesis.name: f.forward.hypothesis for f in single}
    for a in sets:
        names = [e.name for e in a.forward.hypothesis.effects]
        for out in names:
            kept = [alone[name] for name in names if name != out]
            for b in single:
                new = b.forward.hypothesis
                if new.name in names or not all(_compatible(new, h) for h in kept):
                    continue
                h = joined(*kept, new)
                if h.name not in known:
                    found.setdefault(h.name, (h, [a]))
    return list(found.values())


def _apart(a: Fit, b: Fit) -> bool:
    """Whether no effect of one explanation holds one of the other already."""
    return _compatible(a.forward.hypothesis, b.forward.hypothesis)


def _compatible(a: Hypothesis, b: Hypothesis) -> bool:
    return not any(
        e.name in other.holds or other.name in e.holds for e in a.effects for other in b.effects
    )


def _finished(truncated_fits: Sequence[Sequence[Fit]], hopeless: float, odds: Odds) -> list[Fit]:
    """Fit hypotheses fully from their truncated fits, but for those that are hopeless."""
    worth = [
        i for i, truncated in enumerate(truncated_fits) if _promise(truncated, odds) > hopeless
    ]
    ended = [max(truncated, key=_evidence) for truncated in truncated_fits]
    for i, found in zip(worth, together([finish(truncated_fits[i]) for i in worth]), strict=True):
        ended[i] = found
    return ended


def _promise(begun: Sequence[Fit], odds: Odds) -> float:
    return max(_with_prior(f, odds) for f in begun)


def _evidence(found: Fit) -> float:
    return found.log_evidence


def _with_prior(found: Fit, odds: Odds) -> float:
    """Log of evidence times the prior of a variant of a hypothesis."""
    hypothesis = found.forward.hypothesis
    prior = odds.ln_prior(hypothesis.name) + float(np.log(hypothesis.share))
    return found.log_evidence + prior


def _scored(
    fits: Mapping[str, tuple[Fit, ...]], odds: Odds, seed: int
) -> tuple[dict[str, tuple[Fit, ...]], dict[str, tuple[float, ...]]]:
    """Score every variant, and by draws of their posteriors those that are still in play."""
    promise = {name: [_with_prior(f, odds) for f in group] for name, group in fits.items()}
    far = max(max(values) for values in promise.values()) - _FAR_BEHIND
    scores = {
        name: [
            _score(f, seed, _QUICK if p > far else 0)
            for f, p in zip(group, promise[name], strict=True)
        ]
        for name, group in fits.items()
    }
    total = {name: max(values) + odds.ln_prior(name) for name, values in scores.items()}
    least = max(total.values()) - _IN_PLAY
    refined = {name: list(group) for name, group in fits.items()}
    for name, values in scores.items():
        beside = max(values) - _BESIDE
        for i, value in enumerate(values):
            if value > beside and value + odds.ln_prior(name) > least:
                refined[name][i] = refine(fits[name][i], seed)
                values[i] = _score(refined[name][i], seed, _CAREFUL)
    return (
        {name: tuple(group) for name, group in refined.items()},
        {name: tuple(values) for name, values in scores.items()},
    )


def _score(found: Fit, seed: int, draws: int) -> float:
    """Log of evidence times relevance (if it is drawn) times a variant's share in its name."""
    share = found.forward.hypothesis.share
    relevant = relevance(found, seed, draws) if draws else 0.0
    return found.log_evidence + relevant + float(np.log(share))


def probabilities(log_evidence: Mapping[str, float], odds: Odds) -> dict[str, float]:
    """Posterior probabilities of hypotheses from their evidence."""
    score = {name: value + odds.ln_prior(name) for name, value in log_evidence.items()}
    total = logsumexp(list(score.values()))
    return {name: float(np.exp(value - total)) for name, value in score.items()}


@dataclass(frozen=True)
class Odds:
    """Probabilities of hypotheses before the data.

    Parameters
    ----------
    n_single : int
        Effects among which the prior probability of one listed effect is shared out.
    suspicion : mapping of str to float
        Cause to the logarithm of the ratio of its odds to act to what they are without a context.
    """

    n_single: int
    suspicion: Mapping[str, float]

    @classmethod
    def of(cls, n_single: int, context: Context) -> Odds:
        """Take what is suspected into account."""
        plain = cls(n_single, {})
        usual = {
            name: float(np.exp(plain.ln_prior(name)) / (1.0 - REMAINDER))
            for name in context.suspected
        }
        return cls(
            n_single,
            {n: _logit(p) - _logit(min(usual[n], 0.5)) for n, p in context.suspected.items()},
        )

    def ln_prior(self, name: str) -> float:
        """Log probability of a hypothesis, up to a constant."""
        if name in ("none", "unknown"):
            return LN_PRIOR[name]
        causes = name.split("+")
        listed = [c for c in causes if c != "unknown"]
        rest = REMAINDER if len(listed) < len(causes) else 1.0 - REMAINDER
        prior = float(np.log(rest)) + sum(self.suspicion.get(c, 0.0) for c in listed)
        if listed == ["parameter_shift"]:
            return LN_PRIOR["parameter_shift"] + prior
        single = LN_PRIOR["single"] - float(np.log(max(self.n_single, 1)))
        return single + (len(listed) - 1) * LN_PAIR_TO_SINGLE + prior


def _logit(p: float) -> float:
    return float(np.log(p / (1.0 - p)))


def calibrate_lab(data: Campaigns, seed: int) -> Lab:
    """Mode of each output's simulator on the lab, and its noise."""
    modes, noise = {}, {}
    for o in data.outputs:
        rng = generator(seed, "gap", "lab", o.name)
        _check_defined(data, o, generator(seed, "gap", "defined", o.name))
        mode = find_mode(o.problem.log_prob, o.problem.priors, rng, n_climb=8)
        modes[o.name] = mode[:-1]
        sigma = float(o.problem.theta(mode[None])[0, -1])
        noise[o.name] = Noise(sigma, 0.0)
    return modes, noise


def _check_defined(data: Campaigns, o: OutputData, rng: np.random.Generator) -> None:
    """Refuse rows of either campaign at which a simulator has no value."""
    problem, field = o.problem, data.case.field
    theta = o.priors.to_natural(o.priors.sample(rng, _N_TRIED))
    check_defined(
        problem.bound, theta, problem.conditions, data.case.lab.source, problem.table.lines
    )
    there = {k: v[o.rows] for k, v in problem.bound.model.select(data.view.conditions).items()}
    check_defined(problem.bound, theta, there, field.source, field.lines[o.rows])


class _Worker:
    def __init__(
        self, data: Campaigns, lab_mode: Mapping[str, Array], noise: Mapping[str, Noise], seed: int,
        odds: Odds,
    ) -> None:  # fmt: skip
        self.data, self.lab_mode, self.noise, self.seed = data, lab_mode, noise, seed
        self.odds = odds
        self._bases: Bases = {}

    def fit(self, hypotheses: Sequence[Hypothesis]) -> dict[str, tuple[Fit, ...]]:
        """Fit from the lab's calibration, by name."""
        truncated = together([self.truncated(h) for h in hypotheses])
        fits: dict[str, tuple[Fit, ...]] = {}
        for found in together([finish(group) for group in truncated]):
            name = found.forward.hypothesis.name
            fits[name] = (*fits.get(name, ()), found)
        return fits

    def truncated(self, hypothesis: Hypothesis) -> Walk[list[Fit]]:
        """Begin at the lab's calibration, effects at several guesses of their prior."""
        forward, start = self._forward(hypothesis)
        if hypothesis.onset_over is not None:
            return truncated_fit(self.data, forward, self._onset_start(forward, start), self.noise)
        if not hypothesis.effects:
            return truncated_fit(self.data, forward, start, self.noise)
        starts = self._spread(forward, start, _N_SCREEN, range(len(hypothesis.effects)))
        return truncated_fit(self.data, forward, start, self.noise, starts=starts, count=_N_BEGUN)

    def search(
        self,
        pairs: Sequence[_Started],
        truncated_fits: Sequence[list[Fit]],
        leading: float,
    ) -> list[list[Fit]]:
        """Begin the pairs that are in play from more guesses."""
        in_play = [
            i
            for i in range(len(pairs))
            if _promise(truncated_fits[i], self.odds) > leading - _SEARCHED
        ]
        more = together([self.truncated_joint(*pairs[i], _N_BEGUN, skip=1) for i in in_play])
        searched = [list(truncated) for truncated in truncated_fits]
        for i, truncated in zip(in_play, more, strict=True):
            searched[i] += truncated
        return searched

    def begun(self, sets: Sequence[_Started], listed: float) -> list[Fit]:
        """Fit sets, those fully that come near the best explanation of listed causes."""
        truncated_fits = together(
            [self.truncated_joint(h, of, _N_BEGUN_LARGER) for h, of in sets]
        )
        return _finished(truncated_fits, listed - _SEARCHED, self.odds)

    def truncated_joint(
        self, hypothesis: Hypothesis, members: Sequence[Fit], count: int, skip: int = 0
    ) -> Walk[list[Fit]]:
        """Begin where parts of a hypothesis have led, the effects they lack by their prior."""
        if not members:
            return self.truncated(hypothesis)
        forward, start = self._forward(hypothesis)
        place = {e.name: s for e, s in zip(hypothesis.effects, forward.phi_slices, strict=True)}
        parts = []
        for member in members:
            old, led = member.forward, start.copy()
            for o in self.data.outputs:
                led[forward.theta_slices[o.name]] = member.psi[old.theta_slices[o.name]]
            for e, s in zip(old.hypothesis.effects, old.phi_slices, strict=True):
                if e.name in place:
                    led[place[e.name]] = member.psi[s]
            if old.shift is not None:
                led[forward.shift_slice] = member.psi[old.shift_slice]
            known = {e.name for e in old.hypothesis.effects}
            lacking = [i for i, e in enumerate(hypothesis.effects) if e.name not in known]
            size = _N_SCREEN // len(members) if lacking else 1
            parts.append(self._spread(forward, led, size, lacking))
        starts = np.concatenate(parts)
        return truncated_fit(
            self.data, forward, start, self.noise, starts=starts, count=count, skip=skip
        )

    def _forward(self, hypothesis: Hypothesis) -> tuple[Forward, Array]:
        scale = {o: n.sigma for o, n in self.noise.items()}
        forward = Forward(self.data, hypothesis, scale, self.lab_mode, bases=self._bases)
        start = np.array([p.loc for p in forward.priors.free])
        for o in self.data.outputs:
            start[forward.theta_slices[o.name]] = self.lab_mode[o.name]
        return forward, start

    def _onset_start(self, forward: Forward, start: Array) -> Array:
        """The threshold, and the step and bend there, that the lab's residuals show best."""
        lower, upper = (
            getattr(forward.priors.free[forward.threshold], e) for e in ("lower", "upper")
        )
        thresholds = np.linspace(lower, upper, _N_THRESHOLDS)
        plain = forward.simulator(start[None], self.data.view)
        left = np.zeros(_N_THRESHOLDS)
        starts = np.repeat(start[None], _N_THRESHOLDS, axis=0)
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
        rng = generator(self.seed, "gap", hypothesis.name, *which)
        starts = np.repeat(start[None], size, axis=0)
        for i in which:
            effect, priors = hypothesis.effects[i], hypothesis.effect_priors[i]
            drawn = priors.sample(rng, size)
            if type(effect).begun is not Effect.begun:
                natural = effect.begun(
                    priors.to_natural(drawn), self._left(forward, start), self.data.view
                )
                drawn = priors.to_internal(natural)
            starts[:, forward.phi_slices[i]] = drawn
        return starts

    def _left(self, forward: Forward, start: Array) -> dict[str, Array]:
        """What a guess leaves of the field's readings, by the role of the output."""
        predicted = forward.field(start[None], self.data.view)
        left = {}
        for o in self.data.outputs:
            left[o.role] = np.full(predicted[o.name].shape[1], np.nan)
            left[o.role][o.rows] = o.field - predicted[o.name][0, o.rows]
        return left
