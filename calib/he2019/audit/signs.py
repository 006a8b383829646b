"""Signs of Tables 3 to 6. The text of the source lost every minus, so each sign is an inference.

E: the peak of the pull must lie inside the tested slips, since Eqs 6-9 read it off the curve. With
E above one the argument of the formula has a maximum of its own, which may stay below what the peak
needs; that is decided for all coefficients that print alike.
Table 5: each triple of signs gives its own family of quadratics in pressure; all but one are far
from Table 4 however the lost digits are chosen.
"""

from __future__ import annotations

import numpy as np

from calib.he2019.audit.finding import Basis, Finding, Quantity, Verdict, rounded
from calib.he2019.audit.intervals import Interval, exact, exp, log, printed
from calib.he2019.audit.nearness import ASSUMED_SLIPS
from calib.he2019.audit.pull import coefficients, largest_pull, peak_slip
from calib.he2019.audit.quadratics import NAMES, nearest_by_signs, printed_signs
from calib.he2019.audit.words import number, percent
from calib.he2019.datasets.published import FittedTable, Published
from calib.models.magic_formula import magic_formula

FAMILY = "Signs"

# A reading is refused if even its best coefficients miss Table 4 by more than this part.
FAR = 0.5


def signs(published: Published) -> list[Finding]:
    """Test the signs of E, of c1 to c6, and of the rut model's parameters."""
    tables = (published.geometric, published.genetic)
    return [
        *(sign_of_curvature(table) for by_psi in tables for table in by_psi.values()),
        *(signs_of_quadratic(published, what) for what in ("D", "BCD")),
        signs_of_rut(published),
    ]


def _in_range(peak: Interval | None) -> bool:
    return peak is not None and bool(peak.upper <= ASSUMED_SLIPS.max())


def sign_of_curvature(table: FittedTable) -> Finding:
    """Test the sign of one E of Table 3 or 4."""
    box = coefficients(table)
    figure = table.estimates["E"]
    read, other = peak_slip(box), peak_slip(box._replace(E=-box.E))
    found = [] if read is None else [rounded("peak at a slip of", read, "%")]
    if other is None:
        top = largest_pull(box._replace(E=-box.E))
        found.append(rounded("largest pull with the other sign", top, "kN", table.estimates["D"]))
        evidence = (
            f"With E = {-figure.value:g} the pull would never exceed {number(float(top.upper))} "
            f"kN, far from D = {table.estimates['D'].text} kN, and would have no peak"
        )
    else:
        found.append(rounded("peak with the other sign at", other, "%"))
        evidence = f"{_apart(table)}; the peak moves to {number(float(other.middle))} %"
    if not _in_range(read):
        verdict = Verdict.CONTRADICTED
        evidence = f"With E = {figure.text} there is no peak inside the tested slips"
    else:
        verdict = Verdict.CONSISTENT if _in_range(other) else Verdict.CONFIRMED
    if verdict is Verdict.CONFIRMED and read is not None:
        evidence += f"; with E = {figure.text} the peak is at {number(float(read.middle))} %"
    name = table.source.lower().replace(" ", "").replace(",", "_").replace("psi", "")
    return Finding(
        f"{name}_sign_of_E", FAMILY, f"{table.source}, Eqs 3-5", (f"{table.source}: E",),
        f"E = {figure.text}, its sign inferred",
        "whether the curve has a peak inside the tested slips under either sign, over all "
        "coefficients that print alike",
        tuple(found), verdict, evidence + ".",
        "The sign rests on Table 5, whose E is negative at 18 psi under every reading not excluded."
        if verdict is Verdict.CONSISTENT else "",
        Basis.SLIPS if verdict is Verdict.CONSISTENT else Basis.PRINTED,
    )  # fmt: skip


def _apart(table: FittedTable) -> str:
    """Say how far the two signs' curves are apart, beside the noise of the fit."""
    values = table.values
    flipped = {**values, "E": -values["E"]}
    apart = magic_formula(ASSUMED_SLIPS, **values) - magic_formula(ASSUMED_SLIPS, **flipped)
    furthest = float(np.abs(apart).max())
    noise = float(np.sqrt(table.quality["cost"].value / (ASSUMED_SLIPS.size - len(values))))
    return (
        "Both signs give a peak inside the tested slips, and their curves differ by at most "
        f"{number(furthest, 2)} kN where the noise is {number(noise, 2)} kN"
    )


