"""Fit a hypothesis to both campaigns at once: mode, curvature and evidence.

Gauss-Newton on the joint posterior of simulator, effect and form errors, with the noise scales
re-estimated between steps. Conditional on the noise the model is close to linear in psi where the
posterior has its mass, so the evidence is Laplace's at first (`refine` mends it where it counts):

    ln Z = ln p(y | psi^, sigma^) + ln p(psi^) + (d/2) ln 2 pi - (1/2) ln |H| + bounds + averaging

where averaging over the noise lifts it (`calib.gap.noise.ln_averaging`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import log_ndtr

from calib.gap.forward import Forward
from calib.gap.gauss_newton import (
    FIRST_STEPS,
    Batch,
    Iterate,
    Residuals,
    Slope,
    batches,
    diagonal,
    gauss_newton,
    residuals_of_all,
    slopes,
    variance_left,
)
from calib.gap.noise import Noise, ln_averaging, ln_prior
from calib.models.base import Array


@dataclass(frozen=True)
class Fit:
    """The posterior of a hypothesis as a normal about its mode.

    Parameters
    ----------
    psi : ndarray, shape (d,)
    covariance : ndarray, shape (d, d)
    log_evidence : float
        Laplace's, or that of the draws.
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
        try:
            # Which is one matrix; signs of eigenvectors are another on another processor.
            root = np.linalg.cholesky(self.covariance)
        except np.linalg.LinAlgError:
            values, vectors = np.linalg.eigh(self.covariance)
            root = vectors * np.sqrt(np.maximum(values, 0.0))
        drawn = self.psi + rng.standard_normal((size, self.psi.size)) @ root.T
        _, _, lower, upper, _ = self.forward.priors._arrays
        return np.clip(drawn, lower, upper)


@dataclass(frozen=True)
class Start:
    """Where a fit of a hypothesis begins.

    Parameters
    ----------
    guesses : ndarray, shape (k, d)
    noise : mapping of str to Noise
        First guess.
    count : int
        How many of the best guesses, apart from each other, to begin from.
    """

    forward: Forward
    guesses: Array
    noise: Mapping[str, Noise]
    count: int = 1


def truncated_fits(starts: Sequence[Start]) -> list[list[Fit]]:
    """Take the first Gauss-Newton steps of fits on the same campaigns."""
    problems = [Residuals(start.forward.data, start.forward) for start in starts]
    asked = [(p, p.clip(start.guesses)) for p, start in zip(problems, starts, strict=True)]
    iterates = []
    for start, (problem, psi), raw in zip(starts, asked, residuals_of_all(asked), strict=True):
        costs = problem.costs(psi, raw, problem.sds(start.noise))
        begun = problem.best(costs, psi, start.count)
        forward, noise = start.forward, dict(start.noise)
        linear = forward.smooth_slices and not forward.hypothesis.effects and forward.shift is None
        # Predictions are linear in a discrepancy: its noise is known after the second step.
        steps = 2 if linear else FIRST_STEPS
        iterates.append([Iterate(problem, psi[i], raw[i], noise, steps) for i in begun])
    return _climbed(iterates)


def fit(forward: Forward, start: Array, noise: Mapping[str, Noise]) -> Fit:
    """Fit one hypothesis from one guess, shape (d,)."""
    return finished(truncated_fits([Start(forward, start[None], noise)]))[0]


def finished(begun: Sequence[Sequence[Fit]]) -> list[Fit]:
    """Fit fully from the truncated fits of each hypothesis that are worth it; keep the best."""
    climbed = full_fits([_worth(group) for group in begun])
    return [max(group, key=lambda f: f.log_evidence) for group in climbed]


def _worth(begun: Sequence[Fit]) -> list[Fit]:
    """Truncated fits of a hypothesis that may end at its best mode, one for each mode."""
    ranked = sorted(begun, key=lambda f: -f.log_evidence)
    kept: list[Fit] = []
    for found in ranked:
        worth = found.log_evidence >= ranked[0].log_evidence - 6.0
        if worth and not any(_near(found, other) for other in kept):
            kept.append(found)
    return kept or ranked[:1]


