"""Multi-start nonlinear least squares inside the prior's bounds, without a prior term."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from calib.errors import CalibError
from calib.inference.estimators.base import PointEstimate, check_defined, residuals, sum_of_squares
from calib.inference.estimators.search import (
    Found,
    central_interval,
    edge_notes,
    fit_identified,
    location,
    representative_rows,
)  # fmt: skip
from calib.inference.problem import Problem
from calib.inference.sampling.mode import prior_widths
from calib.models.base import Array

# Relative step of the central differences, in prior standard deviations.
_STEP = 1e-5
_TOLERANCE = 1e-13
_PRECISE = 1e-9


class _Polished(NamedTuple):
    z: Array
    cost: float
    converged: bool


class _Descent:
    """Residuals and their Jacobian in coordinates of prior location and width."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.location, self.width = location(problem), prior_widths(problem.priors)
        self.lower = (np.array([p.lower for p in problem.priors.free]) - self.location) / self.width
        self.upper = (np.array([p.upper for p in problem.priors.free]) - self.location) / self.width
        self.n_evaluations = 0
        # The tolerances below are meant for residuals of the order of one, whatever the unit.
        scatter = float(np.linalg.norm(problem.response - problem.response.mean()))
        self.scale = scatter if scatter > 0.0 else 1.0

    def natural(self, z: Array) -> Array:
        self.n_evaluations += z.shape[0]
        return self.problem.theta(self.location + z * self.width)

    def residuals(self, z: Array) -> Array:
        return np.asarray(residuals(self.problem, self.natural(z[None]))[0] / self.scale)

    def jacobian(self, z: Array) -> Array:
        # All differences in one model evaluation; one-sided on a bound.
        step = _STEP * np.eye(z.size)
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
            ftol=_TOLERANCE,
            xtol=_TOLERANCE,
            gtol=_TOLERANCE,
            max_nfev=400,
        )
        return _Polished(np.asarray(result.x), 2.0 * float(result.cost), bool(result.success))


def estimate_least_squares(
    problem: Problem, rng: np.random.Generator, *, n_screen: int = 1024, n_polish: int = 4
) -> PointEstimate:
    """Minimise the sum of squares from many starts.

    Prior draws are screened in one batched evaluation, in `n_polish` groups; the best of each group
    is polished by SciPy's trust-region reflective method. The prior's bounds hold; otherwise the
    prior only supplies the starts. Of more than a few thousand rows a representative part is used,
    and the best of what is found is polished on all of them.
    """

    def fit(reduced: Problem) -> tuple[Array, Found, str]:
        rough = _Descent(representative_rows(reduced))
        polished = [rough.polish(start) for start in _starts(rough, rng, n_screen, n_polish)]
        best = min(polished, key=lambda p: p.cost)
        n_agree = sum(p.cost <= best.cost * (1.0 + _PRECISE) + _PRECISE**2 for p in polished)
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
    """Say which estimates the prior thinks all but impossible."""
    low, high = central_interval(problem)
    far = [n for n, out in zip(problem.names, (x < low) | (x > high), strict=True) if out]
    return f"{', '.join(far)} outside the prior's central 99.8 %" if far else ""


def _starts(descent: _Descent, rng: np.random.Generator, n_screen: int, n_polish: int) -> Array:
    drawn = descent.problem.priors.sample(rng, max(n_screen, n_polish))
    z = (drawn - descent.location) / descent.width
    cost = sum_of_squares(descent.problem, descent.natural(z))
    groups = np.array_split(np.arange(z.shape[0]), n_polish)
    # The best of each group rather than the best of all, which may share one basin.
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
            mend="look for impossible conditions in the data, or widen the prior",
        )
    return np.asarray(z[best])
