"""Many ascents at once: quasi-Newton steps for a batch of starts, one density call for all.

It tells basins apart, which needs no accuracy; one ascent at a time costs ten times as much.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from calib.models.base import Array

type Mask = NDArray[np.bool_]

_WORST = 1e12
_DIFFERENCE = 1e-5
_LENGTHS = 4.0 ** -np.arange(8)


def climb(
    log_prob: Callable[[Array], Array],
    starts: Array,
    width: Array,
    lower: Array,
    upper: Array,
    *,
    steps: int = 60,
    tolerance: float = 1e-4,
) -> tuple[Array, Array]:
    """Climb from every start (m, d) to near a local maximum; return where and how high it is.

    BFGS with gradients by central differences inside bounds (d,); of eight lengths along each
    direction the best is taken, at most one `width` long.

    Parameters
    ----------
    log_prob : callable
        ``(k, d) -> (k,)``; ``-inf`` where it is not allowed.
    width : ndarray, shape (d,)
        A length over which each coordinate matters (its prior sd).
    tolerance : float
        In log density: an ascent that gains less in a step, and expects less, stops.
    """
    d = width.size
    low, high = lower / width, upper / width

    def cost(z: Array) -> Array:
        value = -log_prob(z.reshape(-1, d) * width)
        return np.where(np.isfinite(value), value, _WORST).reshape(z.shape[:-1])

    def gradient(z: Array, f: Array) -> Array:
        # One-sided at a bound, and beside ground that is not allowed: the point stays at z there.
        ahead = np.minimum(z[:, None] + _DIFFERENCE * np.eye(d), high)
        behind = np.maximum(z[:, None] - _DIFFERENCE * np.eye(d), low)
        value = cost(np.concatenate([ahead, behind], axis=1))
        steps = np.einsum("smii->msi", np.stack([ahead, behind]) - z[:, None]).reshape(-1, 2 * d)
        allowed = value < _WORST
        value, steps = np.where(allowed, value, f[:, None]), np.where(allowed, steps, 0.0)
        span = steps[:, :d] - steps[:, d:]
        return np.asarray((value[:, :d] - value[:, d:]) / np.maximum(span, 1e-12))

    z = np.clip(starts / width, low, high)
    f = cost(z)
    g = gradient(z, f)
    inverse = np.tile(np.eye(d), (z.shape[0], 1, 1))
    blank = np.ones(z.shape[0], dtype=bool)
    left = np.arange(z.shape[0])
    ends, heights = z.copy(), -f
    for _ in range(steps):
        direction = -np.einsum("mij,mj->mi", inverse, g)
        direction[((z <= low) & (direction < 0.0)) | ((z >= high) & (direction > 0.0))] = 0.0
        expected = -np.einsum("mi,mi->m", direction, g)
        direction /= np.maximum(np.linalg.norm(direction, axis=1), 1.0)[:, None]
        tried = np.clip(z[:, None] + _LENGTHS[:, None] * direction[:, None], low, high)
        value = cost(tried)
        rows, best = np.arange(z.shape[0]), value.argmin(axis=1)
        better = value[rows, best] < f
        new = np.where(better[:, None], tried[rows, best], z)
        gained = np.where(better, f - value[rows, best], 0.0)
        new_gradient = gradient(new, f - gained)
        learned = _update(inverse, blank & better, new - z, new_gradient - g, better)
        # A direction that leads nowhere is forgotten; if nothing was known, it is the end.
        inverse[~better] = np.eye(d)
        done = (~better & blank) | (~blank & (gained < tolerance) & (expected < 2.0 * tolerance))
        blank = ~better | (blank & ~learned)
        z, f, g = new, f - gained, new_gradient
        ends[left], heights[left] = z, -f
        going = ~done
        if not going.any():
            break
        left, z, f, g, inverse, blank = (a[going] for a in (left, z, f, g, inverse, blank))
    return ends * width, heights


def _update(inverse: Array, first: Mask, s: Array, y: Array, moved: Mask) -> Mask:
    """Update inverse Hessians (m, d, d) in place by BFGS; return for which it made sense."""
    d = s.shape[1]
    sy, yy = np.einsum("mi,mi->m", s, y), np.einsum("mi,mi->m", y, y)
    good = moved & (sy > 1e-10 * np.sqrt(np.einsum("mi,mi->m", s, s) * yy))
    start = good & first
    inverse[start] = np.eye(d) * (sy[start] / yy[start])[:, None, None]
    rho = np.where(good, 1.0 / np.where(good, sy, 1.0), 0.0)[:, None, None]
    hy = np.einsum("mij,mj->mi", inverse, y)
    yhy = np.einsum("mi,mi->m", y, hy)[:, None, None]
    outer, cross = s[:, :, None] * s[:, None], hy[:, :, None] * s[:, None]
    inverse += rho * ((1.0 + rho * yhy) * outer - cross - cross.transpose(0, 2, 1))
    return np.asarray(good, dtype=np.bool_)
