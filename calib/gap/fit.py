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
from numpy.typing import NDArray
from scipy.special import log_ndtr

from calib.gap.case import Campaigns
from calib.gap.forward import Forward
from calib.gap.noise import Noise, ln_prior, most_probable, noise_at
from calib.models.base import Array
from calib.sampling.mode import prior_widths

__all__ = ["Fit", "climb_on", "finish", "fit", "log_joint", "look"]

# The noise of an output is known beforehand to this factor (sd of its logarithm).
SIGMA_SD_LOG = 1.0
_MAX_STEPS = 40
# Steps of a first look; of one at a discrepancy alone, which predictions are linear in.
_FIRST_STEPS, _LINEAR_STEPS = 3, 1
# How many nats behind the best of several looks one is given up, and within how many posterior sds
# of a better one.
_WORTH, _NEAR = 6.0, 1.5
# Guesses closer than this (in prior sds) climb to the same mode.
_APART = 0.7


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
            return np.asarray(self.sample[rng.integers(self.sample.shape[0], size=size)])
        values, vectors = np.linalg.eigh(self.covariance)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        drawn = self.psi + rng.standard_normal((size, self.psi.size)) @ root.T
        _, _, lower, upper, _ = self.forward.priors._arrays
        return np.clip(drawn, lower, upper)


def look(
    data: Campaigns,
    forward: Forward,
    start: Array,
    noise: Mapping[str, Noise],
    *,
    starts: Array | None = None,
    count: int = 1,
) -> list[Fit]:
    """Take the first steps of a fit, from one guess or several.

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
    """
    problem = _Residuals(data, forward)
    candidates = problem.clip(start)[None]
    if starts is not None:
        candidates = np.concatenate([candidates, problem.clip(starts)])
    begun = problem.best(candidates, noise, count)
    linear = bool(forward.smooth_slices) and not forward.hypothesis.effects
    steps = _LINEAR_STEPS if linear and forward.shift is None else _FIRST_STEPS
    return [_climb(problem, psi, noise, steps) for psi in begun]


def fit(
    data: Campaigns, forward: Forward, start: Array, noise: Mapping[str, Noise],
    *, starts: Array | None = None, count: int = 1,
) -> Fit:  # fmt: skip
    """Fit a hypothesis, the parameters as for `look`."""
    return finish(look(data, forward, start, noise, starts=starts, count=count))


def finish(looks: Sequence[Fit]) -> Fit:
    """Climb on from the first looks that are worth it, and keep the most probable mode."""
    ranked = sorted(looks, key=lambda f: -f.log_evidence)
    kept: list[Fit] = []
    for found in ranked:
        worth = found.log_evidence >= ranked[0].log_evidence - _WORTH
        if worth and not any(_near(found, other) for other in kept):
            kept.append(found)
    return max((climb_on(f) for f in kept or ranked[:1]), key=lambda f: f.log_evidence)


def _near(found: Fit, other: Fit) -> bool:
    """Whether two looks are on the way to the same mode."""
    sd = np.sqrt(np.diag(other.covariance))
    return bool((np.abs(found.psi - other.psi) < _NEAR * sd).all())


def climb_on(found: Fit) -> Fit:
    """Climb from where a fit has stopped to the mode beside it."""
    problem = _Residuals(found.forward.data, found.forward)
    return _climb(problem, found.psi, found.noise, _MAX_STEPS)


def _climb(problem: _Residuals, psi: Array, noise: Mapping[str, Noise], steps: int) -> Fit:
    """Climb from a guess to the mode beside it."""
    noise = dict(noise)
    damping = 1e-3
    raw = problem.raw(psi[None])
    quiet = 0
    for _ in range(steps):
        jacobian, residual = problem.jacobian(psi, noise)
        gradient = jacobian.T @ residual
        hessian = jacobian.T @ jacobian
        cost = float(problem.costs(psi[None], raw, noise)[0])
        step, gained, damping, moved = _step(problem, psi, noise, hessian, gradient, cost, damping)
        if moved is not None:
            psi, raw = problem.clip(psi + step), moved
        new_noise = problem.update_noise(raw, jacobian, hessian)
        changed = max(
            abs(np.log(new_noise[o].sigma / noise[o].sigma))
            + abs(new_noise[o].rho - noise[o].rho)
            + abs(new_noise[o].kappa - noise[o].kappa)
            for o in noise
        )
        noise = new_noise
        quiet = quiet + 1 if gained < 1e-3 and changed < 1e-2 else 0
        if quiet >= 2:
            break
    return problem.finish(psi, noise)


