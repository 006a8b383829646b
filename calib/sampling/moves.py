"""Our emcee moves: independent draws from a proposal fitted to the posterior, a walk along it."""

from __future__ import annotations

from typing import Any

import emcee
import numpy as np

from calib.models.base import Array
from calib.sampling.proposal import AnyProposal, Proposal

__all__ = ["IndependenceMove", "WalkMove"]


class IndependenceMove(emcee.moves.Move):  # type: ignore[misc]
    """Metropolis-Hastings with independent proposals from a fitted mixture.

    Every walker is proposed a fresh draw, whatever its position; the acceptance ratio is that of
    the importance weights. Exact for any proposal, fast where the mixture resembles the
    posterior; it is meant to run beside a local move, which still mixes where it does not.

    As a proposal does not depend on where the walkers are, those of many steps are drawn and
    evaluated at once: a batch costs little more than a step's worth.

    Parameters
    ----------
    proposal : Mixture or Proposal
    rng : Generator
        Draws the proposals.
    ahead : int
        Steps whose proposals are evaluated at once. Those left over at the end are wasted.
    """

    def __init__(self, proposal: AnyProposal, rng: np.random.Generator, ahead: int = 16) -> None:
        self.proposal = proposal
        self.rng = rng
        self.ahead = ahead
        self._queue: list[tuple[Array, Array, Array]] = []
        # Where the walkers were last seen, and the proposal's density there.
        self._seen: Array | None = None
        self._log_q = np.empty(0)

    def propose(self, model: Any, state: Any) -> tuple[Any, Array]:
        """Move the walkers; the interface is emcee's.

        Parameters
        ----------
        model : emcee.model.Model
        state : emcee.State

        Returns
        -------
        state : emcee.State
        accepted : ndarray of bool, shape (walkers,)
        """
        walkers = state.coords.shape[0]
        if not self._queue:
            self._refill(model, walkers)
        drawn, log_prob, log_q = self._queue.pop()
        before = self._log_q_at(state.coords)
        ratio = (log_prob - log_q) - (state.log_prob - before)
        accepted = np.log1p(-model.random.rand(walkers)) < ratio
        state.coords[accepted] = drawn[accepted]
        state.log_prob[accepted] = log_prob[accepted]
        self._log_q = np.where(accepted, log_q, before)
        self._seen = state.coords.copy()
        return state, accepted

    def _refill(self, model: Any, walkers: int) -> None:
        drawn, log_q = self.proposal.draw(self.rng, self.ahead * walkers)
        log_prob = model.log_prob_fn(drawn)
        parts = (np.split(a, self.ahead) for a in (drawn, log_prob, log_q))
        self._queue = list(zip(*parts, strict=True))

    def _log_q_at(self, coords: Array) -> Array:
        """Return the proposal's density at the walkers, worked out where they have moved since."""
        if self._seen is None:
            return self.proposal.log_prob(coords)
        moved = (coords != self._seen).any(axis=1)
        if moved.any():
            self._log_q[moved] = self.proposal.log_prob(coords[moved])
        return self._log_q


class WalkMove(emcee.moves.Move):  # type: ignore[misc]
    """A random walk in straightened coordinates: a local move that follows bends and funnels.

    All walkers step at once, each on its own, by a normal as wide as the posterior there times a
    factor drawn anew for each step: long ones cross the bulk, short ones are accepted in corners.

    Parameters
    ----------
    proposal : Proposal
        Whose straightened coordinates they are.
    rng : Generator
    """

    def __init__(self, proposal: Proposal, rng: np.random.Generator) -> None:
        self.straightener = proposal.straightener
        self.cholesky = proposal.mixture.covariance_cholesky()
        self.rng = rng

    def propose(self, model: Any, state: Any) -> tuple[Any, Array]:
        """Move the walkers; the interface is emcee's.

        Parameters
        ----------
        model : emcee.model.Model
        state : emcee.State

        Returns
        -------
        state : emcee.State
        accepted : ndarray of bool, shape (walkers,)
        """
        walkers, d = state.coords.shape
        v, before = self.straightener.straighten(state.coords)
        length = 2.38 / np.sqrt(d) * 0.1 ** self.rng.random((walkers, 1))
        step = self.rng.standard_normal((walkers, d)) @ self.cholesky.T
        t, after = self.straightener.bend(v + length * step)
        log_prob = model.log_prob_fn(t)
        # Densities of v: those of t over the Jacobian |dv/dt|.
        ratio = (log_prob - after) - (state.log_prob - before)
        accepted = np.log1p(-model.random.rand(walkers)) < ratio
        state.coords[accepted] = t[accepted]
        state.log_prob[accepted] = log_prob[accepted]
        return state, accepted
