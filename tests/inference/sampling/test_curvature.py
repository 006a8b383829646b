"""Curvature at a mode."""

from __future__ import annotations

import numpy as np
from scipy import stats

from calib.inference.sampling.mode import hessian_scale

MEAN = np.array([1.0, -2.0, 0.5])
SCALE = np.array([[2.0, 0.6, 0.1], [0.6, 1.0, -0.3], [0.1, -0.3, 0.5]])


def test_curvature_at_a_mode_is_the_covariance() -> None:
    target = stats.multivariate_normal(MEAN, SCALE)
    found = hessian_scale(target.logpdf, MEAN, np.array([20.0, 30.0, 10.0]))
    # Differences of a quadratic are exact but for rounding; the widest eigenvalue is untouched.
    np.testing.assert_allclose(found, SCALE, rtol=1e-6)


def test_a_direction_the_density_ignores_is_as_wide_as_its_prior() -> None:
    found = hessian_scale(
        lambda t: stats.norm.logpdf(t[:, 0], 0.0, 0.1), np.zeros(2), np.array([1.0, 3.0])
    )
    np.testing.assert_allclose(np.diag(found), [0.01, 9.0], rtol=1e-6)


def test_a_mode_at_the_edge_of_the_allowed_still_has_a_scale() -> None:
    found = hessian_scale(
        lambda t: np.where(t[:, 0] >= 0.0, -t[:, 0] / 0.1, -np.inf), np.zeros(1), np.ones(1)
    )
    assert 0.0 < found[0, 0] <= 1.0
