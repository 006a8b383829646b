"""Does the genetic algorithm converge with Table 2's settings? Its cost over many seeds.

The true optimum is that of multi-start least squares. Three searches: each pressure by itself, in
the source's coordinates B, C, D and E; the joint fit in this package's coordinates (values at the
end pressures); and the joint fit in the coordinates that Table 5 prints, c1 to c9 and b0, whose
search box is not printed and is taken as 30 times the printed figure, with its sign.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from calib.batch.pool import Pool
from calib.batch.threads import one_thread
from calib.data import Table
from calib.he2019.audit.finding import (
    Finding,
    Quantity,
    Verdict,
    finding,
)
from calib.he2019.audit.nearness import pressure_curves, printed_coefficients
from calib.he2019.datasets.embedded import load_he2019
from calib.he2019.datasets.published import Published
from calib.inference.estimators import (
    GeneticSettings,
    PointEstimate,
    estimate,
)
from calib.inference.estimators.genetic import minimise_genetic_runs
from calib.inference.estimators.identified import hold_unidentified
from calib.inference.estimators.search import search_space
from calib.inference.problem import Problem, build_problem
from calib.inference.random import generator
from calib.models.base import Array
from calib.report.study import Progress
from calib.validation.scores import jeffreys

_BOX = 30.0
_C_RANGE = (1.0, 2.0)
# A search has arrived if its cost exceeds the optimum by less than this part of it.
_ARRIVED = 0.01


@dataclass(frozen=True)
class Seeds:
    """How many seeds each search is repeated with."""

    by_pressure: int = 20
    joint: int = 10
    printed_coordinates: int = 10


@dataclass(frozen=True, eq=False)
class Search:
    """One search, repeated over seeds.

    In kN^2: the least cost known, the final cost by seed, shape (n_seeds,), and the printed one.
    """

    name: str
    optimum: float
    costs: Array
    published: str

    @property
    def arrived(self) -> int:
        """Seeds whose cost is within 1 % of the optimum."""
        return int(np.sum(self.costs <= self.optimum * (1.0 + _ARRIVED)))

    @property
    def share(self) -> Quantity:
        """Part of the seeds that arrived, with its 95 % Jeffreys interval."""
        hits, n = self.arrived, self.costs.size
        return Quantity(f"seeds that reach the optimum, {self.name}", hits / n, "1",
                        *jeffreys(hits, n), f"95 % Jeffreys, {hits} of {n}")  # fmt: skip


@dataclass(frozen=True, eq=False)
class GeneticStudy:
    """All searches with Table 2's settings, and the geometric method on the same data; by psi."""

    settings: GeneticSettings
    by_pressure: Mapping[int, Search]
    joint: Search
    printed_coordinates: Search
    read_off: Mapping[int, PointEstimate] = field(default_factory=dict)

    @property
    def searches(self) -> tuple[Search, ...]:
        """All of them, in the order they are shown in."""
        return (*self.by_pressure.values(), self.joint, self.printed_coordinates)


def printed_settings(published: Published) -> GeneticSettings:
    """Return Table 2's settings."""
    s = {name: figure.value for name, figure in published.setup.genetic_settings.items()}
    return GeneticSettings(
        F=s["F"], CP=s["CP"], MP=s["MP"], mutation_low=s["mutation_low"],
        mutation_high=s["mutation_high"], NP=int(s["NP"]), max_iterations=int(s["iterations"]),
    )  # fmt: skip


def begin_convergence(
    published: Published, seed: int, seeds: Seeds, pool: Pool
) -> Callable[[Progress], GeneticStudy]:
    """Ask for the searches over seeds, on the reconstructed data; return what waits for them."""
    settings = printed_settings(published)
    box = _printed_box(published)
    printed = [
        pool.submit(_in_printed_coordinates, box, seed, runs, settings)
        for runs in _parts(seeds.printed_coordinates)
    ]
    joint_text = published.pressure.quality["cost"].text
    joint = pool.submit(_repeat_joint, joint_text, seed, seeds.joint, settings)
    by_pressure = {
        psi: pool.submit(_repeat_alone, psi, table.quality["cost"].text, seed, seeds.by_pressure,
                         settings)
        for psi, table in published.genetic.items()
    }  # fmt: skip
    planned = seeds.by_pressure * len(by_pressure) + seeds.joint + seeds.printed_coordinates

    def finish(tell: Progress) -> GeneticStudy:
        what = "genetic algorithm over seeds"
        alone = {}
        for i, (psi, piece) in enumerate(by_pressure.items()):
            alone[psi] = piece.result()
            tell(what, (i + 1) * seeds.by_pressure, planned)
        together = joint.result()
        tell(what, planned - seeds.printed_coordinates, planned)
        costs = np.concatenate([piece.result() for piece in printed])
        tell(what, planned, planned)
        table = load_he2019("drawbar_pull")
        read_off = {
            psi: estimate(_alone(table, psi), "geometric", generator(seed, "audit", "geometric"))
            for psi in published.genetic
        }
        return GeneticStudy(
            settings, alone, together,
            Search("all pressures, c1 to b0", together.optimum, costs, joint_text), read_off,
        )  # fmt: skip

    return finish


