"""Functions of the parameters, everywhere roughly and where the posterior lies well.

A *level* is a region of parameter space with coordinates in which it is round and unit-sized, and
a process for each function on the runs in it. The last level has no bounds: it is the whole prior.
A level counts fully up to its reach and fades out beyond, smoothly, in favour of the next.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.models.base import Array
from calib.models.simulators.emulator.kriging import Kriging, Scales, find_scales, krige

__all__ = ["Level", "Region", "level_on", "mixed"]

# A level ends at so many times its reach.
_FADE = 1.35


@dataclass(frozen=True)
class Region:
    """Where a level is centred, and in which coordinates.

    Parameters
    ----------
    centre : ndarray, shape (d,)
        In units of the prior's sds.
    root : ndarray, shape (d, d)
        Lower factor of the covariance there.
    reach : float
        In sds; infinite for the whole prior.
    """

    centre: Array
    root: Array
    reach: float = np.inf

    def coordinates(self, z: Array) -> Array:
        """Return coordinates in which the region is round, (k, d) to (k, d)."""
        return np.asarray(np.linalg.solve(self.root, (z - self.centre).T).T)

    def nearest(self, z: Array, least: int) -> NDArray[np.intp]:
        """Return which runs belong to it: those inside, and of others the nearest `least`."""
        far = np.linalg.norm(self.coordinates(z), axis=1)
        count = max(least, int((far <= _FADE * self.reach).sum()))
        return np.sort(np.argsort(far, kind="stable")[:count])


@dataclass(frozen=True)
class Level:
    """A region with a process for each function.

    Parameters
    ----------
    region : Region
    functions : tuple of Kriging
    """

    region: Region
    functions: tuple[Kriging, ...]

    def weight(self, x: Array) -> Array:
        """Return how much it counts at its own coordinates, shape (k, d) to (k,)."""
        if np.isinf(self.region.reach):
            return np.ones(len(x))
        far = np.linalg.norm(x, axis=1) / self.region.reach
        u = np.clip((_FADE - far) / (_FADE - 1.0), 0.0, 1.0)
        return np.asarray(u**3 * (u * (6.0 * u - 15.0) + 10.0))


def level_on(
    region: Region,
    x: Array,
    coefficients: Array,
    tiny: float,
    *,
    noisy: bool,
    scales: Sequence[Scales] | None = None,
    known: bool = False,
) -> Level:
    """Fit a level to runs.

    Parameters
    ----------
    region : Region
    x : ndarray, shape (n, d)
        Runs in the region's coordinates.
    coefficients : ndarray, shape (n, j)
    tiny : float
        Spread below which a function need not be looked into.
    noisy : bool
        Whether the simulator gives other values each time.
    scales : sequence of Scales, optional
        Where to begin; with `known`, to use as they are.
    """
    functions = []
    for j, y in enumerate(coefficients.T):
        begin = scales[j] if scales is not None and j < len(scales) else None
        if known and begin is not None:
            found = begin
        elif y.std() < tiny:
            found = Scales(np.full(x.shape[1], 3.0), 1e-3)
        else:
            found = find_scales(x, y, noisy=noisy, start=begin)
        functions.append(krige(x, y, found))
    return Level(region, tuple(functions))


def mixed(levels: Sequence[Level], z: Array, *, variance: bool) -> tuple[Array, Array | None]:
    """Evaluate all functions.

    Parameters
    ----------
    levels : sequence of Level
        The last without bounds.
    z : ndarray, shape (k, d)
        In units of the prior's sds.
    variance : bool
        Whether variances are wanted.

    Returns
    -------
    means, variances : ndarray, shape (k, j)
    """
    count = len(levels[0].functions)
    means = np.zeros((len(z), count))
    variances = np.zeros((len(z), count)) if variance else None
    left = np.ones(len(z))
    for level in levels:
        rows = np.flatnonzero(left > 0.0)
        if not rows.size:
            break
        x = level.region.coordinates(z[rows])
        share = left[rows] * level.weight(x)
        some = share > 0.0
        rows, x, share = rows[some], x[some], share[some]
        for j, function in enumerate(level.functions):
            if variances is None:
                means[rows, j] += share * function.mean(x)
            else:
                mean, var = function.mean_and_variance(x)
                means[rows, j] += share * mean
                variances[rows, j] += share * var
        left[rows] -= share
        left[left < 1e-12] = 0.0
    return means, variances
