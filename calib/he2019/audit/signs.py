"""Signs of Tables 3 to 6, and the unit of pressure in Table 5.

The text of the source lost every minus, so each sign is an inference.

E: the peak of the pull must lie inside the tested slips, since Eqs 6-9 read it off the curve. With
E above one the argument of the formula has a maximum of its own, which may stay below what the peak
needs; that is decided for all coefficients that print alike.

Table 5: all coefficients that print as c, c' and c'' form a box, and the quadratic is linear in
them: the smallest possible largest relative deviation from Table 4 at its pressures is a linear
programme, solved exactly. A reading (of signs, of the unit of pressure) under which even the best
coefficients of the box are far from Table 4 cannot be what the source fitted.

Table 1: the exponent of C1, the sign of C3, the unit of cone index, the goodness of fit.

Eq 1, density = {(CI/C1) [C2 + (theta - C3)^2]}^(1/C4), has every coefficient once: over all that
print alike its extremes are those of interval arithmetic.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from scipy.optimize import linprog

from calib.he2019.audit.finding import (
    Basis,
    Finding,
    Quantity,
    Verdict,
    beside_rival,
    between,
    finding,
    rounded,
)
from calib.he2019.audit.intervals import Interval, exact, exp, log, printed, square
from calib.he2019.audit.nearness import ASSUMED_SLIPS
from calib.he2019.audit.pull import coefficients, largest_pull, peak_slip
from calib.he2019.datasets.published import Published
from calib.models.base import Array
from calib.models.magic_formula import magic_formula
from calib.report.reference import FittedTable

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
    return {
        (a, b, c): nearest(published, what, signs=(a, b, c), psi_per_unit=psi_per_unit)
        for a, b, c in product((1, -1), repeat=3)
    }


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
    mirrored = {**values, "E": -values["E"]}
    apart = magic_formula(ASSUMED_SLIPS, **values) - magic_formula(ASSUMED_SLIPS, **mirrored)
    noise = np.sqrt(table.quality["cost"].value / (ASSUMED_SLIPS.size - len(values)))
    return finding(
        f"{name}_sign_of_E", verdict, found, claim="sign_of_E", figures=[f"{table.source}: E"],
        basis=Basis.SLIPS if verdict is Verdict.CONSISTENT else None, source=table.source, E=E,
        D=D, top=None if top is None else float(top.upper), apart=float(np.abs(apart).max()),
        noise=float(noise), read=None if read is None else float(read.middle),
        other=None if other is None else float(other.middle),
    )  # fmt: skip


def signs_of_quadratic(published: Published, what: str) -> Finding:
    """Test the signs of the coefficients of D or of BCD in Table 5."""
    by_signs = nearest_by_signs(published, what)
    read = printed_signs(published, what)
    own = by_signs.pop(read).deviation
    rival_signs = min(by_signs, key=lambda signs: by_signs[signs].deviation)
    rival = by_signs[rival_signs].deviation
    names, written = NAMES[what], signs_text(read)
    return finding(
        f"table5_signs_of_{what}", beside_rival(own <= FAR, rival <= FAR),
        (Quantity(f"least deviation with {written}", 100.0 * own, "%"),
         Quantity(f"least with any other, {signs_text(rival_signs)}", 100.0 * rival, "%")),
        claim="table5_signs", figures=[f"Table 5: {' '.join(names)}"], names=names, what=what,
        read=written, own=own, rival=rival,
    )  # fmt: skip


def signs_text(signs: tuple[int, ...]) -> str:
    """Write signs as they are read: (+, -, +)."""
    return "(" + ", ".join("+-"[s < 0] for s in signs) + ")"


def signs_of_rut(published: Published) -> Finding:
    """Test the signs of n0, n1 and of the exponent of k (Eq 21)."""
    figures, setup = published.rut_depth.estimates, published.setup
    n0, n1, k = (printed(figures[name]) for name in ("n0", "n1", "k"))
    slip = printed(setup.largest_rut_slip)
    lengths = [printed(f) for f in setup.contact_length_mm.values()]
    ends = (np.array([float(getattr(i, end)) for i in lengths]) for end in ("lower", "upper"))
    area = Interval(*ends) * printed(setup.contact_width_mm)
    pressure = exact(1e6 * setup.normal_load_kn.value) / area
    # In metres, of each pressure.
    towed, driven = (exp((log(pressure) - log(k)) / n) for n in (n0, n0 + n1 * slip))
    mm = exact(1000.0)
    towed_mm = rounded("rut without slip", mm * towed, "mm", middle=False)
    driven_mm = rounded("rut at the largest slip fitted", mm * driven, "mm", middle=False)
    deepens = bool(np.all(driven.lower > towed.upper))
    sensible = bool(towed_mm.lower > 1.0 and towed_mm.upper < setup.tyre_width_mm.value)
    return finding(
        "table6_signs", Verdict.CONFIRMED if deepens and sensible else Verdict.CONTRADICTED,
        (towed_mm, driven_mm), n1=figures["n1"], k=figures["k"], towed=towed_mm, driven=driven_mm,
        slip=setup.largest_rut_slip.value,
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
    possible = {unit for unit, deviation in least.items() if deviation <= FAR}
    return finding(
        "table5_pressure_unit",
        beside_rival(_DECLARED in possible, bool(possible - {_DECLARED})),
        (Quantity(f"least deviation in {unit}", 100.0 * d, "%") for unit, d in least.items()),
        declared=_DECLARED, least=least, best=min(least, key=lambda unit: least[unit]),
    )  # fmt: skip


# Cone indices of soils that carry a wheel but let it sink, kPa.
_CONE_INDEX = Interval(np.array(100.0), np.array(3000.0))
# Dry bulk density of mineral soils, g/cm^3: 1.0 to 1.9 (Brady & Weil 2016, The Nature and
# Properties of Soils), with a tenth to either side.
_MINERAL = (0.9, 2.0)
_KPA_PER_MPA = 1000.0


def density_range(
    published: Published,
    *,
    exponent: int = 1,
    C3_sign: int = 1,
    cone_index: Interval = _CONE_INDEX,
) -> Interval:
    """Return the densities (g/cm^3) that Table 1 gives over the tested water contents.

    1 takes the exponent of C1, or C3, with the sign that it is read with, -1 with the other; cone
    index is in the unit of Eq 1.
    """
    figures = published.bulk_density.estimates
    C1, C2, C3, C4 = (printed(figures[name]) for name in ("C1", "C2", "C3", "C4"))
    if exponent < 0:
        mantissa = 10.0 ** np.floor(np.log10(figures["C1"].value))
        C1 = C1 / exact(mantissa) / exact(mantissa)
    if C3_sign < 0:
        C3 = -C3
    largest = published.setup.largest_water_content
    water = Interval(np.array(0.0), np.array(largest.value + largest.half_unit))
    return exp((log(cone_index) - log(C1) + log(C2 + square(water - C3))) / C4)


def density_findings(published: Published) -> list[Finding]:
    """Judge Table 1."""
    return [
        _exponent(published), _sign_of_C3(published), _unit(published), _quality(published),
        finding("table1_values", Verdict.UNTESTABLE),
    ]  # fmt: skip


def _plausible(density: Interval) -> bool:
    low, high = _MINERAL
    return bool(density.lower >= low and density.upper <= high)


def _quantity(name: str, density: Interval) -> Quantity:
    what = "over conditions and rounding"
    return between(name, float(density.lower), float(density.upper), "g/cm^3", what)


def _exponent(published: Published) -> Finding:
    figure = published.bulk_density.estimates["C1"]
    read, other = density_range(published), density_range(published, exponent=-1)
    verdict = beside_rival(_plausible(read), _plausible(other))
    wrong = other if verdict is Verdict.CONFIRMED else read
    power = int(np.floor(np.log10(figure.value)))
    return finding(
        "table1_exponent_of_C1", verdict,
        (_quantity(f"density with an exponent of {power:+d}", read),
         _quantity(f"density with an exponent of {-power:+d}", other)),
        C1=figure, mineral=_MINERAL, power=-power if wrong is other else power, wrong=wrong,
        read=read, most=_most_samples(published, float(wrong.upper)),
    )  # fmt: skip


def _most_samples(published: Published, densest: float) -> int | str:
    """Return how many samples could have both the RMSE and the largest relative error printed.

    Some error is at least sqrt(SSE/n) = RMSE sqrt((n - p)/n), and none exceeds the largest
    relative error of the densest sample.
    """
    table = published.bulk_density
    rmse, relative = table.quality["rmse"], table.quality["max_relative_error"]
    part = relative.value + relative.half_unit
    largest = part * densest / (1.0 - part)
    share = (largest / (rmse.value - rmse.half_unit)) ** 2
    p = len(table.estimates)
    return "any number of" if share >= 1.0 else int(p / (1.0 - share))


def _sign_of_C3(published: Published) -> Finding:
    rmse = published.bulk_density.quality["rmse"].value
    one = Interval(np.array(400.0), np.array(400.0))
    read = density_range(published, cone_index=one)
    other = density_range(published, C3_sign=-1, cone_index=one)
    apart = float(max(other.upper - read.lower, read.upper - other.lower))
    return finding(
        "table1_sign_of_C3",
        Verdict.UNTESTABLE if apart <= 2.0 * rmse else Verdict.CONSISTENT,
        (_quantity("density with C3 positive", read), _quantity("density with C3 negative", other),
         Quantity("largest difference", apart, "g/cm^3", published=f"RMSE {rmse:g}")),
        C3=published.bulk_density.estimates["C3"], apart=apart, rmse=rmse,
    )  # fmt: skip


def _unit(published: Published) -> Finding:
    in_kpa = density_range(published)
    low, high = (end / _KPA_PER_MPA for end in (_CONE_INDEX.lower, _CONE_INDEX.upper))
    in_mpa = density_range(published, cone_index=Interval(low, high))
    fine = _plausible(in_kpa), _plausible(in_mpa)
    return finding(
        "table1_unit_of_cone_index",
        # That only kPa gives a soil would not prove it.
        {(True, True): Verdict.UNTESTABLE, (True, False): Verdict.CONSISTENT}.get(
            fine, beside_rival(*fine)
        ),
        (_quantity("density with kPa", in_kpa), _quantity("density with MPa", in_mpa)),
        in_kpa=in_kpa, in_mpa=in_mpa,
    )  # fmt: skip


def _quality(published: Published) -> Finding:
    table = published.bulk_density
    r_squared, rmse, relative = (
        printed(table.quality[name]) for name in ("r_squared", "rmse", "max_relative_error")
    )
    density = density_range(published)
    # One error squared is no more than all of them: (relative x density)^2 <= RMSE^2 (n - p).
    largest = relative * density
    fewest = len(table.estimates) + float(np.ceil((largest.lower / rmse.upper) ** 2))
    most = _most_samples(published, float(density.upper))
    # The sd of the observed densities, and the factor of cone index that the explained part needs.
    spread = rmse / Interval(*(np.sqrt(1.0 - e) for e in (r_squared.upper, r_squared.lower)))
    explained = np.sqrt(r_squared.upper) * spread.upper / density.lower
    factor = float(np.exp(table.values["C4"] * explained))
    possible = isinstance(most, str) or most >= fewest
    return finding(
        "table1_quality",
        Verdict.CONSISTENT if possible and factor < 30.0 else Verdict.CONTRADICTED,
        (Quantity("samples at least", fewest),
         rounded("sd of the measured densities", spread, "g/cm^3"),
         Quantity("factor of cone index per sd of the fitted densities, at most", factor)),
        quality=table.quality, fewest=int(fewest), factor=factor,
        spread=float(spread.middle / density.middle),
    )  # fmt: skip
