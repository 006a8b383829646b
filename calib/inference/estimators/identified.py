"""Which parameters the data determine at all; the others are held before anything is fitted.

Two inflation pressures leave the curvature of a quadratic in pressure free, tests at one ground
pressure leave the exponent of pressure free. A least-squares cost is flat along such a parameter:
an optimiser would return wherever it happened to start. The parameter is held at the location of
its prior instead, and the estimate says so.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import qr

from calib.inference.estimators.base import residuals
from calib.inference.problem import Problem
from calib.inference.sampling.mode import prior_widths
from calib.models.base import Array

# A parameter is flat if one prior standard deviation of it moves the predictions, as far as the
# others cannot imitate it, by less than this part of their own scatter.
_FLAT = 1e-6
_N_POINTS = 8
_STEP = 1e-4
_TAIL = 0.5 * (1.0 - 0.998)
_MOST_ROWS = 4000


def location(problem: Problem) -> Array:
    """Prior location (mean or median) inside the bounds, internal, shape (n_dim,)."""
    return np.array([np.clip(p.loc, p.lower, p.upper) for p in problem.priors.free])


def central_interval(problem: Problem) -> tuple[Array, Array]:
    """Bounds of the prior's central 99.8 %, internal, each of shape (n_dim,)."""
    ends = np.repeat([[_TAIL], [1.0 - _TAIL]], problem.n_dim, axis=1)
    low, high = problem.priors.ppf(ends)
    return low, high


def representative_rows(problem: Problem) -> Problem:
    """Return the problem on at most about 4000 rows that span every condition.

    Whatever is needed to find the neighbourhood of the optimum, a few thousand rows show.
    """
    n = len(problem.table)
    if n <= _MOST_ROWS:
        return problem
    conditions = list(problem.conditions.values())
    pick = np.linspace(0, n - 1, _MOST_ROWS // len(conditions)).round().astype(int)
    rows = np.unique(np.concatenate([np.argsort(c, kind="stable")[pick] for c in conditions]))
    return problem.with_table(problem.table.take(rows))


def hold_unidentified(problem: Problem) -> tuple[Problem, tuple[str, ...]]:
    """Hold the noise's parameters and every parameter that the data do not determine.

    The rank of the Jacobian of the predictions is taken at the prior's centre and at a few points
    around it; a parameter is given up only if it is flat, or imitated by the others, at all. Return
    the problem whose free coordinates are to be fitted, the noise scale fixed at one, and the names
    of those held at their prior location.
    """
    entries = problem.priors.entries[len(problem.bound.model.parameters) :]
    # Their values do not enter a sum of squares.
    problem = problem.with_fixed({p.name: 1.0 for p in entries if not p.fixed})
    if not problem.names:
        return problem, ()
    flat = min(_flat_at_points(representative_rows(problem)), key=len, default=())
    if not flat:
        return problem, ()
    names = tuple(problem.names[j] for j in sorted(flat))
    natural = problem.theta(location(problem)[None])[0]
    values = dict(zip((p.name for p in problem.priors.entries), natural, strict=True))
    return problem.with_fixed({name: float(values[name]) for name in names}), names


def _flat_at_points(problem: Problem) -> list[tuple[int, ...]]:
    d, width, centre = problem.n_dim, prior_widths(problem.priors), location(problem)
    # A low-discrepancy sequence in the middle of the prior: the answer needs no random numbers.
    ratio = (1.0 + np.sqrt(5.0)) / 2.0
    steps = np.mod(np.outer(np.arange(1, _N_POINTS + 1), ratio ** -np.arange(1, d + 1)), 1.0)
    points = np.vstack([centre, problem.priors.ppf(0.2 + 0.6 * steps)])
    scatter = float(np.linalg.norm(problem.response - problem.response.mean()))
    found = []
    for point in points:
        step = _STEP * np.diag(width)
        pairs = problem.theta(np.concatenate([point + step, point - step]))
        ahead, behind = np.split(residuals(problem, pairs), 2)
        jacobian = ((behind - ahead) / (2.0 * _STEP)).T
        if np.isfinite(jacobian).all():
            found.append(_flat_columns(jacobian, scatter))
    return found


def _flat_columns(jacobian: Array, scatter: float) -> tuple[int, ...]:
    upper, order = qr(jacobian, mode="r", pivoting=True, check_finite=False)
    left = np.abs(np.diagonal(upper))
    threshold = _FLAT * max(scatter, 1e-300)
    n_left = np.count_nonzero(left > threshold)
    return tuple(int(j) for j in order[n_left:])
