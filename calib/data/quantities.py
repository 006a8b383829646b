"""The dictionary of quantities: their names, units and the values they can have.

Inside the package every quantity has one canonical column in one unit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import inf
from types import MappingProxyType
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from calib.data.units import convert

__all__ = ["QUANTITIES", "UNITS", "Quantity", "Range"]

_RATIO = {"ratio": "dimensionless", "fraction": "dimensionless", "percent": "percent",
          "pct": "percent"}  # fmt: skip

# Suffixes are lower case, so each has one reading: mpa is MPa and mg_m3 is Mg/m3 (the milli
# readings are absurd for soil).
UNITS: Mapping[str, Mapping[str, str]] = MappingProxyType({
    "slip": _RATIO,
    "mass ratio": _RATIO | {"g_g": "dimensionless", "kg_kg": "dimensionless"},
    "volume ratio": _RATIO | {"m3_m3": "dimensionless", "cm3_cm3": "dimensionless"},
    "pressure": {
        "kpa": "kPa", "psi": "psi", "bar": "bar", "mpa": "MPa", "pa": "Pa", "hpa": "hPa",
        "mbar": "mbar", "atm": "atm", "ksi": "ksi", "kgf_cm2": "kgf/cm**2", "n_cm2": "N/cm**2",
        "n_mm2": "N/mm**2", "kn_m2": "kN/m**2", "lbf_in2": "lbf/in**2",
    },
    "force": {"kn": "kN", "n": "N", "dan": "daN", "lbf": "lbf", "kgf": "kgf", "kip": "kip"},
    "length": {"mm": "mm", "cm": "cm", "m": "m", "in": "inch", "inch": "inch", "ft": "ft"},
    "speed": {
        "m_s": "m/s", "km_h": "km/h", "kmh": "km/h", "kph": "km/h", "cm_s": "cm/s",
        "mm_s": "mm/s", "ft_s": "ft/s", "in_s": "inch/s", "mph": "mph",
    },
    "density": {
        "g_cm3": "g/cm**3", "kg_m3": "kg/m**3", "mg_m3": "Mg/m**3", "t_m3": "t/m**3",
        "kg_dm3": "kg/dm**3", "kg_l": "kg/L", "g_ml": "g/mL", "g_cc": "g/cm**3",
        "lb_ft3": "lb/ft**3", "pcf": "lb/ft**3",
    },
    "number": {},
    "label": {},
})  # fmt: skip


@dataclass(frozen=True)
class Range:
    """The values a quantity can have, in its canonical unit."""

    low: float = -inf
    high: float = inf
    low_open: bool = False
    integer: bool = False

    def holds(self, values: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return whether each value lies inside; NaN does not."""
        slack = 1e-9  # a bound written in another unit must not fail by its last bit
        above = values > self.low if self.low_open else values >= self.low - slack
        inside = above & (values <= self.high + slack)
        return inside & (values == np.round(values)) if self.integer else inside

    def describe(self, unit: str = "dimensionless", to_unit: str = "dimensionless") -> str:
        """Say the range in `to_unit`, its bounds being in `unit`."""
        low, high = (float(convert(x, unit, to_unit)) for x in (self.low, self.high))
        name = "" if to_unit == "dimensionless" else f" {to_unit.replace('**', '')}"
        what = "a whole number" if self.integer else "a number"
        if np.isfinite(low) and np.isfinite(high):
            return f"{what} from {low:g} to {high:g}{name}"
        if np.isfinite(low):
            return f"{what} {'above' if self.low_open else 'of at least'} {low:g}{name}"
        return f"{what}{f' in {name.strip()}' if name else ''}"


