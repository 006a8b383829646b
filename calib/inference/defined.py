"""Refuse rows at which a model has no value, whatever its parameters."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib.errors import CalibError
from calib.models.base import Array, BoundModel, Conditions

__all__ = ["check_defined"]

_SHOWN = 5


def check_defined(
    bound: BoundModel, theta: Array, conditions: Conditions, source: str, lines: NDArray[np.int64]
) -> None:
    """Refuse rows at which no parameter vector has a finite prediction.

    Parameters
    ----------
    bound : BoundModel
    theta : ndarray, shape (k, d)
        Natural parameters of the model, as its prior spreads them.
    conditions : mapping of str to ndarray, shape (n,)
    source : str
        What the rows are from, for the message.
    lines : ndarray, shape (n,)
        Where they stand there.

    Raises
    ------
    CalibError
        Naming the lines.
    """
    empty = lines[~np.isfinite(bound.location(theta, conditions)).any(axis=0)]
    if empty.size:
        raise CalibError(
            f"the model {bound.model.name} has no value there",
            where=f"{source}, lines {', '.join(map(str, empty[:_SHOWN]))}"
            + (f" and {empty.size - _SHOWN} more" if empty.size > _SHOWN else ""),
            allowed="conditions at which the model is defined (see its page in the documentation)",
            mend="leave these rows out, or choose another model",
        )
