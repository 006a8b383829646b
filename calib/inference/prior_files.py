"""Prior files: TOML read, checked against the model, and turned into priors."""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError
from scipy.special import digamma, polygamma

from calib.batch.plugins import declared_in
from calib.data.quantities import QUANTITIES
from calib.errors import CalibError
from calib.inference.noise import DEFAULT_PRIORS, USUAL, Along, Family, NoiseChoice
from calib.inference.priors import Prior, Priors
from calib.models import MODELS

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
type _AnyEntry = Annotated[
    _Normal | _LogNormal | _HalfNormal | _Uniform | _Gamma | _Fixed, Field(discriminator="dist")
]


class _Likelihood(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)
    family: Family = "normal"
    noise_depends_on: str = ""
    correlated_along: Along = ""


class _File(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)
    model: str
    likelihood: _Likelihood = _Likelihood()
    parameters: dict[str, _AnyEntry]


_NOISE = TypeAdapter(dict[str, _AnyEntry]).validate_python(tomllib.loads(DEFAULT_PRIORS))


def json_schema() -> dict[str, Any]:
    """Return the JSON schema of a prior file."""
    return _File.model_json_schema()


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
    packaged = Path(str(resources.files("calib"))) / "_priors"
    # An editable install has no packaged copy: the priors then lie beside the package.
    folder = packaged if packaged.is_dir() else Path(__file__).resolve().parents[2] / "priors"
    return folder / f"{model_name}.toml"


def prior_file_model(path: Path) -> str:
    """Return the model that a prior file says it is for.

    Raises
    ------
    CalibError
        If the file cannot be read or names none.
    """
    model = _content(_text(Path(path)), str(path)).get("model")
    if not isinstance(model, str):
        raise CalibError(
            "the prior file does not say which model it is for",
            where=str(path),
            allowed='model = "NAME"',
            mend="add this line at its top",
        )
    return model


def read_priors(
    path: PriorFile, model_name: str, parameters: Sequence[str], references: Mapping[str, float]
) -> Priors:
    """Read and check a prior file.

    Parameters
    ----------
    path : Path or PriorFile
        TOML file with ``model`` and a table ``parameters.NAME`` for each parameter.
    model_name : str
        The model it must be for.
    parameters : sequence of str
        The parameters it must give, in order; of a model the noise scale ``sigma`` last. Those of
        the noise that the file chooses are put before it, and have default priors.
    references : mapping of str to float
        Values of the columns that priors may be relative to, as `prior_references` returns them.

    Raises
    ------
    CalibError
        If the file is missing, is not TOML, or gives unknown, missing or impossible entries.
    """
    place = path.place if isinstance(path, DeclaredPriors) else ""
    priors = parse_priors(_text(path), place or str(path), model_name, parameters, references)
    return replace(priors, source=str(path)) if place else priors


def _text(path: PriorFile) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise CalibError(
            f"the prior file cannot be read ({error})",
            where=str(path),
            mend="give the path of a readable TOML file",
        ) from None


def _content(text: str, source: str) -> dict[str, Any]:
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise CalibError(
            f"the prior file is not valid TOML: {error}", where=source, mend="correct that line"
        ) from None


def prior_references(columns: Mapping[str, NDArray[np.float64]]) -> dict[str, float]:
    """Return the scales that priors may be relative to: medians of columns (n,), where positive."""
    medians = {
        name: float(np.median(values[np.isfinite(values)]))
        for name, values in columns.items()
        if np.isfinite(values).any()
    }
    return {name: median for name, median in medians.items() if median > 0.0}


def relative_columns(text: str) -> dict[str, float]:
    """Return the columns that priors are relative to, and what is assumed without one."""
    entries = tomllib.loads(text)["parameters"].values()
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
    if unknown := [key for key in content if key not in _File.model_fields]:
        raise _no_such_key(unknown[0], _File.model_fields, source)
    noise = _noise_choice(content, source, parameters)
    _check_names(content, source, model_name, parameters, noise.parameters)
    try:
        file = _File.model_validate(content)
    except ValidationError as error:
        raise _explain(error, source) from None
    _check_units(file, source, model_name)
    given = _NOISE | file.parameters
    names = (*parameters[:-1], *noise.parameters, *parameters[-1:])
    entries = tuple(_prior(name, given[name], source, references) for name in names)
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
        found, where=f"{source}, parameters.{prior.name}", allowed=allowed,
        mend="correct this entry",
    )  # fmt: skip


