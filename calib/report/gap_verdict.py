"""The verdict on a gap, by explicit rules, from a few facts.

The first rule that applies decides:

1. none: no gap, at a probability of 90 % or more;
2. not shown: no hypothesis of a gap is named, and none is not certain either;
3. trend: outputs change together over the runs, and nothing that is listed does that;
4. wander: one reading changes over the runs, neither as a drift nor as a step;
5. over runs: one reading changes over the runs, in which form cannot be told;
6. unknown: there is a gap, and nothing that is listed explains it;
7. tie: there is a gap, and several explanations are about as probable;
8. recalibrate: the same model with other parameter values closes the gap;
9. named: one effect, or pair, at a probability of 90 % or more;
10. likely: one effect, or pair, that is more probable than all others together.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

from calib.report.labels import joined

SURE = 0.9
# Hypotheses within this factor of the best are read as a tie with it.
TIE = 0.2
_MOST_TIED = 4
# A change over the runs that nothing listed explains.
NEITHER = "something that is neither"
# ln 20: the evidence that makes odds of twenty to one.
_ENOUGH_NATS = math.log(20.0)
_PREDICT = "calib predict DIAGNOSIS --at NEW.csv"


class Tone(StrEnum):
    """How the card looks."""

    FINE = "fine"
    CARE = "care"
    NO = "no"


@dataclass(frozen=True)
class Candidate:
    """A hypothesis: its name, its name in words, its claim, its probability."""

    name: str
    words: str
    title: str
    probability: float


@dataclass(frozen=True)
class WhereFact:
    """A region: "drawbar pull, at slips from 30 to 60 %", "0.09 kN lower", its probability."""

    place: str
    gap: str
    probability: float


@dataclass(frozen=True)
class CauseFact:
    """A cause: its name, in words, what happens, whether it acts, and its share of the gap.

    `instrument` says that it is a fault of one, not of wheel or soil.
    """

    name: str
    words: str
    title: str
    probability: float
    share: float
    interval: tuple[float, float]
    instrument: bool = False


@dataclass(frozen=True)
class ShrinkFact:
    """Errors in words with units; fraction and interval as ratios."""

    output: str
    before: str
    after: str
    floor: str
    fraction: float
    interval: tuple[float, float]


@dataclass(frozen=True)
class NextFact:
    """A measurement: the two hypotheses in words, where, and what it is expected to tell."""

    separates: tuple[str, str]
    conditions: str
    gain_nats: float


@dataclass(frozen=True)
class RunsFact:
    """A change over the order of the runs: of what, and how probable in whichever form.

    Parameters
    ----------
    outputs : str
        In words.
    probability : float
    forms : sequence of (str, float)
        "a drift", "a step", `NEITHER`, the most probable first.
    together : bool
        Whether it is a change of several outputs at once.
    only : bool
        Whether no other output is measured.
    """

    outputs: str
    probability: float
    forms: Sequence[tuple[str, float]]
    together: bool = False
    only: bool = False

    @property
    def rivals(self) -> list[tuple[str, float]]:
        """Forms about as probable as the first."""
        return [form for form in self.forms if form[1] >= TIE * self.forms[0][1]]


@dataclass(frozen=True)
class GapEvidence:
    """What a verdict is made from.

    Parameters
    ----------
    verdict : {"effect", "none", "unknown", "ambiguous"}
    ranked : sequence of Candidate
        Most probable first.
    sizes : sequence of str
        What the best hypothesis amounts to.
    where : sequence of WhereFact
        One of each output that has any.
    shrink_place : str
        On which rows the shrink was judged.
    alike : sequence of str
        Effects that look like the best one on this design, in words.
    smallest : float
        Smallest size that this design can name, in noise sds of the laboratory.
    look : str
        What to measure where nothing that is listed explains the gap.
    causes : sequence of CauseFact
        Listed causes, whatever acts besides.
    remainder : CauseFact, optional
        Something that is not listed, by itself or beside listed causes.
    remainder_where : str
        Where that lies.
    untested : sequence of str
        Listed effects on the outputs of the named causes that a column is missing for, with which.
    assumed : sequence of str
        What was taken for conditions of the calibration that it does not record, on which the best
        hypothesis rests.
    put_in, without : str
        What was put into the diagnosis besides the data, and what it finds without that.
    runs : RunsFact, optional
        A change over the order of the runs, of the outputs that most probably do.
    """

    verdict: str
    ranked: Sequence[Candidate]
    sizes: Sequence[str]
    where: Sequence[WhereFact]
    shrink: Sequence[ShrinkFact]
    shrink_place: str
    next_facts: Sequence[NextFact]
    alike: Sequence[str] = ()
    smallest: float = float("nan")
    look: str = ""
    causes: Sequence[CauseFact] = ()
    remainder: CauseFact | None = None
    remainder_where: str = ""
    untested: Sequence[str] = ()
    assumed: Sequence[str] = ()
    put_in: str = ""
    without: str = ""
    runs: RunsFact | None = None

    @property
    def acting(self) -> list[CauseFact]:
        """Causes that are more likely to act than not, the largest share first."""
        found = [c for c in self.causes if c.probability >= 0.5]
        if not self.causes:
            # Of the best explanation alone, where nothing is known of its parts.
            best = self.ranked[0]
            nan = float("nan")
            found = [
                CauseFact(best.name, best.words, best.title, best.probability, nan, (nan, nan))
            ]
        return sorted(found, key=lambda c: -c.share)


@dataclass(frozen=True)
class GapVerdict:
    """What a busy reader needs: a headline of one sentence, and a state of two or three words.

    The facts say which, how large, where, how far, what next; `rule` is the one that decided.
    """

    tone: Tone
    rule: str
    state: str
    headline: str
    facts: Sequence[tuple[str, str]]


def judge_gap(e: GapEvidence) -> GapVerdict:
    """Apply the rules."""
    found = _judge(e)
    headline = found.headline[0].upper() + found.headline[1:]
    return replace(
        found, headline=headline, facts=[(k, v[0].upper() + v[1:]) for k, v in found.facts]
    )


def _judge(e: GapEvidence) -> GapVerdict:
    best = e.ranked[0]
    if e.verdict == "none":
        return _no_gap(e, best)
    facts = _facts(e)
    changes = _over_runs(e, facts)
    if changes is not None:
        return changes
    if e.verdict == "unknown":
        return GapVerdict(
            Tone.NO, "unknown", "Cause unknown",
            "There is a real gap, and no effect on the list explains it", facts,
        )  # fmt: skip
    if e.verdict == "ambiguous":
        tied = _tied(e)
        words = [c.words for c in tied]
        there_is = "There may be" if any(c.name == "none" for c in tied) else "There is"
        headline = f"{there_is} a gap, but the data cannot tell {joined(words)} apart"
        if len(words) == 1:
            headline = f"There may be a gap; {words[0]} is the likeliest of many explanations"
        return GapVerdict(Tone.CARE, "tie", "Not told apart", headline, facts)
    acting = e.acting
    sure = min(c.probability for c in acting) >= SURE
    tone = Tone.FINE if sure else Tone.CARE
    if [c.name for c in acting] == ["parameter_shift"]:
        return GapVerdict(
            tone, "recalibrate", "Recalibrate",
            f"{_hedge(sure)}the same model with other parameter values closes the gap", facts,
        )  # fmt: skip
    count = {1: "", 2: "two causes at once: ", 3: "three causes at once: "}
    several = count.get(len(acting), f"{len(acting)} causes at once: ")
    rest = ""
    if e.remainder is not None and e.remainder.probability >= 0.5:
        rest = ", and something besides that is not listed"
    named = "Cause named" if len(acting) == 1 else "Causes named"
    likely = "Likely cause" if len(acting) == 1 else "Likely causes"
    return GapVerdict(
        tone, "named" if sure else "likely", named if sure else likely,
        f"{_hedge(sure)}{several}{', and '.join(c.title for c in acting)}{rest}", facts,
    )  # fmt: skip


def _over_runs(e: GapEvidence, facts: Sequence[tuple[str, str]]) -> GapVerdict | None:
    """Say what is sure of a change over the runs where its form, or its cause, is not."""
    r = e.runs
    if r is None or r.probability < 0.5:
        return None
    hedge = _hedge(r.probability >= SURE)
    if r.together:
        return GapVerdict(
            Tone.NO, "trend", "Trend over the runs",
            f"{hedge}{r.outputs} change together over the runs: rather the ground, the weather or "
            "the wheel than one instrument", facts,
        )  # fmt: skip
    if r.forms[0][0] == NEITHER and len(r.rivals) == 1:
        return GapVerdict(
            Tone.NO, "wander", "Wanders over the runs",
            f"{hedge}{r.outputs} changes over the runs, neither as a drift nor as a step", facts,
        )  # fmt: skip
    if len(r.rivals) < 2 or any(c.probability >= SURE for c in e.acting):
        return None
    forms = joined([f"{form} ({odds_text(p)})" for form, p in r.rivals])
    return GapVerdict(
        Tone.CARE, "over runs", "Not told apart",
        f"{hedge}{r.outputs} changes over the runs, but the data cannot tell {forms} apart", facts,
    )  # fmt: skip


def _no_gap(e: GapEvidence, best: Candidate) -> GapVerdict:
    sure = best.probability >= SURE
    size = "" if not math.isfinite(e.smallest) else (
        f"; an effect of {e.smallest:.1f} noise sd (rms in the output where it is largest; the "
        "laboratory's noise) would have shown in four of five campaigns like this one"
    )  # fmt: skip
    facts = [("Which", f"No gap, probability {odds_text(best.probability)}{size}")]
    if e.put_in:
        facts.append(("Put in", f"{e.put_in}. Without that: {e.without}"))
    others = [c for c in e.ranked[1:4] if c.probability >= 0.05]
    if others:
        listed = joined([f"{c.words} ({odds_text(c.probability)})" for c in others])
        facts.append(("Not excluded", listed))
        facts += _next(e)
    if sure:
        return GapVerdict(
            Tone.FINE, "none", "No gap",
            "The calibrated simulator holds: what is left is measurement noise", facts,
        )  # fmt: skip
    return GapVerdict(
        Tone.CARE, "not shown", "No gap shown",
        "The data show no gap, but they do not exclude one either", facts,
    )  # fmt: skip


def _facts(e: GapEvidence) -> list[tuple[str, str]]:
    facts = [("Causes", _causes(e))] if e.causes else []
    if e.put_in:
        facts.append(("Put in", f"{e.put_in}. Without that: {e.without}"))
    facts.append(("Which", _which(e)))
    if e.untested:
        one = "it acts, its" if len(e.untested) == 1 else "any acts, its"
        facts.append(
            ("Not tested", f"{'; '.join(e.untested)}. If {one} trace is put down to what is named")
        )
    if e.assumed:
        facts.append(
            ("Assumed", f"{joined(list(e.assumed))}, which the calibration does not record. If it "
             "was otherwise, sizes are wrong, and a second cause may be named for the difference")
        )  # fmt: skip
    if e.sizes:
        facts.append(("How large", f"{'; '.join(e.sizes)}"))
    facts += [("Where", _where(e)), ("How far", _how_far(e)), *_next(e)]
    return facts


def _causes(e: GapEvidence) -> str:
    """Say what acts, whatever acts besides, and what part of the gap it is."""
    named = e.acting or [c for c in e.causes if c.probability >= 0.05][:2]
    parts = [
        f"{c.words} acts ({odds_text(c.probability)}) and is {_share(c)} of the gap" for c in named
    ]
    rest = e.remainder
    if rest is not None and rest.probability >= 0.05:
        where = f", {e.remainder_where}," if e.remainder_where else ""
        parts.append(
            f"what is of no listed shape{where} is there with {odds_text(rest.probability)} and is "
            f"{_share(rest)} of it"
        )
    return "; ".join(parts) or "No listed cause reaches 5 %"


def _share(c: CauseFact) -> str:
    low, high = (_per_cent(v) for v in c.interval)
    return f"{_per_cent(c.share)} % ({low} to {high} %)"


def _which(e: GapEvidence) -> str:
    best = e.ranked[0]
    text = f"As a whole: {best.words}, probability {odds_text(best.probability)}"
    rivals = [c for c in e.ranked[1:_MOST_TIED] if c.probability >= 0.05]
    if rivals:
        listed = joined([f"{c.words} ({odds_text(c.probability)})" for c in rivals])
        text += f"; also possible: {listed}"
    else:
        text += "; nothing else reaches 5 %"
    if e.alike:
        text += f". On these conditions it looks like {joined(list(e.alike))}"
    return text


def _where(e: GapEvidence) -> str:
    if not e.where:
        return "In no stretch of the conditions does the gap probably exceed the noise"
    return "; ".join(f"{w.place}: {w.gap} ({odds_text(w.probability)})" for w in e.where)


def _how_far(e: GapEvidence) -> str:
    if not e.shrink:
        return "No output has a gap that could shrink"
    parts = []
    for s in e.shrink:
        low, high = (_per_cent(v) for v in s.interval)
        shrinks = "it shrinks by" if s.fraction > 0.0 else "it does not shrink:"
        part = (
            f"{s.output} error from {s.before} to {s.after} rms (noise {s.floor}): {shrinks} "
            f"{_per_cent(s.fraction)} % (90 % interval {low} to {high} %)"
        )
        if s.interval[0] <= 0.0 < s.fraction:
            part += ", so it may not shrink at all"
        parts.append(part)
    return f"{'; '.join(parts)}, {e.shrink_place}"


def advice(e: GapEvidence) -> str:
    """Say what to do that is no measurement between causes; nothing where one comes first."""
    if e.verdict == "unknown":
        return e.look
    runs = _reading(e)
    if runs is None and e.verdict != "effect":
        return ""
    faults = [runs] if runs else [c.words for c in e.acting if c.instrument]
    if faults:
        ground = ""
        if e.runs is not None and e.runs.only and e.runs.probability >= 0.5:
            ground = f". If it is sound, the ground changed over the runs: {e.runs.outputs} alone "
            ground += "cannot tell"
        return (
            f"check the instrument before the model ({joined(faults)}): zero and span, and an "
            "early run once more. What is predicted with the cause is the reading, not the truth"
            f"{ground}"
        )
    if _measure_first(e):
        return ""
    missing = [c.words for c in e.acting if c.name != "parameter_shift"]
    if not missing:
        return (
            "fit the field's rows too, and look at what changed in the soil. Until then predict "
            f"with the other parameter values: {_PREDICT}"
        )
    causes = "cause" if len(missing) == 1 else "causes"
    return (
        f"predict with the {causes} in the model ({joined(missing)}): {_PREDICT}. Or put "
        f"{'it' if len(missing) == 1 else 'them'} into the simulator, and calibrate that again"
    )


def _reading(e: GapEvidence) -> str | None:
    """Name a reading that changes over the runs, though not in which form."""
    changes = _over_runs(e, ())
    told = changes is None or changes.rule != "over runs"
    return None if told or e.runs is None else e.runs.outputs


def _measure_first(e: GapEvidence) -> bool:
    return bool(e.next_facts) and e.ranked[0].probability < SURE


def _next(e: GapEvidence) -> list[tuple[str, str]]:
    """Say what to do, or what would separate the first two unless the first is certain."""
    text = advice(e)
    if text:
        return [("Next", text)]
    if not _measure_first(e):
        return []
    n = max(e.next_facts, key=lambda fact: (_leading(e, fact), fact.gain_nats))
    repeats = repeats_needed(n.gain_nats)
    a, b = n.separates
    if repeats is None:
        return [
            ("Next", f"No single condition in the range of the data separates {a} from {b}; "
             "vary another condition, or measure another output"),
        ]  # fmt: skip
    many = "one measurement" if repeats == 1 else f"about {repeats} measurements"
    return [("Next", f"To separate {a} from {b}: {many} at {n.conditions}")]


def _leading(e: GapEvidence, fact: NextFact) -> int:
    leaders = {c.words for c in e.ranked[:2]}
    return sum(word in leaders for word in fact.separates)


def repeats_needed(gain_nats: float) -> int | None:
    """Measurements for expected odds of twenty to one; None where that is out of reach (50)."""
    if not gain_nats > 0.0:
        return None
    repeats = math.ceil(_ENOUGH_NATS / gain_nats)
    return repeats if repeats <= 50 else None


def odds_text(p: float) -> str:
    """Write a probability as a percentage without claiming certainty."""
    if p > 0.995:
        return "above 99 %"
    return "below 1 %" if p < 0.01 else f"{100.0 * p:.0f} %"


def _tied(e: GapEvidence) -> list[Candidate]:
    best = e.ranked[0].probability
    return [c for c in e.ranked if c.probability >= TIE * best][:_MOST_TIED]


def _hedge(sure: bool) -> str:
    return "" if sure else "probably "


def _per_cent(ratio: float) -> str:
    return f"{100.0 * ratio:.0f}".replace("-", "\N{MINUS SIGN}")
