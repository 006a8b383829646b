"""Processes over parameters and over conditions: what they meet, and how sure they are."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from calib.models.simulators.kriging import (
    BEYOND,
    Scales,
    correlation,
    find_scales,
    krige,
    minus_log_likelihood,
    over_conditions,
    trend_of,
)


def test_it_is_the_limit_of_a_wide_prior_of_the_trend() -> None:
    rng = np.random.default_rng(1)
    x, at = rng.standard_normal((40, 2)), rng.standard_normal((7, 2))
    y = np.stack([np.sin(x[:, 0]) + x[:, 1] ** 2, x[:, 0] * x[:, 1]], axis=1)
    scales = Scales(np.array([1.3, 2.1]), 1e-4)
    found = krige(x, y, scales)
    mean, unknown = found.mean_and_unknown(at)
    b, b_at, wide = trend_of(x), trend_of(at), 1e6

    def covariance(u: np.ndarray, v: np.ndarray, bu: np.ndarray, bv: np.ndarray) -> np.ndarray:
        return correlation(u, v, scales.lengths) + wide * bu @ bv.T

    k = covariance(x, x, b, b) + scales.nugget * np.eye(len(x))
    across = covariance(at, x, b_at, b)
    solved = np.linalg.solve(k, across.T)
    left = np.diag(covariance(at, at, b_at, b_at)) - np.einsum("kn,nk->k", across, solved)
    np.testing.assert_allclose(mean, solved.T @ y, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(unknown, left, rtol=0.02, atol=1e-4)
    np.testing.assert_allclose(mean, found.mean(at))


def test_it_meets_what_it_knows_and_is_unsure_elsewhere() -> None:
    rng = np.random.default_rng(2)
    x = rng.uniform(-1.0, 1.0, (30, 2))
    y = np.exp(x[:, :1]) * np.cos(2.0 * x[:, 1:])
    found = krige(x, y, find_scales(x, y))
    mean, unknown = found.mean_and_unknown(x)
    np.testing.assert_allclose(mean, y, atol=1e-3)
    far = found.mean_and_unknown(np.array([[4.0, 4.0]]))[1]
    assert far[0] > 100.0 * unknown.max()


@pytest.mark.parametrize("noise", [0.05, 0.2])
def test_noise_is_told_from_shape(noise: float) -> None:
    rng = np.random.default_rng(3)
    x = np.repeat(rng.uniform(-2.0, 2.0, (40, 1)), 3, axis=0)
    y = np.sin(2.0 * x) + noise * rng.standard_normal(x.shape)
    scales = find_scales(x, y, noisy=True)
    found = krige(x, y, scales)
    at = np.linspace(-1.5, 1.5, 21)[:, None]
    assert np.sqrt(np.mean((found.mean(at) - np.sin(2.0 * at)) ** 2)) < 0.5 * noise
    assert noise / 2.0 < np.sqrt(found.variances[0] * scales.nugget) < 2.0 * noise


def test_a_constant_is_no_trouble() -> None:
    x = np.random.default_rng(4).standard_normal((12, 3))
    y = np.full((12, 2), 5.0)
    found = krige(x, y, find_scales(x, y))
    np.testing.assert_allclose(found.mean(x + 0.3), 5.0)


def sklearns(lengths: np.ndarray, nugget: float, most: float = 1e-3, **kwargs: Any) -> Any:
    # Not at the top: to import it takes every process of the tests half a second.
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    kernel = ConstantKernel(1.0, (1e-2, 1e6)) * RBF(lengths, (0.2, 100.0))
    return GaussianProcessRegressor(
        kernel + WhiteKernel(nugget, (1e-9, most)), alpha=1e-10, **kwargs
    )


def test_the_likelihood_and_its_gradient_are_scikit_learns() -> None:
    rng = np.random.default_rng(4)
    x = rng.uniform(-2.0, 2.0, (25, 3))
    y = np.stack([np.sin(x[:, 0]) + 0.1 * x[:, 1] * x[:, 2], x[:, 1] ** 2], axis=1)
    regressor = sklearns(np.ones(3), 1e-4, optimizer=None).fit(x, y)
    squares = np.square(x.T[:, :, None] - x.T[:, None])
    for logs in rng.uniform([-1.0, -1.0, 0.0, -12.0], [2.0, 2.0, 3.0, -7.0], (8, 4)):
        value, gradient = minus_log_likelihood(logs, squares, y)

        # Theirs, of which ours is the greatest over the variance.
        def theirs(level: float, logs: np.ndarray = logs) -> tuple[float, np.ndarray]:
            at = np.array([level, *logs[:-1], level + logs[-1]])
            found, slope = regressor.log_marginal_likelihood(at, eval_gradient=True)
            return found, slope[1:]

        best = minimize_scalar(lambda level: -theirs(level)[0], bounds=(-10, 20), method="bounded")
        assert value == pytest.approx(best.fun, rel=1e-6)
        slope = theirs(best.x)[1]
        np.testing.assert_allclose(gradient, -slope, rtol=1e-3, atol=1e-3 * abs(slope).max())


@pytest.mark.parametrize("seed", range(5))
def test_scales_are_those_that_scikit_learn_finds(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x = rng.uniform(-2.0, 2.0, (60, 2))
    shape = np.stack([np.sin(1.5 * x[:, 0]) + 0.2 * x[:, 1] ** 2, 0.3 * x[:, 0] ** 2], axis=1)
    y = shape + 0.05 * rng.standard_normal(shape.shape)
    b = trend_of(x)
    rest = y - b @ np.linalg.lstsq(b, y)[0]
    theirs = sklearns(np.full(2, 2.0), 1e-5, 1.0).fit(x, rest / rest.std()).kernel_
    found = find_scales(x, y, noisy=True)
    np.testing.assert_allclose(found.lengths, theirs.k1.k2.length_scale, rtol=0.02)
    assert found.nugget == pytest.approx(
        theirs.k2.noise_level / theirs.k1.k1.constant_value, rel=0.02
    )


def curves(s: np.ndarray, w: np.ndarray) -> np.ndarray:
    return np.stack([w * (1.0 - np.exp(-s / 0.1)), w**1.2 * s, np.ones_like(s)])


def grid(n: int) -> dict[str, np.ndarray]:
    s, w = np.meshgrid(np.linspace(0.0, 0.6, n), np.linspace(2.0, 8.0, 6), indexing="ij")
    return {"slip_ratio": s.ravel(), "normal_load_kn": w.ravel()}


def test_curves_are_met_at_the_nodes_and_near_between() -> None:
    nodes = grid(14)
    known = curves(*nodes.values())
    over = over_conditions(nodes, known)
    weights = over.weights(known)
    np.testing.assert_allclose(over.at(nodes, weights), known.T, atol=1e-4)
    rng = np.random.default_rng(1)
    x = {"slip_ratio": rng.uniform(0.0, 0.6, 50), "normal_load_kn": rng.uniform(2.0, 8.0, 50)}
    true = curves(*x.values())
    np.testing.assert_allclose(over.at(x, weights), true.T, atol=0.02 * 8.0)
    # What is left out tells how far off it is between nodes, to a factor.
    assert 0.0 < np.abs(over.left_out(known)).max() < 1.0


def test_conditions_may_differ_by_vector() -> None:
    nodes = grid(10)
    known = curves(*nodes.values())
    over = over_conditions(nodes, known)
    weights = over.weights(known)
    s = np.linspace(0.1, 0.5, 12).reshape(3, 4)
    x = {"slip_ratio": s, "normal_load_kn": np.full(4, 3.0)}
    found = over.at(x, weights)
    assert found.shape == (3, 4, 3)
    one = over.at({"slip_ratio": s[1], "normal_load_kn": np.full(4, 3.0)}, weights)
    np.testing.assert_allclose(found[1], one)


def test_beyond_the_box_it_goes_on_straight_and_then_has_no_value() -> None:
    nodes = {"slip_ratio": np.linspace(0.1, 0.5, 12)}
    known = (2.0 + 3.0 * nodes["slip_ratio"])[None]
    over = over_conditions(nodes, known)
    weights = over.weights(known)
    near, far = 0.5 + 0.9 * BEYOND * 0.4, 0.5 + 1.2 * BEYOND * 0.4
    found = over.at({"slip_ratio": np.array([0.45, near, far])}, weights)[:, 0]
    np.testing.assert_allclose(found[:2], [3.35, 2.0 + 3.0 * near], atol=2e-3)
    assert np.isnan(found[2])


def test_a_condition_that_did_not_vary_is_not_guessed() -> None:
    nodes = {"slip_ratio": np.linspace(0.1, 0.5, 8), "normal_load_kn": np.full(8, 5.0)}
    over = over_conditions(nodes, np.sin(nodes["slip_ratio"])[None])
    weights = over.weights(np.sin(nodes["slip_ratio"])[None])
    x = {"slip_ratio": np.array([0.2, 0.2]), "normal_load_kn": np.array([5.0, 6.0])}
    found = over.at(x, weights)[:, 0]
    assert np.isfinite(found[0])
    assert np.isnan(found[1])
