"""How the simulators' parameters may shift in the field: each alone, or together as soils do."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from scipy.linalg import block_diag

from calib.errors import CalibError
from calib.gap.campaigns import OutputData
from calib.inference.prior_files import default_priors
from calib.inference.sampling.mode import prior_widths
from calib.models.base import Array

type ShiftAs = Literal["alone", "soil"]

# Shifts of how a parameter varies with pressure, slip or water, relative to those of its value.
DIFFERENCE = 0.2
# Another zero of slip: unit of the relative error of the rolling radius.
ZERO_OF_SLIP, RADIUS_ERROR = "slip_zero", 0.03
# What water does to the strength of a soil: its prior spans all soils there are, of which those of
# two campaigns with one density relation are near neighbours.
_OF_WATER = ("C2", "C3")
# The same quantity under another name: the exponent of plain Bekker is that without slip.
_SAME = {"n": "n0"}


@dataclass(frozen=True)
class ShiftMap:
    """What the coordinates of a shift change, per unit of each.

    Attributes
    ----------
    parameters : mapping of str to ndarray, shape (d, k)
        By output, its d parameters in internal coordinates.
    radius_error : ndarray, shape (k,)
        Relative error of the rolling radius behind the recorded slip.
    """

    parameters: Mapping[str, Array]
    radius_error: Array


class _Row(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    ways: tuple[float, ...]
    own: float = Field(gt=0.0)


class _File(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)
    unit: str = Field(min_length=1)
    reason: str = Field(min_length=1)
    source: str = Field(min_length=1)
    ways: tuple[str, ...]
    parameters: dict[str, _Row]


def another_soil() -> dict[str, tuple[Array, float]]:
    """Read how quantities move together when the soil is another one.

    Returns
    -------
    dict
        Quantity to its loadings on the ways in which soils differ, shape (ways,), and the sd of
        what it does by itself; in units of the prior sds.

    Raises
    ------
    CalibError
        If the prior file cannot be read or is not complete.
    """
    path = default_priors("shifts/another_soil")
    try:
        file = _File.model_validate(tomllib.loads(path.read_text(encoding="utf-8")))
    except (OSError, tomllib.TOMLDecodeError, ValidationError) as error:
        raise CalibError(
            f"the prior of parameter shifts cannot be read ({error})", where=str(path),
            hint="install the package again",
        ) from None  # fmt: skip
    if any(len(row.ways) != len(file.ways) for row in file.parameters.values()):
        raise CalibError(
            "a parameter has not as many loadings as there are ways", where=str(path),
            expected=f"{len(file.ways)} numbers each", hint="correct it",
        )  # fmt: skip
    return {name: (np.array(row.ways), row.own) for name, row in file.parameters.items()}


def quantities(names: Sequence[str]) -> list[str]:
    """Name the coordinates in which a model's shifts are described.

    The values at the two end pressures, K_lo and K_hi, become K, which both share, and
    K_difference, half of what they differ by.
    """
    found = []
    for name in names:
        stem, _, end = name.rpartition("_")
        if end in ("lo", "hi") and {f"{stem}_lo", f"{stem}_hi"} <= set(names):
            found.append(stem if end == "lo" else f"{stem}_difference")
        else:
            found.append(_SAME.get(name, name))
    return found


def coordinates(outputs: Sequence[OutputData]) -> list[tuple[str, str]]:
    """Name output and quantity of every coordinate of a shift, in the order in which they come."""
    found = []
    for o in outputs:
        kinds = quantities(o.priors.names)
        if o.role == "pull":
            kinds.append(ZERO_OF_SLIP)
        found += [(o.name, kind) for kind in kinds]
    return found


def alone_sd(quantity: str) -> float:
    """Prior sd of a quantity that shifts by itself, in its parameter's prior sds."""
    lesser = quantity.endswith(("_bend", "_difference")) or quantity in ("n1", *_OF_WATER)
    return DIFFERENCE if lesser else 1.0


def shift_map(outputs: Sequence[OutputData], shift_as: ShiftAs) -> tuple[ShiftMap, list[float]]:
    """Map shift coordinates to shifts of each output's parameters, and of the zero of slip.

    Another soil changes the traction curve at all pressures, and the exponent of sinkage at all
    slips, much alike: the values at the two end pressures share one shift, and differ by less, as
    the bends between them and the exponent's growth with slip (n1) do. With "soil", what a softer
    soil does to the traction curve goes along with what it does to the ruts.

    Slip was zeroed in the laboratory, where the wheel pulled nothing. Elsewhere it pulls nothing at
    another slip, for the resistance differs: the recorded slip is then wrong as with a wrong
    rolling radius. It is sought where drawbar pull is measured.

    Parameters
    ----------
    shift_as : {"alone", "soil"}

    Returns
    -------
    ShiftMap
    list of float
        Prior sds of the coordinates for shifts of one prior sd.
    """
    at = coordinates(outputs)
    kinds = [kind for _, kind in at]
    blocks: list[Array] = []
    for o in outputs:
        names = [kind for name, kind in at if name == o.name and kind != ZERO_OF_SLIP]
        blocks.append(prior_widths(o.priors)[:, None] * _unfold(names))
        if o.role == "pull":
            blocks.append(np.full((1, 1), RADIUS_ERROR))
    matrix = block_diag(*blocks)
    sds = np.array([alone_sd(kind) for kind in kinds])
    if shift_as == "soil":
        matrix = matrix @ _together(kinds, sds)
        sds = np.ones(sds.size)
    parameters = {
        o.name: matrix[[name == o.name and kind != ZERO_OF_SLIP for name, kind in at]]
        for o in outputs
    }
    zero = [kind == ZERO_OF_SLIP for kind in kinds]
    return ShiftMap(parameters, matrix[zero].sum(axis=0)), sds.tolist()


def _unfold(names: Sequence[str]) -> Array:
    """From what end pressures share and differ by to their values, shape (d, d)."""
    matrix = np.eye(len(names))
    for j, name in enumerate(names):
        if name.endswith("_difference"):
            i = names.index(name.removesuffix("_difference"))
            matrix[i, j], matrix[j, i] = -1.0, 1.0
    return matrix


def _together(kinds: Sequence[str], alone: Array) -> Array:
    """Square root of the covariance of the quantities, shape (k, k)."""
    known = another_soil()
    covariance = np.diag(alone**2)
    at = [i for i, kind in enumerate(kinds) if kind in known]
    if at:
        ways = np.stack([known[kinds[i]][0] for i in at])
        own = np.array([known[kinds[i]][1] for i in at])
        covariance[np.ix_(at, at)] = ways @ ways.T + np.diag(own**2)
    return np.asarray(np.linalg.cholesky(covariance))
