"""Rank all hypotheses: fit them, turn evidence into probabilities."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from calib.errors import CalibError, meant
from calib.gap.campaigns import Campaigns, OutputData
from calib.gap.case import Context
from calib.gap.constants import FOLLOWS_RUNS, PLENTY, SEARCH
from calib.gap.effects import EFFECTS, Effect
from calib.gap.fit import Fit
from calib.gap.hypotheses import (
    Hypothesis,
    prior_share,
    shifts,
    singles,
    split_testable,
    wider,
    with_case_effects,
    with_known_size,
)
from calib.gap.identifiability import Identifiability, identifiability
from calib.gap.importance import refine
from calib.gap.noise import Noise
from calib.gap.odds import (
    Odds,
    gap_size,
    likelihood_tempering,
    ln_size_restriction,
    probabilities,
    with_prior,
)
from calib.gap.search import StartingPoints, search_sets, unusually_large
from calib.inference.mode import find_mode
from calib.inference.random import generator
from calib.inference.search import check_defined
from calib.models.base import Array


def change_over_runs(residual: Array, order: Array) -> float:
    """Most by which a straight line or one step over the runs raises the log likelihood.

    The noise is what is left in either case.
    """
    z = residual[np.argsort(order, kind="stable")]
    n, u = z.size, np.arange(z.size) - 0.5 * (z.size - 1)
    z = z - z.mean()
    before = np.arange(1, n)
    of_step = np.square(np.cumsum(z)[:-1]) * n / (before * (n - before))
    of_line = np.square(u @ z) / np.square(u).sum()
    total = float(np.square(z).sum())
    if total <= 1e-20 * float(np.square(residual).sum()):
        return 0.0
    part = max(float(of_step.max()), float(of_line)) / total
    return -0.5 * n * float(np.log(max(1.0 - part, 1e-12)))


def follows_runs(data: Campaigns, none: Fit) -> set[str]:
    """Roles of the outputs whose residuals without a gap change over the runs."""
    if data.view.column("order") is None:
        return set()
    order = data.view.of("order")
    return {
        o.role
        for o in data.outputs
        if change_over_runs(none.field_residuals[o.name], order[o.rows]) > FOLLOWS_RUNS
    }


# Internal parameters of each simulator, and its noise.
type Lab = tuple[dict[str, Array], dict[str, Noise]]


@dataclass(frozen=True)
class Ranking:
    """All fitted hypotheses.

    Parameters
    ----------
    fits : mapping of str to tuple of Fit
        By name; several where prior scales, or ways to shift or to be unlisted, were averaged over.
    scores : mapping of str to tuple of float
        Log evidence of each fit, for effects that matter, times its share in its hypothesis.
    probability : mapping of str to float
        Sums to one.
    not_testable : mapping of str to str
        Effect to reason.
    lab_mode : mapping of str to ndarray
        Internal parameters of each simulator as the lab calibrated it.
    identifiability : Identifiability
        What the design could show before its outcomes were looked at.
    odds : Odds
        Probabilities of the hypotheses before the data.
    gap : float
        Size of the gap by the best explanation, in noise sds (rms over the field rows of the output
        where it is largest).
    """

    fits: Mapping[str, tuple[Fit, ...]]
    scores: Mapping[str, tuple[float, ...]]
    log_evidence: Mapping[str, float]
    probability: Mapping[str, float]
    not_testable: Mapping[str, str]
    lab_mode: Mapping[str, Array]
    identifiability: Identifiability
    odds: Odds
    gap: float

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

    @property
    def in_play(self) -> dict[str, Fit]:
        """Best fits of the hypotheses worth telling apart: at most three, none below 0.03."""
        return {n: self.best(n) for n in self.order[:3] if self.probability[n] >= 0.03}

    def best(self, name: str) -> Fit:
        """The most probable fit of a hypothesis."""
        return self.fits[name][int(np.argmax(self.scores[name]))]


def rank(
    data: Campaigns,
    seed: int,
    *,
    effects: Mapping[str, Effect] = EFFECTS,
    lab: Lab | None = None,
    design: Identifiability | None = None,
    plenty: int = PLENTY,
) -> Ranking:
    """Fit every hypothesis and rank them.

    Parameters
    ----------
    effects : mapping of str to Effect, optional
    lab : Lab, optional
        If `calibrate_lab` has been called before.
    design : Identifiability, optional
        What the design could show, if it is known from a campaign that has all of these rows.
    plenty : int, optional
        Effective draws of a posterior, and draws for its relevance, that are enough.
    """
    able, unable = split_testable(data, with_case_effects(data, effects))
    lab_mode, noise = lab or calibrate_lab(data, seed)
    single = singles(data, able)
    shares = {h.name: prior_share(h.effects[0], able) for h in single}
    beside = {name for name, share in shares.items() if share is not None}
    listed = [h for h in single if h.name not in beside]
    design = design or identifiability(data, listed, lab_mode, noise, seed)
    single = [h for h in single if h.name not in design.idle]
    unable |= dict.fromkeys(design.idle, "it changes nothing that the models of this case predict")
    single = [replace(h, share=shares[h.name] or 1.0) for h in single]
    context = data.case.context
    _check_names(context, {*able, *unable})
    single = [with_known_size(h, context) for h in single if h.name not in context.excluded]
    unable |= dict.fromkeys(context.excluded, "it is excluded in the case's [context]")
    beside -= set(context.excluded)
    odds = Odds.of(len(single) - len(beside), context)
    guesses = StartingPoints(data, lab_mode, noise, odds)
    asked = [h for h in single if not (h.effects[0].seldom and "order" in h.effects[0].covariates)]
    fits = guesses.fit([Hypothesis("none"), *shifts(data), *asked])
    following = follows_runs(data, fits["none"][0])
    readings = [h for h in single if h not in asked]
    single = asked + [
        h for h in readings if h.name in context.names or following & set(h.effects[0].outputs)
    ]
    fits |= guesses.fit(single[len(asked) :])
    # A size that is known is not several times as large.
    free = [h for h in single if h.name not in context.sizes]
    far = [h for h in free if unusually_large(fits[h.name][0], 0, h.effect_priors[0])]
    for name, more in guesses.fit([wider(h) for h in far]).items():
        fits[name] += more
    fits |= search_sets(guesses, [h.name for h in single if h.name not in beside], fits)
    fits, scores = _scored(fits, guesses.odds, seed, plenty)
    log_evidence = {name: float(logsumexp(values)) for name, values in scores.items()}
    gap = _gap(fits, scores, log_evidence, guesses.odds)
    probability = probabilities(log_evidence, guesses.odds, likelihood_tempering(gap))
    return Ranking(
        fits, scores, log_evidence, probability, unable, lab_mode, design, guesses.odds, gap
    )


def _gap(
    fits: Mapping[str, tuple[Fit, ...]],
    scores: Mapping[str, tuple[float, ...]],
    log_evidence: Mapping[str, float],
    odds: Odds,
) -> float:
    """Size of the gap by the most probable explanation, in noise sds; see `Ranking.gap`."""
    best = max(log_evidence, key=lambda name: log_evidence[name] + odds.ln_prior(name))
    return gap_size(fits[best][int(np.argmax(scores[best]))])


def _check_names(context: Context, known: set[str]) -> None:
    """Refuse a context that speaks of what nobody knows."""
    strange = [n for n in context.names if n not in known and n != "parameter_shift"]
    strange += [n for n in (*context.excluded, *context.sizes) if n == "parameter_shift"]
    if strange:
        raise CalibError(
            f"the context speaks of {strange[0]}",
            where="[context] of case.toml",
            expected=", ".join(sorted(known)) + "; parameter_shift may be suspected",
            hint="leave it out"
            if strange[0] == "parameter_shift"
            else meant(strange[0], known, "correct the name, or leave it out"),
        )


def _scored(
    fits: Mapping[str, tuple[Fit, ...]], odds: Odds, seed: int, plenty: int
) -> tuple[dict[str, tuple[Fit, ...]], dict[str, tuple[float, ...]]]:
    """Score every variant, and by draws of their posteriors those that are still in play."""
    promise = {name: [with_prior(f, odds) for f in group] for name, group in fits.items()}
    best = max(max(values) for values in promise.values())

    def draws(promised: float) -> int:
        behind = best - promised
        if behind < SEARCH.relevance_behind:
            return 96
        return 32 if behind < SEARCH.relevance_far else 0

    every = [(f, draws(p)) for name in fits for f, p in zip(fits[name], promise[name], strict=True)]
    found = iter(_scores(every, seed))
    scores = {name: [next(found) for _ in group] for name, group in fits.items()}
    refined = {name: list(group) for name, group in fits.items()}
    tried: set[tuple[str, int]] = set()
    while asked := sorted(_in_play(scores, odds) - tried):
        tried |= set(asked)
        for name, i in asked:
            refined[name][i] = refine(fits[name][i], seed, plenty)
        again = _scores([(refined[name][i], round(1.5 * plenty)) for name, i in asked], seed)
        for (name, i), score in zip(asked, again, strict=True):
            scores[name][i] = score
    return (
        {name: tuple(group) for name, group in refined.items()},
        {name: tuple(values) for name, values in scores.items()},
    )


def _in_play(scores: Mapping[str, Sequence[float]], odds: Odds) -> set[tuple[str, int]]:
    """Names of hypotheses that are in play, and the places of their variants that are."""
    best = max(max(values) + odds.ln_prior(name) for name, values in scores.items())
    least = best - SEARCH.in_play
    return {
        (name, i)
        for name, values in scores.items()
        for i, value in enumerate(values)
        if value > max(values) - SEARCH.variant_in_play and value + odds.ln_prior(name) > least
    }


def _scores(asked: Sequence[tuple[Fit, int]], seed: int) -> list[float]:
    """Log of evidence times relevance (if it is drawn) times a variant's share in its name."""
    relevant = ln_size_restriction(asked, seed)
    return [
        f.log_evidence + r + float(np.log(f.forward.hypothesis.share))
        for (f, _), r in zip(asked, relevant, strict=True)
    ]


def calibrate_lab(data: Campaigns, seed: int) -> Lab:
    """Mode of each output's simulator on the lab, and its noise."""
    modes, noise = {}, {}
    for o in data.outputs:
        _check_defined(data, o, generator(seed, "gap", "defined", o.name))
        mode = find_mode(o.problem.log_prob, o.problem.priors)
        modes[o.name] = mode[:-1]
        sigma = float(o.problem.theta(mode[None])[0, -1])
        noise[o.name] = Noise(sigma, 0.0)
    return modes, noise


def _check_defined(data: Campaigns, o: OutputData, rng: np.random.Generator) -> None:
    """Refuse rows of either campaign at which a simulator has no value."""
    problem, field = o.problem, data.case.field
    theta = o.priors.to_natural(o.priors.sample(rng, 32))
    check_defined(
        problem.bound, theta, problem.conditions, data.case.lab.source, problem.table.lines
    )
    there = {k: v[o.rows] for k, v in problem.bound.model.select(data.view.conditions).items()}
    check_defined(problem.bound, theta, there, field.source, field.lines[o.rows])
