"""Entries of a prior file: what each distribution takes, what is wrong with one, and its prior."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError
from scipy.special import digamma, polygamma

from calib.data.quantities import QUANTITIES
from calib.errors import CalibError, in_words, meant
from calib.inference.noise import DEFAULT_PRIORS, Along, Family
from calib.inference.priors import Prior

# Beyond these, squares and products of numbers leave the range of double precision; no quantity of
# the field comes near them. An sd of 20 on the logarithm is a factor of 5e8 to either side.
_Number = Annotated[float, Field(strict=True, ge=-1e15, le=1e15)]
_Positive = Annotated[float, Field(strict=True, gt=1e-15, le=1e15)]
# Farther out the quantiles of a normal lose their digits.
_MOST_SDS = 1e4
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
type PriorEntry = Annotated[
    _Normal | _LogNormal | _HalfNormal | _Uniform | _Gamma | _Fixed, Field(discriminator="dist")
]


class LikelihoodTable(BaseModel):
    """The table ``[likelihood]``."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    family: Family = "normal"
    noise_depends_on: str = ""
    correlated_along: Along = ""


class PriorFileContent(BaseModel):
    """A whole prior file."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    model: str
    likelihood: LikelihoodTable = LikelihoodTable()
    parameters: dict[str, PriorEntry]


NOISE_ENTRIES = TypeAdapter(dict[str, PriorEntry]).validate_python(tomllib.loads(DEFAULT_PRIORS))


def json_schema() -> dict[str, Any]:
    """Return the JSON schema of a prior file."""
    return PriorFileContent.model_json_schema()


def prior_of(name: str, entry: PriorEntry, source: str, references: Mapping[str, float]) -> Prior:
    """Return the prior that an entry gives; `references` as for `read_priors`.

    Raises
    ------
    CalibError
        If its bounds cross, or it is relative to no known column.
    """
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
            where=f"{source}, parameters.{name}",
            expected="normal, lognormal, half_normal, uniform or fixed",
            hint="choose one of these",
        )  # fmt: skip
    if not lower < upper:
        raise CalibError(
            f"lower bound {lower:g} is not below upper bound {upper:g}",
            where=f"{source}, parameters.{name}",
            hint="give lower < upper",
        )
    if max(lower - loc, loc - upper) > _MOST_SDS * scale > 0.0:
        raise CalibError(
            f"the bounds lie {max(lower - loc, loc - upper) / scale:.3g} sds from the "
            f"{'median' if isinstance(entry, _OnLogarithm) else 'mean'}",
            where=f"{source}, parameters.{name}",
            expected=f"bounds within {_MOST_SDS:g} sds, and better those that hold some of the "
            "distribution",
            hint="correct the bounds, or the distribution",
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
            expected=", ".join(q.canonical for q in QUANTITIES.values()),
            hint="name one of these, as the table has it in its own unit",
        )


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


def likeliest(error: ValidationError) -> Any:
    """Return the error to tell: of a misspelt key, by which another is missing, its name."""
    errors = error.errors()
    return next((e for e in errors if e["type"] == "extra_forbidden"), errors[0])


def no_such_key(key: object, known: Iterable[str], where: str) -> CalibError:
    """Return the refusal of a key that is not `known`."""
    return CalibError(
        f"there is no key {str(key)!r}", where=where, expected=", ".join(known),
        hint=meant(str(key), known, "correct it, or take it out"),
    )  # fmt: skip


def explain(error: ValidationError, source: str) -> CalibError:
    """Return what pydantic found in a prior file as this package says it."""
    first = likeliest(error)
    place = [str(part) for part in first["loc"]]
    if first["type"] == "extra_forbidden" and place[0] == "parameters":
        _, name, dist, key = place
        return no_such_key(key, _DISTS[dist].model_fields, f"{source}, parameters.{name}")
    if first["type"].startswith("union_tag"):
        return _no_such_dist(first["input"], f"{source}, {'.'.join(place)}")
    if first["type"] == "float_type":
        return CalibError(
            in_words(first),
            where=f"{source}, parameters.{place[1]}",
            expected=f"a number, as in {place[-1]} = 0.75",
            hint="write a number without quotes",
        )  # fmt: skip
    return CalibError(
        in_words(first),
        where=f"{source}, {'.'.join(place)}",
        expected="dist = normal (mean, sd > 0), lognormal (median > 0, sd_log > 0), half_normal "
        "(sd > 0), uniform (lower < upper) or fixed (value); of nu also gamma (shape > 0, "
        "rate > 0); each with unit, reason, source",
        hint="correct this entry",
    )


def _no_such_dist(entry: Mapping[str, Any], where: str) -> CalibError:
    dist = entry.get("dist")
    found = "there is no dist" if dist is None else f"there is no distribution {dist!r}"
    return CalibError(
        found, where=where, expected=", ".join(_DISTS),
        hint=meant(str(dist), _DISTS, "choose one of these"),
    )  # fmt: skip