def _near(found: Fit, other: Fit) -> bool:
    """Whether two truncated fits are on the way to the same mode."""
    sd = np.sqrt(np.diag(other.covariance))
    return bool((np.abs(found.psi - other.psi) < 1.5 * sd).all())


def full_fits(begun: Sequence[Sequence[Fit]]) -> list[list[Fit]]:
    """Climb from where fits of each hypothesis have stopped to the modes beside them."""
    problems = [Residuals(group[0].forward.data, group[0].forward) for group in begun]
    asked = [
        (p, np.stack([f.psi for f in group])) for p, group in zip(problems, begun, strict=True)
    ]
    return _climbed(
        [
            [Iterate(p, f.psi, r, dict(f.noise), 40) for f, r in zip(group, raw, strict=True)]
            for p, group, raw in zip(problems, begun, residuals_of_all(asked), strict=True)
        ]
    )


def _climbed(iterates: Sequence[Sequence[Iterate]]) -> list[list[Fit]]:
    """Climb from guesses at several hypotheses to the modes beside them."""
    everyone = [a for group in iterates for a in group]
    gauss_newton(everyone)
    found: dict[Iterate, Fit] = {}
    for batch in batches(everyone):
        found |= zip(batch.iterates, _laplace(batch, slopes(batch, batch.kept())), strict=True)
    return [[found[a] for a in group] for group in iterates]


def _laplace(batch: Batch, slope: Slope) -> list[Fit]:
    """The normals about modes, and the evidence that they give."""
    # A flat direction is as wide as its prior.
    flat = np.where(batch.precision > 0, 0.0, 1.0 / batch.width**2) * 1e-6
    hessian = slope.hessian + diagonal(flat)
    sign, log_det = np.linalg.slogdet(hessian)
    inverse = np.linalg.inv(hessian)
    residual = batch.raw / slope.sds
    log_likelihood = -0.5 * (
        np.square(residual).sum(axis=1)
        + 2.0 * np.log(slope.sds).sum(axis=1)
        + residual.shape[1] * np.log(2.0 * np.pi)
    )
    left, at = variance_left(slope.scaled, inverse), batch.data.at_rows
    averaging = np.sum(
        [ln_averaging(batch.raw[:, p], left[:, p], at[o]) for o, p in batch.parts.items()], axis=0
    )
    n_lab = {o.name: o.problem.response.size for o in batch.data.outputs}
    fits = []
    for i, iterate in enumerate(batch.iterates):
        problem, psi, d = iterate.problem, iterate.psi, iterate.psi.size
        covariance = inverse[i, :d, :d]
        evidence = float(log_likelihood[i] + problem.forward.priors.log_prob(psi[None])[0])
        evidence += 0.5 * d * np.log(2.0 * np.pi) - 0.5 * float(log_det[i])
        evidence += _bounds_correction(problem, psi, slope.gradient[i, :d], covariance)
        evidence += sum(ln_prior(n) for n in iterate.noise.values()) + float(averaging[i])
        field = {o: residual[i, part][n_lab[o] :] for o, part in batch.parts.items()}
        fits.append(
            Fit(
                problem.forward,
                psi,
                _within(problem, covariance),
                iterate.noise,
                evidence if np.isfinite(evidence) and sign[i] > 0 else -np.inf,
                float(log_likelihood[i]),
                field,
            )
        )
    return fits


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
    bounded = np.isfinite(problem.lower) | np.isfinite(problem.upper)
    held = problem.blocked(psi[None], -gradient[None])[0]
    slope = np.where(held, gradient * sd, 0.0)[bounded]
    low, high = (
        (end - psi)[bounded] / sd[bounded] + slope for end in (problem.lower, problem.upper)
    )
    return float((0.5 * slope**2 + _ln_mass(low, high)).sum())


def _ln_mass(low: Array, high: Array) -> Array:
    """Log of the standard normal's mass between two ends."""
    # In its lower tail, where differences are exact.
    swap = low + high > 0.0
    low, high = np.where(swap, -high, low), np.where(swap, -low, high)
    ln_low, ln_high = log_ndtr(low), log_ndtr(high)
    return np.asarray(ln_high + np.log(np.maximum(-np.expm1(ln_low - ln_high), 1e-300)))
