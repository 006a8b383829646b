"""Facts about a gap that a verdict and its figures are made from, and how each is worded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from calib.data.files import plain_number
from calib.data.quantities import OUTPUTS, role_of
from calib.gap.case import words_of
from calib.gap.diagnose import Diagnosis, field_parts
from calib.gap.effects import EFFECTS
from calib.gap.files import BENCH, track_record
from calib.gap.mixture import Region
from calib.models.base import Array
from calib.report.labels import MINUS, NO_UNIT, Axis, axis_of, joined, odds_text, percent_range

# Hypotheses within this factor of the best are read as a tie with it.
TIE = 0.2
MOST_TIED = 4
# What is less probable is not spoken of: shown as a percentage it would be below 5.
SHOWN = 0.045
# From here on a cause is said to be possible besides those that act, and a change over the runs to
# be surer than each of its forms.
_ALSO = 0.1
# A change over the runs that nothing listed explains.
NEITHER = "something that is neither"


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

    `instrument` says how to check the one that is at fault; empty if wheel or soil is. `size` is
    its first parameter in the most probable explanation that has it: "offset 0.12 ± 0.02 kN".
    `faults` are the names of all faults of the same instrument that were tested.
    """

    name: str
    words: str
    title: str
    probability: float
    share: float
    interval: tuple[float, float]
    instrument: str = ""
    size: str = ""
    faults: Sequence[str] = ()


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
    surest : float
        Probability of the surest listed cause that is such a change, whatever acts besides.
    """

    outputs: str
    probability: float
    forms: Sequence[tuple[str, float]]
    together: bool = False
    only: bool = False
    surest: float = 1.0

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
        The first of each output that has any, and one along what the best hypothesis is about.
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
    excluded : sequence of str
        Effects among what was put in that are known not to act.
    runs : RunsFact, optional
        A change over the order of the runs, of the outputs that most probably do.
    doubts : sequence of str
        What the most probable explanation leaves in the field, and should not, each in a clause.
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
    excluded: Sequence[str] = ()
    runs: RunsFact | None = None
    doubts: Sequence[str] = ()

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


def causes_text(e: GapEvidence) -> str:
    """Say what acts, whatever acts besides, and what part of the gap it is."""
    named = e.acting or [c for c in e.causes if c.probability >= SHOWN][:2]
    parts = [
        f"{c.words} acts ({odds_text(c.probability)}) and is {_share(c)} of the gap" for c in named
    ]
    also = [c for c in e.causes if c.probability >= _ALSO and c not in named]
    if also and e.acting:
        listed = joined([f"{c.words} ({odds_text(c.probability)})" for c in also])
        parts.append(f"besides, or instead, there may be {listed}")
    runs = e.runs
    surer = runs is not None and runs.surest < runs.probability - _ALSO
    if runs is not None and surer and runs.probability >= 0.5 and not runs.together:
        parts.append(
            f"that {runs.outputs} changes over the runs, in whichever form, has "
            f"{odds_text(runs.probability)}"
        )
    rest = e.remainder
    if rest is not None and rest.probability >= SHOWN:
        where = f", {e.remainder_where}," if e.remainder_where else ""
        parts.append(
            f"what is of no listed shape{where} is there with {odds_text(rest.probability)} and is "
            f"{_share(rest)} of it"
        )
    if not parts:
        return "No listed cause reaches 5 %"
    several = ". Shares are rms over the rows of all outputs, in noise sds"
    return "; ".join(parts) + (several if len(e.shrink) > 1 else "")


def _share(c: CauseFact) -> str:
    return f"{_per_cent(c.share)} % ({percent_range(c.interval)})"


def track_record_text(probability: float) -> str:
    """Say how often first explanations that were as probable were right."""
    r = track_record(probability)
    ends = f"{r.low:g} or more" if r.high == 1.0 else f"{r.low:g} to {r.high:g}"
    return (
        f"Of {r.cases:,} blind cases whose first explanation was stated at {ends}, {r.share:.2f} "
        f"(95 % interval {r.interval[0]:.2f} to {r.interval[1]:.2f}) were right: {BENCH}"
    )


def which_text(e: GapEvidence) -> str:
    """Say which hypothesis is the best, what else is possible, and what looks like it."""
    best = e.ranked[0]
    text = f"As a whole: {best.words}, probability {odds_text(best.probability)}"
    rivals = [c for c in e.ranked[1:MOST_TIED] if c.probability >= SHOWN]
    if rivals:
        listed = joined([f"{c.words} ({odds_text(c.probability)})" for c in rivals])
        text += f"; also possible: {listed}"
    else:
        text += "; nothing else reaches 5 %"
    if e.alike:
        text += f". On these conditions it looks like {joined(list(e.alike))}"
    return text


def where_text(e: GapEvidence) -> str:
    """Say in which regions the gap probably exceeds the noise."""
    if not e.where:
        return "In no stretch of the conditions does the gap probably exceed the noise"
    return "; ".join(
        f"{w.place}: {w.gap} (probability {odds_text(w.probability)})" for w in e.where
    )


def how_far_text(e: GapEvidence) -> str:
    """Say by how much the error of each output shrinks."""
    if not e.shrink:
        return "No output has a gap that could shrink"
    parts = []
    for s in e.shrink:
        shrinks = "it shrinks by" if s.fraction > 0.0 else "it does not shrink:"
        part = (
            f"{s.output} error from {s.before} to {s.after} rms (noise {s.floor}): {shrinks} "
            f"{_per_cent(s.fraction)} % (90 % interval {percent_range(s.interval)})"
        )
        if s.interval[0] <= 0.0 < s.fraction:
            part += ", so it may not shrink at all"
        parts.append(part)
    faulty = [c.words for c in e.acting if c.instrument]
    meant = f". Errors are of what the instrument reads, {joined(faulty)} in it" if faulty else ""
    return f"{'; '.join(parts)}, as expected {e.shrink_place}{meant}"


def _per_cent(ratio: float) -> str:
    return f"{100.0 * ratio:.0f}".replace("-", MINUS)


# The words for a region that covers all rows.
EVERYWHERE = "all conditions measured"

_WORDS = {
    "none": "no gap beyond the noise",
    "unknown": "a real gap that nothing listed explains",
    "parameter_shift": "the same model with other parameter values",
}
_SHORT = {"none": "none (noise)", "unknown": "unknown effect", "parameter_shift": "parameter shift"}
# What is not listed, as a part of an explanation.
_PART = {"unknown": "something unlisted"}
_MOST_PANELS = 4
# Pulls below this (kN) are those of a single small wheel, written in newtons.
_SMALL_PULL = 0.1


def short_name(name: str) -> str:
    """Return a hypothesis's name in words."""
    if name in _SHORT:
        return _SHORT[name]
    return " + ".join(_PART.get(part, part.replace("_", " ")) for part in name.split("+"))


