"""Whether what a user declares of a model holds together, seen without data."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any
from unicodedata import normalize

from calib.data.files import MEND_TOML
from calib.data.quantities import OUTPUTS, QUANTITIES, convert
from calib.errors import CalibError

if TYPE_CHECKING:
    from calib.models.base import Model

_ONE = "dimensionless"
# Those of variables in `calib.inference.io`.
DIMENSIONS = dict.fromkeys(("chain", "draw", "row"), "a dimension of the files of draws")


def check_tuple(attribute: str, given: object, where: str) -> None:
    """Refuse plain text in the place of a tuple of texts: it would be taken letter by letter."""
    if isinstance(given, str):
        raise CalibError(
            f"{attribute} is the text {given!r}", where=where, allowed="a tuple of texts",
            mend=f"write {attribute} = ({_quoted(given)},), with the comma",
        )  # fmt: skip
    if not isinstance(given, list | tuple) or not all(isinstance(part, str) for part in given):
        raise CalibError(
            f"{attribute} is {given!r}", where=where, allowed="a tuple of texts",
            mend='write each between quotation marks, with commas: ("a", "b")',
        )  # fmt: skip


def _quoted(given: str) -> str:
    """Return a text as it is written in Python, mathematics with its backslashes as they are."""
    return f'r"{given}"' if "\\" in given else f'"{given}"'


def check_word(name: object, what: str, where: str) -> None:
    """Check that the name of a model or a parameter will do wherever it stands."""
    if not isinstance(name, str) or not name.isidentifier():
        raise CalibError(
            f"{name!r} is no name for a {what}", where=where,
            allowed="letters of any script, digits and underscores, not beginning with a digit: it "
            "names columns, variables of netCDF and marks of templates too",
            mend="give it another name",
        )  # fmt: skip


def check_names(
    taken: Mapping[str, str], given: Iterable[tuple[str, str, str]], where: str
) -> None:
    """Check that each name is that of one thing: files know things by their names.

    `taken` maps names of other things to what these are; `given` are names, what each names, and
    the key that says so.
    """
    # Letters that look alike and are written in two ways are the same.
    known = {normalize("NFKC", name): what for name, what in taken.items()}
    for name, what, key in given:
        other = known.get(normalize("NFKC", name))
        if other is not None:
            raise CalibError(
                f"{what} is there twice" if other == what else f"{what} has the name of {other}",
                where=f"{where}, {key}",
                allowed="a name for each parameter, condition and output that nothing else has: "
                f"not {', '.join(taken)}",
                mend="rename one of them",
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
                f"there is no quantity {column!r}", where=where, allowed=", ".join(QUANTITIES),
                mend="register a Quantity for it before the model",
            )  # fmt: skip
    if QUANTITIES[model.output].role != "output":
        raise CalibError(
            f"{model.output} is no output", where=where, allowed=", ".join(OUTPUTS.values()),
            mend='register its Quantity with role="output"',
        )  # fmt: skip
    if not model.conditions or not model.parameters:
        raise CalibError(
            "a model needs conditions and parameters", where=where,
            mend="name at least one of each",
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
            allowed="priors=... with the text of a prior file",
            mend="write it after the example that `calib priors magic_formula` shows",
        )  # fmt: skip
    try:
        given = tomllib.loads(model.priors).get("parameters", {})
    except tomllib.TOMLDecodeError as error:
        raise CalibError(
            f"its priors are not valid TOML: {error}", where=where, mend=MEND_TOML
        ) from None
    apart = sorted(set(names) ^ set(given))
    if apart:
        raise CalibError(
            f"its priors and its parameters differ by {', '.join(apart)}", where=where,
            allowed=", ".join(names), mend="give a prior for each of these, and for nothing else",
        )  # fmt: skip
    _check_units(model, given, where)


def _check_units(model: Model, given: dict[str, Any], where: str) -> None:
    """Refuse a prior in another unit than its parameter's, as far as that is known."""
    log = model.response == "log"
    wanted = {"sigma": "1" if log else QUANTITIES[model.output].unit}
    # Without `reported` they all have the unit 1, which then says nothing.
    if set(model.reported.values()) != {"1"}:
        wanted |= {name: unit for name, unit in model.reported.items() if name in model.parameters}
    for name, unit in wanted.items():
        found = given[name].get("unit") if isinstance(given[name], dict) else None
        if found is not None and not _same_unit(str(found), unit):
            raise CalibError(
                f"the unit is {found!r}", where=f"{where}, priors, parameters.{name}.unit",
                allowed=f'unit = "{unit.replace("**", "^").replace(_ONE, "1")}"',
                mend="convert the numbers to this unit",
            )  # fmt: skip


def _same_unit(found: str, wanted: str) -> bool:
    found, wanted = (_ONE if u == "1" else u.replace("^", "**") for u in (found, wanted))
    try:
        return found == wanted or float(convert(1.0, found, wanted)) == 1.0
    except CalibError:
        return False