@dataclass(frozen=True)
class Quantity:
    """One entry of the dictionary.

    Parameters
    ----------
    stem : str
        Its name in a header, without the unit.
    canonical : str
        The column it becomes.
    kind : str
        Key of `UNITS`; also the dimension as messages call it.
    unit : str
        The canonical unit, in pint's spelling.
    role : {"output", "condition", "bookkeeping"}
    description : str
        What it is, in plain words.
    range : Range
        Values it can have.
    synonyms : tuple of str
        Other stems.
    bare_unit : str or None
        Unit of a header without a suffix; None where the suffix is compulsory.
    log_scale : bool
        Whether the models compare its logarithm, so that it must be positive when used.
    mend : str
        What to do about a value outside the range.
    """

    stem: str
    canonical: str
    kind: str
    unit: str
    role: Literal["output", "condition", "bookkeeping"]
    description: str
    range: Range = Range()
    synonyms: tuple[str, ...] = ()
    bare_unit: str | None = None
    log_scale: bool = False
    mend: str = "correct the value, its unit in the column name, or delete the row"

    @property
    def units(self) -> Mapping[str, str]:
        """Accepted suffixes and the pint units they mean."""
        return UNITS[self.kind]


_POSITIVE = Range(low=0.0, low_open=True)
_SLIP = Range(low=-1.0, high=1.0)
_ONE = "dimensionless"


def _dictionary() -> Mapping[str, Quantity]:
    entries = (
        Quantity("slip", "slip_ratio", "slip", _ONE, "condition",
                 "wheel slip; 0.2 means 20 %", _SLIP),
        Quantity("nominal_slip", "nominal_slip_ratio", "slip", _ONE, "bookkeeping",
                 "slip before its zero was redefined", _SLIP),
        Quantity("inflation_pressure", "inflation_pressure_psi", "pressure", "psi", "condition",
                 "tyre inflation (gauge) pressure", _POSITIVE),
        Quantity("average_ground_pressure", "average_ground_pressure_kpa", "pressure", "kPa",
                 "condition", "load over contact area", _POSITIVE),
        Quantity("normal_load", "normal_load_kn", "force", "kN", "condition",
                 "vertical load on the wheel", _POSITIVE,
                 synonyms=("load", "wheel_load", "vertical_load")),
        Quantity("speed", "speed_m_s", "speed", "m/s", "condition",
                 "travel speed", Range(low=0.0)),
        Quantity("pass_number", "pass_number", "number", _ONE, "condition",
                 "how often a wheel has run in this rut, the first time being 1",
                 Range(low=1.0, integer=True), bare_unit=_ONE),
        Quantity("run_order", "run_order", "number", _ONE, "bookkeeping",
                 "order in which the rows were measured", bare_unit=_ONE),
        Quantity("repeat", "repeat", "label", _ONE, "bookkeeping",
                 "label of a repetition", synonyms=("replicate",), bare_unit=_ONE),
        Quantity("run", "run", "label", _ONE, "bookkeeping",
                 "label of a test run", synonyms=("run_id",), bare_unit=_ONE),
        Quantity("gravimetric_water_content", "gravimetric_water_content", "mass ratio", _ONE,
                 "condition", "mass of water over mass of dry soil", Range(low=0.0, high=3.0),
                 synonyms=("water_content_grav",), bare_unit=_ONE),
        Quantity("volumetric_water_content", "volumetric_water_content", "volume ratio", _ONE,
                 "condition", "volume of water over volume of soil", Range(low=0.0, high=1.0),
                 synonyms=("water_content_vol",), bare_unit=_ONE),
        Quantity("cone_index", "cone_index_kpa", "pressure", "kPa", "condition",
                 "penetration resistance of a cone", _POSITIVE,
                 synonyms=("penetration_resistance",)),
        Quantity("drawbar_pull", "drawbar_pull_kn", "force", "kN", "output",
                 "net pull of the wheel; negative when it must be pushed"),
        Quantity("rut_depth", "rut_depth_mm", "length", "mm", "output",
                 "depth of the rut, or sinkage", _POSITIVE, synonyms=("sinkage",),
                 log_scale=True,
                 mend="the models compare the logarithm of the rut depth, which zero and negative "
                 "depths do not have: correct the zero of the gauge, or delete the row"),
        Quantity("bulk_density", "bulk_density_g_cm3", "density", "g/cm**3", "output",
                 "dry mass of soil over its volume", Range(low=0.3, high=3.5)),
    )  # fmt: skip
    return MappingProxyType({quantity.canonical: quantity for quantity in entries})


QUANTITIES: Mapping[str, Quantity] = _dictionary()
