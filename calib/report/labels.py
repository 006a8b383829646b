"""Names and units as a reader writes them, for axes (mathtext) and sentences (plain text)."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from calib.data.headers import parse_header
from calib.data.numbers import plain_number
from calib.data.quantities import QUANTITIES
from calib.data.units import convert
from calib.errors import CalibError
from calib.models.base import Array
from calib.report.numbers import NOTHING, format_number

NO_UNIT = NOTHING
MINUS = "\N{MINUS SIGN}"

_GREEK = {
    "sigma": "\N{GREEK SMALL LETTER SIGMA}",
    "gamma": "\N{GREEK SMALL LETTER GAMMA}",
    "nu": "\N{GREEK SMALL LETTER NU}",
    "theta": "\N{GREEK SMALL LETTER THETA}",
}


# Units by canonical column in which a page shows its values, where they are not the usual ones.
_UNITS: ContextVar[Mapping[str, str]] = ContextVar("units of a page", default=MappingProxyType({}))
_FRACTIONS = ("dimensionless", "percent")


@contextmanager
def units_of(headers: Iterable[str]) -> Iterator[None]:
    """Have `axis_of` show values in the units of a file, which its column names say.

    Of two columns of one quantity the first counts. Fractions are shown in percent all the same.
    """
    units: dict[str, str] = {}
    for header in headers:
        try:
            column = parse_header(header)
        except CalibError:  # not from a file that was read
            continue
        if column is not None:
            units.setdefault(column.quantity.canonical, column.unit)
    before = _UNITS.set(units)
    try:
        yield
    finally:
        _UNITS.reset(before)


@dataclass(frozen=True)
class Axis:
    """How a canonical column is drawn: in words, and by a factor from the canonical unit."""

    name: str
    unit: str
    factor: float = 1.0

    @property
    def label(self) -> str:
        """For an axis."""
        return f"{self.name} ({self.unit})"

    def scale(self, values: Array) -> Array:
        """Convert from the canonical unit."""
        return np.asarray(values) * self.factor

    def range_text(self, values: Array) -> str:
        """Say from where to where values go."""
        low, high = (self.value_text(float(f(values))) for f in (np.min, np.max))
        return f"{low} to {high} {self.unit}"

    def value_text(self, value: float) -> str:
        """Write one value, without the unit: whole numbers whole."""
        scaled = self.factor * value
        text = f"{scaled:.0f}" if abs(scaled) >= 1000.0 else plain_number(scaled)
        return text.replace("-", MINUS)


def axis_of(column: str) -> Axis:
    """Return how a canonical column is drawn."""
    quantity = QUANTITIES.get(column)
    if quantity is None:
        return Axis(column.replace("_", " ").capitalize(), NO_UNIT)
    own = _UNITS.get().get(column, quantity.unit)
    if own not in (quantity.unit, *_FRACTIONS):
        factor = float(convert(1.0, quantity.unit, own))
        return Axis(quantity.title, unit_plain(own.replace("**", "^").replace("*", " ")), factor)
    unit = quantity.unit.replace("**", "^").replace("*", " ").replace("dimensionless", NO_UNIT)
    return Axis(quantity.title, *(quantity.shown or (degrees(unit), 1.0)))


def stem_and_subscript(name: str) -> tuple[str, str]:
    """Split a parameter's name: ``K_lo`` into K and lo, ``C3`` into C and 3."""
    stem, _, below = name.partition("_")
    digits = re.fullmatch(r"([A-Za-z]+)(\d+)", stem)
    if digits and not below:
        stem, below = digits.groups()
    if not below and len(stem) == 2 and stem[0].isupper() and stem[1].islower():
        stem, below = stem[0], stem[1]
    return stem, below


def symbol(name: str) -> str:
    """Return a parameter's symbol in mathtext: ``K_lo`` as K with a subscript."""
    stem, below = stem_and_subscript(name)
    stem = f"\\{stem}" if stem in _GREEK else stem
    return f"${stem}_\\mathrm{{{below}}}$" if below else f"${stem}$"


def plain(name: str) -> str:
    """Return a parameter's symbol for a sentence."""
    stem, _, below = name.partition("_")
    stem = _GREEK.get(stem, stem)
    return f"{stem}_{below}" if below else stem


def degrees(unit: str) -> str:
    """Write degrees of temperature, ``degC`` to the program, with their sign."""
    return re.sub(r"\bdeg(?=[CF]\b)", "\N{DEGREE SIGN}", unit)


def unit_text(unit: str) -> str:
    """Return a unit in mathtext: powers raised; an en dash where there is none."""
    if unit in ("1", "", "dimensionless"):
        return NO_UNIT
    return re.sub(r"\^(-?\w+)", r"$^{\1}$", degrees(unit))


def unit_plain(unit: str) -> str:
    """Return a unit for a sentence: small powers as superscripts, nothing where there is none."""
    if unit in ("1", "", "dimensionless"):
        return ""
    return degrees(unit).replace("^2", "²").replace("^3", "³")


def parameter_label(name: str, unit: str, *, log: bool = False) -> str:
    """Return symbol and unit of a parameter for an axis."""
    inside = symbol(name)
    if log:
        inside = f"log$_{{10}}$ {inside}"
    return f"{inside} ({unit_text(unit)})"


def short(value: float, digits: int = 2) -> str:
    """Write a number with few significant digits."""
    return format_number(value, digits)


def percent(fraction: float) -> str:
    """Write a fraction as a percentage with two significant digits."""
    return f"{short(100.0 * fraction)} %"


def percent_range(ends: tuple[float, float]) -> str:
    """Write two fractions as whole percentages, from one to the other."""
    low, high = (f"{100.0 * end:.0f}".replace("-", MINUS) for end in ends)
    return f"{low} to {high} %"


def odds_text(p: float) -> str:
    """Write a probability as a percentage without claiming certainty."""
    if p > 0.995:
        return "above 99 %"
    return "below 1 %" if p < 0.01 else f"{100.0 * p:.0f} %"


def joined(words: list[str]) -> str:
    """Join words as a sentence does."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def unbroken(text: str) -> str:
    """Keep numbers and their units on one line."""
    return re.sub(r"(\d) (%|kN|mm|psi|kPa|g/cm³|rows?\b)", "\\1\N{NO-BREAK SPACE}\\2", text)


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Lay rows of a table out as lines of text whose columns begin below each other."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ("  ".join(map(str.ljust, row, widths)) for row in rows)
    return [line.rstrip() for line in lines]
