"""Posteriors of hypotheses that were not fitted: about where a test says, as wide as it says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib.gap.campaigns import Campaigns, OutputData, campaigns
from calib.gap.constants import PLENTY, ROUNDS
from calib.gap.fit import Fit, Residuals
from calib.gap.forward import Forward
from calib.gap.hypotheses import Hypothesis
from calib.gap.noise import Noise, noise_conditions_of_lab
from calib.gap.posterior import sample
from calib.gap.ranking import calibrate_lab
from calib.gap.screen import Screen
from calib.inference.priors import Prior, Priors
from tests.custom_problems import normal, problem_of
from tests.gap.cases import NOISE, PULL_ONLY, make_case

SIGMA = {o: NOISE[o] for o in ("drawbar_pull", "rut_depth")}


def fit_at(data: Campaigns, hypothesis: Hypothesis, sd: float = 0.0) -> Fit:
    """Return a posterior about the middle of the priors, of this sd in every coordinate."""
    forward = Forward(data, hypothesis, SIGMA)
    psi = np.array([p.loc for p in forward.priors.free])
    noise = {o.name: Noise(SIGMA[o.name]) for o in data.outputs}
    return Fit(forward, noise, 0.0, {}, draws_of(psi, sd * np.eye(psi.size)))


def draws_of(psi: np.ndarray, root: np.ndarray) -> np.ndarray:
    """Return draws of exactly this mean and root of the covariance."""
    away = np.sqrt(psi.size) * root.T
    return np.concatenate([psi + away, psi - away])


def moved(found: Fit, psi: np.ndarray) -> Fit:
    """Return a posterior elsewhere."""
    return replace(found, sample=found.sample + (psi - found.psi))


def fitted(
    data: Campaigns, hypothesis: Hypothesis, effective: float = PLENTY, seed: int = 1
) -> Fit:
    """Return a posterior from the guesses of the screen."""
    screen = Screen(data, *calibrate_lab(data, seed), seed)
    forward = screen.forward(hypothesis)
    choices = [screen.choice(())]
    if forward.causes:
        cause = screen.cause(hypothesis)
        choices = [screen.choice(((cause, i),)) for i in range(len(cause.parts))]
    best = sorted(choices, key=lambda c: -c.ln_evidence)[:3]
    guesses = [screen.guess(forward, c.parts) for c in best]
    rng, (_, noise) = np.random.default_rng(seed), guesses[0]
    begun = [(proposal, 1.0) for proposal, _ in guesses]
    first, found = sample(forward, noise, begun, rng, 200.0, (1000,) * 6)
    return sample(forward, first.noise, found, rng, effective, ROUNDS)[0]


def straight_line(seed: int, *idle: Prior, lower: float = -np.inf) -> Campaigns:
    """Ten readings in the laboratory and seven in the field, none of them with a gap.

    On parameters that are idle nothing depends.
    """
    few = campaigns(make_case(models=PULL_ONLY, n_lab=10, n_field=7))
    rng = np.random.default_rng(seed)
    slips = np.linspace(0.0, 0.6, 10), few.view.slip()
    pulls = [0.3 + 0.8 * s + 0.04 * rng.standard_normal(s.size) for s in slips]
    sigma = normal("sigma", np.log(0.05), 0.8, log=True)
    a = replace(normal("a", 0.0, 1.0), lower=lower)
    priors = [a, normal("b", 0.5, 2.0), *idle, sigma]
    problem = problem_of(lambda a, b, *more: a + b * more[-1], priors, slips[0], pulls[0])
    own = Priors(problem.priors.entries[:-1])
    o = OutputData("drawbar_pull", problem, own, np.arange(7), pulls[1])
    at = {o.name: noise_conditions_of_lab(problem.table, few.view)}
    return Campaigns((o,), few.view, at, few.case)


def averaged_log_joint(found: Fit, psi: np.ndarray) -> np.ndarray:
    """Log likelihood, averaged over the noise, plus log prior, in all dimensions."""
    problem = Residuals(found.forward.data, found.forward)
    with np.errstate(all="ignore"):
        averaged = problem.ln_averaged(problem.raw(psi))
    return np.asarray(found.forward.log_prior(psi) + averaged)


def log_joint(found: Fit, psi: np.ndarray) -> np.ndarray:
    """Log likelihood plus log prior at a fit's noise, in all dimensions, shape (k, d) to (k,)."""
    problem = Residuals(found.forward.data, found.forward)
    sds = problem.sds(found.noise)
    with np.errstate(all="ignore"):
        squares = np.square(problem.raw(psi) / sds).sum(axis=1)
    constant = np.log(sds).sum() + 0.5 * sds.size * np.log(2.0 * np.pi)
    return np.asarray(found.forward.log_prior(psi) - 0.5 * squares - constant)
