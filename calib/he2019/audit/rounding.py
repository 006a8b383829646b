"""What the printed digits of Table 5 can and cannot reproduce, by interval propagation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from calib.batch.threads import one_thread
from calib.he2019.audit.finding import (
    Finding,
    Quantity,
    Verdict,
    between,
    finding,
)
from calib.he2019.audit.intervals import Interval, printed
from calib.he2019.audit.nearness import pressure_curves, printed_coefficients
from calib.he2019.audit.pull import coefficients, pressure_box, pull, pull_from_slope, quadratic
from calib.he2019.audit.signs import NAMES, nearest, targets
from calib.he2019.datasets.published import Published
from calib.models.base import Array
from calib.report.numbers import format_number

# Digits are enough where D is fixed to this part.
_WANTED = 0.01


@dataclass(frozen=True, eq=False)
class RoundingStudy:
    """The pull curves (kN) that the digits of Tables 4 and 5 allow, by pressure in psi.

    Slips are in percent. `as_printed` takes Table 5's digits as they stand; infinite where K or D
    is not positive.
    """

    slips: Array
    allowed: Mapping[int, Interval]
    as_printed: Mapping[int, Array]
    table4: Mapping[int, Interval]


@one_thread()
def study_rounding(published: Published, n: int = 151) -> RoundingStudy:
    """Propagate the rounding of Tables 4 and 5 to the pull at n slips up to 75 %."""
    slips = np.linspace(0.0, 75.0, n)
    pressures = list(published.genetic)
    as_printed = printed_coefficients(published)[None]
    curves = pressure_curves(as_printed, np.array(pressures, dtype=np.float64), slips)
    return RoundingStudy(
        slips,
        {psi: pull_from_slope(slips, pressure_box(published, psi)) for psi in pressures},
        {psi: curves[0, i] for i, psi in enumerate(pressures)},
        {psi: pull(slips, coefficients(table)) for psi, table in published.genetic.items()},
    )


def rounding_findings(published: Published, study: RoundingStudy) -> list[Finding]:
    """Judge the digits of D, BCD, E and C, of the pull, and of Table 4."""
    return [
        _peak(published), _slope_and_curvature(published), _curve(published, study),
        _shape(published), _table4(study),
    ]  # fmt: skip


def _quadratics(
    published: Published, what: str, unit: str
) -> tuple[list[Interval], list[Quantity]]:
    pressures, wanted = targets(published, what)
    ranges = [quadratic(published, NAMES[what], p) for p in pressures]
    found = [
        Quantity(
            f"{what} at {p:g} psi", float(r.middle), unit, float(r.lower), float(r.upper),
            "rounding", f"{format_number(value, 4)} (Table 4)",
        )
        for p, r, value in zip(pressures, ranges, wanted, strict=True)
    ]  # fmt: skip
    return ranges, found


def _peak(published: Published) -> Finding:
    ranges, found = _quadratics(published, "D", "kN")
    pressures, wanted = targets(published, "D")
    off = [abs(float(r.middle) / w - 1.0) for r, w in zip(ranges, wanted, strict=True)]
    spread = [float(r.half_width) / w for r, w in zip(ranges, wanted, strict=True)]
    worst = int(np.argmax(spread))
    best = nearest(published, "D")
    verdict = Verdict.CONTRADICTED
    if all(r.holds(w) for r, w in zip(ranges, wanted, strict=True)):
        verdict = Verdict.CORRECTED if max(spread) > _WANTED else Verdict.CONFIRMED
    c3, best_c3 = published.pressure.estimates["c3"], float(best.coefficients[2])
    psi = float(pressures[worst])
    name = "c3 that brings D nearest to Table 4"
    found.append(Quantity(name, best_c3, "kN/psi^2", published=c3.text))
    return finding(
        "table5_digits_of_D", verdict, found, psi=psi, spread=spread[worst], range=ranges[worst],
        off=off[worst], best_c3=best_c3, deviation=best.deviation, wanted=_WANTED, c3=c3,
        needed=_WANTED * wanted[worst] / psi**2,
    )  # fmt: skip


def _slope_and_curvature(published: Published) -> Finding:
    slope, found = _quadratics(published, "BCD", "kN/%")
    curvature, more = _quadratics(published, "E", "1")
    pressures, K4 = targets(published, "BCD")
    _, E4 = targets(published, "E")
    spread = max(float(r.half_width) / k for r, k in zip(slope, K4, strict=True))
    missed, outside = (
        [f"{p:g}" for p, r, v in zip(pressures, ranges, wanted, strict=True) if not r.holds(v)]
        for ranges, wanted in ((slope, K4), (curvature, E4))
    )
    verdict = Verdict.CORRECTED if spread > _WANTED else Verdict.CONFIRMED
    if outside or missed:
        verdict = Verdict.CONTRADICTED
    return finding(
        "table5_digits_of_BCD_and_E", verdict, (*found, *more), missed=missed, outside=outside,
        spread=spread,
    )  # fmt: skip


def _curve(published: Published, study: RoundingStudy) -> Finding:
    found, relative = [], {}
    for psi, allowed in study.allowed.items():
        at = int(np.argmax(allowed.half_width))
        D = published.genetic[psi].values["D"]
        relative[psi] = float(allowed.half_width.max()) / D
        found.append(
            between(
                f"widest range of the pull at {psi} psi", allowed.lower[at], allowed.upper[at],
                "kN", "rounding", f"{format_number(D, 4)} peak (Table 4)",
            )
        )  # fmt: skip
    best, worst = min(relative, key=lambda p: relative[p]), max(relative, key=lambda p: relative[p])
    gaps = {p: _gap(study.allowed[p], study.table4[p]) for p in relative}
    outside = [
        f"by up to {format_number(gap, 2)} kN at {p} psi" for p, gap in gaps.items() if gap > 0.0
    ]
    return finding(
        "table5_digits_of_pull",
        Verdict.CONFIRMED if relative[worst] <= _WANTED else Verdict.CORRECTED, found,
        open=relative, best=best, worst=worst, outside=outside,
    )  # fmt: skip


def _gap(allowed: Interval, curve: Interval) -> float:
    """Return how far a curve leaves a range at most, kN; not above zero where it does not."""
    beyond = np.maximum(allowed.lower - curve.upper, curve.lower - allowed.upper)
    return float(beyond.max())


def _shape(published: Published) -> Finding:
    figure = published.pressure.estimates["b0"]
    b0, each = printed(figure), [table.values["C"] for table in published.genetic.values()]
    low, high = min(each), max(each)
    inside = bool(b0.upper >= low and b0.lower <= high)
    return finding(
        "table5_b0", Verdict.CONSISTENT if inside else Verdict.CONTRADICTED,
        [between("C of Table 4", low, high, "1", "over pressures", figure.text)],
        b0=figure, low=low, high=high,
    )  # fmt: skip


def _table4(study: RoundingStudy) -> Finding:
    widest = {psi: float(i.half_width.max()) for psi, i in study.table4.items()}
    worst = max(widest.values())
    return finding(
        "table4_digits", Verdict.CONFIRMED if worst < 0.005 else Verdict.CORRECTED,
        (Quantity(f"half the widest range at {p} psi", w, "kN") for p, w in widest.items()),
        worst=worst,
    )  # fmt: skip
