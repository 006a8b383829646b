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

from calib.he2019.audit.finding import (
    Finding,
    Quantity,
    Verdict,
    beside_rival,
    between,
    finding,
    rounded,
)
from calib.he2019.audit.intervals import Interval, exact, sin
from calib.he2019.audit.nearness import ASSUMED_SLIPS, references
from calib.he2019.audit.pull import coefficients, peak_slip
from calib.he2019.datasets.published import Published
from calib.inference.estimators import PointEstimate
from calib.models.magic_formula import magic_formula
from calib.report.reference import FittedTable

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


def _features(published: Published) -> Finding:
    found, peaks, fine = [], [], True
    for psi, table in published.geometric.items():
        f = features(table)
        inside = f.x_peak is not None and bool(
            f.x_peak.lower > 0.0 and f.x_peak.upper < ASSUMED_SLIPS.max()
        )
        below = bool(f.asymptote.upper <= table.values["D"] and f.asymptote.lower > 0.0)
        fine = fine and inside and below
        if f.x_peak is not None:
            found.append(rounded(f"xm at {psi} psi", f.x_peak, "%"))
            peaks.append(found[-1].value)
        found.append(rounded(f"ys at {psi} psi", f.asymptote, "kN"))
    verdict = Verdict.CONSISTENT if fine else Verdict.CONTRADICTED
    return finding("table3_features", verdict, found, peaks=peaks)


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
    return finding(
        "table3_initial_slope",
        Verdict.CONFIRMED if initial <= _NEAR else beside_rival(False, bool(chord <= _NEAR)),
        found, missed=off_slope, pressures=list(published.geometric), chord=float(chord),
    )  # fmt: skip


def _curvature(published: Published) -> Finding:
    found, misses = [], []
    for psi, table in published.geometric.items():
        v, fitted = table.values, published.genetic[psi].values
        chord = chord_curvature(v["C"])
        misses.append(abs(chord - v["E"]) / abs(v["E"]))
        beside = f"{table.estimates['E'].text} (Table 3), {fitted['E']:g} (Table 4)"
        name = f"E if the chord is taken for the slope, {psi} psi"
        found.append(Quantity(name, chord, published=beside))
    worst = max(misses)
    verdict = Verdict.CORRECTED if worst <= 0.15 else Verdict.CONSISTENT
    chords = [q.value for q in found]
    return finding("table3_curvature", verdict, found, chords=chords, worst=worst)


def _costs(published: Published) -> Finding:
    known = {r.psi: r for r in references(published)}
    found: list[Quantity] = []
    refused: dict[bool, list[int]] = {False: [], True: []}
    better = True
    for psi, table in published.geometric.items():
        cost = table.quality["cost"]
        better &= cost.value >= published.genetic[psi].quality["cost"].value
        curve = magic_formula(ASSUMED_SLIPS, **table.values)[None]
        for optimal, what in (
            (False, "any data with Table 4's cost"), (True, "Table 4 taken for the optimum"),
        ):  # fmt: skip
            low, high = (float(b[0]) for b in known[psi].bounds(curve, optimal=optimal))
            name = f"cost of Table 3 at {psi} psi"
            found.append(between(name, low, high, "kN^2", what, cost.text))
            if not low - cost.half_unit <= cost.value <= high + cost.half_unit:
                refused[optimal].append(psi)
    verdict = Verdict.CONSISTENT if better and not refused[False] else Verdict.CONTRADICTED
    return finding("table3_costs", verdict, found, refused_if_optimal=refused[True])


def _reconstructed(published: Published, read_off: Mapping[int, PointEstimate]) -> Finding:
    found = []
    for psi, estimate in read_off.items():
        table = published.geometric[psi]
        text = table.quality["cost"].text
        found.append(Quantity(f"cost at {psi} psi", estimate.cost, "kN^2", published=text))
        found += [
            Quantity(f"{name} at {psi} psi", estimate.reported[name], f.unit, published=f.text)
            for name, f in table.estimates.items()
        ]
    return finding(
        "table3_reading", Verdict.UNTESTABLE, found, costs=[e.cost for e in read_off.values()],
        printed=[published.geometric[psi].quality["cost"].text for psi in read_off],
    )  # fmt: skip
