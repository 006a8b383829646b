"""The verdict on a gap, by explicit rules, from a few facts.

The verdict on a gap, by explicit rules, from a few facts.

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

What the best explanation leaves in the field, and should not, is said with any, which is not fine.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

from scipy.special import softmax

from calib.gap.diagnose import Diagnosis
from calib.gap.effects import Effect
from calib.gap.effects.instruments import EARLY
from calib.gap.mixture import UNLISTED
from calib.report.gap_facts import (
    MOST_TIED,
    NEITHER,
    SHOWN,
    TIE,
    Candidate,
    CauseFact,
    GapEvidence,
    NextFact,
    RunsFact,
    causes_text,
    how_far_text,
    output_word,
    where_text,
    which_text,
)
from calib.report.labels import joined, odds_text


def over_runs(found: Diagnosis) -> RunsFact | None:
    """Say how probable it is that a reading changes over the runs, and in which form.

    Of the outputs that may, those that most probably do; None where none is at all likely to.
    """
    facts = [_of(found, (o.name,)) for o in found.data.outputs]
    if len(found.data.outputs) > 1:
        facts.append(_of(found, found.data.names))
    best = max(facts, key=lambda fact: fact.probability)
    return best if best.probability >= 0.05 else None


def _of(found: Diagnosis, outputs: Sequence[str]) -> RunsFact:
    p = found.ranking.probability
    roles = [o.role for o in found.data.outputs if o.name in outputs]
    # Of several outputs at once nothing that is listed changes the reading over the runs.
    kinds = {name: _kind(e) for name, e in _faults(found).items() if list(e.outputs) == roles}
    forms = dict.fromkeys(kinds.values(), 0.0)
    total, causes = 0.0, dict.fromkeys(kinds, 0.0)
    for name, probability in p.items():
        acting = {kinds[cause] for cause in name.split("+") if cause in kinds}
        total += probability if acting else 0.0
        causes |= {c: causes[c] + probability for c in name.split("+") if c in kinds}
        # One that is a drift and a step at once is neither by itself.
        both = "a drift and a step at once" if len(acting) > 1 else ""
        for kind in [both] if both else acting:
            forms[kind] = forms.get(kind, 0.0) + probability
    unlisted = _unlisted(found, tuple(outputs))
    forms[NEITHER] = unlisted
    ranked = sorted(forms.items(), key=lambda form: -form[1])
    return RunsFact(
        joined([output_word(o) for o in outputs]), total + unlisted, ranked,
        together=len(outputs) > 1, only=len(found.data.outputs) == 1,
        surest=max(causes.values(), default=0.0),
    )  # fmt: skip


def _faults(found: Diagnosis) -> dict[str, Effect]:
    """Instruments that fail with run order, of those that are tried, by name."""
    fits = (fit for group in found.ranking.fits.values() for fit in group)
    effects = (e for fit in fits for e in fit.forward.hypothesis.effects)
    return {e.name: e for e in effects if e.instrument and "order" in e.covariates}


def _kind(effect: Effect) -> str:
    return "a step" if "change_point" in effect.parameters else "a drift"


def _unlisted(found: Diagnosis, outputs: tuple[str, ...]) -> float:
    """Probability that something unlisted follows the order of the runs in just these outputs."""
    ranking = found.ranking
    if UNLISTED not in ranking.fits:
        return 0.0
    hypotheses = [fit.forward.hypothesis for fit in ranking.fits[UNLISTED]]
    weights = softmax(ranking.scores[UNLISTED])
    part = sum(
        float(w)
        for h, w in zip(hypotheses, weights, strict=True)
        if "order" in (h.smooth_over, h.onset_over) and h.smooth_outputs == outputs
    )
    return part * ranking.probability[UNLISTED]


SURE = 0.9
# ln 20: the evidence that makes odds of twenty to one.
_ENOUGH_NATS = math.log(20.0)
_PREDICT = "calib predict DIAGNOSIS --at NEW.csv"
_CONTEXT = "under [context] in case.toml (a section to add where there is none)"
_FOLDER = "DIAGNOSIS being this folder"


class Tone(StrEnum):
    """How the card looks."""

    FINE = "fine"
    CARE = "care"
    NO = "no"


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
    if e.doubts:
        said = "no gap on average" if e.verdict == "none" else found.headline
        tone = Tone.CARE if found.tone is Tone.FINE else found.tone
        found = replace(found, tone=tone, headline=f"{said}, but {joined(list(e.doubts))}")
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
    # The best explanation may have one more, of which nobody knows which it is.
    if several and len([c for c in best.name.split("+") if c != "unknown"]) > len(acting):
        several = f"at least {several}"
    rest = ""
    if e.remainder is not None and e.remainder.probability >= 0.5:
        probably = "" if e.remainder.probability >= SURE else "probably "
        rest = f"; something that is not listed {probably}acts besides"
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
    others = [c for c in e.ranked[1:4] if c.probability >= SHOWN]
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
    facts = [("Causes", causes_text(e))] if e.causes else []
    if e.put_in:
        facts.append(("Put in", f"{e.put_in}. Without that: {e.without}"))
    facts.append(("Which", which_text(e)))
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
    facts += [("Where", where_text(e)), ("How far", how_far_text(e)), *_next(e)]
    return facts


def advice(e: GapEvidence) -> str:
    """Say what to do that is no measurement between causes; nothing where one comes first."""
    if e.verdict == "unknown":
        return e.look
    runs = _reading(e)
    if runs is None and e.verdict != "effect":
        return ""
    faults = {c.words: _check(c) for c in e.acting if c.instrument}
    if runs:
        faults = {runs: EARLY}
    if faults:
        return _check_first(e, faults, runs)
    if _measure_first(e):
        return ""
    missing = _missing(e)
    if not missing:
        return (
            "fit the field's rows too, and look at what changed in the soil. Until then predict "
            f"with the other parameter values: {_PREDICT}, {_FOLDER}"
        )
    causes = "cause" if len(missing) == 1 else "causes"
    return (
        f"predict with the {causes} in the model ({joined(missing)}): {_PREDICT}, {_FOLDER}. Or "
        f"put {'it' if len(missing) == 1 else 'them'} into the simulator, and calibrate that again"
    )


def _check_first(e: GapEvidence, faults: Mapping[str, str], runs: str | None) -> str:
    """Say how to check instruments, and what to do if one is at fault, or none is."""
    checks = joined([f"{words} ({check})" for words, check in faults.items()])
    causes = [] if runs else [c for c in e.acting if c.instrument]
    names = [c.name for c in causes]
    doubted = [c.name for c in causes if c.probability < SURE]
    know = ""
    if doubted:
        sure = ", ".join(f"{name} = 0.99" for name in doubted)
        know = f"put suspected = {{{sure}}} {_CONTEXT}, diagnose again, and, "
    folder = "DIAGNOSIS being the new folder" if know else _FOLDER
    without = "".join(f" --without {name}" for name in names) or " --without CAUSE"
    one = len(faults) == 1
    # A second line of what is excluded would replace the first.
    settled = list(dict.fromkeys([*e.excluded, *(n for c in causes for n in c.faults or [c.name])]))
    listed = ", ".join(f'"{name}"' for name in settled)
    rest = "for that is settled" if one else "save what was not checked, with all faults of it"
    groups = [f"{c.words} with {', '.join(c.faults)}" for c in causes if len(c.faults) > 1]
    if groups and not one:
        rest += f" ({joined(groups)})"
    exclude = f"put excluded = [{listed}] {_CONTEXT}, {rest}, " if names else ""
    every = "it" if one else "every one of them"
    unknown = "it" if one else "one of them"
    steps = [
        f"check the {'instrument' if one else 'instruments'} before the model: {checks}"
        + ("; ± is one sd" if "±" in checks else ""),
        "correct the field's readings by what the check showed, be it all that is expected, a part "
        f"or nothing; {exclude}and diagnose again, into another --out, to predict from that",
        f"only if {every} showed all that is expected, readings may stay as they are instead: "
        f"{know}once it is mended, predict without the fault: {_PREDICT}{without}, {folder}; leave "
        "the option out to predict what the faulty instrument reads",
        f"if {unknown} can no longer be checked, {'' if one else 'do (2) for the others, then '}"
        f"predict {'from this folder' if one else 'from the new folder (this one if none can)'} "
        f"with --without {'that fault' if len(names) != 1 else names[0]}, for what truly happens, "
        "or without the option, for what it reads: the doubt whether it is at fault is in the band",
    ]
    if e.runs is not None and e.runs.only and e.runs.probability >= 0.5:
        steps.append(
            f"if it is sound, the ground changed over the runs: {e.runs.outputs} alone cannot tell"
        )
    also = [c for c in e.causes if c.instrument and SHOWN <= c.probability < 0.5 and not runs]
    if also:
        listed = joined([f"{c.words} ({odds_text(c.probability)}; {_check(c)})" for c in also])
        steps.append(f"worth a check as well: {listed}")
    if missing := _missing(e):
        them = "it" if len(missing) == 1 else "them"
        steps.append(
            f"what is no fault, {joined(missing)}, belongs in the simulator; until then "
            f"predictions include {them}"
        )
    return ". ".join(f"({i}) {step[0].upper()}{step[1:]}" for i, step in enumerate(steps, 1))


def _check(c: CauseFact) -> str:
    return f"{c.instrument}; expect {c.size}" if c.size else c.instrument


def _missing(e: GapEvidence) -> list[str]:
    """Say what acts in the soil or at the wheel, and is not the model's own."""
    return [c.words for c in e.acting if not c.instrument and c.name != "parameter_shift"]


