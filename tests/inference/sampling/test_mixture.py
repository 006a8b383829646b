"""Mixtures of Student-t: densities by scipy, draws by their moments."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from calib.inference.sampling.mixture import Mixture, StudentT

MEAN = np.array([1.0, -2.0, 0.5])
SCALE = np.array([[2.0, 0.6, 0.1], [0.6, 1.0, -0.3], [0.1, -0.3, 0.5]])


def student(dof: float = 6.0, shift: float = 0.0) -> StudentT:
    return StudentT(MEAN + shift, np.linalg.cholesky(SCALE), dof)


@pytest.mark.parametrize("dof", [1.5, 6.0, 80.0])
def test_a_student_t_has_scipys_density(dof: float) -> None:
    t = np.random.default_rng(1).normal(0.0, 4.0, (50, 3))
    expected = stats.multivariate_t(MEAN, SCALE, dof).logpdf(t)
    np.testing.assert_allclose(student(dof).log_prob(t), expected, rtol=1e-10)


@pytest.mark.parametrize("rng", [np.random.default_rng(2), np.random.RandomState(2)])
def test_draws_of_a_student_t_have_its_moments(rng) -> None:
    n, dof = 40_000, 12.0
    t = student(dof).sample(rng, n)
    covariance = SCALE * dof / (dof - 2.0)
    sd = np.sqrt(np.diag(covariance))
    assert np.all(np.abs(t.mean(axis=0) - MEAN) < 5.0 * sd / np.sqrt(n))
    # Kurtosis 3 (dof-2)/(dof-4) = 3.75: entries of the covariance vary by at most
    # sqrt(2.75/n) of the product of sds.
    error = np.abs(np.cov(t.T) - covariance) / np.outer(sd, sd)
    assert error.max() < 5.0 * np.sqrt(2.75 / n)
    marginal = stats.t(dof, MEAN[0], np.sqrt(SCALE[0, 0]))
    assert stats.kstest(t[:, 0], marginal.cdf).pvalue > 1e-4


def mixture() -> Mixture:
    return Mixture(np.array([0.25, 0.75]), (student(5.0), student(20.0, shift=4.0)))


def test_a_mixture_has_the_weighted_density() -> None:
    t = np.random.default_rng(1).normal(1.0, 4.0, (50, 3))
    one = stats.multivariate_t(MEAN, SCALE, 5.0).pdf(t)
    other = stats.multivariate_t(MEAN + 4.0, SCALE, 20.0).pdf(t)
    np.testing.assert_allclose(mixture().log_prob(t), np.log(0.25 * one + 0.75 * other), rtol=1e-10)


def test_draws_of_a_mixture_follow_its_density() -> None:
    """E[q1/q] = 1 under the mixture q, for either component q1; likewise the mean."""
    n = 40_000
    t = mixture().sample(np.random.default_rng(3), n)
    q = mixture().log_prob(t)
    for component in mixture().components:
        ratio = np.exp(component.log_prob(t) - q)  # at most 1/0.25
        assert abs(ratio.mean() - 1.0) < 5.0 * ratio.std() / np.sqrt(n)
    error = np.abs(t.mean(axis=0) - (MEAN + 3.0)) / (t.std(axis=0) / np.sqrt(n))
    assert error.max() < 5.0
