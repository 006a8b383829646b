"""Which hypothesis: fit them all, turn evidence into probabilities."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from calib.gap.ascent import Walk, together
from calib.gap.case import Campaigns
from calib.gap.discrepancy import Bases
from calib.gap.effects import EFFECTS, Effect
from calib.gap.fit import Fit, finish, look
from calib.gap.forward import Forward
from calib.gap.hypotheses import (
    LN_PAIR_TO_SINGLE,
    LN_PRIOR,
    pairs_of,
    remainders,
    shifts,
    singles,
    split_testable,
    unknowns,
)
from calib.gap.hypothesis import Hypothesis
from calib.gap.isolate import Isolability, isolability
from calib.gap.noise import Noise
from calib.gap.refine import refine
from calib.gap.relevance import relevance
from calib.inference.random import generator
from calib.inference.sampling.mode import find_mode
from calib.models.base import Array

__all__ = ["Lab", "Ranking", "calibrate_lab", "rank"]

# Internal parameters of each simulator, and its noise.
type Lab = tuple[dict[str, Array], dict[str, Noise]]

_N_SCREEN = 96
_N_BEGUN = 5
_N_THRESHOLDS = 24
_N_PAIR_SEEDS = 6
_N_LEADING = 2
_IDLE = "it changes nothing that the models of this case predict"
# A discrepancy or a pair that is so many nats (prior and all) behind the best hypothesis at first
# look is given up. Of 1344 discrepancies and 2698 first looks at pairs (14 cases) those that ended
# within 8 nats of the best were then less than 13.5 and 10.6 behind.
_HOPELESS = 15.0
# One within so many nats is looked at from more guesses: a pair has many modes.
_SEARCHED = 8.0
# Draws for the relevance of a hypothesis: at first, and while it is still in play.
_QUICK, _CAREFUL = 160, 3000
# A hypothesis is in play within so many nats of the best, its variants within so many of its best.
_IN_PLAY, _BESIDE = 5.0, 3.0


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
    """

    fits: Mapping[str, tuple[Fit, ...]]
    scores: Mapping[str, tuple[float, ...]]
    log_evidence: Mapping[str, float]
    probability: Mapping[str, float]
    not_testable: Mapping[str, str]
    lab_mode: Mapping[str, Array]
    isolability: Isolability

    @property
    def order(self) -> list[str]:
        """Names, most probable first."""
        return sorted(self.probability, key=lambda name: -self.probability[name])

    @property
    def prior(self) -> dict[str, float]:
        """Probability of each hypothesis before the data; sums to one."""
        names = [n for n in self.probability if n not in LN_PRIOR and "+" not in n]
        return probabilities(dict.fromkeys(self.probability, 0.0), len(names))

    def best(self, name: str) -> Fit:
        """The most probable fit of a hypothesis."""
        return self.fits[name][int(np.argmax(self.scores[name]))]


def rank(
    data: Campaigns, seed: int, *, effects: Mapping[str, Effect] = EFFECTS, lab: Lab | None = None
) -> Ranking:
    """Fit every hypothesis and rank them; `lab` if `calibrate_lab` has been called before."""
    able, unable = split_testable(data, effects)
    lab_mode, noise = lab or calibrate_lab(data, seed)
    single = singles(data, able)
    design = isolability(data, single, lab_mode, noise, seed)
    single = [h for h in single if h.name not in design.idle]
    unable |= dict.fromkeys(design.idle, _IDLE)
    worker = _Worker(data, lab_mode, noise, seed)
    fits = worker.fit([Hypothesis("none"), *shifts(data), *single])
    fits |= _unlisted_and_pairs(worker, single, fits)
    fits, scores = _scored(fits, len(single), seed)
    log_evidence = {name: float(logsumexp(values)) for name, values in scores.items()}
    probability = probabilities(log_evidence, len(single))
    return Ranking(fits, scores, log_evidence, probability, unable, lab_mode, design)


def _unlisted_and_pairs(
    worker: _Worker, single: Sequence[Hypothesis], fits: Mapping[str, tuple[Fit, ...]]
) -> dict[str, tuple[Fit, ...]]:
    """Fit what is not listed, and pairs; finish those that are not hopeless at first look."""
    n = len(single)
    alone = [fits["parameter_shift"], *(fits[h.name] for h in single)]
    best = sorted((max(group, key=_evidence) for group in alone), key=_evidence, reverse=True)
    leaders = [f.forward.hypothesis for f in best[:_N_LEADING]]
    others = unknowns(worker.data) + remainders(worker.data, leaders, n)
    pairs = [(h, [fits[e.name][0] for e in h.effects]) for h in _promising_pairs(single, fits)]
    looked = together(
        [worker.look(h) for h in others] + [worker.look_pair(h, members, 1) for h, members in pairs]
    )
    leading = max(_promise(looks, n) for looks in (*fits.values(), *looked))
    first = len(others)
    searched = [
        i for i in range(len(pairs)) if _promise(looked[first + i], n) > leading - _SEARCHED
    ]
    more = together([worker.look_pair(*pairs[i], _N_BEGUN, skip=1) for i in searched])
    for i, looks in zip(searched, more, strict=True):
        looked[first + i] += looks
    ended = _finished(looked, leading - _HOPELESS, n)
    found = {h.name: (f,) for (h, _), f in zip(pairs, ended[first:], strict=True)}
    return {"unknown": tuple(ended[:first])} | found


