"""Prior files: TOML read, checked entry by entry and against the model, and turned into priors."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from importlib import resources
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError
from scipy.special import digamma, polygamma

from calib.batch.user_code import declared_in
from calib.data.files import TOML_HINT, read_text
from calib.data.quantities import QUANTITIES
from calib.errors import CalibError, in_words, meant
from calib.inference.likelihood import DEFAULT_PRIORS, IID_NORMAL, Along, Family, Noise
from calib.inference.priors import Prior, Priors
from calib.models import MODELS, get_model
from calib.models.base import same_unit
from calib.models.simulators.declaration import written

if TYPE_CHECKING:
    from calib.inference.calibration import Calibration

# Beyond these, squares and products of numbers leave the range of double precision; no quantity of
# the field comes near them. An sd of 20 on the logarithm is a factor of 5e8 to either side.
_Number = Annotated[float, Field(strict=True, ge=-1e15, le=1e15)]
_Positive = Annotated[float, Field(strict=True, gt=1e-15, le=1e15)]
_LogSd = Annotated[float, Field(strict=True, gt=1e-6, le=20.0)]


class _Entry(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    unit: str
    reason: str = Field(min_length=1)
    source: str = Field(min_length=1)
    relative_to: str | None = None
    default_reference: _Positive = 1.0
    inherited: bool = Field(
        False, description="in copies that calib keeps: the file left this prior to the model's own"
    )


class _Bounded(_Entry):
    lower: _Number | None = None
    upper: _Number | None = None


class _OnLogarithm(_Entry):
    lower: _Positive | None = None
    upper: _Positive | None = None


class _Normal(_Bounded):
    dist: Literal["normal"]
    mean: _Number
    sd: _Positive


class _LogNormal(_OnLogarithm):
    dist: Literal["lognormal"]
    median: _Positive
    sd_log: _LogSd


class _HalfNormal(_Entry):
    dist: Literal["half_normal"]
    sd: _Positive


class _Uniform(_Entry):
    dist: Literal["uniform"]
    lower: _Number
    upper: _Number


class _Gamma(_OnLogarithm):
    dist: Literal["gamma"]
    shape: _Positive
    rate: _Positive


class _Fixed(_Entry):
    dist: Literal["fixed"]
    value: _Number


_DISTS: Mapping[str, type[_Entry]] = {
    "normal": _Normal, "lognormal": _LogNormal, "half_normal": _HalfNormal, "uniform": _Uniform,
    "gamma": _Gamma, "fixed": _Fixed,
}  # fmt: skip
type PriorEntry = Annotated[
    _Normal | _LogNormal | _HalfNormal | _Uniform | _Gamma | _Fixed, Field(discriminator="dist")
]


class LikelihoodTable(BaseModel):
    """The table ``[likelihood]``."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    family: Family = "normal"
    noise_depends_on: str = ""
    correlated_along: Along = ""
    errors: dict[str, _Positive | str] | None = None
    set_points: tuple[str, ...] = ()


