"""The box in which the population methods search, and the estimate made of what they find."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from calib.errors import CalibError
from calib.inference.estimators.base import PointEstimate, goodness, residuals, sum_of_squares
from calib.inference.estimators.identified import central_interval, hold_unidentified
from calib.inference.problem import Problem
from calib.models.base import Array

type Box = Mapping[str, tuple[float, float]]


class Found(NamedTuple):
    """What a minimiser found: where, after how many evaluations, and whether it had converged."""

    x: Array
    n_evaluations: int
    converged: bool
    note: str = ""


@dataclass(frozen=True)
class SearchSpace:
    """Coordinates, box and cost of a search for the free parameters of a problem.

    Parameters
    ----------
    names : tuple of str
        The coordinates; ``B`` and ``E`` in the place of ``K`` and ``G`` for the Magic Formula at
        one pressure, as in the source.
    lower, upper : ndarray, shape (d,)
        The box: in natural units for the Magic Formula at one pressure, else in the prior's
        internal coordinates, so that log-normal parameters are searched on their logarithm.
    """

    problem: Problem
    names: tuple[str, ...]
    lower: Array
    upper: Array

    def natural(self, x: Array) -> Array:
        """Natural parameters, the noise scale last, of coordinates (k, d)."""
        priors = self.problem.priors
        other = self.problem.bound.model.searched
        if other is None:
            return priors.to_natural(x)
        searched = dict(zip(self.names, x.T, strict=True))
        value: dict[str, Any] = {p.name: searched.get(p.name, p.loc) for p in priors.entries}
        value |= {name: searched[name] for name in other.names.values() if name in searched}
        found = other.sampled(value)
        columns = [found[p.name] for p in priors.entries]
        return np.stack(np.broadcast_arrays(x[:, 0], *columns)[1:], axis=1)

    def cost(self, x: Array) -> Array:
        """Sum of squared residuals (Eq 10), (k, d) to (k,); ``inf`` where there is no value."""
        return sum_of_squares(self.problem, self.natural(x))

    def _residuals(self, x: Array) -> Array:
        return np.asarray(residuals(self.problem, self.natural(x[None]))[0])

    def polish(self, x: Array) -> Found:
        """Descend from a point of the box (d,) by least squares; never to a higher cost."""
        # Late: a tenth of a second, and what knows of the methods seldom uses one.
        from scipy.optimize import least_squares

        result = least_squares(
            self._residuals,
            x,
            jac="3-point",
            bounds=(self.lower, self.upper),
            x_scale=self.upper - self.lower,
            ftol=1e-13,
            xtol=1e-13,
            gtol=1e-13,
        )
        n_evaluations = result.nfev + 2 * x.size * (result.njev or 0)
        better = 2.0 * result.cost <= self.cost(x[None])[0]
        return Found(np.asarray(result.x) if better else x, n_evaluations, bool(result.success))


def search_space(problem: Problem, box: Box | None = None) -> SearchSpace:
    """Return the space in which a population method searches.

    The problem has the noise scale and undetermined parameters held. A box replaces the bounds, in
    natural units, of some coordinates: by default B from 0.001 to 0.5 per percent, C from 1 to 2, D
    from 0 to twice the largest pull and E from -30 to 1 for the Magic Formula at one pressure; for
    all other parameters the central 99.8 % interval of the prior.

    Raises
    ------
    CalibError
        If the box names no coordinate or has a lower bound that is not below its upper bound.
    """
    other = problem.bound.model.searched
    names = tuple(other.names.get(n, n) if other else n for n in problem.names)
    low, high = central_interval(problem)
    logs = [p.log and other is None for p in problem.priors.free]
    _check_box(box or {}, names)
    largest = float(np.abs(problem.response).max())
    given = (other.box(largest) if other else {}) | dict(box or {})
    for j, name in enumerate(names):
        if name in given:
            ends = np.array(given[name], dtype=np.float64)
            if logs[j] and ends[0] <= 0.0:
                raise CalibError(
                    f"the search box of {name} starts at {ends[0]:g}",
                    allowed="a lower bound above 0, as its logarithm is searched",
                    mend="raise the lower bound",
                )
            low[j], high[j] = np.log(ends) if logs[j] else ends
        elif other and problem.priors.free[j].log:  # a user's prior may be log-normal
            low[j], high[j] = np.exp([low[j], high[j]])
    return SearchSpace(problem, names, low, high)


def _check_box(box: Box, names: tuple[str, ...]) -> None:
    for name, (low, high) in box.items():
        if name not in names:
            raise CalibError(
                f"the search box names {name!r}, which is not searched",
                allowed=", ".join(names),
                mend="name one of these coordinates",
            )
        if not -np.inf < low < high < np.inf:
            raise CalibError(
                f"the search box of {name} goes from {low:g} to {high:g}",
                allowed="two finite numbers, lower < upper",
                mend="correct the box",
            )


def held_note(held: tuple[str, ...]) -> str:
    """Say which parameters were held, or nothing."""
    if not held:
        return ""
    return f"the data do not determine {', '.join(held)}: held at the prior's location"


def edge_notes(names: tuple[str, ...], x: Array, lower: Array, upper: Array, what: str) -> str:
    """Say which coordinates ended on an edge, or nothing."""
    span = np.where(np.isfinite(upper - lower), upper - lower, 1.0)
    at = (x - lower <= 1e-6 * span) | (upper - x <= 1e-6 * span)
    stuck = [name for name, on_edge in zip(names, at, strict=True) if on_edge]
    return f"{', '.join(stuck)} on the edge of {what}" if stuck else ""


def fit_identified(
    problem: Problem, method: str, fit: Callable[[Problem], tuple[Array, Found, str]]
) -> PointEstimate:
    """Hold what the data do not determine, fit the rest, and complete the estimate.

    `fit` returns the model's parameters (d_model,), what was found, and notes on edges.
    """
    clock = time.perf_counter()
    reduced, held = hold_unidentified(problem)
    if reduced.names:
        theta, found, edges = fit(reduced)
    else:
        theta, edges = reduced.of_model(reduced.theta(np.empty((1, 0))))[0], ""
        found = Found(np.empty(0), 1, True, "every parameter is fixed")
    return goodness(
        problem,
        method,
        theta,
        n_fitted=len(reduced.names),
        n_evaluations=found.n_evaluations,
        seconds=time.perf_counter() - clock,
        converged=found.converged,
        notes=(found.note, held_note(held), edges),
    )


def search_in_box(
    problem: Problem, method: str, box: Box | None, minimise: Callable[[SearchSpace], Found]
) -> PointEstimate:
    """Estimate by a search of the box of what the data determine."""

    def fit(reduced: Problem) -> tuple[Array, Found, str]:
        space = search_space(reduced, box)
        found = minimise(space)
        if not np.isfinite(space.cost(found.x[None]))[0]:
            raise CalibError(
                f"{problem.bound.model.name} has no value for some rows, wherever in the search "
                "box its parameters lie",
                where=problem.table.source,
                mend="look for impossible conditions in the data, or pass another search box",
            )
        edges = edge_notes(space.names, found.x, space.lower, space.upper, "the search box")
        return problem.of_model(space.natural(found.x[None]))[0], found, edges

    return fit_identified(problem, method, fit)
