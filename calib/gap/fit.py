"""Fit a hypothesis to both campaigns at once: mode, curvature and evidence.

Gauss-Newton on the joint posterior of simulator, effect and form errors, with the noise scales
re-estimated between steps. Conditional on the noise the model is close to linear in psi where the
posterior has its mass, so the evidence is Laplace's at first (`refine` mends it where it counts):

    ln Z = ln p(y | psi^, sigma^) + ln p(psi^) + (d/2) ln 2 pi - (1/2) ln |H| + bounds
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import log_ndtr

from calib.gap.ascent import Ascent, Walk, climb, slopes, together
from calib.gap.case import Campaigns
from calib.gap.forward import Forward
from calib.gap.noise import Noise, ln_prior
from calib.gap.residuals import Residuals
from calib.models.base import Array

__all__ = ["Fit", "finish", "fit", "full_fit", "log_joint", "truncated_fit"]

_MAX_STEPS = 40
# Steps of a truncated fit; of one at a discrepancy alone, which predictions are linear in.
_FIRST_STEPS, _LINEAR_STEPS = 3, 1
# How many nats behind the best of several truncated fits one is given up, and within how many
# posterior sds of a better one.
_WORTH, _NEAR = 6.0, 1.5
# Draws whose predictions stay in the processor's cache; more at once take twice as long each.
_AT_ONCE = 1024


@dataclass(frozen=True)
class Fit:
    """The posterior of a hypothesis as a normal about its mode.

    Parameters
    ----------
    forward : Forward
    psi : ndarray, shape (d,)
    covariance : ndarray, shape (d, d)
    noise : mapping of str to Noise
    log_evidence : float
        Laplace's, or that of the draws.
    log_likelihood : float
    field_residuals : mapping of str to ndarray
        Standardised residuals of the field rows of each output.
    sample : ndarray, shape (draws, d), optional
        Draws of the posterior itself, where the normal was not good enough.
    """

    forward: Forward
    psi: Array
    covariance: Array
    noise: Mapping[str, Noise]
    log_evidence: float
    log_likelihood: float
    field_residuals: Mapping[str, Array]
    sample: Array | None = None

    def draws(self, rng: np.random.Generator, size: int) -> Array:
        """Draw psi within its bounds, shape (size, d)."""
        if self.sample is not None:
            # Each draw as often as any other: chance adds nothing to what the sample has already.
            return np.asarray(self.sample[np.resize(rng.permutation(len(self.sample)), size)])
        values, vectors = np.linalg.eigh(self.covariance)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        drawn = self.psi + rng.standard_normal((size, self.psi.size)) @ root.T
        _, _, lower, upper, _ = self.forward.priors._arrays
        return np.clip(drawn, lower, upper)


def truncated_fit(
    data: Campaigns,
    forward: Forward,
    start: Array,
    noise: Mapping[str, Noise],
    *,
    starts: Array | None = None,
    count: int = 1,
    skip: int = 0,
) -> Walk[list[Fit]]:
    """Take the first Gauss-Newton steps of a fit, from one guess or several.

    Parameters
    ----------
    data : Campaigns
    forward : Forward
    start : ndarray, shape (d,)
        First guess, the simulator's part of it fitted to the lab.
    noise : mapping of str to Noise
        First guess.
    starts : ndarray, shape (k, d), optional
        More guesses, screened in one call.
    count : int
        How many of the best guesses, apart from each other, to begin from.
    skip : int
        How many of those to leave out, as begun from before.
    """
    problem = Residuals(data, forward)
    candidates = problem.clip(start)[None]
    if starts is not None:
        candidates = np.concatenate([candidates, problem.clip(starts)])
    raw = yield problem, candidates
    costs = problem.costs(candidates, raw, problem.sds(noise))
    begun = problem.best(costs, candidates, count)[skip:]
    linear = bool(forward.smooth_slices) and not forward.hypothesis.effects
    steps = _LINEAR_STEPS if linear and forward.shift is None else _FIRST_STEPS
    ascents = [Ascent(candidates[i], raw[i], dict(noise)) for i in begun]
    return (yield from _climbed(problem, ascents, steps))


def fit(
    data: Campaigns, forward: Forward, start: Array, noise: Mapping[str, Noise],
    *, starts: Array | None = None, count: int = 1,
) -> Fit:  # fmt: skip
    """Fit a hypothesis, the parameters as for `truncated_fit`."""
    (truncated,) = together(
        [truncated_fit(data, forward, start, noise, starts=starts, count=count)]
    )
    return together([finish(truncated)])[0]


def finish(begun: Sequence[Fit]) -> Walk[Fit]:
    """Fit fully from the truncated fits that are worth it, and keep the most probable mode."""
    ranked = sorted(begun, key=lambda f: -f.log_evidence)
    kept: list[Fit] = []
    for found in ranked:
        worth = found.log_evidence >= ranked[0].log_evidence - _WORTH
        if worth and not any(_near(found, other) for other in kept):
            kept.append(found)
    climbed = yield from full_fit(kept or ranked[:1])
    return max(climbed, key=lambda f: f.log_evidence)


def _near(found: Fit, other: Fit) -> bool:
    """Whether two truncated fits are on the way to the same mode."""
    sd = np.sqrt(np.diag(other.covariance))
    return bool((np.abs(found.psi - other.psi) < _NEAR * sd).all())


def full_fit(begun: Sequence[Fit]) -> Walk[list[Fit]]:
    """Climb from where fits of one hypothesis have stopped to the modes beside them."""
    forward = begun[0].forward
    problem = Residuals(forward.data, forward)
    raw = yield problem, np.stack([f.psi for f in begun])
    ascents = [Ascent(f.psi, r, dict(f.noise)) for f, r in zip(begun, raw, strict=True)]
    return (yield from _climbed(problem, ascents, _MAX_STEPS))


def _climbed(problem: Residuals, ascents: list[Ascent], steps: int) -> Walk[list[Fit]]:
    """Climb from guesses to the modes beside them."""
    if not ascents:
        return []
    yield from climb(problem, ascents, steps)
    slope = yield from slopes(problem, ascents)
    return [
        _laplace(problem, ascent, sds, gradient, hessian)
        for ascent, sds, gradient, hessian in zip(
            ascents, slope.sds, slope.gradient, slope.hessian, strict=True
        )
    ]


def _laplace(
    problem: Residuals, ascent: Ascent, sds: Array, gradient: Array, hessian: Array
) -> Fit:
    """The normal about a mode, and the evidence that it gives."""
    psi, d, n = ascent.psi, ascent.psi.size, sds.size
    residual = ascent.raw / sds
    log_likelihood = (
        -0.5 * float(residual @ residual) - float(np.log(sds).sum()) - 0.5 * n * np.log(2 * np.pi)
    )
    log_prior = float(problem.forward.priors.log_prob(psi[None])[0])
    # A flat direction is as wide as its prior.
    flat = np.where(problem.precision > 0, 0.0, 1.0 / problem.width**2) * 1e-6
    hessian = hessian + np.diag(flat)
    sign, log_det = np.linalg.slogdet(hessian)
    covariance = np.linalg.inv(hessian)
    evidence = log_likelihood + log_prior + 0.5 * d * np.log(2 * np.pi) - 0.5 * log_det
    evidence += _bounds_correction(problem, psi, gradient, covariance)
    evidence += sum(ln_prior(n) for n in ascent.noise.values())
    covariance = _within(problem, covariance)
    n_lab = {o.name: o.problem.response.size for o in problem.data.outputs}
    return Fit(
        problem.forward, psi, covariance, ascent.noise,
        float(evidence) if np.isfinite(evidence) and sign > 0 else -np.inf, log_likelihood,
        {o: residual[part][n_lab[o]:] for o, part in problem.parts.items()},
    )  # fmt: skip


def _within(problem: Residuals, covariance: Array) -> Array:
    """Return a covariance in which no bounded coordinate is wider than between its bounds."""
    sd, bounded = np.sqrt(np.diag(covariance)), 0.5 * (problem.upper - problem.lower)
    shrunk = np.minimum(bounded / sd, 1.0)
    return np.asarray(shrunk[:, None] * covariance * shrunk)


def _bounds_correction(problem: Residuals, psi: Array, gradient: Array, covariance: Array) -> float:
    """Log of the mass of the normal that lies inside the bounds, one coordinate at a time.

    One that is held at a bound has a slope there, which moves its normal beyond it.
    """
    sd = np.sqrt(np.diag(covariance))
    held = problem.blocked(psi[None], -gradient[None])[0]
    total = 0.0
    for i in np.flatnonzero(np.isfinite(problem.lower) | np.isfinite(problem.upper)).tolist():
        slope = float(gradient[i] * sd[i]) if held[i] else 0.0
        low = (problem.lower[i] - psi[i]) / sd[i] + slope
        high = (problem.upper[i] - psi[i]) / sd[i] + slope
        total += 0.5 * slope**2 + _ln_mass(low, high)
    return total


def _ln_mass(low: float, high: float) -> float:
    """Log of the standard normal's mass between two ends."""
    if low + high > 0.0:  # in its other tail, where differences are exact
        low, high = -high, -low
    ln_high = float(log_ndtr(high))
    return ln_high + float(np.log(max(-np.expm1(float(log_ndtr(low)) - ln_high), 1e-300)))


def log_joint(fit: Fit, psi: Array) -> Array:
    """Log likelihood plus log prior at a fit's noise, shape (k, d) to (k,)."""
    problem = Residuals(fit.forward.data, fit.forward)
    sds = problem.sds(fit.noise)
    with np.errstate(all="ignore"):
        prior = fit.forward.priors.log_prob(psi)
        squares = np.full(len(psi), np.inf)
        # Where the prior has no mass nothing need be predicted: of draws from it with heavy tails
        # that is a good part.
        inside = np.flatnonzero(np.isfinite(prior))
        clipped = problem.clip(psi[inside])
        for i in range(0, inside.size, _AT_ONCE):
            raw = problem.raw(clipped[i : i + _AT_ONCE])
            squares[inside[i : i + _AT_ONCE]] = np.square(raw / sds).sum(axis=1)
    constant = np.log(sds).sum() + 0.5 * sds.size * np.log(2.0 * np.pi)
    return np.asarray(prior - 0.5 * squares - constant)
