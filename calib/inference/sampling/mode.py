"""Find the modes of a posterior from point estimates and prior draws."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from calib.inference.even import even_points
from calib.inference.priors import Priors
from calib.inference.sampling.climb import climb
from calib.inference.sampling.curvature import hessian_scale
from calib.models.base import Array

_WORST = 1e12
_MOST_POLISHED = 6
# Where `find_mode` looks, and from how many points it climbs.
_SCREENED, _CLIMBED = 400, 8
# Steps, and what gains too little for another (nats), of the last of its ascents.
_TO_THE_END, _AT_THE_END = 300, 1e-8
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
    n_screen: int = 400,
    n_climb: int = 16,
) -> list[Mode]:
    """Return the modes of a posterior ``(k, d) -> (k,)`` that were found, the highest first.

    The given starts (m, d) and the best of each of `n_climb` groups of prior draws climb together,
    a batch of quasi-Newton ascents; if none are screened, only the given starts climb. The highest
    is polished by L-BFGS-B, with gradients by central differences; so is each of the others that
    neither lies in its neighbourhood nor far below it. A sampler that knows one mode only may miss
    another whatever its own diagnostics say.
    """
    return _climbed(log_prob, priors, _starts(log_prob, priors, rng, starts, n_screen, n_climb))


def _climbed(log_prob: Callable[[Array], Array], priors: Priors, starts: Array) -> list[Mode]:
    """Modes that are found from some starts, the highest first."""
    width = prior_widths(priors)
    ends, values = climb(log_prob, starts, width, *_bounds(priors))
    modes: list[Mode] = []
    polished = 0
    for i in np.argsort(-values):
        t, value = ends[i], float(values[i])
        if polished == _MOST_POLISHED or (
            modes
            and (
                modes[0].log_prob - value > _NEGLIGIBLE or any(m.explains(t, value) for m in modes)
            )
        ):
            continue
        top, end = _polish(log_prob, t, priors)
        polished += 1
        if top <= -_WORST:
            # Nowhere is the density positive: the caller will see.
            modes.append(Mode(end, -np.inf, np.diag(width**2)))
        elif not any(m.explains(end, top) for m in modes):
            modes.append(Mode(end, top, hessian_scale(log_prob, end, width)))
    return sorted(modes, key=lambda mode: -mode.log_prob)


def _starts(
    log_prob: Callable[[Array], Array],
    priors: Priors,
    rng: np.random.Generator,
    starts: Array | None,
    n_screen: int,
    n_climb: int,
) -> Array:
    if starts is not None and n_screen == 0:
        return np.atleast_2d(starts)
    picked = _best_of_each(log_prob, priors.sample(rng, n_screen), n_climb)
    return picked if starts is None else np.concatenate([np.atleast_2d(starts), picked])


def _best_of_each(log_prob: Callable[[Array], Array], pool: Array, count: int) -> Array:
    """The best of each of so many groups: the best of all may share one basin."""
    value = log_prob(pool)
    groups = np.array_split(np.arange(len(pool)), count)
    return pool[[group[value[group].argmax()] for group in groups]]


def _bounds(priors: Priors) -> tuple[Array, Array]:
    return np.array([p.lower for p in priors.free]), np.array([p.upper for p in priors.free])


def _polish(
    log_prob: Callable[[Array], Array], start: Array, priors: Priors
) -> tuple[float, Array]:
    from scipy.optimize import minimize  # late: a tenth of a second, and few commands polish

    d, width = start.size, prior_widths(priors)
    step = 1e-5
    directions = np.concatenate([np.zeros((1, d)), step * np.eye(d), -step * np.eye(d)])
    low, high = ((bound - start) / width for bound in _bounds(priors))

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
