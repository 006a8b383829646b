"""Find the modes of a posterior from point estimates and prior draws."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr, ndtri

from calib.inference.even import even_points
from calib.inference.priors import Priors
from calib.inference.sampling.climb import climb
from calib.inference.sampling.curvature import hessian_scale
from calib.models.base import Array

_WORST = 1e12
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
        if value <= -_WORST:
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
