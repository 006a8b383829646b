"""Fit a proposal to the posterior by adaptive importance sampling.

Curvature at the posterior's modes gives a first proposal; rounds of adaptive importance sampling
(Cappe et al. 2008, doi:10.1007/s11222-008-9059-x) fit it to the posterior. Draws from the result
accept with high probability, so a chain of them is nearly as good as independent draws; the same
weights estimate the evidence.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from calib.inference.sampling.mixture import (
    Mixture,
    Straightener,
    StudentT,
    fit_mixture,
    log_sum,
    moments,
)
from calib.models.base import Array

_FITTED_DRAWS = 6000
_BROAD_SCALE, _BROAD_DOF = 1.3, 4.0
_LEAST_BROAD, _MOST_BROAD = 0.08, 0.4
# A mode that seems to have no mass is proposed this often all the same.
_LEAST_SHARE = 0.01


@dataclass(frozen=True)
class Part:
    """A mixture of Student-t in straightened coordinates: what is proposed about one mode."""

    straightener: Straightener
    mixture: Mixture

    def draw(self, rng: np.random.Generator, size: int) -> Array:
        """Draw, shape (size, d)."""
        return self.straightener.bend(self.mixture.sample(rng, size))[0]

    def log_prob(self, t: Array) -> Array:
        """Log density, shape (k, d) to (k,)."""
        v, log_jacobian = self.straightener.straighten(t)
        return self.mixture.log_prob(v) + log_jacobian


@dataclass(frozen=True)
class Proposal:
    """Parts (m), one for each mode, and their weights (m,)."""

    weights: Array
    parts: tuple[Part, ...]

    @property
    def n_dim(self) -> int:
        """Dimension."""
        return self.parts[0].mixture.n_dim

    def draw(self, rng: np.random.Generator, size: int) -> tuple[Array, Array]:
        """Draw, and return the log density there, shapes (size, d) and (size,)."""
        counts = rng.multinomial(size, self.weights)
        drawn = [part.draw(rng, int(n)) for part, n in zip(self.parts, counts, strict=True)]
        t = np.concatenate(drawn)[rng.permutation(size)]
        return t, self.log_prob(t)

    def log_prob(self, t: Array) -> Array:
        """Log density, shape (k, d) to (k,)."""
        return np.asarray(log_sum(self._log_parts(t)))

    def shares(self, t: Array) -> Array:
        """Return how probable it is that each part proposed a point, shape (k, d) to (m, k)."""
        log_parts = self._log_parts(t)
        return np.asarray(np.exp(log_parts - log_sum(log_parts)))

    def extended(self, t: Array) -> Proposal:
        """Return the proposal with one more part, about draws (k, d) that lie beside the others."""
        found = moments(t, np.full(len(t), 1.0 / len(t)))
        if found is None:
            return self
        straight, one = Straightener.identity(self.n_dim), np.ones(1)
        part = Part(straight, Mixture(one, (StudentT(*found, _BROAD_DOF),)))
        share = 1.0 / (len(self.parts) + 1)
        return Proposal(np.append((1.0 - share) * self.weights, share), (*self.parts, part))

    def _log_parts(self, t: Array) -> Array:
        logs = [part.log_prob(t) for part in self.parts]
        return np.log(self.weights)[:, None] + np.stack(logs)


def fit_proposal(
    old: Proposal, draws: Array, weight: Array, worth: float, trust: float, rng: np.random.Generator
) -> Proposal:
    """Fit a proposal to weighted draws (k, d), worth so many independent ones.

    One step of expectation maximisation over the parts: each is fitted to the draws in proportion
    to the probability that it proposed them, and stays as it is where they are degenerate.
    """
    if weight.size > _FITTED_DRAWS:
        draws = draws[systematic(weight, _FITTED_DRAWS, rng)]
        weight = np.full(_FITTED_DRAWS, 1.0 / _FITTED_DRAWS)
    by_part = old.shares(draws) * weight
    mass = by_part.sum(axis=1)
    parts = [
        _fit_part(part, draws, own, total, worth, trust, rng)
        for part, own, total in zip(old.parts, by_part, mass, strict=True)
    ]
    weights = np.maximum(mass, _LEAST_SHARE)
    return Proposal(weights / weights.sum(), tuple(parts))


def first_proposal(parts: Sequence[Mixture]) -> Proposal:
    """Propose each of some mixtures as often, in coordinates that are not straightened."""
    straight = Straightener.identity(parts[0].n_dim)
    equal = np.full(len(parts), 1.0 / len(parts))
    return Proposal(equal, tuple(Part(straight, mixture) for mixture in parts))


def _fit_part(
    old: Part,
    draws: Array,
    weight: Array,
    mass: float,
    worth: float,
    trust: float,
    rng: np.random.Generator,
) -> Part:
    """Fit a part to draws whose weights sum to `mass`.

    A broad component covers what the others miss. The less the proposal that the draws came from
    was to be trusted, the larger is its share.
    """
    effective = worth * mass
    if effective < 2 * draws.shape[1]:
        return old
    weight = weight / mass
    try:
        straightener = Straightener.fit(draws, weight)
    except np.linalg.LinAlgError:
        return old
    v, _ = straightener.straighten(draws)
    straight = moments(v, weight)
    if straight is None:
        return old
    mean, cholesky = straight
    share = _LEAST_BROAD + (_MOST_BROAD - _LEAST_BROAD) * (1.0 - trust) ** 2
    fitted = fit_mixture(v, weight, mean, cholesky, effective, rng)
    broad = StudentT(mean, _BROAD_SCALE * cholesky, _BROAD_DOF)
    return Part(
        straightener,
        Mixture(np.append((1.0 - share) * fitted.weights, share), (*fitted.components, broad)),
    )


def systematic(weight: Array, size: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Draw so many indices in proportion to weights of sum 1, by systematic resampling."""
    levels = (rng.random() + np.arange(size)) / size
    return np.minimum(np.searchsorted(np.cumsum(weight), levels), weight.size - 1)


