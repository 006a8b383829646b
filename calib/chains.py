"""Statistics of chains, by ArviZ: R-hat, effective sample sizes, intervals, smoothed weights.

The only place that calls ArviZ's array functions; imported late because it takes half a second.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any, Literal

import numpy as np

from calib.models.base import Array

__all__ = ["ess", "hdi", "mcse", "psis", "rhat", "tail_shape"]


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


def mcse(chains: Array, method: Literal["mean", "sd", "median"]) -> Array:
    """Monte Carlo standard error of a summary of each parameter, (chains, draws, d) to (d,)."""
    with np.errstate(all="ignore"):
        value = _stats().mcse(chains, chain_axis=0, draw_axis=1, method=method)
    return np.asarray(value)


def tail_shape(chains: Array) -> Array:
    """Pareto shape k of the heavier tail of each parameter, (chains, draws, d) to (d,).

    Moments up to 1/k exist: with k above 1/2 no variance, so no Monte Carlo error of a mean.

    References
    ----------
    Vehtari et al. (2024), Pareto smoothed importance sampling, JMLR 25(72).
    """
    with np.errstate(all="ignore"):
        return np.asarray(_stats().pareto_khat(chains, chain_axis=0, draw_axis=1))


def hdi(draws: Array, prob: float) -> tuple[float, float]:
    """Highest-density interval of draws of shape (n,)."""
    low, high = _stats().hdi(draws, prob)
    return float(low), float(high)


def psis(log_ratio: Array) -> tuple[Array, Array]:
    """Pareto-smoothed log weights (n, draws) of log ratios (n, draws), and the shapes k, (n,).

    References
    ----------
    Vehtari et al. (2024), Pareto smoothed importance sampling, JMLR 25(72).
    """
    # ArviZ takes log likelihoods, of which it forms the ratios of leave-one-out itself.
    log_weight, k = _stats().psislw(-log_ratio)
    return np.asarray(log_weight), np.asarray(k)
