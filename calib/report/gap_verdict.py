"""The verdict on a gap: ten rules, from the document of a diagnosis to a level and a rule."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum

from calib.gap.document import Explanation, GapDocument, RunTrend

# From here on a cause, or no gap, is certain.
SURE = 0.9
# Explanations within this factor of the best are a tie with it.
TIE = 0.2


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


def _change(d: GapDocument) -> RunTrend | None:
    """Return a change over the runs that is more probable than not."""
    return d.runs if d.runs is not None and d.runs.probability >= 0.5 else None


def _trend(d: GapDocument) -> bool:
    change = _change(d)
    return change is not None and change.together


def _wander(d: GapDocument) -> bool:
    change = _change(d)
    return change is not None and [form for form, _ in rivals(change)] == ["neither"]


def _over_runs(d: GapDocument) -> bool:
    change = _change(d)
    named = any(c.probability >= SURE for c in d.acting)
    return change is not None and len(rivals(change)) > 1 and not named


type _Applies = Callable[[GapDocument], bool]

# The first rule that applies decides. A fine level needs certainty, and no doubts.
RULES: tuple[tuple[str, Tone, _Applies], ...] = (
    # There is no gap.
    ("none", Tone.FINE, lambda d: d.verdict == "none" and _sure(d)),
    ("not shown", Tone.CARE, lambda d: d.verdict == "none"),
    # Several outputs, or one reading, change over the runs: not as any listed effect does ...
    ("trend", Tone.NO, _trend),
    ("wander", Tone.NO, _wander),
    # ... or in a form that the data do not decide.
    ("over runs", Tone.CARE, _over_runs),
    # There is a gap, and no listed effect explains it, or several explain it about as well.
    ("unknown", Tone.NO, lambda d: d.verdict == "unknown"),
    ("tie", Tone.CARE, lambda d: d.verdict == "ambiguous"),
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
