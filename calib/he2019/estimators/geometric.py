"""The geometric method: Magic Formula coefficients read off the measured curve (Eqs 6-9)."""

from __future__ import annotations

import time

import numpy as np

from calib.he2019.estimators.features import coefficients, read_features
from calib.inference.estimators.base import PointEstimate, goodness, sum_of_squares
from calib.inference.problem import Problem
from calib.models.base import Array

# Eq 9 may give an E above 1, for which the formula has no single peak; G = 1 - E is kept positive.
_LEAST_G = 0.01


def estimate_geometric(
    problem: Problem,
    rng: np.random.Generator | None = None,
    *,
    slope_slip_percent: float = 5.0,
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
        problem,
        "geometric",
        problem.of_model(natural)[0],
        n_fitted=len(set(values) & set(problem.names)),
        n_evaluations=1,
        seconds=time.perf_counter() - clock,
        notes=notes,
    )


def _inside(problem: Problem, values: dict[str, float]) -> Array:
    """Natural parameters within the bounds, shape (1, d_all); prior locations for the rest."""
    entries = problem.priors.entries
    natural = np.array([[values.get(p.name, _location(problem, p.name)) for p in entries]])
    # Fixed parameters take their value on the way.
    return problem.theta(problem.priors.to_internal(natural)) if problem.names else natural


def _location(problem: Problem, name: str) -> float:
    prior = next(p for p in problem.priors.entries if p.name == name)
    return float(np.exp(prior.loc)) if prior.log else prior.loc


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
    values = {"K": B * C * D, "C": C, "D": D, "G": max(1.0 - E, _LEAST_G)}
    if not Sh.fixed:
        values["Sh"] = features.zero
    if not Sv.fixed:
        values["Sv"] = 0.0
    return values, (_peak_note(features.has_peak),)


def _peak_note(has_peak: bool) -> str:
    return "" if has_peak else "no peak inside the range: C is the prior's"


def _several_pressures(problem: Problem, up_to: float) -> tuple[dict[str, float], tuple[str, ...]]:
    mid, half = (problem.bound.references[f"p_{name}_psi"] for name in ("mid", "half"))
    u = (problem.conditions["inflation_pressure_psi"] - mid) / half
    slip = 100.0 * problem.conditions["slip_ratio"]
    # Readings of one nominal pressure differ a little from test to test.
    order = np.argsort(u, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(u[order]) > 0.05) + 1)
    read = [
        read_features(
            slip[g],
            problem.observed[g],
            slope_slip_percent=up_to,
            where=f"{problem.table.source}, rows near {mid + half * u[g].mean():g} psi",
        )
        for g in groups
    ]
    found = [coefficients(features, _location(problem, "C")) for features in read]
    centres = np.array([u[g].mean() for g in groups])
    basis = np.column_stack([0.5 * (1.0 - centres), 0.5 * (1.0 + centres), centres**2 - 1.0])
    n_basis = 3 if len(groups) > 2 else 2
    values = {"C": float(np.mean([c.C for c in found]))}
    curves = {"K": [c.B * c.C * c.D for c in found], "D": [c.D for c in found],
              "G": [max(1.0 - c.E, _LEAST_G) for c in found]}  # fmt: skip
    for name, at_pressures in curves.items():
        fit = np.linalg.lstsq(basis[:, :n_basis], np.array(at_pressures), rcond=None)[0]
        values[f"{name}_lo"], values[f"{name}_hi"] = float(fit[0]), float(fit[1])
        if n_basis == 3:
            values[f"{name}_bend"] = 2.0 * float(fit[2] / (fit[0] + fit[1]))
    held = "" if n_basis == 3 else "two pressures: the bends are at the prior's location"
    return values, (held, _peak_note(all(f.has_peak for f in read)))
