"""Densities whose moments, quantiles and evidence are known, and how near draws must come."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import stats
from scipy.special import gammaln

from calib.inference.diagnostics import ess
from calib.inference.proposal import Guess
from calib.inference.sampler import Draws, SamplerSettings, sample_density
from calib.models.base import Array

# Deviations are allowed five standard errors: by chance one in two million.
SIGMAS = 5.0
QUANTILES = (0.025, 0.25, 0.5, 0.75, 0.975)

type LogProb = Callable[[Array], Array]


def run(
    log_prob: LogProb, mean: Array, covariance: Array, seed: int = 1,
    settings: SamplerSettings | None = None, last_starts: Array | None = None,
) -> Draws:  # fmt: skip
    """Sample a density from a first guess of its location and scale."""
    mean = np.asarray(mean, dtype=float)
    seeds = np.random.SeedSequence(seed).spawn(5)
    first = Guess(mean, np.linalg.cholesky(np.asarray(covariance, dtype=float)))
    names = tuple(f"x{i}" for i in range(mean.size))
    return sample_density(
        log_prob, [first], seeds, names, settings or SamplerSettings(),
        rng=np.random.default_rng(seeds[0]), last_starts=last_starts,
    )  # fmt: skip


def assert_distributed(
    draws: Draws, function: Callable[[Array], Array], expected: stats.rv_frozen
) -> None:
    """Compare the distribution of a function of the draws with the known one."""
    ensembles, walkers, steps, _ = draws.t.shape
    value = function(draws.flat).reshape(ensembles * walkers, steps)
    for p in QUANTILES:
        below = (value < expected.ppf(p)).astype(float)
        # The effective size of this very indicator, which is what the tail ESS is.
        size = float(ess(below[..., None], "mean")[0])
        error = np.sqrt(p * (1.0 - p) / min(size, below.size))
        assert abs(below.mean() - p) < SIGMAS * error, (p, below.mean(), error)


def evidence_error(draws: Draws, size: int = 1500) -> float:
    """Standard error of the log evidence: relative weight variance is 1/efficiency - 1."""
    return float(np.sqrt((1.0 / draws.efficiency - 1.0) / size))


@dataclass(frozen=True)
class Linear:
    """A normal linear model with a conjugate prior, its posterior in closed form.

    beta | sigma2 ~ N(0, sigma2 lam^-1 I), sigma2 ~ InvGamma(a, b); sigma2 = 1 if it is known.
    """

    x: Array
    y: Array
    lam: float = 0.5
    a: float = 3.0
    b: float = 2.0

    @property
    def precision(self) -> Array:
        return self.x.T @ self.x + self.lam * np.eye(self.x.shape[1])

    @property
    def mean(self) -> Array:
        return np.linalg.solve(self.precision, self.x.T @ self.y)

    @property
    def _b_n(self) -> float:
        return self.b + 0.5 * float(self.y @ self.y - self.mean @ self.precision @ self.mean)

    @property
    def _a_n(self) -> float:
        return self.a + 0.5 * self.y.size

    def log_prob_known(self, t: Array) -> Array:
        fit = stats.norm.logpdf(self.y, t @ self.x.T, 1.0).sum(axis=1)
        return fit + stats.norm.logpdf(t, 0.0, self.lam**-0.5).sum(axis=1)

    def log_prob_unknown(self, t: Array) -> Array:
        """Of (beta, ln sigma); the last term is the Jacobian of sigma2 = exp(2 ln sigma)."""
        beta, ln_sigma = t[:, :-1], t[:, -1]
        sigma = np.exp(ln_sigma)[:, None]
        fit = stats.norm.logpdf(self.y, beta @ self.x.T, sigma).sum(axis=1)
        prior = stats.norm.logpdf(beta, 0.0, sigma * self.lam**-0.5).sum(axis=1)
        sigma2 = np.exp(2.0 * ln_sigma)
        noise = stats.invgamma.logpdf(sigma2, self.a, scale=self.b)
        return fit + prior + noise + np.log(2.0) + 2.0 * ln_sigma

    def log_evidence_known(self) -> float:
        covariance = np.eye(self.y.size) + self.x @ self.x.T / self.lam
        return float(stats.multivariate_normal.logpdf(self.y, None, covariance))

    def log_evidence_unknown(self) -> float:
        d = self.x.shape[1]
        return float(
            -0.5 * self.y.size * np.log(2 * np.pi)
            + 0.5 * (d * np.log(self.lam) - np.linalg.slogdet(self.precision)[1])
            + self.a * np.log(self.b)
            - self._a_n * np.log(self._b_n)
            + gammaln(self._a_n)
            - gammaln(self.a)
        )

    def marginal_known(self, i: int) -> stats.rv_frozen:
        return stats.norm(self.mean[i], np.sqrt(np.linalg.inv(self.precision)[i, i]))

    def marginal_unknown(self, i: int) -> stats.rv_frozen:
        scale = self._b_n / self._a_n * np.linalg.inv(self.precision)[i, i]
        return stats.t(2.0 * self._a_n, self.mean[i], np.sqrt(scale))

    def sigma2(self) -> stats.rv_frozen:
        return stats.invgamma(self._a_n, scale=self._b_n)


def linear() -> Linear:
    rng = np.random.default_rng(12)
    x = np.column_stack([np.ones(15), np.linspace(0.0, 1.0, 15), rng.standard_normal(15)])
    return Linear(x, x @ np.array([1.0, -2.0, 0.5]) + 0.8 * rng.standard_normal(15))
