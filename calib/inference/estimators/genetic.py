"""The genetic algorithm of the source (Eqs 10-11, Table 2), after Cabrera et al. (2004).

One generation, for each parent X of a population of NP:

1. a disturbing vector V = X_best + F (X_r1 - X_r2) (Eq 11), r1 and r2 drawn for this parent;
2. crossover: each gene of the descendant is V's with probability CP, else the parent's;
3. mutation: each gene of the descendant changes with probability MP;
4. the descendant replaces its parent if it is fitter (Eq 10).

The source leaves four things open, which are settled here as follows.

- The amount of a mutation is drawn uniformly from the mutation interval *in units of the width of
  the search box*, its sign at random: added raw, an amount of up to 1 would throw a B of 0.1 out of
  any sensible box.
- A gene that would leave the box stays the parent's. (Put on the edge, genes gather there: at
  18 psi 3 % of the runs then end in a local optimum on the edge C = 2, and none do like this.)
- r1 and r2 differ from each other, not necessarily from the parent.
- All descendants of a generation see the parents' generation, so that one batched model evaluation
  serves all of them.

The source runs 4000 generations at most; here a run ends once the whole population has converged.
Its mutations do not lead out of a local optimum that all of it has converged on.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib.errors import CalibError
from calib.inference.estimators.search import Box, Found, PointEstimate, SearchSpace, search_in_box
from calib.inference.problem import Problem
from calib.models.base import Array

# Generations whose random numbers are drawn in one call. Changing it changes what a seed gives.
_BLOCK = 32


@dataclass(frozen=True)
class GeneticSettings:
    """Settings of the genetic algorithm; the defaults are Table 2 of the source.

    `F` weighs the difference in the disturbing vector, `CP` and `MP` are the probabilities of
    crossover and mutation per gene, the mutation interval is in units of the width of the search
    box, and `NP` is the size of the population. A run stops early once the costs of the whole
    population differ by no more than `tolerance` of the lowest for `patience` generations in a row.
    """

    F: float = 0.4
    CP: float = 0.6
    MP: float = 0.1
    mutation_low: float = 0.0
    mutation_high: float = 1.0
    NP: int = 50
    max_iterations: int = 4000
    tolerance: float = 1e-12
    patience: int = 5

    def __post_init__(self) -> None:
        checks = (
            (self.F > 0.0, "F", "a positive number"),
            (0.0 <= self.CP <= 1.0, "CP", "a probability from 0 to 1"),
            (0.0 <= self.MP <= 1.0, "MP", "a probability from 0 to 1"),
            (0.0 <= self.mutation_low <= self.mutation_high, "mutation_low", "0 to mutation_high"),
            (self.NP >= 3, "NP", "a whole number of at least 3"),
            (self.max_iterations >= 1, "max_iterations", "a whole number of at least 1"),
            (self.tolerance >= 0.0, "tolerance", "a number of at least 0"),
            (self.patience >= 1, "patience", "a whole number of at least 1"),
        )
        for fine, name, allowed in checks:
            if not fine:
                raise CalibError(
                    f"the genetic algorithm cannot run with {name} = {getattr(self, name)}",
                    where="genetic settings",
                    expected=allowed,
                    hint="Table 2 of the source has F 0.4, CP 0.6, MP 0.1, interval 0 to 1, NP 50",
                )


class GeneticDraws(NamedTuple):
    """The random numbers of some generations, each array with a leading axis of generations.

    r1 and r2 of each parent, (g, NP); whether a gene is the disturbing vector's, (g, NP, d);
    amounts of mutation in units of the box, (g, NP, d), zero for genes that do not mutate.
    """

    first: NDArray[np.intp]
    second: NDArray[np.intp]
    crossed: NDArray[np.bool_]
    mutation: Array


def draw_generations(
    rng: np.random.Generator, n_generations: int, d: int, settings: GeneticSettings
) -> GeneticDraws:
    """Draw the random numbers of some generations."""
    size = settings.NP
    pair = rng.random((2, n_generations, size))
    first = (pair[0] * size).astype(np.intp)
    # Offset by 1 to NP - 1 places, so that r2 is never r1.
    second = (first + 1 + (pair[1] * (size - 1)).astype(np.intp)) % size
    gene = rng.random((3, n_generations, size, d))
    signed = 2.0 * gene[2] - 1.0
    amount = settings.mutation_low + (settings.mutation_high - settings.mutation_low) * abs(signed)
    mutation = np.where(gene[1] < settings.MP, np.copysign(amount, signed), 0.0)
    return GeneticDraws(first, second, gene[0] < settings.CP, mutation)


def descendants(
    population: Array, best: Array, draws: GeneticDraws, F: float, lower: Array, upper: Array
) -> Array:
    """Make the descendants of one generation (Eq 11, crossover, mutation), shape (NP, d).

    `draws` are of this generation, without the leading axis; `lower` and `upper` (d,) are the box.
    """
    disturbing = best + F * (population.take(draws.first, 0) - population.take(draws.second, 0))
    child = np.where(draws.crossed, disturbing, population)
    child += draws.mutation * (upper - lower)
    return np.where((child < lower) | (child > upper), population, child)


class GeneticResult(NamedTuple):
    """What `minimise_genetic` returns.

    `x` (d,), and the lowest cost of the first population and after each generation. Converged is a
    population that agrees before the last iteration.
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
    """Minimise a cost over a box, shapes (d,), in which the first population is drawn uniformly.

    The cost ``(k, d) -> (k,)``, ``inf`` where it has no value, is called once per generation;
    settings are Table 2's by default.

    References
    ----------
    Cabrera, Ortiz, Carabias & Simon (2004), doi:10.1076/vesd.41.2.109.26496, as Eqs 10-11 and
    Table 2 of He, Sandu & Osorio (2019), doi:10.1016/j.jterra.2019.07.003.
    """
    s = settings or GeneticSettings()
    population = lower + (upper - lower) * rng.random((s.NP, lower.size))
    costs = np.array(cost(population))
    there = costs[np.isfinite(costs)]
    # An exact fit has no lowest cost to compare with: the costs' rounding then ends the run.
    floor = 1e-24 * float(np.median(there)) if there.size else 0.0
    history, calm = [costs.min()], 0
    for generation in range(s.max_iterations):
        if generation % _BLOCK == 0:
            block = draw_generations(rng, _BLOCK, lower.size, s)
        draws = GeneticDraws(*(part[generation % _BLOCK] for part in block))
        children = descendants(population, population[costs.argmin()], draws, s.F, lower, upper)
        child_costs = cost(children)
        fitter = child_costs < costs
        population[fitter], costs[fitter] = children[fitter], child_costs[fitter]
        history.append(costs.min())
        tolerated = history[-1] * (1.0 + s.tolerance) + floor
        calm = calm + 1 if costs.max() <= tolerated < np.inf else 0
        if calm == s.patience:
            break
    return GeneticResult(
        population[costs.argmin()], float(history[-1]), s.NP * len(history), np.array(history),
        calm == s.patience,
    )  # fmt: skip


def estimate_genetic(
    problem: Problem,
    rng: np.random.Generator,
    *,
    settings: GeneticSettings | None = None,
    box: Box | None = None,
    restarts: int = 0,
    polish: bool = False,
) -> PointEstimate:
    """Minimise the sum of squares by the genetic algorithm of the source, Table 2 by default.

    The box is that of `search_space`. Not in the source: `restarts` are further runs from new
    populations, of which the best counts, as a population never leaves a local optimum on which it
    has converged; `polish` adds a least-squares descent from the result.
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
