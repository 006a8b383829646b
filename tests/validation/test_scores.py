"""Scores against their definitions and against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from calib.validation.scores import LEVELS, coverage, crps, pit, score


def test_crps_is_its_definition() -> None:
    rng = np.random.default_rng(1)
    draws, observed = rng.gamma(2.0, size=(60, 7)), rng.gamma(2.0, size=7)
    for j in range(7):
        x = draws[:, j]
        expected = np.abs(x - observed[j]).mean() - 0.5 * np.abs(x[:, None] - x).mean()
        assert crps(draws, observed)[j] == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("y", [-2.0, 0.0, 0.3, 4.0])
def test_crps_of_a_normal(y: float) -> None:
    """Gneiting & Raftery (2007), Eq 21: sigma [z (2 Phi(z) - 1) + 2 phi(z) - 1/sqrt(pi)]."""
    mu, sigma = 0.5, 1.5
    z = (y - mu) / sigma
    expected = sigma * (z * (2.0 * stats.norm.cdf(z) - 1.0) + 2.0 * stats.norm.pdf(z) - np.pi**-0.5)
    # Quantiles in place of draws: the error falls as 1/m instead of 1/sqrt(m).
    m = 20_000
    draws = stats.norm.ppf((np.arange(m) + 0.5) / m, mu, sigma)[:, None]
    assert crps(draws, np.array([y]))[0] == pytest.approx(expected, abs=1e-3)


def test_crps_of_a_point_is_the_absolute_error() -> None:
    np.testing.assert_allclose(crps(np.full((10, 2), 3.0), np.array([1.0, 3.5])), [2.0, 0.5])


@pytest.mark.parametrize(("hits", "n"), [(9, 14), (1, 30), (29, 30), (50, 100)])
def test_coverage_has_the_jeffreys_interval(hits: int, n: int) -> None:
    draws = np.tile(np.linspace(-1.0, 1.0, 201)[:, None], n)
    observed = np.where(np.arange(n) < hits, 0.0, 5.0)
    found = coverage(draws, observed, 0.9)
    assert (found.hits, found.n, found.proportion) == (hits, n, hits / n)
    expected = stats.beta.interval(0.95, hits + 0.5, n - hits + 0.5)
    np.testing.assert_allclose([found.lower, found.upper], expected, rtol=1e-10)


def test_the_interval_of_none_and_all_reaches_the_end() -> None:
    draws = np.linspace(-1.0, 1.0, 201)[:, None] * np.ones(5)
    none, every = (coverage(draws, np.full(5, y), 0.5) for y in (9.0, 0.0))
    assert (none.lower, none.hits) == (0.0, 0)
    assert (every.upper, every.hits) == (1.0, 5)
    assert none.upper == pytest.approx(stats.beta.ppf(0.975, 0.5, 5.5))
    assert every.lower == pytest.approx(stats.beta.ppf(0.025, 5.5, 0.5))


@pytest.mark.parametrize("level", LEVELS)
def test_bands_are_central(level: float) -> None:
    draws = np.arange(10_001.0)[:, None]
    low, high = 10_000 * (0.5 - level / 2), 10_000 * (0.5 + level / 2)
    for y, inside in ((low - 1, 0), (low + 1, 1), (high - 1, 1), (high + 1, 0)):
        assert coverage(draws, np.array([y]), level).hits == inside


def test_pit_is_the_part_below() -> None:
    draws = np.arange(10.0)[:, None] * np.ones(3)
    np.testing.assert_allclose(pit(draws, np.array([-1.0, 3.5, 20.0])), [0.0, 0.4, 1.0])


def simulated(spread: float) -> tuple[np.ndarray, np.ndarray]:
    """Draws of 400 normals of various widths, and observations `spread` times as wide."""
    rng = np.random.default_rng(7)
    mean, sd = rng.normal(size=400), rng.uniform(0.5, 2.0, 400)
    return mean + sd * rng.standard_normal((2000, 400)), mean + spread * sd * rng.normal(size=400)


def test_calibrated_predictions_have_a_uniform_pit_and_the_coverage_they_claim() -> None:
    found = score(*simulated(1.0))
    # One fixed seed; a calibrated method fails either line with probability 1e-3 or less.
    assert stats.kstest(found.pit, "uniform").pvalue > 1e-3
    for level, c in found.coverage.items():
        assert stats.binomtest(c.hits, c.n, level).pvalue > 1e-3


@pytest.mark.parametrize("spread", [0.5, 2.0])
def test_miscalibrated_predictions_are_noticed(spread: float) -> None:
    found = score(*simulated(spread))
    assert stats.kstest(found.pit, "uniform").pvalue < 1e-3
    assert stats.binomtest(found.coverage[0.5].hits, 400, 0.5).pvalue < 1e-3


def test_relative_errors_leave_out_what_is_near_zero() -> None:
    observed = np.array([2.0, -1.0, 0.1, 0.11, 0.0])
    draws = np.tile([2.2, -0.9, 5.0, 0.088, 1.0], (5, 1))
    found = score(draws, observed)
    # A twentieth of the largest is 0.1, which is not above itself.
    np.testing.assert_allclose(found.relative_error, [0.1, -0.1, np.nan, -0.2, np.nan], rtol=1e-9)
    assert found.max_relative_error == pytest.approx(0.2)
    rmse = np.sqrt((0.2**2 + 0.1**2 + 4.9**2 + 0.022**2 + 1.0**2) / 5)
    assert found.rmse == pytest.approx(rmse)
    assert found.n == 5
    np.testing.assert_allclose(found.median, draws[0])


def test_relative_errors_of_zeros_alone_are_undefined() -> None:
    assert np.isnan(score(np.ones((5, 2)), np.zeros(2)).max_relative_error)
