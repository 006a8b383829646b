"""The signs of c7, c8 and c9, by what Table 5 would cost.

E(p) of Table 5 is far from Table 4's under every reading, so nearness of E decides nothing: at
18 psi the pull hardly depends on it. The pull does decide. For each reading, the coefficients that
print alike are searched for the least total cost (Eq 16) that any data compatible with Table 4
could give them; the source printed a total. The bound takes Table 4 for the least-squares optimum
of each pressure and needs the slips, so it is repeated with other shifts of zero slip.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.optimize import minimize

from calib.batch.threads import one_thread
from calib.he2019.audit.finding import (
    Finding,
    Quantity,
    Verdict,
    finding,
)
from calib.he2019.audit.nearness import (
    ASSUMED_SLIPS,
    COEFFICIENTS,
    joint_bounds,
    printed_coefficients,
    references,
)
from calib.he2019.audit.signs import Signs, printed_signs, signs_text
from calib.he2019.datasets.drawbar import SLIP_SHIFT
from calib.he2019.datasets.published import Published
from calib.inference.random import generator
from calib.models.base import Array

_SHIFTS = (0.0, 1.0, 3.0, 4.0)
_SCREENED, _STARTS, _STEP, _WORST = 400, 4, 1e-5, 1e4


def _box(published: Published, signs: Signs) -> tuple[Array, Array]:
    middle = printed_coefficients(published)
    middle[6:9] = np.abs(middle[6:9]) * signs
    figures = published.pressure.estimates
    return middle, np.array([figures[name].half_unit for name in COEFFICIENTS])


def least_cost(
    published: Published, signs: Signs, slips: Array, seed: int, *, optimal: bool = True
) -> float:
    """Return the least total cost (kN^2) that Table 5's digits allow under a reading of c7 to c9.

    Searched from several starts by L-BFGS-B, so found rather than proved. Slips, shape (n,), are in
    percent; `optimal` takes Table 4 for the optimum of each pressure.
    """
    known = references(published, slips)
    middle, half = _box(published, signs)

    def bound(z: Array) -> Array:
        least, _ = joint_bounds(middle + half * z, known, slips, optimal=optimal)
        return np.minimum(least, _WORST)

    def with_gradient(z: Array) -> tuple[float, Array]:
        # One batch: the point and a step to either side of it along each coordinate.
        values = bound(np.vstack([z, z + _STEP * np.eye(z.size), z - _STEP * np.eye(z.size)]))
        return float(values[0]), (values[1 : 1 + z.size] - values[1 + z.size :]) / (2.0 * _STEP)

    drawn = generator(seed, "audit", "curvature", *signs).uniform(-1.0, 1.0, (_SCREENED, half.size))
    starts = drawn[np.argsort(bound(drawn))[:_STARTS]]
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
    readings: list[Signs] = [(a, b, c) for a, b, c in product((1, -1), repeat=3)]
    least = {s: least_cost(published, s, ASSUMED_SLIPS, seed) for s in readings}
    free = {s: least_cost(published, s, ASSUMED_SLIPS, seed, optimal=False) for s in readings}
    nominal = ASSUMED_SLIPS - 100.0 * SLIP_SHIFT
    best = sorted(least, key=lambda s: least[s])[:2]
    shifted = {
        s: tuple(least_cost(published, s, nominal + shift, seed) for shift in _SHIFTS) for s in best
    }
    return CurvatureStudy(published.pressure.quality["cost"].value, least, free, shifted)


def curvature_signs(published: Published, study: CurvatureStudy) -> list[Finding]:
    """Judge c7 and c8 together, and c9 by itself."""
    read = printed_signs(published, "E")
    best, second = study.order[:2]
    return [_first_two(study, read, best), _last(published, study, read, best, second)]


def _quantities(study: CurvatureStudy, readings: list[Signs]) -> Iterator[Quantity]:
    for s in readings:
        name, least = f"least cost with {signs_text(s)}", study.least[s]
        shifts = (*study.by_shift.get(s, ()), least)
        if len(shifts) == 1:
            yield Quantity(name, least, "kN^2")
        else:
            what = "shifts of zero slip from 0 to 4 %"
            yield Quantity(name, least, "kN^2", min(shifts), max(shifts), what)


def _first_two(study: CurvatureStudy, read: Signs, best: Signs) -> Finding:
    nearest = {
        (a, b): min(study.least[a, b, c] for c in (1, -1)) for a, b in product((1, -1), repeat=2)
    }
    own, rival = nearest.pop(best[:2]), min(nearest.values())
    excluded = [s for s, cost in study.least_free.items() if cost > study.published_cost]
    verdict = Verdict.CORRECTED
    if best[:2] == read[:2]:
        verdict = Verdict.CONFIRMED if rival > study.published_cost else Verdict.CONSISTENT
    return finding(
        "table5_signs_of_c7_c8", verdict, _quantities(study, study.order[:4]),
        read=signs_text(read[:2]), best=signs_text(best[:2]), own=own, rival=rival,
        printed=study.published_cost, excluded=len(excluded),
    )  # fmt: skip


def _last(
    published: Published, study: CurvatureStudy, read: Signs, best: Signs, second: Signs
) -> Finding:
    always = best[:2] == second[:2] and all(
        a < b for a, b in zip(study.by_shift[best], study.by_shift[second], strict=True)
    )
    verdict = Verdict.UNTESTABLE
    if always:
        verdict = Verdict.CONFIRMED if best[2] == read[2] else Verdict.CORRECTED
    return finding(
        "table5_sign_of_c9", verdict, _quantities(study, [best, second]),
        c9=published.pressure.estimates["c9"], sign="positive" if best[2] > 0 else "negative",
        least=study.least[best], rival=study.least[second], printed=study.published_cost,
    )  # fmt: skip
