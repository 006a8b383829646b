"""Whether what a user declares of a model holds together, seen without data."""

from __future__ import annotations

import tomllib
from typing import TYPE_CHECKING

from calib.data.quantities import OUTPUTS, QUANTITIES
from calib.errors import CalibError

if TYPE_CHECKING:
    from calib.models.base import Model


def check_model(model: Model) -> None:
    """Check a declaration.

    Raises
    ------
    CalibError
        If a column is no quantity, the output is none, a name is given twice, or the priors are
        missing or not of the model's parameters.
    """
    where = f"model {model.name!r}"
    if not model.name.isidentifier():
        raise CalibError(
            "the name of a model must be a word", where=where,
            allowed="letters, digits and underscores", mend="give it another name",
        )  # fmt: skip
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
    twice = sorted({n for n in names if names.count(n) > 1})
    if twice:
        raise CalibError(
            f"the parameter {twice[0]} is there twice", where=where,
            allowed="each name once; sigma is the noise's", mend="rename one of them",
        )  # fmt: skip
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
            f"its priors are not valid TOML: {error}", where=where, mend="correct that line"
        ) from None
    apart = sorted(set(names) ^ set(given))
    if apart:
        raise CalibError(
            f"its priors and its parameters differ by {', '.join(apart)}", where=where,
            allowed=", ".join(names), mend="give a prior for each of these, and for nothing else",
        )  # fmt: skip
