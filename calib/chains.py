"""Statistics of chains, by ArviZ: R-hat, effective sample sizes, intervals, smoothed weights.

The only place that calls ArviZ's array functions; imported late because it takes half a second.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any, Literal

import numpy as np

from calib.models.base import Array

__all__ = ["ess", "hdi", "power_scaled_weights", "power_sensitivity", "psis", "rhat"]


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


def psis(log_ratio: Array) -> tuple[Array, Array]:
    """Pareto-smoothed log weights (n, draws) of log ratios (n, draws), and the shapes k, (n,).

    References
    ----------
    Vehtari et al. (2024), Pareto smoothed importance sampling, JMLR 25(72).
    """
    # ArviZ takes log likelihoods, of which it forms the ratios of leave-one-out itself.
    log_weight, k = _stats().psislw(-log_ratio)
    return np.asarray(log_weight), np.asarray(k)


def power_scaled_weights(log_density: Array, alpha: float) -> Array:
    """Smoothed weights that raise a part of the density to a power.

    Parameters
    ----------
    log_density : ndarray, shape (chains, draws)
        Of the prior, or of the likelihood, at each draw.
    alpha : float
        The power.

    Returns
    -------
    ndarray, shape (chains, draws)
        Of sum one.

    References
    ----------
    Kallioinen et al. (2024), doi:10.1007/s11222-023-10366-5.
    """
    log_weight = np.asarray(_stats().power_scale_lw(log_density, alpha=alpha, axis=(0, 1)))
    weight = np.exp(log_weight - log_weight.max())
    return np.asarray(weight / weight.sum())


def power_sensitivity(
    draws: Array, weights: tuple[Array, Array], alphas: tuple[float, float]
) -> float:
    """Distance that a marginal moves per doubling of the power.

    Parameters
    ----------
    draws : ndarray, shape (chains, draws)
    weights : tuple of ndarray
        For the lower and for the upper power.
    alphas : tuple of float
        The two powers.
    """
    lower, upper = weights
    value = _stats().power_scale_sense(
        draws, lower, upper, lower_alpha=alphas[0], upper_alpha=alphas[1]
    )
    return float(value)
