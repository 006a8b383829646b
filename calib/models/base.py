"""What every model is: equations over parameter vectors, bound to reference conditions.

A `Model` holds pure functions. Binding it to calibration data fixes the *reference conditions*
(a cone index, a ground pressure, the two end pressures) about which its sampled parameters are
defined: parameters at a condition that was measured are far better conditioned than the
published coefficients, which are reported beside them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from calib.errors import CalibError

__all__ = [
    "N_WORK", "Array", "BoundModel", "Columns", "Conditions", "Model", "References", "Rows",
    "columns",
]  # fmt: skip

N_WORK = 3

type Array = NDArray[np.float64]
type References = Mapping[str, float]
type Conditions = Mapping[str, Array]
type Columns = tuple[Array, ...]
# What an equation needs of the conditions, whatever the parameters; see `Model.prepare`.
type Rows = Mapping[str, NDArray[Any]]


def columns(theta: Array) -> Columns:
    """Split parameter vectors into columns that broadcast against conditions.

    Parameters
    ----------
    theta : ndarray, shape (k, n_parameters)

    Returns
    -------
    tuple of ndarray, each of shape (k, 1)
    """
    return tuple(theta[:, j, None] for j in range(theta.shape[1]))


def _no_references(conditions: Conditions) -> dict[str, float]:
    return {}


def _as_they_are(conditions: Conditions, references: References) -> Rows:
    return conditions


@dataclass(frozen=True)
class Model:
    """A published tyre-soil equation and its well-conditioned parametrisation.

    Parameters
    ----------
    name, title, equation : str
        Identifier, heading and equation as printed, with its number in the source.
    output : str
        Canonical column that the model predicts.
    conditions : tuple of str
        Canonical columns that it needs.
    parameters : tuple of str
        The sampled parameters, in the order of `theta`.
    reported : mapping of str to str
        The published parameters and their units.
    response : {"identity", "log"}
        Scale on which the noise is additive.
    location : callable
        ``(columns, rows, references, work) -> prediction`` on the scale of the response; NaN where
        the equation has no value. Columns of shape (k, 1) with rows of shape (n,) give (k, n);
        columns of shape (1, k) with rows of shape (n, 1) give (n, k), for short data much faster.
        `work`, shape (`N_WORK`, k, n) or (`N_WORK`, n, k), is memory for temporaries and the
        result: fresh memory would cost more than the arithmetic.
    report_theta : callable
        ``(theta, references) -> {name: (k,)}``: published parameters from sampled ones.
    theta_from_reported : callable
        The inverse for one vector.
    bind_references : callable
        ``conditions -> references``.
    prepare : callable
        ``(conditions, references) -> rows``: what `location` needs of the conditions, worked out
        once for any number of parameter vectors.
    """

    name: str
    title: str
    equation: str
    output: str
    conditions: tuple[str, ...]
    parameters: tuple[str, ...]
    reported: Mapping[str, str]
    response: Literal["identity", "log"]
    location: Callable[[Columns, Rows, References, Array], Array]
    report_theta: Callable[[Array, References], dict[str, Array]]
    theta_from_reported: Callable[[Mapping[str, float], References], Array]
    bind_references: Callable[[Conditions], dict[str, float]] = _no_references
    prepare: Callable[[Conditions, References], Rows] = _as_they_are

    def bind(self, conditions: Conditions) -> BoundModel:
        """Fix the reference conditions to those of calibration data."""
        return BoundModel(self, self.bind_references(self.select(conditions)))

    def select(self, conditions: Conditions) -> dict[str, Array]:
        """Return the columns this model needs.

        Raises
        ------
        CalibError
            If one is missing.
        """
        missing = [name for name in self.conditions if name not in conditions]
        if missing:
            raise CalibError(
                f"model {self.name} needs {', '.join(missing)}, which the data do not have",
                allowed=f"columns {', '.join(self.conditions)} (in any known unit)",
                mend=f"add the column, or see `calib template {self.name}` for an example",
            )
        return {name: conditions[name] for name in self.conditions}


@dataclass(frozen=True)
class BoundModel:
    """A model with its reference conditions."""

    model: Model
    references: References

    def location(self, theta: Array, conditions: Conditions, rows: Rows | None = None) -> Array:
        """Predict on the scale of the response, shape (k, n); rows if prepared before."""
        with np.errstate(all="ignore"):
            theta = np.atleast_2d(theta)
            k = max([len(theta)] + [len(v) for v in conditions.values() if v.ndim > 1])
            work = np.empty((N_WORK, k, next(iter(conditions.values())).shape[-1]))
            rows = self.model.prepare(conditions, self.references) if rows is None else rows
            return self.model.location(columns(theta), rows, self.references, work)

    def prepare(self, conditions: Conditions) -> Rows:
        """Work out what the equation needs of conditions."""
        with np.errstate(all="ignore"):
            return self.model.prepare(conditions, self.references)

    def predict(self, theta: Array, conditions: Conditions) -> Array:
        """Predict the output in its canonical unit, shape (k, n)."""
        return self.from_response(self.location(theta, conditions))

    def to_response(self, output: Array) -> Array:
        """Map outputs to the scale on which the noise is additive."""
        return np.log(output) if self.model.response == "log" else np.asarray(output)

    def from_response(self, location: Array) -> Array:
        """Map the scale of the response back to the output."""
        return np.exp(location) if self.model.response == "log" else location

    def report(self, theta: Array) -> dict[str, Array]:
        """Return the published parameters of each vector, each of shape (k,)."""
        # A published coefficient may be beyond all numbers where the sampled ones are not.
        with np.errstate(all="ignore"):
            return self.model.report_theta(np.atleast_2d(theta), self.references)

    def theta(self, reported: Mapping[str, float]) -> Array:
        """Return the sampled parameters of published ones, shape (d,)."""
        return self.model.theta_from_reported(reported, self.references)