def _finished(looked: Sequence[Sequence[Fit]], hopeless: float, n_single: int) -> list[Fit]:
    """Climb on from first looks at hypotheses, but for those that are hopeless."""
    worth = [i for i, looks in enumerate(looked) if _promise(looks, n_single) > hopeless]
    ended = [max(looks, key=_evidence) for looks in looked]
    for i, found in zip(worth, together([finish(looked[i]) for i in worth]), strict=True):
        ended[i] = found
    return ended


def _promise(looks: Sequence[Fit], n_single: int) -> float:
    return max(_with_prior(f, n_single) for f in looks)


def _evidence(found: Fit) -> float:
    return found.log_evidence


def _with_prior(found: Fit, n_single: int) -> float:
    """Log of evidence times the prior of a variant of a hypothesis."""
    hypothesis = found.forward.hypothesis
    prior = _ln_prior(hypothesis.name, n_single) + float(np.log(hypothesis.share))
    return found.log_evidence + prior


def _scored(
    fits: Mapping[str, tuple[Fit, ...]], n_single: int, seed: int
) -> tuple[dict[str, tuple[Fit, ...]], dict[str, tuple[float, ...]]]:
    """Score every variant, and by draws of their posteriors those that are still in play."""
    promise = {name: [_with_prior(f, n_single) for f in group] for name, group in fits.items()}
    hopeless = max(max(values) for values in promise.values()) - _HOPELESS
    scores = {
        name: [
            _score(f, seed, _QUICK if p > hopeless else 0)
            for f, p in zip(group, promise[name], strict=True)
        ]
        for name, group in fits.items()
    }
    total = {name: max(values) + _ln_prior(name, n_single) for name, values in scores.items()}
    least = max(total.values()) - _IN_PLAY
    refined = {name: list(group) for name, group in fits.items()}
    for name, values in scores.items():
        beside = max(values) - _BESIDE
        for i, value in enumerate(values):
            if value > beside and value + _ln_prior(name, n_single) > least:
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


def probabilities(log_evidence: Mapping[str, float], n_single: int) -> dict[str, float]:
    """Posterior probabilities of hypotheses from their evidence."""
    score = {name: value + _ln_prior(name, n_single) for name, value in log_evidence.items()}
    total = logsumexp(list(score.values()))
    return {name: float(np.exp(value - total)) for name, value in score.items()}


def _ln_prior(name: str, n_single: int) -> float:
    if name in ("none", "unknown", "parameter_shift"):
        return LN_PRIOR[name]
    single = LN_PRIOR["single"] - float(np.log(max(n_single, 1)))
    return single + LN_PAIR_TO_SINGLE if "+" in name else single


def _promising_pairs(
    single: Sequence[Hypothesis], fits: Mapping[str, tuple[Fit, ...]]
) -> list[Hypothesis]:
    """Pairs that contain one of the best single effects; the others cannot be the best pair."""
    ranked = sorted(single, key=lambda h: -fits[h.name][0].log_evidence)
    best = {h.name for h in ranked[:_N_PAIR_SEEDS]}
    return [h for h in pairs_of(single) if best & {e.name for e in h.effects}]


def calibrate_lab(data: Campaigns, seed: int) -> Lab:
    """Mode of each output's simulator on the lab, and its noise."""
    modes, noise = {}, {}
    for o in data.outputs:
        rng = generator(seed, "gap", "lab", o.name)
        mode = find_mode(o.problem.log_prob, o.problem.priors, rng, n_climb=8)
        modes[o.name] = mode[:-1]
        sigma = float(o.problem.theta(mode[None])[0, -1])
        noise[o.name] = Noise(sigma, 0.0)
    return modes, noise


class _Worker:
    def __init__(
        self, data: Campaigns, lab_mode: Mapping[str, Array], noise: Mapping[str, Noise], seed: int
    ) -> None:
        self.data, self.lab_mode, self.noise, self.seed = data, lab_mode, noise, seed
        self._bases: Bases = {}

    def fit(self, hypotheses: Sequence[Hypothesis]) -> dict[str, tuple[Fit, ...]]:
        """Fit from the lab's calibration, by name."""
        looks = together([self.look(h) for h in hypotheses])
        fits: dict[str, tuple[Fit, ...]] = {}
        for found in together([finish(group) for group in looks]):
            name = found.forward.hypothesis.name
            fits[name] = (*fits.get(name, ()), found)
        return fits

    def look(self, hypothesis: Hypothesis) -> Walk[list[Fit]]:
        """Begin at the lab's calibration, effects at several guesses of their prior."""
        forward, start = self._forward(hypothesis)
        if hypothesis.onset_over is not None:
            return look(self.data, forward, self._onset_start(forward, start), self.noise)
        if not hypothesis.effects:
            return look(self.data, forward, start, self.noise)
        starts = self._spread(forward, start, _N_SCREEN, range(len(hypothesis.effects)))
        return look(self.data, forward, start, self.noise, starts=starts, count=_N_BEGUN)

    def look_pair(
        self, hypothesis: Hypothesis, members: Sequence[Fit], count: int, skip: int = 0
    ) -> Walk[list[Fit]]:
        """Begin two effects where each alone has led."""
        forward, start = self._forward(hypothesis)
        parts = []
        for i, member in enumerate(members):
            led = start.copy()
            for o in self.data.outputs:
                led[forward.theta_slices[o.name]] = member.psi[member.forward.theta_slices[o.name]]
            led[forward.phi_slices[i]] = member.psi[member.forward.phi_slices[0]]
            parts.append(self._spread(forward, led, _N_SCREEN // 2, [1 - i]))
        starts = np.concatenate(parts)
        return look(self.data, forward, start, self.noise, starts=starts, count=count, skip=skip)

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
            starts[:, forward.phi_slices[i]] = hypothesis.effect_priors[i].sample(rng, size)
        return starts
