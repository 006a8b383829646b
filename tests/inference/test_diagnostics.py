"""Our one pass over the ranks, and emcee's autocorrelation time, against the libraries."""

from __future__ import annotations

import emcee
import numpy as np
import pytest

from calib.inference.diagnostics import (
    autocorrelation_time,
    convergence,
    distances,
    ess,
    hdi,
    hdi_error,
    mcse,
    median_error,
    power_scaled_weights,
    power_sensitivity,
    rank_histograms,
    rank_scatter,
    tail_shape,
)


def sticky(seed: int, shape: tuple[int, ...], share: float) -> np.ndarray:
    """Chains that repeat their last value, as Metropolis chains do: ties among the ranks."""
    rng = np.random.default_rng(seed)
    fresh = rng.standard_normal(shape)
    fresh[0] += 0.3
    draws = fresh.copy()
    for s in range(1, shape[2]):
        moved = rng.random(shape[:2]) < share
        draws[:, :, s] = np.where(moved[..., None], fresh[:, :, s], draws[:, :, s - 1])
    return draws


@pytest.mark.parametrize("shape", [(4, 20, 60, 3), (4, 6, 200, 2), (5, 1, 40, 1)])
@pytest.mark.parametrize("share", [1.0, 0.3])
def test_convergence_is_arviz_own(shape: tuple[int, ...], share: float) -> None:
    # Not at the top: to import it takes every process of the tests a second.
    from arviz_stats.base import array_stats

    draws = sticky(1, shape, share)
    ensembles, walkers, steps, d = shape
    found = convergence(draws)
    by_ensemble = draws.transpose(0, 2, 1, 3).reshape(ensembles, steps * walkers, d)
    by_walker = draws.reshape(ensembles * walkers, steps, d)
    expected = array_stats.rhat(by_ensemble, chain_axis=0, draw_axis=1, method="rank")
    np.testing.assert_allclose(found.rhat, expected, rtol=1e-12)
    np.testing.assert_allclose(found.ess_bulk, ess(by_walker, "bulk"), rtol=1e-12)
    np.testing.assert_allclose(found.ess_tail, ess(by_walker, "tail"), rtol=1e-12)


def test_the_first_of_an_odd_number_of_steps_is_left_out() -> None:
    draws = sticky(2, (4, 5, 41, 2), 0.5)
    odd, even = convergence(draws), convergence(draws[:, :, 1:])
    np.testing.assert_array_equal(odd.rhat, even.rhat)
    np.testing.assert_array_equal(odd.ess_bulk, even.ess_bulk)


@pytest.mark.parametrize("steps", [50, 201])
def test_autocorrelation_times_are_emcees(steps: int) -> None:
    chain = sticky(3, (1, 12, steps, 3), 0.3)[0]
    expected = emcee.autocorr.integrated_time(chain.transpose(1, 0, 2), tol=0)
    np.testing.assert_allclose(autocorrelation_time(chain), expected, rtol=1e-10)


def test_a_walker_that_never_moved_has_no_autocorrelation_time() -> None:
    chain = sticky(4, (1, 12, 80, 2), 0.3)[0]
    chain[3, :, 1] = 0.7
    assert np.isfinite(autocorrelation_time(chain)[0])
    assert np.isnan(autocorrelation_time(chain)[1])


def test_errors_are_the_scatter_of_parts_over_a_root_of_their_number() -> None:
    """Parts that differ by a shift alone; the ends of an interval go with the cube root."""
    shifts = np.array([0.0, 1.0, 3.0, 4.0, 4.5, 6.0, 6.5, 7.0])
    parts = np.random.default_rng(5).gamma(2.0, 1.0, 400) + shifts[:, None]
    scatter = float(shifts.std(ddof=1))
    np.testing.assert_allclose(hdi_error(parts, 0.9), [scatter / 2.0, scatter / 2.0])
    assert median_error(parts) == pytest.approx(scatter / np.sqrt(8.0))


def test_four_steps_are_enough_and_three_are_not() -> None:
    draws = sticky(6, (4, 5, 4, 2), 1.0)
    assert np.isfinite(convergence(draws).rhat).all()
    for found in vars(convergence(draws[:, :, :3])).values():
        assert np.isnan(found).all()


def test_errors_of_independent_draws_are_the_textbooks() -> None:
    """Of n normal draws the mean errs by s / sqrt n, the sd by s / sqrt 2n, the median more."""
    chains = np.random.default_rng(7).normal(0.0, [2.0, 5.0], (4, 5000, 2))
    mean, sd, median = (mcse(chains, method) for method in ("mean", "sd", "median"))
    root = np.array([2.0, 5.0]) / np.sqrt(20_000)
    # Of the effective size, estimated over some dozen lags, and of a density: some percent.
    np.testing.assert_allclose(mean, root, rtol=0.1)
    np.testing.assert_allclose(sd, root / np.sqrt(2.0), rtol=0.1)
    np.testing.assert_allclose(median, root * np.sqrt(np.pi / 2.0), rtol=0.2)


