"""Quantities: names, units and their conversion, physical roles, and how they are shown.

It is the only vocabulary: inside the package every quantity has one canonical column in one unit,
outputs are known by their stems, and effects know quantities by their physical roles. The shipped
ones stand in `quantities.toml`; a new one is one declaration, made known by `calib.register`.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from math import inf
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.data.registry import Registry
from calib.errors import FAULTS, CalibError

_SHIPPED = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
UNITS: Mapping[str, Mapping[str, str]] = _SHIPPED["units"]


@cache
def _pint() -> Any:
    import pint  # late: it takes longer to start than a diagnosis to draw

    return pint, pint.UnitRegistry()


@cache
def _factor(from_unit: str, to_unit: str) -> float:
    """Return how many `to_unit` one `from_unit` is.

    Fifteen digits drop the last-bit noise of chained definitions (999.9999999999999).
    """
    for si in _SHIPPED["si"].values():
        if from_unit in si and to_unit in si:
            return float(f"{si[from_unit] / si[to_unit]:.15g}")
    pint, registry = _pint()
    try:
        one, zero = (float(registry.Quantity(x, from_unit).m_as(to_unit)) for x in (1.0, 0.0))
    except pint.DimensionalityError as error:
        raise CalibError(
            f"cannot convert {from_unit!r} to {to_unit!r}: {error}",
            expected="two units of the same dimension",
            hint="use a unit that measures the same quantity",
        ) from None
    # Pint reads a unit as a Python expression, and fails on what is none in many ways.
    except Exception as error:
        raise CalibError(
            f"unknown unit in the conversion from {from_unit!r} to {to_unit!r} ({error})",
            expected="units known to pint, such as kPa, psi, kN, mm, g/cm**3, percent",
            hint="correct the spelling of the unit",
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
    # 57 percent is 57/100 = 0.57 to the last bit; 57 * 0.01 is not.
    return np.asarray(array * factor if factor >= 1.0 else array / _factor(to_unit, from_unit))


# Fewer texts than `float` takes ("1_000", digits of other scripts); Fortran writes 1.5D3.
_NUMBER = re.compile(
    r"[-+]?(?:(?:\d+\.?\d*|\.\d+)(?:[eEdD][-+]?\d+)?|nan|inf(?:inity)?)", re.ASCII | re.IGNORECASE
)


def real_array(found: Any, unit: str = "dimensionless") -> NDArray[np.float64]:
    """Return what a model or simulator gave as numbers in a unit, of any shape, copied.

    What carries a unit is converted from it, and what carries none is in `unit`. What is masked or
    missing (None, NA) within an array is NaN: it has no value.

    Raises
    ------
    CalibError
        If it is none of real numbers, cannot be converted, or its order is not that of the rows.
    """
    if found is None:
        raise _refused("it is nothing (None)", unit)
    with np.errstate(all="ignore"):  # overflow of a wider type is infinite, which is no value
        return _real(found, unit)


def _real(found: Any, unit: str) -> NDArray[np.float64]:
    if found is None or type(found).__name__ == "NAType":
        return np.array(np.nan)
    if isinstance(found, str):
        if not _NUMBER.fullmatch(found.strip()):
            raise _refused(f"the text {found!r} is no number", unit)
        return np.array(float(re.sub(r"(?<=[\d.])[dD]", "e", found)))
    if type(found) is np.ndarray:
        return _of_array(found, unit)
    _check_order(found, unit)
    own = _unit_of(found)
    if own is not None:
        return convert(_real(_without_unit(found), "dimensionless"), own, unit)
    mask = getattr(found, "mask", None)
    if isinstance(mask, np.ndarray | np.bool_):
        return np.where(mask, np.nan, _real(np.where(mask, 0, np.asarray(found)), unit))
    if isinstance(found, Sequence) and not isinstance(found, bytes | bytearray):
        return _of_parts(found, unit)
    inner = _inner(found)
    if inner is not None:
        return _real(inner, unit)
    name = type(found).__name__
    if isinstance(found, bool) or not hasattr(found, "__float__"):
        raise _refused(f"it is of the type {name}", unit)
    try:
        return np.array(float(found))
    except (*FAULTS, ArithmeticError) as error:
        raise _refused(f"{name} is no number of double precision ({error})", unit) from None


def _of_array(found: NDArray[Any], unit: str) -> NDArray[np.float64]:
    match found.dtype.kind:
        case "f" | "i" | "u":
            return found.astype(np.float64)
        case "c":
            missing = np.isnan(found)
            size = np.abs(np.where(missing, 0.0, found.imag)).max(initial=0.0)
            if size > 0.0:
                raise _refused(f"it is complex, with imaginary parts up to {size:g}", unit)
            return np.where(missing, np.nan, found.real).astype(np.float64)
        case "O" | "U":
            return _of_parts(found.ravel().tolist(), unit).reshape(found.shape)
        case _:
            raise _refused(f"it is of the type {found.dtype}", unit)


def _of_parts(found: Sequence[Any], unit: str) -> NDArray[np.float64]:
    parts = [_real(part, unit) for part in found]
    if len({part.shape for part in parts}) > 1:
        raise _refused("its rows differ in length", unit)
    return np.stack(parts) if parts else np.empty(0)


def _inner(found: Any) -> Any:
    """Return the array that something stands for, if any."""
    if isinstance(found, np.ndarray | np.generic | complex):
        return np.asarray(found)
    # Labelled arrays hold others, which may have units; a conversion would lose them.
    held = getattr(found, "data", None) if hasattr(found, "dims") else None
    if held is not None and type(held) is not type(found):
        return held
    if not hasattr(found, "__array__"):
        return None
    try:
        return np.asarray(found)
    except (*FAULTS, ArithmeticError) as error:
        what = f"{type(found).__name__} is no array of numbers ({error})"
        raise _refused(what, "dimensionless") from None


def _unit_of(found: Any) -> str | None:
    """Return the unit that something carries, as quantities of Pint, Astropy and unyt do."""
    attributes = getattr(found, "attrs", None)
    noted = attributes if isinstance(attributes, Mapping) else {}
    for name in ("units", "unit"):
        unit = noted.get(name, getattr(found, name, None))
        if unit is not None and not callable(unit):
            return "dimensionless" if str(unit) in ("", "1") else str(unit)
    return None


def _without_unit(found: Any) -> Any:
    for name in ("magnitude", "value"):
        inner = getattr(found, name, None)
        if inner is not None and not callable(inner):
            return inner
    if isinstance(found, np.ma.MaskedArray):
        return np.ma.array(np.asarray(found), mask=np.ma.getmaskarray(found))
    inner = _inner(found)
    if inner is None:
        what = f"{type(found).__name__} has a unit, but no numbers"
        raise _refused(what, "dimensionless")
    return inner


def _check_order(found: Any, unit: str) -> None:
    """Check that the labels of what is labelled, as in pandas, are those of the rows in order."""
    labels, axes = getattr(found, "indexes", None), getattr(found, "axes", None)
    if isinstance(labels, Mapping):
        axes = list(labels.values())
    for axis in axes if isinstance(axes, list) else []:
        with suppress(*FAULTS):
            if np.array_equal(np.asarray(axis), np.arange(len(axis))):
                continue
        raise _refused(
            f"its rows are labelled {', '.join(map(str, list(axis)[:3]))}, not 0, 1, 2 in order",
            unit,
            "return them in the order of the conditions, without labels (to_numpy)",
        )


def _refused(what: str, unit: str, hint: str = "") -> CalibError:
    plain = "real numbers" if unit == "dimensionless" else f"real numbers in {unit}"
    return CalibError(
        what,
        expected=f"{plain}, or what has a unit of its own; NaN for no value",
        hint=hint or f"return {plain} with a decimal point, or NaN where there is no value",
    )


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
    """One entry of the vocabulary.

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
        Its meaning in plain words.
    range : Range
        Values it can have.
    synonyms : tuple of str
        Other stems.
    bare_unit : str or None
        Unit of a header without a suffix; None where the suffix is compulsory.
    log_scale : bool
        Whether the models compare its logarithm, so that it must be positive when used.
    hint : str
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
    def stems(self) -> tuple[str, ...]:
        """Its stem and the synonyms."""
        return self.stem, *self.synonyms

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
        for other in QUANTITIES.values():
            taken = set(self.stems) & set(other.stems)
            if taken and other.canonical != self.canonical:
                raise CalibError(
                    f"columns called {min(taken)} are those of {other.stem} already",
                    where=f"the quantity {self.stem}",
                    expected="a stem and synonyms that name nothing else",
                    hint=f"name it otherwise, or use {other.canonical}",
                )
        QUANTITIES.add(self)


def _shipped() -> Iterator[Quantity]:
    for stem, entry in _SHIPPED["quantities"].items():
        fields: dict[str, Any] = {
            key: tuple(value) if isinstance(value, list) else value for key, value in entry.items()
        }
        yield Quantity(stem, **(fields | {"range": Range(**entry.get("range", {}))}))


QUANTITIES: Registry[Quantity] = Registry(
    "quantity", lambda quantity: quantity.canonical, *_shipped(), group="terracalib.quantities"
)


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


def columns_of(physical: str) -> tuple[str, ...]:
    """Return the canonical columns that have a physical role, or are named so themselves."""
    return tuple(c for c, q in QUANTITIES.items() if physical in (q.physical, c))


def role_of(column: str) -> str:
    """Return the physical role of a canonical column."""
    return QUANTITIES[column].physical if column in QUANTITIES else column


def output_of(column: str) -> str:
    """Return the name in results of an output's canonical column."""
    return QUANTITIES[column].stem


def physical_role(output: str) -> str:
    """Return the role by which effects know an output."""
    return QUANTITIES[OUTPUTS[output]].physical
