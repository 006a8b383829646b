"""What needs searching: the genetic algorithm over seeds, and the signs of c7, c8 and c9.

E(p) of Table 5 is far from Table 4's under every reading, so nearness of E decides nothing: at
18 psi the pull hardly depends on it. The pull does decide. For each reading, the coefficients that
print alike are searched for the least total cost (Eq 16) that any data compatible with Table 4
could give them; the source printed a total. The bound takes Table 4 for the least-squares optimum
of each pressure and needs the slips, so it is repeated with other shifts of zero slip.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.optimize import minimize

from calib.batch.environment import one_thread
from calib.data import Table
from calib.he2019.audit.bounds import (
    ASSUMED_SLIPS,
    COEFFICIENTS,
    joint_bounds,
    pressure_curves,
    printed_coefficients,
    references,
)
from calib.he2019.audit.finding import Finding, Quantity, Verdict, finding
from calib.he2019.audit.table5 import READINGS, Signs, printed_signs, signs_text
from calib.he2019.embedded import load_he2019
from calib.he2019.published import Published
from calib.he2019.reconstruction import SLIP_SHIFT
from calib.inference.estimators import GeneticSettings, PointEstimate, estimate, minimise_genetic
from calib.inference.problem import Problem, build_problem
from calib.inference.random import generator
from calib.inference.search import hold_unidentified, search_space
from calib.models.base import Array
from calib.report.study import Progress
from calib.validation.scores import jeffreys


@dataclass(frozen=True)
class Seeds:
    """How many seeds each search is repeated with."""

    by_pressure: int = 20
    joint: int = 10
    printed_coordinates: int = 10


@dataclass(frozen=True, eq=False)
class Search:
    """A search over seeds, in kN^2: least cost known, final costs (n_seeds,), the printed one."""

    name: str
    optimum: float
    costs: Array
    published: str

    @property
    def arrived(self) -> int:
        """Seeds whose cost is within 1 % of the optimum."""
        return int(np.sum(self.costs <= 1.01 * self.optimum))

    @property
    def share(self) -> Quantity:
        """Part of the seeds that arrived, with its 95 % Jeffreys interval."""
        hits, n = self.arrived, self.costs.size
        return Quantity(f"seeds that reach the optimum, {self.name}", hits / n, "1",
                        *jeffreys(hits, n), f"95 % Jeffreys, {hits} of {n}")  # fmt: skip


@dataclass(frozen=True, eq=False)
class GeneticStudy:
    """All searches with Table 2's settings, and the geometric method on the same data; by psi."""

    by_pressure: Mapping[int, Search]
    joint: Search
    printed_coordinates: Search
    read_off: Mapping[int, PointEstimate]

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


