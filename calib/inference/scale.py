"""Whether data are of a size that priors can say, before any work goes into them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from calib.data.headers import accepted_headers
from calib.data.numbers import plain_number
from calib.data.quantities import QUANTITIES
from calib.errors import CalibError
from calib.inference.prior_files import relative_columns
from calib.inference.random import generator

if TYPE_CHECKING:
    from calib.inference.problem import Problem

# Draws of the prior, and the rows that they are looked at in.
_DRAWS, _ROWS = 2_000, 50
# The size of a column is that which all but its largest tenth have: one slip of the pen is none.
_SIZE = 0.9
# Part of the draws on either side that is no evidence against an assumed scale.
_TAIL = 5e-4
# An order of magnitude.
_FAR = 10.0


def check_scale(problem: Problem, assumed: Mapping[str, float]) -> None:
    """Raise a CalibError if the output is of a size that the priors exclude.

    Where they rest on an assumed value any size beyond what they admit tells against that. Where
    they do not, they may be wrong too, which is said after a fit: refused is what is beyond them by
    an order of magnitude.

    Parameters
    ----------
    problem : Problem
    assumed : mapping of str to float
        Columns that the priors are relative to and the data lack, with what was assumed.
    """
    low, high = _expected(problem)
    column = problem.table.column(problem.bound.model.output)
    size = float(np.quantile(np.abs(problem.observed), _SIZE))
    slack = 1.0 if assumed else _FAR
    # Of a column of zeros the size tells nothing.
    if not np.isfinite([low, high]).all() or low / slack <= size <= high * slack or size == 0.0:
        return
    written = [plain_number(float(column.written(x))) for x in (low, high, size)]
    unit = f" {column.unit_word}".rstrip()
    found = (
        f"nine tenths of the {column.quantity.word}s are at most {written[2]}{unit} in size, and "
        f"the priors of {problem.bound.model.name} expect {written[0]} to {written[1]}{unit}"
    )
    if not assumed:
        relative = relative_columns(problem.priors.text) if problem.priors.text else {}
        used = dict.fromkeys(
            [problem.bound.model.output, *relative, *problem.bound.model.conditions]
        )
        raise CalibError(
            found, where=f"{problem.table.source}, column {column.header!r}",
            allowed="an output of a size that the priors admit",
            mend=f"check the units of {', '.join(map(problem.table.header_of, used))}; if they are "
            "right, pass a prior file of your own that admits it (`calib priors "
            f"{problem.bound.model.name}` writes one to edit)",
        )  # fmt: skip
    taken = ", ".join(_taken(name, value) for name, value in assumed.items())
    raise CalibError(
        f"there is no column {', '.join(assumed)}; {taken} was assumed, but {found}",
        where=problem.table.source,
        allowed="; ".join(", ".join(accepted_headers(QUANTITIES[name])) for name in assumed),
        mend=f"add the column {', '.join(assumed)}; if its values are not known, pass a prior file "
        "whose entries are not relative to it",
    )


def _taken(name: str, value: float) -> str:
    quantity = QUANTITIES[name]
    return f"{quantity.word} {value:g} {quantity.unit.replace('**', '')}".removesuffix(
        " dimensionless"
    )


def _expected(problem: Problem) -> tuple[float, float]:
    """Return between which values the priors expect the size of the output."""
    table = problem.table
    rows = np.linspace(0, len(table) - 1, min(len(table), _ROWS)).astype(np.int64)
    some = problem.with_table(table.take(rows))
    rng = generator(0, "scale of the priors")
    with np.errstate(all="ignore"):
        natural = some.theta(some.priors.sample(rng, _DRAWS))
        drawn = some.draw_location(natural, some.conditions, rng) + some.draw_noise(natural, rng)
        sizes = np.quantile(np.abs(some.bound.from_response(drawn)), _SIZE, axis=1)
    sizes = sizes[np.isfinite(sizes)]
    if sizes.size < _DRAWS / 2:
        return np.nan, np.nan
    low, high = np.quantile(sizes, [_TAIL, 1.0 - _TAIL])
    return float(low), float(high)
