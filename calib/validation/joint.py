"""What the predictive draws themselves say of many rows at once.

Held-out rows of one test share the uncertainty of one curve, so they are not independent: when it
is off, it is off for all of them. Every draw is a set of rows that the model deems possible, so
treating draws as observations gives the reference that a binomial or Kolmogorov law would give
for independent rows.
"""

from __future__ import annotations

import numpy as np
from scipy.special import bdtr

from calib.models.base import Array

_MAX_REPLICATES = 2000


def ks_distance(pit: Array) -> Array:
    """Largest distance of the ECDF of PIT values from uniform, shape (..., n) to (...)."""
    ordered = np.sort(pit, axis=-1)
    n = ordered.shape[-1]
    above = np.arange(1, n + 1) / n - ordered
    below = ordered - np.arange(n) / n
    return np.asarray(np.maximum(above.max(axis=-1), below.max(axis=-1)))


def pit_half_width(draws: Array) -> float:
    """Half the width of the band that 95 % of the PIT values of possible rows (size, n) stay in."""
    return float(np.quantile(ks_distance(_pit_of_draws(draws)), 0.95))


def coverage_probability(draws: Array, hits: int, level: float) -> float:
    """Probability of covering no more rows than were covered, were the predictions right.

    `hits` rows are inside their central band of draws (size, n).
    """
    covered = (np.abs(_pit_of_draws(draws) - 0.5) <= 0.5 * level).sum(axis=1)
    # The draw that was observed counts among those possible, so it is never 0.
    return float((1 + (covered <= hits).sum()) / (1 + covered.size))


def binomial_p(hits: int, n: int, level: float = 0.9) -> float:
    """Probability of so few hits or fewer among n independent rows; NaN of none."""
    return float(bdtr(hits, n, level)) if n else float("nan")


def hits(draws: Array, observed: Array, level: float) -> int:
    """Count the observations (n,) inside the central band of their draws (size, n)."""
    low, high = np.nanquantile(draws, [0.5 - 0.5 * level, 0.5 + 0.5 * level], axis=0)
    return int(((observed >= low) & (observed <= high)).sum())


def effective_rows(draws: Array) -> float:
    """Number of independent rows that would say as much on whether the predictions are off.

    That is n/(1 + (n - 1) r) with r the mean correlation between rows.
    """
    good = _complete(draws)
    n = good.shape[1]
    if n < 2:
        return float(n)
    correlation = np.corrcoef(good, rowvar=False)
    mean = (correlation.sum() - n) / (n * (n - 1))
    return float(n / (1.0 + (n - 1) * max(0.0, mean)))


def _complete(draws: Array) -> Array:
    return draws[np.isfinite(draws).all(axis=1)]


def _pit_of_draws(draws: Array) -> Array:
    good = _complete(draws)
    rank = good.argsort(axis=0).argsort(axis=0)
    return np.asarray((rank[:_MAX_REPLICATES] + 0.5) / good.shape[0])
