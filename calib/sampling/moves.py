"""Our emcee moves: opposite pairs from a proposal fitted to the posterior, a walk along it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import emcee
import numpy as np
from numpy.typing import NDArray

from calib.models.base import Array
from calib.sampling.proposal import Proposal

__all__ = ["PairMove", "WalkMove"]


class PairMove(emcee.moves.Move):  # type: ignore[misc]
    """Metropolis-Hastings with opposite pairs of points from a fitted proposal.

    A pair S = {t, t'} is drawn whatever a walker's own pair is, and accepted by the ratio of the
    weights W(S) = (pi(t) + pi(t')) / (q(t) + q(t')), densities in straightened coordinates; the
    walker then stands at either point with the probability that pi gives it. Every second step,
    and wherever a pair was refused, it goes over to its pair's other point with probability
    min(1, pi(t')/pi(t)). Both leave pi as it is (the first is an independence sampler of pairs, the
    second Metropolis within one) and are exact for any proposal.

    Opposite points cancel each other's errors of the mean (antithetic variates), and W varies less
    than pi/q as errors of the proposal that are odd cancel in it. As pairs do not depend on where
    the walkers are, those of many steps are drawn and evaluated at once.

    Parameters
    ----------
    proposal : Proposal
    rng : Generator
        Draws the pairs.
    ahead : int
        Steps, two for each pair, whose points are evaluated at once. Those left over at the end
        are wasted.
    """

    def __init__(self, proposal: Proposal, rng: np.random.Generator, ahead: int = 16) -> None:
        self.proposal = proposal
        self.rng = rng
        self.pairs = max(1, ahead // 2)
        self._queue: list[_Pairs] = []
        self._fresh = False
        # Where the walkers were last seen, and their pairs.
        self._seen: Array | None = None
        self._held: _Pairs

    def propose(self, model: Any, state: Any) -> tuple[Any, Array]:
        """Move the walkers; the interface is emcee's.

        Parameters
        ----------
        model : emcee.model.Model
        state : emcee.State

        Returns
        -------
        state : emcee.State
        moved : ndarray of bool, shape (walkers,)
        """
        held = self._look(model, state)
        walkers = state.coords.shape[0]
        self._fresh = not self._fresh
        moved = np.log1p(-model.random.rand(walkers)) < held.log_odds
        if self._fresh:
            if not self._queue:
                self._refill(model, walkers)
            drawn = self._queue.pop()
            # Not the numbers that decide on the point: the pair is refused whatever they are.
            accepted = np.log1p(-model.random.rand(walkers)) < drawn.log_weight - held.log_weight
            held.flip(np.flatnonzero(moved & ~accepted))
            taken = np.flatnonzero(accepted)
            held.put(drawn.of(taken), taken)
            moved |= accepted
        else:
            held.flip(np.flatnonzero(moved))
        which = np.flatnonzero(moved)
        state.coords[which], state.log_prob[which] = held.here(which)
        self._seen = state.coords.copy()
        return state, moved

    def _refill(self, model: Any, walkers: int) -> None:
        size = self.pairs * walkers
        t, log_jacobian, log_q = self.proposal.draw_pairs(self.rng, size)
        log_prob = model.log_prob_fn(t.reshape(2 * size, -1)).reshape(2, size)
        pairs = _Pairs.between(t, log_prob, log_jacobian, log_q)
        # Log odds are what a logistic number stays below with the odds' probability.
        pairs.flip(np.flatnonzero(self.rng.logistic(size=size) < pairs.log_odds))
        self._queue = [pairs.of(slice(i, i + walkers)) for i in range(0, size, walkers)]

    def _look(self, model: Any, state: Any) -> _Pairs:
        """Return the walkers' pairs, worked out where they have been moved since."""
        if self._seen is None:
            self._held = self._around(model, state.coords, state.log_prob)
            return self._held
        moved = np.flatnonzero((state.coords != self._seen).any(axis=1))
        if moved.size:
            found = self._around(model, state.coords[moved], state.log_prob[moved])
            self._held.put(found, moved)
        return self._held

    def _around(self, model: Any, here: Array, log_prob: Array) -> _Pairs:
        other, log_jacobian, log_q = self.proposal.opposite(here)
        both = np.stack([log_prob, model.log_prob_fn(other)])
        return _Pairs.between(np.stack([here, other]), both, log_jacobian, log_q)


@dataclass(frozen=True)
class _Pairs:
    """A pair for each walker, of which it stands at one point. Its arrays change in place.

    Parameters
    ----------
    points : ndarray, shape (2, k, d)
    log_prob : ndarray, shape (2, k)
    side : ndarray of int, shape (k,)
        Which of the two points the walker stands at.
    log_odds : ndarray, shape (k,)
        Log of the density at the other over that here, in straightened coordinates.
    log_weight : ndarray, shape (k,)
    """

    points: Array
    log_prob: Array
    side: NDArray[np.intp]
    log_odds: Array
    log_weight: Array

    @classmethod
    def between(cls, t: Array, log_prob: Array, log_jacobian: Array, log_q: Array) -> _Pairs:
        """Pair points (2, k, d) whose log densities and Jacobians are (2, k), the first is here."""
        # Densities of v: those of t over the Jacobian |dv/dt|.
        log_pi = log_prob - log_jacobian
        with np.errstate(invalid="ignore"):  # where both densities are zero
            log_odds = log_pi[1] - log_pi[0]
        log_weight = np.logaddexp(log_pi[0], log_pi[1]) - log_q
        return cls(t, log_prob, np.zeros(log_q.size, dtype=np.intp), log_odds, log_weight)

    def here(self, which: NDArray[np.intp]) -> tuple[Array, Array]:
        """Where some of the walkers stand, and the log density there."""
        side = self.side[which]
        return self.points[side, which], self.log_prob[side, which]

    def of(self, which: NDArray[np.intp] | slice) -> _Pairs:
        """Pairs of some of the walkers."""
        return _Pairs(
            self.points[:, which], self.log_prob[:, which], self.side[which],
            self.log_odds[which], self.log_weight[which],
        )  # fmt: skip

    def put(self, other: _Pairs, which: NDArray[np.intp]) -> None:
        """Give some of the walkers other pairs."""
        self.points[:, which], self.log_prob[:, which] = other.points, other.log_prob
        self.side[which] = other.side
        self.log_odds[which], self.log_weight[which] = other.log_odds, other.log_weight

    def flip(self, which: NDArray[np.intp]) -> None:
        """Have some of the walkers go over to the other point."""
        self.side[which] ^= 1
        self.log_odds[which] *= -1.0


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
