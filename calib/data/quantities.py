"""Quantities: names, units and their conversion, physical roles, and how they are shown.

It is the only vocabulary: inside the package every quantity has one canonical column in one unit,
outputs are known by their stems, and effects know quantities by their physical roles. A new one is
one declaration, made known by `calib.register`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from math import inf
from types import MappingProxyType
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.data.registry import Registry
from calib.errors import CalibError

if TYPE_CHECKING:
    import pint


@cache
def _registry() -> pint.UnitRegistry:
    # Building the registry takes longer than all else in this module, and data in canonical
    # units never need it.
    import pint

    return pint.UnitRegistry()


# The usual units in SI, by definition: pint takes longer to start than a diagnosis to draw. All
# others are asked of pint.
_POUND, _INCH, _GRAVITY = 0.45359237, 0.0254, 9.80665
_USUAL: Mapping[str, Mapping[str, float]] = {
    "pressure": {
        "Pa": 1.0, "kPa": 1e3, "MPa": 1e6, "bar": 1e5, "psi": _POUND * _GRAVITY / _INCH**2,
    },
    "force": {"N": 1.0, "kN": 1e3, "lbf": _POUND * _GRAVITY, "kgf": _GRAVITY},
    "length": {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "inch": _INCH},
    "ratio": {"dimensionless": 1.0, "percent": 1e-2},
    "density": {"g/cm**3": 1e3, "kg/m**3": 1.0},
    "speed": {"m/s": 1.0, "km/h": 1.0 / 3.6},
}  # fmt: skip


@cache
def _factor(from_unit: str, to_unit: str) -> float:
    """Return how many `to_unit` one `from_unit` is."""
    for si in _USUAL.values():
        if from_unit in si and to_unit in si:
            # Fifteen digits drop the last-bit noise of chained definitions (999.9999999999999).
            return float(f"{si[from_unit] / si[to_unit]:.15g}")
    import pint

    registry = _registry()
    try:
        one, zero = (float(registry.Quantity(x, from_unit).m_as(to_unit)) for x in (1.0, 0.0))
    except (pint.UndefinedUnitError, pint.DefinitionSyntaxError) as error:
        raise CalibError(
            f"unknown unit in the conversion from {from_unit!r} to {to_unit!r} ({error})",
            expected="units known to pint, such as kPa, psi, kN, mm, g/cm**3, percent",
            hint="correct the spelling of the unit",
        ) from None
    except pint.DimensionalityError as error:
        raise CalibError(
            f"cannot convert {from_unit!r} to {to_unit!r}: {error}",
            expected="two units of the same dimension",
            hint="use a unit that measures the same quantity",
        ) from None
    if zero != 0.0:
        raise CalibError(
            f"cannot convert {from_unit!r} to {to_unit!r}: their zeros differ",
            expected="units that differ by a factor only",
            hint="use an absolute unit",
        )
    return float(f"{one:.15g}")


def convert(values: ArrayLike, from_unit: str, to_unit: str) -> NDArray[np.float64]:
    """Convert values of any shape from one unit to another; NaN stays NaN.

    Units are in pint's spelling, such as ``"kPa"``, ``"g/cm**3"`` or ``"percent"``.

    Raises
    ------
    CalibError
        If a unit is unknown, the dimensions differ or the units have different zeros.
    """
    array = np.array(values, dtype=np.float64)
    if from_unit == to_unit:
        return array
    factor = _factor(from_unit, to_unit)
    if factor >= 1.0:
        return np.asarray(array * factor)
    # 57 percent is 57/100 = 0.57 to the last bit; 57 * 0.01 is not.
    return np.asarray(array / _factor(to_unit, from_unit))


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
    "torque": {"knm": "kN*m", "nm": "N*m", "lbf_ft": "lbf*ft"},
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
        Its name in a header, without the unit; of an output, its name in results.
    canonical : str
        The column it becomes.
    kind : str
        Its dimension as messages call it: a key of `UNITS`, unless it has `suffixes` of its own.
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
    title : str
        Its name on an axis and as a heading; the stem in words by default.
    shown : tuple of (str, float), optional
        Unit in which it is drawn, and the factor from the canonical one to it.
    physical : str
        The role by which effects refer to it (``"pull"``, ``"slip"``): the stem by default.
        Several quantities may have the same one.
    of_factors : bool
        Whether factors of it count, not differences, so that what depends on it is even on its
        logarithm.
    usual : tuple of (float, float), optional
        Where values usually lie, in the canonical unit; others are read, with a warning.
    largest : tuple of (float, float), optional
        Where the largest size in a column usually lies, in the canonical unit; of vehicles' wheels.
    suffixes : mapping of str to str, optional
        Accepted unit suffixes of a header and the pint units they mean, for a dimension that is
        not in `UNITS`.
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
    hint: str = "correct the value, its unit in the column name, or delete the row"
    title: str = ""
    shown: tuple[str, float] | None = None
    physical: str = ""
    of_factors: bool = False
    usual: tuple[float, float] | None = None
    largest: tuple[float, float] | None = None
    suffixes: Mapping[str, str] | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "title", self.title or self.stem.replace("_", " ").capitalize())
        object.__setattr__(self, "physical", self.physical or self.stem)

    @property
    def units(self) -> Mapping[str, str]:
        """Accepted suffixes and the pint units they mean."""
        return UNITS.get(self.kind, {}) if self.suffixes is None else self.suffixes

    @property
    def word(self) -> str:
        """Its name in a sentence."""
        return self.stem.replace("_", " ")

    @property
    def unit_word(self) -> str:
        """The canonical unit as messages say it; empty for a plain number."""
        return self.unit.replace("dimensionless", "").replace("**", "").replace("*", " ")

    def register(self) -> None:
        """Make it known.

        Raises
        ------
        CalibError
            If its canonical column does not read as itself, its name is taken, or its units do not
            differ from the canonical one by a factor (as degrees Fahrenheit from Celsius).
        """
        for suffix, unit in (self.suffixes or {}).items():
            try:
                convert(1.0, unit, self.unit)
            except CalibError as error:
                raise CalibError(
                    error.message,
                    where=f"the quantity {self.stem}, suffix {suffix!r}",
                    expected="units that differ from the canonical one by a factor",
                    hint=f"leave {suffix!r} out, and convert such columns before they are read",
                ) from None
        if self.unit not in (*self.units.values(), self.bare_unit):
            raise CalibError(
                f"the quantity {self.stem} has no suffix for its own unit {self.unit!r}",
                expected=", ".join(sorted({*self.units.values()})) or "suffixes={suffix: unit}",
                hint="declare it with suffixes={...} that have the canonical unit among them",
            )
        ending = self.canonical.removeprefix(f"{self.stem}_")
        if self.units.get(ending) != self.unit and not (
            self.canonical == self.stem and self.bare_unit == self.unit
        ):
            raise CalibError(
                f"the column {self.canonical!r} does not name {self.stem} in {self.unit}",
                expected=f"{self.stem} and a suffix of the unit: {', '.join(self.units)}",
                hint="correct the canonical column",
            )
        mine = {self.stem, *self.synonyms}
        for other in QUANTITIES.values():
            taken = mine & {other.stem, *other.synonyms}
            if taken and other.canonical != self.canonical:
                raise CalibError(
                    f"columns called {min(taken)} are those of {other.stem} already",
                    where=f"the quantity {self.stem}",
                    expected="a stem and synonyms that name nothing else",
                    hint=f"name it otherwise, or use {other.canonical}",
                )
        QUANTITIES.add(self)


_POSITIVE = Range(low=0.0, low_open=True)
_SLIP = Range(low=-1.0, high=1.0)
_ONE = "dimensionless"


QUANTITIES: Registry[Quantity] = Registry(
    "quantity",
    lambda quantity: quantity.canonical,
    Quantity("bulk_density", "bulk_density_g_cm3", "density", "g/cm**3", "output",
             "dry mass of soil over its volume", Range(low=0.3, high=3.5),
             title="Dry bulk density", shown=("g/cm³", 1.0), physical="density"),
    Quantity("drawbar_pull", "drawbar_pull_kn", "force", "kN", "output",
             "net pull of the wheel; negative when it must be pushed", physical="pull",
             largest=(0.15, 120.0)),
    Quantity("rut_depth", "rut_depth_mm", "length", "mm", "output",
             "depth of the rut, or sinkage", _POSITIVE, synonyms=("sinkage",),
             log_scale=True, physical="sinkage", largest=(1.0, 1e3),
             hint="the models compare the logarithm of the rut depth, which zero and negative "
             "depths do not have: correct the zero of the gauge, or delete the row"),
    Quantity("driving_torque", "driving_torque_knm", "torque", "kN*m", "output",
             "torque that the axle gives to the wheel", shown=("kN m", 1.0),
             largest=(0.1, 100.0)),
    Quantity("shear_stress", "shear_stress_kpa", "pressure", "kPa", "output",
             "shear force over the sheared area", Range(low=0.0), largest=(1.0, 1e3)),
    Quantity("slip", "slip_ratio", "slip", _ONE, "condition",
             "wheel slip, 1 - v/(ωr); 0.2 means 20 %", _SLIP, shown=("%", 100.0),
             largest=(0.01, 1.0)),
    Quantity("nominal_slip", "nominal_slip_ratio", "slip", _ONE, "bookkeeping",
             "slip before its zero was redefined", _SLIP, shown=("%", 100.0),
             largest=(0.01, 1.0)),
    Quantity("inflation_pressure", "inflation_pressure_psi", "pressure", "psi", "condition",
             "tyre inflation (gauge) pressure", _POSITIVE, physical="pressure",
             usual=(6.0, 150.0)),
    Quantity("average_ground_pressure", "average_ground_pressure_kpa", "pressure", "kPa",
             "condition", "load over contact area", _POSITIVE, title="Ground pressure",
             largest=(5.0, 5e3),
             physical="ground_pressure"),
    Quantity("normal_load", "normal_load_kn", "force", "kN", "condition",
             "vertical load on the wheel", _POSITIVE, physical="load", of_factors=True,
             synonyms=("load", "wheel_load", "vertical_load"), largest=(0.3, 200.0)),
    Quantity("speed", "speed_m_s", "speed", "m/s", "condition",
             "travel speed", Range(low=0.0), of_factors=True),
    Quantity("pass_number", "pass_number", "number", _ONE, "condition",
             "how often a wheel has run in this rut, the first time being 1",
             Range(low=1.0, integer=True), bare_unit=_ONE, title="Pass", shown=("number", 1.0),
             physical="passes", of_factors=True),
    Quantity("run_order", "run_order", "number", _ONE, "bookkeeping",
             "order in which the rows were measured", bare_unit=_ONE, shown=("number", 1.0),
             physical="order"),
    Quantity("repeat", "repeat", "label", _ONE, "bookkeeping",
             "label of a repetition", synonyms=("replicate",), bare_unit=_ONE),
    Quantity("run", "run", "label", _ONE, "bookkeeping",
             "label of a test run", synonyms=("run_id",), bare_unit=_ONE),
    Quantity("gravimetric_water_content", "gravimetric_water_content", "mass ratio", _ONE,
             "condition", "mass of water over mass of dry soil", Range(low=0.0, high=3.0),
             synonyms=("water_content_grav",), bare_unit=_ONE, title="Water content",
             shown=("% of dry mass", 100.0), physical="water"),
    Quantity("volumetric_water_content", "volumetric_water_content", "volume ratio", _ONE,
             "condition", "volume of water over volume of soil", Range(low=0.0, high=1.0),
             synonyms=("water_content_vol",), bare_unit=_ONE, title="Water content",
             shown=("% of volume", 100.0), physical="water_by_volume"),
    Quantity("cone_index", "cone_index_kpa", "pressure", "kPa", "condition",
             "penetration resistance of a cone", _POSITIVE, physical="cone", of_factors=True,
             synonyms=("penetration_resistance",), largest=(20.0, 15e3)),
    Quantity("tyre_width", "tyre_width_m", "length", "m", "condition",
             "width of the tyre's section, or of a rigid wheel", _POSITIVE, of_factors=True,
             synonyms=("tire_width", "wheel_width", "section_width"), largest=(0.02, 2.0)),
    Quantity("tyre_diameter", "tyre_diameter_m", "length", "m", "condition",
             "outer diameter of the tyre or wheel, unloaded", _POSITIVE, of_factors=True,
             synonyms=("tire_diameter", "wheel_diameter"), largest=(0.05, 5.0)),
    Quantity("tyre_deflection", "tyre_deflection_mm", "length", "mm", "condition",
             "how far the load flattens the tyre on hard ground", Range(low=0.0),
             synonyms=("tire_deflection",), largest=(1.0, 500.0)),
    Quantity("section_height", "section_height_mm", "length", "mm", "condition",
             "height of the tyre's section, from rim to tread", _POSITIVE, of_factors=True,
             largest=(20.0, 1e3)),
    Quantity("contact_length", "contact_length_mm", "length", "mm", "condition",
             "length of the contact of tyre and ground, along the way of travel", _POSITIVE,
             of_factors=True, synonyms=("contact_patch_length",), largest=(10.0, 2e3)),
    Quantity("contact_width", "contact_width_mm", "length", "mm", "condition",
             "width of the contact of tyre and ground", _POSITIVE, of_factors=True,
             synonyms=("contact_patch_width",), largest=(10.0, 2e3)),
    Quantity("plate_width", "plate_width_mm", "length", "mm", "condition",
             "smaller side of a rectangular plate; diameter of a round one", _POSITIVE,
             of_factors=True, synonyms=("plate_diameter",), largest=(5.0, 2e3)),
    Quantity("shear_displacement", "shear_displacement_mm", "length", "mm", "condition",
             "how far the sheared soil has moved", Range(low=0.0), largest=(1.0, 1e3)),
    Quantity("normal_stress", "normal_stress_kpa", "pressure", "kPa", "condition",
             "normal force over the sheared area", Range(low=0.0), of_factors=True,
             largest=(0.5, 2e3)),
    group="terracalib.quantities",
)  # fmt: skip


class _Outputs(Mapping[str, str]):
    """The outputs that can be calibrated: name in results to canonical column."""

    def __getitem__(self, name: str) -> str:
        for quantity in QUANTITIES.values():
            if quantity.role == "output" and quantity.stem == name:
                return quantity.canonical
        raise KeyError(name)

    def __iter__(self) -> Iterator[str]:
        return (q.stem for q in QUANTITIES.values() if q.role == "output")

    def __len__(self) -> int:
        return sum(q.role == "output" for q in QUANTITIES.values())


OUTPUTS: Mapping[str, str] = _Outputs()


@cache
def _columns_of(physical: str, _version: int) -> tuple[str, ...]:
    return tuple(c for c, q in QUANTITIES.items() if physical in (q.physical, c))


def columns_of(physical: str) -> tuple[str, ...]:
    """Return the canonical columns that have a physical role, or are named so themselves."""
    return _columns_of(physical, QUANTITIES.version)


def role_of(column: str) -> str:
    """Return the physical role of a canonical column."""
    return QUANTITIES[column].physical if column in QUANTITIES else column


def output_of(column: str) -> str:
    """Return the name in results of an output's canonical column."""
    return QUANTITIES[column].stem


def physical_role(output: str) -> str:
    """Return the role by which effects know an output."""
    return QUANTITIES[OUTPUTS[output]].physical
