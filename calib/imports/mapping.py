"""The mapping of a file's columns to quantities, ``mapping.toml``, and what can be derived.

A mapping::

    [columns]
    slip_percent = {derive = "slip_of_kappa", inputs = {kappa = {from = "SR"}}}
    drawbar_pull_n = {from = "FX", unit = "N"}
    normal_load_n = {from = "FZ", unit = "N", factor = -1}
    average_ground_pressure_kpa = {derive = "pressure", inputs = {
        force = {from = "FZ", unit = "N", factor = -1}, area = {value = 120, unit = "cm2"}}}
    [crop]                       # optional: rows to keep, by columns of the file or of these
    ET = [5, 60]
    [bins]                       # optional: means of rows that lie in one bin
    slip_percent = {width = 2}
    [thin]                       # or: every so many rows
    every = "auto"
"""

from __future__ import annotations

import inspect
import os
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from calib.data.files import TOML_HINT, read_toml
from calib.data.quantities import convert
from calib.data.table import normal
from calib.errors import CalibError, in_words, meant
from calib.imports.tables import SPELLINGS

type Array = NDArray[np.float64]


def pressure(force: Array, area: Array) -> Array:
    """Force over area."""
    return force / area


def shear_stress(torque: Array, radius: Array, inner_radius: Array | float = 0.0) -> Array:
    """Stress under a shear ring, or a disc, all of which yields: T = 2π τ (r³ - r_i³) / 3."""
    return 3.0 * torque / (2.0 * np.pi * (radius**3 - np.power(inner_radius, 3.0)))


def slip(speed: Array, wheel_speed: Array, radius: Array) -> Array:
    """Slip as models take it, 1 - v/(ωr)."""
    return 1.0 - speed / (wheel_speed * radius)


def kappa(speed: Array, wheel_speed: Array, radius: Array) -> Array:
    """Slip of ISO 8855 and SAE J670, ωr/v - 1."""
    return wheel_speed * radius / speed - 1.0


def slip_of_kappa(kappa: Array) -> Array:
    """Slip 1 - v/(ωr) from ωr/v - 1."""
    return kappa / (1.0 + kappa)


# By name the function, and the unit of what it gives.
DERIVED: Mapping[str, tuple[Callable[..., Array], str]] = {
    "pressure": (pressure, "Pa"),
    "shear_stress": (shear_stress, "Pa"),
    "slip": (slip, "dimensionless"),
    "kappa": (kappa, "dimensionless"),
    "slip_of_kappa": (slip_of_kappa, "dimensionless"),
}
# By name of an input its dimension, and the unit that functions take.
INPUTS: Mapping[str, tuple[str, str]] = {
    "force": ("force", "N"),
    "area": ("area", "m**2"),
    "torque": ("torque", "N*m"),
    "radius": ("length", "m"),
    "inner_radius": ("length", "m"),
    "speed": ("speed", "m/s"),
    "wheel_speed": ("rotation", "rad/s"),
    "kappa": ("slip", "dimensionless"),
}


def inputs_of(derived: str) -> tuple[list[str], list[str]]:
    """Return the inputs that a derived quantity needs, and those that it may have."""
    found = inspect.signature(DERIVED[derived][0]).parameters
    needed = [name for name, p in found.items() if p.default is p.empty]
    return needed, [name for name in found if name not in needed]


class _Strict(BaseModel):
    model_config = ConfigDict(
        extra="forbid", frozen=True, allow_inf_nan=False, populate_by_name=True
    )


