"""Tables 3 to 5, the drawbar pull: features, signs, the unit of pressure, costs and digits.

*Table 3.* Eqs 6-9 can be inverted: a row states an initial slope tan(theta) = BCD, a peak (xm, ym)
and an asymptote ys. These are set beside the features of Table 4's curve, fitted to the same tests.
A slope that is the chord to the peak instead, tan(theta) = ym/xm, makes B xm = 1/C, and then

    E = [1/C - tan(pi/(2C))]/[1/C - arctan(1/C)],

strongly negative whatever the curve.

*Signs.* The text of the source lost every minus, so each sign is an inference. The peak of the pull
must lie inside the tested slips, since Eqs 6-9 read it off the curve. With E above one the argument
of the formula has a maximum of its own, which may stay below what the peak needs.

*Table 5.* All coefficients that print as c, c' and c'' form a box, and the quadratic is linear in
them: the smallest possible largest relative deviation from Table 4 at its pressures is a linear
programme, solved exactly. A reading (of signs, of the unit of pressure) under which even the best
coefficients of the box are far from Table 4 cannot be what the source fitted.

*Cost.* Quadratics through three pressures are free at each of them, so Eqs 12-15 are the Magic
Formula of each pressure with one C for all. Any such curves near Table 4's cost at most
(|d| + r)^2 a pressure (`calib.he2019.audit.bounds`), whatever the data: that bounds the optimum
from above. With the largest distance over all slips in the place of the tested ones the bound needs
no slips at all.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import product
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares, linprog, minimize, minimize_scalar

from calib.batch.environment import one_thread
from calib.he2019.audit.bounds import (
    ASSUMED_SLIPS,
    NAMES,
    Interval,
    Reference,
    coefficients,
    exact,
    joint_bounds,
    largest_pull,
    peak_slip,
    pressure_box,
    pressure_curves,
    printed,
    printed_coefficients,
    pull,
    pull_from_slope,
    quadratic,
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
    finding,
    rounded,
)
from calib.he2019.published import Published
from calib.inference.estimators import PointEstimate
from calib.models.base import Array
from calib.models.magic_formula import magic_formula
from calib.report.numbers import format_number
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
    verdict = Verdict.CONSISTENT if better and not refused[False] else Verdict.CONTRADICTED
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


# Signs, and the unit of pressure

type Signs = tuple[int, int, int]

READINGS: tuple[Signs, ...] = tuple((a, b, c) for a, b, c in product((1, -1), repeat=3))
# A reading is refused if even its best coefficients miss Table 4 by more than this part.
FAR = 0.5
PSI_PER_UNIT: Mapping[str, float] = MappingProxyType(
    {"psi": 1.0, "kPa": 1.0 / 6.894757, "bar": 100.0 / 6.894757}
)
_DECLARED = "kPa"


class Nearest(NamedTuple):
    """The least largest relative deviation of a box, its coefficients (3,), the quadratic (m,)."""

    deviation: float
    coefficients: Array
    values: Array


def targets(published: Published, what: str) -> tuple[Array, Array]:
    """Return the pressures of Table 4 (psi) and its D (kN), BCD (kN/%) or E at them."""
    values = [t.values for t in published.genetic.values()]
    wanted = [v["B"] * v["C"] * v["D"] if what == "BCD" else v[what] for v in values]
    return np.array([float(psi) for psi in published.genetic]), np.array(wanted)


def printed_signs(published: Published, what: str) -> Signs:
    """Return the signs of a quadratic's coefficients as they are read."""
    a, b, c = (int(np.sign(published.pressure.estimates[n].value)) for n in NAMES[what])
    return a, b, c


def signs_text(signs: tuple[int, ...]) -> str:
    """Write signs as they are read: (+, -, +)."""
    return "(" + ", ".join("+-"[s < 0] for s in signs) + ")"


