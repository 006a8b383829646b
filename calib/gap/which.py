"""Which hypothesis: fit them all, turn evidence into probabilities."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from calib.gap.case import Campaigns
from calib.gap.effects import EFFECTS, Effect
from calib.gap.fit import Fit, Noise, fit
from calib.gap.forward import Forward, Hypothesis
from calib.gap.hypotheses import (
    LN_PAIR_TO_SINGLE,
    LN_PRIOR,
    SHIFTS,
    pairs_of,
    singles,
    split_testable,
    unknowns,
)
from calib.gap.isolate import Isolability, isolability
from calib.gap.relevance import relevance
from calib.models.base import Array
from calib.sampling.mode import find_mode
from calib.streams import generator

__all__ = ["Ranking", "rank"]

_N_SCREEN = 96
_N_PAIR_SEEDS = 6


@dataclass(frozen=True)
class Ranking:
    """All fitted hypotheses.

    Parameters
    ----------
    fits : mapping of str to tuple of Fit
        By name; several where a prior scale was averaged over.
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
    log_evidence: Mapping[str, float]
    probability: Mapping[str, float]
    not_testable: Mapping[str, str]
    lab_mode: Mapping[str, Array]
    isolability: Isolability

    @property
    def order(self) -> list[str]:
        """Names, most probable first."""
        return sorted(self.probability, key=lambda name: -self.probability[name])


def rank(data: Campaigns, seed: int, *, effects: Mapping[str, Effect] = EFFECTS) -> Ranking:
    """Fit every hypothesis and rank them."""
    able, unable = split_testable(data, effects)
    lab_mode, noise = _calibrate_lab(data, seed)
    single = singles(data, able)
    design = isolability(data, single, lab_mode, noise, seed)
    worker = _Worker(data, lab_mode, noise, seed)
    fits: dict[str, tuple[Fit, ...]] = {"none": (worker.fit(Hypothesis("none")),)}
    fits["unknown"] = tuple(worker.fit(h) for h in unknowns(data))
    fits["parameter_shift"] = tuple(
        worker.fit(Hypothesis("parameter_shift", shift=s)) for s in SHIFTS
    )
    for h in single:
        fits[h.name] = (worker.fit(h),)
    for h in _promising_pairs(single, fits):
        fits[h.name] = (worker.fit(h),)
    log_evidence = {
        name: float(
            logsumexp([f.log_evidence + relevance(f, seed) for f in group]) - np.log(len(group))
        )
        for name, group in fits.items()
    }
    probability = probabilities(log_evidence, len(single))
    return Ranking(fits, log_evidence, probability, unable, lab_mode, design)


def probabilities(log_evidence: Mapping[str, float], n_single: int) -> dict[str, float]:
    """Posterior probabilities of hypotheses from their evidence."""
    score = {}
    for name, value in log_evidence.items():
        if name in ("none", "unknown", "parameter_shift"):
            prior = LN_PRIOR[name]
        elif "+" in name:
            prior = LN_PRIOR["single"] - np.log(max(n_single, 1)) + LN_PAIR_TO_SINGLE
        else:
            prior = LN_PRIOR["single"] - np.log(max(n_single, 1))
        score[name] = value + prior
    total = logsumexp(list(score.values()))
    return {name: float(np.exp(value - total)) for name, value in score.items()}


def _promising_pairs(
    single: Sequence[Hypothesis], fits: Mapping[str, tuple[Fit, ...]]
) -> list[Hypothesis]:
    """Pairs that contain one of the best single effects; the others cannot be the best pair."""
    ranked = sorted(single, key=lambda h: -fits[h.name][0].log_evidence)
    best = {h.name for h in ranked[:_N_PAIR_SEEDS]}
    return [h for h in pairs_of(single) if best & {e.name for e in h.effects}]


def _calibrate_lab(data: Campaigns, seed: int) -> tuple[dict[str, Array], dict[str, Noise]]:
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

    def fit(self, hypothesis: Hypothesis) -> Fit:
        scale = {o: n.sigma for o, n in self.noise.items()}
        forward = Forward(self.data, hypothesis, scale, self.lab_mode)
        start = np.array([p.loc for p in forward.priors.free])
        for o in self.data.outputs:
            start[forward.theta_slices[o.name]] = self.lab_mode[o.name]
        starts = None
        if hypothesis.effects:
            rng = generator(self.seed, "gap", hypothesis.name)
            starts = np.repeat(start[None], _N_SCREEN, axis=0)
            for s, p in zip(forward.phi_slices, hypothesis.effect_priors, strict=True):
                starts[:, s] = p.sample(rng, _N_SCREEN)
        return fit(self.data, forward, start, self.noise, starts=starts)
