"""Find the modes of a posterior from point estimates and prior draws, with their curvature."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from calib.inference.priors import Priors
from calib.inference.random import even_points
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


_HOPELESS = 1e12
# Where `find_mode` looks, and from how many points it climbs.
_SCREENED, _CLIMBED = 400, 8
# Steps, and what gains too little for another (nats), of the last of its ascents.
_TO_THE_END, _AT_THE_END = 300, 1e-8
# Times the prior's width, from which half of the search for modes begins; no farther out than this
# part of the prior.
_WIDER, _TAIL = 3.0, 1e-12
# Modes so many nats below the highest hold no mass worth finding; squared standard distances up to
# this are no distance.
_NEGLIGIBLE, _NEAR = 15.0, 25.0


def prior_widths(priors: Priors) -> Array:
    """Prior standard deviation (uniform: a quarter of the range) of each free parameter, (d,)."""
    _, scale, lower, upper, _ = priors._arrays
    return np.where(np.isfinite(scale), scale, 0.25 * (upper - lower))


def find_mode(log_prob: Callable[[Array], Array], priors: Priors) -> Array:
    """Return the highest mode of a posterior ``(k, d) -> (k,)``, shape (d,).

    From points that fill the prior evenly, the same for every seed, a batch of quasi-Newton
    ascents; the highest is then followed to its end.
    """
    width, bounds = prior_widths(priors), _bounds(priors)
    pool = priors.ppf(even_points(_SCREENED, len(priors.free)))
    ends, values = climb(log_prob, _best_of_each(log_prob, pool, _CLIMBED), width, *bounds)
    highest = ends[[values.argmax()]]
    found, _ = climb(log_prob, highest, width, *bounds, steps=_TO_THE_END, tolerance=_AT_THE_END)
    return np.asarray(found[0])


@dataclass(frozen=True)
class Mode:
    """A mode of a posterior, (d,), and the covariance of the normal with the curvature there."""

    t: Array
    log_prob: float
    covariance: Array

    def explains(self, t: Array, log_prob: float) -> bool:
        """Whether a point may well belong here: no farther off than its density lets expect.

        For a normal density the squared distance would be twice what the log density lacks.
        """
        apart = t - self.t
        squared = float(apart @ np.linalg.solve(self.covariance, apart))
        return squared < 4.0 * max(self.log_prob - log_prob, 0.0) + _NEAR


def find_modes(
    log_prob: Callable[[Array], Array],
    priors: Priors,
    rng: np.random.Generator,
    *,
    starts: Array | None = None,
    spread: int = 64,
) -> list[Mode]:
    """Return the modes of a posterior ``(k, d) -> (k,)`` that were found, the highest first.

    The given starts (m, d) and `spread` points, half of them drawn evenly from the prior and half
    from one several times as wide, climb together, each by itself: a mode is found from any point
    on its slopes, however much higher another is.
    """
    width, bounds = prior_widths(priors), _bounds(priors)
    begun = [np.empty((0, width.size)) if starts is None else np.atleast_2d(starts)]
    if spread:
        u = (even_points(spread, width.size) + rng.random(width.size)) % 1.0
        u[::2] = ndtr(_WIDER * ndtri(u[::2]))
        begun.append(priors.ppf(np.clip(u, _TAIL, 1.0 - _TAIL)))
    ends, values = climb(log_prob, np.concatenate(begun), width, *bounds)
    modes: list[Mode] = []
    for i in np.argsort(-values):
        t, value = ends[i], float(values[i])
        if modes and (
            modes[0].log_prob - value > _NEGLIGIBLE or any(m.explains(t, value) for m in modes)
        ):
            continue
        if value <= -_HOPELESS:
            # Nowhere is the density positive: the caller will see.
            modes.append(Mode(t, -np.inf, np.diag(width**2)))
            continue
        # A posterior may be a million times narrower than its prior.
        near = np.sqrt(np.diag(hessian_scale(log_prob, t, width)))
        top, high = climb(
            log_prob, t[None], near, *bounds, steps=_TO_THE_END, tolerance=_AT_THE_END
        )
        if not any(m.explains(top[0], float(high[0])) for m in modes):
            modes.append(Mode(top[0], float(high[0]), hessian_scale(log_prob, top[0], width)))
    return sorted(modes, key=lambda mode: -mode.log_prob)


def _best_of_each(log_prob: Callable[[Array], Array], pool: Array, count: int) -> Array:
    """The best of each of so many groups: the best of all may share one basin."""
    value = log_prob(pool)
    groups = np.array_split(np.arange(len(pool)), count)
    return pool[[group[value[group].argmax()] for group in groups]]


def _bounds(priors: Priors) -> tuple[Array, Array]:
    return np.array([p.lower for p in priors.free]), np.array([p.upper for p in priors.free])
