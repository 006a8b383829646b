"""Words about a diagnosis: its template's sentences, and how quantities in them are written."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import count
from typing import Any

import numpy as np

from calib.data.files import plain_number
from calib.data.quantities import OUTPUTS, QUANTITIES, physical_role, role_of
from calib.gap.case import words_of
from calib.gap.constants import ALIKE
from calib.gap.describe import gap_document
from calib.gap.diagnose import Diagnosis
from calib.gap.document import BENCH, Cause, Explanation, GapDocument, Next, Size
from calib.gap.effects.dependence import PREFIX
from calib.gap.effects.instruments import EARLY
from calib.gap.mixture import Region
from calib.report.gap_verdict import SURE, GapVerdict, judge, rivals, tied
from calib.report.labels import (
    MINUS,
    NO_UNIT,
    Axis,
    axis_of,
    joined,
    odds_text,
    percent,
    percent_range,
    short,
)
from calib.report.numbers import format_value
from calib.report.page.template import template

# What is less probable is not spoken of: as a percentage it is below 5.
_SHOWN = 0.045

_NAMES = {
    "none": "none (noise)", "unknown": "unknown effect", "parameter_shift": "parameter shift",
}  # fmt: skip
_TITLES = {
    "none": "no gap beyond the noise",
    "unknown": "a real gap that nothing listed explains",
    "parameter_shift": "the same model with other parameter values",
}
_FACTS = {
    "Causes": "causes", "Known beforehand": "known", "Which": "which", "Not tested": "untested",
    "Assumed": "assumed", "How large": "how_large", "Where": "where", "How far": "how_far",
}  # fmt: skip


def short_name(name: str) -> str:
    """Return an explanation's, a cause's or a parameter's name in words."""
    if name in _NAMES:
        return _NAMES[name]
    return " + ".join(
        "something unlisted" if part == "unknown" else part.replace("_", " ")
        for part in name.split("+")
    )


def chance(p: float) -> str:
    """Write a probability in a figure, without claiming certainty."""
    return odds_text(p).replace("above", ">").replace("below", "<")


def _cause_name(cause: Explanation | Cause) -> str:
    unlisted = isinstance(cause, Cause) and cause.name == "unknown"
    return "something unlisted" if unlisted else short_name(cause.name)