class PriorFileContent(BaseModel):
    """A whole prior file."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    model: str
    likelihood: LikelihoodTable = LikelihoodTable()
    parameters: dict[str, PriorEntry] = {}


NOISE_ENTRIES = TypeAdapter(dict[str, PriorEntry]).validate_python(tomllib.loads(DEFAULT_PRIORS))


def prior_of(name: str, entry: PriorEntry, source: str, references: Mapping[str, float]) -> Prior:
    """Return the prior that an entry gives; `references` as for `read_priors`.

    Raises
    ------
    CalibError
        If its bounds cross, or it is relative to no known column.
    """
    where, known = f"{source}, parameters.{name}", [q.canonical for q in QUANTITIES.values()]
    reference, text = 1.0, _words(entry)
    if entry.relative_to is not None:
        if entry.relative_to not in known:
            raise CalibError(
                f"relative_to names no known column: {entry.relative_to!r}",
                where=where,
                expected=", ".join(known),
                hint="name one of these, as the table has it in its own unit",
            )
        reference = references.get(entry.relative_to, entry.default_reference)
        text += f" x {reference:g} ({entry.relative_to})"
    loc, scale, lower, upper = _internal(entry, reference)
    gamma = (entry.shape, entry.rate) if isinstance(entry, _Gamma) else None
    if gamma is not None and name != "nu":
        found = 'dist = "gamma" is for the degrees of freedom nu of a Student-t likelihood'
        expected = "normal, lognormal, half_normal, uniform or fixed"
        raise CalibError(found, where=where, expected=expected, hint="choose one of these")
    if not lower < upper:
        found = f"lower bound {lower:g} is not below upper bound {upper:g}"
        raise CalibError(found, where=where, hint="give lower < upper")
    most_sds = 1e4  # farther out the quantiles of a normal lose their digits
    off = max(lower - loc, loc - upper)
    if off > most_sds * scale > 0.0:
        middle = "median" if isinstance(entry, _OnLogarithm) else "mean"
        raise CalibError(
            f"the bounds lie {off / scale:.3g} sds from the {middle}",
            where=where,
            expected=f"bounds within {most_sds:g} sds, and better those that hold some of the "
            "distribution",
            hint="correct the bounds, or the distribution",
        )
    return Prior(
        name, entry.unit, entry.reason, entry.source, text, isinstance(entry, _OnLogarithm), loc,
        scale, lower, upper, gamma,
    )  # fmt: skip


def _internal(entry: PriorEntry, reference: float) -> tuple[float, float, float, float]:
    """Return (loc, scale, lower, upper) of an entry in internal coordinates."""
    low, high = getattr(entry, "lower", None), getattr(entry, "upper", None)
    if isinstance(entry, _OnLogarithm):
        reference = 1.0 if isinstance(entry, _Gamma) else reference
        low, high = (x and float(np.log(x * reference)) for x in (low, high))
    else:
        low, high = (x if x is None else x * reference for x in (low, high))
    low, high = -np.inf if low is None else low, np.inf if high is None else high
    match entry:
        case _Normal(mean=mean, sd=sd):
            return mean * reference, sd * reference, low, high
        case _LogNormal(median=median, sd_log=sd_log):
            return float(np.log(median * reference)), sd_log, low, high
        case _HalfNormal(sd=sd):
            return 0.0, sd * reference, 0.0, high
        case _Uniform():
            return 0.5 * (low + high), np.inf, low, high
        case _Gamma(shape=shape, rate=rate):
            mean, variance = float(digamma(shape) - np.log(rate)), float(polygamma(1, shape))
            return mean, float(np.sqrt(variance)), low, high
        case _Fixed(value=value):
            return value * reference, 0.0, low, high


def _words(entry: PriorEntry) -> str:
    """Write an entry as its distribution with its numbers, and its bounds if there are any."""
    own = {name: value for name, value in entry if name not in _Entry.model_fields}
    dist = own.pop("dist")
    low, high = None, None
    if dist != "uniform":
        low, high = own.pop("lower", None), own.pop("upper", None)
    text = f"{dist}({', '.join(f'{value:g}' for value in own.values())})"
    if low is None and high is None:
        return text
    return f"{text} on [{-np.inf if low is None else low:g}, {np.inf if high is None else high:g}]"


def _likeliest(error: ValidationError) -> Any:
    """Return the error to tell: of a misspelt key, by which another is missing, its name."""
    errors = error.errors()
    return next((e for e in errors if e["type"] == "extra_forbidden"), errors[0])


def _no_such_key(key: object, known: Iterable[str], where: str) -> CalibError:
    """Return the refusal of a key that is not `known`."""
    return CalibError(
        f"there is no key {str(key)!r}", where=where, expected=", ".join(known),
        hint=meant(str(key), known, "correct it, or take it out"),
    )  # fmt: skip


def _explain(error: ValidationError, source: str) -> CalibError:
    """Return what pydantic found in a prior file as this package says it."""
    first = _likeliest(error)
    place = [str(part) for part in first["loc"]]
    found, where = in_words(first), f"{source}, {'.'.join(place)}"
    expected, hint = (
        "dist = normal (mean, sd > 0), lognormal (median > 0, sd_log > 0), half_normal (sd > 0), "
        "uniform (lower < upper) or fixed (value); of nu also gamma (shape > 0, rate > 0); each "
        "with unit, reason, source",
        "correct this entry",
    )
    if first["type"] == "extra_forbidden" and place[0] == "parameters":
        _, name, dist, key = place
        return _no_such_key(key, _DISTS[dist].model_fields, f"{source}, parameters.{name}")
    if first["type"].startswith("union_tag"):
        dist = first["input"].get("dist")
        found = "there is no dist" if dist is None else f"there is no distribution {dist!r}"
        expected, hint = ", ".join(_DISTS), meant(str(dist), _DISTS, "choose one of these")
    elif first["type"] == "float_type":
        where = f"{source}, parameters.{place[1]}"
        expected, hint = f"a number, as in {place[-1]} = 0.75", "write a number without quotes"
    return CalibError(found, where=where, expected=expected, hint=hint)


@dataclass(frozen=True)
class DeclaredPriors:
    """Priors that a model or an effect declares as text, read as a file is.

    `place` is where a user finds them, if that is no file of this name.
    """

    name: str
    text: str
    place: str = ""

    def read_text(self, encoding: str | None = None) -> str:
        """Return the text."""
        return self.text

    def read_bytes(self) -> bytes:
        """Return the text as bytes."""
        return self.text.encode()

    def is_file(self) -> bool:
        """Whether it can be read: always."""
        return True

    def __str__(self) -> str:
        return self.name


# A prior file on disk, or priors that are read like one.
type PriorFile = Path | DeclaredPriors


def declared_priors(what: str, name: str, text: str, declared: object) -> DeclaredPriors:
    """Return the priors of a model or an effect that `declared`, a function or class, is of."""
    place = ", ".join(filter(None, (declared_in(declared), f"priors of the {what} {name}")))
    return DeclaredPriors(f"{name}.toml", text, place)


def default_priors(model_name: str) -> PriorFile:
    """Return a model's priors: those it declares, else the file that is shipped."""
    known = MODELS.get(model_name)
    if known is not None and known.priors:
        return declared_priors("model", model_name, known.priors, known.predict)
    return _shipped() / f"{model_name}.toml"


