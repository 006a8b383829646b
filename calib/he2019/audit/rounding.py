"""What Eq 22 does to n0, n1 and k: the controlled pressure regressed on the measured rut.

Least squares of y = ln pgr on ln zt and s ln zt, y taking two values d apart, makes the means of
the fitted values differ by R^2 d between the two pressures (cov(fit, y) = var(fit) = R^2 var(y)).
With slips alike at both pressures that says

    mean over slips of (n0 + n1 s)(ln z42 - ln z18) = R^2 d,   where Eq 21 says d:

by the ruts' own means the exponents are larger by 1/R^2, with pressure as the instrument (Wald
1940, doi:10.1214/aoms/1177731868). This follows from the printed figures alone. The likelihood of
ln zt given pgr and s shows the same on the reconstructed data, and in campaigns simulated from it.

What the printed digits of Table 5 can and cannot reproduce, by interval propagation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from calib.batch.threads import one_thread
from calib.data import Table, hold_out
from calib.he2019.audit.finding import Finding, Quantity, Verdict, between, finding, rounded
from calib.he2019.audit.intervals import Interval, exact, exp, log, printed
from calib.he2019.audit.nearness import pressure_curves, printed_coefficients
from calib.he2019.audit.pull import (
    coefficients,
    fitted_lengths,
    pressure_box,
    pull,
    pull_from_slope,
    quadratic,
)
from calib.he2019.audit.signs import NAMES, nearest, targets
from calib.he2019.datasets.embedded import load_he2019
from calib.he2019.datasets.published import Published
from calib.he2019.datasets.rut import SLIPS
from calib.inference.calibration import Calibration, ParameterSummary, calibrate
from calib.inference.estimators import PointEstimate, estimate
from calib.inference.problem import Problem, build_problem
from calib.inference.random import generator
from calib.inference.sampling.sampler import Progress
from calib.models.base import Array
from calib.models.bekker import rut_depth
from calib.report.numbers import format_number
from calib.report.reference import Figure

_N_CAMPAIGNS = 4000
_MM = 1000.0


@dataclass(frozen=True, eq=False)
class InverseStudy:
    """The proper likelihood beside Eq 22, on the reconstructed data.

    The modified Bekker model calibrated on 18 and 42 psi, with posterior draws n0, n1 and k of
    shape (m,), and least squares of ln zt. At the slips of the 30 psi rows, in mm: Eq 21 at Table
    6, (n,), and draws of the mean rut, (m, n). `simulated`, (c, 3): n0, n1 and R^2 of Eq 22 in
    campaigns simulated from `direct`.
    """

    calibration: Calibration
    direct: PointEstimate
    held_out: Table
    n0: Array
    n1: Array
    k: Array
    published_30: Array
    mean_30: Array
    simulated: Array


def simulate_inverse(
    problem: Problem, truth: PointEstimate, rng: np.random.Generator, size: int = _N_CAMPAIGNS
) -> Array:
    """Fit Eq 22 to campaigns simulated from Eq 21, shape (size, 3): n0, n1 and R^2.

    Of a problem of modified_bekker the conditions are used, not the ruts; the RMSE of `truth` is
    the noise of ln zt.
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
    published: Published,
    seed: int,
    *,
    calibration: Calibration | None = None,
    progress: Progress | None = None,
) -> InverseStudy:
    """Calibrate the rut model by its likelihood, and set Eq 22 beside it.

    A calibration of the modified Bekker model on the 18 and 42 psi rows is used if it is at hand.
    """
    fitted, held = hold_out(
        load_he2019("rut_depth"), "inflation_pressure_psi", float(published.setup.held_out_psi)
    )
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
        calibration, direct, held, reported["n0"], reported["n1"], reported["k"],
        _MM * rut_depth(pressure, slip, v["k"], v["n0"], v["n1"]),
        _MM * rut_depth(pressure, slip, *each),
        simulate_inverse(problem, direct, generator(seed, "audit", "inverse")),
    )  # fmt: skip


def attenuation(published: Published) -> Interval:
    """Return the factor 1/R^2 by which the exponents are too small."""
    return exact(1.0) / printed(published.rut_depth.quality["r_squared"])


_UNITS = {"n0": "1", "n1": "1", "k": "kPa/m^n"}
# An exponent off by less than this part would not be worth a correction.
_WORTH = 0.05


def inverse_findings(published: Published, study: InverseStudy) -> list[Finding]:
    """Judge n0, n1 and k, by the printed figures and by the likelihood, and 30 psi."""
    return [
        inverse_by_print(published),
        inverse_by_likelihood(published, study),
        prediction_at_30(published, study),
    ]


def _worth_correcting(published: Published) -> bool:
    return float(attenuation(published).middle) - 1.0 > _WORTH


