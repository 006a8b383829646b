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
from calib.he2019.audit.intervals import Interval, exact, printed
from calib.he2019.datasets.embedded import load_he2019
from calib.he2019.datasets.published import Published
from calib.inference.calibration import Calibration, calibrate
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