type LogProb = Callable[[Array], Array]

# Shares, scales and degrees of freedom of the first proposal, about the first guess: the curvature
# at a mode often promises too narrow a posterior.
_FIRST = ((0.6, 1.2, 6.0), (0.25, 2.0, 4.0), (0.15, 4.0, 3.0))
# Draws of each round per dimension plus five, and the efficiency beyond which more are no use.
_ROUNDS, _GOOD = (60, 120, 250, 400), 0.9


@dataclass(frozen=True)
class Guess:
    """A first guess of where a density lies: mean (d,) and Cholesky factor (d, d)."""

    mean: Array
    cholesky: Array


@dataclass(frozen=True)
class Assessment:
    """What importance sampling from a proposal says of it and of the density.

    The log of the density's integral, and the effective fraction of the draws, in (0, 1]; zero if
    the density was zero at all of them.
    """

    log_evidence: float
    efficiency: float


def adapt(
    log_prob: LogProb, guesses: Sequence[Guess], rng: np.random.Generator
) -> tuple[Proposal, Assessment]:
    """Fit a proposal to an unnormalised density ``(k, d) -> (k,)`` by adaptive importance sampling.

    Every round draws from the proposal that all rounds before it made, and ends the work if it
    resembles the density well enough; the assessment is by the last round's draws. There is a guess
    for each mode that is known.
    """
    d = guesses[0].mean.size
    proposal = first_proposal(
        [
            Mixture(
                np.array([share for share, _, _ in _FIRST]),
                tuple(
                    StudentT(guess.mean, scale * guess.cholesky, dof) for _, scale, dof in _FIRST
                ),
            )
            for guess in guesses
        ]
    )
    memory = _Memory()
    for size in _ROUNDS:
        draws, log_q = proposal.draw(rng, size * (d + 5) * len(guesses))
        value = log_prob(draws)
        found = _assess(value - log_q)
        if found.efficiency > _GOOD or found.efficiency == 0.0:
            break
        memory.add(proposal, draws, value)
        draws, weight = memory.weighted()
        weight = _tempered(weight)
        proposal = fit_proposal(proposal, draws, weight, _effective(weight), found.efficiency, rng)
    return proposal, found


def refit(
    log_prob: LogProb,
    old: Proposal,
    draws: Array,
    effective: float,
    rng: np.random.Generator,
) -> tuple[Proposal, Assessment]:
    """Fit a proposal to draws (k, d), worth so many, of a chain that the old one left short."""
    weight = np.full(draws.shape[0], 1.0 / draws.shape[0])
    proposal = fit_proposal(old, draws, weight, effective, 1.0, rng)
    drawn, log_q = proposal.draw(rng, _ROUNDS[-2] * (draws.shape[1] + 5))
    return proposal, _assess(log_prob(drawn) - log_q)


def tempered_moments(draws: Array, log_weight: Array) -> tuple[Array, Array] | None:
    """Mean (d,) and Cholesky factor (d, d) of weighted draws (k, d); None if they are degenerate.

    Log weights (k,) are flattened where few draws carry them.
    """
    total = logsumexp(log_weight)
    if not np.isfinite(total):
        return None
    return moments(draws, _tempered(np.exp(log_weight - total)))


@dataclass
class _Memory:
    """Draws of all rounds, weighted as from the mixture of all their proposals.

    So weighted, draws of early, poor proposals help where they happen to lie well and do no harm
    elsewhere (Cornuet et al. 2012, doi:10.1111/j.1467-9469.2011.00756.x).
    """

    proposals: list[Proposal] = field(default_factory=list)
    sizes: list[int] = field(default_factory=list)
    draws: list[Array] = field(default_factory=list)
    log_probs: list[Array] = field(default_factory=list)

    def add(self, proposal: Proposal, draws: Array, log_prob: Array) -> None:
        """Remember a round."""
        possible = np.isfinite(log_prob)
        self.proposals.append(proposal)
        self.sizes.append(draws.shape[0])
        self.draws.append(draws[possible])
        self.log_probs.append(log_prob[possible])

    def weighted(self) -> tuple[Array, Array]:
        """Return all draws (k, d), and their normalised weights (k,)."""
        draws = np.concatenate(self.draws)
        log_q = np.stack(
            [np.log(n) + q.log_prob(draws) for n, q in zip(self.sizes, self.proposals, strict=True)]
        )
        log_weight = np.concatenate(self.log_probs) - log_sum(log_q)
        weight = np.exp(log_weight - log_weight.max())
        return draws, weight / weight.sum()


def _assess(log_weight: Array) -> Assessment:
    if not np.isfinite(log_weight).any():
        return Assessment(-np.inf, 0.0)
    total = float(logsumexp(log_weight))
    weight = np.exp(log_weight - total)
    n = log_weight.size
    return Assessment(total - float(np.log(n)), float(1.0 / (n * np.square(weight).sum())))


def _tempered(weight: Array) -> Array:
    """Flatten weights until enough draws carry them to estimate a covariance."""
    n = weight.size
    for power in (1.0, 0.7, 0.5, 0.35, 0.25, 0.15):
        w = weight**power
        w /= w.sum()
        if 1.0 / np.square(w).sum() >= min(0.1 * n, 300.0):
            return np.asarray(w)
    return np.asarray(w)


def _effective(weight: Array) -> float:
    return float(1.0 / np.square(weight).sum())
