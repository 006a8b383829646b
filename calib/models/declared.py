"""Whether what a user declares of a model holds together, seen without data."""

from __future__ import annotations

import tomllib
from typing import TYPE_CHECKING

from calib.data.quantities import OUTPUTS, QUANTITIES
from calib.errors import CalibError

if TYPE_CHECKING:
    from calib.models.base import Model

__all__ = ["check_model"]


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
    if model.prior_file is None:
        raise CalibError(
            "the model has no priors", where=where,
            allowed=f"prior_file=Path(__file__).with_name('{model.name}.toml')",
            mend="write a prior file after the example that `calib priors` shows, and name it",
        )  # fmt: skip
    try:
        tomllib.loads(model.prior_file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise CalibError(
            f"the priors of the model cannot be read ({error})", where=str(model.prior_file),
            mend="write this file after the example that `calib priors` shows",
        ) from None  # fmt: skip
