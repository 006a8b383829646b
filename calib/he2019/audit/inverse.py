"""What Eq 22 does to n0, n1 and k: the controlled pressure regressed on the measured rut.

Least squares of y = ln pgr on ln zt and s ln zt, y taking two values d apart, makes the means of
the fitted values differ by R^2 d between the two pressures (cov(fit, y) = var(fit) = R^2 var(y)).
With slips alike at both pressures that says

    mean over slips of (n0 + n1 s)(ln z42 - ln z18) = R^2 d,   where Eq 21 says d:

by the ruts' own means the exponents are larger by 1/R^2, with pressure as the instrument (Wald
1940, doi:10.1214/aoms/1177731868). This follows from the printed figures alone. The likelihood of
ln zt given pgr and s shows the same on the reconstructed data, and in campaigns simulated from it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.data import Table, hold_out
from calib.he2019.audit.finding import (
    Finding,
    Quantity,
    Verdict,
    finding,
    rounded,
)
from calib.he2019.audit.intervals import Interval, exact, exp, log, printed
from calib.he2019.audit.rut_quality import fitted_lengths
from calib.he2019.datasets.embedded import load_he2019
from calib.he2019.datasets.published import Figure, Published
from calib.he2019.datasets.rut import SLIPS
from calib.inference.calibration import Calibration, ParameterSummary, calibrate
from calib.inference.estimators import PointEstimate, estimate
from calib.inference.problem import Problem, build_problem
from calib.inference.random import generator
from calib.inference.sampling.sampler import Progress
from calib.models.base import Array
from calib.models.bekker import rut_depth

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
