"""One smooth function of a few coordinates from few values: universal kriging.

    f(x) = b(x)' beta + g(x),   g ~ GP(0, s^2 [r(x, x') + nugget 1(x = x')]),
    r(x, x') = exp(-1/2 sum_j ((x_j - x'_j) / l_j)^2)

with b the constant and the coordinates, beta flat beforehand (Rasmussen & Williams 2006, *Gaussian
Processes for Machine Learning*, section 2.7).

The length scales are those of the greatest marginal likelihood, as scikit-learn's
`GaussianProcessRegressor` would find them (a test holds one against the other). It has no trend,
its predictions check and copy their input at each call, and its search, mostly spent on kernel
objects, takes ten times as long; where a sampler asks a million times and an emulator is built anew
after every few runs, that matters. GPyTorch, GPflow and tinygp bring torch, TensorFlow or JAX, and
300 values need none of what those are for.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular

from calib.models.base import Array

__all__ = ["Kriging", "Scales", "find_scales", "krige", "minus_log_likelihood"]

# Relative to the process: smaller and the matrix has no factor, larger and values are not met.
_NUGGET, _NOISY = 1e-9, 1.0
_LENGTHS = (0.2, 100.0)
_LEVELS = (1e-2, 1e6)  # of the process's variance, in units of the values'
_STEPS = 40
# What keeps the matrix of the smallest nugget from having no factor.
_JITTER = 1e-10


@dataclass(frozen=True)
class Scales:
    """Length scales and nugget, relative to the process's variance.

    Parameters
    ----------
    lengths : ndarray, shape (d,)
    nugget : float
    """

    lengths: Array
    nugget: float


@dataclass(frozen=True)
class Kriging:
    """A function as its values let it be known.

    Parameters
    ----------
    x : ndarray, shape (n, d)
        Where values are known.
    scales : Scales
    beta : ndarray, shape (q,)
    gamma : ndarray, shape (n,)
        What the correlations with the known points multiply.
    root : ndarray, shape (n, n)
        Inverse of the lower factor of the correlations.
    trend : ndarray, shape (q, n)
        With the correlations, what the values take off a trend that is not known.
    trend_root : ndarray, shape (q, q)
        Inverse of the lower factor of the trend's precision.
    variance : float
        Of the process.
    """

    x: Array
    scales: Scales
    beta: Array
    gamma: Array
    root: Array
    trend: Array
    trend_root: Array
    variance: float

    def mean(self, at: Array) -> Array:
        """Return the mean at points, shape (k, d) to (k,)."""
        return np.asarray(
            trend_of(at) @ self.beta + correlation(at, self.x, self.scales.lengths) @ self.gamma
        )

    def mean_and_variance(self, at: Array) -> tuple[Array, Array]:
        """Return mean and variance at points, shape (k, d) to (k,) each."""
        r = correlation(at, self.x, self.scales.lengths)
        b = trend_of(at)
        left = r @ self.root.T
        open_trend = (b - r @ self.trend.T) @ self.trend_root.T
        part = 1.0 - np.einsum("kn,kn->k", left, left)
        part += np.einsum("kq,kq->k", open_trend, open_trend)
        return b @ self.beta + r @ self.gamma, self.variance * np.maximum(part, 0.0)


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
    """Fit trend and process for given scales.

    Parameters
    ----------
    x : ndarray, shape (n, d)
    y : ndarray, shape (n,)
    scales : Scales
    """
    n = len(x)
    b = trend_of(x)
    lower = cholesky(correlation(x, x, scales.lengths) + scales.nugget * np.eye(n), lower=True)
    within = solve_triangular(lower, b, lower=True)
    # A trend along a coordinate that did not vary is none.
    precision = within.T @ within
    precision += 1e-10 * np.trace(precision) / len(precision) * np.eye(len(precision))
    trend_lower = cholesky(precision, lower=True)
    beta = cho_solve((trend_lower, True), within.T @ solve_triangular(lower, y, lower=True))
    rest = y - b @ beta
    gamma = cho_solve((lower, True), rest)
    variance = float(rest @ gamma) / max(n - b.shape[1], 1)
    return Kriging(
        x, scales, beta, gamma,
        solve_triangular(lower, np.eye(n), lower=True),
        cho_solve((lower, True), b).T,
        solve_triangular(trend_lower, np.eye(len(precision)), lower=True),
        variance,
    )  # fmt: skip


def find_scales(x: Array, y: Array, *, noisy: bool = False, start: Scales | None = None) -> Scales:
    """Find length scales and nugget by marginal likelihood, the trend taken out before.

    Parameters
    ----------
    x : ndarray, shape (n, d)
    y : ndarray, shape (n,)
    noisy : bool
        Whether values at one point may differ: else the nugget stays small.
    start : Scales, optional
        Where to begin.
    """
    from scipy.optimize import minimize  # late: a tenth of a second, and few commands emulate

    b = trend_of(x)
    rest = y - b @ np.linalg.lstsq(b, y, rcond=None)[0]
    spread = float(rest.std())
    if spread <= 1e-12 * max(float(np.abs(y).max()), 1e-300):
        return start or Scales(np.full(x.shape[1], 3.0), 1e-6)
    lengths = np.full(x.shape[1], 2.0) if start is None else np.clip(start.lengths, 0.3, 60.0)
    most = _NOISY if noisy else 1e-3
    nugget = 1e-5 if start is None else float(np.clip(start.nugget, 2 * _NUGGET, 0.5 * most))
    start_at = np.log([1.0, *lengths, nugget])
    bounds = np.log([_LEVELS, *[_LENGTHS] * x.shape[1], (_NUGGET, most)])
    # Few steps: the last digit of a length scale changes no prediction.
    found = minimize(
        minus_log_likelihood, start_at, (np.square(x.T[:, :, None] - x.T[:, None]), rest / spread),
        method="L-BFGS-B", jac=True, bounds=bounds, options={"maxiter": _STEPS},
    )  # fmt: skip
    scales = np.exp(found.x)
    return Scales(scales[1:-1], max(float(scales[-1] / scales[0]), _NUGGET))


def minus_log_likelihood(logs: Array, squares: Array, y: Array) -> tuple[float, Array]:
    """Return minus the log marginal likelihood of values without a trend, and its gradient.

    Rasmussen & Williams (2006), equations 2.30 and 5.9.

    Parameters
    ----------
    logs : ndarray, shape (d + 2,)
        Logarithms of the process's variance, its length scales and the nugget.
    squares : ndarray, shape (d, n, n)
        Squared distances along each coordinate.
    y : ndarray, shape (n,)
    """
    level, lengths, nugget = np.exp(logs[0]), np.exp(logs[1:-1]), np.exp(logs[-1])
    inverse_squares = lengths**-2.0
    smooth = level * np.exp(-0.5 * np.tensordot(inverse_squares, squares, axes=1))
    eye = np.eye(len(y))
    try:
        lower = cholesky(smooth + (nugget + _JITTER) * eye, lower=True)
    except np.linalg.LinAlgError:
        return np.inf, np.zeros_like(logs)
    inverse = cho_solve((lower, True), eye)
    gamma = inverse @ y
    value = 0.5 * y @ gamma + np.log(np.diag(lower)).sum() + 0.5 * len(y) * np.log(2.0 * np.pi)
    off = 0.5 * (inverse - np.outer(gamma, gamma))
    along = (off * smooth).ravel()
    by_length = inverse_squares * (squares.reshape(len(lengths), -1) @ along)
    return float(value), np.array([along.sum(), *by_length, nugget * np.trace(off)])
