"""An independence proposal that knows the posterior: a mixture of Student-t fitted to it.

Curvature at the posterior's mode gives a first Student-t; rounds of adaptive importance sampling
(Cappe et al. 2008, doi:10.1007/s11222-008-9059-x) move it to the posterior's own mean and
covariance. Draws from the result accept with high probability, so a chain of them is nearly as
good as independent draws; the same weights estimate the evidence.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln, logsumexp

from calib.models.base import Array

__all__ = ["Mixture", "StudentT", "adapt", "hessian_scale"]

type LogProb = Callable[[Array], Array]


@dataclass(frozen=True)
class StudentT:
    """A multivariate Student-t.

    Parameters
    ----------
    mean : ndarray, shape (d,)
    cholesky : ndarray, shape (d, d)
        Lower factor of the scale matrix.
    dof : float
        Degrees of freedom.
    """

    mean: Array
    cholesky: Array
    dof: float

    def sample(self, rng: np.random.Generator | np.random.RandomState, size: int) -> Array:
        """Draw, shape (size, d)."""
        normal = rng.standard_normal((size, self.mean.size))
        chi2 = rng.chisquare(self.dof, size) / self.dof
        return self.mean + (normal / np.sqrt(chi2)[:, None]) @ self.cholesky.T

    def log_prob(self, t: Array) -> Array:
        """Log density, shape (k, d) to (k,)."""
        d = self.mean.size
        z = np.linalg.solve(self.cholesky, (t - self.mean).T)
        constant = (
            gammaln(0.5 * (self.dof + d))
            - gammaln(0.5 * self.dof)
            - 0.5 * d * np.log(self.dof * np.pi)
            - np.log(np.diag(self.cholesky)).sum()
        )
        squared = np.einsum("dk,dk->k", z, z)
        return np.asarray(constant - 0.5 * (self.dof + d) * np.log1p(squared / self.dof))


def hessian_scale(log_prob: LogProb, mode: Array, width: Array) -> Array:
    """Covariance of the normal approximation at a mode, by central differences.

    Parameters
    ----------
    log_prob : callable
        ``(k, d) -> (k,)``.
    mode : ndarray, shape (d,)
    width : ndarray, shape (d,)
        A length over which each coordinate matters (its prior sd); the step is found from it.

    Returns
    -------
    ndarray, shape (d, d)
        Positive definite: directions in which the density does not fall are given `width`.
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
    # No direction is wider than its prior allows.
    inverse = (vectors / np.maximum(eigenvalues, 1.0)) @ vectors.T
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


@dataclass(frozen=True)
class Mixture:
    """A mixture of Student-t components.

    Parameters
    ----------
    weights : ndarray, shape (m,)
    components : tuple of StudentT, length m
    """

    weights: Array
    components: tuple[StudentT, ...]

    @property
    def n_dim(self) -> int:
        """Dimension."""
        return int(self.components[0].mean.size)

    def sample(self, rng: np.random.Generator | np.random.RandomState, size: int) -> Array:
        """Draw, shape (size, d)."""
        which = rng.choice(self.weights.size, size=size, p=self.weights)
        drawn = np.empty((size, self.n_dim))
        for j, component in enumerate(self.components):
            mine = which == j
            drawn[mine] = component.sample(rng, int(mine.sum()))
        return drawn

    def log_parts(self, t: Array) -> Array:
        """Log of each weighted component density, shape (m, k)."""
        return np.stack(
            [np.log(w) + c.log_prob(t) for w, c in zip(self.weights, self.components, strict=True)]
        )

    def log_prob(self, t: Array) -> Array:
        """Log density, shape (k, d) to (k,)."""
        return np.asarray(logsumexp(self.log_parts(t), axis=0))


def adapt(
    log_prob: LogProb,
    start: StudentT | Mixture,
    rng: np.random.Generator,
    *,
    size: int = 1500,
    components: int = 4,
) -> tuple[Mixture, float, float]:
    """Fit a mixture of Student-t to a density by adaptive importance sampling.

    Rounds with one component find its location and scale; if that resembles the density, it is
    kept, otherwise components are split off to follow its bends and tails. Of several modes, each
    starts as a component and is split at once.

    Parameters
    ----------
    log_prob : callable
        ``(k, d) -> (k,)``, unnormalised.
    start : StudentT or Mixture
        One component for each known mode.
    rng : Generator
    size : int
        Draws in each round.
    components : int
        Components split off at most.

    Returns
    -------
    Mixture
        The fitted proposal.
    float
        Log evidence, estimated from the last round.
    float
        Effective sample fraction of the last round, in (0, 1].
    """
    proposal = start if isinstance(start, Mixture) else Mixture(np.ones(1), (start,))
    log_evidence, efficiency = -np.inf, 0.0
    split_off = False
    # Several modes are a mixture from the beginning.
    first = 0 if len(proposal.components) == 1 else _SINGLE_ROUNDS
    for stage in range(first, _SINGLE_ROUNDS + _MIXTURE_ROUNDS):
        draws = proposal.sample(rng, size)
        log_weight = log_prob(draws) - proposal.log_prob(draws)
        if not np.isfinite(log_weight).any():
            break
        total = logsumexp(log_weight)
        log_evidence = float(total - np.log(size))
        weight = np.exp(log_weight - total)
        efficiency = float(1.0 / (size * np.square(weight).sum()))
        if stage >= _SINGLE_ROUNDS and efficiency > _GOOD:
            break
        weight = _tempered(weight)
        last_single = _SINGLE_ROUNDS - 1
        if stage < last_single or (stage == last_single and efficiency > _GOOD):
            proposal = _refit_single(proposal, draws, weight)
        elif not split_off:
            proposal = _split(proposal, draws, weight, rng, components)
            proposal = _expectation_maximisation(proposal, draws, weight)
            split_off = True
            size = 2 * size
        else:
            proposal = _expectation_maximisation(proposal, draws, weight)
    return proposal, log_evidence, efficiency


