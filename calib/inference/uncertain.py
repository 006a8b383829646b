"""The density of residuals where the prediction itself is known with an error.

The noise is independent, the prediction's error is shared by the rows: a few curves B, (n, j),
times independent normals of one variance v. So the residuals r are normal with the covariance
sigma^2 I + v B B'. With B'B = U diag(d) U', the same for all parameters, and a = U'B'r,

    ln N = -n ln sigma - 1/2 sum_i ln(1 + v d_i / sigma^2) - n/2 ln 2 pi
           - (r'r - sum_i a_i^2 v / (sigma^2 + v d_i)) / (2 sigma^2)
"""

from __future__ import annotations

import numpy as np

from calib.models.base import Array


def log_normal(residuals: Array, variance: Array, curves: Array, sigma: Array) -> Array:
    """Evaluate the log density of residuals (k, n), shape (k,); NaN where one is.

    The coefficients of the prediction's error, along curves (n, j), have a variance (k,), the noise
    has an sd (k,).
    """
    if not np.isfinite(curves).all():
        return np.full(len(residuals), np.nan)
    squares = np.einsum("kn,kn->k", residuals, residuals)
    bad = ~(np.isfinite(squares) & np.isfinite(variance) & (sigma > 0.0))
    scale = np.where(bad, 1.0, sigma)
    ratio = (np.where(bad, 0.0, variance) / scale**2)[:, None]
    sizes, axes = np.linalg.eigh(curves.T @ curves)
    along = np.where(bad[:, None], 0.0, residuals) @ (curves @ axes)
    grown = 1.0 + ratio * np.maximum(sizes, 0.0)
    taken = (along**2 * ratio / grown).sum(axis=1)
    value = -residuals.shape[1] * (np.log(scale) + 0.5 * np.log(2.0 * np.pi))
    value -= 0.5 * (np.log(grown).sum(axis=1) + (squares - taken) / scale**2)
    return np.where(bad, np.nan, value)
