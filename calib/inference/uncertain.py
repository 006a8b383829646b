"""The density of residuals where the prediction itself is known with an error.

The noise is independent, the prediction's error is shared by the rows: a few curves B, (n, j),
times independent normals of variances v. So the residuals r are normal with the covariance
sigma^2 I + B diag(v) B', whose inverse and determinant follow from matrices of j on a side
(Woodbury): with S = diag(sqrt v) and M = I + S B'B S / sigma^2,

    ln N = -n ln sigma - 1/2 ln |M| - n/2 ln 2 pi
           - (r'r - r'B S M^-1 S B'r / sigma^2) / (2 sigma^2)
"""

from __future__ import annotations

import numpy as np

from calib.models.base import Array


def log_normal(residuals: Array, sigma: Array, variances: Array, curves: Array) -> Array:
    """Evaluate the log density of residuals (k, n), shape (k,); NaN where one is.

    The noise has an sd (k,), the coefficients of the prediction's error, along curves (n, j), have
    variances (k, j).
    """
    n = residuals.shape[1]
    squares = np.einsum("kn,kn->k", residuals, residuals)
    bad = ~(np.isfinite(squares) & (sigma > 0.0))
    scale = np.where(bad, 1.0, sigma)
    root = np.sqrt(np.where(bad[:, None], 0.0, variances)) / scale[:, None]
    gram = curves.T @ curves
    m = np.eye(gram.shape[0]) + root[:, :, None] * gram * root[:, None, :]
    bad |= ~np.isfinite(m).all(axis=(1, 2))
    m[bad] = np.eye(gram.shape[0])
    seen = np.where(bad[:, None], 0.0, residuals @ curves) * root
    taken, log_det = _solved(m, seen)
    value = -n * (np.log(scale) + 0.5 * np.log(2.0 * np.pi)) - log_det
    value -= 0.5 * (squares - taken) / scale**2
    return np.where(bad, np.nan, value)


def _solved(m: Array, seen: Array) -> tuple[Array, Array]:
    """Return s' M^-1 s and half the log determinant of every M = I + P, P positive, each (k,)."""
    try:
        lower = np.linalg.cholesky(m)
    except np.linalg.LinAlgError:
        # At a tiny sigma the I is lost in rounding; but no eigenvalue is less than one.
        values, vectors = np.linalg.eigh(m)
        values = np.maximum(values, 1.0)
        along = np.einsum("kji,kj->ki", vectors, seen)
        return (np.square(along) / values).sum(axis=1), 0.5 * np.log(values).sum(axis=1)
    taken = np.square(np.linalg.solve(lower, seen[:, :, None])).sum(axis=(1, 2))
    return taken, np.log(np.einsum("kjj->kj", lower)).sum(axis=1)