class Source(_Strict):
    """Where the values of a column come from: a column of the file, a constant, or a derivation.

    Parameters
    ----------
    from_ : str or list of str
        ``from``: a column of the file, or several that hold repeats of one reading side by side.
    value : float or str
        The same for all rows.
    derive : str
        A name of `DERIVED`.
    inputs : mapping of str to Source
        What it is derived from.
    unit : str
        Of the column or the constant; by default what the file says.
    factor : float
        By which values are multiplied first; -1 turns a sign.
    """

    from_: Annotated[str | list[str] | None, Field(alias="from", min_length=1)] = None
    value: float | str | None = None
    derive: Literal["pressure", "shear_stress", "slip", "kappa", "slip_of_kappa"] | None = None
    inputs: dict[str, Source] = {}
    unit: str = ""
    factor: float = 1.0

    @model_validator(mode="after")
    def _one(self) -> Self:
        if sum(x is not None for x in (self.from_, self.value, self.derive)) != 1:
            raise ValueError("a column has one of from, value and derive")
        if self.derive is None:
            if self.inputs:
                raise ValueError("inputs belong to derive")
            return self
        needed, may = inputs_of(self.derive)
        if not set(needed) <= set(self.inputs) <= {*needed, *may}:
            more = f", and may take {', '.join(may)}" if may else ""
            raise ValueError(f"{self.derive} takes the inputs {', '.join(needed)}{more}")
        if self.unit:
            raise ValueError("what is derived has no unit: its inputs have")
        return self


class Bin(_Strict):
    """Bins along a column: their width in its unit, or how many from its least to its largest."""

    width: Annotated[float | None, Field(gt=0.0)] = None
    count: Annotated[int | None, Field(ge=1)] = None

    @model_validator(mode="after")
    def _one(self) -> Self:
        if (self.width is None) == (self.count is None):
            raise ValueError("a bin has one of width and count")
        return self


class Thin(_Strict):
    """Which rows of each run to keep: the first of so many, by their autocorrelation if auto."""

    every: Annotated[int, Field(ge=1)] | Literal["auto"]


class Mapped(_Strict):
    """The content of a ``mapping.toml``."""

    sheet: str = ""
    columns: Annotated[dict[str, Source], Field(min_length=1)]
    crop: dict[str, Annotated[list[float], Field(min_length=2, max_length=2)]] = {}
    bins: dict[str, Bin] = {}
    thin: Thin | None = None

    @model_validator(mode="after")
    def _one(self) -> Self:
        if self.bins and self.thin:
            raise ValueError("rows are put into bins or thinned, not both")
        if unknown := [name for name in self.bins if name not in self.columns]:
            raise ValueError(f"bins are along {unknown[0]}, which is none of the columns")
        return self


def read_mapping(mapping: str | os.PathLike[str] | Mapping[str, Any]) -> tuple[Mapped, str]:
    """Read a mapping from a TOML file, or what such a file would hold; and its name for messages.

    Raises
    ------
    CalibError
        If the file cannot be read, or says something that is not understood.
    """
    if isinstance(mapping, Mapping):
        return _mapped(mapping, "mapping"), "mapping"
    where = os.fspath(mapping)
    try:
        return _mapped(read_toml(Path(mapping)), where), where
    except OSError as error:
        raise CalibError(
            f"the mapping cannot be read ({error.strerror})", where=where,
            hint="`calib import FILE --out my.csv` without --mapping writes one to start from",
        ) from None  # fmt: skip
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise CalibError(f"not valid TOML: {error}", where=where, hint=TOML_HINT) from None


def _mapped(content: Mapping[str, Any], where: str) -> Mapped:
    try:
        return Mapped.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
    place = ".".join(str(part) for part in first["loc"] if part != "str")
    name = str(first["loc"][-1]) if first["loc"] else ""
    known = [*Mapped.model_fields, *Source.model_fields, "from", "width", "count", "every"]
    unknown = first["type"] == "extra_forbidden"
    raise CalibError(
        f"unknown key {name}" if unknown else in_words(first),
        where=f"{where}, {place}" if place else where,
        expected='[columns] name_unit = {from = "a column of the file", unit = "N"}; also value, '
        "derive with inputs, factor; [crop], [bins] or [thin]",
        hint=meant(name, known) if unknown else "correct it",
    )


def to_unit(values: Array, unit: str, known: Mapping[str, str], wanted: str) -> Array:
    """Convert values from a unit, as column names or rigs write it, to one of pint's.

    `known` are the suffixes of its dimension and what they mean, as `calib.data.quantities.UNITS`.
    """
    bare = unit.strip("[]() ")
    spelt = known.get(normal(bare)) or SPELLINGS.get(bare.lower(), bare)
    try:
        return convert(values, spelt, wanted)
    except CalibError as error:
        raise CalibError(
            error.message,
            expected=f"a unit such as {', '.join(known) or wanted}",
            hint="correct the unit in the mapping, or the column that it is taken from",
        ) from None
