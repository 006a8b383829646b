"""Find the posterior's mode from point estimates and prior draws."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.optimize import minimize

from calib.models.base import Array
from calib.priors import Priors

__all__ = ["find_mode", "prior_widths"]

_WORST = 1e12


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
    n_screen: int = 400,
    n_polish: int = 4,
) -> Array:
    """Return the mode of a posterior in internal coordinates.

    The best of the given starts and of prior draws are polished by L-BFGS-B with gradients by
    central differences, all of one gradient's points evaluated in one call.

    Parameters
    ----------
    log_prob : callable
        ``(k, d) -> (k,)``.
    priors : Priors
    rng : Generator
    starts : ndarray, shape (m, d), optional
        Point estimates, in internal coordinates.
    n_screen, n_polish : int
        Prior draws screened, and how many of the best are polished.

    Returns
    -------
    ndarray, shape (d,)
    """
    width = prior_widths(priors)
    pool = priors.sample(rng, n_screen)
    given = np.empty((0, width.size)) if starts is None else np.atleast_2d(starts)
    screened = pool[np.argsort(-log_prob(pool))[:n_polish]]
    candidates = np.concatenate([given, screened])
    lower = np.array([p.lower for p in priors.free])
    upper = np.array([p.upper for p in priors.free])
    polished = [_polish(log_prob, x, width, lower, upper) for x in candidates]
    value, best = max(polished, key=lambda pair: pair[0])
    del value
    return best


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
