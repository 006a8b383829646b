"""The curvature of a density at a mode, as the covariance of a normal."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from calib.models.base import Array

# Of curvatures over that of the prior.
_NARROWEST = 1e13

type LogProb = Callable[[Array], Array]


def hessian_scale(log_prob: LogProb, mode: Array, width: Array) -> Array:
    """Covariance (d, d) of the normal approximation at a mode (d,), by central differences.

    Their step is found from `width` (d,), a length over which each coordinate matters (its prior
    sd). Positive definite: directions in which the density does not fall are given that width.
    """
    d = mode.size
    step = _unit_drop_steps(log_prob, mode, width)
    offsets = [np.zeros(d)]
    for i in range(d):
        for j in range(i + 1):
            for si, sj in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
                e = np.zeros(d)
                e[i] += si * step[i]
                e[j] += sj * step[j]
                offsets.append(e)
    value = log_prob(mode + np.array(offsets))
    value = np.where(np.isfinite(value), value, value[0] - 10.0)
    hessian = np.zeros((d, d))
    position = 1
    for i in range(d):
        for j in range(i + 1):
            pp, pm, mp, mm = value[position : position + 4]
            hessian[i, j] = hessian[j, i] = (pp - pm - mp + mm) / (4.0 * step[i] * step[j])
            position += 4
    scaled = -hessian * np.outer(width, width)
    eigenvalues, vectors = np.linalg.eigh(scaled)
    # No direction is wider than its prior allows, none so narrow that rounding hides it.
    inverse = (vectors / np.clip(eigenvalues, 1.0, _NARROWEST)) @ vectors.T
    return np.asarray(inverse * np.outer(width, width))


def _unit_drop_steps(log_prob: LogProb, mode: Array, width: Array) -> Array:
    """Steps along each axis over which the log density falls by about a half."""
    d = mode.size
    sizes = 2.0 ** -np.arange(0, 24)
    steps = sizes[None, :] * width[:, None]
    points = np.repeat(mode[None], d * sizes.size, axis=0).reshape(d, sizes.size, d)
    plus, minus = points.copy(), points.copy()
    for i in range(d):
        plus[i, :, i] += steps[i]
        minus[i, :, i] -= steps[i]
    value = log_prob(np.concatenate([mode[None], plus.reshape(-1, d), minus.reshape(-1, d)]))
    top = value[0]
    drops = top - np.minimum(
        value[1 : 1 + d * sizes.size].reshape(d, -1), value[1 + d * sizes.size :].reshape(d, -1)
    )
    # The largest step that drops by no more than a half; NaN-safe because -inf drops are large.
    fits = np.where(np.isfinite(drops), drops, np.inf) <= 0.5
    first = np.where(fits.any(axis=1), fits.argmax(axis=1), sizes.size - 1)
    return steps[np.arange(d), first]