def _noise_choice(
    content: Mapping[str, Any], source: str, parameters: Sequence[str]
) -> NoiseChoice:
    """Return what the table ``[likelihood]`` says."""
    if "likelihood" not in content:
        return USUAL
    where = f"{source}, [likelihood]"
    if parameters[-1] != "sigma":
        raise CalibError(
            "an effect has no likelihood of its own", where=where, mend="take the table out"
        )
    try:
        chosen = _Likelihood.model_validate(content["likelihood"])
    except ValidationError as error:
        first = _likeliest(error)
        if first["type"] == "extra_forbidden":
            raise _no_such_key(first["loc"][-1], _Likelihood.model_fields, where) from None
        raise CalibError(
            f"{'.'.join(map(str, first['loc']))}: {first['msg']}", where=where,
            allowed='family = "normal" or "student_t", noise_depends_on = "slip" or another '
            'condition of the model, correlated_along = "run_order"',
            mend="correct this entry",
        ) from None  # fmt: skip
    noise = NoiseChoice(chosen.family, chosen.noise_depends_on, chosen.correlated_along)
    if noise.correlated_along and noise.family != "normal":
        raise CalibError(
            "noise that is correlated along a run is normal", where=where,
            allowed='family = "normal"', mend="take one of the two out",
        )  # fmt: skip
    taken = [name for name in noise.parameters if name in parameters]
    if taken:
        raise CalibError(
            f"the model has a parameter {taken[0]}, which is the noise's name for one of its own",
            where=where, mend="rename it in the model, or take the table out",
        )  # fmt: skip
    return noise


def _check_names(
    content: Mapping[str, Any], source: str, model_name: str, parameters: Sequence[str],
    of_noise: Sequence[str],
) -> None:  # fmt: skip
    if content.get("model") != model_name:
        raise CalibError(
            f"the priors are for model {content.get('model')!r}, not {model_name!r}",
            where=source,
            allowed=f'model = "{model_name}"',
            mend="pass the prior file of this model",
        )
    given = content.get("parameters")
    given = given if isinstance(given, Mapping) else {}
    unknown = [name for name in given if name not in (*parameters, *of_noise)]
    missing = [name for name in parameters if name not in given]
    if unknown or missing:
        found = "; ".join(
            f"{what} {', '.join(names)}"
            for what, names in (("unknown parameter", unknown), ("missing parameter", missing))
            if names
        )
        raise CalibError(
            found,
            where=f"{source}, [parameters]",
            allowed=", ".join(parameters),
            mend=f"{_meant(unknown, missing)}give exactly these parameters{_example(model_name)}",
        )


def _example(model_name: str) -> str:
    shipped = default_priors(model_name)
    there = isinstance(shipped, Path) and shipped.is_file()
    return "; copy the shipped file and edit it" if there else ""


def _check_units(file: _File, source: str, model_name: str) -> None:
    """A prior in another unit would silently be taken for one in the model's."""
    shipped = default_priors(model_name)
    if not shipped.is_file():
        return
    units = {
        name: entry.get("unit")
        for name, entry in tomllib.loads(shipped.read_text(encoding="utf-8"))["parameters"].items()
    } | {name: entry.unit for name, entry in _NOISE.items()}
    for name, entry in file.parameters.items():
        if name in units and entry.unit != units[name]:
            raise CalibError(
                f"the unit is {entry.unit!r}",
                where=f"{source}, parameters.{name}",
                allowed=f"unit = {units[name]!r}",
                mend="convert the numbers to this unit",
            )


def _likeliest(error: ValidationError) -> Any:
    """Return the error to tell: of a misspelt key, by which another is missing, its name."""
    errors = error.errors()
    return next((e for e in errors if e["type"] == "extra_forbidden"), errors[0])


