"""The verdict on a gap, by ten rules, and the words about a diagnosis.

The sentences are those of ``diagnosis_words.j2``; `Words.n` writes the quantities in them.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np

from calib.arguments import takes
from calib.data.files import plain_number
from calib.data.quantities import OUTPUTS, QUANTITIES, physical_role, role_of
from calib.gap.case import words_of
from calib.gap.constants import ALIKE, FALSE_REGIONS
from calib.gap.describe import gap_document
from calib.gap.diagnose import Diagnosis
from calib.gap.document import BENCH, Cause, Explanation, GapDocument, Next, RunTrend, Size
from calib.gap.effects.dependence import PREFIX
from calib.gap.effects.instruments import EARLY
from calib.gap.laboratory_bias import Bias
from calib.gap.mixture import Region
from calib.report.constants import SHOWN, SURE, TIE
from calib.report.labels import (
    MINUS,
    NO_UNIT,
    Axis,
    joined,
    odds_text,
    percent,
    percent_range,
    short,
    units_of,
)
from calib.report.numbers import format_at, format_value, last_place
from calib.report.page.template import template
from calib.report.rows import output_axis


class Tone(StrEnum):
    """How the card looks."""

    FINE = "fine"
    CARE = "care"
    NO = "no"


@dataclass(frozen=True)
class GapVerdict:
    """What a busy reader needs: a headline of one sentence, and a state of one to three words.

    The facts say which, how large, where, how far, what next; `rule` is the one that decided.
    """

    tone: Tone
    rule: str
    state: str
    headline: str
    facts: Sequence[tuple[str, str]]

    def __repr__(self) -> str:
        return f"<GapVerdict {self.state}: {self.headline}>"


def rivals(runs: RunTrend) -> list[tuple[str, float]]:
    """Return the forms of a change over the runs that are about as probable as the first."""
    return [form for form in runs.forms if form[1] >= TIE * runs.forms[0][1]]


def tied(d: GapDocument) -> list[Explanation]:
    """Return the explanations that are about as probable as the first."""
    return [e for e in d.explanations if e.probability >= TIE * d.best.probability][:4]


def _sure(d: GapDocument) -> bool:
    """Whether no gap is certain or, if there is one, all causes that act."""
    if d.verdict == "none":
        return d.best.probability >= SURE
    return all(c.probability >= SURE for c in d.acting)


def _rivalled(d: GapDocument) -> bool:
    """Whether an explanation without the causes that act is at least half as probable as the best.

    Unless some cause is certain.
    """
    acting = {c.name for c in d.acting}
    if not acting or any(c.probability >= SURE for c in d.acting):
        return False
    others = [e.probability for e in d.explanations if not acting & set(e.name.split("+"))]
    return max(others, default=0.0) >= 0.5 * d.best.probability


def _change(d: GapDocument) -> str:
    """Return the rule for a change over the runs that is more probable than not, if one applies."""
    if d.runs is None or d.runs.probability < 0.5:
        return ""
    # Several outputs, or one reading, change: not as any listed effect does ...
    if d.runs.together:
        return "trend"
    forms = [form for form, _ in rivals(d.runs)]
    if forms == ["neither"]:
        return "wander"
    # ... or in a form that the data do not decide.
    named = any(c.probability >= SURE for c in d.acting)
    return "over runs" if len(forms) > 1 and not named else ""


# The first rule that applies decides. A fine level needs certainty, and no doubts.
RULES: tuple[tuple[str, Tone, Callable[[GapDocument], bool]], ...] = (
    # There is no gap.
    ("none", Tone.FINE, lambda d: d.verdict == "none" and _sure(d)),
    ("not shown", Tone.CARE, lambda d: d.verdict == "none"),
    ("trend", Tone.NO, lambda d: _change(d) == "trend"),
    ("wander", Tone.NO, lambda d: _change(d) == "wander"),
    ("over runs", Tone.CARE, lambda d: _change(d) == "over runs"),
    # There is a gap, and no listed effect explains it, or several explain it about as well.
    ("unknown", Tone.NO, lambda d: d.verdict == "unknown"),
    ("tie", Tone.CARE, lambda d: d.verdict == "ambiguous" or _rivalled(d)),
    # Causes act.
    ("recalibrate", Tone.FINE, lambda d: [c.name for c in d.acting] == ["parameter_shift"]),
    ("named", Tone.FINE, _sure),
    ("likely", Tone.CARE, lambda d: True),
)


def judge(d: GapDocument) -> tuple[Tone, str]:
    """Apply the rules: return how the card looks, and the name of the rule that decided."""
    rule, tone = next((rule, tone) for rule, tone, applies in RULES if applies(d))
    if tone is Tone.FINE and (d.doubts or not _sure(d)):
        tone = Tone.CARE
    return tone, rule


_TITLES = {
    "none": "no gap beyond the noise",
    "unknown": "a real gap that nothing listed explains",
    "parameter_shift": "the same model with other parameter values",
}


def short_name(name: str) -> str:
    """Return an explanation's, a cause's or a parameter's name in words."""
    if name in ("none", "unknown"):
        return "none (noise)" if name == "none" else "unknown effect"
    parts = (part.replace("_", " ") for part in name.split("+"))
    return " + ".join("something unlisted" if part == "unknown" else part for part in parts)


