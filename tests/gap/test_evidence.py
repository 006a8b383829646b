"""The evidence of a straight line read seventeen times, which is known in closed form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import multivariate_normal, norm

from calib.gap.campaigns import Campaigns
from calib.gap.constants import KAPPA, RHO
from calib.gap.fit import Fit, fit
from calib.gap.forward import Forward
from calib.gap.hypotheses import Hypothesis
from calib.gap.importance import refine
from calib.gap.noise import Noise, ln_prior
from calib.inference.priors import Prior
from tests.gap.fits import lifted, straight_line


def design_of(data: Campaigns) -> np.ndarray:
    return np.stack([np.ones(17), data.at_rows["drawbar_pull"].slip], axis=1)


PRIOR_MEAN, PRIOR_COVARIANCE = np.array([0.0, 0.5]), np.diag([1.0, 4.0])


def closed_form(data: Campaigns, noise: Noise) -> float:
    """Both parameters integrated out, the readings are normal; with the noise's own prior."""
    at, design = data.at_rows["drawbar_pull"], design_of(data)
    covariance = design @ PRIOR_COVARIANCE @ design.T + np.diag(noise.sd(at) ** 2)
    exact = multivariate_normal.logpdf(data.observed, design @ PRIOR_MEAN, covariance)
    return float(exact) + ln_prior(noise)


def noises(data: Campaigns) -> tuple[list[Noise], float]:
    """A grid of them, and the log of what each stands for in ln sigma."""
    ln_sigma = np.log(0.04) + np.linspace(-2.0, 3.0, 201)
    kappas = KAPPA if np.ptp(data.at_rows["drawbar_pull"].softness) else KAPPA[:1]
    grid = [Noise(float(np.exp(s)), r, k) for s in ln_sigma for r in RHO for k in kappas]
    return grid, float(np.log(ln_sigma[1] - ln_sigma[0]) + 0.5 * np.log(17.0 / np.pi))


@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_the_evidence_is_that_of_the_closed_form(seed: int):
    """Laplace's at the fit's noise, that of the draws averaged over it."""
    data = straight_line(seed)
    forward = Forward(data, Hypothesis("none"), {"drawbar_pull": 0.04})
    found = fit(forward, np.array([0.0, 0.5]), {"drawbar_pull": Noise(0.04)})
    exact = closed_form(data, found.noise["drawbar_pull"]) + lifted(found)
    # In a linear model Laplace's is exact; of 23,000 weighted draws the error is about 0.01.
    assert found.log_evidence == pytest.approx(exact, abs=1e-4)
    grid, each = noises(data)
    averaged = logsumexp([closed_form(data, noise) for noise in grid]) + each
    assert refine(found, 1).log_evidence == pytest.approx(averaged, abs=0.03)
    # Laplace's over the noise is not exact of 17 readings.
    assert found.log_evidence == pytest.approx(averaged, abs=0.2)


@pytest.mark.parametrize("start", [0.1, 0.1005, 0.5, 0.899, 0.9])
def test_what_nothing_depends_on_changes_no_evidence(start: float):
    def evidence(data: Campaigns, begun: list[float]) -> tuple[float, float]:
        forward = Forward(data, Hypothesis("none"), {"drawbar_pull": 0.04})
        found = fit(forward, np.array(begun), {"drawbar_pull": Noise(0.04)})
        refined = refine(found, 1)
        assert refined.sample is not None
        return found.log_evidence, refined.log_evidence

    # As the change point of a step that falls between two runs.
    idle = Prior("c", "1", "a test", "nobody", "uniform", False, 0.5, np.inf, 0.1, 0.9)
    without = evidence(straight_line(1), [0.0, 0.5])
    found = evidence(straight_line(1, idle), [0.0, 0.5, start])
    assert found[0] == pytest.approx(without[0], abs=0.01)
    assert found[1] == pytest.approx(without[1], abs=0.05)


