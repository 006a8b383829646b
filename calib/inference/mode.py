"""Find the modes of a posterior by many ascents, and the curvature at each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr, ndtri

from calib.inference.priors import Priors
from calib.inference.random import even_points
from calib.models.base import Array

type LogProb = Callable[[Array], Array]


def climb(
    log_prob: LogProb, starts: Array, width: Array, lower: Array, upper: Array, *,
    steps: int = 60, tolerance: float = 1e-7,
) -> tuple[Array, Array]:  # fmt: skip
    """Climb from every start (m, d) to a local maximum, by SciPy's L-BFGS-B.

    Parameters
    ----------
    log_prob : callable
        ``(k, d) -> (k,)``; ``-inf`` where it is not allowed.
    width : ndarray, shape (d,)
        A length over which each coordinate matters (its prior sd).
    tolerance : float
        Relative gain in log density below which an ascent ends.

    Returns
    -------
    ends : ndarray, shape (m, d)
    heights : ndarray, shape (m,)
        Log densities there.
    """
    from scipy.optimize import minimize  # late: a tenth of a second

    low, high = lower / width, upper / width
    step = 1e-5 * np.eye(width.size)
    ends, heights = np.clip(starts, lower, upper), np.empty(len(starts))

    for i, start in enumerate(ends):
        heights[i] = log_prob(start[None])[0]
        if not np.isfinite(heights[i]):
            continue

        def cost(z: Array, wall: float = 1e3 - heights[i]) -> tuple[float, Array]:
            """Minus the log density and its gradient, one-sided at bounds and forbidden ground."""
            ahead, behind = np.minimum(z + step, high), np.maximum(z - step, low)
            value = -log_prob(np.concatenate([z[None], ahead, behind]) * width)
            f, sides = value[0], value[1:].reshape(2, -1)
            if not np.isfinite(f):
                return wall, np.zeros_like(z)
            allowed = np.isfinite(sides)
            span = np.stack([np.diagonal(ahead), np.diagonal(behind)]) - z
            span, sides = np.where(allowed, span, 0.0), np.where(allowed, sides, f)
            return f, (sides[0] - sides[1]) / np.maximum(span[0] - span[1], 1e-12)

        found = minimize(
            cost, start / width, jac=True, method="L-BFGS-B", bounds=np.stack([low, high], axis=1),
            options={"maxiter": steps, "ftol": tolerance, "gtol": 1e-6},
        )  # fmt: skip
        if -found.fun > heights[i]:
            ends[i], heights[i] = found.x * width, -found.fun
    return ends, heights


def hessian_scale(log_prob: LogProb, mode: Array, width: Array) -> Array:
    """Covariance (d, d) of the normal approximation at a mode (d,), by central differences.

    The step along each axis lowers the log density by at most a half. No direction is wider than
    `width` (d,), a length over which each coordinate matters (its prior sd).
    """
    sizes = 2.0 ** -np.arange(24.0)
    axes = (sizes[:, None, None] * np.diag(width)).reshape(-1, mode.size)
    value = log_prob(np.concatenate([mode[None], mode + axes, mode - axes]))
    lowest = value[1:].reshape(2, sizes.size, -1).min(axis=0)
    small = np.nan_to_num(value[0] - lowest, nan=np.inf) <= 0.5
    first = np.where(small.any(axis=0), small.argmax(axis=0), sizes.size - 1)
    step = sizes[first] * width
    i, j = np.tril_indices(mode.size)
    a, b = np.diag(step)[i], np.diag(step)[j]
    corners = log_prob(mode + np.concatenate([a + b, a - b, b - a, -a - b]))
    corners = np.where(np.isfinite(corners), corners, value[0] - 10.0).reshape(4, -1)
    hessian = np.empty((mode.size, mode.size))
    difference = corners[0] - corners[1] - corners[2] + corners[3]
    hessian[i, j] = hessian[j, i] = difference / (4.0 * step[i] * step[j])
    eigenvalues, vectors = np.linalg.eigh(-hessian * np.outer(width, width))
    # A direction so narrow that rounding hides it is given the least width that it can show.
    inverse = (vectors / np.clip(eigenvalues, 1.0, 1e13)) @ vectors.T
    return np.asarray(inverse * np.outer(width, width))


def prior_widths(priors: Priors) -> Array:
    """Prior standard deviation (uniform: a quarter of the range) of each free parameter, (d,)."""
    scale = np.array([p.scale for p in priors.free])
    lower, upper = _bounds(priors)
    return np.where(np.isfinite(scale), scale, 0.25 * (upper - lower))


def find_mode(log_prob: LogProb, priors: Priors) -> Array:
    """Return the highest mode of a posterior ``(k, d) -> (k,)``, shape (d,).

    The best of each of eight groups of points that fill the prior evenly, the same for every seed,
    climbs; the highest is then followed to its end.
    """
    width, bounds = prior_widths(priors), _bounds(priors)
    groups = priors.ppf(even_points(400, width.size)).reshape(8, 50, -1)
    best = log_prob(groups.reshape(400, -1)).reshape(8, 50).argmax(axis=1)
    ends, values = climb(log_prob, groups[np.arange(8), best], width, *bounds)
    highest = ends[[values.argmax()]]
    found, _ = climb(log_prob, highest, width, *bounds, steps=300, tolerance=1e-13)
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
        return squared < 4.0 * max(self.log_prob - log_prob, 0.0) + 25.0


def find_modes(
    log_prob: LogProb, priors: Priors, rng: np.random.Generator, *,
    starts: Array | None = None, spread: int = 64,
) -> list[Mode]:  # fmt: skip
    """Return the modes of a posterior ``(k, d) -> (k,)`` that were found, the highest first.

    The given starts (m, d) and `spread` points, half of them spread evenly over the prior and half
    over one three times as wide, climb each by itself: a mode is found from any point on its
    slopes, however much higher another is.
    """
    width, bounds = prior_widths(priors), _bounds(priors)
    begun = [np.empty((0, width.size)) if starts is None else np.atleast_2d(starts)]
    if spread:
        u = (even_points(spread, width.size) + rng.random(width.size)) % 1.0
        u[::2] = ndtr(3.0 * ndtri(u[::2]))
        begun.append(priors.ppf(np.clip(u, 1e-12, 1.0 - 1e-12)))
    ends, values = climb(log_prob, np.concatenate(begun), width, *bounds)
    if not np.isfinite(values).any():  # the caller will see
        return [Mode(ends[0], -np.inf, np.diag(width**2))]
    modes: list[Mode] = []
    negligible = 15.0  # nats below the highest mode, where no mass is
    for i in np.argsort(-values):
        t, value = ends[i], float(values[i])
        if values.max() - value > negligible or any(m.explains(t, value) for m in modes):
            continue
        # A posterior may be a million times narrower than its prior.
        near = np.sqrt(np.diag(hessian_scale(log_prob, t, width)))
        top, high = climb(log_prob, t[None], near, *bounds, steps=300, tolerance=1e-13)
        if not any(m.explains(top[0], float(high[0])) for m in modes):
            modes.append(Mode(top[0], float(high[0]), hessian_scale(log_prob, top[0], width)))
    return sorted(modes, key=lambda mode: -mode.log_prob)


def _bounds(priors: Priors) -> tuple[Array, Array]:
    return np.array([p.lower for p in priors.free]), np.array([p.upper for p in priors.free])
