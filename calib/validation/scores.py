"""Scores of predictive draws against observations: pure functions of arrays.

`draws` always has shape (n_draws, n): predictive draws of n observations, noise included.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import betaincinv

from calib.models.base import Array

LEVELS = (0.5, 0.9, 0.95)
# Relative errors of a pull near zero say nothing: rows below this part of the largest are left out.
RELATIVE_ERROR_FLOOR = 0.05
# Rows that are farther off than this are counted.
RELATIVE_ERROR_FAR = 0.06


@dataclass(frozen=True)
class Coverage:
    """How many observations a band covered, with the 95 % Jeffreys interval of the proportion."""

    level: float
    hits: int
    n: int
    lower: float
    upper: float

    @property
    def proportion(self) -> float:
        """Covered part."""
        return self.hits / self.n


@dataclass(frozen=True)
class Scores:
    """Scores of one set of n observations.

    Parameters
    ----------
    rmse : float
        Of the predictive median, in the unit of the output.
    crps : float
        Mean continuous ranked probability score, in the unit of the output; NaN where the
        predictive distribution's tail is so heavy that it has none.
    relative_error : ndarray, shape (n,)
        (median - observed)/observed; NaN where the observation is below a twentieth of the
        largest.
    pit, median : ndarray, shape (n,)
        Probability integral transform, and the predictive median.
    """

    n: int
    rmse: float
    crps: float
    relative_error: Array
    coverage: Mapping[float, Coverage]
    pit: Array
    median: Array

    @property
    def max_relative_error(self) -> float:
        """Largest absolute relative error; NaN where every observation is near zero."""
        defined = self.relative_error[~np.isnan(self.relative_error)]
        return float(np.abs(defined).max()) if defined.size else float("nan")

    @property
    def n_far(self) -> int:
        """How many rows have a relative error of more than 6 %."""
        return int((np.abs(self.relative_error) > RELATIVE_ERROR_FAR).sum())


def crps(draws: Array, observed: Array) -> Array:
    """Continuous ranked probability score of each observation, shape (n,).

    After Gneiting & Raftery (2007), doi:10.1198/016214506000001437, Eq 21, with the sorted form of
    the mean absolute difference.
    """
    m = draws.shape[0]
    ordered = np.sort(draws, axis=0)
    weight = (2.0 * np.arange(1, m + 1) - m - 1.0) / m**2
    return np.asarray(np.abs(draws - observed).mean(axis=0) - weight @ ordered)


def pit(draws: Array, observed: Array) -> Array:
    """Part of the draws below each observation, shape (n,)."""
    return np.asarray((draws < observed).mean(axis=0))


def coverage(draws: Array, observed: Array, level: float) -> Coverage:
    """Count the observations inside the central band of a level."""
    low, high = np.quantile(draws, [0.5 - level / 2.0, 0.5 + level / 2.0], axis=0)
    hits = int(((observed >= low) & (observed <= high)).sum())
    n = int(observed.size)
    return Coverage(level, hits, n, *jeffreys(hits, n))


def jeffreys(hits: int, n: int) -> tuple[float, float]:
    """Return the 95 % Jeffreys interval of a proportion, closed at the ends of all or none.

    After Brown, Cai & DasGupta (2001), doi:10.1214/ss/1009213286.
    """
    # Quantiles of the beta distribution, without SciPy's statistics, which are slow to import.
    a, b = hits + 0.5, n - hits + 0.5
    low = 0.0 if hits == 0 else float(betaincinv(a, b, 0.025))
    return low, 1.0 if hits == n else float(betaincinv(a, b, 0.975))


def score(draws: Array, observed: Array, *, heavy: bool = False) -> Scores:
    """Score predictive draws (n_draws, n) of observations (n,); heavy ones have no CRPS."""
    median = np.median(draws, axis=0)
    large = np.abs(observed) > RELATIVE_ERROR_FLOOR * np.abs(observed).max()
    relative = np.full(observed.size, np.nan)
    relative[large] = (median[large] - observed[large]) / observed[large]
    return Scores(
        n=int(observed.size),
        rmse=float(np.sqrt(np.mean(np.square(median - observed)))),
        crps=float("nan") if heavy else float(crps(draws, observed).mean()),
        relative_error=relative,
        coverage={level: coverage(draws, observed, level) for level in LEVELS},
        pit=pit(draws, observed),
        median=median,
    )