def title_of(found: Diagnosis, name: str) -> str:
    """Say what a hypothesis claims, in plain words."""
    if name in _WORDS:
        return _WORDS[name]
    titles = {e.name: e.title for e in EFFECTS.values()}
    titles |= _PART | {"parameter_shift": _WORDS["parameter_shift"]}
    for fit in found.ranking.fits.get(name, ()):
        titles |= {e.name: e.title for e in fit.forward.hypothesis.effects}
    return ", and ".join(titles.get(part) or part.replace("_", " ") for part in name.split("+"))


def unit_after(axis: Axis) -> str:
    """Return a unit to be put after a number; nothing for counts."""
    return "" if axis.unit in ("number", NO_UNIT) else f" {axis.unit}"


def region_text(found: Diagnosis, region: Region) -> str:
    """Say over which stretch of which condition a region lies, or that it is everywhere."""
    column, ends = next(iter(region.conditions.items()))
    rows = next(o.rows for o in found.data.outputs if o.name == region.output)
    values = found.data.view.conditions[column][rows]
    if ends[0] <= values.min() and ends[1] >= values.max():
        return EVERYWHERE
    axis = axis_of(column)
    words = words_of(found.data.case.covariates, column, *ends)
    if words:
        return f"{axis.name.lower()} {words}"
    low, high = (condition_text(column, axis.factor * v) for v in ends)
    span = low if low == high else f"{low} to {high}"
    return f"{axis.name.lower()} {span}{unit_after(axis)}"


