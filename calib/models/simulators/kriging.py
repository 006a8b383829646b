"""Smooth functions from few values: of parameters by universal kriging, and of conditions.

    f_j(x) = b(x)' beta_j + g_j(x),   g_j ~ GP(0, s_j^2 [r(x, x') + nugget 1(x = x')]),
    r(x, x') = exp(-1/2 sum_i ((x_i - x'_i) / l_i)^2)

with b the constant and the coordinates, beta flat beforehand (Rasmussen & Williams 2006, *Gaussian
Processes for Machine Learning*, section 2.7). The functions share r: whatever their number, a point
costs one row of correlations and one product with a matrix of n on a side. The length scales are
scikit-learn's, whose `GaussianProcessRegressor` has no trend and no error of what is left out.

The length scales maximise the likelihood of one process with one variance for all functions, so
that those that vary most count most. Each s_j^2 is the geometric mean of two estimates: the
likelihood's, which takes the length scales as known and is too sure, and that of the leave-one-out
errors (section 5.4.2), of which those at the edge are large.

Over conditions, every run gives its outputs at the same *nodes*, so the covariance over parameters
and conditions is a product, and one smooth process through the nodes serves all runs.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, cholesky, solve_triangular

from calib.models.base import Array
from calib.models.constants import BEYOND_NODES, NUGGETS_OVER, STEP_INSIDE


@dataclass(frozen=True)
class Scales:
    """Length scales (d,), and the nugget relative to the process's variance."""

    lengths: Array
    nugget: float


@dataclass(frozen=True)
class Kriging:
    """Functions as their values let them be known.

    Values are known at `x` (n, d); `beta` (q, j) are the trends, `gamma` (n, j) what correlations
    with the known points multiply, `root` (n, n) the inverse of the lower factor of the
    correlations, `trend` (q, n) what, with the correlations, the values take off an unknown trend,
    `trend_root` (q, q) the inverse of the lower factor of its precision, `variances` (j,) those of
    the processes.
    """

    x: Array
    scales: Scales
    beta: Array
    gamma: Array
    root: Array
    trend: Array
    trend_root: Array
    variances: Array

    def mean(self, at: Array) -> Array:
        """Return the means at points, shape (k, d) to (k, j)."""
        lengths = self.scales.lengths
        found = [
            trend_of(some) @ self.beta + correlation(some, self.x, lengths) @ self.gamma
            for some in chunks(at)
        ]
        return np.concatenate(found)

    def mean_and_unknown(self, at: Array) -> tuple[Array, Array]:
        """Return means (k, j), and which part of `variances` is left at points, shape (k,)."""
        means, unknown = [], []
        for some in chunks(at):
            r, b = correlation(some, self.x, self.scales.lengths), trend_of(some)
            means.append(b @ self.beta + r @ self.gamma)
            open_trend = (b - r @ self.trend.T) @ self.trend_root.T
            left = 1.0 - np.square(r @ self.root.T).sum(axis=1)
            unknown.append(left + np.square(open_trend).sum(axis=1))
        return np.concatenate(means), np.maximum(np.concatenate(unknown), 0.0)

    def left_out(self) -> tuple[Array, Array]:
        """Return errors of the values, (n, j), and their parts of `variances`, (n,), if left out.

        Rasmussen & Williams (2006), equations 5.10 to 5.12, the trend estimated without them too.
        """
        unknown = 1.0 / _precisions(self.root, self.trend, self.trend_root)
        return self.gamma * unknown[:, None], unknown


def chunks(at: Array) -> Iterator[Array]:
    """Return points (k, d) a few at a time, at least once: correlations take memory."""
    few = 512
    return (at[i : i + few] for i in range(0, max(len(at), 1), few))


def trend_of(x: Array) -> Array:
    """Return the trend's functions, shape (k, 1 + d)."""
    return np.concatenate([np.ones((len(x), 1)), x], axis=1)


def correlation(a: Array, b: Array, lengths: Array) -> Array:
    """Return the correlations of the process, shapes (k, d) and (n, d) to (k, n)."""
    return np.asarray(np.exp(-0.5 * _squared_distances(a / lengths, b / lengths)))


def _squared_distances(a: Array, b: Array) -> Array:
    squared = np.square(a).sum(axis=1)[:, None] + np.square(b).sum(axis=1) - 2.0 * (a @ b.T)
    return np.asarray(np.maximum(squared, 0.0))


