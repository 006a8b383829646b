"""The fitted proposal: densities by scipy, draws by their moments, evidence in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from calib.sampling.curvature import hessian_scale
from calib.sampling.proposal import AnyProposal, Guess, Mixture, Proposal, StudentT, adapt

from .closed_form import linear

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


def adapted(log_prob, start: StudentT | Guess, seed: int = 4) -> tuple[AnyProposal, float, float]:
    proposal, found = adapt(
        log_prob, [Guess(start.mean, start.cholesky)], np.random.default_rng(seed)
    )
    return proposal, found.log_evidence, found.efficiency


def error_of(efficiency: float) -> float:
    """Five standard errors of a log evidence from the least draws of a round, 60 x 7."""
    return 5.0 * np.sqrt((1.0 / efficiency - 1.0) / 420) + 1e-12


def test_the_evidence_of_a_gaussian_found_from_a_poor_guess() -> None:
    target = stats.multivariate_normal(MEAN, SCALE)
    poor = StudentT(MEAN + 1.5, 0.5 * np.eye(3), 6.0)
    mixed, log_evidence, efficiency = adapted(lambda t: target.logpdf(t) - 7.5, poor)
    assert efficiency > 0.7
    assert abs(log_evidence + 7.5) < error_of(efficiency)
    drawn = mixed.sample(np.random.default_rng(1), 20_000)
    # A loose check that it lies on the target: a tenth of the sds, and a half of the spread
    # (the proposal is wider by design).
    assert np.all(np.abs(drawn.mean(axis=0) - MEAN) < 0.1 * np.sqrt(np.diag(SCALE)))
    spread = drawn.std(axis=0) / np.sqrt(np.diag(SCALE))
    assert np.all((spread > 0.95) & (spread < 1.5))


@pytest.mark.parametrize("known", [True, False])
def test_the_evidence_of_a_conjugate_model(known: bool) -> None:
    model = linear()
    log_prob = model.log_prob_known if known else model.log_prob_unknown
    exact = model.log_evidence_known() if known else model.log_evidence_unknown()
    d = 3 if known else 4
    _, log_evidence, efficiency = adapted(log_prob, StudentT(np.zeros(d), np.eye(d), 6.0))
    assert efficiency > 0.3
    assert abs(log_evidence - exact) < error_of(efficiency)


def test_several_components_follow_a_bend() -> None:
    def log_prob(t):
        bent = t[:, 1] - t[:, 0] ** 2
        return stats.norm.logpdf(t[:, 0]) + stats.norm.logpdf(bent, 0.0, 0.4)

    mixed, log_evidence, efficiency = adapted(log_prob, StudentT(np.zeros(2), np.eye(2), 6.0))
    assert isinstance(mixed, Proposal)
    assert len(mixed.mixture.components) > 1
    assert mixed.mixture.weights.sum() == pytest.approx(1.0)
    # A single Gaussian of the banana's moments has an efficiency near 0.2.
    assert efficiency > 0.35
    assert abs(log_evidence) < error_of(efficiency)


@pytest.mark.parametrize("seed", range(12))
def test_an_efficiency_that_hovers_about_good_enough(seed: int) -> None:
    """One component may look good in one round and poor in the next: then it is split."""
    target = stats.multivariate_t([1.0, -1.0], [[1.0, 0.6], [0.6, 2.0]], df=2)
    _, log_evidence, efficiency = adapted(
        target.logpdf, StudentT(np.zeros(2), np.eye(2), 6.0), seed
    )
    # The weights of a tail heavier than the proposal's have no variance: a loose bound.
    assert abs(log_evidence) < 0.2
    assert 0.0 < efficiency <= 1.0


def test_a_density_that_is_zero_everywhere_gives_no_evidence() -> None:
    _, log_evidence, efficiency = adapted(lambda t: np.full(len(t), -np.inf), student())
    assert log_evidence == -np.inf
    assert efficiency == 0.0


def test_curvature_at_a_mode_is_the_covariance() -> None:
    target = stats.multivariate_normal(MEAN, SCALE)
    found = hessian_scale(target.logpdf, MEAN, np.array([20.0, 30.0, 10.0]))
    # Differences of a quadratic are exact but for rounding; the widest eigenvalue is untouched.
    np.testing.assert_allclose(found, SCALE, rtol=1e-6)


def test_a_direction_the_density_ignores_is_as_wide_as_its_prior() -> None:
    found = hessian_scale(
        lambda t: stats.norm.logpdf(t[:, 0], 0.0, 0.1), np.zeros(2), np.array([1.0, 3.0])
    )
    np.testing.assert_allclose(np.diag(found), [0.01, 9.0], rtol=1e-6)


def test_a_mode_at_the_edge_of_the_allowed_still_has_a_scale() -> None:
    found = hessian_scale(
        lambda t: np.where(t[:, 0] >= 0.0, -t[:, 0] / 0.1, -np.inf), np.zeros(1), np.ones(1)
    )
    assert 0.0 < found[0, 0] <= 1.0
