"""Exact extremes of the Magic Formula over boxes of coefficients.

With E <= 1 and slip x >= 0 the argument g = (1 - E) u + E arctan u, u = Bx, rises with u and falls
with E, so over a box its extremes are at two corners; for 1 < C < 2 the angle C arctan g stays in
0 to pi. Tables 3 and 4 print B, and every coefficient occurs once: extremes are exact. Table 5
gives K = BCD, so C and D occur twice (u = Kx/(CD)): their ranges are cut into cells, which leaves
an enclosure a little too wide, never too narrow. K fixes the sign of u together with D: the pull
is the same for D and -D, and its limit at D = 0 is zero.

Table 6's goodness of fit: R^2, RMSE and the number of points against each other.

Eq 22 regresses ln pgr, which takes two values d apart, on ln zt and s ln zt. With n points, a part
w of them at the higher pressure and p = 3 coefficients,

    R^2 = 1 - SSE/SST,  SST = n w (1 - w) d^2,  SSE = RMSE^2 (n - p),

so R^2 and RMSE fix d for every n and w; the contact lengths give d too, since load and contact
width are the same at both pressures.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy
from scipy.optimize import brentq

from calib.he2019.audit.finding import (
    Finding,
    Quantity,
    Verdict,
    between,
    finding,
    percent,
    rounded,
)
from calib.he2019.audit.intervals import Interval, arctan, exact, log, printed, sin, tan
from calib.he2019.datasets.published import Published
from calib.he2019.datasets.rut import SLIPS
from calib.models.base import Array
from calib.report.reference import FittedTable

_C_CELLS = 2


class Coefficients(NamedTuple):
    """Intervals of B (1/%) or K (kN/%), C, D (kN) and E."""

    stiffness: Interval
    C: Interval
    D: Interval
    E: Interval


def coefficients(table: FittedTable) -> Coefficients:
    """Return all coefficients that print as in Table 3 or 4."""
    return Coefficients(*(printed(table.estimates[name]) for name in "BCDE"))


def quadratic(published: Published, names: tuple[str, str, str], pressure: float) -> Interval:
    """Return all values of c + c' p + c'' p^2 that the printed digits allow."""
    c, linear, bend = (printed(published.pressure.estimates[name]) for name in names)
    p = exact(pressure)
    return c + linear * p + bend * (p * p)


def pressure_box(published: Published, pressure: float) -> Coefficients:
    """Return K, C, D and E at a pressure that Table 5's digits allow (Eqs 12-15)."""
    return Coefficients(
        quadratic(published, ("c4", "c5", "c6"), pressure),
        printed(published.pressure.estimates["b0"]),
        quadratic(published, ("c1", "c2", "c3"), pressure),
        quadratic(published, ("c7", "c8", "c9"), pressure),
    )


def _argument(u: Interval, E: Interval) -> Interval:
    """Return g over u >= 0 and E <= 1."""
    if np.any(E.upper > 1.0):
        raise ValueError("with E above 1 the argument does not rise with slip")

    def at(point_u: Array, point_E: Array) -> Interval:
        a, e = exact(point_u), exact(point_E)
        return a - e * (a - arctan(a))

    # u = infinity stands for D = 0: the argument is infinite too.
    finite = np.where(np.isfinite(u.upper), u.upper, 0.0)
    lower = at(u.lower, np.broadcast_to(E.upper, u.lower.shape)).lower
    upper = at(finite, np.broadcast_to(E.lower, finite.shape)).upper
    return Interval(np.maximum(lower, 0.0), np.where(np.isfinite(u.upper), upper, np.inf))


def pull(slip_percent: Array, box: Coefficients) -> Interval:
    """Return the exact extremes of the pull (kN) where B is printed (Tables 3 and 4).

    For slips (n,) not negative, B and D positive, C between 1 and 2, E at most 1; else a
    ValueError.
    """
    u = box.stiffness * exact(slip_percent)
    return box.D * sin(box.C * arctan(_argument(u, box.E)))


