"""Rank all hypotheses: screen them, draw their posteriors, turn evidence into probabilities."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from calib.errors import CalibError, meant
from calib.gap.campaigns import Campaigns, OutputData
from calib.gap.case import Context
from calib.gap.constants import (
    BESIDE,
    CUT,
    FIRST,
    FIRST_ROUNDS,
    GUESSES,
    IN_PLAY,
    PARTS,
    PLENTY,
    ROUNDS,
)
from calib.gap.effects import EFFECTS, Effect
from calib.gap.fit import Fit
from calib.gap.hypotheses import (
    Hypothesis,
    by_parameters,
    joined,
    prior_share,
    shifts,
    singles,
    split_testable,
    unknowns,
    with_case_effects,
    with_known_size,
    with_residual_discrepancy,
)
from calib.gap.identifiability import Identifiability, identifiability
from calib.gap.noise import Noise
from calib.gap.odds import (
    Odds,
    gap_size,
    likelihood_tempering,
    ln_relevant,
    probabilities,
    sizes,
)
from calib.gap.posterior import Proposed, sample
from calib.gap.screen import Choice, Screen
from calib.inference.mode import find_mode
from calib.inference.random import generator
from calib.inference.search import check_defined
from calib.models.base import Array

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
    shares : mapping of str to float
        Prior probability of all variants of a name together, as a part of what a name of its kind
        has.
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
    shares: Mapping[str, float]
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
    def causes(self) -> int:
        """How many causes the most probable hypothesis has."""
        return 0 if self.order[0] == "none" else 1 + self.order[0].count("+")

    @property
    def prior(self) -> dict[str, float]:
        """Probability of each hypothesis before the data; sums to one."""
        ln_share = {name: float(np.log(share)) for name, share in self.shares.items()}
        return probabilities(ln_share, self.odds)

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
    plenty: float = PLENTY,
) -> Ranking:
    """Fit every hypothesis and rank them.

    Parameters
    ----------
    effects : mapping of str to Effect, optional
    lab : Lab, optional
        If `calibrate_lab` has been called before.
    design : Identifiability, optional
        What the design could show, if it is known from a campaign that has all of these rows.
    plenty : float, optional
        Effective draws of a posterior that are enough.
    """
    able, unable = split_testable(data, with_case_effects(data, effects))
    lab_mode, noise = lab or calibrate_lab(data, seed)
    single = singles(data, able)
    shares = {h.name: prior_share(h.effects[0], able) for h in single}
    alone = {name for name, share in shares.items() if share is not None}
    listed = [h for h in single if h.name not in alone]
    design = design or identifiability(data, listed, lab_mode, noise, seed)
    single = [h for h in single if h.name not in design.idle]
    unable |= dict.fromkeys(design.idle, "it changes nothing that the models of this case predict")
    single = [replace(h, share=shares[h.name] or 1.0) for h in single]
    context = data.case.context
    check_names(context, {*able, *unable})
    single = [with_known_size(h, context) for h in single if h.name not in context.excluded]
    unable |= dict.fromkeys(context.excluded, "it is excluded in the case's [context]")
    alone -= set(context.excluded)
    odds = Odds.of(len(single) - len(alone), context)
    single = [variant for h in single for variant in by_parameters(h)]
    screen = Screen(data, lab_mode, noise, seed)
    candidates, tried = _candidates(screen, odds, single, alone)
    fits, scores = _scored(screen, candidates, odds, seed, plenty)
    log_evidence = {name: float(logsumexp(values)) for name, values in scores.items()}
    best = max(log_evidence, key=lambda name: log_evidence[name] + odds.ln_prior(name))
    gap = gap_size(fits[best][int(np.argmax(scores[best]))])
    probability = probabilities(log_evidence, odds, likelihood_tempering(gap))
    return Ranking(
        fits, scores, tried, log_evidence, probability, unable, lab_mode, design, odds, gap
    )


@dataclass(frozen=True)
class Candidate:
    """A hypothesis as the screen sees it.

    Parameters
    ----------
    promise : float
        Log of evidence times prior, by the screen.
    ln_relevant : float
        Log prior probability that its causes are large enough to count.
    ln_restricted : float
        That of all variants of its name.
    choices : tuple of Choice
        Of parts of its causes.
    """

    hypothesis: Hypothesis
    promise: float
    ln_relevant: float
    choices: tuple[Choice, ...]
    ln_restricted: float = 0.0

    @property
    def name(self) -> str:
        """Of the hypothesis."""
        return self.hypothesis.name

    @property
    def best(self) -> list[Choice]:
        """Choices, the best first."""
        return sorted(self.choices, key=lambda choice: -choice.ln_evidence)

    @classmethod
    def of(
        cls, h: Hypothesis, odds: Odds, ln_relevant: float, choices: Sequence[Choice]
    ) -> Candidate:
        """Add up choices."""
        promise = float(logsumexp([c.ln_evidence for c in choices]) + np.log(h.share))
        return cls(h, promise + odds.ln_prior(h.name), ln_relevant, tuple(choices))


def _candidates(
    screen: Screen, odds: Odds, single: Sequence[Hypothesis], alone: Collection[str]
) -> tuple[list[Candidate], dict[str, float]]:
    """Hypotheses near the best by the screen, and every cause by itself; each name's share."""
    data = screen.data
    found = [Candidate.of(Hypothesis("none"), odds, 0.0, [screen.choice(())])]
    for h in [*shifts(data), *unknowns(data)]:
        cause = screen.cause(h)
        if of_parts := [screen.choice(((cause, i),)) for i in range(len(cause.parts))]:
            found.append(Candidate.of(h, odds, cause.ln_relevant, of_parts))
    causes = [screen.cause(h) for h in single]
    groups = dict[tuple[int, ...], list[Choice]]()
    for choice in [
        *screen.choices([c for c in causes if c.name not in alone]),
        *screen.choices([c for c in causes if c.name in alone], most=1),
    ]:
        groups.setdefault(tuple(sorted(id(c) for c, _ in choice.parts)), []).append(choice)
    for group in groups.values():
        some = [cause for cause, _ in group[0].parts]
        relevant = sum(c.ln_relevant_in_set for c in some)
        relevant = some[0].ln_relevant if len(some) == 1 else relevant
        h = joined(*(cause.forward.hypothesis for cause in some))
        found.append(Candidate.of(h, odds, relevant, group))
    found = _restricted(found)
    found += _restricted(_with_residuals(screen, odds, found))
    least = max(c.promise for c in found) - CUT
    best = {c.name: c for c in sorted(found, key=lambda c: c.promise)}
    shares = dict[str, float]()
    for c in found:
        shares[c.name] = shares.get(c.name, 0.0) + c.hypothesis.share
    kept = [c for c in found if c.promise > least or ("+" not in c.name and best[c.name] is c)]
    return kept, {c.name: shares[c.name] for c in kept}


