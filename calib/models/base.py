"""What every model is: equations over parameter vectors, bound to reference conditions.

A `Model` holds pure functions. Binding it to calibration data fixes the *reference conditions*
(a cone index, a ground pressure, the two end pressures) about which its sampled parameters are
defined: parameters at a condition that was measured are far better conditioned than the
published coefficients, which are reported beside them.
"""

from __future__ import annotations

import tomllib
import traceback
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields
from functools import partial
from typing import Any, Literal
from unicodedata import normalize

import numpy as np
from numpy.typing import NDArray

from calib.batch.user_code import call
from calib.data.files import MEND_TOML, real_array
from calib.data.quantities import OUTPUTS, QUANTITIES, convert
from calib.errors import CalibError
from calib.models.latex import text

type Array = NDArray[np.float64]
type References = Mapping[str, float]
type Conditions = Mapping[str, Array]
type Columns = tuple[Array, ...]
# The part of an equation that depends on the conditions alone; see `Model.prepare`.
type Rows = Mapping[str, NDArray[Any]]


def columns(theta: Array) -> Columns:
    """Split parameter vectors (k, d) into columns (k, 1), to broadcast against conditions."""
    return tuple(theta[:, j, None] for j in range(theta.shape[1]))


def _no_references(conditions: Conditions) -> dict[str, float]:
    return {}


