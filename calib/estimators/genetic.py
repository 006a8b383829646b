"""The genetic algorithm of the source (Eqs 10-11, Table 2), after Cabrera et al. (2004).

One generation, and what the source leaves open of it, is in `calib.estimators.generation`.
The source runs 4000 generations at most; here a run ends once the whole population has converged.
Its mutations do not lead out of a local optimum that all of it has converged on.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from calib.estimators.base import PointEstimate
from calib.estimators.generation import (
    GeneticDraws,
    GeneticSettings,
    descendants,
    draw_generations,
)
from calib.estimators.search import Box, Found, SearchSpace, search_in_box
from calib.models.base import Array
from calib.problem import Problem

__all__ = ["GeneticResult", "GeneticSettings", "estimate_genetic", "minimise_genetic"]

# Generations whose random numbers are drawn in one call: the calls would cost more than the
# numbers. Part of what a seed means; changing it changes the numbers of a run.
_BLOCK = 32


class GeneticResult(NamedTuple):
    """What `minimise_genetic` returns.

    Parameters
    ----------
    x : ndarray, shape (d,)
    cost : float
    n_evaluations : int
    history : ndarray, shape (generations + 1,)
        Lowest cost of the first population and after each generation.
    converged : bool
        Whether the population converged before the last iteration.
    """

    x: Array
    cost: float
    n_evaluations: int
    history: Array
    converged: bool


def minimise_genetic(
    cost: Callable[[Array], Array],
    lower: Array,
    upper: Array,
    rng: np.random.Generator,
    settings: GeneticSettings | None = None,
) -> GeneticResult:
    """Minimise a cost over a box.

    Parameters
    ----------
    cost : callable
        ``(k, d) -> (k,)``, ``inf`` where it has no value; called once per generation.
    lower, upper : ndarray, shape (d,)
        The search box, in which the first population is drawn uniformly.
    rng : Generator
    settings : GeneticSettings, optional
        Table 2 by default.

    References
    ----------
    Cabrera, Ortiz, Carabias & Simon (2004), doi:10.1076/vesd.41.2.109.26496, as Eqs 10-11 and
    Table 2 of He, Sandu & Osorio (2019), doi:10.1016/j.jterra.2019.07.003.
    """
    s = settings or GeneticSettings()
    d = lower.size
    population = lower + (upper - lower) * rng.random((s.NP, d))
    costs = cost(population)
    lead = int(costs.argmin())
    history = [float(costs[lead])]
    # An exact fit has no lowest cost to compare with: the costs' rounding then ends the run.
    finite = costs[np.isfinite(costs)]
    floor = 1e-24 * float(np.median(finite)) if finite.size else 0.0
    calm = 0
    for generation in range(s.max_iterations):
        row = generation % _BLOCK
        if row == 0:
            block = draw_generations(rng, _BLOCK, d, s)
        draws = GeneticDraws(*(part[row] for part in block))
        children = descendants(population, population[lead], draws, s.F, lower, upper)
        new = cost(children)
        fitter = new < costs
        population[fitter] = children[fitter]
        costs[fitter] = new[fitter]
        lead = int(costs.argmin())
        lowest = float(costs[lead])
        history.append(lowest)
        alike = costs.max() <= lowest * (1.0 + s.tolerance) + floor < np.inf
        calm = calm + 1 if alike else 0
        if calm == s.patience:
            break
    n_evaluations = s.NP * len(history)
    return GeneticResult(
        population[lead].copy(), lowest, n_evaluations, np.array(history), calm == s.patience
    )


def estimate_genetic(
    problem: Problem,
    rng: np.random.Generator,
    *,
    settings: GeneticSettings | None = None,
    box: Box | None = None,
    restarts: int = 0,
    polish: bool = False,
) -> PointEstimate:
    """Minimise the sum of squares by the genetic algorithm of the source.

    Parameters
    ----------
    problem : Problem
    rng : Generator
    settings : GeneticSettings, optional
        Table 2 by default.
    box : mapping of str to (lower, upper), optional
        As for `calib.estimators.search.search_space`.
    restarts : int
        Further runs from fresh populations, the best of all being returned. Not in the source: a
        population that has converged on a local optimum never leaves it, however long it runs.
    polish : bool
        Whether least squares from the result follows. Not in the source.
    """

    def minimise(space: SearchSpace) -> Found:
        runs = [
            minimise_genetic(space.cost, space.lower, space.upper, rng, settings)
            for _ in range(restarts + 1)
        ]
        best = min(runs, key=lambda run: run.cost)
        n_evaluations = sum(run.n_evaluations for run in runs)
        note = f"{best.history.size - 1} generations"
        if restarts:
            note += f", the best of {len(runs)} runs"
        if not polish:
            return Found(best.x, n_evaluations, best.converged, note)
        polished = space.polish(best.x)
        return Found(polished.x, n_evaluations + polished.n_evaluations, True, f"{note}, polished")

    return search_in_box(problem, "genetic", box, minimise)
