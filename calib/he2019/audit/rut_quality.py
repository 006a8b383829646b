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
from scipy.stats import binom, norm

from calib.he2019.audit.finding import Basis, Finding, Quantity, Verdict, number, percent, rounded
from calib.he2019.audit.intervals import Interval, exact, log, printed
from calib.he2019.datasets.published import Published
from calib.he2019.datasets.rut import SLIPS
from calib.models.base import Array

_FAMILY = "Table 6, Eq 22"
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


def _fitted(published: Published) -> tuple[int, int]:
    low, high = (p for p in published.setup.inflation_pressures_psi
                 if p != published.setup.held_out_psi)  # fmt: skip
    return low, high


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
    low, high = (printed(published.setup.contact_length_mm[p]) for p in _fitted(published))
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
    quality, n = published.rut_depth.quality, study.assumed_n
    at = int(np.flatnonzero(study.n == n)[0])
    implied = Interval(study.implied.lower[at], study.implied.upper[at])
    reconciled = study.reconciled
    agree = n in reconciled
    numbers, found = "no number of points would agree", []
    if reconciled.size:
        ends = float(reconciled.min()), float(reconciled.max())
        found.append(Quantity("numbers of points that reconcile them", float("nan"), "1", *ends,
                              "rounding"))  # fmt: skip
        numbers = f"{ends[0]:g} to {ends[1]:g} points would agree"
        whole = [m for m in reconciled if m % n == 0 and m > n]
        if whole and not agree:
            numbers += ", such as " + " or ".join(
                f"{m:g} ({m / n:g} readings in each test)" for m in whole
            )
    return Finding(
        "table6_consistency", _FAMILY, "Table 6, Eq 22",
        ("Table 6: r_squared", "Table 6: rmse", "Setup: largest_rut_slip",
         *(f"Setup: contact length, {p} psi" for p in _fitted(published))),
        f"R^2 = {quality['r_squared'].text} and RMSE = {quality['rmse'].text} are of {n} points, "
        "two pressures at nine slips up to 20 %",
        "R^2 and RMSE fix ln(pgr42/pgr18) for every number of points; load over contact area fixes "
        "it too",
        (
            rounded(f"ln(pgr42/pgr18) from R^2 and RMSE, n = {n}", implied),
            rounded("ln(pgr42/pgr18) from the contact lengths", study.from_contact),
            *found,
        ),
        Verdict.CONSISTENT if agree else Verdict.CONTRADICTED,
        f"With {n} points R^2 and RMSE imply {number(float(implied.lower))} to "
        f"{number(float(implied.upper))}, the contact lengths "
        f"{number(float(study.from_contact.middle))}; {numbers}.",
        "Whether the measured ground pressures differ from load over contact area, or more points "
        f"were fitted; {_unequal(published, study)}.",
        Basis.SLIPS,
    )  # fmt: skip


