"""Climb to modes of a hypothesis's posterior: Gauss-Newton from several guesses in step.

The simulator costs as much for one vector of parameters as for a hundred, so that all guesses take
their steps together, and so do hypotheses: a climb is a generator that asks for residuals.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass

import numpy as np

from calib.gap.noise import Noise
from calib.gap.residuals import Residuals, residuals_of_all
from calib.models.base import Array

__all__ = ["Ascent", "Slope", "Walk", "climb", "slopes", "together"]

# Asks for a problem's residuals at some psi (k, d), is sent them (k, N), until it has a result.
type Walk[T] = Generator[tuple[Residuals, Array], Array, T]

# Dampings that are tried at each step, relative to the last that was good.
_DAMPINGS = 10.0 ** np.arange(-1.0, 5.0)
# A step that gains less, in nats, and changes the noise less, is quiet; two of them are the end.
_QUIET_GAIN, _QUIET_NOISE = 1e-3, 1e-2


def together[T](walks: Sequence[Walk[T]]) -> list[T]:
    """Run walks on the same campaigns in step and return their results."""
    results: dict[int, T] = {}
    asked: dict[int, tuple[Residuals, Array]] = {}
    for i, walk in enumerate(walks):
        _go_on(i, walk, None, asked, results)
    while asked:
        answers = residuals_of_all(list(asked.values()))
        asked, before = {}, list(asked)
        for i, raw in zip(before, answers, strict=True):
            _go_on(i, walks[i], raw, asked, results)
    return [results[i] for i in range(len(walks))]


def _go_on[T](
    i: int, walk: Walk[T], raw: Array | None, asked: dict[int, tuple[Residuals, Array]],
    results: dict[int, T],
) -> None:  # fmt: skip
    """Send one walk what it asked for; keep its next question or its result."""
    try:
        asked[i] = next(walk) if raw is None else walk.send(raw)
    except StopIteration as end:
        results[i] = end.value


@dataclass
class Ascent:
    """One guess on its way to the mode beside it.

    Parameters
    ----------
    psi : ndarray, shape (d,)
    raw : ndarray, shape (N,)
        Residuals at psi.
    noise : dict of str to Noise
    """

    psi: Array
    raw: Array
    noise: dict[str, Noise]
    damping: float = 1e-3
    quiet: int = 0


@dataclass(frozen=True)
class Slope:
    """Derivatives of several ascents where they stand.

    Parameters
    ----------
    sds : ndarray, shape (m, N)
        Of the noise.
    scaled : ndarray, shape (m, d, N)
        Derivatives of the residuals over their sds.
    gradient : ndarray, shape (m, d)
        Of the cost, minus the log posterior.
    hessian : ndarray, shape (m, d, d)
        Gauss and Newton's.
    """

    sds: Array
    scaled: Array
    gradient: Array
    hessian: Array


def climb(problem: Residuals, ascents: list[Ascent], steps: int) -> Walk[None]:
    """Climb from each guess to the mode beside it.

    Parameters
    ----------
    problem : Residuals
    ascents : list of Ascent
        Moved in place.
    steps : int
        At most.
    """
    going = ascents
    for _ in range(steps):
        slope = yield from slopes(problem, going)
        gains = yield from _step(problem, going, slope)
        raw = np.stack([a.raw for a in going])
        noises = problem.update_noises(raw, slope.scaled, slope.hessian)
        for ascent, gained, noise in zip(going, gains, noises, strict=True):
            quiet = gained < _QUIET_GAIN and _change(ascent.noise, noise) < _QUIET_NOISE
            ascent.noise, ascent.quiet = noise, ascent.quiet + 1 if quiet else 0
        going = [a for a in going if a.quiet < 2]
        if not going:
            break


def slopes(problem: Residuals, ascents: list[Ascent]) -> Walk[Slope]:
    """Work out the derivatives of ascents where they stand."""
    psi, raw = np.stack([a.psi for a in ascents]), np.stack([a.raw for a in ascents])
    sds = np.stack([problem.sds(a.noise) for a in ascents])
    moved = yield problem, problem.around(psi)
    scaled = problem.jacobian(psi, raw, moved) / sds[:, None]
    with np.errstate(invalid="ignore", over="ignore"):
        gradient = (scaled @ (raw / sds)[:, :, None])[..., 0]
        gradient += (psi - problem.loc) * problem.precision**2
        hessian = scaled @ scaled.swapaxes(1, 2)
    hessian += np.diag(problem.precision**2)
    return Slope(sds, scaled, gradient, hessian)


def _step(problem: Residuals, ascents: list[Ascent], slope: Slope) -> Walk[list[float]]:
    """One Levenberg-Marquardt step of each: several dampings tried in one batched call.

    Returns what each gained; without a step the next dampings are larger.
    """
    psi, raw = np.stack([a.psi for a in ascents]), np.stack([a.raw for a in ascents])
    dampings = np.array([a.damping for a in ascents])[:, None] * _DAMPINGS
    tried = problem.clip(psi[:, None] + _directions(problem, psi, slope, dampings))
    m, t, d = tried.shape
    there = (yield problem, tried.reshape(m * t, d)).reshape(m, t, -1)
    cost = problem.costs(psi, raw, slope.sds)
    costs = problem.costs(tried, there, slope.sds[:, None])
    costs = np.where(np.isfinite(costs), costs, np.inf)
    gains = []
    for i, best in enumerate(costs.argmin(axis=1).tolist()):
        ascent, better = ascents[i], bool(costs[i, best] < cost[i])
        if better:
            ascent.psi, ascent.raw = tried[i, best], there[i, best]
            ascent.damping = max(float(dampings[i, best]), 1e-9)
        else:
            ascent.damping = min(float(dampings[i, -1]) * 10.0, 1e6)
        gains.append(float(cost[i] - costs[i, best]) if better else 0.0)
    return gains


def _directions(problem: Residuals, psi: Array, slope: Slope, dampings: Array) -> Array:
    """Damped steps, shape (m, dampings, d)."""
    # A coordinate that nothing depends on at this point still needs a finite step.
    diagonal = np.diagonal(slope.hessian, axis1=1, axis2=2) + 1e-2 / problem.width**2
    # At a bound, a coordinate that would leave is held there.
    free = ~problem.blocked(psi, -slope.gradient)
    hessian = slope.hessian * (free[:, :, None] & free[:, None])
    added = np.where(free[:, None], dampings[..., None] * diagonal[:, None], 1.0)
    stack = np.repeat(hessian[:, None], dampings.shape[1], axis=1)
    np.einsum("mtii->mti", stack)[...] += added
    gradient = np.where(free, slope.gradient, 0.0)
    return np.asarray(-np.linalg.solve(stack, gradient[:, None, :, None])[..., 0])


def _change(old: dict[str, Noise], new: dict[str, Noise]) -> float:
    """The most that an output's noise has changed."""
    return max(
        float(abs(np.log(new[o].sigma / old[o].sigma)))
        + abs(new[o].rho - old[o].rho)
        + abs(new[o].kappa - old[o].kappa)
        for o in old
    )
