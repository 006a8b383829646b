"""Sums of squared residuals of many parameter vectors: the work of every likelihood.

Rows taken at the same conditions share their prediction mu. Of m such rows with mean m_y,

    sum (y - mu)^2 = sum (y - m_y)^2 + m (m_y - mu)^2,

so the model is evaluated once per distinct condition, whatever the number of rows. What is left
is worked through in tiles, some rows times some vectors, that stay in the processor's cache and
bound the memory. Each tile's part is summed on its own, so the number of threads does not change
a digit of the result.

The density of residuals where the prediction itself is known with an error.

The noise is independent, the prediction's error is shared by the rows: a few curves B, (n, j),
times independent normals of one variance v. So the residuals r are normal with the covariance
sigma^2 I + v B B'. With B'B = U diag(d) U', the same for all parameters, and a = U'B'r,

    ln N = -n ln sigma - 1/2 sum_i ln(1 + v d_i / sigma^2) - n/2 ln 2 pi
           - (r'r - sum_i a_i^2 v / (sigma^2 + v d_i)) / (2 sigma^2)
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from calib.models.base import Array, BoundModel, Conditions, Rows, columns

# Cells (rows times vectors) of a tile: a few arrays of doubles in a processor's cache.
_TILE_CELLS = 65_536
# Up to this many rows are one tile, in their order.
_SHORT = 256
# Cells from which a second thread is worth starting.
_PARALLEL_CELLS = 4_000_000


@dataclass(frozen=True)
class _Tile:
    """Rows that are evaluated together."""

    rows: Rows
    response: Array
    """Mean response at each distinct condition."""
    repeats: Array | None
    """How many rows share the condition; None where all are distinct."""


@dataclass(frozen=True)
class Squares:
    """Sum of squared residuals of a bound model on fixed data.

    `within` is that of the repeats about their means. Threads are for large tasks; the result does
    not depend on them.
    """

    bound: BoundModel
    tiles: tuple[_Tile, ...]
    n_distinct: int
    within: float
    threads: int

    @classmethod
    def of(
        cls,
        bound: BoundModel,
        conditions: Conditions,
        response: Array,
        *,
        threads: int | None = None,
    ) -> Squares:
        """Arrange conditions and responses (n,) for a bound model, a thread for each processor."""
        distinct, mean, repeats, within = _distinct(conditions, response)
        tiles = tuple(
            _tile(bound, distinct, mean, repeats, rows) for rows in _blocks(distinct, mean.size)
        )
        return cls(bound, tiles, mean.size, within, threads or _processors())

    def __call__(self, theta: Array) -> Array:
        """Evaluate natural parameters of the model, (k, d) to (k,); NaN where it has no value."""
        sums = np.empty((len(self.tiles), theta.shape[0]))

        def work(i: int) -> None:
            _evaluate(self.bound, self.tiles[i], theta, sums[i])

        if self.threads > 1 and theta.shape[0] * self.n_distinct >= _PARALLEL_CELLS:
            with ThreadPoolExecutor(self.threads) as pool:
                list(pool.map(work, range(len(self.tiles))))
        else:
            for i in range(len(self.tiles)):
                work(i)
        return np.asarray(sums.sum(axis=0) + self.within)


def _processors() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _evaluate(bound: BoundModel, tile: _Tile, theta: Array, out: Array) -> None:
    """Write each vector's sum of squares over a tile's rows."""
    at_once = max(1, _TILE_CELLS // tile.response.size)
    # Threads have their own error state. Bad vectors come out as NaN.
    with np.errstate(all="ignore"):
        for i in range(0, theta.shape[0], at_once):
            some = columns(theta[i : i + at_once])
            r = bound.model.mean_response(some, tile.rows, bound.references) - tile.response
            r *= r
            out[i : i + at_once] = r.sum(axis=1) if tile.repeats is None else r @ tile.repeats


def _tile(
    bound: BoundModel, distinct: Conditions, mean: Array, repeats: Array | None, rows: slice
) -> _Tile:
    prepared = bound.prepare({name: v[rows] for name, v in distinct.items()})
    return _Tile(prepared, mean[rows], None if repeats is None else repeats[rows])


def _distinct(
    conditions: Conditions, response: Array
) -> tuple[dict[str, Array], Array, Array | None, float]:
    """Merge the repeats; long data come back sorted by the condition of fewest values.

    Return the distinct conditions and, of the rows at each, the mean response and the number (None
    if none was repeated), all of shape (m,); and the sum of squares about the means.
    """
    n = response.size
    levels = [np.unique(v, return_inverse=True) for v in conditions.values()]
    levels.sort(key=lambda level: level[0].size)
    code = np.zeros(n, dtype=np.intp)
    for values, inverse in levels:
        # Renumbered at every step, so that the codes cannot overflow.
        code = np.unique(code * values.size + inverse, return_inverse=True)[1]
    count = np.bincount(code)
    if count.size == n:
        order = np.argsort(code) if n > _SHORT else np.arange(n)
        return {name: v[order] for name, v in conditions.items()}, response[order], None, 0.0
    first = np.empty(count.size, dtype=np.intp)
    first[code[::-1]] = np.arange(n)[::-1]
    mean = np.bincount(code, response) / count
    within = float(np.square(response - mean[code]).sum())
    distinct = {name: v[first] for name, v in conditions.items()}
    return distinct, mean, count.astype(np.float64), within


def _blocks(distinct: Conditions, n: int) -> list[slice]:
    """Cut sorted rows into tiles, also where the condition of fewest values changes.

    There the equation may work out per value what it would otherwise do per row.
    """
    if n <= _SHORT:
        return [slice(0, n)]
    few = min(distinct.values(), key=lambda v: np.unique(v).size)
    edges = np.flatnonzero(np.diff(few)) + 1
    if edges.size * _SHORT > n:
        edges = edges[:0]
    cuts = [0]
    for edge in [*edges.tolist(), n]:
        length = edge - cuts[-1]
        parts = -(-length // _TILE_CELLS)
        cuts += [cuts[-1] + length * (j + 1) // parts for j in range(parts)]
    return [slice(a, b) for a, b in pairwise(cuts)]


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