def _unequal(published: Published, study: QualityStudy) -> str:
    splits = _splits(published, study)
    if not splits:
        return f"no unequal split of {study.assumed_n} points or fewer reconciles them"
    listed = " or ".join(f"{m} of {n}" for n, m in splits)
    return f"unequal numbers at the two pressures would also do, as {listed}"


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
    rmse, values = table.quality["rmse"].value, table.values
    sse = rmse**2 * (n - len(table.estimates))
    steepest = values["n0"] + values["n1"] * published.setup.largest_rut_slip.value
    # The largest error is no less than the root mean square and no more than all of them.
    least = 1.0 - float(np.exp(-np.sqrt(sse / n) / steepest))
    most = float(np.exp(np.sqrt(sse) / min(values["n0"], steepest))) - 1.0
    stated = table.quality["max_relative_error"]
    below = table.quality["most_below"]
    above = int(sse // (np.log1p(below.value) * min(values["n0"], steepest)) ** 2)
    fine = least <= stated.value + stated.half_unit and stated.value - stated.half_unit <= most
    return Finding(
        "table6_fitted_errors", _FAMILY, "Table 6, Eq 21",
        ("Table 6: max_relative_error", "Table 6: most_below"),
        f"relative rut errors are {percent(stated.value, 2)} at most and mostly below "
        f"{percent(below.value, 2)} on the fitted data",
        f"the least and the largest error that RMSE = {table.quality['rmse'].text} on {n} points "
        "allows",
        (Quantity("largest relative error", float("nan"), "1", least, most, "bounds",
                  stated.text),
         Quantity(f"errors above {percent(below.value, 2)}, at most", float(above))),
        Verdict.CONSISTENT if fine else Verdict.CONTRADICTED,
        f"The RMSE allows a largest error of {percent(least, 2)} to {percent(most, 2)}, and no "
        f"more than {above} of {n} above {percent(below.value, 2)}.",
        "The measured ruts.", Basis.SLIPS,
    )  # fmt: skip


def _held_out_errors(published: Published, study: QualityStudy) -> Finding:
    quality, levels = published.rut_depth.quality, len(SLIPS)
    sd = within_pressure_sd(published, study.assumed_n)
    largest, threshold = quality["held_out_max_relative_error"], quality["held_out_threshold"]
    few = int(quality["held_out_above_threshold"].value)
    beyond = 2.0 * float(norm.sf(np.log1p(threshold.value) / sd))
    at_most = float(binom.cdf(few, levels, beyond))
    all_within = float((1.0 - 2.0 * norm.sf(np.log1p(largest.value) / sd)) ** levels)
    least = min(at_most, all_within)
    return Finding(
        "table6_held_out_errors", _FAMILY, "Table 6, Eq 21, 30 psi",
        ("Table 6: held_out_max_relative_error", "Table 6: held_out_threshold",
         "Table 6: held_out_above_threshold"),
        f"at 30 psi relative rut errors are {percent(largest.value, 2)} at most, with "
        f"{few} above {percent(threshold.value, 2)}",
        f"the probability of errors as small or smaller on {levels} slips, from the scatter within "
        "a pressure that R^2 and RMSE imply",
        (Quantity("sd of ln zt within a pressure", sd),
         Quantity(f"probability of {few} or fewer above {percent(threshold.value, 2)}", at_most),
         Quantity(f"probability that none exceeds {percent(largest.value, 2)}", all_within)),
        Verdict.CONSISTENT if least > _HELD_OUT_LEAST else Verdict.CONTRADICTED,
        f"With a scatter of {percent(sd, 2)}, {few} or fewer above {percent(threshold.value, 2)} "
        f"have a probability of {number(at_most, 2)} and none above {percent(largest.value, 2)} "
        f"of {number(all_within, 2)}: as expected.",
        "How many slips were held out is not printed.", Basis.SLIPS,
    )  # fmt: skip


def _ground_pressure(published: Published) -> Finding:
    setup = published.setup
    # The load is a setting: its one printed digit is not an uncertainty of the test.
    load, width = exact(setup.normal_load_kn.value), printed(setup.contact_width_mm)
    psi_kpa = 6.894757
    found, share = [], []
    for psi, length in setup.contact_length_mm.items():
        pressure = exact(1e6) * load / (width * printed(length))
        share.append(float(pressure.middle) / (psi_kpa * psi))
        found.append(rounded(f"load over contact rectangle at {psi} psi", pressure, "kPa"))
    return Finding(
        "ground_pressure", "Not testable", "test description",
        ("Setup: contact_width_mm", "Setup: normal_load_kn",
         *(f"Setup: contact length, {p} psi" for p in setup.contact_length_mm)),
        "load over contact length times width stands for the average ground pressure",
        "beside the inflation pressure, which the ground carries where a thin tread meets it",
        tuple(found), Verdict.UNTESTABLE,
        f"The rectangle gives {', '.join(percent(s, 2) for s in share)} of the inflation pressure: "
        "it is larger than the area that carries the load.",
        "The measured average ground pressures; k of Table 6 depends on them, n0 and n1 only on "
        "their ratio.",
        Basis.PHYSICS,
    )  # fmt: skip
