"""The move of opposite pairs leaves the target as it is."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import emcee
import numpy as np
import pytest
from scipy import stats
from scipy.special import expit

from calib.inference.diagnostics import ess
from calib.inference.sampling.mixture import Mixture, StudentT
from calib.inference.sampling.moves import PairMove, WalkMove
from calib.inference.sampling.proposal import Proposal
from calib.inference.sampling.straighten import Straightener
from tests.inference.sampling.densities import (
    BELOW_ZERO_OF_BIMODAL,
    LAWS,
    Stub,
    assert_share,
    at,
    banana,
    bimodal,
    chain,
    fitted,
    funnel,
    half,
    log_volume,
    normal,
    student,
)

N = 300


class Dealt(np.random.Generator):
    """Random numbers of which those that pick a point of each pair are known."""

    def __init__(self, seed: int, level: np.ndarray) -> None:
        super().__init__(np.random.PCG64(seed))
        self.level = level

    def logistic(self, *, size: int) -> np.ndarray:
        """The logistic number of a uniform one."""
        return np.log(self.level / (1.0 - self.level))


def pi_of(log_prob: Callable, proposal: Proposal, t: np.ndarray) -> np.ndarray:
    """Log density in straightened coordinates, where pairs are opposite."""
    return log_prob(t) - log_volume(proposal, t)


@pytest.mark.parametrize("log_prob", [banana, funnel, student, bimodal])
def test_detailed_balance_of_every_step(log_prob: Callable) -> None:
    """A fresh pair S' comes with density q(S'), and is accepted with probability
    a = min(1, W(S')/W(S)), W = (pi(t) + pi(t'))/q(S): W(S) q(S) q(S') a(S, S') is symmetric. Of its
    points, t is taken with probability pi(t)/(pi(t) + pi(t')). Where it is refused, and at every
    second step, the walker goes over to the other point of its own with min(1, pi(t')/pi(t)).
    """
    proposal = fitted(log_prob)
    start, _ = proposal.draw(np.random.default_rng(1), N)
    own, _, own_q = proposal.opposite(start)
    pairs, _, q = proposal.draw_pairs(np.random.default_rng(2), N)
    pi = [pi_of(log_prob, proposal, t) for t in (start, own, *pairs)]
    accept = np.exp(np.minimum(np.logaddexp(*pi[2:]) - q - np.logaddexp(*pi[:2]) + own_q, 0.0))
    second = expit(pi[3] - pi[2])
    flip = np.exp(np.minimum(pi[1] - pi[0], 0.0))
    some = np.random.default_rng(7)
    for _ in range(20):
        u_flip, u_accept, u_second = some.random((3, N))
        # Numbers so near a probability that rounding decides are moved away.
        for u, p in ((u_flip, flip), (u_accept, accept), (u_second, second)):
            u[abs(u - p) < 1e-4] = 0.5 * p[abs(u - p) < 1e-4]
        accepted, flipped = u_accept < accept, u_flip < flip
        fresh = np.where((u_second < second)[:, None], pairs[1], pairs[0])
        kept = np.where(flipped[:, None], own, start)
        middle = np.where(accepted[:, None], fresh, kept)
        other, _, _ = proposal.opposite(middle)
        over = np.exp(
            np.minimum(pi_of(log_prob, proposal, other) - pi_of(log_prob, proposal, middle), 0.0)
        )
        level = some.random(N)
        level[abs(level - over) < 1e-4] = 0.5 * over[abs(level - over) < 1e-4]
        end = np.where((level < over)[:, None], other, middle)

        move = PairMove(proposal, Dealt(2, u_second), ahead=1)
        stub = Stub(log_prob, 1.0 - u_flip, 1.0 - u_accept, 1.0 - level)
        state = at(log_prob, start)
        for expected, went in ((middle, accepted | flipped), (end, level < over)):
            state, moved = move.propose(stub, state)
            np.testing.assert_allclose(state.coords, expected, rtol=1e-7, atol=1e-7)
            np.testing.assert_array_equal(moved, went)
            np.testing.assert_allclose(state.log_prob, log_prob(state.coords), atol=1e-12)


def test_walkers_that_another_move_has_carried_off_are_noticed() -> None:
    uniform = np.full(8, 0.7)
    proposal = fitted(normal)
    points, _ = proposal.draw(np.random.default_rng(1), 8)
    used, fresh = (PairMove(proposal, np.random.default_rng(5), 1) for _ in range(2))
    state = at(normal, points)
    for _ in range(2):
        state, _ = used.propose(Stub(normal, uniform), state)
    used.rng = np.random.default_rng(5)
    elsewhere = state.coords.copy()
    elsewhere[::2] += 0.3
    after, accepted = used.propose(Stub(normal, uniform), at(normal, elsewhere))
    expected, also = fresh.propose(Stub(normal, uniform), at(normal, elsewhere))
    np.testing.assert_array_equal(accepted, also)
    np.testing.assert_allclose(after.coords, expected.coords, rtol=1e-9)


@pytest.mark.parametrize("taken", [1, 2, 3, 6, 7])
def test_pairs_that_are_left_serve_walkers_that_were_carried_off(taken: int) -> None:
    """Eight steps are worked out ahead; after some of them every second walker is elsewhere."""
    level = np.full(8, 1.0 - 1e-12)  # everything is accepted
    proposal = fitted(normal)
    move = PairMove(proposal, np.random.default_rng(6), ahead=8)
    stub, state = Stub(normal, level), at(normal, np.zeros((8, 2)))
    for _ in range(taken):
        state, _ = move.propose(stub, state)
    assert stub.evaluations == 8 + 8 * 8
    state.coords[::2] += 0.3
    state.log_prob[:] = normal(state.coords)
    before, left = state.coords.copy(), 4 - (taken + 1) // 2
    state, moved = move.propose(stub, state)
    # The opposites of those four; new pairs only where none are left.
    assert stub.evaluations == 8 + 8 * 8 + 4 + (0 if left else 8 * 8)
    assert moved.all()
    fresh = state.coords.copy()
    assert (fresh != before).any(axis=1).all()
    state, _ = move.propose(stub, state)
    np.testing.assert_allclose(state.coords, proposal.opposite(fresh)[0], atol=1e-9)


@pytest.mark.parametrize("taken", [1, 2, 3])
def test_a_walker_that_was_carried_off_has_its_own_opposite(taken: int) -> None:
    """And the others keep theirs: with every fresh pair refused, a flip shows whose is whose."""
    proposal = fitted(normal)
    move = PairMove(proposal, np.random.default_rng(6), ahead=8)
    start = 0.2 * np.random.default_rng(3).standard_normal((8, 2))
    # No uniform number is that low, but its logarithm is above that of any ratio.
    accepted, refused = np.full(8, 1.0 - 1e-12), np.full(8, -1e300)
    state = at(normal, start)
    for _ in range(taken):
        state, _ = move.propose(Stub(normal, accepted), state)
    state.coords[::2] += 0.3
    state.log_prob[:] = normal(state.coords)
    before = state.coords.copy()
    # Of three numbers the second refuses the fresh pair, the first has the walker go over.
    stub = Stub(normal, accepted, refused, accepted)
    state, moved = move.propose(stub, state)
    assert moved.all()
    np.testing.assert_allclose(state.coords, proposal.opposite(before)[0], atol=1e-9)
    np.testing.assert_allclose(state.log_prob, normal(state.coords), atol=1e-12)


def test_every_pair_is_evaluated_once_and_used_once() -> None:
    """Of ten steps five draw pairs, two for each evaluation ahead; the start's are the first 8."""
    stub = Stub(normal, np.full(8, 1.0 - 1e-12))  # everything is accepted
    move = PairMove(fitted(normal), np.random.default_rng(6), ahead=4)
    state, seen = at(normal, np.zeros((8, 2))), []
    for step in range(12):
        state, moved = move.propose(stub, state)
        assert moved.all()
        seen.append(state.coords.copy())
        assert stub.evaluations == 8 + 8 * 4 * (step // 4 + 1)
    assert np.unique(np.concatenate(seen), axis=0).shape[0] == 96


@cache
def pairs_alone(log_prob: Callable, ahead: int = 16) -> np.ndarray:
    proposal = fitted(log_prob)
    start, _ = proposal.draw(np.random.default_rng(3), 800)
    start = start[np.isfinite(log_prob(start))][:200]
    return chain(log_prob, [PairMove(proposal, np.random.default_rng(5), ahead)], start, 500)


@pytest.mark.parametrize(("log_prob", "function", "law"), LAWS)
@pytest.mark.parametrize("ahead", [1, 16])
def test_a_chain_of_pairs_alone(log_prob: Callable, function: Callable, law, ahead: int) -> None:
    value = function(pairs_alone(log_prob, ahead))
    for p in (0.025, 0.25, 0.5, 0.75, 0.975):
        assert_share(value < law.ppf(p), p)


@cache
def pairs_and_walks(log_prob: Callable) -> np.ndarray:
    proposal = fitted(log_prob)
    start, _ = proposal.draw(np.random.default_rng(3), 200)
    rng = np.random.default_rng(5)
    move = PairMove(proposal, rng, 8, walk=WalkMove(proposal, rng), every=4)
    return chain(log_prob, [move], start, 500)


@pytest.mark.parametrize(("log_prob", "function", "law"), LAWS)
def test_a_chain_with_walks_between(log_prob: Callable, function: Callable, law) -> None:
    value = function(pairs_and_walks(log_prob))
    for p in (0.025, 0.25, 0.5, 0.75, 0.975):
        assert_share(value < law.ppf(p), p)


class Aside(WalkMove):
    """In the place of a walk: every walker to a point of no pair."""

    def __init__(self) -> None:
        self.turns = 0

    def propose(self, model: object, state: emcee.State) -> tuple[emcee.State, np.ndarray]:
        """Move the walkers."""
        self.turns += 1
        state.coords += 0.3
        state.log_prob[:] = normal(state.coords)
        return state, np.ones(len(state.coords), dtype=bool)


@pytest.mark.parametrize("every", [2, 3, 4, 6])
def test_the_walk_has_its_turn_after_so_many_steps(every: int) -> None:
    aside = Aside()
    move = PairMove(fitted(normal), np.random.default_rng(6), 4, walk=aside, every=every)
    stub, state = Stub(normal, np.full(8, 0.5)), at(normal, np.zeros((8, 2)))
    for step in range(20):
        before = state.coords.copy()
        state, _ = move.propose(stub, state)
        assert aside.turns == (step + 1) // (every + 1)
        if step % (every + 1) == every:
            np.testing.assert_array_equal(state.coords, before + 0.3)
        # Also of walkers whose pairs were drawn before they were carried off.
        np.testing.assert_allclose(state.log_prob, normal(state.coords), atol=1e-12)


def test_a_chain_of_pairs_alone_visits_both_modes() -> None:
    assert_share(pairs_alone(bimodal)[..., 0] < 0.0, BELOW_ZERO_OF_BIMODAL)


def test_points_whose_opposites_have_no_density() -> None:
    value = pairs_alone(half)[..., 0]
    for p in (0.05, 0.5, 0.95):
        assert_share(value < stats.expon.ppf(p), p)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # numpy 2 and emcee's own moves
def test_a_chain_beside_a_local_move() -> None:
    moves = [(PairMove(fitted(banana), np.random.default_rng(2)), 0.7), (emcee.moves.DEMove(), 0.3)]
    start, _ = fitted(banana).draw(np.random.default_rng(3), 200)
    value = chain(banana, moves, start, 600)[..., 1]
    # x1 = x0^2 + e: by simulation of many more draws than the chain's.
    rng = np.random.default_rng(4)
    known = rng.standard_normal(4_000_000) ** 2 + 0.5 * rng.standard_normal(4_000_000)
    for p in (0.05, 0.5, 0.95):
        assert_share(value < np.quantile(known, p), p)


def test_a_perfect_symmetric_proposal_is_always_accepted_and_left_for_its_opposite() -> None:
    mixture = Mixture(np.ones(1), (StudentT(np.array([0.5, 1.0]), np.diag([1.0, 2.0]), 7.0),))
    perfect = Proposal(Straightener.identity(2), mixture)
    start, _ = perfect.draw(np.random.default_rng(1), 10)
    moves = [PairMove(perfect, np.random.default_rng(4))]
    sampler = emcee.EnsembleSampler(10, 2, perfect.log_prob, vectorize=True, moves=moves)
    sampler.random_state = np.random.RandomState(6).get_state()
    sampler.run_mcmc(start, 50)
    assert sampler.acceptance_fraction.min() == 1.0
    pairs = sampler.get_chain().reshape(25, 2, 10, 2)
    np.testing.assert_allclose(
        pairs.mean(axis=1), np.broadcast_to([0.5, 1.0], (25, 10, 2)), atol=1e-12
    )


def test_means_of_opposite_pairs_scatter_less() -> None:
    """As the effective size says, which counts them for more than their number."""
    means, sizes = [], []
    proposal = fitted(normal)
    for seed in range(60):
        rng = np.random.default_rng(seed)
        start, _ = proposal.draw(rng, 40)
        sampler = emcee.EnsembleSampler(
            40, 2, normal, vectorize=True, moves=[PairMove(proposal, rng)]
        )
        sampler.random_state = np.random.RandomState(seed).get_state()
        sampler.run_mcmc(start, 60)
        t = sampler.get_chain(discard=12).transpose(1, 0, 2)
        means.append(t.mean(axis=(0, 1)))
        sizes.append(ess(t, "mean"))
    assert np.mean(sizes) > 40 * 48
    ratio = (
        np.var(means, axis=0, ddof=1)
        * np.mean(sizes, axis=0)
        / np.diag(np.array([[1.0, 0.6], [0.6, 0.5]]))
    )
    # A ratio of variances of 60 values has a standard error of sqrt(2/59).
    assert np.all(ratio < 1.0 + 4.0 * np.sqrt(2.0 / 59))
