"""Many ascents at once: each ends near a maximum of its own basin, inside the bounds."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from calib.inference.sampling.mode import climb

FAR = np.full(3, np.inf)


def test_every_start_reaches_the_top_of_a_correlated_density() -> None:
    scale = np.array([[1e-4, 0.009, 0.0], [0.009, 1.0, 0.0], [0.0, 0.0, 25.0]])
    target = stats.multivariate_normal([1.0, -2.0, 30.0], scale)
    starts = np.random.default_rng(1).normal(0.0, 3.0, (20, 3))
    ends, heights = climb(target.logpdf, starts, np.array([1.0, 1.0, 5.0]), -FAR, FAR)
    assert np.all(heights > target.logpdf(target.mean) - 0.05)
    np.testing.assert_allclose(heights, target.logpdf(ends))


def test_a_valley_that_bends() -> None:
    """The valley of Rosenbrock, of which a tenth in log density is all that is asked."""

    def log_prob(t):
        return -np.square(1.0 - t[:, 0]) - 100.0 * np.square(t[:, 1] - t[:, 0] ** 2)

    starts = np.array([[-1.2, 1.0], [2.0, -1.0], [0.0, 0.0], [-0.5, 2.0]])
    ends, heights = climb(log_prob, starts, np.ones(2), -FAR[:2], FAR[:2])
    assert np.all(heights > -0.1)
    np.testing.assert_allclose(ends, 1.0, atol=0.7)


def test_each_basin_is_reached_from_its_own_side() -> None:
    def log_prob(t):
        return np.logaddexp(
            stats.norm.logpdf(t[:, 0], -3.0, 0.1), stats.norm.logpdf(t[:, 0], 4.0, 0.5)
        )

    ends, _ = climb(
        log_prob, np.array([[-5.0], [-2.5], [3.0], [9.0]]), np.ones(1), -FAR[:1], FAR[:1]
    )
    np.testing.assert_allclose(ends[:, 0], [-3.0, -3.0, 4.0, 4.0], atol=0.05)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_bounds_are_reached_and_kept(sign: float) -> None:
    low, high = np.array([-1.0, 0.0]), np.array([2.0, 3.0])
    corner = high if sign > 0 else low
    starts = np.random.default_rng(2).uniform(low, high, (8, 2))
    ends, _ = climb(lambda t: sign * t.sum(axis=1), starts, np.ones(2), low, high)
    np.testing.assert_allclose(ends, np.tile(corner, (8, 1)), atol=1e-9)


def test_ground_that_is_not_allowed_is_not_entered() -> None:
    def log_prob(t):
        return np.where(t[:, 0] > 0.0, -np.square(t[:, 0] - 0.5), -np.inf)

    ends, heights = climb(log_prob, np.array([[3.0], [1e-6]]), np.ones(1), -FAR[:1], FAR[:1])
    np.testing.assert_allclose(ends[:, 0], 0.5, atol=0.2)
    assert np.isfinite(heights).all()
