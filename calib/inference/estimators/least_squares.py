"""Least squares from many starts within the prior's bounds."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from calib.errors import CalibError
from calib.inference.estimators.search import (
    Found,
    PointEstimate,
    central_interval,
    check_defined,
    edge_notes,
    fit_identified,
    prior_location,
    representative_rows,
    residuals,
    sum_of_squares,
)
from calib.inference.problem import Problem
from calib.inference.sampling.mode import prior_widths
from calib.models.base import Array


class _Polished(NamedTuple):
    z: Array
    cost: float
    converged: bool


class _Descent:
    """Residuals and their Jacobian in coordinates of prior location and width."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.location, self.width = prior_location(problem), prior_widths(problem.priors)
        self.lower = (np.array([p.lower for p in problem.priors.free]) - self.location) / self.width
        self.upper = (np.array([p.upper for p in problem.priors.free]) - self.location) / self.width
        self.n_evaluations = 0
        # The tolerances suit residuals of the order of one.
        scatter = float(np.linalg.norm(problem.response - problem.response.mean()))
        self.scale = scatter if scatter > 0.0 else 1.0

    def natural(self, z: Array) -> Array:
        self.n_evaluations += z.shape[0]
        return self.problem.theta(self.location + z * self.width)

    def residuals(self, z: Array) -> Array:
        return np.asarray(residuals(self.problem, self.natural(z[None]))[0] / self.scale)

    def jacobian(self, z: Array) -> Array:
        # All differences in one model evaluation; one-sided on a bound.
        step = 1e-5 * np.eye(z.size)  # prior standard deviations
        ahead, behind = np.minimum(z + step, self.upper), np.maximum(z - step, self.lower)
        span = np.diagonal(ahead) - np.diagonal(behind)
        r = residuals(self.problem, self.natural(np.concatenate([ahead, behind])))
        slope = (r[: z.size] - r[z.size :]) / (self.scale * span[:, None])
        # A step beyond where the model has a value says nothing about that direction.
        return np.asarray(np.nan_to_num(slope, nan=0.0, posinf=0.0, neginf=0.0).T)

    def polish(self, z: Array) -> _Polished:
        from scipy.optimize import least_squares  # late: a tenth of a second

        result = least_squares(
            self.residuals,
            z,
            jac=self.jacobian,
            bounds=(self.lower, self.upper),
            x_scale="jac",
            ftol=1e-13,
            xtol=1e-13,
            gtol=1e-13,
            max_nfev=400,
        )
        return _Polished(np.asarray(result.x), 2.0 * float(result.cost), bool(result.success))


def estimate_least_squares(
    problem: Problem, rng: np.random.Generator, *, n_screen: int = 1024, n_polish: int = 4
) -> PointEstimate:
    """Minimise the sum of squares from many starts within the prior's bounds.

    Prior draws are screened in one batched evaluation, and the best of each of `n_polish` groups is
    polished by SciPy's trust-region reflective method. Of more than a few thousand rows a
    representative part is used, and the best result is polished on all of them.
    """

    def fit(reduced: Problem) -> tuple[Array, Found, str]:
        rough = _Descent(representative_rows(reduced))
        polished = [rough.polish(start) for start in _starts(rough, rng, n_screen, n_polish)]
        best = min(polished, key=lambda p: p.cost)
        n_agree = sum(p.cost <= best.cost * (1.0 + 1e-9) + 1e-18 for p in polished)
        evaluations, fine = rough.n_evaluations, rough
        if rough.problem is not reduced:
            fine = _Descent(reduced)
            best = fine.polish(best.z)
            evaluations += fine.n_evaluations
        x = fine.location + best.z * fine.width
        lower, upper = np.array([(p.lower, p.upper) for p in reduced.priors.free]).T
        valley = "the cost still falls along a valley without end in sight"
        said = [f"{n_agree} of {len(polished)} starts end at the lowest cost"]
        said += [] if best.converged else [valley]
        edges = edge_notes(reduced.names, x, lower, upper, "the prior's bounds")
        notes = "; ".join(filter(None, (edges, _far_note(reduced, x))))
        theta = reduced.of_model(reduced.theta(x[None]))[0]
        return theta, Found(x, evaluations, best.converged, "; ".join(said)), notes

    return fit_identified(problem, "least_squares", fit)


def _far_note(problem: Problem, x: Array) -> str:
    """Name the estimates that the prior deems almost impossible."""
    low, high = central_interval(problem)
    far = [n for n, out in zip(problem.names, (x < low) | (x > high), strict=True) if out]
    return f"{', '.join(far)} outside the prior's central 99.8 %" if far else ""


def _starts(descent: _Descent, rng: np.random.Generator, n_screen: int, n_polish: int) -> Array:
    drawn = descent.problem.priors.sample(rng, max(n_screen, n_polish))
    z = (drawn - descent.location) / descent.width
    cost = sum_of_squares(descent.problem, descent.natural(z))
    groups = np.array_split(np.arange(z.shape[0]), n_polish)
    # Not the best of all, which may share one basin.
    best = np.array([group[cost[group].argmin()] for group in groups])
    best = best[np.isfinite(cost[best])]
    if best.size == 0:
        problem = descent.problem
        theta = problem.of_model(problem.theta(drawn))
        check_defined(
            problem.bound, theta, problem.conditions, problem.table.source, problem.table.lines
        )
        raise CalibError(
            f"{problem.bound.model.name} has no value for some rows, wherever in the "
            "prior its parameters are drawn",
            where=problem.table.source,
            hint="look for impossible conditions in the data, or widen the prior",
        )
    return np.asarray(z[best])