@pytest.mark.parametrize("lower", [-np.inf, 0.2, 0.3, 0.4])
def test_of_a_bounded_parameter_the_evidence_is_the_mass_inside(lower: float):
    """The mode is inside the bound, beside it, or held at it by readings that ask for less."""
    data = straight_line(1, lower=lower)
    forward = Forward(data, Hypothesis("none"), {"drawbar_pull": 0.04})
    found = fit(forward, np.array([max(0.0, lower + 0.1), 0.5]), {"drawbar_pull": Noise(0.04)})
    noise, at = found.noise["drawbar_pull"], data.at_rows["drawbar_pull"]
    design = np.stack([np.ones(17), at.slip], axis=1)
    prior, sd = np.diag([1.0, 4.0]), noise.sd(at)
    free = multivariate_normal.logpdf(
        data.observed, design @ [0.0, 0.5], design @ prior @ design.T + np.diag(sd**2)
    )
    # Of the normals without the bound, the shares beyond it after and before the readings.
    precision = design.T @ (design / sd[:, None] ** 2) + np.linalg.inv(prior)
    information = design.T @ (data.observed / sd**2) + np.linalg.inv(prior) @ [0.0, 0.5]
    mean, covariance = np.linalg.solve(precision, information), np.linalg.inv(precision)
    after, before = norm.logsf(lower, mean[0], np.sqrt(covariance[0, 0])), norm.logsf(lower)
    exact = free + after - before + ln_prior(noise) + lifted(found)
    assert found.log_evidence == pytest.approx(exact, abs=1e-3)
    if lower == 0.4:
        assert found.psi[0] == pytest.approx(lower)
        assert mean[0] + 2.0 * np.sqrt(covariance[0, 0]) < lower


def at(psi, evidence: float = 0.0, covariance=None) -> Fit:
    psi = np.atleast_1d(np.asarray(psi, dtype=float))
    covariance = np.eye(psi.size) if covariance is None else covariance
    return Fit(None, psi, covariance, {}, evidence, 0.0, {})  # type: ignore[arg-type]


def _normal(data: Campaigns, noise: Noise) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variances of the parameters at a noise."""
    weighted = design_of(data).T / noise.sd(data.at_rows["drawbar_pull"]) ** 2
    covariance = np.linalg.inv(weighted @ design_of(data) + np.linalg.inv(PRIOR_COVARIANCE))
    mean = covariance @ (weighted @ data.observed + np.linalg.inv(PRIOR_COVARIANCE) @ PRIOR_MEAN)
    return mean, np.diag(covariance)


def test_draws_that_are_kept_are_as_many_of_each_part_as_it_weighs():
    """Of a straight line: the posterior, a normal at any noise, averaged over it."""
    data = straight_line(1)
    forward = Forward(data, Hypothesis("none"), {"drawbar_pull": 0.04})
    found = fit(forward, np.array([0.0, 0.5]), {"drawbar_pull": Noise(0.04)})
    refined = refine(found, 1)
    assert refined.sample is not None
    assert refined.sample.shape == (1500, 2)
    grid, _ = noises(data)
    weight = np.exp([closed_form(data, noise) for noise in grid])
    weight /= weight.sum()
    means, variances = np.array([_normal(data, noise) for noise in grid]).swapaxes(0, 1)
    mean = weight @ means
    z = (refined.sample - mean) / np.sqrt(weight @ (variances + np.square(means - mean)))
    # Systematic: no more scatter than the draws behind them, 800 effective ones or more.
    np.testing.assert_allclose(z.mean(axis=0), 0.0, atol=0.15)
    np.testing.assert_allclose(z.std(axis=0), 1.0, atol=0.12)
    # Enough effective draws end the rounds; no normal at all is left as it is.
    few = refine(found, 1, plenty=200)
    assert few.sample is not None
    assert few.log_evidence == pytest.approx(refined.log_evidence, abs=0.1)
    bad = replace(found, covariance=-np.eye(2))
    assert refine(bad, 1) is bad
    nowhere = replace(found, psi=np.full(2, np.nan))
    assert refine(nowhere, 1) is nowhere
