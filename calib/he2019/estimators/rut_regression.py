"""The rut-depth regression as published (Eq 22): ln pgr on ln zt and s ln zt, by least squares.

    ln pgr = ln k + n0 ln zt + n1 s ln zt

It regresses the pressure, which was set and takes two values, on the rut, which was measured with
errors. Errors in a regressor attenuate its coefficient: the exponent comes out too small. The
likelihood of this package is on ln zt given pgr and s; its least-squares estimate stands beside.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from calib.errors import CalibError
from calib.inference.estimators.base import PointEstimate, goodness
from calib.inference.problem import Problem

_MM_PER_M = 1000.0


@dataclass(frozen=True)
class RutRegression:
    """Result of the published regression on n rows.

    n0, n1 and k (n and k without slip), k in kPa/m^n; R^2 and RMSE are of ln pgr, RMSE being
    ``sqrt(SSE/(n - p))`` with p parameters, as in MATLAB. `n_excluded` rows were left out for
    their slip.
    """

    reported: dict[str, float]
    r_squared: float
    rmse: float
    n: int
    n_excluded: int


def rut_regression(problem: Problem, max_slip: float = 0.2) -> RutRegression:
    """Regress the logarithm of ground pressure on that of rut depth, without slip for bekker.

    Rows above `max_slip` are left out, where the table has a slip: above 30 % the rut rebounds and
    its depth is no longer the sinkage, and the source used slips up to 20 %.

    Raises
    ------
    CalibError
        If the rows do not determine the coefficients.

    References
    ----------
    He, Sandu & Osorio (2019), Eq 22 and Table 6, doi:10.1016/j.jterra.2019.07.003.
    """
    with_slip = problem.bound.model.name == "modified_bekker"
    n_all = len(problem.table)
    slip = problem.table["slip_ratio"] if "slip_ratio" in problem.table else np.zeros(n_all)
    rows = ~(slip > max_slip * (1.0 + 1e-9))
    ln_z = np.log(problem.observed[rows] / _MM_PER_M)
    y = np.log(problem.conditions["average_ground_pressure_kpa"][rows])
    regressors = [np.ones_like(ln_z), ln_z] + ([slip[rows] * ln_z] if with_slip else [])
    names = ("k", "n0", "n1") if with_slip else ("k", "n")
    X = np.column_stack(regressors)
    n, p = X.shape
    if n <= p or np.linalg.matrix_rank(X) < p or np.ptp(y) == 0.0:
        raise CalibError(
            f"the published regression cannot tell its {p} coefficients apart on {n} rows of slip "
            f"up to {max_slip:g} and {np.unique(y).size} ground pressures",
            where=problem.table.source,
            allowed=f"more than {p} rows in which ground pressure, rut depth"
            f"{' and slip vary' if with_slip else ' vary'}",
            mend="add tests, raise max_slip, or use another method such as least_squares",
        )
    beta = np.linalg.lstsq(X, y, rcond=None)[0]
    r = y - X @ beta
    sse = float(r @ r)
    values = dict(zip(names, beta.tolist(), strict=True))
    values["k"] = float(np.exp(values["k"]))
    return RutRegression(
        reported={name: values[name] for name in problem.bound.model.reported},
        r_squared=1.0 - sse / float(np.square(y - y.mean()).sum()),
        rmse=float(np.sqrt(sse / (n - p))),
        n=n,
        n_excluded=n_all - n,
    )


def estimate_published_regression(
    problem: Problem,
    rng: np.random.Generator | None = None,
    *,
    max_slip: float = 0.2,
) -> PointEstimate:
    """Estimate by `rut_regression`, judged on the likelihood's scale (ln zt, all rows).

    Raises
    ------
    CalibError
        As `rut_regression`; also if a parameter is fixed, or the exponent comes out at or below
        zero, with which no rut depth can be predicted.
    """
    clock = time.perf_counter()
    fixed = [p.name for p in problem.priors.entries[:-1] if p.fixed]
    if fixed:
        raise CalibError(
            f"the published regression fits all coefficients, but {', '.join(fixed)} is fixed",
            allowed="no fixed parameter",
            mend="free it, or use another method such as least_squares",
        )
    fit = rut_regression(problem, max_slip)
    exponent = fit.reported.get("n0", fit.reported.get("n", np.nan))
    if not exponent > 0.0:
        raise CalibError(
            f"the published regression gives an exponent of {exponent:.3g}",
            where=problem.table.source,
            allowed="rut depths that grow with ground pressure",
            mend="check the columns of rut depth and ground pressure, or use least_squares",
        )
    left_out = f"{fit.n_excluded} rows above {max_slip:g} slip left out" if fit.n_excluded else ""
    return goodness(
        problem,
        "published_regression",
        problem.bound.theta(fit.reported),
        n_fitted=len(fit.reported),
        n_evaluations=0,
        seconds=time.perf_counter() - clock,
        notes=(
            f"regression of ln pgr: R² = {fit.r_squared:.3f}, RMSE = {fit.rmse:.3f} (n = {fit.n})",
            left_out,
        ),
    )
