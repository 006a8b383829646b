"""Table 6's goodness of fit: R^2, RMSE and the number of points against each other.

Eq 22 regresses ln pgr, which takes two values d apart, on ln zt and s ln zt. With n points, a part
w of them at the higher pressure and p = 3 coefficients,

    R^2 = 1 - SSE/SST,  SST = n w (1 - w) d^2,  SSE = RMSE^2 (n - p),

so R^2 and RMSE fix d for every n and w; the contact lengths give d too, since load and contact
width are the same at both pressures.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from calib.he2019.audit.finding import (
    Finding,
    Quantity,
    Verdict,
    between,
    finding,
    percent,
    rounded,
)
from calib.he2019.audit.intervals import Interval, exact, log, printed
from calib.he2019.datasets.published import Published
from calib.he2019.datasets.rut import SLIPS
from calib.models.base import Array

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
