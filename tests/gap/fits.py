"""Posteriors of hypotheses that were not fitted: about where a test says, as wide as it says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib.gap.campaigns import Campaigns, OutputData, campaigns
from calib.gap.fit import Fit
from calib.gap.forward import Forward
from calib.gap.gauss_newton import Residuals, variance_left
from calib.gap.hypotheses import Hypothesis
from calib.gap.noise import Noise, ln_averaging, noise_conditions_of_lab
from calib.inference.priors import Prior, Priors
from tests.custom_problems import normal, problem_of
from tests.gap.cases import NOISE, PULL_ONLY, make_case

SIGMA = {o: NOISE[o] for o in ("drawbar_pull", "rut_depth")}


def fit_at(data: Campaigns, hypothesis: Hypothesis, sd: float = 0.0) -> Fit:
    """Return a posterior about the middle of the priors, of this sd in every coordinate."""
    forward = Forward(data, hypothesis, SIGMA)
    psi = np.array([p.loc for p in forward.priors.free])
    noise = {o.name: Noise(SIGMA[o.name]) for o in data.outputs}
    return Fit(forward, psi, sd**2 * np.eye(psi.size), noise, 0.0, 0.0, {})


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


def lifted(found: Fit) -> float:
    """By how much Laplace's evidence is more than that at the fit's noise, averaged over it."""
    data, psi = found.forward.data, found.psi[None]
    problem = Residuals(data, found.forward)
    raw = problem.raw(psi)
    jacobian = problem.jacobian(psi, raw, problem.raw(problem.around(psi)))
    scaled = jacobian / problem.sds(found.noise)
    precision = np.where(problem.precision > 0, problem.precision, 1e-3 / problem.width)
    inverse = np.linalg.inv(scaled[0] @ scaled[0].T + np.diag(precision**2))
    left = variance_left(scaled, inverse[None])
    return float(
        sum(
            ln_averaging(raw[:, part], left[:, part], data.at_rows[o])[0]
            for o, part in problem.parts.items()
        )
    )


def averaged_log_joint(found: Fit, psi: np.ndarray) -> np.ndarray:
    """Log likelihood, averaged over the noise, plus log prior, in all dimensions."""
    problem = Residuals(found.forward.data, found.forward)
    with np.errstate(all="ignore"):
        averaged = problem.ln_averaged(problem.raw(problem.clip(psi)))
    return np.asarray(found.forward.priors.log_prob(psi) + averaged)


def log_joint(found: Fit, psi: np.ndarray) -> np.ndarray:
    """Log likelihood plus log prior at a fit's noise, in all dimensions, shape (k, d) to (k,)."""
    problem = Residuals(found.forward.data, found.forward)
    sds = problem.sds(found.noise)
    with np.errstate(all="ignore"):
        squares = np.square(problem.raw(problem.clip(psi)) / sds).sum(axis=1)
    constant = np.log(sds).sum() + 0.5 * sds.size * np.log(2.0 * np.pi)
    return np.asarray(found.forward.priors.log_prob(psi) - 0.5 * squares - constant)