def shrink_place(found: Diagnosis) -> str:
    """Say on which rows it was judged how far the gap shrinks."""
    if found.data.case.new_conditions is not None:
        return "at the new conditions, of which there are no readings"
    parts = len(field_parts(found.data, found.seed))
    if parts:
        return (
            "at the field's own conditions, each row predicted without it (the rows are left out "
            f"in {parts} parts)"
        )
    return "at the field's own rows, which were fitted: they are too few to leave some out"


def condition_text(column: str, value: float) -> str:
    """Write a condition, in the unit of its axis, to the digits that a plan or a stretch needs."""
    if role_of(column) in ("slip", "order"):
        return f"{value:.0f}".replace("-", MINUS)
    return plain_number(value, 2 if abs(value) < 10.0 else 3).replace("-", MINUS)


def output_word(output: str) -> str:
    """Return an output's name in a sentence."""
    return output.replace("_", " ")


@dataclass(frozen=True)
class OutputRows:
    """Field rows of one output, as they are drawn, arrays of shape (n,).

    On the scale of the axis the reading, the calibrated simulator before and the corrected one
    after; the sd of a reading; truth minus simulator, its sd, and the probability that it exceeds
    the noise.
    """

    name: str
    axis: Axis
    rows: NDArray[np.int64]
    measured: Array
    before: Array
    after: Array
    noise: Array
    gap: Array
    sd: Array
    probability: Array


def output_rows(found: Diagnosis) -> list[OutputRows]:
    """Gather the field rows of every output."""
    gathered = []
    view, truth = found.data.view, found.truth
    for o, gap in zip(found.data.outputs, found.gaps, strict=True):
        axis = output_axis(found, o.name)
        theta = o.priors.to_natural(found.ranking.lab_mode[o.name][None])
        before = o.problem.bound.predict(theta, o.problem.bound.model.select(view.conditions))[0]
        gathered.append(
            OutputRows(
                o.name,
                axis,
                o.rows,
                axis.scale(found.data.case.field[OUTPUTS[o.name]][o.rows]),
                axis.scale(np.asarray(before)[o.rows]),
                axis.scale(truth.mean(truth.truth[o.name])[o.rows]),
                axis.scale(truth.mean(truth.noise[o.name])[o.rows]),
                axis.scale(gap.gap),
                axis.scale(gap.sd),
                gap.probability,
            )
        )
    return gathered


def output_axis(found: Diagnosis, output: str) -> Axis:
    """Return how an output is written: drawbar pulls of a small wheel in newtons."""
    axis = axis_of(OUTPUTS[output])
    if (
        axis.unit == "kN"
        and np.nanmax(np.abs(found.data.case.field[OUTPUTS[output]])) < _SMALL_PULL
    ):
        return Axis(axis.name, "N", 1000.0)
    return axis


def panel_groups(
    found: Diagnosis, rows: NDArray[np.int64]
) -> list[tuple[str, NDArray[np.bool_]]]:  # fmt: skip
    """Split rows by inflation pressure into a few panels: titles and masks."""
    column = found.data.view.column("pressure") or ""
    pressure = found.data.view.conditions.get(column)
    everything = np.ones(rows.size, dtype=np.bool_)
    if pressure is None or np.ptp(pressure) == 0.0:
        return [("", everything)]
    distinct, axis = np.unique(pressure), axis_of(column)
    if distinct.size <= _MOST_PANELS:
        return [(f"{axis.value_text(p)} {axis.unit}", pressure[rows] == p) for p in distinct]
    edges = np.quantile(pressure, [0.0, 1.0 / 3.0, 2.0 / 3.0, 1.0])
    groups = []
    for low, high in pairwise(edges):
        inside = (pressure[rows] >= low) & (pressure[rows] <= high)
        if low > edges[0]:
            inside &= pressure[rows] > low
        groups.append((axis.range_text(np.array([low, high])), inside))
    return groups
