"""Point estimates: several methods, one problem in, one `PointEstimate` out.

The genetic algorithm is that of the source (Eqs 10-11, Table 2), after Cabrera et al. (2004). One
generation, for each parent X of a population of NP:

1. a disturbing vector V = X_best + F (X_r1 - X_r2) (Eq 11), r1 and r2 drawn for this parent;
2. crossover: each gene of the descendant is V's with probability CP, else the parent's;
3. mutation: each gene of the descendant changes with probability MP;
4. the descendant replaces its parent if it is fitter (Eq 10).

The source leaves four things open, which are settled here as follows.

- The amount of a mutation is drawn uniformly from the mutation interval *in units of the width of
  the search box*, its sign at random: added raw, an amount of up to 1 would throw a B of 0.1 out of
  any sensible box.
- A gene that would leave the box stays the parent's: on the edge, genes would gather.
- r1 and r2 differ from each other, not necessarily from the parent.
- All descendants of a generation see the parents' generation, so that one batched model evaluation
  serves all of them.

The source runs 4000 generations at most; here a run ends once the whole population has converged.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib.batch.environment import one_thread
from calib.data.registry import Registry
from calib.errors import CalibError
from calib.inference.design import try_simulator
from calib.inference.problem import Problem
from calib.inference.search import (
    Box,
    Minimum,
    PointEstimate,
    SearchSpace,
    central_interval,
    check_defined,
    descend_from,
    edge_notes,
    estimate_differential_evolution,
    fit_identified,
    representative_rows,
    scatter_of,
    search_in_box,
    sum_of_squares,
)
from calib.models import get_model
from calib.models.base import Array


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
        if generation % 32 == 0:  # another length of a block changes what a seed gives
            block = draw_generations(rng, 32, lower.size, s)
        draws = GeneticDraws(*(part[generation % 32] for part in block))
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

    def minimise(space: SearchSpace) -> Minimum:
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
            return Minimum(best.x, n_evaluations, best.converged, note)
        polished = space.polish(best.x)
        return Minimum(
            polished.x, n_evaluations + polished.n_evaluations, True, f"{note}, polished"
        )

    return search_in_box(problem, "genetic", box, minimise)


def estimate_least_squares(
    problem: Problem, rng: np.random.Generator, *, n_screen: int = 1024, n_polish: int = 4
) -> PointEstimate:
    """Minimise the sum of squares from many starts within the prior's bounds.

    Prior draws are screened in one batched evaluation, and the best of each of `n_polish` groups is
    polished by SciPy's trust-region reflective method. Of more than a few thousand rows a
    representative part is used, and the best result is polished on all of them.
    """

    def fit(reduced: Problem) -> tuple[Array, Minimum, str]:
        rough = representative_rows(reduced)
        polished = [descend_from(rough, t) for t in _starts(rough, rng, n_screen, n_polish)]
        best = min(polished, key=lambda p: p.cost)
        floor = 1e-18 * scatter_of(rough) ** 2  # of an exact fit costs are rounding
        n_agree = sum(p.cost <= best.cost * (1.0 + 1e-9) + floor for p in polished)
        evaluations = max(n_screen, n_polish) + sum(p.n_evaluations for p in polished)
        if rough is not reduced:
            best = descend_from(reduced, best.x)
            evaluations += best.n_evaluations
        x = best.x
        lower, upper = np.array([(p.lower, p.upper) for p in reduced.priors.free]).T
        valley = "the cost still falls along a valley without end in sight"
        said = [f"{n_agree} of {len(polished)} starts end at the lowest cost"]
        said += [] if best.converged else [valley]
        edges = edge_notes(reduced.names, x, lower, upper, "the prior's bounds")
        notes = "; ".join(filter(None, (edges, _far_note(reduced, x))))
        theta = reduced.of_model(reduced.theta(x[None]))[0]
        return theta, Minimum(x, evaluations, best.converged, "; ".join(said)), notes

    return fit_identified(problem, "least_squares", fit)


def _far_note(problem: Problem, x: Array) -> str:
    """Name the estimates that the prior deems almost impossible."""
    low, high = central_interval(problem)
    far = [n for n, out in zip(problem.names, (x < low) | (x > high), strict=True) if out]
    return f"{', '.join(far)} outside the prior's central 99.8 %" if far else ""


def _starts(problem: Problem, rng: np.random.Generator, n_screen: int, n_polish: int) -> Array:
    drawn = problem.priors.sample(rng, max(n_screen, n_polish))
    cost = sum_of_squares(problem, problem.theta(drawn))
    groups = np.array_split(np.arange(len(drawn)), n_polish)
    # Not the best of all, which may share one basin.
    best = np.array([group[cost[group].argmin()] for group in groups])
    best = best[np.isfinite(cost[best])]
    if best.size == 0:
        theta = problem.of_model(problem.theta(drawn))
        check_defined(
            problem.bound, theta, problem.conditions, problem.table.source, problem.table.lines
        )
        raise CalibError(
            f"{problem.bound.model.name} has no value for some rows, wherever in the "
            "prior its parameters are drawn",
            where=problem.table.source,
            hint="look for impossible conditions in the data, or widen the prior",
        )
    return np.asarray(drawn[best])


__all__ = [
    "METHODS", "GeneticSettings", "Method", "PointEstimate", "compare", "estimate", "method_name",
    "methods_for", "minimise_genetic",
]  # fmt: skip


@dataclass(frozen=True)
class Method:
    """A way to estimate the parameters of a model.

    `estimate` is ``(problem, rng, **settings) -> PointEstimate``; `title`, `short` and `words` name
    it in a legend, at the head of a narrow column, and in a sentence. It is for the named `models`,
    or for all; the least `place` comes first.
    """

    name: str
    estimate: Callable[..., PointEstimate]
    title: str
    short: str
    words: str
    models: tuple[str, ...] = ()
    place: int = 100

    def register(self) -> None:
        """Apply it wherever all methods apply."""
        METHODS.add(self)


METHODS: Registry[Method] = Registry(
    "method of estimation",
    lambda method: method.name,
    Method("genetic", estimate_genetic, "genetic algorithm", "GA", "the genetic algorithm",
           place=10),
    Method(
        "differential_evolution", estimate_differential_evolution, "differential evolution", "DE",
        "differential evolution", place=20,
    ),
    Method("least_squares", estimate_least_squares, "least squares", "LS",
           "multi-start least squares", place=30),
)  # fmt: skip


def method_name(name: str) -> str:
    """Return the name of a method for a legend."""
    return METHODS[name].title if name in METHODS else name


def methods_for(model_name: str) -> tuple[str, ...]:
    """Return the methods that apply to a model, in their order."""
    name = get_model(model_name).name
    known = sorted(METHODS.values(), key=lambda method: method.place)
    return tuple(m.name for m in known if not m.models or name in m.models)


@one_thread()
def estimate(
    problem: Problem, method: str, rng: np.random.Generator, **settings: Any
) -> PointEstimate:
    """Estimate the parameters of a problem by one method.

    Settings are keyword arguments of the method's function, such as
    ``settings=GeneticSettings(NP=100)`` for ``"genetic"``. A CalibError if the method does not
    exist, does not apply to the model, or fails on these data.

    Examples
    --------
    >>> import calib
    >>> ruts = calib.load_he2019("rut_depth")
    >>> import numpy as np
    >>> problem = calib.build_problem("bekker", ruts)
    >>> found = calib.estimate(problem, "least_squares", np.random.default_rng(1))
    >>> found.converged
    True
    """
    model = problem.bound.model.name
    if method not in methods_for(model):
        found = f"method {method!r} does not apply to model {model}"
        raise CalibError(
            found if method in METHODS else f"there is no method {method!r}",
            expected=", ".join(methods_for(model)),
            hint="use one of these methods",
        )
    try_simulator(problem)
    return METHODS[method].estimate(problem, rng, **settings)


def compare(
    problem: Problem, rng: np.random.Generator, methods: Sequence[str] | None = None
) -> tuple[PointEstimate, ...]:
    """Estimate by several methods, each on its own random stream, in the order of the methods.

    By default these are all that apply to the model, without those that cannot read the data (no
    rise of the pull, one ground pressure); methods that are named raise their error.
    """
    found = []
    chosen = methods_for(problem.bound.model.name) if methods is None else tuple(methods)
    for method, stream in zip(chosen, rng.spawn(len(chosen)), strict=True):
        try:
            found.append(estimate(problem, method, stream))
        except CalibError:
            if methods is not None:
                raise
    return tuple(found)
