"""Whether two samples are of one posterior, in units of their Monte Carlo errors."""

from __future__ import annotations

import numpy as np

from calib.inference.diagnostics import ess
from calib.models.base import Array

__all__ = ["z_scores"]


def z_scores(a: Array, b: Array) -> dict[str, Array]:
    """Differences of means and quantiles over their standard errors.

    Parameters
    ----------
    a, b : ndarray, shape (chains, draws, d)

    Returns
    -------
    dict of ndarray, each of shape (d,)
        ``mean``, and the shares of draws below the pooled 5, 50 and 95 % quantiles. Each is
        standard normal if the posteriors are one; errors are from the effective sample size of
        the very quantity that is compared.
    """
    pooled = [np.concatenate([x[..., j].ravel() for x in (a, b)]) for j in range(a.shape[-1])]
    found = {"mean": _z(a, b)}
    for p in (5, 50, 95):
        edge = np.array([np.percentile(x, p) for x in pooled])
        found[f"q{p}"] = _z((a < edge).astype(float), (b < edge).astype(float))
    return found


def _z(a: Array, b: Array) -> Array:
    difference, variance = 0.0, 0.0
    for x, sign in ((a, 1.0), (b, -1.0)):
        difference = difference + sign * x.mean(axis=(0, 1))
        variance = variance + x.var(axis=(0, 1)) / ess(x, "mean")
    return np.asarray(difference / np.sqrt(variance))
