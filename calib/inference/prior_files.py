"""Prior files: TOML read, checked against the model, and turned into priors."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from calib.batch.plugins import declared_in
from calib.data.files import MEND_TOML, read_text
from calib.errors import CalibError, in_words, meant
from calib.inference.noise import USUAL, NoiseChoice
from calib.inference.prior_entries import (
    NOISE_ENTRIES,
    LikelihoodTable,
    PriorFileContent,
    explain,
    likeliest,
    no_such_key,
    prior_of,
)
from calib.inference.priors import Prior, Priors
from calib.models import MODELS


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
        raise CalibError(
            "the prior file does not say which model it is for",
            where=str(path),
            expected='model = "NAME"',
            hint="add this line at its top",
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
        return read_text(path)
    except (OSError, UnicodeDecodeError) as error:
        raise CalibError(
            f"the prior file cannot be read ({error})",
            where=str(path),
            hint="give the path of a readable TOML file",
        ) from None


def _content(text: str, source: str) -> dict[str, Any]:
    try:
        return _parsed(text)
    except tomllib.TOMLDecodeError as error:
        raise CalibError(
            f"the prior file is not valid TOML: {error}", where=source, hint=MEND_TOML
        ) from None


@lru_cache(maxsize=64)
def _parsed(text: str) -> dict[str, Any]:
    """What a text says, which a diagnosis asks of the same few again and again; not to change."""
    return tomllib.loads(text)


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
        raise no_such_key(unknown[0], PriorFileContent.model_fields, source)
    noise = _noise_choice(content, source, parameters)
    _check_names(content, source, model_name, parameters, noise.parameters)
    try:
        file = PriorFileContent.model_validate(content)
    except ValidationError as error:
        raise explain(error, source) from None
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


def _noise_choice(
    content: Mapping[str, Any], source: str, parameters: Sequence[str]
) -> NoiseChoice:
    """Return what the table ``[likelihood]`` says."""
    if "likelihood" not in content:
        return USUAL
    where = f"{source}, [likelihood]"
    if parameters[-1] != "sigma":
        raise CalibError(
            "an effect has no likelihood of its own", where=where, hint="take the table out"
        )
    try:
        chosen = LikelihoodTable.model_validate(content["likelihood"])
    except ValidationError as error:
        first = likeliest(error)
        if first["type"] == "extra_forbidden":
            raise no_such_key(first["loc"][-1], LikelihoodTable.model_fields, where) from None
        raise CalibError(
            in_words(first), where=where,
            expected='family = "normal" or "student_t", noise_depends_on = "slip" or another '
            'condition of the model, correlated_along = "run_order"',
            hint="correct this entry",
        ) from None  # fmt: skip
    noise = NoiseChoice(chosen.family, chosen.noise_depends_on, chosen.correlated_along)
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
        raise CalibError(
            f"the priors are for model {content.get('model')!r}, not {model_name!r}",
            where=source,
            expected=f'model = "{model_name}"',
            hint="pass the prior file of this model",
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
        guesses = "".join(
            f"{name}: {guess} " for name in unknown if (guess := meant(name, missing, ""))
        )
        raise CalibError(
            found,
            where=f"{source}, [parameters]",
            expected=", ".join(parameters),
            hint=f"{guesses}give exactly these parameters{_example(model_name)}",
        )


def _example(model_name: str) -> str:
    shipped = default_priors(model_name)
    there = isinstance(shipped, Path) and shipped.is_file()
    return "; copy the shipped file and edit it" if there else ""


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
