"""Proposals: draws come with their density, of one part and of several."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from tests.inference.sampling.densities import banana, bimodal, fitted, funnel


@pytest.mark.parametrize("log_prob", [banana, bimodal, funnel])
def test_draws_come_with_their_density(log_prob: Callable) -> None:
    proposal = fitted(log_prob)
    t, log_q = proposal.draw(np.random.default_rng(8), 500)
    np.testing.assert_allclose(log_q, proposal.log_prob(t), atol=1e-9)


def test_the_parts_share_a_density_between_them() -> None:
    proposal = fitted(bimodal).extended(np.random.default_rng(1).normal(5.0, 0.1, (50, 2)))
    t, log_q = proposal.draw(np.random.default_rng(8), 20_000)
    shares = proposal.shares(t)
    np.testing.assert_allclose(shares.sum(axis=0), 1.0)
    error = np.sqrt(shares.var(axis=1) / len(t))
    assert np.all(np.abs(shares.mean(axis=1) - proposal.weights) < 5.0 * error)
    parts = np.stack([part.log_prob(t) for part in proposal.parts])
    np.testing.assert_allclose(np.exp(log_q), proposal.weights @ np.exp(parts))
