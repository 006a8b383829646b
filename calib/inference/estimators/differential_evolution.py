"""SciPy's differential evolution, the yardstick of the genetic algorithm."""

from __future__ import annotations

from typing import Any

import numpy as np

from calib.inference.estimators.base import PointEstimate
from calib.inference.estimators.search import Box, Found, SearchSpace, search_in_box
from calib.inference.problem import Problem
from calib.models.base import Array

# Instead of `inf`, with which the population's spread, SciPy's stopping rule, is undefined.
_WORST = 1e100


def estimate_differential_evolution(
    problem: Problem, rng: np.random.Generator, *, box: Box | None = None, **settings: Any
) -> PointEstimate:
    """Minimise the sum of squares by `scipy.optimize.differential_evolution`.

    A generation is one batched model evaluation. The box is as for
    `calib.inference.estimators.search.search_space`, the other settings are SciPy's, and
    so are their defaults.
    """
    from scipy.optimize import differential_evolution  # late: a tenth of a second

    def minimise(space: SearchSpace) -> Found:
        evaluated = 0

        def cost(x: Array) -> Array:
            nonlocal evaluated
            values = space.cost(np.atleast_2d(x.T))
            evaluated += values.size
            return np.minimum(values, _WORST)

        # The stubs know the scalar signature only.
        batched: Any = cost
        result = differential_evolution(
            batched,
            list(zip(space.lower, space.upper, strict=True)),
            vectorized=True,
            updating="deferred",
            rng=rng,
            **settings,
        )
        return Found(np.asarray(result.x), evaluated, bool(result.success))

    return search_in_box(problem, "differential_evolution", box, minimise)