def _parts(n: int) -> list[range]:
    """Halves of some runs, which take longest, to be done side by side."""
    return [range(n // 2), range(n // 2, n)] if n > 1 else [range(n)]


def _repeat_alone(psi: int, text: str, seed: int, n: int, settings: GeneticSettings) -> Search:
    problem = _alone(load_he2019("drawbar_pull"), psi)
    return _repeat(problem, f"{psi} psi", text, seed, ("audit", "genetic", f"{psi}"), n, settings)


def _repeat_joint(text: str, seed: int, n: int, settings: GeneticSettings) -> Search:
    problem = build_problem("magic_formula_pressure", load_he2019("drawbar_pull"))
    labels = ("audit", "genetic", "joint")
    return _repeat(problem, "all pressures", text, seed, labels, n, settings)


def _alone(table: Table, psi: int) -> Problem:
    rows = table.take(np.isclose(table["inflation_pressure_psi"], psi))
    return build_problem("magic_formula", rows, fixed={"Sh": 0.0, "Sv": 0.0})


@one_thread()
def _repeat(
    problem: Problem, name: str, text: str, seed: int, labels: tuple[str, ...], n: int,
    settings: GeneticSettings,
) -> Search:  # fmt: skip
    optimum = estimate(problem, "least_squares", generator(seed, *labels, "optimum")).cost
    space = search_space(hold_unidentified(problem)[0])
    streams = [generator(seed, *labels, i) for i in range(n)]
    runs = minimise_genetic_runs(space.cost, space.lower, space.upper, streams, settings)
    costs = [run.cost for run in runs]
    return Search(name, min(optimum, *costs), np.array(costs), text)


def _printed_box(published: Published) -> tuple[Array, Array]:
    """Return the box of c1 to c9 and b0 that is searched, shapes (10,)."""
    printed = printed_coefficients(published)
    # The optimum has c9 positive, and so has Table 5 (`calib.he2019.audit.curvature_signs`).
    printed[8] = abs(printed[8])
    lower, upper = np.minimum(0.0, _BOX * printed), np.maximum(0.0, _BOX * printed)
    lower[9], upper[9] = _C_RANGE
    return lower, upper


@one_thread()
def _in_printed_coordinates(
    box: tuple[Array, Array], seed: int, runs: range, settings: GeneticSettings
) -> Array:
    """Return the costs of searches in c1 to c9 and b0, one for each run."""
    table = load_he2019("drawbar_pull")
    pressures = np.unique(table["inflation_pressure_psi"])
    rows = [np.isclose(table["inflation_pressure_psi"], p) for p in pressures]
    slips = 100.0 * table["slip_ratio"][rows[0]]
    observed = np.stack([table["drawbar_pull_kn"][r] for r in rows])

    def cost(x: Array) -> Array:
        apart = pressure_curves(x, pressures, slips) - observed
        return np.asarray(np.einsum("kmn,kmn->k", apart, apart))

    streams = [generator(seed, "audit", "genetic", "printed", i) for i in runs]
    return np.array([run.cost for run in minimise_genetic_runs(cost, *box, streams, settings)])


def convergence_findings(study: GeneticStudy) -> list[Finding]:
    """Judge the convergence of the algorithm, pressure by pressure and jointly."""
    return [_by_pressure(study), _joint(study)]


def _by_pressure(study: GeneticStudy) -> Finding:
    searches = list(study.by_pressure.values())
    everywhere = all(s.arrived == s.costs.size for s in searches)
    return finding(
        "genetic_by_pressure", Verdict.CONFIRMED if everywhere else Verdict.CONTRADICTED,
        [s.share for s in searches], hits=sum(s.arrived for s in searches),
        n=sum(s.costs.size for s in searches), low=min(s.share.lower for s in searches),
        excess=max(float((s.costs / s.optimum - 1.0).max()) for s in searches),
    )  # fmt: skip


def _joint(study: GeneticStudy) -> Finding:
    ours, printed = study.joint, study.printed_coordinates
    costs, worst = printed.costs, float(printed.costs.max())
    always = ours.arrived == ours.costs.size and printed.arrived == costs.size
    return finding(
        "genetic_joint", Verdict.CONFIRMED if always else Verdict.CONTRADICTED,
        (ours.share, printed.share,
         Quantity("cost in c1 to b0", float(np.median(costs)), "kN^2", float(costs.min()), worst,
                  "over seeds", printed.published)),
        ours=ours, printed=printed, worst=worst,
    )  # fmt: skip