# Rounds with one component, and then with several; a fraction beyond which more are no use.
_SINGLE_ROUNDS, _MIXTURE_ROUNDS, _GOOD = 3, 4, 0.7
_EM_STEPS = 12
_DEFENSIVE = 0.05


def _tempered(weight: Array) -> Array:
    """Flatten weights until enough draws carry them to estimate a covariance."""
    n = weight.size
    for power in (1.0, 0.7, 0.5, 0.35, 0.25, 0.15):
        w = weight**power
        w /= w.sum()
        if 1.0 / np.square(w).sum() >= 0.1 * n:
            return np.asarray(w)
    return np.asarray(w)


def _moments(draws: Array, weight: Array) -> tuple[Array, Array] | None:
    """Weighted mean and Cholesky factor of the covariance; None where it is degenerate."""
    mean = weight @ draws / weight.sum()
    centred = draws - mean
    covariance = (centred * (weight / weight.sum())[:, None]).T @ centred
    scale = np.sqrt(np.diag(covariance))
    if not (np.isfinite(scale).all() and (scale > 0.0).all()):
        return None
    correlation = covariance / np.outer(scale, scale) + 1e-9 * np.eye(mean.size)
    try:
        return mean, scale[:, None] * np.linalg.cholesky(correlation)
    except np.linalg.LinAlgError:
        return None


def _refit_single(proposal: Mixture, draws: Array, weight: Array) -> Mixture:
    """One component of the weighted draws' mean and covariance."""
    # The scale matrix of a Student-t of this covariance would be (dof - 2)/dof of it; keeping the
    # covariance itself covers the tails at little cost.
    found = _moments(draws, weight)
    if found is None:
        return proposal
    return Mixture(np.ones(1), (StudentT(*found, proposal.components[0].dof),))


def _split(
    proposal: Mixture, draws: Array, weight: Array, rng: np.random.Generator, most: int
) -> Mixture:
    """Spread components over the weighted draws, a broad one kept among them for safety."""
    single = _refit_single(proposal, draws, weight).components[0]
    modes = (single,) if len(proposal.components) == 1 else proposal.components
    picked = rng.choice(weight.size, size=most, p=weight)
    # Each is as narrow as the mode to which its centre belongs.
    near = Mixture(np.ones(len(modes)), modes).log_parts(draws[picked]).argmax(axis=0)
    parts = [
        StudentT(draws[i], 0.7 * modes[j].cholesky, single.dof)
        for i, j in zip(picked, near, strict=True)
    ]
    # A mode that no centre was drawn in keeps its own.
    parts += [m for j, m in enumerate(modes) if j not in near]
    weights = np.append(np.full(len(parts), (1.0 - _DEFENSIVE) / len(parts)), _DEFENSIVE)
    broad = StudentT(single.mean, 1.3 * single.cholesky, single.dof)
    return Mixture(weights, (*parts, broad))


def _expectation_maximisation(proposal: Mixture, draws: Array, weight: Array) -> Mixture:
    """Fit the components, all but the last, to weighted draws; dof stay as they are."""
    *parts, broad = proposal.components
    shares = proposal.weights[:-1]
    d = proposal.n_dim
    for _ in range(_EM_STEPS):
        log_parts = Mixture(shares, tuple(parts)).log_parts(draws)
        responsibility = np.exp(log_parts - logsumexp(log_parts, axis=0)) * weight
        new_parts, new_shares = [], []
        for part, r in zip(parts, responsibility, strict=True):
            z = np.linalg.solve(part.cholesky, (draws - part.mean).T)
            # Draws far out in a component's tails weigh little: the Student-t's own weighting.
            u = (part.dof + d) / (part.dof + np.einsum("dk,dk->k", z, z))
            total = float(r.sum())
            if total * weight.size < 5.0 * d:
                continue
            found = _moments(draws, r * u)
            if found is None:
                continue
            mean, cholesky = found
            new_parts.append(
                StudentT(mean, cholesky * np.sqrt(float((r * u).sum()) / total), part.dof)
            )
            new_shares.append(total)
        if not new_parts:
            return proposal
        parts, shares = new_parts, np.array(new_shares) / np.sum(new_shares)
    weights = np.append((1.0 - _DEFENSIVE) * shares, _DEFENSIVE)
    return Mixture(weights, (*parts, broad))
