"""Tables 3 and 4, the Magic Formula at each pressure: features, costs and the signs of E.

*Features.* Eqs 6-9 can be inverted: a row states an initial slope tan(theta) = BCD, a peak (xm, ym)
and an asymptote ys. These are set beside the features of Table 4's curve, fitted to the same tests.
A slope that is the chord to the peak instead, tan(theta) = ym/xm, makes B xm = 1/C, and then

    E = [1/C - tan(pi/(2C))]/[1/C - arctan(1/C)],

strongly negative whatever the curve.

*Signs.* The text of the source lost every minus, so each sign is an inference. The peak of the pull
must lie inside the tested slips, since Eqs 6-9 read it off the curve. With E above one the argument
of the formula has a maximum of its own, which may stay below what the peak needs.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from calib.he2019.audit.bounds import (
    ASSUMED_SLIPS,
    Interval,
    coefficients,
    exact,
    largest_pull,
    peak_slip,
    references,
    sin,
)
from calib.he2019.audit.finding import (
    Basis,
    Finding,
    Quantity,
    Verdict,
    beside_rival,
    between,
    consistent_if,
    finding,
    rounded,
)
from calib.he2019.published import Published
from calib.inference.estimators import PointEstimate
from calib.models.magic_formula import magic_formula
from calib.report.reference import FittedTable


class Features(NamedTuple):
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
    asymptote = box.D * sin(exact(np.pi) - box.C * exact(0.5 * np.pi))
    chord = None if peak is None else box.D / peak
    return Features(box.stiffness * box.C * box.D, peak, asymptote, chord)


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
        fine = fine and bool(f.asymptote.lower > 0.0 and f.asymptote.upper <= table.values["D"])
        if f.x_peak is None:
            fine = False
        else:
            fine = fine and bool(f.x_peak.lower > 0.0 and f.x_peak.upper < ASSUMED_SLIPS.max())
            found.append(rounded(f"xm at {psi} psi", f.x_peak, "%"))
            peaks.append(found[-1].value)
        found.append(rounded(f"ys at {psi} psi", f.asymptote, "kN"))
    return finding("table3_features", consistent_if(fine), found, peaks=peaks)


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
    near = 0.05  # a slope this close to a reading is taken for it
    chord, initial = np.abs(off_chord).max(), np.abs(off_slope).max()
    return finding(
        "table3_initial_slope",
        Verdict.CONFIRMED if initial <= near else beside_rival(False, bool(chord <= near)),
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
    worst, chords = max(misses), [q.value for q in found]
    verdict = Verdict.CORRECTED if worst <= 0.15 else Verdict.CONSISTENT
    return finding("table3_curvature", verdict, found, chords=chords, worst=worst)


def _costs(published: Published) -> Finding:
    known = {r.psi: r for r in references(published)}
    found: list[Quantity] = []
    refused: dict[bool, list[int]] = {False: [], True: []}
    better = True
    what = {False: "any data with Table 4's cost", True: "Table 4 taken for the optimum"}
    for psi, table in published.geometric.items():
        cost = table.quality["cost"]
        better &= cost.value >= published.genetic[psi].quality["cost"].value
        curve = magic_formula(ASSUMED_SLIPS, **table.values)[None]
        for optimal in what:
            low, high = (float(b[0]) for b in known[psi].bounds(curve, optimal=optimal))
            name = f"cost of Table 3 at {psi} psi"
            found.append(between(name, low, high, "kN^2", what[optimal], cost.text))
            if not low - cost.half_unit <= cost.value <= high + cost.half_unit:
                refused[optimal].append(psi)
    verdict = consistent_if(better and not refused[False])
    return finding("table3_costs", verdict, found, refused_if_optimal=refused[True])


def _reconstructed(published: Published, read_off: Mapping[int, PointEstimate]) -> Finding:
    found, texts = [], []
    for psi, estimate in read_off.items():
        table = published.geometric[psi]
        texts.append(table.quality["cost"].text)
        found.append(Quantity(f"cost at {psi} psi", estimate.cost, "kN^2", published=texts[-1]))
        found += [
            Quantity(f"{name} at {psi} psi", estimate.reported[name], f.unit, published=f.text)
            for name, f in table.estimates.items()
        ]
    costs = [estimate.cost for estimate in read_off.values()]
    return finding("table3_reading", Verdict.UNTESTABLE, found, costs=costs, printed=texts)


def _in_range(peak: Interval | None) -> bool:
    return peak is not None and bool(peak.upper <= ASSUMED_SLIPS.max())


def sign_of_curvature(table: FittedTable) -> Finding:
    """Test the sign of one E of Table 3 or 4."""
    box, E, D = coefficients(table), table.estimates["E"], table.estimates["D"]
    flipped = box._replace(E=-box.E)
    read, other = peak_slip(box), peak_slip(flipped)
    found = [] if read is None else [rounded("peak at a slip of", read, "%")]
    top = None
    if other is None:
        top = largest_pull(flipped)
        found.append(rounded("largest pull with the other sign", top, "kN", D))
    else:
        found.append(rounded("peak with the other sign at", other, "%"))
    verdict = Verdict.CONTRADICTED
    if _in_range(read):
        verdict = Verdict.CONSISTENT if _in_range(other) else Verdict.CONFIRMED
    name = table.source.lower().replace(" ", "").replace(",", "_").replace("psi", "")
    # How far the two signs' curves are apart, beside the noise of the fit.
    values = table.values
    own, mirrored = (
        magic_formula(ASSUMED_SLIPS, **{**values, "E": sign * values["E"]}) for sign in (1, -1)
    )
    apart = float(np.abs(own - mirrored).max())
    noise = np.sqrt(table.quality["cost"].value / (ASSUMED_SLIPS.size - len(values)))
    return finding(
        f"{name}_sign_of_E", verdict, found, claim="sign_of_E", figures=[f"{table.source}: E"],
        basis=Basis.SLIPS if verdict is Verdict.CONSISTENT else None, source=table.source, E=E,
        D=D, top=None if top is None else float(top.upper), apart=apart,
        noise=float(noise), read=None if read is None else float(read.middle),
        other=None if other is None else float(other.middle),
    )  # fmt: skip