@cache
def _shipped() -> Path:
    packaged = Path(str(resources.files("calib"))) / "_priors"
    # An editable install has no packaged copy: the priors then lie beside the package.
    return packaged if packaged.is_dir() else Path(__file__).resolve().parents[2] / "priors"


def prior_file_model(path: Path) -> str:
    """Return the model that a prior file says it is for.

    Raises
    ------
    CalibError
        If the file cannot be read or names none.
    """
    model = _content(_text(Path(path)), str(path)).get("model")
    if not isinstance(model, str):
        found, hint = (
            "the prior file does not say which model it is for",
            "add this line at its top",
        )
        raise CalibError(found, where=str(path), expected='model = "NAME"', hint=hint)
    return model


def read_priors(
    path: PriorFile, model_name: str, parameters: Sequence[str], references: Mapping[str, float]
) -> Priors:
    """Read and check a prior file.

    Parameters
    ----------
    path : Path or PriorFile
        TOML file with ``model`` and tables ``parameters.NAME``; what it leaves out is taken from
        the model's own priors (see `whole_text`).
    model_name : str
        The model it must be for.
    parameters : sequence of str
        The parameters it is to give, in order; of a model the noise scale ``sigma`` last. Those of
        the noise that the file chooses are put before it, and have default priors.
    references : mapping of str to float
        Values of the columns that priors may be relative to, as `prior_references` returns them.

    Raises
    ------
    CalibError
        If the file is missing, is not TOML, or gives unknown, missing or impossible entries.
    """
    place = path.place if isinstance(path, DeclaredPriors) else ""
    text = whole_text(path, model_name)
    priors = parse_priors(text, place or str(path), model_name, parameters, references)
    return replace(priors, source=str(path)) if place else priors


