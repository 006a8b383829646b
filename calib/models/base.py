"""What every model is: equations over parameter vectors, bound to reference conditions.

A `Model` holds pure functions. Binding it to calibration data fixes the *reference conditions*
(a cone index, a ground pressure, the two end pressures) about which its sampled parameters are
defined: parameters at a condition that was measured are far better conditioned than the
published coefficients, which are reported beside them.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from calib.batch.foreign import call
from calib.data.quantities import QUANTITIES
from calib.data.table import real_array
from calib.errors import CalibError
from calib.models.latex import text

type Array = NDArray[np.float64]
type References = Mapping[str, float]
type Conditions = Mapping[str, Array]
type Columns = tuple[Array, ...]
# What an equation needs of the conditions, whatever the parameters; see `Model.prepare`.
type Rows = Mapping[str, NDArray[Any]]


def columns(theta: Array) -> Columns:
    """Split parameter vectors (k, d) into columns (k, 1), to broadcast against conditions."""
    return tuple(theta[:, j, None] for j in range(theta.shape[1]))


def _no_references(conditions: Conditions) -> dict[str, float]:
    return {}


def not_given(*_: Any) -> Any:
    """Stand for a function of a model that is made up when the model is."""
    raise NotImplementedError


@dataclass(frozen=True)
class _Predicted:
    """The mean response of a model that declares `predict`."""

    model: Model

    def __call__(self, columns: Columns, rows: Rows, references: References) -> Array:
        theta = np.concatenate(columns, axis=1)
        shape = np.broadcast_shapes(*(v.shape for v in rows.values()))
        if len(shape) == 1:
            return self._call(theta, rows)
        # Conditions of each vector's own: many functions broadcast them, which is much faster.
        k = max(len(theta), shape[0])
        theta = np.broadcast_to(theta, (k, theta.shape[1]))
        own = {name: np.broadcast_to(v, (k, shape[1])) for name, v in rows.items()}

        def one(i: int) -> Array:
            return self._call(theta[i : i + 1], {name: v[i] for name, v in own.items()})

        first = one(0)
        try:
            found = self._call(theta, own) if k > 1 else first
            if np.allclose(found[0], first[0], 1e-12, 0.0, equal_nan=True):
                return found
        except CalibError:
            pass
        return np.concatenate([first, *(one(i) for i in range(1, k))])

    def _call(self, theta: Array, rows: Rows) -> Array:
        if self.model.predict is None:
            raise CalibError(
                f"the model {self.model.name} has no predict",
                allowed="predict(theta (k, d), conditions) -> (k, n)",
                mend="declare it with a function that predicts its output",
            )
        # Copies: what a function does to what it is handed is seen by no other call.
        handed = theta.copy(), {name: v.copy() for name, v in rows.items()}
        try:
            given = call(self.model.predict, *handed)
        except CalibError:
            raise
        except (Exception, SystemExit) as error:  # of the user's own code
            frame = traceback.extract_tb(error.__traceback__)[-1]
            raise CalibError(
                f"predict of the model {self.model.name} fails: {type(error).__name__}: {error}",
                where=f"{frame.filename}, line {frame.lineno}",
                allowed=f"conditions {', '.join(self.model.conditions)}; parameters in columns of "
                f"theta (k, {len(self.model.parameters)})",
                mend="correct the function",
            ) from error
        try:
            found = real_array(given, QUANTITIES[self.model.output].unit)
        except CalibError as error:
            raise error.within(f"predict of the model {self.model.name}") from None
        n = next(iter(rows.values())).shape[-1]
        if found.shape != (theta.shape[0], n):
            raise CalibError(
                f"predict of the model {self.model.name} returned the shape {found.shape}",
                allowed=f"(vectors, rows) = ({theta.shape[0]}, {n})",
                mend="theta[:, :1] is the first parameter as a column, (vectors, 1)",
            )
        return np.log(found) if self.model.response == "log" else found


def _by_name(names: tuple[str, ...], theta: Array, references: References) -> dict[str, Array]:
    """Report the sampled parameters as they are."""
    return dict(zip(names, theta.T, strict=True))


def _vector(names: tuple[str, ...], reported: Mapping[str, float], references: References) -> Array:
    """Return one vector of parameters by name, the inverse of `_by_name`."""
    return np.array([reported[name] for name in names])


def _as_they_are(conditions: Conditions, references: References) -> Rows:
    return conditions


@dataclass(frozen=True)
class Searched:
    """Coordinates in which population methods search a model, in the place of its prior's.

    `names` maps sampled parameters to the published ones that are searched for them, `box` is
    ``largest response -> {name: (lower, upper)}``, and `sampled` turns searched values, by name,
    into sampled ones.
    """

    names: Mapping[str, str]
    box: Callable[[float], dict[str, tuple[float, float]]]
    sampled: Callable[[dict[str, Any]], dict[str, Any]]


@dataclass(frozen=True)
class Alone:
    """A simpler model, for each value of a condition by itself, to be seen beside a joint one.

    Some of its parameters are held.
    """

    column: str
    model: str
    fixed: Mapping[str, float]


@dataclass(frozen=True)
class Model:
    """An equation that predicts an output from conditions: the only place for what is known of it.

    A model of one's own needs `name`, `title`, `output`, `conditions`, `parameters`, `predict`,
    `priors` and, for a template and simulation-based calibration, an `example`.

    Parameters
    ----------
    name, title : str
        Identifier and heading.
    output : str
        Canonical column that the model predicts.
    conditions : tuple of str
        Canonical columns that it needs.
    parameters : tuple of str
        The sampled parameters, in the order of `theta`.
    predict : callable, optional
        ``(theta (k, d), conditions) -> (k, n)``: the output in its canonical unit, from parameters
        and conditions of shape (n,) each; NaN where the equation has no value.
    reported : mapping of str to str
        The published parameters and their units; the sampled ones by default, without units.
    response : {"identity", "log"}
        Scale on which the noise is additive.
    latex : tuple of str
        The equation, in the mathematics of `calib.models.latex`, and where it helps its parts.
    letters : str
        What its letters mean that are not parameters, with marks of `calib.report.publish.markup`.
    applies : str
        When it applies, and its limits, in plain sentences.
    numbers : str
        Where its source prints it: ``"Eqs 12-15"``.
    source : str
        Whom it is after, with a DOI.
    cited : str
        Key of the source in `references.bib`, where it is there.
    parametrisation : str
        Which parameters are sampled and why these, with the reference conditions in braces.
    example : str
        A CSV of the data it is calibrated on; those of the shipped models are files in
        `calib/models/examples`.
    priors : str
        Its priors as the TOML text of a prior file, if they are not among the shipped ones.
    parabolic_in : str
        A condition in which its coefficients are parabolas, not to be trusted beyond the data.
    alone : Alone, optional
    searched : Searched, optional
    estimates_all_rows : bool
        Whether point estimates are from all rows, those held out among them, as published.
    mean_response : callable, optional
        In the place of `predict`, on the scale of the response: ``(columns, rows, references) ->
        (k, n)``, from a column (k, 1) of each parameter and rows of shape (n,) or (k, n); NaN
        where the equation has no value.
    report_theta : callable
        ``(theta, references) -> {name: (k,)}``: published parameters from sampled ones.
    theta_from_reported : callable
        The inverse for one vector.
    bind_references : callable
        ``conditions -> references``.
    prepare : callable
        ``(conditions, references) -> rows``: what `mean_response` needs of the conditions, worked
        out once for any number of parameter vectors.
    joined : (str, str, str), optional
        Two parameters and a condition by which the second is multiplied: where it varies little,
        the data know but their sum, and it is sampled with their ratio.
    slow : bool
        Whether its posterior takes minutes: `calib sbc` asks for many, and for this one by name.
    uncertain : callable, optional
        Of a prediction that is known with an error of its own (an emulator's): ``(theta (k, d),
        conditions (n,)) -> prediction (k, n), variance (k,), curves (n, j)`` on the scale of the
        response, the error being the curves times independent normals of that variance.
    """

    name: str
    title: str
    output: str
    conditions: tuple[str, ...]
    parameters: tuple[str, ...]
    predict: Callable[[Array, Conditions], Array] | None = None
    reported: Mapping[str, str] = field(default_factory=dict)
    response: Literal["identity", "log"] = "identity"
    latex: tuple[str, ...] = ()
    letters: str = ""
    applies: str = ""
    numbers: str = ""
    source: str = ""
    cited: str = ""
    parametrisation: str = "The parameters of the equation are sampled."
    example: str = ""
    priors: str = ""
    parabolic_in: str = ""
    alone: Alone | None = None
    searched: Searched | None = None
    estimates_all_rows: bool = False
    mean_response: Callable[[Columns, Rows, References], Array] = not_given
    report_theta: Callable[[Array, References], dict[str, Array]] = not_given
    theta_from_reported: Callable[[Mapping[str, float], References], Array] = not_given
    bind_references: Callable[[Conditions], dict[str, float]] = _no_references
    prepare: Callable[[Conditions, References], Rows] = _as_they_are
    joined: tuple[str, str, str] | None = None
    slow: bool = False
    uncertain: Callable[[Array, Conditions], tuple[Array, Array, Array]] | None = None

    def __post_init__(self) -> None:
        if not self.reported:
            object.__setattr__(self, "reported", dict.fromkeys(self.parameters, "1"))
        if self.mean_response is not_given:
            object.__setattr__(self, "mean_response", _Predicted(self))
        if self.report_theta is not_given:
            object.__setattr__(self, "report_theta", partial(_by_name, self.parameters))
            object.__setattr__(self, "theta_from_reported", partial(_vector, self.parameters))

    @property
    def equation(self) -> str:
        """The equation as plain text, with its number in the source."""
        written = ", ".join(text(part) for part in self.latex)
        return f"{written}  ({self.numbers})" if self.numbers else written

    @property
    def by_sampled(self) -> bool:
        """Whether the sampled parameters are those that are reported."""
        return tuple(self.reported) == self.parameters

    def __reduce__(self) -> tuple[Any, ...]:
        # By its name where it has one: another process knows it too, and what it is made of, a
        # lambda perhaps, need not travel.
        from calib.models import MODELS, get_model

        if MODELS.get(self.name) is self:
            return get_model, (self.name,)
        return partial(Model, **{f.name: getattr(self, f.name) for f in fields(self)}), ()

    def register(self) -> None:
        """Make it known by its name; a CalibError if the declaration does not hold together."""
        from calib.models import MODELS
        from calib.models.declared import check_model

        check_model(self)
        MODELS.add(self)

    def bind(self, conditions: Conditions) -> BoundModel:
        """Fix the reference conditions to those of calibration data."""
        return BoundModel(self, self.bind_references(self.select(conditions)))

    def select(self, conditions: Conditions) -> dict[str, Array]:
        """Return the columns this model needs; a CalibError names one that is missing."""
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
            if self.model.slow and k > 1:
                # Differences in turn leave most parameters as they are, those of an effect all.
                own = {name: v for name, v in conditions.items() if v.ndim > 1}
                each = [np.broadcast_to(v, (k, v.shape[1])) for v in (theta, *own.values())]
                _, first, again = np.unique(
                    np.concatenate(each, axis=1), axis=0, return_index=True, return_inverse=True
                )
                if first.size < k:
                    theta, *rest = (v[first] for v in each)
                    conditions = {**conditions, **dict(zip(own, rest, strict=True))}
                    return self.location(theta, conditions, None if own else rows)[again]
            rows = self.model.prepare(conditions, self.references) if rows is None else rows
            return self.model.mean_response(columns(theta), rows, self.references)

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
        """Map the scale of the response back to the output; infinite where no float holds it."""
        with np.errstate(over="ignore"):
            return np.exp(location) if self.model.response == "log" else location

    def report(self, theta: Array) -> dict[str, Array]:
        """Return the published parameters of each vector, each of shape (k,)."""
        # A published coefficient may be beyond all numbers where the sampled ones are not.
        with np.errstate(all="ignore"):
            return self.model.report_theta(np.atleast_2d(theta), self.references)

    def theta(self, reported: Mapping[str, float]) -> Array:
        """Return the sampled parameters of published ones, shape (d,)."""
        return self.model.theta_from_reported(reported, self.references)