def signs_of_quadratic(published: Published, what: str) -> Finding:
    """Test the signs of the coefficients of D or of BCD in Table 5."""
    by_signs = nearest_by_signs(published, what)
    read = printed_signs(published, what)
    own = by_signs[read].deviation
    best_rival, rival = min(
        ((signs, n.deviation) for signs, n in by_signs.items() if signs != read),
        key=lambda pair: pair[1],
    )
    if own <= FAR:
        verdict = Verdict.CONFIRMED if rival > FAR else Verdict.CONSISTENT
    else:
        verdict = Verdict.CORRECTED if rival <= FAR else Verdict.CONTRADICTED
    written = {s: "(" + ", ".join("+-"[v < 0] for v in s) + ")" for s in (read, best_rival)}
    names = NAMES[what]
    return Finding(
        f"table5_signs_of_{what}", FAMILY, "Table 5, Eqs 12-15",
        tuple(f"Table 5: {name}" for name in names),
        f"{', '.join(names)} have the signs {written[read]}, inferred",
        f"linear programme: the least that {what} can deviate from Table 4 at its three pressures, "
        "over all coefficients that print alike, for each of the eight readings",
        (
            Quantity(f"least deviation with {written[read]}", 100.0 * own, "%"),
            Quantity(f"least with any other, {written[best_rival]}", 100.0 * rival, "%"),
        ),
        verdict,
        f"With {written[read]} some coefficients within the printed digits bring {what} to within "
        f"{percent(own, 2)} of Table 4 at all three pressures; no other signs come nearer than "
        f"{percent(rival)}.",
        "", Basis.PRINTED,
    )  # fmt: skip


def signs_of_rut(published: Published) -> Finding:
    """Test the signs of n0, n1 and of the exponent of k (Eq 21)."""
    figures = published.rut_depth.estimates
    setup = published.setup
    n0, n1, k = (printed(figures[name]) for name in ("n0", "n1", "k"))
    slip = printed(setup.largest_rut_slip)
    lengths = [printed(f) for f in setup.contact_length_mm.values()]
    area = Interval(
        np.array([float(i.lower) for i in lengths]), np.array([float(i.upper) for i in lengths])
    ) * printed(setup.contact_width_mm)
    pressure = exact(1e6 * setup.normal_load_kn.value) / area
    towed, driven = (
        exp((log(pressure) - log(k)) / n) for n in (n0, n0 + n1 * slip)
    )  # metres, of each pressure
    mm = exact(1000.0)
    towed_mm = rounded("rut without slip", mm * towed, "mm", middle=False)
    driven_mm = rounded("rut at the largest slip fitted", mm * driven, "mm", middle=False)
    deepens = bool(np.all(driven.lower > towed.upper))
    sensible = bool(towed_mm.lower > 1.0 and towed_mm.upper < setup.tyre_width_mm.value)
    return Finding(
        "table6_signs", FAMILY, "Table 6, Eqs 18 and 21",
        ("Table 6: n0", "Table 6: n1", "Table 6: k"),
        f"n1 = {figures['n1'].text} and the exponent of k = {figures['k'].text} are positive",
        "Eq 21 at load over contact area, over all parameters that print alike: ruts must deepen "
        "with slip (Eq 18 stands for slip sinkage) and be between 1 mm and the width of the tyre",
        (towed_mm, driven_mm),
        Verdict.CONFIRMED if deepens and sensible else Verdict.CONTRADICTED,
        f"Ruts go from {number(towed_mm.lower)}-{number(towed_mm.upper)} mm without slip to "
        f"{number(driven_mm.lower)}-{number(driven_mm.upper)} mm at "
        f"{100.0 * setup.largest_rut_slip.value:g} % slip; the other sign of n1 would make them "
        "shallower, that of k's exponent kilometres deep.",
        "The size of k depends on the average ground pressures, which are not printed.",
        Basis.PHYSICS,
    )  # fmt: skip