def whole_text(path: PriorFile, model_name: str) -> str:
    """Return the text of a prior file, with the model's own priors of what it leaves out.

    These are marked as inherited. What cannot be completed is returned as it is: parsing it tells
    what is wrong.
    """
    text, own = _text(path), default_priors(model_name)
    if not own.is_file():
        return text
    with suppress(tomllib.TOMLDecodeError):
        content = _parsed(text)
        given, others = content.get("parameters", {}), _parsed(read_text(own)).get("parameters")
        if not (isinstance(given, dict) and isinstance(others, dict)):
            return text
        if content.get("model") != model_name:
            return text
        if given.keys() - others.keys() - NOISE_ENTRIES.keys():  # misspelt, probably
            return text
        tables = [
            written(name, entry | {"inherited": True})
            for name, entry in others.items()
            if name not in given
        ]
        whole = "\n".join([text.rstrip("\n") + "\n", *tables])
        _parsed(whole)  # an inline table of parameters takes no more of them
        return whole if tables else text
    return text


def priors_from_posterior(model_name: str, calibration: Calibration, run: str) -> str:
    """Return a prior file that sets what a posterior says of a model's parameters.

    Those of the same name, unit and meaning, each by itself: the posterior's correlations are lost,
    so the prior is wider than the posterior. The family is that of the model's own prior.

    Parameters
    ----------
    model_name : str
    calibration : Calibration
        Of another model, whose sampled and published parameters are looked at.
    run : str
        What its run is called.

    Raises
    ------
    CalibError
        If the posterior did not converge, or says nothing of any parameter.
    """
    other, model = calibration.problem.bound.model, get_model(model_name)
    entries = _parsed(_text(default_priors(model_name)))["parameters"]
    if not calibration.converged:
        raise CalibError(
            "the posterior did not converge, and is no prior", where=run,
            expected="a run that converged", hint="raise --max-steps, and fit again",
        )  # fmt: skip
    found = []
    for name, entry in entries.items():
        summary = calibration.summary.get(name)
        if summary is None or name == "sigma" or not same_unit(summary.unit, entry["unit"]):
            continue
        if model.meanings.get(name) != other.meanings.get(name):
            continue
        draws = calibration.parameters[name]
        if entry["dist"] == "lognormal" and (draws > 0.0).all():
            logs = np.log(draws)
            about = {"median": float(np.exp(logs.mean())), "sd_log": float(logs.std())}
        else:
            about = {"mean": float(draws.mean()), "sd": float(draws.std())}
        kind = "lognormal" if "median" in about else "normal"
        bounds = {k: entry[k] for k in ("lower", "upper") if k in entry}
        if kind != entry["dist"]:
            bounds.setdefault("lower", 0.0)  # a logarithm has values above it only
        rows = len(calibration.problem.table)
        said = {"reason": f"Posterior of {other.name} on {rows} rows", "source": run}
        numbers = {k: float(f"{v:.6g}") for k, v in about.items()}
        whole = {"dist": kind, **numbers, **bounds, "unit": entry["unit"], **said}
        found.append(written(name, whole))
    if not found:
        raise CalibError(
            f"{other.name} has no parameter of {model_name}: none of the same name, unit and "
            "meaning", where=run, expected=f"some of {', '.join(entries)}",
            hint="compare their parameters (`calib models`)",
        )  # fmt: skip
    return "\n".join([f'model = "{model_name}"', "", *found])


def _inherited(text: str) -> dict[str, Any]:
    """Return the entries that a whole text has from the model's own priors, without their mark."""
    return {
        name: {key: value for key, value in entry.items() if key != "inherited"}
        for name, entry in _parsed(text)["parameters"].items()
        if entry.get("inherited")
    }