def _step(
    problem: _Residuals, psi: Array, noise: Mapping[str, Noise], hessian: Array, gradient: Array,
    cost: float, damping: float,
) -> tuple[Array, float, float, dict[str, Array] | None]:  # fmt: skip
    """One Levenberg-Marquardt step: several dampings tried in one batched call.

    Returns the step, what it gained, the next damping, and the residuals there (none without a
    step).
    """
    # A coordinate that nothing depends on at this point still needs a finite step.
    diagonal = np.diag(np.diag(hessian) + 1e-2 / problem.width**2)
    dampings = damping * 10.0 ** np.arange(-1.0, 5.0)
    # At a bound, a coordinate that would leave is held there.
    free = ~problem.blocked(psi, -gradient)
    steps = np.zeros((dampings.size, psi.size))
    inner = np.ix_(free, free)
    stack = hessian[inner] + dampings[:, None, None] * diagonal[inner]
    steps[:, free] = -np.linalg.solve(stack, gradient[free][None, :, None])[..., 0]
    steps = problem.clip(psi + steps) - psi
    raw = problem.raw(psi + steps)
    costs = problem.costs(psi + steps, raw, noise)
    best = int(np.nanargmin(np.where(np.isfinite(costs), costs, np.inf)))
    if not costs[best] < cost:
        return np.zeros_like(psi), 0.0, min(dampings[-1] * 10.0, 1e6), None
    at_best = {o: r[best : best + 1] for o, r in raw.items()}
    return steps[best], cost - float(costs[best]), max(dampings[best], 1e-9), at_best


