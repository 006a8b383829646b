"""Proposals: draws come with their density, alone and in opposite pairs."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from tests.inference.sampling.densities import banana, bimodal, fitted, funnel, log_volume


@pytest.mark.parametrize("log_prob", [banana, bimodal, funnel])
def test_draws_come_with_their_density(log_prob: Callable) -> None:
    proposal = fitted(log_prob)
    t, log_q = proposal.draw(np.random.default_rng(8), 500)
    np.testing.assert_allclose(log_q, proposal.log_prob(t), atol=1e-9)


@pytest.mark.parametrize("log_prob", [banana, bimodal, funnel])
def test_opposite_pairs(log_prob: Callable) -> None:
    proposal = fitted(log_prob)
    t, log_jacobian, log_q = proposal.draw_pairs(np.random.default_rng(8), 200)
    # The mean of the densities of either point, each alone, in straightened coordinates.
    alone = [proposal.log_prob(x) - log_volume(proposal, x) for x in t]
    np.testing.assert_allclose(log_q, np.logaddexp(*alone) - np.log(2.0), atol=1e-4)
    np.testing.assert_allclose(log_jacobian, [log_volume(proposal, x) for x in t], atol=1e-4)
    for here, there in ((0, 1), (1, 0)):
        other, jacobians, same = proposal.opposite(t[here])
        np.testing.assert_allclose(other, t[there], rtol=1e-7, atol=1e-7)
        np.testing.assert_allclose(jacobians, log_jacobian[[here, there]], atol=1e-7)
        np.testing.assert_allclose(same, log_q, atol=1e-7)
