"""Fit a mixture of Student-t to weighted draws by expectation maximisation.

Squared distances and covariances are both linear in the products of the coordinates, which are
formed once: a step is two matrix products.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln

from calib.inference.sampling.mixture import Mixture, StudentT, log_sum
from calib.models.base import Array

_MOST_COMPONENTS = 16
# Effective draws per entry of a component's covariance.
_DRAWS_PER_ENTRY = 5.0
_STEPS = 20
# Standard deviations up to this part of the mean are no spread.
_ROUNDING = 1e-12
# Components are widened a little: tails that are too light cost far more than too heavy ones.
_WIDEN = 1.07
_DOFS = (3.0, 6.0, 12.0, 30.0)


def moments(x: Array, weight: Array) -> tuple[Array, Array] | None:
    """Weighted mean and Cholesky factor of the covariance; None where it is degenerate."""
    mean = weight @ x
    centred = x - mean
    covariance = (centred * weight[:, None]).T @ centred
    scale = np.sqrt(np.diag(covariance))
    if not (np.isfinite(scale).all() and (scale > _ROUNDING * (1.0 + abs(mean))).all()):
        return None
    correlation = covariance / np.outer(scale, scale) + 1e-9 * np.eye(mean.size)
    try:
        return mean, scale[:, None] * np.linalg.cholesky(correlation)
    except np.linalg.LinAlgError:
        return None


def fit_mixture(
    v: Array,
    weight: Array,
    mean: Array,
    cholesky: Array,
    effective: float,
    rng: np.random.Generator,
) -> Mixture:
    """Fit a mixture to weighted draws (k, d), weights (k,) of sum 1, of known `moments`.

    What the draws are worth limits the number of components; these start at draws picked at random.
    """
    d = mean.size
    m = int(np.clip(effective / (_DRAWS_PER_ENTRY * d**2), 1, _MOST_COMPONENTS))
    # In coordinates where the draws have no correlation and unit variance.
    x = np.linalg.solve(cholesky, (v - mean).T)
    centres = x.T[rng.choice(weight.size, size=m, p=weight)] if m > 1 else np.zeros((1, d))
    scale = (0.7 if m > 1 else 1.0) * np.eye(d)
    parts = _Parts(
        np.full(m, 1.0 / m), centres, np.repeat(scale[None], m, axis=0), np.full(m, _DOFS[2])
    )
    products = _products(x)
    for step in range(_STEPS):
        choose_dof = step in (_STEPS // 2 - 1, _STEPS - 1)
        parts = _improved(parts, x, products, weight, effective, choose_dof=choose_dof)
    back = (
        StudentT(mean + cholesky @ centre, _WIDEN * cholesky @ factor, float(dof))
        for centre, factor, dof in zip(parts.means, parts.choleskys, parts.dofs, strict=True)
    )
    return Mixture(parts.weights, tuple(back))


@dataclass(frozen=True)
class _Parts:
    """Components: weights (m,), means (m, d), Cholesky factors (m, d, d), dof (m,)."""

    weights: Array
    means: Array
    choleskys: Array
    dofs: Array


def _products(x: Array) -> Array:
    """Products of coordinates, shape (d, k) to (d (d + 1)/2, k)."""
    i, j = np.triu_indices(x.shape[0])
    return np.asarray(x[i] * x[j])


def _squared_distances(parts: _Parts, x: Array, products: Array) -> Array:
    """Squared Mahalanobis distances from each component, shape (m, k)."""
    i, j = np.triu_indices(x.shape[0])
    inverse = np.linalg.inv(parts.choleskys)
    precision = inverse.swapaxes(1, 2) @ inverse
    packed = precision[:, i, j] * np.where(i == j, 1.0, 2.0)
    linear = np.einsum("mab,mb->ma", precision, parts.means)
    constant = np.einsum("ma,ma->m", linear, parts.means)
    squared: Array = packed @ products - 2.0 * linear @ x + constant[:, None]
    return np.maximum(squared, 0.0)


def _improved(
    parts: _Parts, x: Array, products: Array, weight: Array, effective: float, *, choose_dof: bool
) -> _Parts:
    """One step on weighted, whitened draws.

    Covariances are drawn towards a half of the whole by as many draws as there are dimensions.
    """
    d = x.shape[0]
    squared = _squared_distances(parts, x, products)
    dof = parts.dofs[:, None]
    constant = np.log(parts.weights) - np.log(np.diagonal(parts.choleskys, axis1=1, axis2=2)).sum(
        axis=1
    )
    log_part = _log_kernel(squared, dof, d) + constant[:, None]
    share = np.exp(log_part - log_sum(log_part))
    share *= weight
    if choose_dof:
        dof = _likeliest_dof(squared, share, d)[:, None]
    # Draws far out in a component's tails weigh little: the Student-t's own weighting.
    tail = share * ((dof + d) / (dof + squared))
    mass = share.sum(axis=1)
    kept = mass * effective >= d
    kept[np.argmax(mass)] = True  # however little the draws are worth
    tail, mass, dof = tail[kept], mass[kept], dof[kept]
    means = tail @ x.T / tail.sum(axis=1)[:, None]
    second = np.empty((mass.size, d, d))
    i, j = np.triu_indices(d)
    second[:, i, j] = second[:, j, i] = tail @ products.T
    about = second - np.einsum("m,ma,mb->mab", tail.sum(axis=1), means, means)
    pseudo = d / effective
    covariances = (about + 0.5 * pseudo * np.eye(d)) / (mass + pseudo)[:, None, None]
    return _Parts(mass / mass.sum(), means, np.linalg.cholesky(covariances), dof[:, 0])


def _log_kernel(squared: Array, dof: Array | float, d: int) -> Array:
    """Log density of a Student-t at squared distances, but for its scale."""
    constant = gammaln(0.5 * (dof + d)) - gammaln(0.5 * dof) - 0.5 * d * np.log(dof)
    return np.asarray(constant - 0.5 * (dof + d) * np.log(1.0 + squared / dof))


def _likeliest_dof(squared: Array, share: Array, d: int) -> Array:
    value = [(share * _log_kernel(squared, dof, d)).sum(axis=1) for dof in _DOFS]
    return np.asarray(np.array(_DOFS)[np.argmax(value, axis=0)])
