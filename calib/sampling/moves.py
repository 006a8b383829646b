"""Our emcee move: independent draws from a proposal fitted to the posterior."""

from __future__ import annotations

import emcee
import numpy as np

from calib.models.base import Array
from calib.sampling.proposal import Mixture

__all__ = ["IndependenceMove"]


class IndependenceMove(emcee.moves.MHMove):  # type: ignore[misc]
    """Metropolis-Hastings with independent proposals from a fitted mixture.

    Every walker is proposed a fresh draw, whatever its position; the acceptance ratio is that of
    the importance weights. Exact for any proposal, fast where the mixture resembles the
    posterior; it is meant to run beside a local move, which still mixes where it does not.

    Parameters
    ----------
    proposal : Mixture
    """

    def __init__(self, proposal: Mixture) -> None:
        self.proposal = proposal
        super().__init__(self._propose, ndim=proposal.n_dim)

    def _propose(self, coords: Array, random: np.random.RandomState) -> tuple[Array, Array]:
        drawn = self.proposal.sample(random, coords.shape[0])
        both = self.proposal.log_prob(np.concatenate([coords, drawn]))
        current, new = np.split(both, 2)
        return drawn, current - new
