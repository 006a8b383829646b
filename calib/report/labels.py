"""Names and units as a reader writes them, and declarations in words."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from calib.data.checks import stretches
from calib.data.files import plain_number
from calib.data.quantities import QUANTITIES, Quantity, columns_of, convert
from calib.data.table import accepted_headers, parse_header
from calib.errors import CalibError, meant
from calib.gap.constants import FORM_ERROR
from calib.gap.effects import EFFECTS, Effect
from calib.gap.hypotheses import read_effect_priors
from calib.inference.prior_files import default_priors, read_priors
from calib.inference.priors import Prior
from calib.models import MODELS, Model
from calib.models.base import Array
from calib.models.card import text
from calib.report.numbers import MINUS as MINUS
from calib.report.numbers import NOTHING, format_number

NO_UNIT = NOTHING

_GREEK = {
    "sigma": "\N{GREEK SMALL LETTER SIGMA}",
    "gamma": "\N{GREEK SMALL LETTER GAMMA}",
    "nu": "\N{GREEK SMALL LETTER NU}",
    "theta": "\N{GREEK SMALL LETTER THETA}",
    "tau": "\N{GREEK SMALL LETTER TAU}",
}


# Units by canonical column in which a page shows its values, where they are not the usual ones.
_UNITS: ContextVar[Mapping[str, str]] = ContextVar("units of a page", default=MappingProxyType({}))


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

    def titled(self, word: str) -> str:
        """Return a label for values of some kind, such as predicted ones."""
        return f"{word} {self.name.lower()} ({self.unit})"

    def scale(self, values: Array) -> Array:
        """Convert from the canonical unit."""
        return np.asarray(values) * self.factor

    def range_text(self, values: Array) -> str:
        """Say from where to where values go, and from where again after a wide gap."""
        ends = [[self.value_text(end) for end in part] for part in stretches(values)]
        return joined([f"{' to '.join(dict.fromkeys(part))} {self.unit}" for part in ends])

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
    if own not in (quantity.unit, "dimensionless", "percent"):
        factor = float(convert(1.0, quantity.unit, own))
        return Axis(quantity.title, unit_plain(own.replace("**", "^").replace("*", " ")), factor)
    unit = quantity.unit.replace("**", "^").replace("*", " ").replace("dimensionless", NO_UNIT)
    return Axis(quantity.title, *(quantity.shown or (degrees(unit), 1.0)))


def parameter_unit(unit: str, columns: Iterable[str]) -> tuple[str, float]:
    """Return a parameter's unit made of those in which `axis_of` shows columns, and the factor.

    Of two columns of one usual unit the first counts. What has a power that is a parameter stays.
    """
    axes: dict[str, Axis] = {}
    for column in columns:
        usual = QUANTITIES[column].unit.replace("**", "^").replace("*", " ")
        axes.setdefault(degrees(usual), axis_of(column))
    if unit in axes:
        return axes[unit].unit, axes[unit].factor
    factor = 1.0

    def shown(part: re.Match[str]) -> str:
        nonlocal factor
        axis = axes.get(part["unit"])
        if axis is None:
            return part[0]
        factor *= axis.factor ** ((-1 if part["per"] == "/" else 1) * int(part["power"] or 1))
        whole = axis.unit if re.fullmatch(r"\w+", axis.unit) else f"({axis.unit})"
        return f"{part['per']}{whole}{f'^{part["power"]}' if part['power'] else ''}"

    parts = r"(?P<per>^|[/ ])(?P<unit>[A-Za-z]+)(?:\^(?P<power>-?\d+))?(?=[/ ]|$)"
    return re.sub(parts, shown, unit), factor


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


def unit_after(unit: str) -> str:
    """Return a unit to put after a number, with a space; nothing where there is none."""
    if unit in ("1", "", "dimensionless"):
        return ""
    return " %" if unit == "percent" else f" {degrees(unit)}"


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
    """Join words as a sentence does; none give nothing."""
    return "".join(words) if len(words) < 2 else f"{', '.join(words[:-1])} and {words[-1]}"


def unbroken(text: str) -> str:
    """Keep numbers and their units on one line."""
    return re.sub(r"(\d) (%|kN|mm|psi|kPa|g/cm³|rows?\b)", "\\1\N{NO-BREAK SPACE}\\2", text)


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Lay rows of a table out as lines of text whose columns begin below each other."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ("  ".join(map(str.ljust, row, widths)) for row in rows)
    return [line.rstrip() for line in lines]


type Facts = dict[str, Any]

ROLES = {
    "output": "An output: models predict it.",
    "condition": "A condition: models predict from it, effects may need it.",
    "bookkeeping": "Bookkeeping: no model predicts from it.",
}
NOISE = {
    "log": "Noise is normal on the logarithm of the output: `sigma` is a relative scatter.",
    "identity": "Noise is normal on the output itself, in its unit.",
}
_ALONG = {
    "size": "its size", "slip": "slip", "pressure": "inflation pressure", "cone": "cone index",
    "water": "water content", "shape": "what it is named for",
    "extrapolation": "pressures that the simulator was not fitted at",
}  # fmt: skip


def model_priors(model: Model) -> tuple[Prior, ...]:
    """Return a model's priors; those that are a part of a column's median, of their defaults."""
    names = (*model.parameters, "sigma")
    return read_priors(default_priors(model.name), model.name, names, {}).entries


def role_columns(roles: Iterable[str], *, output: bool) -> list[str]:
    """Return the columns of all quantities that have some physical roles, outputs or not."""
    return [
        c for role in roles for c in columns_of(role) if (QUANTITIES[c].role == "output") == output
    ]


def how_testable(effect: Effect, link: Callable[[str], str] = str) -> list[str]:
    """Say what a diagnosis needs to test an effect, a sentence each; columns as `link` has them."""

    def named(roles: Iterable[str], *, output: bool) -> str:
        return ", ".join(map(link, role_columns(roles, output=output)))

    one_of = "one of " if len(effect.outputs) > 1 else ""
    found = [f"The case models {one_of}{named(effect.outputs, output=True)}."]
    if effect.needs:
        found.append(
            f"Among them must be {named(effect.needs, output=True)}: its trace in the others could "
            "be another effect's as well."
        )
    if effect.covariates:
        found.append(f"The field records {named(effect.covariates, output=False)}.")
        if effect.varies:
            found.append("This varies in the field, or differs from the laboratory's.")
    return found


def form_words(effect: Effect) -> str:
    """Say how far an effect may depart from its formula."""
    if not effect.form:
        return "The formula is taken as exact."
    errors = ", ".join(f"{FORM_ERROR[f]:g} along {_ALONG[f]}" for f in effect.form)
    return (
        f"No formula is exact: its effect may depart from it (relative sd {errors}), but not "
        "change its sign."
    )


def known_words(effect: Effect) -> list[str]:
    """Say what is known of an effect whatever its formula, a sentence for each output."""
    found = []
    for known in effect.known:
        parts = []
        if known.sign:
            parts.append(f"is never {'negative' if known.sign > 0 else 'positive'}")
        parts += [f"is nothing {_zero(condition)}" for condition in known.zero_at]
        parts += [f"does not shrink as {_word(c)} grows" for c in known.grows_with]
        parts += [f"takes no more than {known.at_most}"] * bool(known.at_most)
        found.append(f"What it adds to the {known.output} {joined(parts)}.")
    return found


def _zero(role: str) -> str:
    return "at no slip" if role == "slip" else f"at the laboratory's {_word(role)}"


def _word(role: str) -> str:
    columns = role_columns([role], output=False)
    return QUANTITIES[columns[0]].title.lower() if columns else role


def users(quantity: Quantity) -> dict[str, list[str]]:
    """Return the names of the models and effects that a quantity is for; the empty left out."""
    column, role = quantity.canonical, quantity.physical
    output = quantity.role == "output"
    found = {
        "predicted by models": [n for n, m in MODELS.items() if m.output == column],
        "used by models": [n for n, m in MODELS.items() if column in m.conditions],
        "touched by effects": [n for n, e in EFFECTS.items() if output and role in e.outputs],
        "needed by effects": [n for n, e in EFFECTS.items() if not output and role in e.covariates],
    }
    return {how: names for how, names in found.items() if names}


def model_facts(model: Model) -> Facts:
    """Return what a model is, as text, lists and mappings."""
    return {
        "title": model.title,
        "equation": model.equation,
        "where": re.sub(r"\[\$(\w+)\]", r"\1", model.letters),
        "after": model.source,
        "limits": model.applies,
        "output": model.output,
        "conditions": list(model.conditions),
        "columns": {c: _unit_and_range(QUANTITIES[c]) for c in (model.output, *model.conditions)},
        "noise": NOISE[model.response],
        "parameters": list(model.parameters),
        "meanings": dict(model.meanings),
        "priors": _priors(model_priors(model)),
    }


def effect_facts(effect: Effect) -> Facts:
    """Return what an effect is, as text, lists and mappings."""
    return {
        "title": effect.title,
        "equation": ", ".join(text(part) for part in effect.latex),
        "testable": " ".join(how_testable(effect)),
        "form": form_words(effect),
        "known": " ".join(known_words(effect)),
        "outputs": role_columns(effect.outputs, output=True),
        "covariates": role_columns(effect.covariates, output=False),
        "parameters": list(effect.parameters),
        "priors": _priors(read_effect_priors(effect, {}).entries),
    }


def quantity_facts(quantity: Quantity) -> Facts:
    """Return what a quantity is, as text, lists and mappings."""
    return {
        "title": f"{quantity.title}: {quantity.description}",
        "role": ROLES[quantity.role],
        "unit": _unit(quantity.unit),
        "allowed": quantity.range.describe(quantity.unit, quantity.unit),
        "known to effects as": quantity.physical,
        "also called": list(quantity.synonyms),
        "columns": {
            header: _unit(column.unit)
            for header in accepted_headers(quantity)
            if (column := parse_header(header)) is not None
        },
        **users(quantity),
    }


def declared[T](what: str, known: Mapping[str, T], name: str) -> T:
    """Return a declaration by its name.

    Raises
    ------
    CalibError
        If there is none, with those that there are.
    """
    if name not in known:
        raise CalibError(
            f"there is no {what} {name!r}", expected=", ".join(known),
            hint=f"{meant(name, known, 'correct the name,')} or name the file that declares "
            f"the {what}",
        )  # fmt: skip
    return known[name]


def _unit_and_range(quantity: Quantity) -> str:
    return f"{_unit(quantity.unit)}; {quantity.range.describe(quantity.unit, quantity.unit)}"


def _unit(unit: str) -> str:
    return unit.replace("**", "^")


def _priors(entries: Iterable[Prior]) -> dict[str, dict[str, str]]:
    return {
        p.name: {"prior": p.text, "unit": p.unit, "why": p.reason, "source": p.source}
        for p in entries
    }
