"""The geometric method: Magic Formula coefficients read off the measured curve (Eqs 6-9).

    C = 2 - (2/pi) arcsin(ys/D)                                     (Eq 7)
    D = ym                                                          (Eq 8)
    B = tan(theta)/(C D)                                            (Eq 6)
    E = [B xm - tan(pi/(2 C))]/[B xm - arctan(B xm)]                (Eq 9)

with the peak (xm, ym), the asymptote ys and the initial slope tan(theta). The source does not say
how it read these features; the rules used here are those of `read_features`.

The rut-depth regression as published (Eq 22): ln pgr on ln zt and s ln zt, by least squares.

    ln pgr = ln k + n0 ln zt + n1 s ln zt

It regresses the pressure, which was set and takes two values, on the rut, which was measured with
errors. Errors in a regressor attenuate its coefficient: the exponent comes out too small. The
likelihood of this package is on ln zt given pgr and s; its least-squares estimate stands beside.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from calib.errors import CalibError
from calib.inference.problem import Problem
from calib.inference.search import PointEstimate, goodness, sum_of_squares
from calib.models.base import Array


class Features(NamedTuple):
    """The features that the geometric method reads off a curve of pull (kN) against slip (%).

    Initial slope tan(theta) (kN/%), slip and pull of the peak xm and ym, pull at the largest slips
    ys. Features are counted from `zero`, the slip at which the pull is zero; `has_peak` says
    whether the pull falls again inside the range.
    """

    slope: float
    x_peak: float
    peak: float
    asymptote: float
    zero: float = 0.0
    has_peak: bool = True


class Coefficients(NamedTuple):
    """B (1/%), C, D (kN) and E of the Magic Formula."""

    B: float
    C: float
    D: float
    E: float


def coefficients(features: Features, C_without_peak: float = 1.5) -> Coefficients:
    """Evaluate Eqs 6-9; without a peak in range the asymptote cannot be seen, and C is given."""
    D = features.peak
    if features.has_peak:
        C = 2.0 - 2.0 / np.pi * np.arcsin(np.clip(features.asymptote / D, -1.0, 1.0))
    else:
        C = C_without_peak
    B = features.slope / (C * D)
    bx = B * features.x_peak
    E = (bx - np.tan(0.5 * np.pi / C)) / (bx - np.arctan(bx))
    return Coefficients(float(B), float(C), float(D), float(E))


def read_features(
    slip_percent: Array, pull: Array, *, slope_slip_percent: float = 5.0, find_zero: bool = False,
    where: str | None = None,
) -> Features:  # fmt: skip
    """Read the features of a measured curve, slips and pulls of shape (n,).

    - Initial slope: the least-squares line through the origin and the rows of slips up to
      `slope_slip_percent`, or through the two smallest positive slips if there are fewer; if that
      line falls, through all rows up to the highest. With `find_zero` it is not forced through the
      origin, and slips count from where it is zero, as the source redefined its zero of slip.
    - Peak: its pull is the highest one measured, repeats being averaged, which on the embedded
      data is the published D; its slip is that of the vertex of the parabola through the highest
      point and its neighbours. If the highest point is the last one, the range holds no peak.
    - Asymptote: the pull at the largest slip.

    CalibError if fewer than four positive slips are distinct, or the pull does not rise above zero.
    """
    slope, zero = _initial_line(slip_percent, pull, slope_slip_percent, find_zero, where)
    x, y = _levels(slip_percent - zero, pull)
    if x.size < 4 or y.max() <= 0.0 or slope <= 0.0:
        raise CalibError(
            "the geometric method cannot read this curve: it finds "
            f"{x.size} positive slips, a largest pull of {y.max() if x.size else 0.0:g} kN and an "
            f"initial slope of {slope:g} kN/%",
            where=where,
            expected="at least 4 distinct positive slips, with a pull that rises from zero",
            hint="use another method, such as least_squares",
        )
    top = int(y.argmax())
    x_peak, peak = float(x[top]), float(y[top])
    if 0 < top < x.size - 1:
        a, b, _ = np.polyfit(x[top - 1 : top + 2] - x_peak, y[top - 1 : top + 2], 2)
        if a < 0.0:
            x_peak -= float(b / (2.0 * a))
    return Features(slope, x_peak, peak, float(y[-1]), zero, top < x.size - 1)


def _initial_line(
    x: Array, y: Array, up_to: float, find_zero: bool, where: str | None
) -> tuple[float, float]:
    positive = np.sort(x[x > 0.0])
    if positive.size < 2:
        raise CalibError(
            f"the geometric method finds {positive.size} positive slips",
            where=where,
            expected="at least 4 distinct positive slips",
            hint="use another method, such as least_squares",
        )
    slope = zero = 0.0
    for limit in (max(up_to, float(positive[1])), float(x[y.argmax()])):
        near = np.abs(x) <= limit
        if find_zero and np.unique(x[near]).size > 1:
            slope, pull_at_zero = np.polyfit(x[near], y[near], 1)
            zero = -pull_at_zero / slope if slope > 0.0 else 0.0
        elif (x[near] != 0.0).any():
            slope = float(x[near] @ y[near]) / float(x[near] @ x[near])
        if slope > 0.0:
            break
    return float(slope), float(zero)


def _levels(x: Array, y: Array) -> tuple[Array, Array]:
    """Average repeats at positive slips; average groups of neighbours where slips are many."""
    x, y = x[x > 0.0], y[x > 0.0]
    levels, which = np.unique(np.round(x, 9), return_inverse=True)
    if levels.size <= 40:
        return levels, np.bincount(which, y) / np.bincount(which)
    # Of more slips, noise would decide where the peak is.
    groups = np.array_split(np.argsort(x, kind="stable"), 20)
    return np.array([x[g].mean() for g in groups]), np.array([y[g].mean() for g in groups])


def _curvature(E: float) -> float:
    """Return G = 1 - E, kept positive: with an E above 1 the formula has no single peak."""
    return max(1.0 - E, 0.01)


def estimate_geometric(
    problem: Problem, rng: np.random.Generator | None = None, *, slope_slip_percent: float = 5.0
) -> PointEstimate:
    """Read the coefficients of magic_formula or magic_formula_pressure off the data, without `rng`.

    At one pressure, Sh is the zero of the initial line if it is free, and Sv is zero if it is free.
    With several pressures the slope K, the peak D and G = 1 - E of each are joined by their
    quadratics, exactly through two or three pressures, C is averaged, and two pressures leave the
    bends at their prior location. Results are moved inside the prior's bounds.
    """
    clock = time.perf_counter()
    one_pressure = problem.bound.model.name == "magic_formula"
    read = _one_pressure if one_pressure else _several_pressures
    values, notes = read(problem, slope_slip_percent)
    natural = _inside(problem, values)
    if not np.isfinite(sum_of_squares(problem, natural)[0]):
        # Far apart pressures may give quadratics that turn negative between them.
        values = {name: v for name, v in values.items() if not name.endswith("_bend")}
        natural = _inside(problem, values)
        notes = (*notes, "the bends are at the prior's location: the curves cannot be joined")
    return goodness(
        problem, "geometric", problem.of_model(natural)[0], n_evaluations=1, notes=notes,
        n_fitted=len(set(values) & set(problem.names)), seconds=time.perf_counter() - clock,
    )  # fmt: skip


def _inside(problem: Problem, values: dict[str, float]) -> Array:
    """Natural parameters within the bounds, shape (1, d_all); prior locations for the rest."""
    entries = problem.priors.entries
    natural = np.array([[values.get(p.name, _location(problem, p.name)) for p in entries]])
    # Fixed parameters take their value on the way.
    return problem.theta(problem.priors.to_internal(natural)) if problem.names else natural


def _location(problem: Problem, name: str) -> float:
    prior = next(p for p in problem.priors.entries if p.name == name)
    return float(np.exp(prior.loc)) if prior.log else prior.loc


_NO_PEAK = "no peak inside the range: C is the prior's"


def _one_pressure(problem: Problem, up_to: float) -> tuple[dict[str, float], tuple[str, ...]]:
    Sh, Sv = (p for p in problem.priors.entries if p.name in ("Sh", "Sv"))
    shift = Sh.loc if Sh.fixed else 0.0
    lift = Sv.loc if Sv.fixed else 0.0
    slip = 100.0 * problem.conditions["slip_ratio"] - shift
    features = read_features(
        slip, problem.observed - lift, slope_slip_percent=up_to, find_zero=not Sh.fixed,
        where=problem.table.source,
    )  # fmt: skip
    B, C, D, E = coefficients(features, _location(problem, "C"))
    values = {"K": B * C * D, "C": C, "D": D, "G": _curvature(E)}
    if not Sh.fixed:
        values["Sh"] = features.zero
    if not Sv.fixed:
        values["Sv"] = 0.0
    return values, ("" if features.has_peak else _NO_PEAK,)


def _several_pressures(problem: Problem, up_to: float) -> tuple[dict[str, float], tuple[str, ...]]:
    mid, half = (problem.bound.references[f"p_{name}_psi"] for name in ("mid", "half"))
    u = (problem.conditions["inflation_pressure_psi"] - mid) / half
    slip = 100.0 * problem.conditions["slip_ratio"]
    # Readings of one nominal pressure differ a little from test to test.
    order = np.argsort(u, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(u[order]) > 0.05) + 1)
    read = [
        read_features(
            slip[g], problem.observed[g], slope_slip_percent=up_to,
            where=f"{problem.table.source}, rows near {mid + half * u[g].mean():g} psi",
        )
        for g in groups
    ]  # fmt: skip
    found = [coefficients(features, _location(problem, "C")) for features in read]
    centres = np.array([u[g].mean() for g in groups])
    basis = np.column_stack([0.5 * (1.0 - centres), 0.5 * (1.0 + centres), centres**2 - 1.0])
    n_basis = 3 if len(groups) > 2 else 2
    values = {"C": float(np.mean([c.C for c in found]))}
    curves = {"K": [c.B * c.C * c.D for c in found], "D": [c.D for c in found],
              "G": [_curvature(c.E) for c in found]}  # fmt: skip
    for name, at_pressures in curves.items():
        fit = np.linalg.lstsq(basis[:, :n_basis], np.array(at_pressures), rcond=None)[0]
        values[f"{name}_lo"], values[f"{name}_hi"] = float(fit[0]), float(fit[1])
        if n_basis == 3:
            values[f"{name}_bend"] = 2.0 * float(fit[2] / (fit[0] + fit[1]))
    held = "" if n_basis == 3 else "two pressures: the bends are at the prior's location"
    return values, (held, "" if all(f.has_peak for f in read) else _NO_PEAK)


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
    CalibError if the rows do not determine the coefficients.
    """
    with_slip = problem.bound.model.name == "modified_bekker"
    n_all = len(problem.table)
    slip = problem.table["slip_ratio"] if "slip_ratio" in problem.table else np.zeros(n_all)
    rows = ~(slip > max_slip * (1.0 + 1e-9))
    ln_z = np.log(problem.observed[rows] / 1000.0)
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
            expected=f"more than {p} rows in which ground pressure, rut depth"
            f"{' and slip vary' if with_slip else ' vary'}",
            hint="add tests, raise max_slip, or use another method such as least_squares",
        )
    beta = np.linalg.lstsq(X, y, rcond=None)[0]
    r = y - X @ beta
    sse = float(r @ r)
    values = dict(zip(names, beta.tolist(), strict=True))
    values["k"] = float(np.exp(values["k"]))
    reported = {name: values[name] for name in problem.bound.model.reported}
    r_squared = 1.0 - sse / float(np.square(y - y.mean()).sum())
    return RutRegression(reported, r_squared, float(np.sqrt(sse / (n - p))), n, n_all - n)