def pull_from_slope(slip_percent: Array, box: Coefficients, *, cells: int = 400) -> Interval:
    """Return an enclosure of the pull (kN) where K = BCD is printed (Table 5).

    D and C are cut into cells. For K positive, C between 1 and 2, E at most 1, D of either sign;
    else a ValueError.
    """
    if np.any(box.stiffness.lower <= 0.0):
        raise ValueError("the slope must be positive")
    holds_zero = bool(box.D.lower <= 0.0 <= box.D.upper)
    ends = sorted(abs(float(end)) for end in (box.D.lower, box.D.upper))
    D_edges = np.linspace(0.0 if holds_zero else ends[0], ends[1], cells + 1)
    C_edges = np.linspace(float(box.C.lower), float(box.C.upper), _C_CELLS + 1)
    x = np.asarray(slip_percent, dtype=np.float64)[:, None, None]
    D = Interval(D_edges[None, :-1, None], D_edges[None, 1:, None])
    C = Interval(C_edges[None, None, :-1], C_edges[None, None, 1:])
    shape = (x.size, cells, _C_CELLS)
    rise = box.stiffness * exact(x)
    product = C * D
    with np.errstate(divide="ignore", invalid="ignore"):
        low = np.broadcast_to(rise.lower / product.upper, shape)
        # At zero slip the pull is zero whatever D is.
        high = np.where(x > 0.0, rise.upper / np.maximum(product.lower, 0.0), 0.0)
    steps = 8.0 * np.spacing(np.where(np.isfinite(high), high, 0.0))
    u = Interval(np.maximum(low * (1.0 - 1e-14), 0.0), np.broadcast_to(high + steps, shape))
    angle = C * arctan(_argument(u, box.E))
    y = D * sin(Interval(np.maximum(angle.lower, 0.0), np.minimum(angle.upper, np.pi)))
    return Interval(np.maximum(y.lower.min(axis=(1, 2)), 0.0), y.upper.max(axis=(1, 2)))


def _largest_argument(E: float) -> float:
    """Return the largest g over u >= 0 where E > 1: at u^2 = 1/(E - 1)."""
    return float(-np.sqrt(E - 1.0) + E * np.arctan(1.0 / np.sqrt(E - 1.0)))


def peak_argument(C: Interval) -> Interval:
    """Return tan(pi/(2C)), the argument at which the sine reaches one."""
    return tan(exact(0.5 * np.pi) / C)


def largest_pull(box: Coefficients) -> Interval:
    """Return the largest pull (kN) over all slips, however large.

    With E at most 1 it is D. With E above 1 the argument has a maximum, which falls as E rises;
    where that stays below tan(pi/(2C)) everywhere in the box, the pull never reaches D.
    """
    if np.all(box.E.upper <= 1.0):
        return box.D
    top = Interval(
        np.asarray(_largest_argument(float(box.E.upper)) * (1.0 - 1e-12)),
        np.asarray(_largest_argument(float(box.E.lower)) * (1.0 + 1e-12)),
    )
    return box.D * sin(box.C * arctan(top))


def peak_slip(box: Coefficients) -> Interval | None:
    """Return the slip (%) of the peak, or None if no coefficients of the box have one.

    ValueError if a part of the box has a peak and another has none.
    """
    target = peak_argument(box.C)
    low_E, high_E = float(box.E.lower), float(box.E.upper)
    if high_E > 1.0:
        if low_E > 1.0 and _largest_argument(low_E) * (1.0 + 1e-12) < float(target.lower):
            return None
        raise ValueError("only a part of the box has a peak")
    lowest = _peak_u(float(target.lower), low_E) * (1.0 - 1e-10)
    highest = _peak_u(float(target.upper), high_E) * (1.0 + 1e-10)
    return Interval(np.asarray(lowest), np.asarray(highest)) / box.stiffness


def _peak_u(target: float, E: float) -> float:
    def excess(u: float) -> float:
        return float(u - E * (u - np.arctan(u)) - target)

    high = 1.0
    while excess(high) < 0.0:
        high *= 2.0
    return float(brentq(excess, 0.0, high, xtol=1e-14, rtol=1e-14))