class Notation:
    """How the quantities of a diagnosis are written, in the units of its files.

    Use it within `calib.report.labels.units_of` of the document's headers.
    """

    finite = staticmethod(math.isfinite)
    range = staticmethod(percent_range)
    name = staticmethod(short_name)
    chance = staticmethod(chance)
    bench, early_check, alike_from = BENCH, EARLY, f"{ALIKE:g}"

    def __init__(self, d: GapDocument) -> None:
        self.d = d
        self.rivals = rivals

    # Quantities, by the name of an output or by a column

    def axis(self, quantity: str) -> Axis:
        """Return how an output or a column is written: pulls of a small wheel in newtons."""
        column = OUTPUTS.get(quantity, quantity)
        axis = axis_of(column)
        own = [o.measured for o in self.d.outputs if OUTPUTS[o.name] == column]
        if own and axis.unit == "kN" and np.abs(own[0]).max() < 0.1:
            return Axis(axis.name, "N", 1000.0)
        return axis

    def _with_unit(self, quantity: str, text: str) -> str:
        unit = self.axis(quantity).unit
        return text if unit in ("number", NO_UNIT) else f"{text} {unit}"

    def output(self, name: str) -> str:
        """Write an output's name."""
        return name.replace("_", " ")

    def outputs(self, names: Iterable[str]) -> str:
        """Write several outputs' names."""
        return joined([self.output(n) for n in names])

    def names(self, names: Iterable[str]) -> str:
        """Write the names of several explanations or causes."""
        return joined([short_name(name) for name in names])

    def is_sinkage(self, output: str) -> bool:
        """Say whether an output is a depth."""
        return physical_role(output) == "sinkage"

    def unit_word(self, output: str) -> str:
        """Return the canonical unit of an output."""
        return QUANTITIES[OUTPUTS[output]].unit_word

    def quantity(self, column: str) -> str:
        """Write a condition's name."""
        return self.axis(column).name.lower()

    def plain(self, quantity: str, value: float) -> str:
        """Write a number without its unit."""
        return short(self.axis(quantity).factor * value).replace("-", MINUS)

    def value(self, quantity: str, value: float) -> str:
        """Write a number."""
        return self._with_unit(quantity, self.plain(quantity, value))

    def amount(self, quantity: str, mean: float, sd: float) -> str:
        """Write mean and sd."""
        factor = self.axis(quantity).factor
        return self._with_unit(quantity, format_value(factor * mean, factor * sd))

    def shift(self, column: str, mean: float, sd: float) -> str:
        """Write by how much a condition differs."""
        axis = self.axis(column)
        unit = "percentage points" if axis.unit == "%" else axis.unit
        return f"{format_value(abs(axis.factor * mean), axis.factor * sd)} {unit}"

    def change(self, s: Size) -> str:
        """Write by how much an output differs."""
        if s.relative:
            return f"{format_value(abs(100.0 * s.mean), 100.0 * s.sd)} %"
        return self.amount(s.quantity, abs(s.mean), s.sd)

    def interval(self, r: Region) -> str:
        """Write the 90 % interval of a region's mean gap."""
        return " to ".join(self.plain(r.output, end) for end in r.interval)

    def gap_range(self, r: Region) -> str:
        """Write the 90 % interval of a region's mean gap, positive in its direction."""
        ends = sorted(math.copysign(1.0, r.gap) * end for end in r.interval)
        return " to ".join(self.plain(r.output, end) for end in ends)

    def _number(self, column: str, value: float) -> str:
        value *= self.axis(column).factor
        if role_of(column) in ("slip", "order"):
            return self.count(value)
        return self.signed(value, 2 if abs(value) < 10.0 else 3)

    def count(self, value: float) -> str:
        """Write a whole number."""
        return f"{value:.0f}".replace("-", MINUS)

    def whole(self, ratio: float) -> str:
        """Write a ratio as a whole percentage, without the sign."""
        return self.count(100.0 * ratio)

    def signed(self, value: float, digits: int = 3) -> str:
        """Write a number without trailing zeros."""
        return plain_number(value, digits).replace("-", MINUS)

    def stretch(self, column: str, low: float, high: float) -> str:
        """Write a stretch of a condition, or the values of a category."""
        text = words_of(self.d.covariates, column, low, high)
        if not text:
            ends = dict.fromkeys(self._number(column, end) for end in (low, high))
            text = self._with_unit(column, " to ".join(ends))
        return f"{self.quantity(column)} {text}"

    def condition(self, column: str, value: float) -> str:
        """Write the value of a condition."""
        return self.stretch(column, value, value)

    def conditions(self, values: Mapping[str, float]) -> str:
        """Write the values of several conditions."""
        return joined([self.condition(column, value) for column, value in values.items()])

    def region(self, r: Region) -> str:
        """Write where a region lies."""
        column, (low, high) = next(iter(r.conditions.items()))
        rows = next(o.rows for o in self.d.outputs if o.name == r.output)
        values = np.array(self.d.conditions[column])[list(rows)]
        everywhere = low <= values.min() and high >= values.max()
        return "all conditions measured" if everywhere else self.stretch(column, low, high)

    # Choices from the document

    def title(self, name: str) -> str:
        """Say what an explanation claims."""
        if name in _TITLES:
            return _TITLES[name]
        known = {**self.d.titles, "parameter_shift": _TITLES["parameter_shift"]}
        return ", and ".join(known.get(part) or short_name(part) for part in name.split("+"))

    def probable[T: (Explanation, Cause)](self, items: Iterable[T]) -> list[T]:
        """Return what is probable enough to be spoken of."""
        return [item for item in items if item.probability >= _SHOWN]

    def listed(self, items: Iterable[Any], words: Mapping[str, str] | None = None) -> str:
        """List explanations, causes, or pairs of a name and a probability."""
        pairs = (i if isinstance(i, tuple) else (_cause_name(i), i.probability) for i in items)
        return joined([f"{(words or {}).get(name, name)} ({odds_text(p)})" for name, p in pairs])

    def tied(self) -> list[Explanation]:
        """Return the explanations that are about as probable as the first."""
        return tied(self.d)

    def listed_causes(self, e: Explanation) -> list[str]:
        """Return the listed causes of an explanation."""
        return [name for name in e.name.split("+") if name != "unknown"]

    def unusable(self) -> list[str]:
        """Return what was put in as suspected or sized, and cannot be tested."""
        names = dict.fromkeys(self.d.suspected)
        return [name for name in names if name in self.d.not_testable]

    def without(self) -> str:
        """List the causes that act without what was put in."""
        p = self.d.without_context or {}
        words = {"none": "no gap", "unknown": "something unlisted"}
        leading = sorted((n for n in p if p[n] >= _SHOWN), key=lambda n: -p[n])[:4]
        return joined([f"{words.get(n, short_name(n))} ({odds_text(p[n])})" for n in leading])

    def alike(self) -> list[str]:
        """Return the effects that look like the best explanation, in words."""
        best = self.d.best.name
        pairs = [pair for pair in self.d.design.alike if best in pair]
        return [short_name(b if a == best else a) for a, b in pairs]

    def missing(self) -> list[str]:
        """Return what acts in the soil or at the wheel and is not the model's own, in words."""
        acting = [c for c in self.d.acting if not c.check and c.name != "parameter_shift"]
        return [short_name(c.name) for c in acting]

    def settled(self, causes: Sequence[Cause]) -> list[str]:
        """Return all faults that checks settle, with what was excluded before.

        A second line of excluded causes would replace the first.
        """
        faults = (fault for c in causes for fault in c.faults)
        return list(dict.fromkeys([*self.d.excluded, *faults]))

    def grouped(self, causes: Sequence[Cause]) -> list[Cause]:
        """Return the causes whose instrument has several faults."""
        return [c for c in causes if len(c.faults) > 1]

    def measure_first(self) -> bool:
        """Say whether a measurement comes before the use of the explanation."""
        return bool(self.d.next_measurements) and self.d.best.probability < SURE

    def most_telling(self) -> Next:
        """Return the measurement that separates the leading explanations best."""
        leaders = {e.name for e in self.d.explanations[:2]}
        return max(
            self.d.next_measurements,
            key=lambda m: (len(leaders.intersection(m.separates)), m.gain_nats),
        )

    def priors(self) -> list[tuple[str, str, str, int]]:
        """Return kinds of hypotheses: name, least and largest prior probability, how many."""
        kinds: dict[str, list[float]] = {}
        for e in sorted(self.d.explanations, key=lambda e: list(_TITLES).index(e.name)
                        if e.name in _TITLES else len(_TITLES)):  # fmt: skip
            kinds.setdefault(_kind(e.name), []).append(e.prior)
        return [
            (kind, percent(min(p)), percent(max(p)), 0 if kind in _TITLES else len(p))
            for kind, p in kinds.items()
        ]

    def counter(self) -> Callable[[], int]:
        """Return what numbers the steps of an advice."""
        return count(1).__next__