def krige(x: Array, y: Array, scales: Scales) -> Kriging:
    """Fit trends and processes for given scales, to values y (n, j) at x (n, d)."""
    n = len(x)
    b = trend_of(x)
    lower = cholesky(correlation(x, x, scales.lengths) + scales.nugget * np.eye(n), lower=True)
    root = solve_triangular(lower, np.eye(n), lower=True)
    within = root @ b
    # Allows for coordinates that did not vary.
    precision = within.T @ within
    precision += 1e-10 * np.trace(precision) / len(precision) * np.eye(len(precision))
    trend_lower = cholesky(precision, lower=True)
    beta = cho_solve((trend_lower, True), within.T @ (root @ y))
    rest = y - b @ beta
    gamma = cho_solve((lower, True), rest)
    trend = cho_solve((lower, True), b).T
    trend_root = solve_triangular(trend_lower, np.eye(len(precision)), lower=True)
    left_out = np.mean(gamma**2 / _precisions(root, trend, trend_root)[:, None], axis=0)
    likely = np.maximum((rest * gamma).sum(axis=0), 0.0) / max(n - b.shape[1], 1)
    # With no more values than coefficients of the trend none can be left out.
    variances = np.sqrt(likely * left_out) if n > b.shape[1] else y.var(axis=0)
    return Kriging(x, scales, beta, gamma, root, trend, trend_root, variances)


def _precisions(root: Array, trend: Array, trend_root: Array) -> Array:
    """One over what is left unknown of each value by the others, shape (n,)."""
    found = np.square(root).sum(axis=0) - np.square(trend_root @ trend).sum(axis=0)
    return np.asarray(np.maximum(found, 1e-12))


def find_scales(x: Array, y: Array, *, noisy: bool = False, start: Scales | None = None) -> Scales:
    """Find length scales and nugget by marginal likelihood, the trends taken out before.

    Of values y (n, j) at x (n, d). The nugget stays small unless values at one point may differ
    (`noisy`); `start` is where to begin.
    """
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    b = trend_of(x)
    rest = y - b @ np.linalg.lstsq(b, y, rcond=None)[0]
    spread = float(np.sqrt(np.square(rest).mean()))
    if spread <= 1e-12 * max(float(np.abs(y).max()), 1e-300):
        return start or Scales(np.full(x.shape[1], 3.0), 1e-6)
    nuggets = 1e-9, 1.0 if noisy else 1e-3
    lengths = np.full(x.shape[1], 2.0) if start is None else np.clip(start.lengths, 0.3, 60.0)
    nugget = 1e-5 if start is None else start.nugget
    nugget = float(np.clip(nugget, 2.0 * nuggets[0], 0.5 * nuggets[1]))
    shape = RBF(lengths, (0.2, 100.0)) + WhiteKernel(nugget, nuggets)
    found = fitted_kernel(ConstantKernel(1.0, (1e-2, 1e6)) * shape, x, rest / spread, 1e-10).k2
    return Scales(np.atleast_1d(found.k1.length_scale), float(found.k2.noise_level))


def fitted_kernel(kernel: Any, x: Array, y: Array, alpha: float) -> Any:
    """Return a kernel at its greatest marginal likelihood, by scikit-learn."""
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.gaussian_process import GaussianProcessRegressor

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        return GaussianProcessRegressor(kernel, alpha=alpha).fit(x, y).kernel_


@dataclass(frozen=True)
class Region:
    """A part of parameter space, with coordinates in which it is round.

    `centre` (d,) is in units of the prior's sds, `root` (d, d) the lower factor of the covariance
    there, `reach` in sds.
    """

    centre: Array
    root: Array
    reach: float

    def coordinates(self, z: Array) -> Array:
        """Return coordinates in which the region is round, (k, d) to (k, d)."""
        return np.asarray(np.linalg.solve(self.root, (z - self.centre).T).T)

    def inside(self, z: Array) -> NDArray[np.bool_]:
        """Whether points lie in it, (k, d) to (k,)."""
        return np.asarray(np.linalg.norm(self.coordinates(z), axis=1) <= self.reach)


