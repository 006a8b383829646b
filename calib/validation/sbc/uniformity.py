"""Whether ranks are uniform: simultaneous bands for their ECDF, and a p value to go with them.

The statistic is the smallest pointwise binomial tail of the ECDF over its evaluation points
(Saeilynoja, Buerkner & Vehtari 2022). Bands come from ArviZ, which simulates the statistic; the
p value is exact, so that it can be corrected for many quantities.

References
----------
.. [1] Saeilynoja, Buerkner & Vehtari (2022), doi:10.1007/s11222-022-10090-6.
.. [2] Moscovich & Nadler (2017), doi:10.1016/j.spl.2016.11.027: the Poisson recursion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from typing import Any

import numpy as np
from scipy.stats import binom, poisson

from calib.models.base import Array

_SIMULATIONS = 4000
_JUMPS = 60  # a Poisson variable of mean one exceeds it with probability below 1e-80


@dataclass(frozen=True)
class EcdfBand:
    """ECDF of probability integral transforms, its simultaneous band; arrays of shape (n + 1,)."""

    x: Array
    ecdf: Array
    lower: Array
    upper: Array


def pit(ranks: Sequence[Sequence[int]], rng: np.random.Generator) -> Array:
    """Turn ranks (draws below the truth, and draws) into what is uniform on (0, 1) if all is right.

    Each rank is spread over its share of the interval, so that they are uniform exactly.
    """
    below, draws = np.array(ranks, dtype=float).reshape(-1, 2).T
    return np.asarray((below + rng.uniform(size=below.size)) / (draws + 1.0))


def ecdf_band(values: Array, level: float) -> EcdfBand:
    """ECDF of values (n,) and the band that holds a uniform sample's with a probability."""
    ecdf_pit: Any = import_module("arviz_stats.ecdf_utils").ecdf_pit

    # The same random numbers every time: the band is a property of n and the level.
    return EcdfBand(*ecdf_pit(values, level, _SIMULATIONS, rng=np.random.default_rng(1)))


def p_value(values: Array) -> float:
    """Probability that as many uniform values (n,) leave the band by as much, exactly."""
    n = values.size
    z = np.arange(1, n) / n
    counts = np.searchsorted(np.sort(values), z, side="right")
    tails = np.minimum(binom.cdf(counts, n, z), binom.sf(counts - 1, n, z))
    return _p_of_tail(n, float(tails.min()))


@cache
def _p_of_tail(n: int, tail: float) -> float:
    """Probability that the smallest pointwise tail of n uniform values is no larger."""
    z = np.arange(1, n) / n
    k = np.arange(n + 1)
    # The observed tail itself must count, whatever its last bit.
    limit = tail * (1.0 + 1e-9)
    inside = (binom.cdf(k, n, z[:, None]) > limit) & (binom.sf(k - 1, n, z[:, None]) > limit)
    # Counts of n uniform values are those of a Poisson process of rate n, given n in all.
    jump = poisson.pmf(np.arange(min(_JUMPS, n + 1)), 1.0)
    mass = np.zeros(n + 1)
    mass[0] = 1.0
    for allowed in np.asarray(inside):
        mass = np.convolve(mass, jump)[: n + 1] * allowed
    stays = np.convolve(mass, jump)[n] / poisson.pmf(n, n)
    return float(np.clip(1.0 - stays, 0.0, 1.0))


def holm(p_values: Sequence[float]) -> list[float]:
    """Adjust p values, in their order, for their number, family-wise (Holm 1979, JSTOR 4615733)."""
    p = np.asarray(p_values, dtype=float)
    order = np.argsort(p)
    scaled = np.maximum.accumulate(p[order] * np.arange(p.size, 0, -1))
    adjusted = np.empty_like(p)
    adjusted[order] = np.minimum(scaled, 1.0)
    return [float(v) for v in adjusted]