class _Residuals:
    """Standardised residuals of lab, field and prior as functions of psi."""

    def __init__(self, data: Campaigns, forward: Forward) -> None:
        self.data = data
        self.forward = forward
        loc, _, lower, upper, precision = forward.priors._arrays
        self.loc, self.precision = np.where(precision > 0, loc, 0.0), precision
        self.lower, self.upper = lower, upper
        self.width = prior_widths(forward.priors)
        field_at = noise_at(data.view)
        self.at = {o.name: data.lab_at[o.name] + field_at.rows(o.rows) for o in data.outputs}
        self.observed = {
            o.name: np.concatenate([o.problem.response, o.field]) for o in data.outputs
        }

    def clip(self, psi: Array) -> Array:
        margin = 1e-7 * self.width
        return np.clip(psi, self.lower + margin, self.upper - margin)

    def blocked(self, psi: Array, direction: Array) -> NDArray[np.bool_]:
        tiny = 2e-7 * self.width
        return ((psi <= self.lower + tiny) & (direction < 0)) | (
            (psi >= self.upper - tiny) & (direction > 0)
        )

    def raw(self, psi: Array) -> dict[str, Array]:
        """Observed minus predicted of lab then field rows, shapes (k, n)."""
        with np.errstate(all="ignore"):
            lab, field = self.forward.campaigns(psi)
        return {
            o.name: self.observed[o.name]
            - np.concatenate([lab[o.name], field[o.name][:, o.rows]], axis=1)
            for o in self.data.outputs
        }

    def standardised(
        self, psi: Array, raw: Mapping[str, Array], noise: Mapping[str, Noise]
    ) -> Array:
        """All residuals over their sds, the priors' included, shape (k, N)."""
        parts = [r / noise[o].sd(self.at[o]) for o, r in raw.items()]
        parts.append((psi - self.loc) * self.precision)
        return np.concatenate(parts, axis=1)

    def ln_sds(self, noise: Mapping[str, Noise]) -> float:
        return float(sum(np.log(noise[o].sd(at)).sum() for o, at in self.at.items()))

    def costs(self, psi: Array, raw: Mapping[str, Array], noise: Mapping[str, Noise]) -> Array:
        """Minus log posterior but for constants, shape (k,)."""
        r = self.standardised(psi, raw, noise)
        with np.errstate(over="ignore"):  # a cost beyond all numbers is one as well
            return np.asarray(0.5 * np.square(r).sum(axis=1) + self.ln_sds(noise))

    def best(self, candidates: Array, noise: Mapping[str, Noise], count: int) -> list[Array]:
        """Return the best candidates that lie apart from each other."""
        costs = self.costs(candidates, self.raw(candidates), noise)
        picked: list[Array] = []
        for i in np.argsort(np.where(np.isfinite(costs), costs, np.inf), kind="stable"):
            apart = [np.abs((candidates[i] - p) / self.width).max() > _APART for p in picked]
            if all(apart):
                picked.append(candidates[i])
            if len(picked) == count:
                break
        return picked

    def jacobian(self, psi: Array, noise: Mapping[str, Noise]) -> tuple[Array, Array]:
        d = psi.size
        h = 1e-4 * self.width
        sign = np.where(psi + h > self.upper, -1.0, 1.0)
        points = np.concatenate([psi[None], psi + np.diag(sign * h)])
        r = self.standardised(points, self.raw(points), noise)
        r = np.where(np.isfinite(r), r, r[0])
        return ((r[1:] - r[0]) / (sign * h)[:, None]).T.reshape(-1, d), r[0]

    def update_noise(
        self, raw: Mapping[str, Array], jacobian: Array, hessian: Array
    ) -> dict[str, Noise]:
        """Noise scales that maximise the marginal likelihood, parameters allowed for."""
        factor = np.linalg.solve(hessian + np.diag(1e-6 / self.width**2), jacobian.T)
        leverage = np.einsum("nd,dn->n", jacobian, factor)
        updated, start = {}, 0
        for o, r in raw.items():
            n = r.shape[1]
            rows = slice(start, start + n)
            start += n
            # Each residual lost the part of its variance that the parameters took up.
            corrected = np.square(r[0]) / np.clip(1.0 - leverage[rows], 0.1, 1.0)
            updated[o] = most_probable(corrected, self.at[o])
        return updated

    def finish(self, psi: Array, noise: dict[str, Noise]) -> Fit:
        jacobian, residual = self.jacobian(psi, noise)
        hessian = jacobian.T @ jacobian
        gradient = jacobian.T @ residual
        d = psi.size
        n = sum(at.slip.size for at in self.at.values())
        data_part = residual[:n]
        log_likelihood = (
            -0.5 * float(data_part @ data_part) - self.ln_sds(noise) - 0.5 * n * np.log(2 * np.pi)
        )
        log_prior = float(self.forward.priors.log_prob(psi[None])[0])
        # A flat direction is as wide as its prior.
        hessian += np.diag(np.where(self.precision > 0, 0.0, 1.0 / self.width**2) * 1e-6)
        sign, log_det = np.linalg.slogdet(hessian)
        covariance = np.linalg.inv(hessian)
        evidence = log_likelihood + log_prior + 0.5 * d * np.log(2 * np.pi) - 0.5 * log_det
        evidence += self._bounds_correction(psi, gradient, covariance)
        evidence += sum(ln_prior(n) for n in noise.values())
        residuals, start = {}, 0
        for o in self.data.outputs:
            n_lab, n_all = o.problem.response.size, self.at[o.name].slip.size
            residuals[o.name] = data_part[start + n_lab : start + n_all]
            start += n_all
        return Fit(
            self.forward, psi, covariance, noise,
            float(evidence) if np.isfinite(evidence) and sign > 0 else -np.inf,
            log_likelihood, residuals,
        )  # fmt: skip

    def _bounds_correction(self, psi: Array, gradient: Array, covariance: Array) -> float:
        """Mass of the normal that lies inside the bounds, one coordinate at a time."""
        sd = np.sqrt(np.diag(covariance))
        total = 0.0
        for i in range(psi.size):
            low, high = self.lower[i], self.upper[i]
            if not (np.isfinite(low) or np.isfinite(high)):
                continue
            to_low, to_high = (psi[i] - low) / sd[i], (high - psi[i]) / sd[i]
            if min(to_low, to_high) < 0.01:
                # Held at a bound with a slope: a one-sided exponential-normal integral.
                slope = abs(gradient[i]) * sd[i]
                total += min(0.5 * slope**2 + float(log_ndtr(-slope)), 0.0)
            else:
                inside = 1.0 - np.exp(log_ndtr(-to_low)) - np.exp(log_ndtr(-to_high))
                total += float(np.log(max(inside, 1e-6)))
        return total


def log_joint(fit: Fit, psi: Array) -> Array:
    """Log likelihood plus log prior at a fit's noise, shape (k, d) to (k,)."""
    problem = _Residuals(fit.forward.data, fit.forward)
    with np.errstate(all="ignore"):
        prior = fit.forward.priors.log_prob(psi)
        inside = problem.clip(psi)
        squares = [
            np.square(r / fit.noise[o].sd(problem.at[o])).sum(axis=1)
            for o, r in problem.raw(inside).items()
        ]
    n = sum(at.slip.size for at in problem.at.values())
    constant = problem.ln_sds(fit.noise) + 0.5 * n * np.log(2.0 * np.pi)
    return np.asarray(prior - 0.5 * np.sum(squares, axis=0) - constant)
