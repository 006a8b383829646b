"""Adaptive importance sampling: evidence in closed form, what the proposal learns."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from calib.inference.sampling.mixture import StudentT
from calib.inference.sampling.proposal import Guess, Proposal, adapt, refit
from tests.inference.sampling.closed_form import linear

MEAN = np.array([1.0, -2.0, 0.5])
SCALE = np.array([[2.0, 0.6, 0.1], [0.6, 1.0, -0.3], [0.1, -0.3, 0.5]])


def student(dof: float = 6.0, shift: float = 0.0) -> StudentT:
    return StudentT(MEAN + shift, np.linalg.cholesky(SCALE), dof)


def adapted(log_prob, start: StudentT | Guess, seed: int = 4) -> tuple[Proposal, float, float]:
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
    drawn, _ = mixed.draw(np.random.default_rng(1), 20_000)
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
    (part,) = mixed.parts
    assert len(part.mixture.components) > 2
    assert part.mixture.weights.sum() == pytest.approx(1.0)
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


def test_a_chain_teaches_what_importance_sampling_missed() -> None:
    """Draws of two modes, of which the proposal knew one."""

    def log_prob(t):
        one, other = (stats.multivariate_normal([x, 0.0]).logpdf(t) for x in (-15.0, 15.0))
        return np.logaddexp(np.log(0.3) + one, np.log(0.7) + other)

    efficiencies = []
    for seed in range(9):
        rng = np.random.default_rng(seed)
        known, before = adapt(log_prob, [Guess(np.array([-15.0, 0.0]), np.eye(2))], rng)
        assert before.log_evidence == pytest.approx(np.log(0.3), abs=0.1)
        draws = rng.standard_normal((4000, 2))
        draws[:, 0] += np.where(np.arange(4000) % 4, -15.0, 15.0)  # in the wrong proportion
        _, after = refit(log_prob, known, draws, 4000.0, rng)
        assert abs(after.log_evidence) < error_of(after.efficiency)
        efficiencies.append(after.efficiency)
    # One seed's lies between 0.387 and 0.438.
    assert np.median(efficiencies) > 0.4


def test_draws_that_have_no_spread_leave_the_proposal_as_it_is() -> None:
    rng = np.random.default_rng(10)
    target = stats.multivariate_normal(MEAN, SCALE)
    known, _ = adapt(target.logpdf, [Guess(MEAN, np.eye(3))], rng)
    same, _ = refit(target.logpdf, known, np.ones((500, 3)), 500.0, rng)
    assert same.parts == known.parts
