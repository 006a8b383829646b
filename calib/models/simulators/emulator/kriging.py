"""Several smooth functions of a few coordinates from few values: universal kriging.

    f_j(x) = b(x)' beta_j + g_j(x),   g_j ~ GP(0, s_j^2 [r(x, x') + nugget 1(x = x')]),
    r(x, x') = exp(-1/2 sum_i ((x_i - x'_i) / l_i)^2)

with b the constant and the coordinates, beta flat beforehand (Rasmussen & Williams 2006, *Gaussian
Processes for Machine Learning*, section 2.7). The functions share r: whatever their number, a point
costs one row of correlations and one product with a matrix of n on a side.

The length scales are those of the greatest likelihood of one process, with one variance for all
functions, so that those that vary most count most. Each s_j^2 is the geometric mean of two
estimates: the likelihood's, which takes the length scales as known and is too sure, and that of the
errors of leaving out one value at a time (section 5.4.2), of which those at the edge are large.

scikit-learn's `GaussianProcessRegressor` finds the same length scales (a test holds one against the
other) in ten times the time, has no trend, and its predictions copy their input at each call; a
sampler asks a million times, and an emulator is built anew after every few runs. GPyTorch, GPflow
and tinygp bring torch, TensorFlow or JAX, and 300 values need none of what those are for.

Where a posterior lies: the runs there matter most.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.linalg.blas import dtrmm

from calib.models.base import Array

# Relative to the process: smaller and the matrix has no factor, larger and values are not met.
_NUGGET, _NOISY = 1e-9, 1.0
_LENGTHS = (0.2, 100.0)
_STEPS = 40
# What keeps the matrix of the smallest nugget from having no factor.
_JITTER = 1e-10
# Points at once: their correlations with some hundred others stay in a processor's cache.
AT_ONCE = 512


@dataclass(frozen=True)
class Scales:
    """Length scales and nugget, relative to the process's variance.

    Parameters
    ----------
    lengths : ndarray, shape (d,)
    """

    lengths: Array
    nugget: float


@dataclass(frozen=True)
class Kriging:
    """Functions as their values let them be known.

    Parameters
    ----------
    x : ndarray, shape (n, d)
        Where values are known.
    beta : ndarray, shape (q, j)
    gamma : ndarray, shape (n, j)
        What the correlations with the known points multiply.
    root : ndarray, shape (n, n)
        Inverse of the lower factor of the correlations.
    trend : ndarray, shape (q, n)
        With the correlations, what the values take off a trend that is not known.
    trend_root : ndarray, shape (q, q)
        Inverse of the lower factor of the trend's precision.
    variances : ndarray, shape (j,)
        Of the processes.
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
        found = np.empty((len(at), self.beta.shape[1]))
        for i in range(0, len(at), AT_ONCE):
            some = slice(i, i + AT_ONCE)
            r = correlation(at[some], self.x, self.scales.lengths)
            found[some] = trend_of(at[some]) @ self.beta + r @ self.gamma
        return found

    def mean_and_unknown(self, at: Array) -> tuple[Array, Array]:
        """Return means (k, j), and which part of `variances` is left at points, shape (k,)."""
        means, unknown = np.empty((len(at), self.beta.shape[1])), np.empty(len(at))
        for i in range(0, len(at), AT_ONCE):
            some = slice(i, i + AT_ONCE)
            r = correlation(at[some], self.x, self.scales.lengths)
            b = trend_of(at[some])
            means[some] = b @ self.beta + r @ self.gamma
            open_trend = (b - r @ self.trend.T) @ self.trend_root.T
            # A triangle is half of a square; the correlations are not needed any more.
            left = dtrmm(1.0, self.root, r.T, lower=1, overwrite_b=1).T
            part = 1.0 - np.einsum("kn,kn->k", left, left)
            unknown[some] = part + np.einsum("kq,kq->k", open_trend, open_trend)
        return means, np.maximum(unknown, 0.0)

    def left_out(self) -> tuple[Array, Array]:
        """Return errors of the values, (n, j), and their parts of `variances`, (n,), if left out.

        Rasmussen & Williams (2006), equations 5.10 to 5.12, the trend estimated without them too.
        """
        unknown = 1.0 / _precisions(self.root, self.trend, self.trend_root)
        return self.gamma * unknown[:, None], unknown


def trend_of(x: Array) -> Array:
    """Return the trend's functions, shape (k, 1 + d)."""
    return np.concatenate([np.ones((len(x), 1)), x], axis=1)


def correlation(a: Array, b: Array, lengths: Array) -> Array:
    """Return the correlations of the process, shapes (k, d) and (n, d) to (k, n)."""
    a, b = a / lengths, b / lengths
    squared = a @ (-2.0 * b.T)
    squared += np.einsum("kd,kd->k", a, a)[:, None]
    squared += np.einsum("nd,nd->n", b, b)
    np.maximum(squared, 0.0, out=squared)
    squared *= -0.5
    return np.asarray(np.exp(squared, out=squared))