def study_convergence(
    published: Published, seed: int, seeds: Seeds, pool: Executor, tell: Progress
) -> GeneticStudy:
    """Repeat the searches over seeds, on the reconstructed data."""
    settings, box = printed_settings(published), _printed_box(published)
    # These take longest: two halves, side by side.
    n = seeds.printed_coordinates
    halves = [range(n // 2), range(n // 2, n)] if n > 1 else [range(n)]
    printed = [pool.submit(_in_printed_coordinates, box, seed, runs, settings) for runs in halves]
    texts = {psi: t.quality["cost"].text for psi, t in published.genetic.items()}
    joint = published.pressure.quality["cost"].text
    asked = [pool.submit(_repeat, *of, seed, seeds.by_pressure, settings) for of in texts.items()]
    asked.append(pool.submit(_repeat, None, joint, seed, seeds.joint, settings))
    planned = seeds.by_pressure * len(texts) + seeds.joint + n
    what, found, done = "genetic algorithm over seeds", list[Search](), 0
    for piece in asked:
        found.append(piece.result())
        done += found[-1].costs.size
        tell(what, done, planned)
    costs = np.concatenate([piece.result() for piece in printed])
    tell(what, planned, planned)
    table = load_he2019("drawbar_pull")
    read_off = {
        psi: estimate(at_pressure(table, psi), "geometric", generator(seed, "audit", "geometric"))
        for psi in texts
    }
    *alone, together = found
    in_printed = Search("all pressures, c1 to b0", together.optimum, costs, joint)
    return GeneticStudy(dict(zip(texts, alone, strict=True)), together, in_printed, read_off)


def at_pressure(table: Table, psi: int) -> Problem:
    """Return the problem of one pressure by itself, as Tables 3 and 4 fit it."""
    rows = table.take(np.isclose(table["inflation_pressure_psi"], psi))
    return build_problem("magic_formula", rows, fixed={"Sh": 0.0, "Sv": 0.0})


@one_thread()
def _repeat(psi: int | None, text: str, seed: int, n: int, settings: GeneticSettings) -> Search:
    """Repeat the search at one pressure, or of all together."""
    table = load_he2019("drawbar_pull")
    if psi is None:
        problem, name = build_problem("magic_formula_pressure", table), "all pressures"
    else:
        problem, name = at_pressure(table, psi), f"{psi} psi"
    labels = ("audit", "genetic", "joint" if psi is None else f"{psi}")
    optimum = estimate(problem, "least_squares", generator(seed, *labels, "optimum")).cost
    space = search_space(hold_unidentified(problem)[0])
    costs = [
        minimise_genetic(
            space.cost, space.lower, space.upper, generator(seed, *labels, i), settings
        ).cost
        for i in range(n)
    ]
    return Search(name, min(optimum, *costs), np.array(costs), text)


def _printed_box(published: Published) -> tuple[Array, Array]:
    """Return the box of c1 to c9 and b0 that is searched, shapes (10,)."""
    printed = printed_coefficients(published)
    printed[8] = abs(printed[8])  # c9 is positive at the optimum, and by the audit in Table 5 too
    lower, upper = np.minimum(0.0, 30.0 * printed), np.maximum(0.0, 30.0 * printed)
    lower[9], upper[9] = 1.0, 2.0
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

    streams = (generator(seed, "audit", "genetic", "printed", i) for i in runs)
    return np.array([minimise_genetic(cost, *box, rng, settings).cost for rng in streams])


def convergence_findings(study: GeneticStudy) -> list[Finding]:
    """Judge the convergence of the algorithm, pressure by pressure and jointly."""
    searches = list(study.by_pressure.values())
    everywhere = all(s.arrived == s.costs.size for s in searches)
    by_pressure = finding(
        "genetic_by_pressure", Verdict.CONFIRMED if everywhere else Verdict.CONTRADICTED,
        [s.share for s in searches], hits=sum(s.arrived for s in searches),
        n=sum(s.costs.size for s in searches), low=min(s.share.lower for s in searches),
        excess=max(float((s.costs / s.optimum - 1.0).max()) for s in searches),
    )  # fmt: skip
    ours, printed = study.joint, study.printed_coordinates
    costs, worst = printed.costs, float(printed.costs.max())
    always = ours.arrived == ours.costs.size and printed.arrived == costs.size
    joint = finding(
        "genetic_joint", Verdict.CONFIRMED if always else Verdict.CONTRADICTED,
        (ours.share, printed.share,
         Quantity("cost in c1 to b0", float(np.median(costs)), "kN^2", float(costs.min()), worst,
                  "over seeds", printed.published)),
        ours=ours, printed=printed, worst=worst,
    )  # fmt: skip
    return [by_pressure, joint]


# The signs of c7, c8 and c9


def least_cost(
    published: Published, signs: Signs, slips: Array, seed: int, *, optimal: bool = True
) -> float:
    """Return the least total cost (kN^2) that Table 5's digits allow under a reading of c7 to c9.

    Searched from several starts by L-BFGS-B, so found rather than proved. Slips, shape (n,), are in
    percent; `optimal` takes Table 4 for the optimum of each pressure.
    """
    known = references(published, slips)
    middle = printed_coefficients(published)
    middle[6:9] = np.abs(middle[6:9]) * signs
    half = np.array([published.pressure.estimates[name].half_unit for name in COEFFICIENTS])

    def bound(z: Array) -> Array:
        least, _ = joint_bounds(middle + half * z, known, slips, optimal=optimal)
        return np.minimum(least, 1e4)  # finite where the formula is not defined

    def with_gradient(z: Array) -> tuple[float, Array]:
        # One batch: the point and a step to either side of it along each coordinate.
        steps = 1e-5 * np.eye(z.size)
        here, up, down = np.split(bound(np.vstack([z, z + steps, z - steps])), [1, 1 + z.size])
        return float(here[0]), (up - down) / 2e-5

    drawn = generator(seed, "audit", "curvature", *signs).uniform(-1.0, 1.0, (400, half.size))
    starts = drawn[np.argsort(bound(drawn))[:4]]
    ends = [
        minimize(with_gradient, z, jac=True, method="L-BFGS-B", bounds=[(-1.0, 1.0)] * z.size)
        for z in starts
    ]
    return float(min(end.fun for end in ends))


@dataclass(frozen=True)
class CurvatureStudy:
    """Least costs (kN^2) by reading of c7, c8 and c9, Table 4 taken for the optimum.

    `least_free` is without that, `by_shift` of the best two readings at other shifts of zero slip.
    """

    published_cost: float
    least: Mapping[Signs, float]
    least_free: Mapping[Signs, float]
    by_shift: Mapping[Signs, tuple[float, ...]]

    @property
    def order(self) -> list[Signs]:
        """Readings, the least cost first."""
        return sorted(self.least, key=lambda signs: self.least[signs])


@one_thread()
def study_curvature_signs(published: Published, seed: int) -> CurvatureStudy:
    """Search the least cost of every reading."""
    least, free = (
        {s: least_cost(published, s, ASSUMED_SLIPS, seed, optimal=optimal) for s in READINGS}
        for optimal in (True, False)
    )
    nominal = ASSUMED_SLIPS - 100.0 * SLIP_SHIFT
    shifted = {
        s: tuple(least_cost(published, s, nominal + shift, seed) for shift in (0.0, 1.0, 3.0, 4.0))
        for s in sorted(least, key=lambda s: least[s])[:2]
    }
    return CurvatureStudy(published.pressure.quality["cost"].value, least, free, shifted)


def curvature_signs(published: Published, study: CurvatureStudy) -> list[Finding]:
    """Judge c7 and c8 together, and c9 by itself."""
    read, printed = printed_signs(published, "E"), study.published_cost
    best, second = study.order[:2]
    nearest = {
        (a, b): min(study.least[a, b, c] for c in (1, -1)) for a, b in product((1, -1), repeat=2)
    }
    own, rival = nearest.pop(best[:2]), min(nearest.values())
    verdict = Verdict.CORRECTED
    if best[:2] == read[:2]:
        verdict = Verdict.CONFIRMED if rival > printed else Verdict.CONSISTENT
    first_two = finding(
        "table5_signs_of_c7_c8", verdict, _quantities(study, study.order[:4]),
        read=signs_text(read[:2]), best=signs_text(best[:2]), own=own, rival=rival,
        printed=printed, excluded=sum(cost > printed for cost in study.least_free.values()),
    )  # fmt: skip
    always = best[:2] == second[:2] and all(
        a < b for a, b in zip(study.by_shift[best], study.by_shift[second], strict=True)
    )
    verdict = Verdict.UNTESTABLE
    if always:
        verdict = Verdict.CONFIRMED if best[2] == read[2] else Verdict.CORRECTED
    last = finding(
        "table5_sign_of_c9", verdict, _quantities(study, [best, second]),
        c9=published.pressure.estimates["c9"], sign="positive" if best[2] > 0 else "negative",
        least=study.least[best], rival=study.least[second], printed=printed,
    )  # fmt: skip
    return [first_two, last]


def _quantities(study: CurvatureStudy, readings: list[Signs]) -> Iterator[Quantity]:
    for s in readings:
        name, least = f"least cost with {signs_text(s)}", study.least[s]
        shifts = (*study.by_shift.get(s, ()), least)
        if len(shifts) == 1:
            yield Quantity(name, least, "kN^2")
        else:
            what = "shifts of zero slip from 0 to 4 %"
            yield Quantity(name, least, "kN^2", min(shifts), max(shifts), what)