def _reading(e: GapEvidence) -> str | None:
    """Name a reading that changes over the runs, though not in which form."""
    changes = _over_runs(e, ())
    told = changes is None or changes.rule != "over runs"
    return None if told or e.runs is None else e.runs.outputs


def _measure_first(e: GapEvidence) -> bool:
    return bool(e.next_facts) and e.ranked[0].probability < SURE


def _next(e: GapEvidence) -> list[tuple[str, str]]:
    """Say what to do, and what would separate the first two unless the first is certain."""
    text = advice(e)
    done = [("Next", text)] if text else []
    if not _measure_first(e) or (text and e.verdict == "unknown"):
        return done
    n = max(e.next_facts, key=lambda fact: (_leading(e, fact), fact.gain_nats))
    repeats = repeats_needed(n.gain_nats)
    a, b = n.separates
    measure = (
        f"no single condition in the range of the data separates {a} from {b}; vary another "
        "condition, or measure another output"
    )
    if repeats is not None:
        many = "one measurement" if repeats == 1 else f"about {repeats} measurements"
        measure = f"to separate {a} from {b}: {many} at {n.conditions}, added to the field's file"
        if any(c.instrument for c in e.acting):
            measure += ", taken with the instrument as it was, or all readings corrected alike"
        measure += ", and diagnose again"
    if text and any(c.instrument for c in e.acting):
        measure = f"after (2) the new page says what is next; where no check is possible, {measure}"
    return [*done, ("Then" if done else "Next", measure)]


def _leading(e: GapEvidence, fact: NextFact) -> int:
    leaders = {c.words for c in e.ranked[:2]}
    return sum(word in leaders for word in fact.separates)


def repeats_needed(gain_nats: float) -> int | None:
    """Measurements for expected odds of twenty to one; None where that is out of reach (50)."""
    if not gain_nats > 0.0:
        return None
    repeats = math.ceil(_ENOUGH_NATS / gain_nats)
    return repeats if repeats <= 50 else None


def _tied(e: GapEvidence) -> list[Candidate]:
    best = e.ranked[0].probability
    return [c for c in e.ranked if c.probability >= TIE * best][:MOST_TIED]


def _hedge(sure: bool) -> str:
    return "" if sure else "probably "
