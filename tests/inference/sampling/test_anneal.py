"""From the prior to the posterior: moments of a normal, modes in their proportions."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from calib.inference.sampling.walkers import anneal


def wide(t):
    return stats.norm.logpdf(t, 0.0, 10.0).sum(axis=1)


def test_draws_of_a_normal_become_those_of_a_narrow_one() -> None:
    def narrow(t):
        return stats.norm.logpdf(t, 3.0, 0.01).sum(axis=1)

    rng = np.random.default_rng(1)
    found = anneal(wide, narrow, 10.0 * rng.standard_normal((1000, 3)), rng)
    assert found is not None
    # Resampled draws are worth fewer than as many independent ones: a fifth at the least.
    assert np.all(np.abs(found.mean(axis=0) - 3.0) < 5.0 * 0.01 / np.sqrt(200))
    assert np.all(np.abs(found.std(axis=0) / 0.01 - 1.0) < 5.0 / np.sqrt(2.0 * 200))


def test_two_modes_keep_their_proportions() -> None:
    def two(t):
        one, other = (stats.norm.logpdf(t[:, 0], m, 0.1) for m in (-5.0, 5.0))
        return np.logaddexp(np.log(0.2) + one, np.log(0.8) + other) + stats.norm.logpdf(t[:, 1])

    shares = []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        found = anneal(wide, two, 10.0 * rng.standard_normal((1000, 2)), rng)
        assert found is not None
        shares.append((found[:, 0] < 0.0).mean())
    error = np.std(shares) / np.sqrt(len(shares))
    assert abs(np.mean(shares) - 0.2) < 5.0 * error
    assert min(shares) > 0.05


def test_a_density_that_is_zero_at_all_draws_has_none() -> None:
    rng = np.random.default_rng(1)
    draws = rng.standard_normal((100, 2))
    assert anneal(wide, lambda t: np.full(len(t), -np.inf), draws, rng) is None


@pytest.mark.parametrize("part", [0.01, 0.3])
def test_a_density_that_is_zero_at_most_draws(part: float) -> None:
    edge = 10.0 * stats.norm.ppf(part)

    def below(t):
        return np.where(t[:, 0] < edge, wide(t), -np.inf)

    rng = np.random.default_rng(1)
    found = anneal(wide, below, 10.0 * rng.standard_normal((1000, 2)), rng)
    assert found is not None
    assert (found[:, 0] < edge).all()
    assert len(np.unique(found[:, 0])) > 500
