"""Point estimates by search: goodness of fit, what is identified, the box, SciPy's evolution.

What the data do not determine is held before anything is fitted. Two inflation pressures leave the
curvature of a quadratic in pressure free, tests at one ground pressure leave the exponent of
pressure free: a least-squares cost is flat along such a parameter, and an optimiser would return
wherever it happened to start. The parameter is held at the location of its prior instead, and the
estimate says so.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr

from calib.data.quantities import QUANTITIES
from calib.errors import CalibError
from calib.inference.mode import prior_widths
from calib.inference.problem import Problem
from calib.models.base import Array, BoundModel, Conditions


@dataclass(frozen=True, eq=False)
class PointEstimate:
    """One estimate of a model's parameters.

    `theta`, shape (d_model,), are the sampled parameters in natural units without the noise scale,
    `reported` the published ones. `cost` is the sum of squared residuals over all rows on the scale
    of the response, `cost_unit` its unit, and `r_squared` one minus cost over the sum of squares
    about the mean. `rmse` is ``sqrt(cost/(n - p))`` with p parameters fitted (MATLAB's convention,
    which the source follows); NaN where n does not exceed p. `n_evaluations` counts parameter
    vectors, `seconds` is wall-clock time, `converged` says whether the method's own stopping rule
    was met, and `note` is for the reader.
    """

    method: str
    theta: Array
    reported: dict[str, float]
    cost: float
    cost_unit: str
    rmse: float
    r_squared: float
    n_evaluations: int
    seconds: float
    converged: bool
    note: str = ""

    @property
    def rmse_unit(self) -> str:
        """Unit of the RMSE."""
        return self.cost_unit.removesuffix("^2").strip("()")


def sum_of_squares(problem: Problem, natural: Array) -> Array:
    """Sum of squared residuals (Eqs 10 and 16), shape (k,); ``inf`` where there is no value.

    Of natural parameters (k, d_all), the noise scale last.
    """
    cost = problem.squares(problem.of_model(natural))
    cost[np.isnan(cost)] = np.inf
    return cost


def goodness(
    problem: Problem,
    method: str,
    theta: Array,
    *,
    n_fitted: int,
    n_evaluations: int,
    seconds: float,
    converged: bool = True,
    notes: Sequence[str] = (),
) -> PointEstimate:
    """Complete an estimate (d_model,) with its cost, RMSE and R².

    Parameters held or fixed do not count as fitted; notes that are empty are left out.
    """
    cost = float(sum_of_squares(problem, theta[None])[0])
    y = problem.response
    spread = float(np.square(y - y.mean()).sum())
    freedom = y.size - n_fitted
    output = QUANTITIES[problem.bound.model.output].unit.replace("**", "^")
    unit = f"({output})^2" if "/" in output else f"{output}^2"
    return PointEstimate(
        method=method,
        theta=theta,
        reported={name: float(v[0]) for name, v in problem.bound.report(theta[None]).items()},
        cost=cost,
        cost_unit="1" if problem.bound.model.response == "log" else unit,
        rmse=float(np.sqrt(cost / freedom)) if freedom > 0 else float("nan"),
        r_squared=1.0 - cost / spread if spread > 0.0 else float("nan"),
        n_evaluations=n_evaluations,
        seconds=seconds,
        converged=converged,
        note="; ".join(note for note in notes if note),
    )


def check_defined(
    bound: BoundModel, theta: Array, conditions: Conditions, source: str, lines: NDArray[np.int64]
) -> None:
    """Refuse rows at which no parameter vector has a finite prediction; the error names them.

    Parameters are (k, d), conditions and the `lines` of the `source` (n,).
    """
    shown = 5
    empty = lines[~np.isfinite(bound.mean_response(theta, conditions)).any(axis=0)]
    if empty.size:
        raise CalibError(
            f"the model {bound.model.name} has no value there",
            where=f"{source}, lines {', '.join(map(str, empty[:shown]))}"
            + (f" and {empty.size - shown} more" if empty.size > shown else ""),
            expected="conditions at which the model is defined (see its page in the documentation)",
            hint="leave these rows out, or choose another model",
        )


def prior_location(problem: Problem) -> Array:
    """Prior location (mean or median) inside the bounds, internal, shape (n_dim,)."""
    return np.array([np.clip(p.loc, p.lower, p.upper) for p in problem.priors.free])


def central_interval(problem: Problem) -> tuple[Array, Array]:
    """Bounds of the prior's central 99.8 %, internal, each of shape (n_dim,)."""
    ends = np.repeat([[0.001], [0.999]], problem.n_dim, axis=1)
    low, high = problem.priors.ppf(ends)
    return low, high