def _restricted(found: Sequence[Candidate]) -> list[Candidate]:
    """Restrict the prior of each name to what counts, in whichever variant it is likely to.

    A variant of small sizes, which hardly ever count, is not as probable as one of large sizes.
    """
    of_name: dict[str, float] = {}
    for name in {c.name for c in found}:
        own = [c for c in found if c.name == name]
        ln_share = np.log([c.hypothesis.share for c in own])
        ln_both = ln_share + [c.ln_relevant for c in own]
        of_name[name] = float(logsumexp(ln_both) - logsumexp(ln_share))
    return [
        replace(
            c, promise=c.promise + c.ln_relevant - of_name[c.name], ln_restricted=of_name[c.name]
        )
        for c in found
    ]


def _with_residuals(screen: Screen, odds: Odds, found: Sequence[Candidate]) -> list[Candidate]:
    """Candidates near the best listed one, with something unlisted beside their causes."""
    listed = [c for c in found if c.name not in ("none", "unknown")]
    least = max((c.promise for c in listed), default=0.0) - CUT
    alone = with_residual_discrepancy(screen.data, Hypothesis("none"))
    residuals = [screen.cause(h) for h in alone]
    more = []
    for c in sorted(listed, key=lambda c: -c.promise)[:BESIDE]:
        if c.promise < least:
            break
        beside = with_residual_discrepancy(screen.data, c.hypothesis)
        for h, rest in zip(beside, residuals, strict=True):
            if rest.parts:
                choices = [screen.choice((*top.parts, (rest, 0))) for top in c.best[:PARTS]]
                relevant = c.ln_relevant + rest.ln_relevant_in_set
                more.append(Candidate.of(h, odds, relevant, choices))
    return more


