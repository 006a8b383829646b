"""Curves known at some conditions, at any other ones: a smooth process through the nodes.

Every run gives its outputs at the same conditions, the *nodes*, among them those of the data, so
the covariance over parameters and conditions is a product. What varies over the conditions is the
matter of this module, once for all runs; it is exact at the nodes.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from calib.models.base import Array

_NUGGET = 1e-8
# The smallest with which the matrix has a factor: by it curves miss their nodes.
_NUGGETS = (1e-13, 1e-12, 1e-11, 1e-10, 1e-9)
# Beyond the nodes' box curves go on straight for so much of its width; farther they have no value.
BEYOND = 0.15
_INSIDE = 0.02


@dataclass(frozen=True)
class Over:
    """Interpolates curves over conditions (Matern 5/2, its length scales by likelihood).

    Parameters
    ----------
    columns : tuple of str
        The conditions that vary.
    low, width : ndarray, shape (c,)
        Of the nodes' box.
    nodes : ndarray, shape (m, c)
        In units of the box.
    lengths : ndarray, shape (c,)
    fixed : mapping of str to float
        The conditions that do not vary.
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
        """Return the curves at conditions, shape (..., j); NaN too far outside.

        Parameters
        ----------
        conditions : mapping of str to ndarray, shape (n,) or (k, n)
        weights : ndarray, shape (m + 1, j)
        """
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
            # From a point a little farther in, on the line along which it leaves the box.
            far = np.abs(out[rows]).max(axis=1, keepdims=True)
            back = self._smooth(inside[rows] - _INSIDE * out[rows] / far, weights)
            found[rows] += (found[rows] - back) * (far / _INSIDE)
            found[rows[far[:, 0] > BEYOND + 1e-9]] = np.nan
        return found

    def _smooth(self, u: Array, weights: Array) -> Array:
        return np.asarray(_matern(u, self.nodes, self.lengths) @ weights[:-1] + weights[-1])

    def _factor(self) -> tuple[Array, bool]:
        if not self.columns:
            return np.eye(len(self.nodes)), True
        k = _matern(self.nodes, self.nodes, self.lengths)
        for nugget in _NUGGETS:
            with suppress(np.linalg.LinAlgError):
                return cho_factor(k + nugget * np.eye(len(k)), lower=True)[0], True
        return cho_factor(k + _NUGGET * np.eye(len(k)), lower=True)[0], True

    def left_out(self, curves: Array) -> Array:
        """Return the errors at each node were it not one, shape (j, m) to (j, m)."""
        if not self.columns or len(self.nodes) < 3:
            return np.zeros_like(curves)
        inverse = cho_solve(self._factor(), np.eye(len(self.nodes)))
        centred = curves - curves.mean(axis=1, keepdims=True)
        return np.asarray(centred @ inverse / np.diag(inverse))


def _matern(a: Array, b: Array, lengths: Array) -> Array:
    a, b = a / lengths, b / lengths
    squared = ((a * a).sum(axis=1)[:, None] + (b * b).sum(axis=1)) - 2.0 * (a @ b.T)
    r = np.sqrt(np.maximum(5.0 * squared, 0.0))
    return np.asarray((1.0 + r + r * r / 3.0) * np.exp(-r))


def over_conditions(
    nodes: Mapping[str, Array], curves: Array, lengths: Array | None = None
) -> Over:
    """Find the length scales over conditions.

    Parameters
    ----------
    nodes : mapping of str to ndarray, shape (m,)
    curves : ndarray, shape (j, m)
        Outputs of some runs.
    """
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
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import ConstantKernel, Matern

    spread = curves.std(axis=1, keepdims=True)
    scaled = ((curves - curves.mean(axis=1, keepdims=True)) / np.where(spread > 0, spread, 1.0)).T
    kernel = ConstantKernel(1.0, (1e-1, 1e5)) * Matern(np.full(u.shape[1], 0.5), (0.03, 20.0), 2.5)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        fitted = GaussianProcessRegressor(kernel, alpha=_NUGGET).fit(u, scaled).kernel_
    return np.asarray(np.atleast_1d(fitted.k2.length_scale) * np.ones(u.shape[1]))
