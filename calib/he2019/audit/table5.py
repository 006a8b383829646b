"""Table 5, the drawbar pull at any pressure: signs, unit of pressure, cost, digits.

*Signs and unit.* All coefficients that print as c, c' and c'' form a box, and the quadratic is
linear in them: the smallest possible largest relative deviation from Table 4 at its pressures is a
linear programme, solved exactly. A reading (of signs, of the unit of pressure) under which even the
best coefficients of the box are far from Table 4 cannot be what the source fitted.

*Cost.* Quadratics through three pressures are free at each of them, so Eqs 12-15 are the Magic
Formula of each pressure with one C for all. Any such curves near Table 4's cost at most
(|d| + r)^2 a pressure (`calib.he2019.audit.bounds`), whatever the data: that bounds the optimum
from above. With the largest distance over all slips in the place of the tested ones the bound needs
no slips at all.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import product
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
    joint_bounds,
    pressure_box,
    pressure_curves,
    printed,
    printed_coefficients,
    pull,
    pull_from_slope,
    quadratic,
    references,
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
from calib.models.base import Array
from calib.models.magic_formula import magic_formula
from calib.report.numbers import format_number
from calib.report.reference import FittedTable

# Signs, and the unit of pressure

type Signs = tuple[int, int, int]

READINGS: tuple[Signs, ...] = tuple((a, b, c) for a, b, c in product((1, -1), repeat=3))


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
) -> tuple[float, Array]:
    """Return the best that D, BCD or E of Table 5 can do, pressure in units of so many psi.

    That is the least possible largest relative deviation from Table 4, and its coefficients (3,).
    """
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
    return float(found.x[3]), np.asarray(found.x[:3])


def deviations(published: Published, what: str, *, psi_per_unit: float = 1.0) -> dict[Signs, float]:
    """Return the least deviation for each of the eight readings of three signs."""
    return {s: nearest(published, what, signs=s, psi_per_unit=psi_per_unit)[0] for s in READINGS}


def _far(deviation: float) -> bool:
    """Whether a reading is refused: even its best coefficients miss Table 4 by half."""
    return deviation > 0.5


def signs_of_quadratic(published: Published, what: str) -> Finding:
    """Test the signs of the coefficients of D or of BCD in Table 5."""
    least, read = deviations(published, what), printed_signs(published, what)
    own = least.pop(read)
    rival_signs, rival = min(least.items(), key=lambda item: item[1])
    names, written = NAMES[what], signs_text(read)
    return finding(
        f"table5_signs_of_{what}", beside_rival(not _far(own), not _far(rival)),
        (Quantity(f"least deviation with {written}", 100.0 * own, "%"),
         Quantity(f"least with any other, {signs_text(rival_signs)}", 100.0 * rival, "%")),
        claim="table5_signs", figures=[f"Table 5: {' '.join(names)}"], names=names, what=what,
        read=written, own=own, rival=rival,
    )  # fmt: skip


def pressure_unit(published: Published) -> Finding:
    """Test in which unit of pressure Table 5 can reproduce D and BCD of Table 4."""
    declared, psi_per_unit = "kPa", {"psi": 1.0, "kPa": 1.0 / 6.894757, "bar": 100.0 / 6.894757}
    # The worse of D and BCD under the best of the eight readings of the signs.
    least = {
        unit: max(
            min(deviations(published, what, psi_per_unit=scale).values()) for what in ("D", "BCD")
        )
        for unit, scale in psi_per_unit.items()
    }
    possible = {unit for unit, deviation in least.items() if not _far(deviation)}
    return finding(
        "table5_pressure_unit", beside_rival(declared in possible, bool(possible - {declared})),
        (Quantity(f"least deviation in {unit}", 100.0 * d, "%") for unit, d in least.items()),
        declared=declared, least=least, best=min(least, key=lambda unit: least[unit]),
    )  # fmt: skip


# The cost of Table 5


class Bounds(NamedTuple):
    """Costs (kN^2) not exceeded: at any slips, at the assumed ones, there if Table 4 is optimal."""

    anywhere: float
    assumed: float
    optimal: float


def _range_of_C(published: Published) -> tuple[float, float]:
    values = [table.values["C"] for table in published.genetic.values()]
    return min(values), max(values)


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
    in_bins = apart[:-1].reshape(75, -1)
    largest = np.maximum(in_bins.max(axis=1), np.append(in_bins[1:, 0], apart[-1]))
    return np.asarray(np.sqrt(np.sum(np.sort(largest)[-levels:] ** 2)))


def _largest_norm(table: FittedTable, C: float, levels: int) -> float:
    """Return a |d| (kN) that some curve with another C exceeds at no slips, rounding included."""
    coarse, fine = (np.linspace(0.0, 75.0, n * 75 + 1) for n in (4, 100))  # %
    fitted = magic_formula(coarse, **table.values)

    def norm(t: Array) -> float:
        apart = np.abs(magic_formula(coarse, t[0], C, t[1], t[2]) - fitted)
        return float(_worst_norm(apart, levels)) if np.isfinite(apart).all() else 1e3

    # The curve that is nearest at the worst slips.
    B, D, E = minimize(
        norm, _start(table, C, coarse), method="Nelder-Mead",
        options={"xatol": 1e-5, "fatol": 1e-5, "maxiter": 1000, "maxfev": 1000},
    ).x  # fmt: skip
    allowed, curve = pull(fine, coefficients(table)), magic_formula(fine, B, C, D, E)
    apart = np.maximum(allowed.upper - curve, curve - allowed.lower)
    between = 0.5 * np.abs(np.diff(curve - magic_formula(fine, **table.values))).max()
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

    # It bounds the optimum whatever C is; the last digit of the best C is of no use.
    ends = _range_of_C(published)
    return float(minimize_scalar(total, bounds=ends, method="bounded", options={"xatol": 5e-3}).fun)


def assumed_slips_bound(published: Published, *, optimal: bool) -> float:
    """Return a cost (kN^2) the optimum cannot exceed; `optimal` takes Table 4 for the optimum."""
    known = references(published)

    def cost(reference: Reference, C: float) -> float:
        t = _start(published.genetic[reference.psi], C, ASSUMED_SLIPS)
        curve = magic_formula(ASSUMED_SLIPS, t[0], C, t[1], t[2])[None]
        return float(reference.bounds(curve, optimal=optimal)[1][0])

    return min(
        sum(cost(r, float(C)) for r in known) for C in np.linspace(*_range_of_C(published), 9)
    )


@one_thread()
def cost_bounds(published: Published) -> Bounds:
    """Bound the joint optimum, from Table 4 alone."""
    assumed, optimal = (assumed_slips_bound(published, optimal=o) for o in (False, True))
    return Bounds(any_slips_bound(published), assumed, optimal)


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
        "table5_joint_cost", consistent_if(not contradicted),
        (*(between(what, floor, most, "kN^2", kind, figure.text) for what, most, kind in each),
         Quantity(name, reconstructed_optimum, "kN^2", published=figure.text)),
        basis=Basis.PRINTED if below or above else None, printed=figure, floor=floor, below=below,
        above=above, levels=published.setup.slip_levels.text, largest_slip=75,
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
        "table5_cost_as_printed", consistent_if(not any(refused)), found,
        printed=figure, strict=strict.tolist(), least=least.tolist(), named=named,
    )  # fmt: skip


# The digits of Tables 4 and 5

# Digits are enough where D, BCD or the pull is fixed to this part.
_WANTED = 0.01


class RoundingStudy(NamedTuple):
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
    widest = {psi: float(allowed.half_width.max()) for psi, allowed in study.table4.items()}
    worst = max(widest.values())
    table4 = finding(
        "table4_digits",
        Verdict.CONFIRMED if worst < 0.005 else Verdict.CORRECTED,
        (Quantity(f"half the widest range at {p} psi", w, "kN") for p, w in widest.items()),
        worst=worst,
    )
    return [
        _digits_of_D(published), _digits_of_BCD_and_E(published), _digits_of_pull(published, study),
        _digits_of_C(published), table4,
    ]  # fmt: skip


class _Range(NamedTuple):
    """What the digits allow a quadratic at a pressure, beside Table 4's value; half its part."""

    psi: float
    allowed: Interval
    wanted: float
    spread: float


