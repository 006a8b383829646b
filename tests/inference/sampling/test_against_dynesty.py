"""Posteriors and evidences of the embedded problems against an independent sampler: dynesty.

Nested sampling shares nothing with ours but the density. Both are run several times from different
seeds, and the spread between runs is the Monte Carlo error of each, whatever its cause. Welch's
test compares every mean, sd, quantile and evidence; p values are adjusted family-wise.
"""

from __future__ import annotations

import numpy as np
import pytest
from dynesty import NestedSampler
from scipy import stats

from calib.inference.problem import Problem, build_problem
from calib.inference.sampler import sample_posterior
from calib.models import MODELS
from calib.validation.replicate import design_of
from calib.validation.scores import holm

RUNS, LIVE = 10, 150
QUANTILES = (0.05, 0.5, 0.95)
# Chance of a false alarm in all figures of one model.
FAMILY = 0.01


def embedded(model: str) -> Problem:
    """The model's calibration on the embedded data, 30 psi held out where that is done."""
    return build_problem(model, design_of(model).table)


def weighted_quantile(values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    order = np.argsort(values)
    below = np.cumsum(weight[order]) - 0.5 * weight[order]
    return np.interp(QUANTILES, below, values[order])


def figures(t: np.ndarray, weight: np.ndarray, log_evidence: float) -> np.ndarray:
    mean = weight @ t
    sd = np.sqrt(weight @ np.square(t - mean))
    quantiles = [weighted_quantile(column, weight) for column in t.T]
    return np.concatenate([mean, sd, np.ravel(quantiles), [log_evidence]])


def ours(problem: Problem, seed: int) -> np.ndarray:
    draws = sample_posterior(problem, seed)
    assert draws.report.passed
    n = draws.flat.shape[0]
    return figures(draws.flat, np.full(n, 1.0 / n), draws.log_evidence)


def theirs(problem: Problem, seed: int) -> np.ndarray:
    def log_likelihood(t: np.ndarray) -> float:
        return max(float(problem.log_likelihood(t[None])[0]), -1e300)

    sampler = NestedSampler(
        log_likelihood,
        lambda u: problem.priors.ppf(u[None])[0],
        problem.n_dim,
        nlive=LIVE,
        # Slices follow the broad, prior-like directions that random walks explore too slowly.
        sample="rslice",
        rstate=np.random.default_rng(seed),
    )
    sampler.run_nested(dlogz=0.01, print_progress=False)
    found = sampler.results
    weight = np.exp(found.logwt - found.logwt.max())
    return figures(found.samples, weight / weight.sum(), float(found.logz[-1]))


def labels(problem: Problem) -> list[str]:
    each = [f"{k} of {n}" for k in ("mean", "sd") for n in problem.names]
    each += [f"{q:g} quantile of {n}" for n in problem.names for q in QUANTILES]
    return [*each, "log evidence"]


@pytest.mark.slow
@pytest.mark.parametrize("model", [m for m in MODELS if MODELS[m].cited == "He_2019"])
def test_an_independent_sampler_agrees(model: str) -> None:
    problem = embedded(model)
    a = np.array([ours(problem, seed) for seed in range(RUNS)])
    b = np.array([theirs(problem, seed) for seed in range(RUNS)])
    test = stats.ttest_ind(a, b, equal_var=False)
    adjusted = holm(test.pvalue)
    sd = a[:, problem.n_dim : 2 * problem.n_dim].mean(axis=0)
    # The comparison is worth something: together the errors are below a tenth of a posterior sd.
    error = np.sqrt(a.var(axis=0, ddof=1) / RUNS + b.var(axis=0, ddof=1) / RUNS)
    assert np.all(error[: problem.n_dim] < 0.1 * sd)
    assert error[-1] < 0.2
    apart = {
        label: (float(x), float(y), p)
        for label, x, y, p in zip(
            labels(problem), a.mean(axis=0), b.mean(axis=0), adjusted, strict=True
        )
        if p < FAMILY
    }
    assert not apart
