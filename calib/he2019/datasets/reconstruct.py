"""The errors nearest to drawn noise under which a published estimate is the exact optimum.

All three data sets are reconstructed alike: draw noise with a fixed seed, then take the nearest
vector of errors (in the sum of squares) that meets the conditions of the published fit. Nearest,
so that what the source does not say stays as close to plain noise as what it says allows.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

type Array = NDArray[np.float64]
type Conditions = Callable[[Array], tuple[Array, Array]]

# Below this part of its length, a direction is rounding noise about the span of those before it.
_DEPENDENT = 1e-9


def normalised_basis(directions: Array) -> Array:
    """Return an orthonormal basis of the span of some directions, shape (n, k) to (n, rank).

    In order of importance: those that earlier ones already span are dropped.
    """
    q, r = np.linalg.qr(directions / np.linalg.norm(directions, axis=0))
    return np.asarray(q[:, np.abs(np.diag(r)) > _DEPENDENT])


def _constraint(kind: str, conditions: Conditions) -> dict[str, object]:
    return {
        "type": kind,
        "fun": lambda errors: conditions(errors)[0],
        "jac": lambda errors: conditions(errors)[1],
    }


def nearest_errors(
    drawn: Array,
    equal: Conditions,
    lower: Array,
    upper: Array,
    at_least: Conditions | None = None,
) -> Array:
    """Return the errors nearest to a draw that meet the conditions, all of shape (n,).

    Conditions map errors to values (m,) and their Jacobian (m, n): those of `equal` must be zero,
    those of `at_least` not negative. Equal bounds fix an error. RuntimeError if they cannot be met.
    """
    constraints: list[Any] = [_constraint("eq", equal)]
    if at_least is not None:
        constraints.append(_constraint("ineq", at_least))

    # Late: a tenth of a second, and whoever knows of the data seldom makes them.
    from scipy.optimize import Bounds, minimize

    def distance(errors: Array) -> float:
        return float(np.sum((errors - drawn) ** 2))

    def gradient(errors: Array) -> Array:
        return np.asarray(2.0 * (errors - drawn))

    found = minimize(
        distance,
        np.clip(drawn, lower, upper),
        jac=gradient,
        bounds=Bounds(lower, upper),
        constraints=constraints,
        method="SLSQP",
        options={"maxiter": 300, "ftol": 1e-15},
    )
    if not found.success:
        raise RuntimeError(f"the published conditions could not be met: {found.message}")
    return np.asarray(found.x, dtype=np.float64)


def read_only(**columns: Array) -> dict[str, Array]:
    """Return columns that cannot be written to, since they are shared between callers."""
    for column in columns.values():
        column.flags.writeable = False
    return columns