def inherited_otherwise(text: str, model_name: str) -> list[str]:
    """Return the parameters whose priors in a whole text are no longer the model's own."""
    left = _inherited(text)
    own = _parsed(read_text(default_priors(model_name)))["parameters"] if left else {}
    return [name for name, entry in left.items() if own.get(name) != entry]


def inheritance_note(priors: Priors, model_name: str) -> str:
    """Say which priors a file sets and whose the others are; empty if it sets all."""
    entries, left = _parsed(priors.text)["parameters"], _inherited(priors.text)
    if not left:
        return ""
    own = ", ".join(name for name in entries if name not in left)
    whose = "shipped ones" if isinstance(default_priors(model_name), Path) else "model's own"
    file = PurePath(priors.source).name
    if not own:
        return f"{file} sets no prior; all are the {whose}"
    return f"{file} sets the prior of {own}; those of {', '.join(left)} are the {whose}"


def _text(path: PriorFile) -> str:
    try:
        return read_text(path)
    except (OSError, UnicodeDecodeError) as error:
        found = f"the prior file cannot be read ({error})"
        hint = "give the path of a readable TOML file"
        raise CalibError(found, where=str(path), hint=hint) from None


def _content(text: str, source: str) -> dict[str, Any]:
    try:
        return _parsed(text)
    except tomllib.TOMLDecodeError as error:
        found = f"the prior file is not valid TOML: {error}"
        raise CalibError(found, where=source, hint=TOML_HINT) from None


@lru_cache(maxsize=64)
def _parsed(text: str) -> dict[str, Any]:
    """What a text says, which a diagnosis asks of the same few again and again; not to change."""
    return tomllib.loads(text)


def relative_columns(text: str) -> dict[str, float]:
    """Return the columns that priors are relative to, and what is assumed without one."""
    entries = _parsed(text)["parameters"].values()
    return {
        e["relative_to"]: float(e.get("default_reference", 1.0))
        for e in entries
        if "relative_to" in e
    }


def parse_priors(
    text: str,
    source: str,
    model_name: str,
    parameters: Sequence[str],
    references: Mapping[str, float],
) -> Priors:
    """Check the text of a prior file; see `read_priors`."""
    content = _content(text, source)
    # A misspelt name is reported before its content: it is the likelier mistake.
    if unknown := [key for key in content if key not in PriorFileContent.model_fields]:
        raise _no_such_key(unknown[0], PriorFileContent.model_fields, source)
    noise = _noise_choice(content, source, parameters)
    _check_names(content, source, model_name, parameters, noise.parameters)
    try:
        file = PriorFileContent.model_validate(content)
    except ValidationError as error:
        raise _explain(error, source) from None
    _check_units(file, source, model_name)
    given = NOISE_ENTRIES | file.parameters
    names = (*parameters[:-1], *noise.parameters, *parameters[-1:])
    entries = tuple(prior_of(name, given[name], source, references) for name in names)
    for prior in entries[len(parameters) - 1 : -1]:
        _check_noise(prior, source)
    return Priors(entries, text, source, noise)


def _check_noise(prior: Prior, source: str) -> None:
    """Check the range of a parameter of the noise."""
    low, high = (prior.loc, prior.loc) if prior.fixed else (prior.lower, prior.upper)
    low, high = np.exp([low, high]) if prior.log else (low, high)
    if prior.name == "nu" and not (prior.log or low > 0.0):
        found = f"degrees of freedom of {low:g} are admitted"
        allowed = "a prior of what is above 0: gamma, lognormal, or with a lower bound > 0"
    elif prior.name == "rho" and not 0.0 <= low <= high < 1.0:
        found = f"correlations from {low:g} to {high:g} are admitted"
        allowed = "a prior with bounds of at least 0 and below 1"
    else:
        return
    raise CalibError(
        found, where=f"{source}, parameters.{prior.name}", expected=allowed,
        hint="correct this entry",
    )  # fmt: skip