def _corrected_k(published: Published) -> Interval:
    """Return k by the means of the ruts: ln k follows from the exponents and the mean of ln pgr."""
    setup, width = published.setup, printed(published.setup.contact_width_mm)
    load = exact(1e6 * setup.normal_load_kn.value)
    one, other = (log(load / (width * length)) for length in fitted_lengths(published))
    middle = exact(0.5) * (one + other)
    k = printed(published.rut_depth.estimates["k"])
    return exp(middle - (middle - log(k)) * attenuation(published))


def inverse_by_print(published: Published) -> Finding:
    """Correct n0, n1 and k by the printed R^2 alone."""
    figures, factor = published.rut_depth.estimates, attenuation(published)
    n0, n1 = printed(figures["n0"]), printed(figures["n1"])
    corrected = {"n0": n0 * factor, "n1": n1 * factor, "k": _corrected_k(published)}
    low, high = fitted_lengths(published)
    ratio, exponent = log(low / high), n0 + n1 * exact(float(np.mean(SLIPS)))
    by_table, by_means = exp(ratio / exponent), exp(ratio / (exponent * factor))
    deeper, claimed = (float(r.middle) - 1.0 for r in (by_means, by_table))
    return finding(
        "table6_inverse_regression",
        Verdict.CORRECTED if _worth_correcting(published) else Verdict.CONFIRMED,
        (*(rounded(f"{name}, by the means of the ruts", value, _UNITS[name], figures[name])
           for name, value in corrected.items()),
         rounded("rut at 42 psi over rut at 18 psi, by their means", by_means),
         rounded("the same by Table 6", by_table)),
        n0=float(corrected["n0"].middle), n1=float(corrected["n1"].middle), deeper=deeper,
        claimed=claimed, r_squared=published.rut_depth.quality["r_squared"],
        shrunk=float(factor.middle) - 1.0,
    )  # fmt: skip


def _posterior(s: ParameterSummary, printed_figure: Figure) -> Quantity:
    kind, centre = ("median", s.median) if s.name == "k" else ("mean", s.mean)
    return Quantity(
        f"{s.name}, posterior {kind}", centre, _UNITS[s.name], s.hdi_lower, s.hdi_upper,
        "95 % HDI", printed_figure.text,
    )  # fmt: skip


def inverse_by_likelihood(published: Published, study: InverseStudy) -> Finding:
    """Set Eq 22 beside the likelihood of ln zt, on reconstructed and on simulated ruts."""
    figures, quality = published.rut_depth.estimates, published.rut_depth.quality
    summary, direct = study.calibration.summary, study.direct.reported
    found = [_posterior(summary[name], figures[name]) for name in _UNITS]
    found += [
        Quantity(f"{n}, least squares of ln zt", direct[n], u, published=figures[n].text)
        for n, u in _UNITS.items()
    ]
    low, middle, high = np.quantile(study.simulated, [0.025, 0.5, 0.975], axis=0).tolist()
    beside = {"n0": figures["n0"], "n1": figures["n1"], "R^2": quality["r_squared"]}
    found += [
        Quantity(f"{name} of Eq 22 in simulated campaigns", middle[j], "1", low[j], high[j],
                 "95 % of campaigns", figure.text)
        for j, (name, figure) in enumerate(beside.items())
    ]  # fmt: skip
    missed = not low[0] <= direct["n0"] <= high[0]
    verdict = Verdict.CORRECTED if missed else Verdict.CONSISTENT
    return finding(
        "table6_likelihood", verdict if study.calibration.converged else Verdict.UNTESTABLE, found,
        campaigns=study.simulated.shape[0], direct=direct["n0"], low=low[0], middle=middle[0],
        high=high[0], missed=missed, n0=summary["n0"], printed=figures["n0"],
        below=float(np.mean(study.n0 < figures["n0"].value)),
    )  # fmt: skip


