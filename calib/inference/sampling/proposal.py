"""A proposal that resembles a posterior, fitted to weighted draws of it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from calib.inference.sampling.expectation import fit_mixture, moments
from calib.inference.sampling.mixture import Mixture, StudentT
from calib.inference.sampling.straighten import Straightener
from calib.models.base import Array

_FITTED_DRAWS = 6000
_BROAD_SCALE, _BROAD_DOF = 1.3, 4.0
_LEAST_BROAD, _MOST_BROAD = 0.08, 0.4


@dataclass(frozen=True)
class Proposal:
    """A mixture of Student-t in straightened coordinates.

    Its draws come alone or in opposite pairs. Points t and t' are opposite if their straightened
    coordinates v and v' = 2 c - v are, about the mixture's mean c; either is the other's. Of a pair
    the density is the mean of the mixture's at its two points.
    """

    straightener: Straightener
    mixture: Mixture

    @property
    def n_dim(self) -> int:
        """Dimension."""
        return self.mixture.n_dim

    @cached_property
    def _centre(self) -> Array:
        return self.mixture.mean()

    def draw(self, rng: np.random.Generator, size: int) -> tuple[Array, Array]:
        """Draw, and return the log density there, shapes (size, d) and (size,)."""
        v = self.mixture.sample(rng, size)
        t, log_jacobian = self.straightener.bend(v)
        return t, self.mixture.log_prob(v) + log_jacobian

    def log_prob(self, t: Array) -> Array:
        """Log density, shape (k, d) to (k,)."""
        v, log_jacobian = self.straightener.straighten(t)
        return self.mixture.log_prob(v) + log_jacobian

    def draw_pairs(self, rng: np.random.Generator, size: int) -> tuple[Array, Array, Array]:
        """Draw opposite pairs, shape (2, size, d).

        With the log of |dv/dt| at each, (2, size), and the log density of each pair, (size,), in
        straightened coordinates.
        """
        v = self.mixture.sample(rng, size)
        both = np.concatenate([v, 2.0 * self._centre - v])
        t, log_jacobian = self.straightener.bend(both)
        log_q = self.mixture.log_prob_symmetric(v, self._centre)
        return t.reshape(2, size, -1), log_jacobian.reshape(2, size), log_q

    def opposite(self, t: Array) -> tuple[Array, Array, Array]:
        """Find the points opposite to some, (k, d) to (k, d).

        With the log of |dv/dt| at both, (2, k), and the log density of each pair, (k,).
        """
        v, here = self.straightener.straighten(t)
        other, there = self.straightener.bend(2.0 * self._centre - v)
        return other, np.stack([here, there]), self.mixture.log_prob_symmetric(v, self._centre)


def fit_proposal(
    old: Proposal,
    draws: Array,
    weight: Array,
    effective: float,
    trust: float,
    rng: np.random.Generator,
) -> Proposal:
    """Fit a proposal to weighted draws; return the old one if they are degenerate.

    A broad component covers what the others miss. The less the proposal that the draws came from
    was to be trusted, the larger is its share.
    """
    draws, weight = _resampled(draws, weight, rng, _FITTED_DRAWS)
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
    return Proposal(
        straightener,
        Mixture(np.append((1.0 - share) * fitted.weights, share), (*fitted.components, broad)),
    )


def _resampled(
    draws: Array, weight: Array, rng: np.random.Generator, most: int
) -> tuple[Array, Array]:
    """Thin weighted draws to a bounded number of equally weighted ones (systematic resampling)."""
    if weight.size <= most:
        return draws, weight
    levels = (rng.random() + np.arange(most)) / most
    picked = np.minimum(np.searchsorted(np.cumsum(weight), levels), weight.size - 1)
    return draws[picked], np.full(most, 1.0 / most)