def _noise_choice(content: Mapping[str, Any], source: str, parameters: Sequence[str]) -> Noise:
    """Return what the table ``[likelihood]`` says."""
    if "likelihood" not in content:
        return IID_NORMAL
    where = f"{source}, [likelihood]"
    if parameters[-1] != "sigma":
        raise CalibError(
            "an effect has no likelihood of its own", where=where, hint="take the table out"
        )
    try:
        chosen = LikelihoodTable.model_validate(content["likelihood"])
    except ValidationError as error:
        first = _likeliest(error)
        if first["type"] == "extra_forbidden":
            raise _no_such_key(first["loc"][-1], LikelihoodTable.model_fields, where) from None
        raise CalibError(
            in_words(first), where=where,
            expected='family = "normal" or "student_t", noise_depends_on = "slip" or another '
            'condition of the model, correlated_along = "run_order", errors = {slip_percent = 1.5} '
            'or = {slip = "slip_percent_sd"}, set_points = ["slip"]',
            hint="correct this entry",
        ) from None  # fmt: skip
    stated = None if chosen.errors is None else tuple(chosen.errors.items())
    noise = Noise(
        chosen.family, chosen.noise_depends_on, chosen.correlated_along,
        stated=stated, set_points=chosen.set_points,
    )  # fmt: skip
    if noise.correlated_along and noise.family != "normal":
        raise CalibError(
            "noise that is correlated along a run is normal", where=where,
            expected='family = "normal"', hint="take one of the two out",
        )  # fmt: skip
    taken = [name for name in noise.parameters if name in parameters]
    if taken:
        raise CalibError(
            f"the model has a parameter {taken[0]}, which is the noise's name for one of its own",
            where=where, hint="rename it in the model, or take the table out",
        )  # fmt: skip
    return noise


def _check_names(
    content: Mapping[str, Any], source: str, model_name: str, parameters: Sequence[str],
    of_noise: Sequence[str],
) -> None:  # fmt: skip
    if content.get("model") != model_name:
        named = f"model {content['model']!r}" if "model" in content else "no model"
        raise CalibError(
            f"the priors are for {named}, not {model_name!r}",
            where=source,
            expected=f'model = "{model_name}"',
            hint="pass the prior file of this model",
        )
    given = content.get("parameters")
    given = given if isinstance(given, Mapping) else {}
    unknown = [name for name in given if name not in (*parameters, *of_noise)]
    left = [name for name in parameters if name not in given]
    missing = [] if unknown and default_priors(model_name).is_file() else left
    if unknown or missing:
        kinds = (("unknown parameter", unknown), ("missing parameter", missing))
        found = "; ".join(f"{what} {', '.join(names)}" for what, names in kinds if names)
        meanings = ((name, meant(name, left, "")) for name in unknown)
        guesses = "".join(f"{name}: {guess} " for name, guess in meanings if guess)
        raise CalibError(
            found,
            where=f"{source}, [parameters]",
            expected=", ".join(parameters),
            hint=f"{guesses}give all of these, each as a table [parameters.NAME]"
            if missing
            else f"{guesses}correct the name, or take it out",
        )


def _check_units(file: PriorFileContent, source: str, model_name: str) -> None:
    """A prior in another unit would silently be taken for one in the model's."""
    shipped = default_priors(model_name)
    if not shipped.is_file():
        return
    units = {
        name: entry.get("unit")
        for name, entry in _parsed(shipped.read_text(encoding="utf-8"))["parameters"].items()
    } | {name: entry.unit for name, entry in NOISE_ENTRIES.items()}
    for name, entry in file.parameters.items():
        if name in units and entry.unit != units[name]:
            raise CalibError(
                f"the unit is {entry.unit!r}",
                where=f"{source}, parameters.{name}",
                expected=f"unit = {units[name]!r}",
                hint="convert the numbers to this unit",
            )
