"""Proposals: densities by SciPy, maps one to one, evidence in closed form, what a chain teaches."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from calib.inference.proposal import (
    Guess,
    Proposal,
    StudentT,
    TriangularMap,
    adapt,
    fit_mixture,
    refit,
)
from tests.inference.sampling.closed_form import linear

MEAN = np.array([1.0, -2.0, 0.5])
SCALE = np.array([[2.0, 0.6, 0.1], [0.6, 1.0, -0.3], [0.1, -0.3, 0.5]])


def banana(t: np.ndarray) -> np.ndarray:
    """x0 ~ N(0, 1), x1 | x0 ~ N(x0^2, 0.4)."""
    bent = t[:, 1] - t[:, 0] ** 2
    return np.asarray(stats.norm.logpdf(t[:, 0]) + stats.norm.logpdf(bent, scale=0.4))


def two_modes(t: np.ndarray) -> np.ndarray:
    one, other = (stats.multivariate_normal([x, 0.0]).logpdf(t) for x in (-15.0, 15.0))
    return np.logaddexp(np.log(0.3) + one, np.log(0.7) + other)


def adapted(log_prob, mean: np.ndarray, scale: float = 1.0, seed: int = 4):
    guess = Guess(mean, scale * np.eye(mean.size))
    return adapt(log_prob, [guess], np.random.default_rng(seed))


def error_of(efficiency: float) -> float:
    """Five standard errors of a log evidence from the least draws of a round, 60 x 7."""
    return 5.0 * np.sqrt((1.0 / efficiency - 1.0) / 420) + 1e-12


@pytest.mark.parametrize("dof", [1.5, 6.0, 80.0])
def test_a_student_t_has_scipys_density(dof: float) -> None:
    t = np.random.default_rng(1).normal(0.0, 4.0, (50, 3))
    expected = stats.multivariate_t(MEAN, SCALE, dof).logpdf(t)
    found = StudentT(MEAN, np.linalg.cholesky(SCALE), dof)
    np.testing.assert_allclose(found.log_prob(t), expected, rtol=1e-10)
    marginal = stats.t(dof, MEAN[0], np.sqrt(SCALE[0, 0]))
    drawn = found.sample(np.random.default_rng(2), 20_000)
    assert stats.kstest(drawn[:, 0], marginal.cdf).pvalue > 1e-4


@pytest.mark.parametrize("d", [1, 2, 3])
def test_the_map_is_one_to_one_and_its_jacobian_its_own(d: int) -> None:
    z = np.random.default_rng(1).standard_normal((4000, 3))
    t = np.column_stack([5.0 + 0.4 * z[:, 1] ** 2 + z[:, 0], z[:, 1], 0.1 * z[:, 2]])[:, 3 - d :]
    found = TriangularMap.fit(t, np.full(4000, 1 / 4000), 4000.0)
    for scale in (1.0, 30.0):  # also far outside what it was fitted to
        there, _ = found.straighten(scale * t)
        np.testing.assert_allclose(found.bend(there), scale * t, rtol=1e-7, atol=1e-7)
    step = 1e-6 * np.eye(d)
    ahead, behind = found.straighten(t[0] + step)[0], found.straighten(t[0] - step)[0]
    log_det = np.linalg.slogdet((ahead - behind) / 2e-6)[1]
    assert found.straighten(t[:1])[1] == pytest.approx(log_det, abs=1e-5)
    if d == 3:
        first, second, _ = found.straighten(t)[0].T
        assert abs(np.corrcoef(t[:, 0], t[:, 1] ** 2)[0, 1]) > 0.2
        assert abs(np.corrcoef(first, second**2)[0, 1]) < 0.1


def test_two_clusters_are_found_with_their_shares() -> None:
    rng = np.random.default_rng(5)
    left = rng.random(4000) < 0.25
    x = rng.standard_normal((4000, 2)) + np.where(left, -8.0, 8.0)[:, None] * [1.0, 0.0]
    shares, components = fit_mixture(x, np.full(4000, 1 / 4000), 4000.0, rng)
    share = shares[components.mean[:, 0] < 0.0].sum()
    assert abs(share - left.mean()) < 0.01


@pytest.mark.parametrize("log_prob", [banana, two_modes])
def test_draws_come_with_their_density(log_prob) -> None:
    """E[p/q] = 1 under the proposal q for a normal density p in its bulk."""
    proposal, _ = adapted(log_prob, np.array([0.5, -0.5]), 1.5)
    proposal = proposal.extended(np.random.default_rng(1).normal(5.0, 0.1, (50, 2)))
    t = proposal.draw(np.random.default_rng(8), 20_000)
    log_q = proposal.log_prob(t)
    middle = t[np.argmax(log_q)]
    ratio = np.exp(stats.multivariate_normal(middle, 1e-3).logpdf(t) - log_q)
    assert abs(ratio.mean() - 1.0) < 5.0 * ratio.std() / np.sqrt(20_000)


def test_the_evidence_of_a_gaussian_found_from_a_poor_guess() -> None:
    target = stats.multivariate_normal(MEAN, SCALE)
    proposal, found = adapted(lambda t: target.logpdf(t) - 7.5, MEAN + 1.5, 0.5)
    assert found.efficiency > 0.7
    assert abs(found.log_evidence + 7.5) < error_of(found.efficiency)
    drawn = proposal.draw(np.random.default_rng(1), 20_000)
    # The proposal is wider by design.
    assert np.all(np.abs(drawn.mean(axis=0) - MEAN) < 0.1 * np.sqrt(np.diag(SCALE)))
    spread = drawn.std(axis=0) / np.sqrt(np.diag(SCALE))
    assert np.all((spread > 0.95) & (spread < 1.5))


@pytest.mark.parametrize("known", [True, False])
def test_the_evidence_of_a_conjugate_model(known: bool) -> None:
    model = linear()
    log_prob = model.log_prob_known if known else model.log_prob_unknown
    exact = model.log_evidence_known() if known else model.log_evidence_unknown()
    _, found = adapted(log_prob, np.zeros(3 if known else 4))
    assert found.efficiency > 0.3
    assert abs(found.log_evidence - exact) < error_of(found.efficiency)


def test_a_bend_is_followed() -> None:
    """A single normal of the banana's moments has an efficiency near 0.2."""
    _, found = adapted(banana, np.zeros(2))
    assert found.efficiency > 0.35
    assert abs(found.log_evidence) < error_of(found.efficiency)


