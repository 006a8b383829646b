"""What every estimator returns: one parameter vector and how well it fits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.data.quantities import QUANTITIES
from calib.errors import CalibError
from calib.inference.problem import Problem
from calib.models.base import Array, BoundModel, Conditions

# Rows times vectors evaluated at once: bounds the memory, keeps temporaries in cache.
_CHUNK_CELLS = 200_000


@dataclass(frozen=True, eq=False)
class PointEstimate:
    """One estimate of a model's parameters.

    Parameters
    ----------
    method : str
        One of `calib.inference.estimators.METHODS`.
    theta : ndarray, shape (d_model,)
        The sampled parameters in natural units, without the noise scale.
    reported : dict of str to float
        The published parameters.
    cost : float
        Sum of squared residuals over all rows, on the scale of the response: of the output itself,
        or of its logarithm for rut depth.
    cost_unit : str
        Its unit.
    rmse : float
        ``sqrt(cost/(n - p))`` with p the number of parameters fitted (MATLAB's convention, which
        the source follows); NaN where n does not exceed p.
    r_squared : float
        One minus cost over the sum of squares about the mean, on the same scale.
    n_evaluations : int
        Parameter vectors at which the model was evaluated.
    seconds : float
        Wall-clock time.
    converged : bool
        Whether the method's own stopping rule was met.
    note : str
        What the reader must know, such as parameters that were held.
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


def residuals(problem: Problem, natural: Array) -> Array:
    """Observed minus predicted on the scale of the response, in chunks, shape (k, d_all) to (k, n).

    Natural parameters have the noise scale last. NaN where the model has no value.
    """
    k, n = natural.shape[0], problem.response.size
    at_once = max(1, _CHUNK_CELLS // n)
    if k <= at_once:
        return problem.residuals(natural)
    out = np.empty((k, n))
    for i in range(0, k, at_once):
        out[i : i + at_once] = problem.residuals(natural[i : i + at_once])
    return out


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


_SHOWN = 5


def check_defined(
    bound: BoundModel, theta: Array, conditions: Conditions, source: str, lines: NDArray[np.int64]
) -> None:
    """Refuse rows at which no parameter vector has a finite prediction.

    Parameters
    ----------
    theta : ndarray, shape (k, d)
        Natural parameters of the model, as its prior spreads them.
    conditions : mapping of str to ndarray, shape (n,)
    source : str
        What the rows are from, for the message.
    lines : ndarray, shape (n,)
        Where they stand there.

    Raises
    ------
    CalibError
        Naming the lines.
    """
    empty = lines[~np.isfinite(bound.location(theta, conditions)).any(axis=0)]
    if empty.size:
        raise CalibError(
            f"the model {bound.model.name} has no value there",
            where=f"{source}, lines {', '.join(map(str, empty[:_SHOWN]))}"
            + (f" and {empty.size - _SHOWN} more" if empty.size > _SHOWN else ""),
            allowed="conditions at which the model is defined (see its page in the documentation)",
            mend="leave these rows out, or choose another model",
        )
