"""Table 6, rut depth: signs, goodness of fit, and what regressing the set pressure does.

Eq 22 regresses ln pgr, which takes two values d apart, on ln zt and s ln zt. With n points, a part
w of them at the higher pressure and p = 3 coefficients,

    R^2 = 1 - SSE/SST,  SST = n w (1 - w) d^2,  SSE = RMSE^2 (n - p),

so R^2 and RMSE fix d for every n and w. The contact lengths give d too, since load and contact
width are the same at both pressures.

Least squares makes the means of the fitted values differ by R^2 d between the two pressures
(cov(fit, y) = var(fit) = R^2 var(y)). With slips alike at both pressures that says

    mean over slips of (n0 + n1 s)(ln z42 - ln z18) = R^2 d,   where Eq 21 says d:

by the ruts' own means the exponents are larger by 1/R^2, with pressure as the instrument (Wald
1940, doi:10.1214/aoms/1177731868). This follows from the printed figures alone. The likelihood of
ln zt given pgr and s shows the same on the reconstructed data, and in campaigns simulated from it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy

from calib.data import Table, hold_out
from calib.he2019.audit.bounds import Interval, exact, exp, log, printed, root_of_rest
from calib.he2019.audit.finding import (
    Finding,
    Quantity,
    Verdict,
    between,
    consistent_if,
    finding,
    percent,
    rounded,
)
from calib.he2019.embedded import load_he2019
from calib.he2019.published import Published
from calib.he2019.reconstruction import SLIPS
from calib.inference.calibration import Calibration, calibrate
from calib.inference.estimators import PointEstimate, estimate
from calib.inference.problem import Problem, build_problem
from calib.inference.random import generator
from calib.inference.sampler import Progress
from calib.models.base import Array
from calib.models.soil import rut_depth


def ground_pressure(published: Published) -> Interval:
    """Return load over contact rectangle (kPa) at each inflation pressure, shape (3,)."""
    setup = published.setup
    lengths = [printed(f) for f in setup.contact_length_mm.values()]
    ends = (np.array([float(getattr(i, end)) for i in lengths]) for end in ("lower", "upper"))
    # The load is a setting: its one printed digit is not an uncertainty of the test.
    load = exact(1e6 * setup.normal_load_kn.value)
    return load / (Interval(*ends) * printed(setup.contact_width_mm))


def signs_of_rut(published: Published) -> Finding:
    """Test the signs of n0, n1 and of the exponent of k (Eq 21)."""
    figures, setup = published.rut_depth.estimates, published.setup
    n0, n1, k = (printed(figures[name]) for name in ("n0", "n1", "k"))
    pressure = ground_pressure(published)
    # In metres, at each pressure.
    exponents = n0, n0 + n1 * printed(setup.largest_rut_slip)
    towed, driven = (exp((log(pressure) - log(k)) / n) for n in exponents)
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


# The goodness of fit of Table 6


@dataclass(frozen=True, eq=False)
class QualityStudy:
    """ln(pgr42/pgr18) by the number of points n (m,), and from the contact lengths.

    `implied` (m,) follows from R^2 and RMSE, pressures equally often; `reconciled` are the n for
    which both agree, the assumed n two pressures at the nine nominal slips up to 20 %.
    """

    n: Array
    implied: Interval
    from_contact: Interval
    reconciled: Array
    assumed_n: int = 2 * len(SLIPS)


def _meet(a: Interval, b: Interval) -> Array:
    return np.asarray((a.lower <= b.upper) & (b.lower <= a.upper))


def fitted_lengths(published: Published) -> tuple[Interval, Interval]:
    """Return the contact lengths (mm) of the lower and the higher pressure fitted."""
    setup = published.setup
    low, high = (p for p in setup.inflation_pressures_psi if p != setup.held_out_psi)
    return printed(setup.contact_length_mm[low]), printed(setup.contact_length_mm[high])


def log_pressure_ratio(published: Published, n: Array, share: float = 0.5) -> Interval:
    """Return ln(pgr42/pgr18) by R^2 and RMSE of n points, a `share` of them at one pressure."""
    quality = published.rut_depth.quality
    factor = np.sqrt((n - len(published.rut_depth.estimates)) / (n * share * (1.0 - share)))
    return printed(quality["rmse"]) / root_of_rest(printed(quality["r_squared"])) * exact(factor)


def study_quality(published: Published) -> QualityStudy:
    """Compare the two ways to ln(pgr42/pgr18)."""
    low, high = fitted_lengths(published)
    n = np.arange(len(published.rut_depth.estimates) + 1.0, 161.0)
    implied, from_contact = log_pressure_ratio(published, n), log(low / high)
    return QualityStudy(n, implied, from_contact, n[_meet(implied, from_contact)])


def rut_quality_findings(published: Published, study: QualityStudy) -> list[Finding]:
    """Judge Table 6's goodness of fit and the errors stated with it."""
    return [_consistency(published, study), _fitted_errors(published, study),
            _held_out_errors(published, study), _ground_pressure(published)]  # fmt: skip


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
    # Unequal numbers at the two pressures, up to the assumed n, that would reconcile both ways.
    splits = [
        (total, m)
        for total in study.n[study.n <= n].astype(int).tolist()
        for m in range(1, total // 2 + 1)
        if _meet(log_pressure_ratio(published, np.array(total), m / total), study.from_contact)
    ]
    return finding(
        "table6_consistency", consistent_if(agree), found,
        quality=published.rut_depth.quality, n=n, implied=implied, ends=ends, splits=splits,
        readings=[] if agree else [float(m) for m in reconciled if m % n == 0 and m > n],
        contact=float(study.from_contact.middle),
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
        "table6_fitted_errors", consistent_if(fine),
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
    fine = min(at_most, all_within) > 0.025
    return finding(
        "table6_held_out_errors", consistent_if(fine),
        (Quantity("sd of ln zt within a pressure", sd),
         Quantity(f"probability of {few} or fewer above {percent(threshold, 2)}", at_most),
         Quantity(f"probability that none exceeds {percent(largest, 2)}", all_within)),
        largest=largest, few=few, threshold=threshold, levels=levels, sd=sd, at_most=at_most,
        all_within=all_within,
    )  # fmt: skip


def _ground_pressure(published: Published) -> Finding:
    p = ground_pressure(published)
    found = [
        rounded(f"load over contact rectangle at {psi} psi", Interval(low, high), "kPa")
        for psi, low, high in zip(published.genetic, p.lower, p.upper, strict=True)
    ]
    shares = [q.value / (6.894757 * psi) for q, psi in zip(found, published.genetic, strict=True)]
    return finding("ground_pressure", Verdict.UNTESTABLE, found, shares=shares)


# What Eq 22 does to n0, n1 and k


@dataclass(frozen=True, eq=False)
class InverseStudy:
    """The proper likelihood beside Eq 22, on the reconstructed data.

    The modified Bekker model calibrated on 18 and 42 psi, with posterior `draws` of n0, n1 and
    k, each (m,), and least squares of ln zt. At the slips of the 30 psi rows, in mm: Eq 21 at Table
    6, (n,), and draws of the mean rut, (m, n). `simulated`, (c, 3): n0, n1 and R^2 of Eq 22 in
    campaigns simulated from `direct`.
    """

    calibration: Calibration
    direct: PointEstimate
    held_out: Table
    draws: Mapping[str, Array]
    published_30: Array
    mean_30: Array
    simulated: Array


def simulate_inverse(
    problem: Problem, truth: PointEstimate, rng: np.random.Generator, size: int = 4000
) -> Array:
    """Fit Eq 22 to campaigns simulated from Eq 21, shape (size, 3): n0, n1 and R^2.

    Only the conditions of the problem of modified_bekker are used; the RMSE of `truth` is the
    noise of ln zt.
    """
    pressure = problem.conditions["average_ground_pressure_kpa"]
    slip, y = problem.conditions["slip_ratio"], np.log(pressure)
    v = truth.reported
    mean = np.log(rut_depth(pressure, slip, v["k"], v["n0"], v["n1"]))
    ln_z = mean + truth.rmse * rng.standard_normal((size, y.size))
    columns = np.stack([np.ones_like(ln_z), ln_z, slip * ln_z], axis=2)
    q, r = np.linalg.qr(columns)
    beta = np.linalg.solve(r, np.einsum("cnj,n->cj", q, y)[:, :, None])[:, :, 0]
    left = y - np.einsum("cnj,cj->cn", columns, beta)
    r_squared = 1.0 - np.sum(left**2, axis=1) / np.sum((y - y.mean()) ** 2)
    return np.column_stack([beta[:, 1], beta[:, 2], r_squared])


def study_inverse(
    published: Published, seed: int, *, calibration: Calibration | None = None,
    progress: Progress | None = None,
) -> InverseStudy:  # fmt: skip
    """Calibrate the rut model on 18 and 42 psi unless that is at hand; set Eq 22 beside it."""
    held_out_psi = float(published.setup.held_out_psi)
    fitted, held = hold_out(load_he2019("rut_depth"), "inflation_pressure_psi", held_out_psi)
    problem = build_problem("modified_bekker", fitted)
    direct = estimate(problem, "least_squares", generator(seed, "rut_depth", "seeding"))
    if calibration is None:
        calibration = calibrate(
            problem, seed, label="rut_depth", estimates=(direct,), progress=progress
        )
    reported = {name: v.ravel() for name, v in calibration.reported.items()}
    slip, pressure = held["slip_ratio"], held["average_ground_pressure_kpa"]
    v = published.rut_depth.values
    each = (reported[name][:, None] for name in ("k", "n0", "n1"))
    return InverseStudy(
        calibration, direct, held, reported,
        1000.0 * rut_depth(pressure, slip, v["k"], v["n0"], v["n1"]),
        1000.0 * rut_depth(pressure, slip, *each),
        simulate_inverse(problem, direct, generator(seed, "audit", "inverse")),
    )  # fmt: skip


def attenuation(published: Published) -> Interval:
    """Return the factor 1/R^2 by which the exponents are too small."""
    return exact(1.0) / printed(published.rut_depth.quality["r_squared"])


def _worth_correcting(published: Published) -> bool:
    # An exponent off by less would not be worth a correction.
    return float(attenuation(published).middle) - 1.0 > 0.05


def inverse_by_print(published: Published) -> Finding:
    """Correct n0, n1 and k by the printed R^2 alone."""
    figures, factor = published.rut_depth.estimates, attenuation(published)
    n0, n1, k = (printed(figures[name]) for name in ("n0", "n1", "k"))
    low, high = fitted_lengths(published)
    # ln k follows from the exponents and the mean of ln pgr.
    ln_p = log(ground_pressure(published))
    ends = (0.5 * (end[0] + end[-1]) for end in (ln_p.lower, ln_p.upper))
    middle = Interval(*ends)
    by_k = exp(middle - (middle - log(k)) * factor)
    corrected = {"n0": n0 * factor, "n1": n1 * factor, "k": by_k}
    ratio, exponent = log(low / high), n0 + n1 * exact(float(np.mean(SLIPS)))
    by_table, by_means = exp(ratio / exponent), exp(ratio / (exponent * factor))
    deeper, claimed = (float(r.middle) - 1.0 for r in (by_means, by_table))
    return finding(
        "table6_inverse_regression",
        Verdict.CORRECTED if _worth_correcting(published) else Verdict.CONFIRMED,
        (*(rounded(f"{name}, by the means of the ruts", value, figures[name].unit, figures[name])
           for name, value in corrected.items()),
         rounded("rut at 42 psi over rut at 18 psi, by their means", by_means),
         rounded("the same by Table 6", by_table)),
        n0=float(corrected["n0"].middle), n1=float(corrected["n1"].middle), deeper=deeper,
        claimed=claimed, r_squared=published.rut_depth.quality["r_squared"],
        shrunk=float(factor.middle) - 1.0,
    )  # fmt: skip


def inverse_by_likelihood(published: Published, study: InverseStudy) -> Finding:
    """Set Eq 22 beside the likelihood of ln zt, on reconstructed and on simulated ruts."""
    figures, quality = published.rut_depth.estimates, published.rut_depth.quality
    summary, direct = study.calibration.summary, study.direct.reported
    found = []
    names = ("n0", "n1", "k")
    for name in names:
        s, kind = summary[name], "median" if name == "k" else "mean"
        found.append(
            Quantity(f"{name}, posterior {kind}", getattr(s, kind), figures[name].unit,
                     s.hdi_lower, s.hdi_upper, "95 % HDI", figures[name].text)
        )  # fmt: skip
    found += [
        Quantity(
            f"{n}, least squares of ln zt", direct[n], figures[n].unit, published=figures[n].text
        )
        for n in names
    ]
    low, middle, high = np.quantile(study.simulated, [0.025, 0.5, 0.975], axis=0).tolist()
    beside = {"n0": figures["n0"], "n1": figures["n1"], "R^2": quality["r_squared"]}
    found += [
        Quantity(f"{name} of Eq 22 in simulated campaigns", middle[j], "1", low[j], high[j],
                 "95 % of campaigns", figure.text)
        for j, (name, figure) in enumerate(beside.items())
    ]  # fmt: skip
    missed, verdict = not low[0] <= direct["n0"] <= high[0], Verdict.UNTESTABLE
    if study.calibration.converged:
        verdict = Verdict.CORRECTED if missed else Verdict.CONSISTENT
    return finding(
        "table6_likelihood", verdict, found,
        campaigns=study.simulated.shape[0], direct=direct["n0"], low=low[0], middle=middle[0],
        high=high[0], missed=missed, n0=summary["n0"], printed=figures["n0"],
        below=float(np.mean(study.draws["n0"] < figures["n0"].value)),
    )  # fmt: skip


def prediction_at_30(published: Published, study: InverseStudy) -> Finding:
    """Say how far the held-out prediction moves when the exponents are corrected."""
    setup, v, quality = published.setup, published.rut_depth.values, published.rut_depth.quality
    held, largest = setup.held_out_psi, quality["held_out_max_relative_error"].value
    ln_p = {p: -np.log(f.value) for p, f in setup.contact_length_mm.items()}
    away = ln_p[held] - np.mean([value for p, value in ln_p.items() if p != held])
    shrunk = 1.0 - quality["r_squared"].value
    by_print = 100.0 * np.expm1(-shrunk * away / (v["n0"] + v["n1"] * np.array(SLIPS)))
    change = 100.0 * (study.mean_30 / study.published_30 - 1.0)
    quantiles = np.quantile(change, [0.025, 0.5, 0.975], axis=0)
    worst = int(np.argmax(np.abs(quantiles[1])))
    low, median, high = quantiles[:, worst].tolist()
    slip = 100.0 * float(study.held_out["slip_ratio"][worst])
    most = float(np.abs(by_print).max())
    blind = _worth_correcting(published) and most < 100.0 * largest
    return finding(
        "table6_prediction_at_30", Verdict.CORRECTED if blind else Verdict.CONSISTENT,
        (Quantity("change by 1/R^2", float(np.median(by_print)), "%", float(by_print.min()),
                  float(by_print.max()), "over slips"),
         Quantity(f"largest change by the posterior, at {slip:g} % slip", median, "%", low, high,
                  "95 % posterior, mean rut")),
        held=held, largest=largest, most=most, median=median, low=low, high=high,
    )  # fmt: skip
