"""Our emcee moves: opposite pairs from a proposal fitted to the posterior, a walk along it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import emcee
import numpy as np
from numpy.typing import NDArray

from calib.inference.sampling.proposal import Proposal
from calib.models.base import Array


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
    the walkers are, those of many steps are drawn and evaluated at once, and what the walkers do
    with them is worked out ahead, as long as no other move carries one off.

    Parameters
    ----------
    rng : Generator
        Draws the pairs.
    ahead : int
        Steps, two for each pair, whose points are evaluated at once. Those left over at the end
        are wasted.
    every : int
        Steps with pairs between two of the walk's.
    """

    def __init__(
        self,
        proposal: Proposal,
        rng: np.random.Generator,
        ahead: int = 16,
        *,
        walk: WalkMove | None = None,
        every: int = 32,
    ) -> None:
        self.proposal = proposal
        self.rng = rng
        self.pairs = max(1, ahead // 2)
        self.walk, self.every = walk, every
        self._since_walk = 0
        self._steps: _Steps | None = None

    def propose(self, model: Any, state: Any) -> tuple[Any, Array]:
        """Move the walkers, and say which moved, shape (walkers,); the interface is emcee's."""
        if self.walk is not None and self._since_walk == self.every:
            self._since_walk = 0
            return self.walk.propose(model, state)
        self._since_walk += 1
        steps = self._steps
        if steps is None:
            held = self._around(model, state.coords, state.log_prob)
            self._steps = steps = self._ahead(model, held, None)
        else:
            elsewhere = state.coords != steps.here
            if elsewhere.any():
                moved = np.flatnonzero(elsewhere.any(axis=1))
                held = steps.held()
                held.put(self._around(model, state.coords[moved], state.log_prob[moved]), moved)
                self._steps = steps = self._ahead(model, held, steps.left())
            elif steps.done == len(steps.moved):
                self._steps = steps = self._ahead(model, steps.held(), None)
        return steps.take(state)

    def _ahead(self, model: Any, held: _Pairs, new: _Pairs | None) -> _Steps:
        """Work out the next steps, with pairs that are left or, without any, new ones."""
        if new is None:
            size = self.pairs * held.side.size
            t, log_jacobian, log_q = self.proposal.draw_pairs(self.rng, size)
            log_prob = model.log_prob_fn(t.reshape(2 * size, -1)).reshape(2, size)
            new = _Pairs.between(t, log_prob, log_jacobian, log_q)
            # Log odds are what a logistic number stays below with the odds' probability.
            new.side[:] = self.rng.logistic(size=size) < new.log_odds
        return _Steps.work_out(held, new, model.random)

    def _around(self, model: Any, here: Array, log_prob: Array) -> _Pairs:
        other, log_jacobian, log_q = self.proposal.opposite(here)
        both = np.stack([log_prob, model.log_prob_fn(other)])
        return _Pairs.between(np.stack([here, other]), both, log_jacobian, log_q)


@dataclass(frozen=True)
class _Pairs:
    """Opposite pairs, points (2, k, d), and at which of them (k,) a walker stands or would stand.

    Log odds are of the density at the second over that at the first, in straightened coordinates.
    """

    points: Array
    log_prob: Array
    side: NDArray[np.intp]
    log_odds: Array
    log_weight: Array

    @classmethod
    def between(cls, t: Array, log_prob: Array, log_jacobian: Array, log_q: Array) -> _Pairs:
        """Pair points (2, k, d) whose log densities and Jacobians are (2, k), at the first."""
        # Densities of v: those of t over the Jacobian |dv/dt|.
        log_pi = log_prob - log_jacobian
        with np.errstate(invalid="ignore"):  # where both densities are zero
            log_odds = log_pi[1] - log_pi[0]
        # The log of the sum, by functions that work on many numbers at once.
        log_weight = np.maximum(log_pi[0], log_pi[1])
        some = log_weight > -np.inf
        log_weight += np.log1p(np.exp(-np.abs(log_odds)), where=some, out=np.zeros(some.size))
        log_weight -= log_q
        return cls(t, log_prob, np.zeros(log_q.size, dtype=np.intp), log_odds, log_weight)

    def of(self, which: NDArray[np.intp] | slice) -> _Pairs:
        """Some of the pairs."""
        return _Pairs(
            self.points[:, which], self.log_prob[:, which], self.side[which],
            self.log_odds[which], self.log_weight[which],
        )  # fmt: skip

    def put(self, other: _Pairs, which: NDArray[np.intp]) -> None:
        """Put others in the place of some, in these arrays."""
        self.points[:, which], self.log_prob[:, which] = other.points, other.log_prob
        self.side[which] = other.side
        self.log_odds[which], self.log_weight[which] = other.log_odds, other.log_weight

    def and_then(self, other: _Pairs) -> _Pairs:
        """These pairs, then others."""
        return _Pairs(
            np.concatenate([self.points, other.points], axis=1),
            np.concatenate([self.log_prob, other.log_prob], axis=1),
            np.concatenate([self.side, other.side]),
            np.concatenate([self.log_odds, other.log_odds]),
            np.concatenate([self.log_weight, other.log_weight]),
        )


@dataclass
class _Steps:
    """Steps that were worked out ahead, and how many of them have been taken.

    Parameters
    ----------
    pairs : _Pairs
        Those the walkers held, one each, then the new ones, one each for every second step.
    start, coords : ndarray, shapes (walkers, d) and (steps, walkers, d)
    log_prob : ndarray, shape (steps, walkers)
    which, side : ndarray of int, shape (steps, walkers)
        The pair that a walker holds after a step, and at which of its points it stands.
    moved : ndarray of bool, shape (steps, walkers)
    """

    pairs: _Pairs
    start: Array
    coords: Array
    log_prob: Array
    which: NDArray[np.intp]
    side: NDArray[np.intp]
    moved: NDArray[np.bool_]
    done: int = 0

    @classmethod
    def work_out(cls, held: _Pairs, new: _Pairs, random: Any) -> _Steps:
        """Take the walkers through all new pairs, two steps for each."""
        walkers = held.side.size
        pairs = held.and_then(new)
        rounds = new.side.size // walkers
        which = np.empty((2 * rounds, walkers), dtype=np.intp)
        side = np.empty((2 * rounds, walkers), dtype=np.intp)
        moved = np.empty((2 * rounds, walkers), dtype=np.bool_)
        here, at = np.arange(walkers), held.side
        log_weight, log_odds = pairs.log_weight, np.stack([pairs.log_odds, -pairs.log_odds])
        for i in range(0, 2 * rounds, 2):
            over, accept, again = (np.log1p(-random.rand(walkers)) for _ in range(3))
            next_ones = np.arange((i // 2 + 1) * walkers, (i // 2 + 2) * walkers)
            # Not the numbers that decide on the point: a pair is refused whatever they are.
            taken = accept < log_weight[next_ones] - log_weight[here]
            flipped = over < log_odds[at, here]
            moved[i] = taken | flipped
            which[i] = here = np.where(taken, next_ones, here)
            side[i] = at = np.where(taken, pairs.side[next_ones], at ^ flipped)
            which[i + 1] = here
            moved[i + 1] = flipped = again < log_odds[at, here]
            side[i + 1] = at = at ^ flipped
        first = np.arange(walkers)
        # Taken from flat arrays: a third of the time of two indices.
        count, flat = pairs.side.size, side * pairs.side.size + which
        return cls(
            pairs, held.points[held.side, first],
            pairs.points.reshape(2 * count, -1).take(flat, axis=0),
            pairs.log_prob.ravel().take(flat), which, side, moved,
        )  # fmt: skip

    @property
    def here(self) -> Array:
        """Where the walkers are, shape (walkers, d)."""
        return self.coords[self.done - 1] if self.done else self.start

    def take(self, state: Any) -> tuple[Any, Array]:
        """Take the next step."""
        state.coords[...], state.log_prob[...] = self.coords[self.done], self.log_prob[self.done]
        self.done += 1
        return state, self.moved[self.done - 1]

    def held(self) -> _Pairs:
        """The pairs that the walkers hold now."""
        if not self.done:
            return self.pairs.of(np.arange(self.start.shape[0]))
        held = self.pairs.of(self.which[self.done - 1])
        held.side[:] = self.side[self.done - 1]
        return held

    def left(self) -> _Pairs | None:
        """New pairs that no step that was taken has looked at; None if there are none."""
        used = (1 + (self.done + 1) // 2) * self.start.shape[0]
        return self.pairs.of(slice(used, None)) if used < self.pairs.side.size else None


class WalkMove(emcee.moves.Move):  # type: ignore[misc]
    """A random walk in a proposal's straightened coordinates: it follows bends and funnels.

    All walkers step at once, each on its own, by a normal as wide as the posterior there times a
    factor drawn anew for each step: long ones cross the bulk, short ones are accepted in corners.
    """

    def __init__(self, proposal: Proposal, rng: np.random.Generator) -> None:
        self.straightener = proposal.straightener
        self.cholesky = proposal.mixture.covariance_cholesky()
        self.rng = rng

    def propose(self, model: Any, state: Any) -> tuple[Any, Array]:
        """Move the walkers, and say which moved, shape (walkers,); the interface is emcee's."""
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