_N_MAX = 160
_HELD_OUT_LEAST = 0.025


@dataclass(frozen=True, eq=False)
class QualityStudy:
    """ln(pgr42/pgr18) by the number of points n (m,), and from the contact lengths.

    `implied` (m,) follows from R^2 and RMSE, pressures equally often; the assumed n are two
    pressures at the nine nominal slips up to 20 %.
    """

    n: Array
    implied: Interval
    from_contact: Interval
    assumed_n: int

    @property
    def reconciled(self) -> Array:
        """Numbers of points for which both agree."""
        meet = (self.implied.lower <= self.from_contact.upper) & (
            self.implied.upper >= self.from_contact.lower
        )
        return np.asarray(self.n[meet])


def fitted_lengths(published: Published) -> tuple[Interval, Interval]:
    """Return the contact lengths (mm) of the lower and the higher pressure fitted."""
    setup = published.setup
    low, high = (p for p in setup.inflation_pressures_psi if p != setup.held_out_psi)
    return printed(setup.contact_length_mm[low]), printed(setup.contact_length_mm[high])


def log_pressure_ratio(published: Published, n: Array, share: float = 0.5) -> Interval:
    """Return the ln(pgr42/pgr18) that R^2 and RMSE imply for n points, more than parameters.

    `share` is the part of the points at one of the two pressures.
    """
    quality = published.rut_depth.quality
    rmse, r_squared = printed(quality["rmse"]), printed(quality["r_squared"])
    factor = np.sqrt((n - len(published.rut_depth.estimates)) / (n * share * (1.0 - share)))
    root = Interval(
        *(np.sqrt(np.asarray(e)) for e in (1.0 - r_squared.upper, 1.0 - r_squared.lower))
    )
    return rmse / root * exact(factor)


def study_quality(published: Published) -> QualityStudy:
    """Compare the two ways to ln(pgr42/pgr18)."""
    low, high = fitted_lengths(published)
    n = np.arange(len(published.rut_depth.estimates) + 1.0, _N_MAX + 1.0)
    return QualityStudy(n, log_pressure_ratio(published, n), log(low / high), 2 * len(SLIPS))


def rut_quality_findings(published: Published, study: QualityStudy) -> list[Finding]:
    """Judge Table 6's goodness of fit and the errors stated with it."""
    return [_consistency(published, study), _fitted_errors(published, study),
            _held_out_errors(published, study), _ground_pressure(published)]  # fmt: skip


