"""Parameters spread over a prior."""

from __future__ import annotations

import numpy as np

from calib.inference.problem import Problem
from calib.inference.random import generator
from calib.models.base import Array

_TRIMMED = 0.002


def prior_design(problem: Problem, count: int, seed: int, *, latin: bool = False) -> Array:
    """Return natural parameters of the model spread over the prior, shape (count, d).

    By Sobol's sequence, of which every beginning is even, or a Latin hypercube.
    """
    from scipy.stats import qmc  # late: half a second, and few commands emulate

    d = len(problem.priors.free)
    bits = int(np.ceil(np.log2(max(count, 2))))
    rng = generator(seed, "emulate", "design")
    if latin:
        u = qmc.LatinHypercube(d, rng=rng).random(count)
    else:
        u = qmc.Sobol(d, scramble=True, rng=rng).random_base2(bits)[:count]
    t = problem.priors.ppf(_TRIMMED + (1.0 - 2.0 * _TRIMMED) * u)
    return problem.of_model(problem.theta(t))


def prior_middle(problem: Problem) -> Array:
    """Return natural parameters of the model at the medians of the prior, shape (1, d)."""
    t = problem.priors.ppf(np.full((1, len(problem.priors.free)), 0.5))
    return problem.of_model(problem.theta(t))