def _ranges(published: Published, what: str, unit: str) -> tuple[list[_Range], list[Quantity]]:
    ranges, found = [], []
    for psi, wanted in zip(*(a.tolist() for a in targets(published, what)), strict=True):
        allowed = quadratic(published, NAMES[what], psi)
        ranges.append(_Range(psi, allowed, wanted, float(allowed.half_width) / wanted))
        beside = f"{format_number(wanted, 4)} (Table 4)"
        found.append(replace(rounded(f"{what} at {psi:g} psi", allowed, unit), published=beside))
    return ranges, found


def _digits_of_D(published: Published) -> Finding:
    ranges, found = _ranges(published, "D", "kN")
    worst = max(ranges, key=lambda r: r.spread)
    deviation, best = nearest(published, "D")
    verdict = Verdict.CONTRADICTED
    if all(r.allowed.holds(r.wanted) for r in ranges):
        verdict = Verdict.CORRECTED if worst.spread > _WANTED else Verdict.CONFIRMED
    c3, best_c3 = published.pressure.estimates["c3"], float(best[2])
    name = "c3 that brings D nearest to Table 4"
    return finding(
        "table5_digits_of_D", verdict,
        [*found, Quantity(name, best_c3, "kN/psi^2", published=c3.text)],
        psi=worst.psi, spread=worst.spread, range=worst.allowed,
        off=abs(float(worst.allowed.middle) / worst.wanted - 1.0), best_c3=best_c3,
        deviation=deviation, wanted=_WANTED, c3=c3,
        needed=_WANTED * worst.wanted / worst.psi**2,
    )  # fmt: skip


def _digits_of_BCD_and_E(published: Published) -> Finding:
    slope, found = _ranges(published, "BCD", "kN/%")
    curvature, more = _ranges(published, "E", "1")
    spread = max(r.spread for r in slope)
    missed, outside = (
        [f"{r.psi:g}" for r in ranges if not r.allowed.holds(r.wanted)]
        for ranges in (slope, curvature)
    )
    verdict = Verdict.CORRECTED if spread > _WANTED else Verdict.CONFIRMED
    if outside or missed:
        verdict = Verdict.CONTRADICTED
    return finding(
        "table5_digits_of_BCD_and_E", verdict, found + more, missed=missed, outside=outside,
        spread=spread,
    )  # fmt: skip


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
        "table5_b0", consistent_if(inside),
        [between("C of Table 4", low, high, "1", "over pressures", figure.text)],
        b0=figure, low=low, high=high,
    )  # fmt: skip
