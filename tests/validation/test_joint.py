"""References for rows that are not independent."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binom, kstwo

from calib.validation.prediction import (
    binomial_p,
    coverage_probability,
    effective_rows,
    ks_distance,
    pit_half_width,
)


@pytest.fixture
def independent() -> np.ndarray:
    return np.random.default_rng(1).standard_normal((4000, 12))


@pytest.fixture
def shared() -> np.ndarray:
    """Rows that move as one."""
    rng = np.random.default_rng(2)
    return rng.standard_normal((4000, 1)) + 0.01 * rng.standard_normal((4000, 12))


def test_independent_rows_give_the_kolmogorov_law(independent):
    assert pit_half_width(independent) == pytest.approx(kstwo.ppf(0.95, 12), rel=0.04)


def test_independent_rows_give_the_binomial_law(independent):
    found = coverage_probability(independent, 9, 0.9)
    assert found == pytest.approx(binom.cdf(9, 12, 0.9), abs=0.02)


def test_rows_that_move_as_one_miss_as_one(shared):
    # All twelve outside happens one time in ten, where the binomial law says 1e-12.
    assert coverage_probability(shared, 0, 0.9) == pytest.approx(0.1, abs=0.02)
    assert pit_half_width(shared) > 0.9


def test_effective_rows(independent, shared):
    assert effective_rows(independent) == pytest.approx(12, abs=0.6)
    assert effective_rows(shared) == pytest.approx(1, abs=0.01)
    assert effective_rows(shared[:, :1]) == 1


def test_draws_without_a_value_are_left_out(independent):
    holed = independent.copy()
    holed[::50, 3] = np.nan
    assert coverage_probability(holed, 12, 0.9) == pytest.approx(1.0)
    assert np.isfinite(effective_rows(holed))


def test_ks_distance_of_known_values():
    assert ks_distance(np.array([0.5])) == pytest.approx(0.5)
    assert ks_distance(np.array([0.25, 0.75])) == pytest.approx(0.25)
    assert ks_distance(np.array([[0.9, 0.95], [0.25, 0.75]])) == pytest.approx([0.9, 0.25])


def test_binomial_p():
    assert binomial_p(14, 14) == pytest.approx(1.0)
    assert binomial_p(9, 14) == pytest.approx(0.0092, abs=0.0005)
    assert binomial_p(9, 14, 0.5) == pytest.approx(binom.cdf(9, 14, 0.5), rel=1e-12)
    assert np.isnan(binomial_p(0, 0))
