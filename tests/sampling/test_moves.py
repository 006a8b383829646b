"""The independence move leaves the target as it is."""

from __future__ import annotations

import emcee
import numpy as np
from scipy import stats

from calib.chains import ess
from calib.sampling.moves import IndependenceMove
from calib.sampling.proposal import Mixture, StudentT


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


def test_detailed_balance_of_every_pair() -> None:
    """pi(x) q(y) a(x, y) = pi(y) q(x) a(y, x), with a as emcee forms it from the move's factor."""
    q = proposal()
    points = np.linspace(-3.0, 3.0, 13)[:, None]

    class Dealt(Mixture):
        """A proposal of which the draws are known."""

        def sample(self, rng, size):
            return dealt

    move = IndependenceMove(Dealt(q.weights, q.components))
    flow = np.empty((13, 13))
    for j in range(13):
        dealt = np.repeat(points[j : j + 1], 13, axis=0)
        drawn, factor = move.get_proposal(points, np.random.RandomState(0))
        np.testing.assert_array_equal(drawn, dealt)
        accept = np.minimum(1.0, np.exp(factor + target(dealt) - target(points)))
        flow[:, j] = np.exp(target(points) + q.log_prob(dealt)) * accept
    np.testing.assert_allclose(flow, flow.T, rtol=1e-12)
    assert flow.min() > 0.0


def test_a_chain_of_the_move_alone_has_the_targets_distribution() -> None:
    sampler = emcee.EnsembleSampler(
        20, 1, target, vectorize=True, moves=[IndependenceMove(proposal())]
    )
    sampler.random_state = np.random.RandomState(3).get_state()
    start = np.random.default_rng(3).normal(0.0, 3.0, (20, 1))
    sampler.run_mcmc(start, 2100)
    chain = sampler.get_chain(discard=100)[..., 0].T
    for p in (0.025, 0.25, 0.5, 0.75, 0.975):
        below = (chain < stats.norm.ppf(p)).astype(float)
        size = min(float(ess(below[..., None], "mean")[0]), below.size)
        assert abs(below.mean() - p) < 5.0 * np.sqrt(p * (1.0 - p) / size)
    assert sampler.acceptance_fraction.mean() > 0.3


def test_a_perfect_proposal_is_always_accepted() -> None:
    q = proposal()
    sampler = emcee.EnsembleSampler(10, 1, q.log_prob, vectorize=True, moves=[IndependenceMove(q)])
    sampler.random_state = np.random.RandomState(4).get_state()
    sampler.run_mcmc(q.sample(np.random.default_rng(1), 10), 50)
    assert sampler.acceptance_fraction.min() == 1.0
