"""Fit a mixture of Student-t to weighted draws by expectation maximisation."""

from __future__ import annotations

import numpy as np
from scipy.special import gammaln

from calib.models.base import Array
from calib.sampling.mixture import Mixture, StudentT, log_sum

__all__ = ["fit_mixture", "moments"]

_MOST_COMPONENTS = 8
# Effective draws per component and dimension.
_DRAWS_PER_COMPONENT = 20.0
_STEPS = 10
# Standard deviations up to this part of the mean are no spread.
_ROUNDING = 1e-12
# Components are widened a little: tails that are too light cost far more than too heavy ones.
_WIDEN = 1.05
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
    """Fit a mixture to weighted draws of known moments by expectation maximisation."""
    d = mean.size
    m = int(np.clip(effective / (_DRAWS_PER_COMPONENT * d), 1, _MOST_COMPONENTS))
    # In coordinates where the draws have no correlation and unit variance.
    x = np.linalg.solve(cholesky, (v - mean).T).T
    centres = x[rng.choice(weight.size, size=m, p=weight)] if m > 1 else np.zeros((1, d))
    parts = tuple(StudentT(c, (0.7 if m > 1 else 1.0) * np.eye(d), _DOFS[2]) for c in centres)
    fitted = Mixture(np.full(m, 1.0 / m), parts)
    for step in range(_STEPS):
        choose_dof = step in (_STEPS // 2 - 1, _STEPS - 1)
        fitted = _improved(fitted, x, weight, effective, choose_dof=choose_dof)
    back = (
        StudentT(mean + cholesky @ c.mean, _WIDEN * cholesky @ c.cholesky, c.dof)
        for c in fitted.components
    )
    return Mixture(fitted.weights, tuple(back))


def _improved(
    mixture: Mixture, x: Array, weight: Array, effective: float, *, choose_dof: bool
) -> Mixture:
    """One step of expectation maximisation on weighted, whitened draws.

    Covariances are drawn towards a half of the whole by as many draws as there are dimensions.
    """
    d = mixture.n_dim
    squared = mixture.squared_distances(x)
    parts = mixture.log_parts(squared)
    share = np.exp(parts - log_sum(parts))
    share *= weight
    dofs = np.array([c.dof for c in mixture.components])
    if choose_dof:
        dofs = _likeliest_dof(squared, share, d)
    # Draws far out in a component's tails weigh little: the Student-t's own weighting.
    tail = share * ((dofs[:, None] + d) / (dofs[:, None] + squared))
    mass = share.sum(axis=1)
    pseudo = d / effective
    components, masses = [], []
    for j in range(dofs.size):
        if mass[j] * effective < d:
            continue
        mean = tail[j] @ x / tail[j].sum()
        scaled = (x - mean) * np.sqrt(tail[j])[:, None]
        covariance = (scaled.T @ scaled + 0.5 * pseudo * np.eye(d)) / (mass[j] + pseudo)
        components.append(StudentT(mean, np.linalg.cholesky(covariance), float(dofs[j])))
        masses.append(mass[j])
    return Mixture(np.array(masses) / np.sum(masses), tuple(components))


def _likeliest_dof(squared: Array, share: Array, d: int) -> Array:
    dof = np.array(_DOFS)
    constant = gammaln(0.5 * (dof + d)) - gammaln(0.5 * dof) - 0.5 * d * np.log(dof)
    value = [
        (share * (c - 0.5 * (v + d) * np.log(1.0 + squared / v))).sum(axis=1)
        for v, c in zip(dof, constant, strict=True)
    ]
    return np.asarray(dof[np.argmax(value, axis=0)])
