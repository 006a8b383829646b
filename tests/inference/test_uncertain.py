"""The likelihood with the prediction's own error, against SciPy's multivariate normal."""

from __future__ import annotations

import numpy as np
from scipy.stats import multivariate_normal

from calib.inference.uncertain import log_normal


def test_it_is_a_normal_density() -> None:
    rng = np.random.default_rng(1)
    k, n, j = 5, 12, 3
    residuals, curves = rng.standard_normal((k, n)), rng.standard_normal((n, j))
    sigma, variances = rng.uniform(0.1, 2.0, k), rng.uniform(0.0, 1.0, (k, j))
    variances[0] = 0.0
    found = log_normal(residuals, sigma, variances, curves)
    for i in range(k):
        covariance = sigma[i] ** 2 * np.eye(n) + (curves * variances[i]) @ curves.T
        np.testing.assert_allclose(
            found[i], multivariate_normal(np.zeros(n), covariance).logpdf(residuals[i])
        )


def test_where_there_is_no_prediction_there_is_no_density() -> None:
    residuals = np.array([[1.0, np.nan], [1.0, 1.0]])
    found = log_normal(residuals, np.array([1.0, -1.0]), np.ones((2, 1)), np.ones((2, 1)))
    assert np.isnan(found).all()
