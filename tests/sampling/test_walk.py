"""The walk along a proposal leaves densities of every shape as they are, on its own."""

from __future__ import annotations

from collections.abc import Callable

import emcee
import numpy as np
import pytest
from scipy import stats

from calib.chains import ess
from calib.sampling.adapt import Guess, adapt
from calib.sampling.moves import WalkMove
from calib.sampling.proposal import Proposal

SIGMAS = 5.0
SCALE = np.array([[1.0, 0.6], [0.6, 0.5]])


def normal(t: np.ndarray) -> np.ndarray:
    return np.asarray(stats.multivariate_normal([1.0, -2.0], SCALE).logpdf(t))


def student(t: np.ndarray) -> np.ndarray:
    return np.asarray(stats.multivariate_t([1.0, -2.0], SCALE, df=4.0).logpdf(t))


def banana(t: np.ndarray) -> np.ndarray:
    """x0 ~ N(0, 1), x1 | x0 ~ N(x0^2, 0.5)."""
    return np.asarray(
        stats.norm.logpdf(t[:, 0]) + stats.norm.logpdf(t[:, 1] - t[:, 0] ** 2, scale=0.5)
    )


def bimodal(t: np.ndarray) -> np.ndarray:
    """Three tenths at -2, seven at 2, both of unit variance."""
    left, right = (stats.norm.logpdf(t[:, 0], m) for m in (-2.0, 2.0))
    return np.logaddexp(np.log(0.3) + left, np.log(0.7) + right) + stats.norm.logpdf(t[:, 1])


def funnel(t: np.ndarray) -> np.ndarray:
    """x1 ~ N(0, 0.5), x0 | x1 ~ N(0, exp x1): the straightener's scale is at work."""
    return np.asarray(
        stats.norm.logpdf(t[:, 1], scale=0.5) + stats.norm.logpdf(t[:, 0], scale=np.exp(t[:, 1]))
    )


def fitted(log_prob: Callable) -> Proposal:
    proposal, _ = adapt(
        log_prob, [Guess(np.array([0.5, -0.5]), 1.5 * np.eye(2))], np.random.default_rng(4)
    )
    assert isinstance(proposal, Proposal)
    return proposal


class Stub:
    """What emcee hands a move, with one uniform number for each walker; it keeps the proposals."""

    def __init__(self, log_prob: Callable, uniform: np.ndarray) -> None:
        self.log_prob, self.uniform, self.random = log_prob, uniform, self
        self.proposed = np.empty(0)

    def rand(self, size: int) -> np.ndarray:
        assert size == self.uniform.size
        return self.uniform

    def log_prob_fn(self, t: np.ndarray) -> np.ndarray:
        self.proposed = t.copy()
        return self.log_prob(t)


def log_volume(proposal: Proposal, t: np.ndarray) -> np.ndarray:
    """Log of |dv/dt| by central differences."""
    h, straighten = 1e-6, proposal.straightener.straighten
    columns = [
        (straighten(t + h * e)[0] - straighten(t - h * e)[0]) / (2.0 * h)
        for e in np.eye(t.shape[1])
    ]
    return np.log(np.abs(np.linalg.det(np.stack(columns, axis=-1))))


@pytest.mark.parametrize("log_prob", [banana, funnel, student])
def test_detailed_balance_of_every_step(log_prob: Callable) -> None:
    """Steps are symmetric in v, so q(t -> t') = g(v' - v) |dv'/dt'|, and

    pi(t) q(t -> t') a(t, t') = pi(t') q(t' -> t) a(t', t) with
    a(t, t') = min(1, pi(t') |dv/dt| / (pi(t) |dv'/dt'|)).
    """
    proposal = fitted(log_prob)
    start, _ = proposal.draw(np.random.default_rng(1), 200)

    def step(uniform: np.ndarray):
        stub = Stub(log_prob, uniform)
        state = emcee.State(start.copy(), log_prob=log_prob(start))
        state, accepted = WalkMove(proposal, np.random.default_rng(2)).propose(stub, state)
        np.testing.assert_array_equal(
            state.coords, np.where(accepted[:, None], stub.proposed, start)
        )
        np.testing.assert_array_equal(state.log_prob, log_prob(state.coords))
        return stub.proposed, accepted

    there, _ = step(np.full(200, 0.5))
    assert (there != start).all()
    ratio = (log_prob(there) - log_volume(proposal, there)) - (
        log_prob(start) - log_volume(proposal, start)
    )
    a = np.exp(np.minimum(ratio, 0.0))
    assert 0.1 < (a < 1.0).mean() < 0.9
    for factor in (1.0 - 1e-5, 1.0 + 1e-5):
        # The same steps; a number just below the probability is accepted, one just above is not.
        level = np.clip(a * factor, 1e-12, 1.0 - 1e-12)
        _, accepted = step(1.0 - level)
        told = a > 1e-6  # of smaller ones a uniform number near one keeps too few digits
        expected = (factor < 1.0) | (a > 1.0 - 1e-4)
        np.testing.assert_array_equal(accepted[told], np.broadcast_to(expected, a.shape)[told])


@pytest.mark.parametrize(
    ("log_prob", "function", "law"),
    [
        (normal, lambda t: t[..., 0], stats.norm(1.0, 1.0)),
        (normal, lambda t: t[..., 0] - 1.2 * t[..., 1], stats.norm(3.4, np.sqrt(0.28))),
        (student, lambda t: t[..., 1], stats.t(4.0, -2.0, np.sqrt(0.5))),
        (banana, lambda t: t[..., 0], stats.norm()),
        (banana, lambda t: t[..., 1] - t[..., 0] ** 2, stats.norm(0.0, 0.5)),
        (funnel, lambda t: t[..., 1], stats.norm(0.0, 0.5)),
        (funnel, lambda t: t[..., 0] * np.exp(-t[..., 1]), stats.norm()),
        (bimodal, lambda t: t[..., 1], stats.norm()),
    ],
)
def test_a_chain_of_the_walk_alone(log_prob: Callable, function: Callable, law) -> None:
    value = function(chain(log_prob))
    for p in (0.025, 0.25, 0.5, 0.75, 0.975):
        assert_share(value < law.ppf(p), p)


def test_a_chain_of_the_walk_alone_visits_both_modes() -> None:
    assert_share(chain(bimodal)[..., 0] < 0.0, 0.3 * stats.norm.cdf(2) + 0.7 * stats.norm.cdf(-2))


def chain(log_prob: Callable) -> np.ndarray:
    """Draws of the walk alone, (walkers, steps, d): each walker is a chain of its own."""
    proposal = fitted(log_prob)
    start, _ = proposal.draw(np.random.default_rng(3), 40)
    sampler = emcee.EnsembleSampler(
        40, 2, log_prob, vectorize=True, moves=[WalkMove(proposal, np.random.default_rng(5))]
    )
    sampler.random_state = np.random.RandomState(6).get_state()
    sampler.run_mcmc(start, 5000)
    return sampler.get_chain(discard=500).transpose(1, 0, 2)


def assert_share(inside: np.ndarray, p: float) -> None:
    size = min(float(ess(inside.astype(float)[..., None], "mean")[0]), inside.size)
    assert size > 400.0
    assert abs(inside.mean() - p) < SIGMAS * np.sqrt(p * (1.0 - p) / size)


def test_a_proposals_draws_come_with_its_density() -> None:
    proposal = fitted(banana)
    t, log_q = proposal.draw(np.random.default_rng(8), 500)
    np.testing.assert_allclose(log_q, proposal.log_prob(t), atol=1e-9)
