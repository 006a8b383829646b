"""Table 1, bulk density, and Tables 3 and 4, the Magic Formula at each pressure.

*Density.* Eq 1, density = {(CI/C1) [C2 + (theta - C3)^2]}^(1/C4), has every coefficient once, so
its extremes over all that print alike are those of interval arithmetic.

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
    exp,
    largest_pull,
    log,
    peak_slip,
    printed,
    references,
    root_of_rest,
    sin,
    square,
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

# Table 1

# Cone indices of soils that carry a wheel but let it sink, kPa.
_CONE_INDEX = Interval(np.array(100.0), np.array(3000.0))
# Dry bulk density of mineral soils, g/cm^3: 1.0 to 1.9 (Brady & Weil 2016, The Nature and
# Properties of Soils), with a tenth to either side.
_MINERAL = 0.9, 2.0


def density_range(
    published: Published, *, exponent: int = 1, C3_sign: int = 1, cone_index: Interval = _CONE_INDEX
) -> Interval:
    """Return the densities (g/cm^3) that Table 1 gives over the tested water contents.

    1 takes the exponent of C1, or C3, with the sign that it is read with, -1 with the other; cone
    index is in the unit of Eq 1.
    """
    figures = published.bulk_density.estimates
    C1, C2, C3, C4 = (printed(figures[name]) for name in ("C1", "C2", "C3", "C4"))
    if exponent < 0:
        mantissa = exact(10.0 ** np.floor(np.log10(figures["C1"].value)))
        C1 = C1 / mantissa / mantissa
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


def _mineral(density: Interval) -> bool:
    low, high = _MINERAL
    return bool(density.lower >= low and density.upper <= high)


def _density(name: str, density: Interval) -> Quantity:
    ends = float(density.lower), float(density.upper)
    return between(name, *ends, "g/cm^3", "over conditions and rounding")


def _exponent(published: Published) -> Finding:
    figure = published.bulk_density.estimates["C1"]
    read, other = density_range(published), density_range(published, exponent=-1)
    verdict = beside_rival(_mineral(read), _mineral(other))
    wrong = other if verdict is Verdict.CONFIRMED else read
    power = int(np.floor(np.log10(figure.value)))
    return finding(
        "table1_exponent_of_C1", verdict,
        (_density(f"density with an exponent of {power:+d}", read),
         _density(f"density with an exponent of {-power:+d}", other)),
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
    return "any number of" if share >= 1.0 else int(len(table.estimates) / (1.0 - share))


def _sign_of_C3(published: Published) -> Finding:
    rmse = published.bulk_density.quality["rmse"].value
    read, other = (
        density_range(published, C3_sign=sign, cone_index=exact(400.0)) for sign in (1, -1)
    )
    apart = float(max(other.upper - read.lower, read.upper - other.lower))
    return finding(
        "table1_sign_of_C3", Verdict.UNTESTABLE if apart <= 2.0 * rmse else Verdict.CONSISTENT,
        (_density("density with C3 positive", read), _density("density with C3 negative", other),
         Quantity("largest difference", apart, "g/cm^3", published=f"RMSE {rmse:g}")),
        C3=published.bulk_density.estimates["C3"], apart=apart, rmse=rmse,
    )  # fmt: skip


def _unit(published: Published) -> Finding:
    mpa = Interval(_CONE_INDEX.lower / 1000.0, _CONE_INDEX.upper / 1000.0)
    in_kpa, in_mpa = density_range(published), density_range(published, cone_index=mpa)
    verdict = beside_rival(_mineral(in_kpa), _mineral(in_mpa))
    # That only kPa gives a soil does not prove it; that both do decides nothing.
    weaker = {Verdict.CONFIRMED: Verdict.CONSISTENT, Verdict.CONSISTENT: Verdict.UNTESTABLE}
    return finding(
        "table1_unit_of_cone_index", weaker.get(verdict, verdict),
        (_density("density with kPa", in_kpa), _density("density with MPa", in_mpa)),
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
    spread = rmse / root_of_rest(r_squared)
    explained = np.sqrt(r_squared.upper) * spread.upper / density.lower
    factor = float(np.exp(table.values["C4"] * explained))
    possible = isinstance(most, str) or most >= fewest
    return finding(
        "table1_quality", consistent_if(possible and factor < 30.0),
        (Quantity("samples at least", fewest),
         rounded("sd of the measured densities", spread, "g/cm^3"),
         Quantity("factor of cone index per sd of the fitted densities, at most", factor)),
        quality=table.quality, fewest=int(fewest), factor=factor,
        spread=float(spread.middle / density.middle),
    )  # fmt: skip


# Tables 3 and 4


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