def nearest(
    published: Published, what: str, *, signs: Signs | None = None, psi_per_unit: float = 1.0
) -> Nearest:
    """Return the best that D, BCD or E of Table 5 can do, pressure in units of so many psi."""
    figures = [published.pressure.estimates[name] for name in NAMES[what]]
    read = signs or printed_signs(published, what)
    middle = [sign * abs(f.value) for sign, f in zip(read, figures, strict=True)]
    pressures, wanted = targets(published, what)
    powers = np.vander(pressures / psi_per_unit, 3, increasing=True)
    scaled = powers / np.abs(wanted)[:, None]
    ones, sign = np.ones((pressures.size, 1)), np.sign(wanted)
    box = [(m - f.half_unit, m + f.half_unit) for m, f in zip(middle, figures, strict=True)]
    found = linprog(
        [0.0, 0.0, 0.0, 1.0],
        A_ub=np.block([[scaled, -ones], [-scaled, -ones]]),
        b_ub=np.concatenate([sign, -sign]),
        bounds=[*box, (0.0, None)],
    )
    if found.x is None:  # the largest deviation is free to grow, so this cannot happen
        raise RuntimeError(f"the linear programme failed: {found.message}")
    coefficients = np.asarray(found.x[:3])
    return Nearest(float(found.x[3]), coefficients, np.asarray(powers @ coefficients))


def nearest_by_signs(
    published: Published, what: str, *, psi_per_unit: float = 1.0
) -> dict[Signs, Nearest]:
    """Return the best for each of the eight readings of three signs."""
    return {s: nearest(published, what, signs=s, psi_per_unit=psi_per_unit) for s in READINGS}


