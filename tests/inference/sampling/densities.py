"""Densities of several shapes, and proposals fitted to them."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
from scipy import stats

from calib.inference.sampling.proposal import Guess, Proposal, adapt


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


@cache
def fitted(log_prob: Callable) -> Proposal:
    proposal, _ = adapt(
        log_prob, [Guess(np.array([0.5, -0.5]), 1.5 * np.eye(2))], np.random.default_rng(4)
    )
    return proposal