def _splits(published: Published, study: QualityStudy) -> list[tuple[int, int]]:
    """Return (n, points at one pressure) up to the assumed n that would reconcile both ways."""
    return [
        (int(n), m)
        for n in study.n[study.n <= study.assumed_n]
        for m in range(1, int(n) // 2 + 1)
        if _meet(log_pressure_ratio(published, np.asarray(float(n)), m / n), study.from_contact)
    ]


def _meet(a: Interval, b: Interval) -> bool:
    return bool(a.lower <= b.upper and b.lower <= a.upper)


def _consistency(published: Published, study: QualityStudy) -> Finding:
    n, reconciled = study.assumed_n, study.reconciled
    at = int(np.flatnonzero(study.n == n)[0])
    implied = Interval(study.implied.lower[at], study.implied.upper[at])
    agree = n in reconciled
    found = [
        rounded(f"ln(pgr42/pgr18) from R^2 and RMSE, n = {n}", implied),
        rounded("ln(pgr42/pgr18) from the contact lengths", study.from_contact),
    ]
    ends = None
    if reconciled.size:
        ends = float(reconciled.min()), float(reconciled.max())
        found.append(between("numbers of points that reconcile them", *ends, "1", "rounding"))
    readings = [] if agree else [float(m) for m in reconciled if m % n == 0 and m > n]
    return finding(
        "table6_consistency", Verdict.CONSISTENT if agree else Verdict.CONTRADICTED, found,
        quality=published.rut_depth.quality, n=n, implied=implied, ends=ends, readings=readings,
        contact=float(study.from_contact.middle), splits=_splits(published, study),
    )  # fmt: skip


def within_pressure_sd(published: Published, n: int) -> float:
    """Return the sd of ln zt about its own mean curve at one pressure, from Table 6 alone.

    The normal equations of Eq 22 give sum(e ln pgr) = SSE: errors of opposite mean at the two
    pressures take up SSE (1 - R^2), so SSE R^2 is left within pressures.
    """
    quality, values = published.rut_depth.quality, published.rut_depth.values
    p = len(published.rut_depth.estimates)
    sse = quality["rmse"].value ** 2 * (n - p)
    exponent = values["n0"] + values["n1"] * float(np.mean(SLIPS))
    return float(np.sqrt(sse * quality["r_squared"].value / (n - p)) / exponent)


def _fitted_errors(published: Published, study: QualityStudy) -> Finding:
    table, n = published.rut_depth, study.assumed_n
    rmse, values = table.quality["rmse"], table.values
    sse = rmse.value**2 * (n - len(table.estimates))
    steepest = values["n0"] + values["n1"] * published.setup.largest_rut_slip.value
    flattest = min(values["n0"], steepest)
    # The largest error is no less than the root mean square and no more than all of them.
    least = 1.0 - float(np.exp(-np.sqrt(sse / n) / steepest))
    most = float(np.exp(np.sqrt(sse) / flattest)) - 1.0
    stated, below = table.quality["max_relative_error"], table.quality["most_below"].value
    above = int(sse // (np.log1p(below) * flattest) ** 2)
    fine = least <= stated.value + stated.half_unit and stated.value - stated.half_unit <= most
    return finding(
        "table6_fitted_errors", Verdict.CONSISTENT if fine else Verdict.CONTRADICTED,
        (between("largest relative error", least, most, "1", "bounds", stated.text),
         Quantity(f"errors above {percent(below, 2)}, at most", float(above))),
        stated=stated.value, below=below, rmse=rmse, n=n, least=least, most=most, above=above,
    )  # fmt: skip


def _held_out_errors(published: Published, study: QualityStudy) -> Finding:
    quality, levels = published.rut_depth.quality, len(SLIPS)
    sd = within_pressure_sd(published, study.assumed_n)
    largest, threshold = (
        quality[f"held_out_{name}"].value for name in ("max_relative_error", "threshold")
    )
    few = int(quality["held_out_above_threshold"].value)
    beyond = 2.0 * float(scipy.stats.norm.sf(np.log1p(threshold) / sd))
    at_most = float(scipy.stats.binom.cdf(few, levels, beyond))
    all_within = float((1.0 - 2.0 * scipy.stats.norm.sf(np.log1p(largest) / sd)) ** levels)
    fine = min(at_most, all_within) > _HELD_OUT_LEAST
    return finding(
        "table6_held_out_errors", Verdict.CONSISTENT if fine else Verdict.CONTRADICTED,
        (Quantity("sd of ln zt within a pressure", sd),
         Quantity(f"probability of {few} or fewer above {percent(threshold, 2)}", at_most),
         Quantity(f"probability that none exceeds {percent(largest, 2)}", all_within)),
        largest=largest, few=few, threshold=threshold, levels=levels, sd=sd, at_most=at_most,
        all_within=all_within,
    )  # fmt: skip


def _ground_pressure(published: Published) -> Finding:
    setup = published.setup
    # The load is a setting: its one printed digit is not an uncertainty of the test.
    load, width = exact(setup.normal_load_kn.value), printed(setup.contact_width_mm)
    found = [
        rounded(f"load over contact rectangle at {psi} psi",
                exact(1e6) * load / (width * printed(length)), "kPa")
        for psi, length in setup.contact_length_mm.items()
    ]  # fmt: skip
    psi_kpa = 6.894757
    shares = [
        q.value / (psi_kpa * psi) for q, psi in zip(found, setup.contact_length_mm, strict=True)
    ]
    return finding("ground_pressure", Verdict.UNTESTABLE, found, shares=shares)
