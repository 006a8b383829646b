"""What the printed digits of Table 5 can and cannot reproduce, by interval propagation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from calib.batch.threads import one_thread
from calib.he2019.audit.finding import Basis, Finding, Quantity, Verdict, number, percent
from calib.he2019.audit.intervals import Interval, printed
from calib.he2019.audit.nearness import COEFFICIENTS, pressure_curves, printed_coefficients
from calib.he2019.audit.pull import coefficients, pressure_box, pull, pull_from_slope, quadratic
from calib.he2019.audit.signs import NAMES, nearest, targets
from calib.he2019.datasets.published import Published
from calib.models.base import Array
from calib.report.labels import joined

_FAMILY = "Digits of Table 5"
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
            "rounding", f"{number(value, 4)} (Table 4)",
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
    holds = all(r.holds(w) for r, w in zip(ranges, wanted, strict=True))
    if not holds:
        verdict = Verdict.CONTRADICTED
    else:
        verdict = Verdict.CORRECTED if max(spread) > _WANTED else Verdict.CONFIRMED
    c3 = published.pressure.estimates["c3"]
    p = float(pressures[worst])
    needed = _WANTED * wanted[worst] / p**2
    found.append(
        Quantity("c3 that brings D nearest to Table 4", float(best.coefficients[2]),
                 "kN/psi^2", published=c3.text)
    )  # fmt: skip
    return Finding(
        "table5_digits_of_D", _FAMILY, "Table 5, Eq 14",
        tuple(f"Table 5: {name}" for name in NAMES["D"]),
        "c1, c2 and c3 as printed give the peak pull D",
        "interval arithmetic over all coefficients that print alike, at the three pressures",
        tuple(found), verdict,
        f"The digits leave D at {p:g} psi open by {percent(spread[worst], 2)} either way "
        f"({number(float(ranges[worst].lower))} to {number(float(ranges[worst].upper))} kN); as "
        f"printed it is off by {percent(off[worst], 2)}, while c3 = "
        f"{number(float(best.coefficients[2]), 4)} would bring D to within "
        f"{percent(best.deviation, 2)} of Table 4 at every pressure.",
        f"To fix D at {p:g} psi to {percent(_WANTED, 1)}, c3 must be known to "
        f"{number(needed, 1)} kN/psi^2, against {c3.half_unit:g} as printed.",
        Basis.PRINTED,
    )  # fmt: skip


def _slope_and_curvature(published: Published) -> Finding:
    slope, found = _quadratics(published, "BCD", "kN/%")
    curvature, more = _quadratics(published, "E", "1")
    _, K4 = targets(published, "BCD")
    pressures, E4 = targets(published, "E")
    spread = max(float(r.half_width) / k for r, k in zip(slope, K4, strict=True))
    outside = [f"{p:g}" for p, r, e in zip(pressures, curvature, E4, strict=True) if not r.holds(e)]
    missed = [
        f"{p:g}" for p, r, k in zip(pressures, slope, K4, strict=True) if not r.holds(float(k))
    ]
    verdict = Verdict.CONFIRMED
    if outside or missed:
        verdict = Verdict.CONTRADICTED
    elif spread > _WANTED:
        verdict = Verdict.CORRECTED
    return Finding(
        "table5_digits_of_BCD_and_E", _FAMILY, "Table 5, Eqs 12 and 15",
        tuple(f"Table 5: {name}" for what in ("BCD", "E") for name in NAMES[what]),
        "c4 to c9 as printed give the slope BCD and the curvature factor E of Table 4",
        "interval arithmetic over all coefficients that print alike, at the three pressures",
        (*found, *more), verdict,
        f"No coefficients that print alike give Table 4's BCD at {joined(missed or ['any'])} psi "
        f"or its E at {joined(outside or ['any'])} psi; the digits leave BCD open by up to "
        f"{percent(spread, 2)}."
        if outside or missed else
        f"Table 4's BCD and E can be reached; the digits leave BCD open by up to "
        f"{percent(spread, 2)}.",
        "A joint fit with one C need not repeat Table 4 exactly; what it can reach is judged by "
        "the cost of Table 5.",
        Basis.PRINTED,
    )  # fmt: skip


def _curve(published: Published, study: RoundingStudy) -> Finding:
    found = []
    for psi, allowed in study.allowed.items():
        at = int(np.argmax(allowed.half_width))
        D = published.genetic[psi].values["D"]
        found.append(
            Quantity(
                f"widest range of the pull at {psi} psi", float("nan"), "kN",
                float(allowed.lower[at]), float(allowed.upper[at]), "rounding",
                f"{number(D, 4)} peak (Table 4)",
            )
        )  # fmt: skip
    relative = {
        psi: float(a.half_width.max()) / published.genetic[psi].values["D"]
        for psi, a in study.allowed.items()
    }
    best, worst = min(relative, key=lambda p: relative[p]), max(relative, key=lambda p: relative[p])
    gaps = {p: _gap(study.allowed[p], study.table4[p]) for p in relative}
    outside = [f"by up to {number(gap, 2)} kN at {p} psi" for p, gap in gaps.items() if gap > 0.0]
    verdict = Verdict.CONFIRMED if relative[worst] <= _WANTED else Verdict.CORRECTED
    return Finding(
        "table5_digits_of_pull", _FAMILY, "Table 5, Eqs 3-5 and 12-15",
        tuple(f"Table 5: {name}" for name in COEFFICIENTS),
        "Table 5 gives the drawbar pull at any slip and pressure",
        "exact extremes in BCD and E and an outward-rounded subdivision in C and D, at 151 slips "
        "up to 75 %, over all coefficients that print alike",
        tuple(found), verdict,
        f"The digits leave the pull open by up to {percent(relative[best], 2)} of the peak at "
        f"{best} psi and {percent(relative[worst], 2)} at {worst} psi"
        + (f"; Table 4 lies outside that range {joined(outside)}." if outside
           else "; Table 4 lies inside that range."),
        "Table 4, pressure by pressure, is the reference to use.",
        Basis.PRINTED,
    )  # fmt: skip


def _gap(allowed: Interval, curve: Interval) -> float:
    """Return how far a curve leaves a range at most, kN; not above zero where it does not."""
    beyond = np.maximum(allowed.lower - curve.upper, curve.lower - allowed.upper)
    return float(beyond.max())


def _shape(published: Published) -> Finding:
    figure = published.pressure.estimates["b0"]
    b0 = printed(figure)
    each = [table.values["C"] for table in published.genetic.values()]
    low, high = min(each), max(each)
    inside = bool(b0.upper >= low and b0.lower <= high)
    return Finding(
        "table5_b0", _FAMILY, "Table 5, Eq 13", ("Table 5: b0",),
        f"one C = b0 = {figure.text} serves all pressures",
        "beside the C of each pressure in Table 4, between which a common C must lie",
        (Quantity("C of Table 4", float("nan"), "1", low, high, "over pressures", figure.text),),
        Verdict.CONSISTENT if inside else Verdict.CONTRADICTED,
        f"b0 lies {'between' if inside else 'outside'} Table 4's {low:g} to {high:g}.",
        "Whether b0 is the best common C needs the measured curves.", Basis.PRINTED,
    )  # fmt: skip


def _table4(study: RoundingStudy) -> Finding:
    widest = {psi: float(i.half_width.max()) for psi, i in study.table4.items()}
    worst = max(widest.values())
    return Finding(
        "table4_digits", _FAMILY, "Table 4, Eqs 3-5",
        tuple(f"Table 4, {psi} psi: {name}" for psi in widest for name in "BCDE"),
        "the digits of Table 4 are enough to evaluate the pull",
        "exact extremes over all coefficients that print alike, at 151 slips up to 75 %",
        tuple(Quantity(f"half the widest range at {p} psi", w, "kN") for p, w in widest.items()),
        Verdict.CONFIRMED if worst < 0.005 else Verdict.CORRECTED,
        f"Rounding moves the pull by {number(1000.0 * worst, 2)} N at most.",
        "", Basis.PRINTED,
    )  # fmt: skip
