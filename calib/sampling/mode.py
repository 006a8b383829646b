"""Find the posterior's modes from point estimates and prior draws."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from calib.models.base import Array
from calib.priors import Priors
from calib.sampling.climb import climb
from calib.sampling.proposal import hessian_scale

__all__ = ["DEPTH", "Mode", "find_mode", "find_modes", "prior_widths"]

# Modes lower than the highest by this in log density are left out: a hundred times as wide, they
# would still hold less than a thousandth of the posterior.
DEPTH = 12.0
# Points within this many standard deviations, per square root of the dimension, share a mode.
_NEAR = 1.5
_WORST = 1e12


@dataclass(frozen=True)
class Mode:
    """A local maximum of a log density.

    Parameters
    ----------
    at : ndarray, shape (d,)
    height : float
        Log density there.
    covariance : ndarray, shape (d, d)
        Of the normal approximation there.
    """

    at: Array
    height: float
    covariance: Array


def prior_widths(priors: Priors) -> Array:
    """Prior standard deviation (uniform: a quarter of the range) of each free parameter, (d,)."""
    return np.array(
        [p.scale if np.isfinite(p.scale) else 0.25 * (p.upper - p.lower) for p in priors.free]
    )


def find_mode(
    log_prob: Callable[[Array], Array],
    priors: Priors,
    rng: np.random.Generator,
    *,
    starts: Array | None = None,
    n_polish: int = 4,
) -> Array:
    """Return the highest mode of a posterior in internal coordinates, shape (d,).

    Parameters are those of `find_modes`.
    """
    return find_modes(log_prob, priors, rng, starts=starts, n_polish=n_polish)[0].at


def find_modes(
    log_prob: Callable[[Array], Array],
    priors: Priors,
    rng: np.random.Generator,
    *,
    starts: Array | None = None,
    n_screen: int = 400,
    n_climb: int = 16,
    n_polish: int = 4,
) -> list[Mode]:
    """Return the modes of a posterior that matter, the highest first.

    The given starts and the best of each group of prior draws climb together, a batch of
    quasi-Newton ascents in one call per step; where they end apart, each end is polished by
    L-BFGS-B. A sampler that knows one mode only may miss another whatever its own diagnostics say.

    Parameters
    ----------
    log_prob : callable
        ``(k, d) -> (k,)``.
    priors : Priors
    rng : Generator
    starts : ndarray, shape (m, d), optional
        Point estimates, in internal coordinates.
    n_screen, n_climb, n_polish : int
        Prior draws screened, how many of them climb, and how many ends are polished at most.

    Returns
    -------
    list of Mode
        Those within `DEPTH` of the highest in log density; where no allowed point was found, one
        of height ``-inf``.
    """
    width = prior_widths(priors)
    lower = np.array([p.lower for p in priors.free])
    upper = np.array([p.upper for p in priors.free])
    pool = priors.sample(rng, n_screen)
    value = log_prob(pool)
    # The best of each group rather than the best of all, which may share one basin.
    groups = np.array_split(np.arange(n_screen), n_climb)
    picked = pool[[group[value[group].argmax()] for group in groups]]
    candidates = picked if starts is None else np.concatenate([np.atleast_2d(starts), picked])
    ends, heights = climb(log_prob, candidates, width, lower, upper)
    modes: list[Mode] = []
    for i in np.argsort(-heights)[: 4 * n_polish]:
        deep = modes and heights[i] < max(m.height for m in modes) - DEPTH
        if len(modes) == n_polish or deep or heights[i] <= -_WORST:
            break
        if any(_near(ends[i], mode) for mode in modes):
            continue
        height, at = _polish(log_prob, ends[i], width, lower, upper)
        if not any(_near(at, mode) for mode in modes):
            modes.append(Mode(at, height, hessian_scale(log_prob, at, width)))
    if not modes:
        return [Mode(ends[0], -np.inf, np.diag(width**2))]
    modes.sort(key=lambda mode: -mode.height)
    return [mode for mode in modes if mode.height > modes[0].height - DEPTH]


def _near(x: Array, mode: Mode) -> bool:
    """Whether a point lies in the bulk that a mode's curvature describes."""
    away = x - mode.at
    return float(away @ np.linalg.solve(mode.covariance, away)) < _NEAR**2 * away.size


def _polish(
    log_prob: Callable[[Array], Array], start: Array, width: Array, lower: Array, upper: Array
) -> tuple[float, Array]:
    d = start.size
    step = 1e-5
    directions = np.concatenate([np.zeros((1, d)), step * np.eye(d), -step * np.eye(d)])
    low, high = (lower - start) / width, (upper - start) / width

    def negative(z: Array) -> tuple[float, Array]:
        # One-sided at a bound: the outer point is pulled back onto it.
        points = np.clip(z + directions, low, high)
        value = -log_prob(start + points * width)
        value = np.where(np.isfinite(value), value, _WORST)
        span = np.diagonal(points[1 : d + 1]) - np.diagonal(points[d + 1 :])
        gradient = (value[1 : d + 1] - value[d + 1 :]) / np.maximum(span, 1e-12)
        return float(value[0]), gradient

    found = minimize(
        negative,
        np.zeros(d),
        jac=True,
        method="L-BFGS-B",
        bounds=list(zip(low, high, strict=True)),
        options={"maxiter": 300},
    )
    return -float(found.fun), start + np.clip(found.x, low, high) * width
