"""What every model is: an equation over named parameters and conditions, and what is known of it.

Binding a model to calibration data fixes the *reference conditions* (a cone index, a ground
pressure, the two end pressures) about which its sampled parameters are defined: parameters at a
condition that was measured are far better conditioned than the published coefficients, which are
reported beside them.
"""

from __future__ import annotations

import tomllib
import traceback
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields
from functools import partial
from typing import Any, Literal, NamedTuple
from unicodedata import normalize

import numpy as np
from numpy.typing import NDArray

from calib.batch.user_code import call
from calib.data.files import TOML_HINT
from calib.data.quantities import OUTPUTS, QUANTITIES, convert, real_array
from calib.errors import CalibError

type Array = NDArray[np.float64]
type References = Mapping[str, float]
type Conditions = Mapping[str, Array]
type Parameters = Mapping[str, Any]


class Alone(NamedTuple):
    """A simpler model to be fitted at each value of a condition, some of its parameters held."""

    column: str
    model: str
    fixed: dict[str, float]


def no_references(conditions: Conditions) -> dict[str, float]:
    """Bind no reference conditions."""
    return {}


def as_they_are(references: References, /, **parameters: Any) -> Parameters:
    """Publish parameters as they are sampled."""
    return parameters


@dataclass(frozen=True)
class Model:
    """An equation that predicts an output from conditions, and all that is known of it.

    A model of one's own needs `name`, `title`, `output`, `conditions`, `parameters`, `predict`,
    `priors` and, for a template and simulation-based calibration, an `example`. Of the shipped
    models all but the functions is in their cards (`calib.models.card`).

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
        ``(theta (k, d), conditions) -> (k, n)``: the output in its canonical unit; NaN where the
        equation has no value. Conditions are of shape (n,), or (k, n) where each vector has its
        own; a function that does not broadcast these is called vector by vector.
    reported : mapping of str to str
        The published parameters and their units; the sampled ones by default, without units.
    meanings : mapping of str to str
        What sampled and published parameters are, in words.
    response : {"identity", "log"}
        Scale on which the noise is additive.
    latex : tuple of str
        The equation, as words with mathematics between dollars, and where it helps its parts.
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
        A simpler model, for point estimates at each value of a condition beside the joint ones.
    searched : mapping of str to (float, float)
        Published parameters that population methods search, in the place of the sampled ones in
        the same places, and their bounds: multiples of the largest output if in its unit.
    estimates_all_rows : bool
        Whether point estimates are from all rows, those held out among them, as published.
    mean_response : callable, optional
        In the place of `predict`, on the scale of the response: ``(conditions, **parameters) ->
        (k, n)``, conditions as above with the references among them, parameters (k, 1) by name.
    to_reported : callable
        ``(references, **sampled) -> published``: published parameters by name from sampled ones.
    from_reported : callable
        The inverse, ``(references, **published) -> sampled``.
    bind_references : callable
        ``conditions -> references``.
    joined : (str, str, str), optional
        Two parameters and a condition that multiplies the second: where it varies little, the data
        determine only their sum, which is sampled together with their ratio.
    slow : bool
        Whether its posterior takes minutes: `calib sbc` asks for many, and for this one by name.
    uncertain : callable, optional
        Of a prediction that is known with an error of its own (an emulator's): ``(theta (k, d),
        conditions (n,)) -> prediction (k, n), variance (k,), curves (n, j)`` on the scale of the
        response, the error being the curves times independent normals of that variance.
    whole : callable, optional
        What models of several outputs have in common: ``(conditions, **parameters) -> anything``,
        which `mean_response` then takes as its only argument. A joint fit calls it once for all.
    """

    name: str
    title: str
    output: str
    conditions: tuple[str, ...]
    parameters: tuple[str, ...]
    predict: Callable[[Array, Conditions], Array] | None = None
    reported: Mapping[str, str] = field(default_factory=dict)
    meanings: Mapping[str, str] = field(default_factory=dict)
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
    searched: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    estimates_all_rows: bool = False
    mean_response: Callable[..., Array] | None = None
    to_reported: Callable[..., Parameters] = as_they_are
    from_reported: Callable[..., Parameters] = as_they_are
    bind_references: Callable[[Conditions], dict[str, float]] = no_references
    joined: tuple[str, str, str] | None = None
    slow: bool = False
    uncertain: Callable[[Array, Conditions], tuple[Array, Array, Array]] | None = None
    whole: Callable[..., Any] | None = None
    # Whether `predict` takes conditions of each vector's own; None until it was tried.
    _broadcasts: bool | None = field(default=None, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not self.reported:
            object.__setattr__(self, "reported", dict.fromkeys(self.parameters, "1"))

    @property
    def equation(self) -> str:
        """The equation as plain text, with its number in the source."""
        from calib.models.card import text

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
        return partial(Model, **{f.name: getattr(self, f.name) for f in fields(self) if f.init}), ()

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

    def mean_response(self, theta: Array, conditions: Conditions) -> Array:
        """Predict on the scale of the response, shape (k, n).

        Parameters are of shape (k, d), conditions of shape (n,) or, of each vector's own, (k, n).
        """
        theta = np.atleast_2d(theta)
        own = {name: v for name, v in conditions.items() if v.ndim > 1}
        k = max([len(theta), *map(len, own.values())])
        if self.model.slow and k > 1:
            # Finite differences repeat many vectors.
            each = [np.broadcast_to(v, (k, v.shape[1])) for v in (theta, *own.values())]
            _, first, again = np.unique(
                np.concatenate(each, axis=1), axis=0, return_index=True, return_inverse=True
            )
            theta, *rest = (v[first] for v in each)
            conditions = {**conditions, **dict(zip(own, rest, strict=True))}
            return self._evaluate(theta, conditions)[again]
        return self._evaluate(theta, conditions)

    def _evaluate(self, theta: Array, conditions: Conditions) -> Array:
        with np.errstate(all="ignore"):
            if self.model.mean_response is None:
                return _predicted(self.model, theta, conditions)
            if self.model.whole is not None:
                return self.part(self.call(self.model.whole, theta, conditions))
            return np.asarray(self.call(self.model.mean_response, theta, conditions))

    def call(self, function: Callable[..., Any], theta: Array, conditions: Conditions) -> Any:
        """Call a function of conditions, references and parameters by name, (k, 1)."""
        named = dict(zip(self.model.parameters, theta.T[:, :, None], strict=True))
        return function({**conditions, **self.references}, **named)

    def part(self, whole: Any) -> Array:
        """Return the mean response that the model's `whole` holds."""
        return np.asarray(self.model.mean_response(whole))  # type: ignore[misc]

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
        named = dict(zip(self.model.parameters, np.atleast_2d(theta).T, strict=True))
        # Published coefficients may overflow where the sampled ones do not.
        with np.errstate(all="ignore"):
            found = self.model.to_reported(self.references, **named)
        return {name: found[name] for name in self.model.reported}

    def theta(self, reported: Parameters) -> Array:
        """Return the sampled parameters of published ones, (d,), or (k, d) of arrays (k,)."""
        published = {p: v for p, v in reported.items() if p in self.model.reported}
        found = self.model.from_reported(self.references, **published)
        columns = [np.asarray(found[p], dtype=np.float64) for p in self.model.parameters]
        return np.stack(np.broadcast_arrays(*columns), axis=-1)


def _predicted(model: Model, theta: Array, conditions: Conditions) -> Array:
    """Return the mean response by `predict`, (k, n)."""
    shape = np.broadcast_shapes(*(v.shape for v in conditions.values()))
    if len(shape) == 1:
        return _called(model, theta, conditions)
    k = max(len(theta), shape[0])
    theta = np.broadcast_to(theta, (k, theta.shape[1]))
    own = {name: np.broadcast_to(v, (k, shape[1])) for name, v in conditions.items()}
    if k > 1 and _broadcasts(model, theta[:2], {name: v[:2] for name, v in own.items()}):
        return _called(model, theta, own)
    return _each(model, theta, own)


def _each(model: Model, theta: Array, own: Conditions) -> Array:
    """Evaluate vector by vector, conditions (k, n) of each vector's own."""
    rows = [{name: v[i] for name, v in own.items()} for i in range(len(theta))]
    return np.concatenate([_called(model, theta[i : i + 1], at) for i, at in enumerate(rows)])


def _broadcasts(model: Model, theta: Array, own: Conditions) -> bool:
    """Whether `predict` gives two vectors with conditions of their own what it gives each."""
    known = getattr(model.predict, "broadcasts", model._broadcasts)
    if known is None:
        try:
            together = _called(model, theta, own)
            known = np.allclose(together, _each(model, theta, own), 1e-12, 0.0, equal_nan=True)
        except CalibError:
            known = False
        object.__setattr__(model, "_broadcasts", bool(known))
    return bool(known)


def _called(model: Model, theta: Array, conditions: Conditions) -> Array:
    """Call `predict` and check what it returns; a CalibError names the line that fails."""
    if model.predict is None:
        raise CalibError(
            f"the model {model.name} has no predict",
            expected="predict(theta (k, d), conditions) -> (k, n)",
            hint="declare it with a function that predicts its output",
        )
    # Copies, as a function may change its arguments.
    handed = theta.copy(), {name: v.copy() for name, v in conditions.items()}
    try:
        given = call(model.predict, *handed)
    except CalibError:
        raise
    except (Exception, SystemExit) as error:  # of the user's own code
        frame = traceback.extract_tb(error.__traceback__)[-1]
        raise CalibError(
            f"predict of the model {model.name} fails: {type(error).__name__}: {error}",
            where=f"{frame.filename}, line {frame.lineno}",
            expected=f"conditions {', '.join(model.conditions)}; parameters in columns of "
            f"theta (k, {len(model.parameters)})",
            hint="correct the function",
        ) from error
    try:
        found = real_array(given, QUANTITIES[model.output].unit)
    except CalibError as error:
        raise error.within(f"predict of the model {model.name}") from None
    n = next(iter(conditions.values())).shape[-1]
    if found.shape != (theta.shape[0], n):
        raise CalibError(
            f"predict of the model {model.name} returned the shape {found.shape}",
            expected=f"(vectors, rows) = ({theta.shape[0]}, {n})",
            hint="theta[:, :1] is the first parameter as a column, (vectors, 1)",
        )
    return np.log(found) if model.response == "log" else found


# Dimensions of the variables in `calib.inference.io`.
DIMENSIONS = dict.fromkeys(("chain", "draw", "row"), "a dimension of the files of draws")


def check_tuple(attribute: str, given: object, where: str) -> None:
    """Refuse plain text in the place of a tuple of texts: it would be taken letter by letter."""
    if isinstance(given, list | tuple) and all(isinstance(part, str) for part in given):
        return
    hint = 'write each between quotation marks, with commas: ("a", "b")'
    if isinstance(given, str):
        literal = f'r"{given}"' if "\\" in given else f'"{given}"'
        hint = f"write {attribute} = ({literal},), with the comma"
    what = "the text " * isinstance(given, str)
    raise CalibError(
        f"{attribute} is {what}{given!r}", where=where, expected="a tuple of texts", hint=hint
    )


def check_word(name: object, what: str, where: str) -> None:
    """Check that the name of a model or a parameter is an identifier."""
    if not isinstance(name, str) or not name.isidentifier():
        raise CalibError(
            f"{name!r} is no name for a {what}",
            where=where,
            expected="letters of any script, digits and underscores, not beginning with a digit: "
            "it names columns, variables of netCDF and marks of templates too",
            hint="give it another name",
        )


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
        other = known.setdefault(normalize("NFKC", name), "")
        if other:
            raise CalibError(
                f"{what} is there twice" if other == what else f"{what} has the name of {other}",
                where=", ".join(filter(None, (where, key))),
                expected="a name for each parameter, condition and output that nothing else has: "
                f"not {', '.join(taken)}",
                hint="rename one of them",
            )
        known[normalize("NFKC", name)] = what


def check_model(model: Model) -> None:
    """Check a declaration: columns, names, priors and their units; the error says what is off."""
    try:
        _check_names_of(model)
        _check_priors(model)
    except CalibError as error:
        raise error.within(f"model {model.name!r}") from None


def _check_names_of(model: Model) -> None:
    check_word(model.name, "model", "")
    for attribute in ("parameters", "conditions", "latex"):
        check_tuple(attribute, getattr(model, attribute), "")
    for parameter in model.parameters:
        check_word(parameter, "parameter", "")
    for column in (model.output, *model.conditions):
        if column not in QUANTITIES:
            hint = "register a Quantity for it before the model"
            known = ", ".join(QUANTITIES)
            raise CalibError(f"there is no quantity {column!r}", expected=known, hint=hint)
    if QUANTITIES[model.output].role != "output":
        raise CalibError(
            f"{model.output} is no output",
            expected=", ".join(OUTPUTS.values()),
            hint='register its Quantity with role="output"',
        )
    if not model.conditions or not model.parameters:
        raise CalibError("a model needs conditions and parameters", hint="name one of each")
    derived = [name for name in model.reported if name not in model.parameters]
    given = [(name, f"the parameter {name}", "parameters") for name in model.parameters]
    given += [(name, f"the published parameter {name}", "reported") for name in derived]
    given += [(name, f"the condition {name}", "conditions") for name in model.conditions]
    given += [(model.output, f"the output {model.output}", "output")]
    check_names(DIMENSIONS | {"sigma": "the noise"}, given, "")


def _check_priors(model: Model) -> None:
    """Check that each parameter has a prior, in its unit as far as that is known."""
    if not model.priors:
        raise CalibError(
            "the model has no priors",
            expected="priors=... with the text of a prior file",
            hint="write it after the example that `calib priors magic_formula` shows",
        )
    try:
        given = tomllib.loads(model.priors).get("parameters", {})
    except tomllib.TOMLDecodeError as error:
        raise CalibError(f"its priors are not valid TOML: {error}", hint=TOML_HINT) from None
    names = (*model.parameters, "sigma")
    apart = sorted(set(names) ^ set(given))
    if apart:
        raise CalibError(
            f"its priors and its parameters differ by {', '.join(apart)}",
            expected=", ".join(names),
            hint="give a prior for each of these, and for nothing else",
        )
    wanted = {"sigma": "1" if model.response == "log" else QUANTITIES[model.output].unit}
    # Without `reported` all have the unit 1, which says nothing.
    if set(model.reported.values()) != {"1"}:
        wanted |= {name: unit for name, unit in model.reported.items() if name in model.parameters}
    for name, unit in wanted.items():
        found = given[name].get("unit") if isinstance(given[name], dict) else None
        if found is not None and not same_unit(str(found), unit):
            unit = unit.replace("**", "^").replace("dimensionless", "1")
            raise CalibError(
                f"the unit is {found!r}",
                where=f"priors, parameters.{name}.unit",
                expected=f'unit = "{unit}"',
                hint="convert the numbers to this unit",
            )


def same_unit(found: str, wanted: str) -> bool:
    """Whether two units, as prior files write them, are one."""
    pair = [("dimensionless" if u == "1" else u).replace("^", "**") for u in (found, wanted)]
    try:
        return pair[0] == pair[1] or float(convert(1.0, *pair)) == 1.0
    except CalibError:
        return False
