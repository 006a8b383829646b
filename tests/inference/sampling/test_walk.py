"""The walk along a proposal leaves densities of every shape as they are, on its own."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from calib.inference.sampling.moves import WalkMove
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
    log_volume,
    student,
)


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
        move = WalkMove(proposal, np.random.default_rng(2))
        state, accepted = move.propose(stub, at(log_prob, start))
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
        np.testing.assert_array_equal(accepted[told], (level < a)[told])


@pytest.mark.parametrize(("log_prob", "function", "law"), LAWS)
def test_a_chain_of_the_walk_alone(log_prob: Callable, function: Callable, law) -> None:
    value = function(walked(log_prob))
    for p in (0.025, 0.25, 0.5, 0.75, 0.975):
        assert_share(value < law.ppf(p), p)


def test_a_chain_of_the_walk_alone_visits_both_modes() -> None:
    assert_share(walked(bimodal)[..., 0] < 0.0, BELOW_ZERO_OF_BIMODAL)


@cache
def walked(log_prob: Callable) -> np.ndarray:
    """Draws of the walk alone: each walker is a chain of its own."""
    proposal = fitted(log_prob)
    start, _ = proposal.draw(np.random.default_rng(3), 200)
    return chain(log_prob, [WalkMove(proposal, np.random.default_rng(5))], start, 1000)