def test_the_shape_of_a_tail_is_that_of_its_pareto_distribution() -> None:
    """A generalised Pareto tail of shape 0.8 beside one of uniform draws, which have none."""
    rng = np.random.default_rng(8)
    heavy = (rng.random((4, 5000)) ** -0.8 - 1.0) / 0.8
    found = tail_shape(np.stack([heavy, -heavy, rng.random((4, 5000))], axis=-1))
    # 3 sqrt n draws of a tail: an sd of (1 + k) / sqrt 424 = 0.09.
    np.testing.assert_allclose(found[:2], 0.8, atol=0.3)
    assert found[2] < 0.0


def test_rank_histograms_see_an_ensemble_that_is_off() -> None:
    rng = np.random.default_rng(1)
    values = rng.standard_normal((4, 2000))
    even = rank_histograms(values)
    assert even.mean() == pytest.approx(1.0)
    assert np.abs(even - 1.0).max() < 0.5
    values[0] += 1.0
    assert rank_histograms(values)[0, -1] > 2.0


def test_distances_are_in_posterior_sds() -> None:
    draws = np.random.default_rng(0).normal(10.0, 2.0, 20_000)
    distance, interval, log = distances(draws, np.array([14.0, np.nan]), hdi(draws, 0.95))
    assert distance[0] == pytest.approx(2.0, abs=0.05)
    assert np.isnan(distance[1])
    assert interval == pytest.approx([-1.96, 1.96], abs=0.06)
    assert not log


def test_distances_of_a_wide_positive_parameter_are_logarithmic() -> None:
    draws = np.exp(np.random.default_rng(0).normal(0.0, 2.0, 20_000))
    distance, _, log = distances(draws, np.array([np.exp(2.0), -1.0]), hdi(draws, 0.95))
    assert log
    assert distance[0] == pytest.approx(1.0, abs=0.05)
    assert np.isnan(distance[1])


def test_a_rank_histogram_counts_twentieths_of_all_draws() -> None:
    """One ensemble below the other: twice its even share in the lower ten, nothing above."""
    found = rank_histograms(np.arange(80.0).reshape(2, 40))
    expected = np.repeat([[2.0, 0.0], [0.0, 2.0]], 10, axis=1)
    np.testing.assert_array_equal(found, expected)
    # In turns, each has one of the two in every twentieth of forty.
    turns = np.arange(40.0).reshape(20, 2).T
    np.testing.assert_array_equal(rank_histograms(turns), np.ones((2, 20)))


@pytest.mark.parametrize("effective", [0.3, 1.0, 400.0])
def test_the_scatter_of_a_rank_histogram_is_binomial(effective: float) -> None:
    """A twentieth of n draws, over n / 20: never of less than one draw."""
    n = max(effective, 1.0)
    sd = np.sqrt(n * 0.05 * 0.95) / (n * 0.05)
    assert rank_scatter(effective) == pytest.approx(1.96 * sd)


@pytest.mark.parametrize(
    ("interval", "log"),
    [((1.0, 4.0), False), ((1.0, 4.01), True), ((0.0, 9.0), False), ((-1.0, 9.0), False)],
)
def test_logarithms_are_taken_of_positive_intervals_beyond_a_factor_of_four(interval, log) -> None:
    """Of the draws those that have one; others are seldom so far outside the interval."""
    draws = np.array([-3.0, 0.0, 1.0, 2.0, 5.0])
    distance, ends, taken = distances(draws, np.array([3.0]), interval)
    to, used = (np.log, draws[2:]) if log else (np.asarray, draws)
    middle, sd = to(used).mean(), to(used).std()
    assert taken is log
    np.testing.assert_allclose(distance, (to(np.array([3.0])) - middle) / sd)
    np.testing.assert_allclose(ends, (to(np.array(interval)) - middle) / sd)


def test_raised_to_a_power_a_normal_has_another_variance() -> None:
    """Draws of variance one, whose density is raised by a quarter: variance 1/1.25."""
    draws = np.random.default_rng(9).standard_normal((4, 5000))
    weight = power_scaled_weights(-0.5 * draws**2, 1.25)
    assert weight.shape == draws.shape
    assert weight.sum() == pytest.approx(1.0)
    # The sd of a variance of 20,000 draws is 1 %.
    assert (weight * draws**2).sum() == pytest.approx(0.8, abs=0.04)


def test_sensitivity_is_a_distance_per_doubling_of_the_power() -> None:
    draws = np.random.default_rng(10).standard_normal((2, 500))
    lower, upper = (power_scaled_weights(-0.5 * draws**2, a) for a in (0.8, 1.25))
    near = power_sensitivity(draws, (lower, upper), (0.8, 1.25))
    # The same marginals, had they needed powers that are three times as far apart.
    far = power_sensitivity(draws, (lower, upper), (0.8**3, 1.25**3))
    assert near == pytest.approx(3.0 * far)
    assert near > 0.0
    even = np.full_like(lower, 1.0 / lower.size)
    assert power_sensitivity(draws, (even, even), (0.8, 1.25)) == pytest.approx(0.0, abs=1e-6)
