"""Statistics of chains, by ArviZ: R-hat, effective sample sizes, intervals, smoothed weights.

The only place that calls ArviZ's array functions; imported late because it takes half a second.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any, Literal

import numpy as np

from calib.models.base import Array

__all__ = ["ess", "hdi", "hdi_error", "median_error", "psis", "rhat"]


def _stats() -> Any:
    return import_module("arviz_stats.base").array_stats


def rhat(chains: Array) -> Array:
    """Rank-normalised split R-hat of each parameter, shape (chains, draws, d) to (d,).

    References
    ----------
    Vehtari et al. (2021), doi:10.1214/20-BA1221.
    """
    with np.errstate(all="ignore"):
        return np.asarray(_stats().rhat(chains, chain_axis=0, draw_axis=1, method="rank"))


def ess(chains: Array, method: Literal["bulk", "tail", "mean"]) -> Array:
    """Effective sample size of each parameter, shape (chains, draws, d) to (d,)."""
    extra = {"prob": (0.05, 0.95)} if method == "tail" else {}
    with np.errstate(all="ignore"):
        value = _stats().ess(chains, chain_axis=0, draw_axis=1, method=method, **extra)
    return np.asarray(value)


def hdi(draws: Array, prob: float) -> tuple[float, float]:
    """Highest-density interval of draws of shape (n,)."""
    low, high = _stats().hdi(draws, prob)
    return float(low), float(high)


def hdi_error(batches: Array, prob: float) -> Array:
    """Monte Carlo standard errors of the ends of a highest-density interval, shape (2,).

    Parameters
    ----------
    batches : ndarray, shape (g, m)
        The draws in g nearly independent parts.
    prob : float

    Notes
    -----
    The ends of a shortest interval converge with the cube root of the number of draws (Kim &
    Pollard 1990, doi:10.1214/aos/1176347498), slower than the quantiles at which they lie: so do
    the ends of the parts, whose scatter is scaled by that root.
    """
    ends = np.asarray(_stats().hdi(batches, prob, axis=-1))
    return np.asarray(ends.std(axis=0, ddof=1) / np.cbrt(batches.shape[0]))


def median_error(batches: Array) -> float:
    """Monte Carlo standard error of the median of draws in nearly independent parts, (g, m)."""
    return float(np.median(batches, axis=-1).std(ddof=1) / np.sqrt(batches.shape[0]))


def psis(log_ratio: Array) -> tuple[Array, Array]:
    """Pareto-smoothed log weights (n, draws) of log ratios (n, draws), and the shapes k, (n,).

    References
    ----------
    Vehtari et al. (2024), Pareto smoothed importance sampling, JMLR 25(72).
    """
    # ArviZ takes log likelihoods, of which it forms the ratios of leave-one-out itself.
    log_weight, k = _stats().psislw(-log_ratio)
    return np.asarray(log_weight), np.asarray(k)