def check_names(context: Context, known: set[str]) -> None:
    """Refuse a context with causes that nobody knows, or that cannot be taken out."""
    always = ("parameter_shift", "unknown")
    for name in (*context.excluded, *context.sizes):
        if name in always:
            raise CalibError(
                f"{name} has no size that could be known, and is always considered",
                where="[context] of case.toml",
                hint="write same_soil = true if field and laboratory have the same soil"
                if name == "parameter_shift"
                else "take it out",
            )
    for name in context.names:
        if name not in known and name != "parameter_shift":
            raise CalibError(
                f"{name} is no cause that is known",
                where="[context] of case.toml",
                expected=", ".join(sorted(known)) + "; parameter_shift may be suspected",
                hint=meant(name, known, "correct the name, or leave it out"),
            )


def _scored(
    screen: Screen, candidates: Sequence[Candidate], odds: Odds, seed: int, plenty: float
) -> tuple[dict[str, tuple[Fit, ...]], dict[str, tuple[float, ...]]]:
    """Draw every candidate's posterior, and those in play until the draws are plenty."""
    found = [_first_look(screen, c, seed) for c in candidates]
    ln_prior = np.array([odds.ln_prior(c.name) for c in candidates])
    done: set[int] = set()
    while True:
        ln = np.array([score for _, _, score in found]) + ln_prior
        asked = set(np.flatnonzero(ln > ln.max() - IN_PLAY).tolist()) - done
        if not asked:
            break
        done |= asked
        for i in sorted(asked):
            fit, proposals, _ = found[i]
            again = sample(
                fit.forward,
                fit.noise,
                proposals,
                _stream(candidates[i].hypothesis, seed, "draws"),
                plenty,
                ROUNDS,
            )
            found[i] = (*again, _score(screen, candidates[i], again[0], 1))
    fits: dict[str, tuple[Fit, ...]] = {}
    scores: dict[str, tuple[float, ...]] = {}
    for c, (fit, _, score) in zip(candidates, found, strict=True):
        fits[c.name] = (*fits.get(c.name, ()), fit)
        scores[c.name] = (*scores.get(c.name, ()), score)
    return fits, scores


def _first_look(screen: Screen, c: Candidate, seed: int) -> tuple[Fit, list[Proposed], float]:
    """Draw a posterior from its best guesses."""
    forward = screen.forward(c.hypothesis)
    top = c.best[:GUESSES]
    found = [screen.guess(forward, choice.parts) for choice in top]
    guesses = [
        (proposal, float(np.exp(choice.ln_evidence - top[0].ln_evidence)))
        for (proposal, _), choice in zip(found, top, strict=True)
    ]
    rng = _stream(c.hypothesis, seed, "first")
    fit, proposals = sample(forward, found[0][1], guesses, rng, FIRST, FIRST_ROUNDS)
    return fit, proposals, _score(screen, c, fit, 5)


def _score(screen: Screen, c: Candidate, fit: Fit, every: int) -> float:
    """Log evidence of the relevant prior times the share in its name; sizes of every n-th draw."""
    score = fit.log_evidence + float(np.log(c.hypothesis.share))
    if not c.choices[0].parts:  # nothing acts
        return score
    size = sizes(fit.forward, screen.noise, fit.sample[::every])
    return score + ln_relevant(size) - c.ln_restricted


def _stream(h: Hypothesis, seed: int, stage: str) -> np.random.Generator:
    over = (h.smooth_over, h.onset_over or "", str(h.smooth), str(h.shift), h.shift_as)
    return generator(seed, "gap", stage, h.name, *over, *h.smooth_outputs)


def calibrate_lab(data: Campaigns, seed: int) -> Lab:
    """Mode of each output's simulator on the lab, and its noise."""
    modes, noise = {}, {}
    for o in data.outputs:
        _check_defined(data, o, generator(seed, "gap", "defined", o.name))
        mode = find_mode(o.problem.log_prob, o.problem.priors)
        modes[o.name] = mode[: len(o.priors.free)]
        natural = o.problem.theta(mode[None])
        along = o.problem.noise.own("rho", natural)[0, 0] if o.along is not None else 0.0
        noise[o.name] = Noise(float(natural[0, -1]), correlation=float(along))
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
