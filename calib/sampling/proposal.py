"""An independence proposal that resembles a posterior, fitted to weighted draws of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.models.base import Array
from calib.sampling.expectation import fit_mixture, moments
from calib.sampling.mixture import Mixture, StudentT, log_sum
from calib.sampling.straighten import Straightener

__all__ = ["AnyProposal", "Proposal", "fit_proposal"]

_FITTED_DRAWS = 6000
_BROAD_SCALE, _BROAD_DOF = 1.3, 4.0
_LEAST_BROAD, _MOST_BROAD = 0.08, 0.4


@dataclass(frozen=True)
class Proposal:
    """A mixture of Student-t in straightened coordinates, beside a broad one in the plain ones.

    Parameters
    ----------
    straightener : Straightener
    mixture : Mixture
        Of straightened coordinates.
    broad : StudentT
        Of plain coordinates; it covers what the mixture misses.
    share : float
        Of the broad component.
    """

    straightener: Straightener
    mixture: Mixture
    broad: StudentT
    share: float

    @property
    def n_dim(self) -> int:
        """Dimension."""
        return self.mixture.n_dim

    def draw(self, rng: np.random.Generator, size: int) -> tuple[Array, Array]:
        """Draw, and return the log density there, shapes (size, d) and (size,)."""
        v = self.mixture.sample(rng, size)
        t, log_jacobian = self.straightener.bend(v)
        broad = np.flatnonzero(rng.random(size) < self.share)
        t[broad] = self.broad.sample(rng, broad.size)
        v[broad], log_jacobian[broad] = self.straightener.straighten(t[broad])
        return t, self._log_prob(t, v, log_jacobian)

    def log_prob(self, t: Array) -> Array:
        """Log density, shape (k, d) to (k,)."""
        return self._log_prob(t, *self.straightener.straighten(t))

    def _log_prob(self, t: Array, v: Array, log_jacobian: Array) -> Array:
        straight = self.mixture.log_prob(v) + log_jacobian + np.log1p(-self.share)
        broad = self.broad.log_prob(t) + np.log(self.share)
        return log_sum(np.stack([straight, broad]))


type AnyProposal = Mixture | Proposal


def fit_proposal(
    old: AnyProposal,
    draws: Array,
    weight: Array,
    effective: float,
    trust: float,
    rng: np.random.Generator,
) -> AnyProposal:
    """Fit a proposal to weighted draws; return the old one if they are degenerate.

    The less the proposal they came from was to be trusted, the larger the share of the broad
    component.
    """
    whole = moments(draws, weight)
    draws, weight = _resampled(draws, weight, rng, _FITTED_DRAWS)
    try:
        straightener = Straightener.fit(draws, weight)
    except np.linalg.LinAlgError:
        return old
    v, _ = straightener.straighten(draws)
    straight = moments(v, weight)
    if whole is None or straight is None:
        return old
    return Proposal(
        straightener,
        fit_mixture(v, weight, *straight, effective, rng),
        StudentT(whole[0], _BROAD_SCALE * whole[1], _BROAD_DOF),
        _LEAST_BROAD + (_MOST_BROAD - _LEAST_BROAD) * (1.0 - trust) ** 2,
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
