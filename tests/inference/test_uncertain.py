"""The likelihood with the prediction's own error, against SciPy's multivariate normal."""

from __future__ import annotations

import numpy as np
from scipy.stats import multivariate_normal

from calib.inference.likelihood import log_normal


def test_it_is_a_normal_density() -> None:
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