def _no_such_key(key: object, known: Iterable[str], where: str) -> CalibError:
    return CalibError(
        f"there is no key {str(key)!r}", where=where, allowed=", ".join(known),
        mend=f"{_meant([str(key)], known)}correct it, or take it out",
    )  # fmt: skip


def _meant(found: Iterable[str], known: Iterable[str]) -> str:
    """Say which names may have been meant."""
    known = list(known)
    pairs = ((name, difflib.get_close_matches(name, known, n=2, cutoff=0.5)) for name in found)
    said = ", ".join(f"{' or '.join(near)} by {name}" for name, near in pairs if near)
    return f"did you mean {said}? " if said else ""


def _explain(error: ValidationError, source: str) -> CalibError:
    first = _likeliest(error)
    place = [str(part) for part in first["loc"]]
    if first["type"] == "extra_forbidden" and place[0] == "parameters":
        _, name, dist, key = place
        return _no_such_key(key, _DISTS[dist].model_fields, f"{source}, parameters.{name}")
    if first["type"].startswith("union_tag"):
        return _no_such_dist(first["input"], f"{source}, {'.'.join(place)}")
    if first["type"] == "float_type":
        return CalibError(
            f"{place[-1]} = {first['input']!r} is not a number",
            where=f"{source}, parameters.{place[1]}", allowed=f"a number, as in {place[-1]} = 0.75",
            mend="write a number without quotes",
        )  # fmt: skip
    return CalibError(
        f"{first['msg']} (found {first.get('input')!r})",
        where=f"{source}, {'.'.join(place)}",
        allowed="dist = normal (mean, sd > 0), lognormal (median > 0, sd_log > 0), half_normal "
        "(sd > 0), uniform (lower < upper) or fixed (value); of nu also gamma (shape > 0, "
        "rate > 0); each with unit, reason, source",
        mend="correct this entry",
    )


def _no_such_dist(entry: Mapping[str, Any], where: str) -> CalibError:
    dist = entry.get("dist")
    found = "there is no dist" if dist is None else f"there is no distribution {dist!r}"
    return CalibError(
        found, where=where, allowed=", ".join(_DISTS),
        mend=f"{_meant([str(dist)], _DISTS)}choose one of these",
    )  # fmt: skip


def _prior(name: str, entry: _AnyEntry, source: str, references: Mapping[str, float]) -> Prior:
    reference, text = 1.0, _words(entry)
    if entry.relative_to is not None:
        _check_relative(name, entry.relative_to, source)
        reference = references.get(entry.relative_to, entry.default_reference)
        text += f" x {reference:g} ({entry.relative_to})"
    loc, scale, lower, upper = _internal(entry, reference)
    gamma = (entry.shape, entry.rate) if isinstance(entry, _Gamma) else None
    if gamma is not None and name != "nu":
        raise CalibError(
            'dist = "gamma" is for the degrees of freedom nu of a Student-t likelihood',
            where=f"{source}, parameters.{name}", allowed="normal, lognormal, half_normal, uniform "
            "or fixed", mend="choose one of these",
        )  # fmt: skip
    if not lower < upper:
        raise CalibError(
            f"lower bound {lower:g} is not below upper bound {upper:g}",
            where=f"{source}, parameters.{name}",
            mend="give lower < upper",
        )
    return Prior(
        name, entry.unit, entry.reason, entry.source, text, isinstance(entry, _OnLogarithm), loc,
        scale, lower, upper, gamma,
    )  # fmt: skip


def _check_relative(name: str, column: str, source: str) -> None:
    if all(q.canonical != column for q in QUANTITIES.values()):
        raise CalibError(
            f"relative_to names no known column: {column!r}",
            where=f"{source}, parameters.{name}",
            allowed=", ".join(q.canonical for q in QUANTITIES.values()),
            mend="name one of these, as the table has it in its own unit",
        )


def _internal(entry: _AnyEntry, reference: float) -> tuple[float, float, float, float]:
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


def _words(entry: _AnyEntry) -> str:
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
