"""Densities of many shapes that the tests of moves share, and what holds of their draws."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import emcee
import numpy as np
from scipy import stats

from calib.inference.diagnostics import ess
from calib.inference.sampling.adapt import Guess, adapt
from calib.inference.sampling.proposal import Proposal

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


def half(t: np.ndarray) -> np.ndarray:
    """x0 ~ Exp(1), x1 ~ N(0, 1): opposite points often have no density."""
    return np.asarray(stats.expon.logpdf(t[:, 0]) + stats.norm.logpdf(t[:, 1]))


# A function of the draws, and its distribution.
LAWS = [
    (normal, lambda t: t[..., 0], stats.norm(1.0, 1.0)),
    (normal, lambda t: t[..., 0] - 1.2 * t[..., 1], stats.norm(3.4, np.sqrt(0.28))),
    (student, lambda t: t[..., 1], stats.t(4.0, -2.0, np.sqrt(0.5))),
    (banana, lambda t: t[..., 0], stats.norm()),
    (banana, lambda t: t[..., 1] - t[..., 0] ** 2, stats.norm(0.0, 0.5)),
    (funnel, lambda t: t[..., 1], stats.norm(0.0, 0.5)),
    (funnel, lambda t: t[..., 0] * np.exp(-t[..., 1]), stats.norm()),
    (bimodal, lambda t: t[..., 1], stats.norm()),
]
BELOW_ZERO_OF_BIMODAL = 0.3 * stats.norm.cdf(2) + 0.7 * stats.norm.cdf(-2)


@cache
def fitted(log_prob: Callable) -> Proposal:
    proposal, _ = adapt(
        log_prob, [Guess(np.array([0.5, -0.5]), 1.5 * np.eye(2))], np.random.default_rng(4)
    )
    return proposal


def log_volume(proposal: Proposal, t: np.ndarray) -> np.ndarray:
    """Log of |dv/dt| by central differences."""
    h, straighten = 1e-6, proposal.straightener.straighten
    columns = [
        (straighten(t + h * e)[0] - straighten(t - h * e)[0]) / (2.0 * h)
        for e in np.eye(t.shape[1])
    ]
    return np.log(np.abs(np.linalg.det(np.stack(columns, axis=-1))))


class Stub:
    """What emcee hands a move: a target, and uniform numbers that are known, in turn."""

    def __init__(self, log_prob: Callable, *uniform: np.ndarray) -> None:
        self.log_prob, self.uniform, self.random = log_prob, list(uniform), self
        self.proposed = np.empty(0)
        self.evaluations = 0

    def rand(self, size: int) -> np.ndarray:
        numbers = self.uniform.pop(0) if len(self.uniform) > 1 else self.uniform[0]
        assert size == numbers.size
        return numbers

    def log_prob_fn(self, t: np.ndarray) -> np.ndarray:
        self.evaluations += len(t)
        self.proposed = t.copy()
        return self.log_prob(t)


def at(log_prob: Callable, points: np.ndarray) -> emcee.State:
    return emcee.State(points.copy(), log_prob=log_prob(points))


def chain(log_prob: Callable, moves: list, start: np.ndarray, steps: int) -> np.ndarray:
    """Draws of moves, (walkers, steps, d), a tenth of the steps left out."""
    sampler = emcee.EnsembleSampler(*start.shape, log_prob, vectorize=True, moves=moves)
    sampler.random_state = np.random.RandomState(6).get_state()
    sampler.run_mcmc(start, steps)
    return sampler.get_chain(discard=steps // 10).transpose(1, 0, 2)


def assert_share(inside: np.ndarray, p: float) -> None:
    size = min(float(ess(inside.astype(float)[..., None], "mean")[0]), inside.size)
    assert size > 400.0
    assert abs(inside.mean() - p) < SIGMAS * np.sqrt(p * (1.0 - p) / size)
