"""A proposal that resembles a posterior, fitted to weighted draws of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.inference.sampling.expectation import fit_mixture, moments
from calib.inference.sampling.mixture import Mixture, StudentT, log_sum
from calib.inference.sampling.straighten import Straightener
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
