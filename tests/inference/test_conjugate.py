"""A conjugate problem in closed form, for every sampler, estimator and prediction.

A parabola with normal priors and known noise: posterior, evidence, predictions and leave-one-out
densities are normal, and every one is known.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pytest
from scipy import stats

from calib.data import table_from_arrays
from calib.inference.calibration import Calibration, calibrate
from calib.inference.diagnostics import ess
from calib.inference.estimators import estimate_genetic, estimate_least_squares
from calib.inference.mode import find_modes
from calib.inference.problem import Problem
from calib.inference.proposal import Guess, adapt
from calib.inference.sampler import fitted_moves, local_moves, run_walkers
from calib.inference.search import estimate_differential_evolution
from calib.validation.prediction import predict
from calib.validation.validate import leave_one_out, validate_held_out
from tests.custom_problems import fixed, normal, problem_of

SIGMAS = 5.0
SIGMA = 0.3
MEAN, SD = np.array([1.0, 0.0, -1.0]), np.array([2.0, 5.0, 8.0])
SLIP = np.linspace(-0.1, 0.7, 15)


def design(slip: np.ndarray) -> np.ndarray:
    return np.column_stack([np.ones_like(slip), slip, slip**2])


@dataclass(frozen=True)
class Exact:
    """The normal posterior of readings y at slips x."""

    x: np.ndarray
    y: np.ndarray

    @cached_property
    def covariance(self) -> np.ndarray:
        X = design(self.x)
        return np.linalg.inv(X.T @ X / SIGMA**2 + np.diag(SD**-2.0))

    @cached_property
    def mean(self) -> np.ndarray:
        X = design(self.x)
        return self.covariance @ (X.T @ self.y / SIGMA**2 + MEAN / SD**2)

    @property
    def log_evidence(self) -> float:
        X = design(self.x)
        covariance = SIGMA**2 * np.eye(self.x.size) + X @ np.diag(SD**2) @ X.T
        return float(stats.multivariate_normal(X @ MEAN, covariance).logpdf(self.y))

    def predictive(self, slip: np.ndarray, noise: float = SIGMA) -> stats.rv_frozen:
        X = design(slip)
        variance = np.einsum("nd,de,ne->n", X, self.covariance, X) + noise**2
        return stats.norm(X @ self.mean, np.sqrt(variance))

    def without(self, i: int) -> Exact:
        rest = np.arange(self.x.size) != i
        return Exact(self.x[rest], self.y[rest])


@pytest.fixture(scope="module")
def exact() -> Exact:
    noise = SIGMA * np.random.default_rng(8).standard_normal(SLIP.size)
    return Exact(SLIP, design(SLIP) @ np.array([0.5, 4.0, -4.5]) + noise)


@pytest.fixture(scope="module")
def problem(exact: Exact) -> Problem:
    priors = [normal(n, m, s) for n, m, s in zip("abc", MEAN, SD, strict=True)]
    return problem_of(
        lambda a, b, c, x: a + b * x + c * x * x, [*priors, fixed("sigma", SIGMA)], exact.x, exact.y
    )


@pytest.fixture(scope="module")
def calibration(problem: Problem) -> Calibration:
    found = calibrate(problem, 1)
    assert found.converged
    return found


def assert_normal(chains: np.ndarray, mean: np.ndarray, covariance: np.ndarray) -> None:
    """Whitened draws, shape (chains, draws, d), have zero mean, unit variance, no correlation."""
    lower = np.linalg.cholesky(covariance)
    z = np.linalg.solve(lower, (chains - mean).reshape(-1, mean.size).T).T
    d, shape = mean.size, chains.shape[:2]
    products = [z[:, i] * z[:, j] for i in range(d) for j in range(i + 1)]
    moments = np.column_stack([z, *products])
    expected = [0.0] * d + [float(i == j) for i in range(d) for j in range(i + 1)]
    for p in (0.05, 0.5, 0.95):
        moments = np.column_stack([moments, z < stats.norm.ppf(p)])
        expected += [p] * d
    size = ess(moments.reshape(*shape, -1), "mean")
    error = moments.std(axis=0) / np.sqrt(size)
    assert np.all(np.abs(moments.mean(axis=0) - expected) < SIGMAS * error)


def test_the_whole_sampler(calibration: Calibration, exact: Exact) -> None:
    t = calibration.draws.t
    assert_normal(t.reshape(-1, *t.shape[2:]), exact.mean, exact.covariance)
    draws = calibration.draws
    error = np.sqrt((1.0 / draws.efficiency - 1.0) / 500)
    assert abs(draws.log_evidence - exact.log_evidence) < SIGMAS * error


@pytest.fixture(scope="module")
def proposal(problem: Problem):
    modes = find_modes(problem.log_prob, problem.priors, np.random.default_rng(1))
    guesses = [Guess(m.t, np.linalg.cholesky(m.covariance)) for m in modes]
    return adapt(problem.log_prob, guesses, np.random.default_rng(2))[0]


def test_the_moves_leave_the_posterior_as_it_is(problem: Problem, exact: Exact, proposal) -> None:
    """All together, the local ones, and each alone: draws of a proposal would hide a wrong one."""
    walkers, steps, rng = 40, 3000, np.random.default_rng(3)
    moves = fitted_moves(proposal, rng)
    assert sum(share for _, share in moves) == pytest.approx(1.0)
    start = proposal.draw(np.random.default_rng(5), walkers)
    for used in (moves, local_moves(), *([(move, 1.0)] for move, _ in moves)):
        chain, _, _ = run_walkers(problem.log_prob, start, used, steps, rng)
        # Walkers exchange positions in these moves; whole ensembles are what is independent, so the
        # effective size is taken of chains along the steps, which it understates if at all.
        assert_normal(chain[steps // 3 :].transpose(1, 0, 2), exact.mean, exact.covariance)


def test_importance_sampling_from_the_fitted_proposal(
    problem: Problem, exact: Exact, proposal
) -> None:
    n = 20_000
    t = proposal.draw(np.random.default_rng(6), n)
    log_q = proposal.log_prob(t)
    log_weight = problem.log_prob(t) - log_q
    weight = np.exp(log_weight - exact.log_evidence)
    # Normalised by the exact evidence, weights have mean one.
    assert abs(weight.mean() - 1.0) < SIGMAS * weight.std() / np.sqrt(n)
    z = np.linalg.solve(np.linalg.cholesky(exact.covariance), (t - exact.mean).T)
    for value in (*z, *(z**2 - 1.0), z[0] * z[1]):
        product = weight * value
        assert abs(product.mean()) < SIGMAS * product.std() / np.sqrt(n)


def test_the_mode_is_the_mean(problem: Problem, exact: Exact) -> None:
    (mode,) = find_modes(problem.log_prob, problem.priors, np.random.default_rng(1))
    sd = np.sqrt(np.diag(exact.covariance))
    assert np.all(np.abs(mode.t - exact.mean) < 1e-3 * sd)
    np.testing.assert_allclose(
        mode.covariance / np.outer(sd, sd), exact.covariance / np.outer(sd, sd), atol=2e-3
    )


@pytest.mark.parametrize(
    ("estimator", "tolerance"),
    [
        (estimate_least_squares, 1e-7),
        (estimate_genetic, 1e-4),
        (estimate_differential_evolution, 1e-3),
    ],
)
def test_every_estimator_finds_the_least_squares_optimum(
    estimator, tolerance: float, problem: Problem, exact: Exact
) -> None:
    optimum, cost, *_ = np.linalg.lstsq(design(exact.x), exact.y)
    found = estimator(problem, np.random.default_rng(1))
    sd = SIGMA * np.sqrt(np.diag(np.linalg.inv(design(exact.x).T @ design(exact.x))))
    assert np.all(np.abs(found.theta - optimum) < tolerance * sd)
    assert found.cost == pytest.approx(float(cost[0]), rel=1e-6)


def test_bands_of_a_prediction(calibration: Calibration, exact: Exact) -> None:
    slip = np.array([-0.3, 0.1, 0.5, 1.0])
    found = predict(calibration, table_from_arrays({"slip_ratio": slip}))
    for bands, noise in ((found.parameter, 0.0), (found.predictive, SIGMA)):
        law = exact.predictive(slip, noise)
        # Quantiles of 4000 nearly independent draws: sqrt(p (1 - p)/n) over the density there.
        for level in (0.5, 0.9, 0.95):
            tail = 0.5 * (1.0 - level)
            error = np.sqrt(tail * (1.0 - tail) / 2000) / stats.norm.pdf(stats.norm.ppf(tail))
            for edge, p in ((bands.lower[level], tail), (bands.upper[level], 1.0 - tail)):
                assert np.all(np.abs(edge - law.ppf(p)) < SIGMAS * error * law.std())


def test_leaving_each_row_out(calibration: Calibration, exact: Exact) -> None:
    found = leave_one_out(calibration)
    each = [
        exact.without(i).predictive(exact.x[i : i + 1]).logpdf(exact.y[i])[0]
        for i in range(exact.x.size)
    ]
    assert found.elpd == pytest.approx(np.sum(each), abs=0.1)
    for i in range(exact.x.size):
        law = exact.without(i).predictive(exact.x[i : i + 1])
        z = (found.draws[:, i] - law.mean()) / law.std()
        assert abs(z.mean()) < 0.1
        assert z.std() == pytest.approx(1.0, abs=0.1)


def test_scores_of_held_out_rows(calibration: Calibration, exact: Exact) -> None:
    """The PIT of readings at the exact quantiles are those quantiles."""
    slip = np.linspace(0.0, 0.6, 9)
    p = np.linspace(0.1, 0.9, 9)
    law = exact.predictive(slip)
    held = table_from_arrays({"slip_ratio": slip, "drawbar_pull_kn": law.ppf(p)})
    found = validate_held_out(calibration, held)
    np.testing.assert_allclose(found.scores.pit, p, atol=SIGMAS * 0.5 / np.sqrt(2000))