def not_given(*_: Any) -> Any:
    """Stand for a function that `Model` fills in."""
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
        # Each vector has conditions of its own. Most functions broadcast them, which is faster.
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
                expected="predict(theta (k, d), conditions) -> (k, n)",
                hint="declare it with a function that predicts its output",
            )
        # Copies, as a function may change its arguments.
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
                expected=f"conditions {', '.join(self.model.conditions)}; parameters in columns of "
                f"theta (k, {len(self.model.parameters)})",
                hint="correct the function",
            ) from error
        try:
            found = real_array(given, QUANTITIES[self.model.output].unit)
        except CalibError as error:
            raise error.within(f"predict of the model {self.model.name}") from None
        n = next(iter(rows.values())).shape[-1]
        if found.shape != (theta.shape[0], n):
            raise CalibError(
                f"predict of the model {self.model.name} returned the shape {found.shape}",
                expected=f"(vectors, rows) = ({theta.shape[0]}, {n})",
                hint="theta[:, :1] is the first parameter as a column, (vectors, 1)",
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
    """A simpler model, fitted to each value of a condition, to compare with a joint one.

    Some of its parameters are held.
    """

    column: str
    model: str
    fixed: Mapping[str, float]


@dataclass(frozen=True)
class Model:
    """An equation that predicts an output from conditions, and all that is known of it.

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
        What its letters mean that are not parameters, with marks of `calib.report.markup`.
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
        Two parameters and a condition that multiplies the second: where it varies little, the data
        determine only their sum, which is sampled together with their ratio.
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
        # A registered model is pickled by name, as its functions may not be picklable.
        from calib.models import MODELS, get_model

        if MODELS.get(self.name) is self:
            return get_model, (self.name,)
        return partial(Model, **{f.name: getattr(self, f.name) for f in fields(self)}), ()

    def register(self) -> None:
        """Make it known by its name; a CalibError if the declaration does not hold together."""
        from calib.models import MODELS

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
                expected=f"columns {', '.join(self.conditions)} (in any known unit)",
                hint=f"add the column, or see `calib template {self.name}` for an example",
            )
        return {name: conditions[name] for name in self.conditions}


@dataclass(frozen=True)
class BoundModel:
    """A model with its reference conditions."""

    model: Model
    references: References

    def mean_response(
        self, theta: Array, conditions: Conditions, rows: Rows | None = None
    ) -> Array:
        """Predict on the scale of the response, shape (k, n); rows if prepared before."""
        with np.errstate(all="ignore"):
            theta = np.atleast_2d(theta)
            k = max([len(theta)] + [len(v) for v in conditions.values() if v.ndim > 1])
            if self.model.slow and k > 1:
                # Finite differences repeat many vectors.
                own = {name: v for name, v in conditions.items() if v.ndim > 1}
                each = [np.broadcast_to(v, (k, v.shape[1])) for v in (theta, *own.values())]
                _, first, again = np.unique(
                    np.concatenate(each, axis=1), axis=0, return_index=True, return_inverse=True
                )
                if first.size < k:
                    theta, *rest = (v[first] for v in each)
                    conditions = {**conditions, **dict(zip(own, rest, strict=True))}
                    return self.mean_response(theta, conditions, None if own else rows)[again]
            rows = self.model.prepare(conditions, self.references) if rows is None else rows
            return self.model.mean_response(columns(theta), rows, self.references)

    def prepare(self, conditions: Conditions) -> Rows:
        """Work out what the equation needs of conditions."""
        with np.errstate(all="ignore"):
            return self.model.prepare(conditions, self.references)

    def predict(self, theta: Array, conditions: Conditions) -> Array:
        """Predict the output in its canonical unit, shape (k, n)."""
        return self.from_response(self.mean_response(theta, conditions))

    def to_response(self, output: Array) -> Array:
        """Map outputs to the scale on which the noise is additive."""
        return np.log(output) if self.model.response == "log" else np.asarray(output)

    def from_response(self, location: Array) -> Array:
        """Map the scale of the response back to the output; infinite where no float holds it."""
        with np.errstate(over="ignore"):
            return np.exp(location) if self.model.response == "log" else location

    def report(self, theta: Array) -> dict[str, Array]:
        """Return the published parameters of each vector, each of shape (k,)."""
        # Published coefficients may overflow where the sampled ones do not.
        with np.errstate(all="ignore"):
            return self.model.report_theta(np.atleast_2d(theta), self.references)

    def theta(self, reported: Mapping[str, float]) -> Array:
        """Return the sampled parameters of published ones, shape (d,)."""
        return self.model.theta_from_reported(reported, self.references)


_ONE = "dimensionless"
# Dimensions of the variables in `calib.inference.io`.
DIMENSIONS = dict.fromkeys(("chain", "draw", "row"), "a dimension of the files of draws")


def check_tuple(attribute: str, given: object, where: str) -> None:
    """Refuse plain text in the place of a tuple of texts: it would be taken letter by letter."""
    if isinstance(given, str):
        raise CalibError(
            f"{attribute} is the text {given!r}", where=where, expected="a tuple of texts",
            hint=f"write {attribute} = ({_quoted(given)},), with the comma",
        )  # fmt: skip
    if not isinstance(given, list | tuple) or not all(isinstance(part, str) for part in given):
        raise CalibError(
            f"{attribute} is {given!r}", where=where, expected="a tuple of texts",
            hint='write each between quotation marks, with commas: ("a", "b")',
        )  # fmt: skip


def _quoted(given: str) -> str:
    """Return a text as a Python literal."""
    return f'r"{given}"' if "\\" in given else f'"{given}"'


def check_word(name: object, what: str, where: str) -> None:
    """Check that the name of a model or a parameter is an identifier."""
    if not isinstance(name, str) or not name.isidentifier():
        raise CalibError(
            f"{name!r} is no name for a {what}", where=where,
            expected="letters of any script, digits and underscores, not beginning with a digit: "
            "it names columns, variables of netCDF and marks of templates too",
            hint="give it another name",
        )  # fmt: skip


def check_names(
    taken: Mapping[str, str], given: Iterable[tuple[str, str, str]], where: str
) -> None:
    """Check that each name is that of one thing: files know things by their names.

    `taken` maps names of other things to what these are; `given` are names, what each names, and
    the key that says so.
    """
    # Letters with two encodings are the same.
    known = {normalize("NFKC", name): what for name, what in taken.items()}
    for name, what, key in given:
        other = known.get(normalize("NFKC", name))
        if other is not None:
            raise CalibError(
                f"{what} is there twice" if other == what else f"{what} has the name of {other}",
                where=f"{where}, {key}",
                expected="a name for each parameter, condition and output that nothing else has: "
                f"not {', '.join(taken)}",
                hint="rename one of them",
            )  # fmt: skip
        known[normalize("NFKC", name)] = what


def check_model(model: Model) -> None:
    """Check a declaration: columns, names, priors and their units; the error says what is off."""
    where = f"model {model.name!r}"
    check_word(model.name, "model", where)
    for parameter in model.parameters if not isinstance(model.parameters, str) else ():
        check_word(parameter, "parameter", where)
    for attribute in ("conditions", "parameters", "latex"):
        check_tuple(attribute, getattr(model, attribute), where)
    for column in (model.output, *model.conditions):
        if column not in QUANTITIES:
            raise CalibError(
                f"there is no quantity {column!r}", where=where, expected=", ".join(QUANTITIES),
                hint="register a Quantity for it before the model",
            )  # fmt: skip
    if QUANTITIES[model.output].role != "output":
        raise CalibError(
            f"{model.output} is no output", where=where, expected=", ".join(OUTPUTS.values()),
            hint='register its Quantity with role="output"',
        )  # fmt: skip
    if not model.conditions or not model.parameters:
        raise CalibError(
            "a model needs conditions and parameters", where=where,
            hint="name at least one of each",
        )  # fmt: skip
    names = (*model.parameters, "sigma")
    derived = [name for name in model.reported if name not in model.parameters]
    given = [(name, f"the parameter {name}", "parameters") for name in model.parameters]
    given += [(name, f"the published parameter {name}", "reported") for name in derived]
    given += [(name, f"the condition {name}", "conditions") for name in model.conditions]
    given += [(model.output, f"the output {model.output}", "output")]
    check_names(DIMENSIONS | {"sigma": "the noise"}, given, where)
    if not model.priors:
        raise CalibError(
            "the model has no priors", where=where,
            expected="priors=... with the text of a prior file",
            hint="write it after the example that `calib priors magic_formula` shows",
        )  # fmt: skip
    try:
        given = tomllib.loads(model.priors).get("parameters", {})
    except tomllib.TOMLDecodeError as error:
        raise CalibError(
            f"its priors are not valid TOML: {error}", where=where, hint=MEND_TOML
        ) from None
    apart = sorted(set(names) ^ set(given))
    if apart:
        raise CalibError(
            f"its priors and its parameters differ by {', '.join(apart)}", where=where,
            expected=", ".join(names), hint="give a prior for each of these, and for nothing else",
        )  # fmt: skip
    _check_units(model, given, where)


def _check_units(model: Model, given: dict[str, Any], where: str) -> None:
    """Refuse a prior in another unit than its parameter's, as far as that is known."""
    log = model.response == "log"
    wanted = {"sigma": "1" if log else QUANTITIES[model.output].unit}
    # Without `reported` all have the unit 1, which says nothing.
    if set(model.reported.values()) != {"1"}:
        wanted |= {name: unit for name, unit in model.reported.items() if name in model.parameters}
    for name, unit in wanted.items():
        found = given[name].get("unit") if isinstance(given[name], dict) else None
        if found is not None and not _same_unit(str(found), unit):
            raise CalibError(
                f"the unit is {found!r}", where=f"{where}, priors, parameters.{name}.unit",
                expected=f'unit = "{unit.replace("**", "^").replace(_ONE, "1")}"',
                hint="convert the numbers to this unit",
            )  # fmt: skip


def _same_unit(found: str, wanted: str) -> bool:
    found, wanted = (_ONE if u == "1" else u.replace("^", "**") for u in (found, wanted))
    try:
        return found == wanted or float(convert(1.0, found, wanted)) == 1.0
    except CalibError:
        return False
