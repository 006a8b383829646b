"""The independence move leaves the target as it is."""

from __future__ import annotations

import warnings

import emcee
import numpy as np
import pytest
from scipy import stats

from calib.chains import ess
from calib.sampling.mixture import Mixture, StudentT
from calib.sampling.moves import IndependenceMove


def proposal(mean: float = 0.8, scale: float = 1.7) -> Mixture:
    """Neither centred on the target nor as wide."""
    return Mixture(
        np.array([0.6, 0.4]),
        (
            StudentT(np.array([mean]), np.array([[scale]]), 5.0),
            StudentT(np.array([-1.0]), np.array([[0.7]]), 9.0),
        ),
    )


def target(t: np.ndarray) -> np.ndarray:
    return np.asarray(stats.norm.logpdf(t[:, 0], 0.0, 1.0))


class Stub:
    """What emcee hands a move: the target, and uniform numbers that are known."""

    def __init__(self, uniform: np.ndarray) -> None:
        self.uniform = uniform
        self.random = self
        self.evaluations = 0

    def rand(self, size: int) -> np.ndarray:
        assert size == self.uniform.size
        return self.uniform

    def log_prob_fn(self, t: np.ndarray) -> np.ndarray:
        self.evaluations += len(t)
        return target(t)


def at(points: np.ndarray) -> emcee.State:
    return emcee.State(points.copy(), log_prob=target(points))


def test_detailed_balance_of_every_pair() -> None:
    """A move from x to y is accepted with probability a(x, y) = min(1, w(y)/w(x)), w = pi/q.

    With it pi(x) q(y) a(x, y) = min(pi(x) q(y), pi(y) q(x)), the same from y to x.
    """
    q = proposal()
    points = np.linspace(-3.0, 3.0, 13)[:, None]
    log_w = target(points) - q.log_prob(points)

    class Dealt(Mixture):
        """A proposal of which the draws are known."""

        def sample(self, rng, size):
            return dealt

    for j in range(13):
        dealt = np.repeat(points[j : j + 1], 13, axis=0)
        a = np.exp(np.minimum(0.0, log_w[j] - log_w))
        for factor in (1.0 - 1e-9, 1.0 + 1e-9):
            move = IndependenceMove(Dealt(q.weights, q.components), np.random.default_rng(0), 1)
            # A uniform number of at most one: what is accepted for certain stays so.
            level = np.minimum(a * factor, 1.0 - 1e-12)
            state, accepted = move.propose(Stub(1.0 - level), at(points))
            np.testing.assert_array_equal(accepted, (factor < 1.0) | (a == 1.0))
            np.testing.assert_array_equal(state.coords, np.where(accepted[:, None], dealt, points))
            np.testing.assert_array_equal(state.log_prob, target(state.coords))


def test_walkers_that_another_move_has_carried_off_are_noticed() -> None:
    uniform = np.full(8, 0.7)
    points = np.linspace(-2.0, 2.0, 8)[:, None]
    used, fresh = (IndependenceMove(proposal(), np.random.default_rng(5), 1) for _ in range(2))
    state, _ = used.propose(Stub(uniform), at(points))
    used.rng = np.random.default_rng(5)
    elsewhere = state.coords.copy()
    elsewhere[::2] += 0.3
    after, accepted = used.propose(Stub(uniform), at(elsewhere))
    expected, also = fresh.propose(Stub(uniform), at(elsewhere))
    np.testing.assert_array_equal(accepted, also)
    np.testing.assert_array_equal(after.coords, expected.coords)


def test_every_proposal_is_evaluated_once_and_used_once() -> None:
    stub = Stub(np.full(8, 1.0 - 1e-12))  # everything is accepted
    move = IndependenceMove(proposal(), np.random.default_rng(6), ahead=5)
    state, seen = at(np.zeros((8, 1))), []
    for step in range(10):
        state, accepted = move.propose(stub, state)
        assert accepted.all()
        seen.append(state.coords.copy())
        assert stub.evaluations == 8 * 5 * (step // 5 + 1)
    assert np.unique(np.concatenate(seen)).size == 80


def run(moves: list, log_prob, walkers: int, start: np.ndarray, steps: int, seed: int = 3):
    sampler = emcee.EnsembleSampler(walkers, 1, log_prob, vectorize=True, moves=moves)
    sampler.random_state = np.random.RandomState(seed).get_state()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        sampler.run_mcmc(start, steps)
    return sampler


@pytest.mark.parametrize("local", [[], [(emcee.moves.DEMove(), 0.3)]])
@pytest.mark.parametrize("ahead", [1, 16])
def test_a_chain_of_the_move_has_the_targets_distribution(local: list, ahead: int) -> None:
    move = IndependenceMove(proposal(), np.random.default_rng(2), ahead)
    start = np.random.default_rng(3).normal(0.0, 3.0, (20, 1))
    sampler = run([(move, 0.7), *local], target, 20, start, 2100)
    chain = sampler.get_chain(discard=100)[..., 0].T
    for p in (0.025, 0.25, 0.5, 0.75, 0.975):
        below = (chain < stats.norm.ppf(p)).astype(float)
        size = min(float(ess(below[..., None], "mean")[0]), below.size)
        assert abs(below.mean() - p) < 5.0 * np.sqrt(p * (1.0 - p) / size)
    assert sampler.acceptance_fraction.mean() > 0.3


def test_a_perfect_proposal_is_always_accepted() -> None:
    q = proposal()
    move = IndependenceMove(q, np.random.default_rng(4))
    sampler = run([move], q.log_prob, 10, q.sample(np.random.default_rng(1), 10), 50)
    assert sampler.acceptance_fraction.min() == 1.0