def _kind(name: str) -> str:
    if name in _TITLES:
        return name
    parts = name.split("+")
    if "unknown" in parts:
        return "remainders"
    if len(parts) > 1:
        return "pairs" if len(parts) == 2 else "sets"
    return "dependences" if name.startswith(PREFIX) else "effects"


class Words:
    """The sentences about one diagnosis, each a macro of ``diagnosis_words.j2``."""

    def __init__(self, d: GapDocument) -> None:
        self.d, self.n = d, Notation(d)
        self.tone, self.rule = judge(d)
        self._card: dict[str, Any] = {}
        self._said: Any = template("diagnosis_words.j2", html=False, trim=False).make_module(
            {"d": d, "n": self.n, "rule": self.rule, "card": self._card}
        )

    def __call__(self, name: str, *facts: Any) -> str:
        """Return a sentence or several; nothing where there is nothing to say."""
        text = re.sub(r"\s+", " ", getattr(self._said, name)(*facts)).strip()
        return re.sub(r" +([,;.:)])(?=[ )]|$)", r"\1", text).replace("( ", "(")

    def facts(self) -> Iterator[tuple[str, str]]:
        """Say which, how large, where, how far, what next."""
        d = self.d
        if d.verdict == "none":
            others = self.n.probable(d.explanations[1:4])
            yield "Which", self("which")
            if d.put_in:
                yield "Known beforehand", self("known")
            if others:
                yield "Not excluded", self.n.listed(others)
                yield from self._next()
            return
        there = {
            "causes": d.causes, "known": d.put_in, "untested": d.untested, "assumed": d.assumed,
            "how_large": d.sizes or (d.unlisted and d.verdict != "ambiguous"),
        }  # fmt: skip
        for label, name in _FACTS.items():
            if there.get(name, True):
                yield label, self(name)
        yield from self._next()

    def _next(self) -> Iterator[tuple[str, str]]:
        """Say what to do, and what would separate the first two unless the first is certain."""
        advice = self("advice")
        if advice:
            yield "Next", advice
        if self.n.measure_first() and not (advice and self.d.verdict == "unknown"):
            after_check = bool(advice) and any(c.check for c in self.d.acting)
            yield "Then" if advice else "Next", self("measure", after_check)

    def verdict(self) -> GapVerdict:
        """Return the card."""
        facts = [(label, upper_first(text)) for label, text in self.facts()]
        headline = upper_first(self("headline"))
        return GapVerdict(self.tone, self.rule, self("state"), headline, facts)

    def terminal(self) -> str:
        """Return what the terminal shows."""
        card = self.verdict()
        self._card |= {
            "headline": card.headline, "facts": card.facts, "track_record": self("track_record"),
        }  # fmt: skip
        return str(self._said.terminal()).strip("\n")


def gap_verdict(found: Diagnosis | GapDocument) -> GapVerdict:
    """Say in a headline and a few sentences what a diagnosis found; nothing is drawn."""
    return Words(found if isinstance(found, GapDocument) else gap_document(found)).verdict()


def upper_first(text: str) -> str:
    """Begin a sentence."""
    return text[:1].upper() + text[1:]