def signs_of_pull(published: Published) -> list[Finding]:
    """Test the signs of E and of c1 to c6."""
    tables = (*published.geometric.values(), *published.genetic.values())
    return [
        *(sign_of_curvature(table) for table in tables),
        *(signs_of_quadratic(published, what) for what in ("D", "BCD")),
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
    deviations = {s: best.deviation for s, best in nearest_by_signs(published, what).items()}
    read = printed_signs(published, what)
    own = deviations.pop(read)
    rival_signs, rival = min(deviations.items(), key=lambda item: item[1])
    names, written = NAMES[what], signs_text(read)
    return finding(
        f"table5_signs_of_{what}", beside_rival(own <= FAR, rival <= FAR),
        (Quantity(f"least deviation with {written}", 100.0 * own, "%"),
         Quantity(f"least with any other, {signs_text(rival_signs)}", 100.0 * rival, "%")),
        claim="table5_signs", figures=[f"Table 5: {' '.join(names)}"], names=names, what=what,
        read=written, own=own, rival=rival,
    )  # fmt: skip


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


# The cost of Table 5

_BINS = 75
_LARGEST_SLIP = float(_BINS)
_COARSE = np.linspace(0.0, _LARGEST_SLIP, 4 * _BINS + 1)
_FINE = np.linspace(0.0, _LARGEST_SLIP, 100 * _BINS + 1)
_N_C = 9


class Bounds(NamedTuple):
    """Costs (kN^2) not exceeded: at any slips, at the assumed ones, there if Table 4 is optimal."""

    anywhere: float
    assumed: float
    optimal: float


def _common_C(published: Published) -> Array:
    values = [table.values["C"] for table in published.genetic.values()]
    return np.linspace(min(values), max(values), _N_C)


def _start(table: FittedTable, C: float, slips: Array) -> Array:
    """Return B, D and E of the curve with another C nearest in the sum of squares."""
    own = table.values
    curve = magic_formula(slips, **own)

    def apart(t: Array) -> Array:
        return magic_formula(slips, t[0], C, t[1], t[2]) - curve

    found = least_squares(apart, np.array([own["B"], own["D"], own["E"]]), x_scale="jac")
    return np.asarray(found.x)


def _worst_norm(apart: Array, levels: int) -> Array:
    """Return the largest |d| of any slips of which no two are within 1 %: one in each bin."""
    in_bins = apart[:-1].reshape(_BINS, -1)
    largest = np.maximum(in_bins.max(axis=1), np.append(in_bins[1:, 0], apart[-1]))
    return np.asarray(np.sqrt(np.sum(np.sort(largest)[-levels:] ** 2)))


def _nearest_everywhere(table: FittedTable, C: float, levels: int) -> Array:
    """Return B, D and E of the curve with another C that is nearest at the worst slips."""
    curve = magic_formula(_COARSE, **table.values)

    def norm(t: Array) -> float:
        apart = np.abs(magic_formula(_COARSE, t[0], C, t[1], t[2]) - curve)
        return float(_worst_norm(apart, levels)) if np.isfinite(apart).all() else 1e3

    found = minimize(
        norm, _start(table, C, _COARSE), method="Nelder-Mead",
        options={"xatol": 1e-5, "fatol": 1e-5, "maxiter": 1000, "maxfev": 1000},
    )  # fmt: skip
    return np.asarray(found.x)


def _largest_norm(table: FittedTable, C: float, levels: int) -> float:
    """Return a |d| (kN) that some curve with another C exceeds at no slips, rounding included."""
    B, D, E = _nearest_everywhere(table, C, levels)
    allowed = pull(_FINE, coefficients(table))
    curve = magic_formula(_FINE, B, C, D, E)
    apart = np.maximum(allowed.upper - curve, curve - allowed.lower)
    between = 0.5 * np.abs(np.diff(curve - magic_formula(_FINE, **table.values))).max()
    return float(_worst_norm(apart + between, levels))


def any_slips_bound(published: Published) -> float:
    """Return a cost (kN^2) the optimum cannot exceed at any slips up to 75 % that are 1 % apart."""
    levels = int(published.setup.slip_levels.value)

    def total(C: float) -> float:
        cost = 0.0
        for table in published.genetic.values():
            figure = table.quality["cost"]
            r = np.sqrt(figure.value + figure.half_unit)
            cost += float((r + _largest_norm(table, C, levels)) ** 2)
        return cost

    between = _common_C(published)[[0, -1]]
    # It bounds the optimum whatever C is; the last digit of the best C is of no use.
    found = minimize_scalar(total, bounds=between, method="bounded", options={"xatol": 5e-3})
    return float(found.fun)


def assumed_slips_bound(published: Published, *, optimal: bool) -> float:
    """Return a cost (kN^2) the optimum cannot exceed; `optimal` takes Table 4 for the optimum."""
    known = references(published)

    def cost(reference: Reference, C: float) -> float:
        t = _start(published.genetic[reference.psi], C, ASSUMED_SLIPS)
        curve = magic_formula(ASSUMED_SLIPS, t[0], C, t[1], t[2])[None]
        return float(reference.bounds(curve, optimal=optimal)[1][0])

    return min(sum(cost(r, float(C)) for r in known) for C in _common_C(published))


@one_thread()
def bounds(published: Published) -> Bounds:
    """Bound the joint optimum, from Table 4 alone."""
    assumed, optimal = (assumed_slips_bound(published, optimal=o) for o in (False, True))
    return Bounds(any_slips_bound(published), assumed, optimal)


def cost_findings(
    published: Published, reconstructed_optimum: float, at_most: Bounds
) -> list[Finding]:
    """Judge the printed cost: as a minimum, and as that of the printed digits."""
    return [joint_cost(published, reconstructed_optimum, at_most), cost_as_printed(published)]


def joint_cost(published: Published, reconstructed_optimum: float, at_most: Bounds) -> Finding:
    """Judge whether the printed cost can be a minimum of Eq 16, beside the reconstructed one."""
    figure = published.pressure.quality["cost"]
    separate = [table.quality["cost"] for table in published.genetic.values()]
    floor = sum(f.value - f.half_unit for f in separate)
    low, high = figure.value - figure.half_unit, figure.value + figure.half_unit
    below, above = high < floor, low > at_most.anywhere
    contradicted = below or above or low > at_most.assumed
    any_data = "bounds for any data with Table 4's costs"
    each = (
        ("minimum at any slips", at_most.anywhere, any_data),
        ("minimum at the assumed slips", at_most.assumed, any_data),
        ("and if Table 4 is optimal", at_most.optimal, "bounds"),
    )
    name = "minimum on the reconstructed data"
    return finding(
        "table5_joint_cost", Verdict.CONTRADICTED if contradicted else Verdict.CONSISTENT,
        (*(between(what, floor, most, "kN^2", kind, figure.text) for what, most, kind in each),
         Quantity(name, reconstructed_optimum, "kN^2", published=figure.text)),
        basis=Basis.PRINTED if below or above else None, printed=figure, floor=floor, below=below,
        above=above, levels=published.setup.slip_levels.text, largest_slip=_LARGEST_SLIP,
        anywhere=at_most.anywhere, assumed=at_most.assumed,
    )  # fmt: skip


def cost_as_printed(published: Published) -> Finding:
    """Judge whether the coefficients as printed can have the printed cost."""
    figure = published.pressure.quality["cost"]
    known = references(published)
    both = np.tile(printed_coefficients(published), (2, 1))
    both[1, 8] *= -1.0  # the sign of c9 is open
    least, largest = joint_bounds(both, known, ASSUMED_SLIPS, optimal=False)
    strict, _ = joint_bounds(both, known, ASSUMED_SLIPS, optimal=True)
    refused = [bool((bound > figure.value + figure.half_unit).all()) for bound in (least, strict)]
    named = [f"c9 = {c9:+g}" for c9 in both[:, 8]]
    what = "any data with Table 4's costs"
    found = [
        between(f"cost with {name}", low, high, "kN^2", what, figure.text)
        for name, low, high in zip(named, least, largest, strict=True)
    ]
    found += [
        Quantity(f"least with {name} if Table 4 is optimal", low, "kN^2", published=figure.text)
        for name, low in zip(named, strict.tolist(), strict=True)
    ]
    return finding(
        "table5_cost_as_printed", Verdict.CONTRADICTED if any(refused) else Verdict.CONSISTENT,
        found, printed=figure, strict=strict.tolist(), least=least.tolist(), named=named,
    )  # fmt: skip


# The digits of Tables 4 and 5

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
        _digits_of_D(published), _digits_of_BCD_and_E(published), _digits_of_pull(published, study),
        _digits_of_C(published), _table4(study),
    ]  # fmt: skip