def krige(x: Array, y: Array, scales: Scales) -> Kriging:
    """Fit trends and processes for given scales.

    Parameters
    ----------
    x : ndarray, shape (n, d)
    y : ndarray, shape (n, j)
    """
    n = len(x)
    b = trend_of(x)
    lower = cholesky(correlation(x, x, scales.lengths) + scales.nugget * np.eye(n), lower=True)
    root = np.asfortranarray(solve_triangular(lower, np.eye(n), lower=True))
    within = root @ b
    # A trend along a coordinate that did not vary is none.
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
    # Where there are no more values than the trend has coefficients none can be left out.
    variances = np.sqrt(likely * left_out) if n > b.shape[1] else y.var(axis=0)
    return Kriging(x, scales, beta, gamma, root, trend, trend_root, variances)


def _precisions(root: Array, trend: Array, trend_root: Array) -> Array:
    """One over what is left unknown of each value by the others, shape (n,)."""
    found = np.square(root).sum(axis=0) - np.square(trend_root @ trend).sum(axis=0)
    return np.asarray(np.maximum(found, 1e-12))


def find_scales(x: Array, y: Array, *, noisy: bool = False, start: Scales | None = None) -> Scales:
    """Find length scales and nugget by marginal likelihood, the trends taken out before.

    Parameters
    ----------
    x : ndarray, shape (n, d)
    y : ndarray, shape (n, j)
    noisy : bool
        Whether values at one point may differ: else the nugget stays small.
    start : Scales, optional
        Where to begin.
    """
    from scipy.optimize import minimize  # late: a tenth of a second, and few commands emulate

    b = trend_of(x)
    rest = y - b @ np.linalg.lstsq(b, y, rcond=None)[0]
    spread = float(np.sqrt(np.square(rest).mean()))
    if spread <= 1e-12 * max(float(np.abs(y).max()), 1e-300):
        return start or Scales(np.full(x.shape[1], 3.0), 1e-6)
    lengths = np.full(x.shape[1], 2.0) if start is None else np.clip(start.lengths, 0.3, 60.0)
    most = _NOISY if noisy else 1e-3
    nugget = 1e-5 if start is None else float(np.clip(start.nugget, 2 * _NUGGET, 0.5 * most))
    bounds = np.log([*[_LENGTHS] * x.shape[1], (_NUGGET, most)])
    # Few steps: the last digit of a length scale changes no prediction.
    found = minimize(
        minus_log_likelihood, np.log([*lengths, nugget]),
        (np.square(x.T[:, :, None] - x.T[:, None]), rest / spread),
        method="L-BFGS-B", jac=True, bounds=bounds, options={"maxiter": _STEPS},
    )  # fmt: skip
    scales = np.exp(found.x)
    return Scales(scales[:-1], float(scales[-1]))


def minus_log_likelihood(logs: Array, squares: Array, y: Array) -> tuple[float, Array]:
    """Return minus the log likelihood at its best variance, without a trend, and its gradient.

    Rasmussen & Williams (2006), equations 2.30 and 5.9, with one variance for all functions.

    Parameters
    ----------
    logs : ndarray, shape (d + 1,)
        Logarithms of the length scales and the nugget.
    squares : ndarray, shape (d, n, n)
        Squared distances along each coordinate.
    y : ndarray, shape (n, j)
    """
    lengths, nugget, n = np.exp(logs[:-1]), np.exp(logs[-1]), y.size
    smooth = np.exp(-0.5 * np.tensordot(lengths**-2.0, squares, axes=1))
    eye = np.eye(len(y))
    try:
        lower = cholesky(smooth + (nugget + _JITTER) * eye, lower=True)
    except np.linalg.LinAlgError:
        return np.inf, np.zeros_like(logs)
    inverse = cho_solve((lower, True), eye)
    gamma = inverse @ y
    level = float(np.vdot(y, gamma)) / n
    log_det = 2.0 * y.shape[1] * np.log(np.diag(lower)).sum()
    value = 0.5 * (n * (np.log(2.0 * np.pi * level) + 1.0) + log_det)
    off = 0.5 * (y.shape[1] * inverse - gamma @ gamma.T / level)
    by_length = squares.reshape(len(lengths), -1) @ (off * smooth).ravel() / lengths**2
    return float(value), np.array([*by_length, nugget * np.trace(off)])


@dataclass(frozen=True)
class Region:
    """A part of parameter space, with coordinates in which it is round.

    Parameters
    ----------
    centre : ndarray, shape (d,)
        In units of the prior's sds.
    root : ndarray, shape (d, d)
        Lower factor of the covariance there.
    reach : float
        In sds.
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