def chance(p: float) -> str:
    """Write a probability in a figure, without claiming certainty."""
    return odds_text(p).replace("above", ">").replace("below", "<")


def _cause_name(cause: Explanation | Cause) -> str:
    unlisted = isinstance(cause, Cause) and cause.name == "unknown"
    return "something unlisted" if unlisted else short_name(cause.name)


class _Notation:
    """How the quantities of a diagnosis are written, in the units of its files.

    Use it within `calib.report.labels.units_of` of the document's headers.
    """

    finite, range = staticmethod(math.isfinite), staticmethod(percent_range)
    name, chance = staticmethod(short_name), staticmethod(chance)
    rivals, tied, physical = staticmethod(rivals), staticmethod(tied), staticmethod(physical_role)
    bench, early_check, alike_from = BENCH, EARLY, f"{ALIKE:g}"
    false_regions = percent(FALSE_REGIONS)

    def __init__(self, d: GapDocument) -> None:
        self.d = d

    # Quantities, by the name of an output or by a column

    def axis(self, quantity: str) -> Axis:
        return output_axis(self.d, quantity)

    def _with_unit(self, quantity: str, text: str) -> str:
        unit = self.axis(quantity).unit
        return text if unit in ("number", NO_UNIT) else f"{text} {unit}"

    def output(self, name: str) -> str:
        return name.replace("_", " ")

    def outputs(self, names: Iterable[str]) -> str:
        return joined([self.output(n) for n in names])

    def names(self, names: Iterable[str]) -> str:
        return joined([short_name(name) for name in names])

    def unit(self, output: str) -> str:
        return QUANTITIES[OUTPUTS[output]].unit_word

    def quantity(self, column: str) -> str:
        return self.axis(column).name.lower()

    def plain(self, quantity: str, value: float) -> str:
        return short(self.axis(quantity).factor * value).replace("-", MINUS)

    def value(self, quantity: str, value: float) -> str:
        return self._with_unit(quantity, self.plain(quantity, value))

    def amount(self, quantity: str, mean: float, sd: float) -> str:
        factor = self.axis(quantity).factor
        return self._with_unit(quantity, format_value(factor * mean, factor * sd))

    def shift(self, column: str, mean: float, sd: float) -> str:
        axis = self.axis(column)
        unit = "percentage points" if axis.unit == "%" else axis.unit
        return f"{format_value(abs(axis.factor * mean), axis.factor * sd)} {unit}"

    def change(self, s: Size) -> str:
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
        return f"{value:.0f}".replace("-", MINUS)

    def whole(self, ratio: float) -> str:
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
        return self.stretch(column, value, value)

    def conditions(self, values: Mapping[str, float]) -> str:
        return joined([self.condition(column, value) for column, value in values.items()])

    def region(self, r: Region) -> str:
        column, (low, high) = next(iter(r.conditions.items()))
        rows = next(o.rows for o in self.d.outputs if o.name == r.output)
        values = np.array(self.d.conditions[column])[list(rows)]
        everywhere = low <= values.min() and high >= values.max()
        return "all conditions measured" if everywhere else self.stretch(column, low, high)

    # Choices from the document

    def title(self, name: str) -> str:
        if name in _TITLES:
            return _TITLES[name]
        known = {**self.d.titles, "parameter_shift": _TITLES["parameter_shift"]}
        return ", and ".join(known.get(part) or short_name(part) for part in name.split("+"))

    def probable[T: (Explanation, Cause)](self, items: Iterable[T]) -> list[T]:
        """Return what is probable enough to be spoken of."""
        return [item for item in items if item.probability >= SHOWN]

    def listed(self, items: Iterable[Any], words: Mapping[str, str] | None = None) -> str:
        """List explanations, causes, or pairs of a name and a probability."""
        pairs = (i if isinstance(i, tuple) else (_cause_name(i), i.probability) for i in items)
        return joined([f"{(words or {}).get(name, name)} ({odds_text(p)})" for name, p in pairs])

    def biased(self) -> list[Bias]:
        """Return the parameters that ignoring the causes would move by an sd, the farthest first.

        Nothing where no cause is named.
        """
        far = [b for b in self.d.laboratory_bias if abs(b.shift_in_sds) >= 1.0 and self.d.acting]
        return sorted(far, key=lambda b: -abs(b.shift_in_sds))

    def ignoring(self, b: Bias) -> str:
        """Write a parameter as it would have come out, as precisely as its sd has it."""
        return format_at(b.ignoring, last_place(b.sd))

    def without(self) -> str:
        """List the causes that act without what was put in."""
        p = self.d.without_context or {}
        words = {"none": "no gap", "unknown": "something unlisted"}
        leading = sorted((n for n in p if p[n] >= SHOWN), key=lambda n: -p[n])[:4]
        return joined([f"{words.get(n, short_name(n))} ({odds_text(p[n])})" for n in leading])

    def alike(self) -> list[str]:
        """Return the effects that look like the best explanation, in words."""
        best = self.d.best.name
        pairs = [pair for pair in self.d.design.alike if best in pair]
        return [short_name(b if a == best else a) for a, b in pairs]

    def settled(self, causes: Sequence[Cause]) -> list[str]:
        """Return all faults that checks settle, with what was excluded before.

        A second line of excluded causes would replace the first.
        """
        faults = (fault for c in causes for fault in c.faults)
        return list(dict.fromkeys([*self.d.excluded, *faults]))

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
        kinds: dict[str, list[float]] = {name: [] for name in _TITLES}
        for e in self.d.explanations:
            kinds.setdefault(_kind(e.name), []).append(e.prior)
        return [
            (kind, percent(min(p)), percent(max(p)), 0 if kind in _TITLES else len(p))
            for kind, p in kinds.items()
            if p
        ]


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
        self.d, self.n = d, _Notation(d)
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
            yield "Hypotheses", self("which")
            if d.put_in:
                yield "Known beforehand", self("known")
            if d.shift_if_same_soil is not None:
                yield "Same soil", self("same_soil")
            if others:
                yield "Not excluded", self.n.listed(others)
                yield from self._next()
            return
        sized = d.sizes or (d.unlisted and d.verdict != "ambiguous")
        for label, macro, there in (
            ("Causes", "causes", d.causes),
            ("Known beforehand", "known", d.put_in),
            ("Same soil", "same_soil", d.shift_if_same_soil is not None),
            ("Hypotheses", "which", True),
            ("Not tested", "untested", d.untested),
            ("Assumed", "assumed", d.assumed),
            ("Size", "how_large", sized),
            ("Where", "where", True),
            ("Correction", "how_far", True),
        ):
            if there:
                yield label, self(macro)
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
        with units_of(self.d.headers):
            facts = [(label, upper_first(text)) for label, text in self.facts()]
            headline = upper_first(self("headline"))
        return GapVerdict(self.tone, self.rule, self("state"), headline, facts)

    def terminal(self) -> str:
        """Return what the terminal shows."""
        card = self.verdict()
        self._card |= {"headline": card.headline, "facts": card.facts}
        self._card["track_record"] = self("track_record")
        return str(self._said.terminal()).strip("\n")


@takes(found=(Diagnosis, GapDocument))
def gap_verdict(found: Diagnosis | GapDocument) -> GapVerdict:
    """Say in a headline and a few sentences what a diagnosis found; nothing is drawn.

    Examples
    --------
    >>> import calib
    >>> diagnosis = calib.diagnose("cases/nominal_slip")  # doctest: +SKIP
    >>> calib.gap_verdict(diagnosis).headline  # doctest: +SKIP
    """
    return Words(found if isinstance(found, GapDocument) else gap_document(found)).verdict()


def upper_first(text: str) -> str:
    """Begin a sentence."""
    return text[:1].upper() + text[1:]