class _Range(NamedTuple):
    """What the digits allow a quadratic at a pressure (psi), beside Table 4's value there."""

    psi: float
    allowed: Interval
    wanted: float

    @property
    def spread(self) -> float:
        return float(self.allowed.half_width) / self.wanted

    def shown(self, what: str, unit: str) -> Quantity:
        q = rounded(f"{what} at {self.psi:g} psi", self.allowed, unit)
        return replace(q, published=f"{format_number(self.wanted, 4)} (Table 4)")


def _ranges(published: Published, what: str) -> list[_Range]:
    return [
        _Range(float(p), quadratic(published, NAMES[what], p), float(wanted))
        for p, wanted in zip(*targets(published, what), strict=True)
    ]


def _digits_of_D(published: Published) -> Finding:
    ranges = _ranges(published, "D")
    worst = max(ranges, key=lambda r: r.spread)
    best = nearest(published, "D")
    verdict = Verdict.CONTRADICTED
    if all(r.allowed.holds(r.wanted) for r in ranges):
        verdict = Verdict.CORRECTED if worst.spread > _WANTED else Verdict.CONFIRMED
    c3, best_c3 = published.pressure.estimates["c3"], float(best.coefficients[2])
    name = "c3 that brings D nearest to Table 4"
    return finding(
        "table5_digits_of_D", verdict,
        (*(r.shown("D", "kN") for r in ranges),
         Quantity(name, best_c3, "kN/psi^2", published=c3.text)),
        psi=worst.psi, spread=worst.spread, range=worst.allowed,
        off=abs(float(worst.allowed.middle) / worst.wanted - 1.0), best_c3=best_c3,
        deviation=best.deviation, wanted=_WANTED, c3=c3,
        needed=_WANTED * worst.wanted / worst.psi**2,
    )  # fmt: skip


def _digits_of_BCD_and_E(published: Published) -> Finding:
    slope, curvature = (_ranges(published, what) for what in ("BCD", "E"))
    spread = max(r.spread for r in slope)
    missed, outside = (
        [f"{r.psi:g}" for r in ranges if not r.allowed.holds(r.wanted)]
        for ranges in (slope, curvature)
    )
    verdict = Verdict.CORRECTED if spread > _WANTED else Verdict.CONFIRMED
    if outside or missed:
        verdict = Verdict.CONTRADICTED
    found = [*(r.shown("BCD", "kN/%") for r in slope), *(r.shown("E", "1") for r in curvature)]
    return finding(
        "table5_digits_of_BCD_and_E", verdict, found, missed=missed, outside=outside, spread=spread
    )


def _digits_of_pull(published: Published, study: RoundingStudy) -> Finding:
    found, relative, outside = [], {}, []
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
        curve = study.table4[psi]
        gap = float(np.maximum(allowed.lower - curve.upper, curve.lower - allowed.upper).max())
        if gap > 0.0:
            outside.append(f"by up to {format_number(gap, 2)} kN at {psi} psi")
    best, worst = min(relative, key=lambda p: relative[p]), max(relative, key=lambda p: relative[p])
    return finding(
        "table5_digits_of_pull",
        Verdict.CONFIRMED if relative[worst] <= _WANTED else Verdict.CORRECTED, found,
        open=relative, best=best, worst=worst, outside=outside,
    )  # fmt: skip


def _digits_of_C(published: Published) -> Finding:
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