def prediction_at_30(published: Published, study: InverseStudy) -> Finding:
    """Say how far the held-out prediction moves when the exponents are corrected."""
    setup, v = published.setup, published.rut_depth.values
    held, largest = setup.held_out_psi, published.rut_depth.quality["held_out_max_relative_error"]
    ln_p = {p: -np.log(f.value) for p, f in setup.contact_length_mm.items()}
    away = ln_p[held] - np.mean([value for p, value in ln_p.items() if p != held])
    shrunk = 1.0 - published.rut_depth.quality["r_squared"].value
    by_print = 100.0 * np.expm1(-shrunk * away / (v["n0"] + v["n1"] * np.array(SLIPS)))
    change = 100.0 * (study.mean_30 / study.published_30 - 1.0)
    quantiles = np.quantile(change, [0.025, 0.5, 0.975], axis=0)
    worst = int(np.argmax(np.abs(quantiles[1])))
    low, median, high = quantiles[:, worst].tolist()
    slip = 100.0 * float(study.held_out["slip_ratio"][worst])
    most = float(np.abs(by_print).max())
    blind = _worth_correcting(published) and most < 100.0 * largest.value
    return finding(
        "table6_prediction_at_30", Verdict.CORRECTED if blind else Verdict.CONSISTENT,
        (Quantity("change by 1/R^2", float(np.median(by_print)), "%", float(by_print.min()),
                  float(by_print.max()), "over slips"),
         Quantity(f"largest change by the posterior, at {slip:g} % slip", median, "%", low, high,
                  "95 % posterior, mean rut")),
        held=held, largest=largest.value, most=most, median=median, low=low, high=high,
    )  # fmt: skip


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
        _peak(published), _slope_and_curvature(published), _curve(published, study),
        _shape(published), _table4(study),
    ]  # fmt: skip


def _quadratics(
    published: Published, what: str, unit: str
) -> tuple[list[Interval], list[Quantity]]:
    pressures, wanted = targets(published, what)
    ranges = [quadratic(published, NAMES[what], p) for p in pressures]
    found = [
        Quantity(
            f"{what} at {p:g} psi", float(r.middle), unit, float(r.lower), float(r.upper),
            "rounding", f"{format_number(value, 4)} (Table 4)",
        )
        for p, r, value in zip(pressures, ranges, wanted, strict=True)
    ]  # fmt: skip
    return ranges, found


def _peak(published: Published) -> Finding:
    ranges, found = _quadratics(published, "D", "kN")
    pressures, wanted = targets(published, "D")
    off = [abs(float(r.middle) / w - 1.0) for r, w in zip(ranges, wanted, strict=True)]
    spread = [float(r.half_width) / w for r, w in zip(ranges, wanted, strict=True)]
    worst = int(np.argmax(spread))
    best = nearest(published, "D")
    verdict = Verdict.CONTRADICTED
    if all(r.holds(w) for r, w in zip(ranges, wanted, strict=True)):
        verdict = Verdict.CORRECTED if max(spread) > _WANTED else Verdict.CONFIRMED
    c3, best_c3 = published.pressure.estimates["c3"], float(best.coefficients[2])
    psi = float(pressures[worst])
    name = "c3 that brings D nearest to Table 4"
    found.append(Quantity(name, best_c3, "kN/psi^2", published=c3.text))
    return finding(
        "table5_digits_of_D", verdict, found, psi=psi, spread=spread[worst], range=ranges[worst],
        off=off[worst], best_c3=best_c3, deviation=best.deviation, wanted=_WANTED, c3=c3,
        needed=_WANTED * wanted[worst] / psi**2,
    )  # fmt: skip


def _slope_and_curvature(published: Published) -> Finding:
    slope, found = _quadratics(published, "BCD", "kN/%")
    curvature, more = _quadratics(published, "E", "1")
    pressures, K4 = targets(published, "BCD")
    _, E4 = targets(published, "E")
    spread = max(float(r.half_width) / k for r, k in zip(slope, K4, strict=True))
    missed, outside = (
        [f"{p:g}" for p, r, v in zip(pressures, ranges, wanted, strict=True) if not r.holds(v)]
        for ranges, wanted in ((slope, K4), (curvature, E4))
    )
    verdict = Verdict.CORRECTED if spread > _WANTED else Verdict.CONFIRMED
    if outside or missed:
        verdict = Verdict.CONTRADICTED
    return finding(
        "table5_digits_of_BCD_and_E", verdict, (*found, *more), missed=missed, outside=outside,
        spread=spread,
    )  # fmt: skip


def _curve(published: Published, study: RoundingStudy) -> Finding:
    found, relative = [], {}
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
    best, worst = min(relative, key=lambda p: relative[p]), max(relative, key=lambda p: relative[p])
    gaps = {p: _gap(study.allowed[p], study.table4[p]) for p in relative}
    outside = [
        f"by up to {format_number(gap, 2)} kN at {p} psi" for p, gap in gaps.items() if gap > 0.0
    ]
    return finding(
        "table5_digits_of_pull",
        Verdict.CONFIRMED if relative[worst] <= _WANTED else Verdict.CORRECTED, found,
        open=relative, best=best, worst=worst, outside=outside,
    )  # fmt: skip


def _gap(allowed: Interval, curve: Interval) -> float:
    """Return how far a curve leaves a range at most, kN; not above zero where it does not."""
    beyond = np.maximum(allowed.lower - curve.upper, curve.lower - allowed.upper)
    return float(beyond.max())


def _shape(published: Published) -> Finding:
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