def estimate_published_regression(
    problem: Problem, rng: np.random.Generator | None = None, *, max_slip: float = 0.2
) -> PointEstimate:
    """Estimate by `rut_regression`, judged on the likelihood's scale (ln zt, all rows).

    CalibError as `rut_regression`, if a parameter is fixed, and if the exponent is not positive.
    """
    clock = time.perf_counter()
    fixed = [p.name for p in problem.priors.entries[:-1] if p.fixed]
    if fixed:
        raise CalibError(
            f"the published regression fits all coefficients, but {', '.join(fixed)} is fixed",
            expected="no fixed parameter",
            hint="free it, or use another method such as least_squares",
        )
    fit = rut_regression(problem, max_slip)
    exponent = fit.reported.get("n0", fit.reported.get("n", np.nan))
    if not exponent > 0.0:
        raise CalibError(
            f"the published regression gives an exponent of {exponent:.3g}",
            where=problem.table.source,
            expected="rut depths that grow with ground pressure",
            hint="check the columns of rut depth and ground pressure, or use least_squares",
        )
    left_out = f"{fit.n_excluded} rows above {max_slip:g} slip left out" if fit.n_excluded else ""
    quality = f"R² = {fit.r_squared:.3f}, RMSE = {fit.rmse:.3f} (n = {fit.n})"
    return goodness(
        problem, "published_regression", problem.bound.theta(fit.reported),
        n_fitted=len(fit.reported), n_evaluations=0, seconds=time.perf_counter() - clock,
        notes=(f"regression of ln pgr: {quality}", left_out),
    )  # fmt: skip