@pytest.mark.parametrize("seed", range(3))
def test_tails_heavier_than_the_proposals(seed: int) -> None:
    target = stats.multivariate_t([1.0, -1.0], [[1.0, 0.6], [0.6, 2.0]], df=2)
    _, found = adapted(target.logpdf, np.zeros(2), seed=seed)
    # The weights have no variance: a loose bound.
    assert abs(found.log_evidence) < 0.2


def test_a_density_that_is_zero_everywhere_gives_no_evidence() -> None:
    _, found = adapted(lambda t: np.full(len(t), -np.inf), MEAN)
    assert found == (-np.inf, 0.0)


def test_a_chain_teaches_what_importance_sampling_missed() -> None:
    """Draws of two modes, of which the proposal knew one."""
    efficiencies = []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        known, before = adapted(two_modes, np.array([-15.0, 0.0]), seed=seed)
        assert before.log_evidence == pytest.approx(np.log(0.3), abs=0.1)
        draws = rng.standard_normal((4000, 2))
        draws[:, 0] += np.where(np.arange(4000) % 4, -15.0, 15.0)  # in the wrong proportion
        _, after = refit(two_modes, known, draws, 4000.0, rng)
        assert abs(after.log_evidence) < error_of(after.efficiency)
        efficiencies.append(after.efficiency)
    assert np.median(efficiencies) > 0.35


def test_draws_that_have_no_spread_leave_the_proposal_as_it_is() -> None:
    target = stats.multivariate_normal(MEAN, SCALE)
    known: Proposal
    known, _ = adapted(target.logpdf, MEAN)
    same, _ = refit(target.logpdf, known, np.ones((500, 3)), 500.0, np.random.default_rng(1))
    assert same.parts == known.parts
