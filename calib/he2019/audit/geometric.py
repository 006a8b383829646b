"""Table 3 against the features of the curve by which Eqs 6-9 define its coefficients.

Eqs 6-9 can be inverted: a row of Table 3 states an initial slope tan(theta) = BCD, a peak (xm, ym)
and an asymptote ys. These are set beside the features of Table 4's curve, fitted to the same tests.
A slope that is the chord to the peak instead, tan(theta) = ym/xm, makes B xm = 1/C, and then

    E = [1/C - tan(pi/(2C))]/[1/C - arctan(1/C)],

strongly negative whatever the curve.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from calib.he2019.audit.finding import Basis, Finding, Quantity, Verdict, number, percent, rounded
from calib.he2019.audit.intervals import Interval, exact, sin
from calib.he2019.audit.nearness import ASSUMED_SLIPS, references
from calib.he2019.audit.pull import coefficients, peak_slip
from calib.he2019.datasets.published import FittedTable, Published
from calib.inference.estimators import PointEstimate
from calib.models.magic_formula import magic_formula

_FAMILY = "Table 3, Eqs 6-9"
# A published slope this much nearer to one reading than to the other is taken for it.
_NEAR = 0.05


@dataclass(frozen=True, eq=False)
class Features:
    """What a row of Table 3 or 4 says of its curve, over all coefficients that print alike.

    Initial slope BCD and chord ym/xm in kN/%, slip of the peak in %, pull at unlimited slip in kN.
    """

    slope: Interval
    x_peak: Interval | None
    asymptote: Interval
    chord: Interval | None


def features(table: FittedTable) -> Features:
    """Return the features that a row of Table 3 or 4 states."""
    box = coefficients(table)
    peak = peak_slip(box)
    half_turn = exact(0.5 * np.pi)
    return Features(
        box.stiffness * box.C * box.D,
        peak,
        box.D * sin(exact(np.pi) - box.C * half_turn),
        None if peak is None else box.D / peak,
    )


def chord_curvature(C: float) -> float:
    """Return the E that Eqs 6 and 9 give if the chord to the peak is taken for the slope."""
    u = 1.0 / C
    return float((u - np.tan(0.5 * np.pi * u)) / (u - np.arctan(u)))


def geometric_findings(
    published: Published, read_off: Mapping[int, PointEstimate] | None = None
) -> list[Finding]:
    """Judge Table 3; `read_off` is the geometric method on the reconstructed data, by psi."""
    found = [_features(published), _slope(published), _curvature(published), _costs(published)]
    return [*found, _reconstructed(published, read_off)] if read_off else found


def _keys(published: Published, names: str) -> tuple[str, ...]:
    return tuple(f"{t.source}: {n}" for t in published.geometric.values() for n in names.split())


def _features(published: Published) -> Finding:
    found, fine = [], True
    for psi, table in published.geometric.items():
        f = features(table)
        inside = f.x_peak is not None and bool(
            f.x_peak.lower > 0.0 and f.x_peak.upper < ASSUMED_SLIPS.max()
        )
        below = bool(f.asymptote.upper <= table.values["D"] and f.asymptote.lower > 0.0)
        fine = fine and inside and below
        if f.x_peak is not None:
            found.append(rounded(f"xm at {psi} psi", f.x_peak, "%"))
        found.append(rounded(f"ys at {psi} psi", f.asymptote, "kN"))
    peaks = [q for q in found if q.name.startswith("xm")]
    return Finding(
        "table3_features", _FAMILY, "Table 3, Eqs 7-9", _keys(published, "B C D E"),
        "Table 3 follows from a peak and an asymptote of the measured curves",
        "Eqs 6-9 inverted over all coefficients that print alike: is there a peak inside the "
        "tested slips, with an asymptote below it?",
        tuple(found), Verdict.CONSISTENT if fine else Verdict.CONTRADICTED,
        "The peaks lie at " + ", ".join(f"{number(q.value)} %" for q in peaks)
        + " slip, inside the tested range, with asymptotes below them." if fine else
        "Some row of Table 3 has no peak inside the tested slips, or an asymptote above it.",
        "Which points were taken for peak and asymptote is not said.",
        Basis.PRINTED,
    )  # fmt: skip


def _slope(published: Published) -> Finding:
    found: list[Quantity] = []
    off_chord, off_slope = [], []
    for psi, table in published.geometric.items():
        own, fitted = features(table), features(published.genetic[psi])
        slope = float(own.slope.middle)
        for name, part in (
            (f"BCD of Table 3 at {psi} psi", own.slope),
            (f"ym/xm of Table 3 at {psi} psi", own.chord),
            (f"initial slope of Table 4 at {psi} psi", fitted.slope),
        ):
            if part is not None:
                found.append(rounded(name, part, "kN/%"))
        off_slope.append(slope / float(fitted.slope.middle) - 1.0)
        off_chord.append(np.inf if own.chord is None else slope / float(own.chord.middle) - 1.0)
    chord, initial = np.abs(off_chord).max(), np.abs(off_slope).max()
    if initial <= _NEAR:
        verdict = Verdict.CONFIRMED
    else:
        verdict = Verdict.CORRECTED if chord <= _NEAR else Verdict.CONTRADICTED
    missed = ", ".join(percent(o, 2) for o in off_slope)
    return Finding(
        "table3_initial_slope", _FAMILY, "Table 3, Eq 6", _keys(published, "B"),
        "B C D of Table 3 is the initial slope of the pull curve",
        "BCD of Table 3 beside the initial slope of Table 4's curve and beside the chord from "
        "the origin to Table 3's own peak",
        tuple(found), verdict,
        f"BCD of Table 3 is off Table 4's initial slope by {missed} at "
        f"{', '.join(map(str, published.geometric))} psi, but within {percent(float(chord), 2)} "
        "of the chord to its own peak, as if that had been read for the initial slope."
        if verdict is Verdict.CORRECTED else
        f"BCD of Table 3 is off Table 4's initial slope by {missed}.",
        "Table 4's slopes are those of fitted curves; the measured slopes near zero slip are not "
        "printed.",
        Basis.PRINTED,
    )  # fmt: skip


def _curvature(published: Published) -> Finding:
    found, misses = [], []
    for psi, table in published.geometric.items():
        v, fitted = table.values, published.genetic[psi].values
        chord = chord_curvature(v["C"])
        misses.append(abs(chord - v["E"]) / abs(v["E"]))
        found.append(
            Quantity(f"E if the chord is taken for the slope, {psi} psi", chord,
                     published=f"{table.estimates['E'].text} (Table 3), {fitted['E']:g} (Table 4)")
        )  # fmt: skip
    worst = max(misses)
    artefact = worst <= 0.15
    return Finding(
        "table3_curvature", _FAMILY, "Table 3, Eq 9", _keys(published, "E"),
        "E of Table 3 describes the curvature of the measured curves",
        "Eq 9 with the chord to the peak for the slope, so that B xm = 1/C: E then depends on C "
        "alone",
        tuple(found), Verdict.CORRECTED if artefact else Verdict.CONSISTENT,
        f"The chord alone gives E = {', '.join(number(q.value) for q in found)}, within "
        f"{percent(worst, 2)} of Table 3 at every pressure: its large E says how the slope was "
        "read, not how the pull curves."
        if artefact else
        f"The chord would give E = {', '.join(number(q.value) for q in found)}, up to "
        f"{percent(worst, 2)} off Table 3.",
        "This restates the finding on the slope: given C, the chord and E determine each other.",
        Basis.PRINTED,
    )  # fmt: skip


def _costs(published: Published) -> Finding:
    known = {r.psi: r for r in references(published)}
    found: list[Quantity] = []
    refused: list[str] = []
    refused_if_optimal: list[str] = []
    better = True
    for psi, table in published.geometric.items():
        cost = table.quality["cost"]
        better &= cost.value >= published.genetic[psi].quality["cost"].value
        curve = magic_formula(ASSUMED_SLIPS, **table.values)[None]
        for optimal, misses, what in (
            (False, refused, "any data with Table 4's cost"),
            (True, refused_if_optimal, "Table 4 taken for the optimum"),
        ):
            low, high = (float(b[0]) for b in known[psi].bounds(curve, optimal=optimal))
            found.append(Quantity(f"cost of Table 3 at {psi} psi", float("nan"), "kN^2", low,
                                  high, what, cost.text))  # fmt: skip
            if not low - cost.half_unit <= cost.value <= high + cost.half_unit:
                misses.append(f"{psi}")
    verdict = Verdict.CONSISTENT if better and not refused else Verdict.CONTRADICTED
    evidence = (
        "Table 3 costs more than Table 4 at every pressure and its costs are possible"
        if verdict is Verdict.CONSISTENT
        else "Table 3's costs are not possible beside Table 4's"
    )
    if verdict is Verdict.CONSISTENT and refused_if_optimal:
        evidence += (
            f"; at the assumed slips they would not be at {' and '.join(refused_if_optimal)} psi "
            "if Table 4 were exactly optimal there"
        )
    return Finding(
        "table3_costs", _FAMILY, "Tables 3 and 4, Eq 10",
        (*_keys(published, "cost"), *(f"{t.source}: cost" for t in published.genetic.values())),
        "the geometric curves cost what Table 3 prints, more than Table 4's",
        "the least and largest cost of Table 3's curves on any data that have Table 4's costs",
        tuple(found), verdict, evidence + ".",
        "The tested slips are not all printed; with fewer tests below 8 % slip the cost at 18 psi "
        "would be possible.",
        Basis.SLIPS,
    )  # fmt: skip


def _reconstructed(published: Published, read_off: Mapping[int, PointEstimate]) -> Finding:
    found = []
    for psi, estimate in read_off.items():
        table = published.geometric[psi]
        found.append(Quantity(f"cost at {psi} psi", estimate.cost, "kN^2",
                              published=table.quality["cost"].text))  # fmt: skip
        found += [
            Quantity(f"{name} at {psi} psi", estimate.reported[name], table.estimates[name].unit,
                     published=table.estimates[name].text)
            for name in "BCDE"
        ]  # fmt: skip
    costs = ", ".join(f"{number(e.cost)}" for e in read_off.values())
    text = ", ".join(published.geometric[psi].quality["cost"].text for psi in read_off)
    return Finding(
        "table3_reading", _FAMILY, "Table 3, Eqs 6-9", _keys(published, "B C D E cost"),
        "Eqs 6-9 give Table 3 from the measured curves",
        "the geometric method, with this package's reading rules, on the reconstructed data",
        tuple(found), Verdict.UNTESTABLE,
        f"Read off the reconstructed data, Eqs 6-9 cost {costs} kN^2 against {text}: neither the "
        "measured curves nor the rules by which they were read are printed.",
        "The measured curves.", Basis.RECONSTRUCTED,
    )  # fmt: skip
