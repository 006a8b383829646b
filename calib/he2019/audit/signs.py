"""Signs of Tables 3 to 6, and the unit of pressure in Table 5.

The text of the source lost every minus, so each sign is an inference.

E: the peak of the pull must lie inside the tested slips, since Eqs 6-9 read it off the curve. With
E above one the argument of the formula has a maximum of its own, which may stay below what the peak
needs; that is decided for all coefficients that print alike.

Table 5: all coefficients that print as c, c' and c'' form a box, and the quadratic is linear in
them: the smallest possible largest relative deviation from Table 4 at its pressures is a linear
programme, solved exactly. A reading (of signs, of the unit of pressure) under which even the best
coefficients of the box are far from Table 4 cannot be what the source fitted.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from scipy.optimize import linprog

from calib.he2019.audit.finding import Basis, Finding, Quantity, Verdict, number, percent, rounded
from calib.he2019.audit.intervals import Interval, exact, exp, log, printed
from calib.he2019.audit.nearness import ASSUMED_SLIPS
from calib.he2019.audit.pull import coefficients, largest_pull, peak_slip
from calib.he2019.datasets.published import FittedTable, Published
from calib.models.base import Array
from calib.models.magic_formula import magic_formula

type Signs = tuple[int, int, int]

NAMES: Mapping[str, tuple[str, str, str]] = MappingProxyType(
    {"D": ("c1", "c2", "c3"), "BCD": ("c4", "c5", "c6"), "E": ("c7", "c8", "c9")}
)


class Nearest(NamedTuple):
    """The best a box of coefficients can do.

    The smallest possible largest relative deviation over the pressures, the coefficients (3,) that
    reach it, and the quadratic there (m,).
    """

    deviation: float
    coefficients: Array
    values: Array


def targets(published: Published, what: str) -> tuple[Array, Array]:
    """Return the pressures of Table 4 (psi) and its D (kN), BCD (kN/%) or E at them."""
    tables = published.genetic
    values = [t.values for t in tables.values()]
    read = {
        "D": [v["D"] for v in values],
        "BCD": [v["B"] * v["C"] * v["D"] for v in values],
        "E": [v["E"] for v in values],
    }
    return np.array([float(psi) for psi in tables]), np.array(read[what])


def printed_signs(published: Published, what: str) -> Signs:
    """Return the signs of a quadratic's coefficients as they are read."""
    a, b, c = (int(np.sign(published.pressure.estimates[n].value)) for n in NAMES[what])
    return a, b, c


def nearest(
    published: Published, what: str, *, signs: Signs | None = None, psi_per_unit: float = 1.0
) -> Nearest:
    """Return the best that coefficients of D, BCD or E printed as in Table 5 can do.

    Signs are as they are read by default; pressure enters in units of so many psi.
    """
    figures = [published.pressure.estimates[name] for name in NAMES[what]]
    read = signs or printed_signs(published, what)
    middle = [sign * abs(f.value) for sign, f in zip(read, figures, strict=True)]
    pressures, wanted = targets(published, what)
    powers = np.vander(pressures / psi_per_unit, 3, increasing=True)
    scaled = powers / np.abs(wanted)[:, None]
    ones, sign = np.ones((pressures.size, 1)), np.sign(wanted)
    found = linprog(
        [0.0, 0.0, 0.0, 1.0],
        A_ub=np.block([[scaled, -ones], [-scaled, -ones]]),
        b_ub=np.concatenate([sign, -sign]),
        bounds=[
            *((m - f.half_unit, m + f.half_unit) for m, f in zip(middle, figures, strict=True)),
            (0.0, None),
        ],
    )
    if found.x is None:  # the largest deviation is free to grow, so this cannot happen
        raise RuntimeError(f"the linear programme failed: {found.message}")
    coefficients = np.asarray(found.x[:3])
    return Nearest(float(found.x[3]), coefficients, np.asarray(powers @ coefficients))


def nearest_by_signs(
    published: Published, what: str, *, psi_per_unit: float = 1.0
) -> dict[Signs, Nearest]:
    """Return the best for each of the eight readings of three signs."""
    readings = list(product((1, -1), repeat=3))
    return {
        (a, b, c): nearest(published, what, signs=(a, b, c), psi_per_unit=psi_per_unit)
        for a, b, c in readings
    }


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


PSI_PER_UNIT: Mapping[str, float] = MappingProxyType(
    {"psi": 1.0, "kPa": 1.0 / 6.894757, "bar": 100.0 / 6.894757}
)
_DECLARED = "kPa"


def pressure_unit(published: Published) -> Finding:
    """Test in which unit of pressure Table 5 can reproduce D and BCD of Table 4."""
    # The worse of D and BCD under the best of the eight readings of the signs.
    least = {
        unit: max(
            min(n.deviation for n in nearest_by_signs(published, what, psi_per_unit=scale).values())
            for what in ("D", "BCD")
        )
        for unit, scale in PSI_PER_UNIT.items()
    }
    possible = [unit for unit, deviation in least.items() if deviation <= FAR]
    if _DECLARED in possible:
        verdict = Verdict.CONFIRMED if possible == [_DECLARED] else Verdict.CONSISTENT
    else:
        verdict = Verdict.CORRECTED if possible else Verdict.CONTRADICTED
    best = min(least, key=lambda unit: least[unit])
    return Finding(
        "table5_pressure_unit", "Unit of pressure", "Table 5, Eqs 12-15, nomenclature",
        tuple(f"Table 5: {name}" for what in ("D", "BCD") for name in NAMES[what]),
        f"inflation pressure enters Eqs 12-15 in {_DECLARED}",
        "linear programme: the least that D and BCD can deviate from Table 4, over all "
        "coefficients that print alike and all readings of their signs, in each unit",
        tuple(
            Quantity(f"least deviation in {unit}", 100.0 * deviation, "%")
            for unit, deviation in least.items()
        ),
        verdict,
        f"In {best} Table 5 can come within {percent(least[best], 2)} of Table 4; in {_DECLARED} "
        f"no coefficients that print alike come nearer than {percent(least[_DECLARED])}, "
        "whatever their signs.",
        "", Basis.PRINTED,
    )  # fmt: skip
