"""Sums of squares against plain sums over rows; the density with an error of the prediction."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

import calib.inference.likelihood as module
from calib.inference.likelihood import SumOfSquares, log_normal
from calib.models import MODELS, BoundModel
from tests.models.ranges import draw

SEEDS = st.integers(0, 2**32 - 1)
LENGTHS = (2, 40, 256, 257, 3000)


def data(name: str, seed: int, n: int, *, levels: int | None = None):
    """A bound model, vectors, and n rows with conditions all distinct or of some levels each."""
    bound, theta, conditions = draw(seed, name, k=7, n=n)
    rng = np.random.default_rng(seed)
    if levels is not None:
        conditions = {c: rng.choice(v[:levels], n) for c, v in conditions.items()}
    location = bound.mean_response(theta[:1], conditions)[0]
    return bound, theta, conditions, location + 0.1 * rng.standard_normal(n)


def plain(bound: BoundModel, theta, conditions, response) -> np.ndarray:
    return np.square(response - bound.mean_response(theta, conditions)).sum(axis=1)


# Without the rigid wheel, whose integrals cost a thousand times the others.
FAST = [name for name in MODELS if not name.startswith("wong_reece")]


@pytest.mark.parametrize("name", FAST)
@settings(max_examples=10, deadline=None)
@given(seed=SEEDS, n=st.sampled_from(LENGTHS), levels=st.sampled_from([None, 1, 3]))
@example(seed=8199, n=257, levels=3)
def test_sums_are_those_over_all_rows(name: str, seed: int, n: int, levels: int | None) -> None:
    bound, theta, conditions, response = data(name, seed, n, levels=levels)
    found = SumOfSquares.of(bound, conditions, response)
    expected, largest = plain(bound, theta, conditions, response), np.abs(response).max()
    # Of 3000 terms, each with a relative rounding error of some 1e-13 (Newton's tolerance) and that
    # of a response, and of a mean of them, which may be large beside its residual.
    rounding = 4.0 * np.finfo(float).eps * largest * np.sqrt(n * expected)
    there = np.isfinite(expected)
    np.testing.assert_array_equal(found(theta)[~there], expected[~there])
    apart = np.abs(found(theta) - expected)[there]
    assert (apart <= (1e-9 * expected + rounding)[there]).all()


def test_a_condition_is_evaluated_once_however_often_it_was_measured() -> None:
    bound, _, conditions, response = data("magic_formula_pressure", 1, 5000, levels=6)
    squares = SumOfSquares.of(bound, conditions, response)
    assert squares.mean.size == len(set(zip(*conditions.values(), strict=True))) <= 36
    assert squares.repeats.sum() == 5000


@pytest.mark.parametrize("name", ["magic_formula_pressure", "modified_bekker"])
@pytest.mark.parametrize("n", LENGTHS)
def test_a_sum_does_not_depend_on_what_it_is_evaluated_with(
    name: str, n: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    bound, theta, conditions, response = data(name, 3, n)
    many = np.tile(theta, (40 if n > 1000 else 300, 1))
    monkeypatch.setattr(module, "CHUNK_CELLS", max(4096, n))
    squares = SumOfSquares.of(bound, conditions, response)
    together = squares(many)
    # Other vectors may change the order of a sum, or Newton's last step of the implicit model.
    for i in (0, 3, 6):
        np.testing.assert_allclose(squares(theta[i : i + 1])[0], together[i::7], rtol=1e-9)


def test_memory_is_bounded() -> None:
    """Some arrays of the cells that are evaluated at once, whatever the rows and vectors."""
    bound, theta, conditions, response = data("magic_formula_pressure", 5, 100_000)
    squares = SumOfSquares.of(bound, conditions, response)
    many = np.tile(theta, (10, 1))
    tracemalloc.start()
    squares(many)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 20 * 8 * module.CHUNK_CELLS < many.shape[0] * response.size * 8


def test_a_vector_without_a_value_does_not_touch_the_others() -> None:
    bound, theta, conditions, response = data("magic_formula_pressure", 6, 42)
    squares = SumOfSquares.of(bound, conditions, response)
    before = squares(theta)
    theta[2] = -1.0
    after = squares(theta)
    assert np.isnan(after[2])
    np.testing.assert_array_equal(np.delete(after, 2), np.delete(before, 2))


def test_with_an_error_of_the_prediction_it_is_a_normal_density() -> None:
    rng = np.random.default_rng(1)
    k, n, j = 5, 12, 3
    residuals, curves = rng.standard_normal((k, n)), rng.standard_normal((n, j))
    sigma, variance = rng.uniform(0.1, 2.0, k), rng.uniform(0.0, 1.0, k)
    variance[0] = 0.0
    found = log_normal(residuals, variance, curves, sigma)
    for i in range(k):
        covariance = sigma[i] ** 2 * np.eye(n) + variance[i] * curves @ curves.T
        np.testing.assert_allclose(
            found[i], multivariate_normal(np.zeros(n), covariance).logpdf(residuals[i])
        )


def test_where_there_is_no_prediction_there_is_no_density() -> None:
    residuals = np.array([[1.0, np.nan], [1.0, 1.0]])
    found = log_normal(residuals, np.ones(2), np.ones((2, 1)), np.array([1.0, -1.0]))
    assert np.isnan(found).all()
    beyond = np.array([[1.0], [np.nan]])  # a row where the curves have no value
    assert np.isnan(log_normal(np.ones((2, 2)), np.ones(2), beyond, np.ones(2))).all()


def test_a_tiny_noise_beside_a_large_error_is_no_failure() -> None:
    rng = np.random.default_rng(2)
    curves = np.repeat(rng.normal(size=(6, 1)), 3, axis=1)  # of rank one
    residuals, variance = rng.normal(size=(4, 6)), np.full(4, 2.0)
    sigma = np.array([0.5, 1e-9, 1e-12, 1e-200])
    with np.errstate(all="ignore"):
        values = log_normal(residuals, variance, curves, sigma)
    covariance = 0.25 * np.eye(6) + 2.0 * curves @ curves.T
    expected = multivariate_normal(np.zeros(6), covariance).logpdf(residuals[0])
    np.testing.assert_allclose(values[0], expected)
    # Residuals that the curves do not explain are impossible without noise.
    assert (values[1:3] < -1e15).all()
    assert np.isnan(values[3])