@dataclass(frozen=True)
class Over:
    """Interpolates curves over conditions (Matern 5/2, its length scales by likelihood).

    `columns` are the conditions that vary, `low` and `width` (c,) the nodes' box, `nodes` (m, c)
    and `lengths` (c,) in units of the box, `fixed` the conditions that do not vary.
    """

    columns: tuple[str, ...]
    low: Array
    width: Array
    nodes: Array
    lengths: Array
    fixed: Mapping[str, float]

    def weights(self, curves: Array) -> Array:
        """Return what `at` needs of curves at the nodes, shape (j, m) to (m + 1, j)."""
        mean = curves.mean(axis=1)
        solved = cho_solve(self._factor(), (curves - mean[:, None]).T)
        return np.concatenate([solved, mean[None]])

    def at(self, conditions: Mapping[str, Array], weights: Array) -> Array:
        """Return curves at conditions (n,) or (k, n), shape (..., j); NaN too far outside."""
        first = next(iter(conditions.values()))
        shape = np.broadcast_shapes(*(v.shape for v in conditions.values())) or first.shape
        off = np.zeros(shape, dtype=bool)
        for name, value in self.fixed.items():
            off |= np.abs(conditions[name] - value) > 1e-6 * max(1.0, abs(value))
        if not self.columns:
            only = weights[-1] + weights[:-1].sum(axis=0)
            found = np.broadcast_to(only, (*shape, weights.shape[1]))
        else:
            raw = [np.broadcast_to(conditions[name], shape).ravel() for name in self.columns]
            u = (np.stack(raw, axis=1) - self.low) / self.width
            found = self._straight_on(u, weights).reshape(*shape, -1)
        return np.where(off[..., None], np.nan, found)

    def _straight_on(self, u: Array, weights: Array) -> Array:
        inside = np.clip(u, 0.0, 1.0)
        found = self._smooth(inside, weights)
        out = u - inside
        rows = np.flatnonzero(np.abs(out).max(axis=1) > 1e-9)
        if rows.size:
            # Linearly, from a point a little farther in.
            far = np.abs(out[rows]).max(axis=1, keepdims=True)
            back = self._smooth(inside[rows] - STEP_INSIDE * out[rows] / far, weights)
            found[rows] += (found[rows] - back) * (far / STEP_INSIDE)
            found[rows[far[:, 0] > BEYOND_NODES + 1e-9]] = np.nan
        return found

    def _smooth(self, u: Array, weights: Array) -> Array:
        return np.asarray(_matern(u, self.nodes, self.lengths) @ weights[:-1] + weights[-1])

    def _factor(self) -> tuple[Array, bool]:
        if not self.columns:
            return np.eye(len(self.nodes)), True
        k = _matern(self.nodes, self.nodes, self.lengths)
        for nugget in NUGGETS_OVER[:-1]:
            with suppress(np.linalg.LinAlgError):
                return cho_factor(k + nugget * np.eye(len(k)), lower=True)[0], True
        return cho_factor(k + NUGGETS_OVER[-1] * np.eye(len(k)), lower=True)[0], True

    def left_out(self, curves: Array) -> tuple[Array, Array]:
        """Return the errors of curves (j, m) at each node were it not one, (j, m).

        And which part of the variance is not known there, (m,).
        """
        if not self.columns or len(self.nodes) < 3:
            return np.zeros_like(curves), np.ones(len(self.nodes))
        inverse = cho_solve(self._factor(), np.eye(len(self.nodes)))
        centred = curves - curves.mean(axis=1, keepdims=True)
        return np.asarray(centred @ inverse / np.diag(inverse)), 1.0 / np.diag(inverse)

    def unknown(self, conditions: Mapping[str, Array]) -> Array:
        """Return which part of the variance is not known at conditions (n,), shape (n,)."""
        raw = [conditions[name] for name in self.columns]
        if not raw:
            return np.zeros(next(iter(conditions.values())).size)
        k = _matern((np.stack(raw, axis=1) - self.low) / self.width, self.nodes, self.lengths)
        return np.maximum(1.0 - (k * cho_solve(self._factor(), k.T).T).sum(axis=1), 0.0)


def _matern(a: Array, b: Array, lengths: Array) -> Array:
    r = np.sqrt(5.0 * _squared_distances(a / lengths, b / lengths))
    return np.asarray((1.0 + r + r * r / 3.0) * np.exp(-r))


def over_conditions(
    nodes: Mapping[str, Array], curves: Array, lengths: Array | None = None
) -> Over:
    """Find the length scales over conditions, from curves (j, m) of some runs at nodes (m,)."""
    varying = tuple(name for name, v in nodes.items() if np.ptp(v) > 1e-9 * np.abs(v).max())
    fixed = {name: float(v[0]) for name, v in nodes.items() if name not in varying}
    m = next(iter(nodes.values())).size
    stacked = np.stack([nodes[n] for n in varying], axis=1) if varying else np.zeros((m, 0))
    low = stacked.min(axis=0, initial=np.inf) if varying else np.zeros(0)
    width = np.ptp(stacked, axis=0) if varying else np.zeros(0)
    u = (stacked - low) / width
    if lengths is None:
        lengths = _lengths(u, curves) if varying else np.zeros(0)
    return Over(varying, low, width, u, lengths, fixed)


def _lengths(u: Array, curves: Array) -> Array:
    from sklearn.gaussian_process.kernels import ConstantKernel, Matern

    spread = curves.std(axis=1, keepdims=True)
    scaled = ((curves - curves.mean(axis=1, keepdims=True)) / np.where(spread > 0, spread, 1.0)).T
    # No shorter than from one value of a condition to the next: between few, curves would fall back
    # to their mean.
    shortest = [max(1.0 / (np.unique(v.round(9)).size - 1), 0.03) for v in u.T]
    kernel = ConstantKernel(1.0, (1e-1, 1e5)) * Matern(
        np.maximum(0.5, shortest), [(low, 20.0) for low in shortest], 2.5
    )
    found = fitted_kernel(kernel, u, scaled, NUGGETS_OVER[-1])
    return np.asarray(np.atleast_1d(found.k2.length_scale) * np.ones(u.shape[1]))