def representative_rows(problem: Problem) -> Problem:
    """Return the problem on at most about 4000 rows that span every condition.

    They are enough to find the neighbourhood of the optimum.
    """
    n, enough = len(problem.table), 4000
    if n <= enough:
        return problem
    conditions = list(problem.conditions.values())
    pick = np.linspace(0, n - 1, enough // len(conditions)).round().astype(int)
    rows = np.unique(np.concatenate([np.argsort(c, kind="stable")[pick] for c in conditions]))
    return problem.with_table(problem.table.take(rows))


def hold_unidentified(problem: Problem) -> tuple[Problem, tuple[str, ...]]:
    """Hold the noise's parameters and every parameter that the data do not determine.

    By the rank of the Jacobian of the predictions at the prior's centre and a few points around it.
    Return the problem whose free coordinates are to be fitted, the noise scale fixed at one, and
    the names of those held at their prior location.
    """
    entries = problem.priors.entries[len(problem.bound.model.parameters) :]
    # Parameters of the noise do not affect a sum of squares.
    problem = problem.with_fixed({p.name: 1.0 for p in entries if not p.fixed})
    if not problem.names:
        return problem, ()
    flat = min(_flat_at_points(representative_rows(problem)), key=len, default=())
    if not flat:
        return problem, ()
    names = tuple(problem.names[j] for j in sorted(flat))
    natural = problem.theta(prior_location(problem)[None])[0]
    values = dict(zip((p.name for p in problem.priors.entries), natural, strict=True))
    return problem.with_fixed({name: float(values[name]) for name in names}), names


def _flat_at_points(problem: Problem) -> list[tuple[int, ...]]:
    """Parameters that are flat at the prior's centre and at points in its middle."""
    d, width, centre = problem.n_dim, prior_widths(problem.priors), prior_location(problem)
    # A low-discrepancy sequence.
    ratio = (1.0 + np.sqrt(5.0)) / 2.0
    steps = np.mod(np.outer(np.arange(1, 9), ratio ** -np.arange(1, d + 1)), 1.0)
    scatter = float(np.linalg.norm(problem.response - problem.response.mean()))
    found = []
    for point in np.vstack([centre, problem.priors.ppf(0.2 + 0.6 * steps)]):
        step = 1e-4 * np.diag(width)
        pairs = problem.theta(np.concatenate([point + step, point - step]))
        ahead, behind = np.split(problem.residuals(pairs), 2)
        jacobian = ((behind - ahead) / 2e-4).T  # per prior standard deviation
        if np.isfinite(jacobian).all():
            upper, order = qr(jacobian, mode="r", pivoting=True, check_finite=False)
            left = np.abs(np.diagonal(upper)) > 1e-6 * max(scatter, 1e-300)
            found.append(tuple(int(j) for j in order[np.count_nonzero(left) :]))
    return found


type Box = Mapping[str, tuple[float, float]]


class Minimum(NamedTuple):
    """What a minimiser found: where, after how many evaluations, and whether it had converged."""

    x: Array
    n_evaluations: int
    converged: bool
    note: str = ""
    cost: float = np.nan


@dataclass(frozen=True)
class SearchSpace:
    """Coordinates, box and cost of a search for the free parameters of a problem.

    The box, (d,) each, is in published parameters for a model that says so (`Model.searched`); else
    in the prior's internal coordinates, so that log-normal parameters are searched on their
    logarithm.
    """

    problem: Problem
    names: tuple[str, ...]
    lower: Array
    upper: Array

    def natural(self, x: Array) -> Array:
        """Natural parameters, the noise scale last, of coordinates (k, d)."""
        priors = self.problem.priors
        model = self.problem.bound.model
        if not model.searched:
            return priors.to_natural(x)
        held = {p.name: p.loc for p in priors.entries}
        value = dict.fromkeys(model.reported, np.nan) | held
        value |= dict(zip(self.names, x.T, strict=True))
        value |= dict(zip(model.parameters, self.problem.bound.theta(value).T, strict=True))
        columns = [(value if name in self.problem.names else held)[name] for name in held]
        return np.stack(np.broadcast_arrays(x[:, 0], *columns)[1:], axis=1)

    def cost(self, x: Array) -> Array:
        """Sum of squared residuals (Eq 10), (k, d) to (k,); ``inf`` where there is no value."""
        return sum_of_squares(self.problem, self.natural(x))

    def polish(self, x: Array) -> Minimum:
        """Descend from a point of the box (d,) by least squares; never to a higher cost."""
        found = descend(
            lambda x: self.problem.residuals(self.natural(x)), x, self.lower, self.upper,
            self.upper - self.lower, scatter_of(self.problem),
        )  # fmt: skip
        better = found.cost <= self.cost(x[None])[0]
        return Minimum(found.x if better else x, found.n_evaluations, found.converged)


def descend(
    residuals: Callable[[Array], Array], x: Array, lower: Array, upper: Array, width: Array,
    scale: float,
) -> Minimum:  # fmt: skip
    """Descend from a point (d,) within bounds by SciPy's trust-region reflective least squares.

    `residuals` are (k, d) to (k, n), of the order of `scale`; each coordinate matters over its
    `width`. All differences of the Jacobian are one evaluation, one-sided on a bound.
    """
    from scipy.optimize import least_squares  # late: a tenth of a second

    low, high, step = lower / width, upper / width, 1e-5 * np.eye(x.size)

    def scaled(z: Array) -> Array:
        return np.asarray(residuals(z[None] * width)[0] / scale)

    def jacobian(z: Array) -> Array:
        ahead, behind = np.minimum(z + step, high), np.maximum(z - step, low)
        span = np.diagonal(ahead) - np.diagonal(behind)
        forward, backward = np.split(residuals(np.concatenate([ahead, behind]) * width), 2)
        slope = (forward - backward) / (scale * span[:, None])
        # A step beyond where the model has a value says nothing about that direction.
        return np.asarray(np.nan_to_num(slope, nan=0.0, posinf=0.0, neginf=0.0).T)

    start = np.clip(x / width, low, high)
    found = least_squares(
        scaled, start, jac=jacobian, bounds=(low, high), x_scale="jac", ftol=1e-13, xtol=1e-13,
        gtol=1e-13, max_nfev=400,
    )  # fmt: skip
    count = found.nfev + 2 * x.size * (found.njev or 0)
    cost = 2.0 * float(found.cost) * scale**2
    return Minimum(found.x * width, count, bool(found.success), cost=cost)


def scatter_of(problem: Problem) -> float:
    """Size of the responses about their mean, by which residuals are of the order of one."""
    return float(np.linalg.norm(problem.response - problem.response.mean())) or 1.0


def descend_from(problem: Problem, t: Array) -> Minimum:
    """Descend from internal coordinates (d,) within the prior's bounds."""
    lower, upper = np.array([(p.lower, p.upper) for p in problem.priors.free]).T
    return descend(
        lambda t: problem.residuals(problem.theta(t)), t, lower, upper,
        prior_widths(problem.priors), scatter_of(problem),
    )  # fmt: skip


def search_space(problem: Problem, box: Box | None = None) -> SearchSpace:
    """Return the space in which a population method searches.

    A box replaces the bounds, in natural units, of some coordinates: by default B from 0.001 to 0.5
    per percent, C from 1 to 2, D from 0 to twice the largest pull and E from -30 to 1 for the Magic
    Formula at one pressure; for all other parameters the central 99.8 % interval of the prior.
    """
    model = problem.bound.model
    other = model.searched
    published = dict(zip(model.parameters, model.reported, strict=False)) if other else {}
    names = tuple(published.get(n, n) for n in problem.names)
    low, high = central_interval(problem)
    logs = [p.log and not other for p in problem.priors.free]
    _check_box(box or {}, names)
    largest = float(np.abs(problem.response).max())
    unit = QUANTITIES[model.output].unit
    sizes = {name: largest if model.reported[name] == unit else 1.0 for name in other}
    given = {name: (a * sizes[name], b * sizes[name]) for name, (a, b) in other.items()}
    given |= dict(box or {})
    for j, name in enumerate(names):
        if name in given:
            ends = np.array(given[name], dtype=np.float64)
            if logs[j] and ends[0] <= 0.0:
                raise CalibError(
                    f"the search box of {name} starts at {ends[0]:g}",
                    expected="a lower bound above 0, as its logarithm is searched",
                    hint="raise the lower bound",
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
                expected=", ".join(names),
                hint="name one of these coordinates",
            )
        if not -np.inf < low < high < np.inf:
            raise CalibError(
                f"the search box of {name} goes from {low:g} to {high:g}",
                expected="two finite numbers, lower < upper",
                hint="correct the box",
            )


def edge_notes(names: tuple[str, ...], x: Array, lower: Array, upper: Array, what: str) -> str:
    """Name the coordinates that ended on an edge."""
    span = np.where(np.isfinite(upper - lower), upper - lower, 1.0)
    at = (x - lower <= 1e-6 * span) | (upper - x <= 1e-6 * span)
    stuck = [name for name, on_edge in zip(names, at, strict=True) if on_edge]
    return f"{', '.join(stuck)} on the edge of {what}" if stuck else ""


def fit_identified(
    problem: Problem, method: str, fit: Callable[[Problem], tuple[Array, Minimum, str]]
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
        found = Minimum(np.empty(0), 1, True, "every parameter is fixed")
    return goodness(
        problem,
        method,
        theta,
        n_fitted=len(reduced.names),
        n_evaluations=found.n_evaluations,
        seconds=time.perf_counter() - clock,
        converged=found.converged,
        notes=(
            found.note,
            f"the data do not determine {', '.join(held)}: held at the prior's location"
            if held
            else "",
            edges,
        ),
    )


def search_in_box(
    problem: Problem, method: str, box: Box | None, minimise: Callable[[SearchSpace], Minimum]
) -> PointEstimate:
    """Estimate what the data determine by searching the box."""

    def fit(reduced: Problem) -> tuple[Array, Minimum, str]:
        space = search_space(reduced, box)
        found = minimise(space)
        if not np.isfinite(space.cost(found.x[None]))[0]:
            raise CalibError(
                f"{problem.bound.model.name} has no value for some rows, wherever in the search "
                "box its parameters lie",
                where=problem.table.source,
                hint="look for impossible conditions in the data, or pass another search box",
            )
        edges = edge_notes(space.names, found.x, space.lower, space.upper, "the search box")
        return problem.of_model(space.natural(found.x[None]))[0], found, edges

    return fit_identified(problem, method, fit)


def estimate_differential_evolution(
    problem: Problem, rng: np.random.Generator, *, box: Box | None = None, **settings: Any
) -> PointEstimate:
    """Minimise the sum of squares by `scipy.optimize.differential_evolution`, batched.

    The box is that of `search_space`; other settings and their defaults are SciPy's.
    """
    from scipy.optimize import differential_evolution  # late: a tenth of a second

    def minimise(space: SearchSpace) -> Minimum:
        evaluated = 0

        def cost(x: Array) -> Array:
            nonlocal evaluated
            values = space.cost(np.atleast_2d(x.T))
            evaluated += values.size
            # With `inf` the population's spread, SciPy's stopping rule, is undefined.
            return np.minimum(values, 1e100)

        # The stubs know the scalar signature only.
        batched: Any = cost
        result = differential_evolution(
            batched,
            list(zip(space.lower, space.upper, strict=True)),
            vectorized=True,
            updating="deferred",
            rng=rng,
            **settings,
        )
        return Minimum(np.asarray(result.x), evaluated, bool(result.success))

    return search_in_box(problem, "differential_evolution", box, minimise)
