"""The scoreboard: several programs on the same cases, as a table and a figure of one page."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from challenge.answers import CaseAnswer
from challenge.mechanism import NONE, UNKNOWN
from challenge.score import Average, Proportion, Score, average, calibration_error, over

_BLUE, _GREEN, _GREY = "#0072B2", "#009E73", "#999999"
_PANELS = (
    ("named", "causes named", True, 0.75),
    ("silent", "silent on nulls", True, 0.95),
    ("missed_by", "error on rows left out, sds", False, None),
    ("miscalibrated", "calibration error", False, 0.10),
    ("seconds", "seconds a case", False, None),
)
_NOTES = """\
- Causes named: of the causes that act, those said to act with a probability of 0.5 or more.
- Wrongly sure: cases in which a listed cause that does not act is said to act at 0.9 or more.
- Silent on nulls: cases without a gap whose verdict is `none`.
- Error on rows left out: rms miss of the corrected prediction over the sd of the true values there,
  median over cases and outputs; the calibrated simulator's own error in brackets. Without a
  prediction it counts as 1, what the mean of the true values would miss by.
- Calibration error: mean distance between the probability of the first explanation and how often
  such are right, in ten bins. The Brier score is 0 at best and 2 at worst.
- Seconds: median over cases, on one machine.
- Failed cases count as wrong everywhere but in the calibration error. Intervals are of 95 %
  (Jeffreys, or a bootstrap). Dashed: the levels asked for of measured cases, 0.75, 0.95 and 0.10.
"""


@dataclass(frozen=True)
class Line:
    """What the board shows of a program.

    Attributes
    ----------
    named, wrongly_sure, silent : Proportion
        Acting causes included at 0.5 or more; cases with an absent one at 0.9 or more; nulls with
        the verdict none.
    missed_by, before : Average
        Median rms miss at the rows left out, in sds of the true values, corrected and not.
    miscalibrated, brier, seconds : Average
        Of the first explanation; of all; median per case.
    failed : int
        Cases without a diagnosis that can be scored.
    """

    named: Proportion
    wrongly_sure: Proportion
    silent: Proportion
    missed_by: Average
    before: Average
    miscalibrated: Average
    brier: Average
    seconds: Average
    failed: int


def line(score: Score) -> Line:
    """Return what the board shows of a program's score."""
    answers = score.answers
    nulls = [a for a in answers if a.truth == NONE]
    hits = [hit for a in answers if a.truth != NONE for hit in _named(a)]
    wrong = [any(c.acts is False and c.name != UNKNOWN and c.probability >= 0.9 for c in a.causes)
             for a in answers]  # fmt: skip
    first = [(a.confidence, float(a.called in a.right)) for a in answers if a.ranked]
    predictions = [p for a in answers for p in a.predictions]
    seconds = [score.seconds[a.case] for a in answers if a.case in score.seconds]
    return Line(
        named=Proportion(sum(hits), len(hits)),
        wrongly_sure=Proportion(sum(wrong), len(wrong)),
        silent=Proportion(sum(a.verdict == NONE for a in nulls), len(nulls)),
        missed_by=average([p.after for p in predictions], np.median),
        before=average([p.before for p in predictions if p.before == p.before], np.median),
        miscalibrated=over(np.array(first).reshape(-1, 2).T, calibration_error),
        brier=average([a.brier for a in answers], np.mean),
        seconds=average(seconds, np.median),
        failed=sum(not a.ranked for a in answers),
    )


def _named(a: CaseAnswer) -> list[bool]:
    """Whether each cause that acts is included; none is where the case failed."""
    acting = [c.probability >= 0.5 for c in a.causes if c.acts]
    return acting if a.ranked else [False] * len(a.truth.split("+"))


def markdown(lines: Mapping[str, Line], n_cases: int) -> str:
    """Return the table, one row for each program.

    Parameters
    ----------
    lines : mapping of str to Line
        By program.
    n_cases : int
        Cases that all of them were given.
    """
    rows = [
        f"| {name} | {_count(o.named)} | {_count(o.wrongly_sure)} | {_count(o.silent)} "
        f"| {_value(o.missed_by)} ({_plain(o.before)}) | {_value(o.miscalibrated)} "
        f"| {_plain(o.brier)} | {_plain(o.seconds)} | {o.failed}/{n_cases} |"
        for name, o in lines.items()
    ]
    return "\n".join([
        "| program | causes named | wrongly sure | silent on nulls | error on rows left out "
        "(simulator) | calibration error | Brier score | seconds | failed |",
        "|---|---|---|---|---|---|---|---|---|", *rows,
    ]) + "\n"  # fmt: skip


def _count(p: Proportion) -> str:
    low, high = p.interval
    return f"{p.successes}/{p.n}, {low:.2f} to {high:.2f}" if p.n else "-"


def _value(a: Average) -> str:
    return f"{a.value:.2f}, {a.interval[0]:.2f} to {a.interval[1]:.2f}" if a.n else "-"


def _plain(a: Average) -> str:
    return f"{a.value:.3g}" if a.n else "-"


def board_figure(lines: Mapping[str, Line], title: str) -> Figure:
    """Draw every program's figures with their 95 % intervals, one panel for each figure.

    Parameters
    ----------
    lines : mapping of str to Line
        By program.
    title : str
        Of which cases.
    """
    figure = Figure(figsize=(12.0, 1.7 + 0.42 * len(lines)), layout="constrained")
    shown = [p for p in _PANELS if any(getattr(one, p[0]).n for one in lines.values())]
    panels = figure.subplots(1, len(shown), sharey=True, squeeze=False)[0]
    for axes, (name, label, more_is_better, level) in zip(panels, shown, strict=True):
        for i, one in enumerate(lines.values()):
            got: Proportion | Average = getattr(one, name)
            if got.n:
                arms = np.abs(np.array(got.interval) - got.value)[:, None]
                axes.errorbar(got.value, i, xerr=arms, fmt="o", color=_BLUE, capsize=3)
            else:
                axes.annotate("no such case", (0.5, i), xycoords=("axes fraction", "data"),
                              ha="center", va="center", fontsize=8, color=_GREY)  # fmt: skip
        if level is not None:
            axes.axvline(level, linestyle="--", color=_GREEN)
        axes.set_title(f"{label}\n({'more' if more_is_better else 'less'} is better)", fontsize=9)
        if name == "seconds":
            axes.set_xscale("log")
        else:
            span = 1.04 * max(1.0, axes.get_xlim()[1])
            axes.set_xlim(-0.04 * span, span)
            axes.xaxis.set_major_locator(MaxNLocator(4, steps=[1, 5, 10]))
        axes.grid(axis="x", color=_GREY, alpha=0.3)
    panels[0].set_yticks(range(len(lines)), [*lines])
    panels[0].set_ylim(len(lines) - 0.5, -0.5)
    figure.suptitle(title, fontsize=10)
    return figure


def write_board(page: Path, section: str, scores: Mapping[str, Score]) -> None:
    """Put a table and a figure of scores into a page, in the place of those of the same section.

    Parameters
    ----------
    page : Path
        Markdown; what is written by hand around the sections is left alone.
    section : str
        Name of the cases.
    scores : mapping of str to Score
        By program, of the same cases.
    """
    lines = {name: line(score) for name, score in scores.items()}
    answers = next(iter(scores.values())).answers
    nulls = sum(a.truth == NONE for a in answers)
    said = f"{section}: {len(answers)} cases, {len(answers) - nulls} with a gap, {nulls} without"
    picture = page.with_name(f"board_{section}.png")
    page.parent.mkdir(parents=True, exist_ok=True)
    board_figure(lines, said).savefig(picture, dpi=150)
    shown = f"![{said}, every program's figures with 95 % intervals]({picture.name})"
    old = page.read_text(encoding="utf-8") if page.exists() else "# Scoreboard\n"
    parts = {
        section: f"{said}.\n\n{markdown(lines, len(answers))}\n{shown}",
        "notes": _NOTES.strip(),
    }
    for name, text in parts.items():
        begin, end = f"<!-- board {name} -->", f"<!-- end of {name} -->"
        if begin not in old:
            notes = "<!-- board notes -->"
            head, mark, rest = old.partition(notes)
            old = f"{head.rstrip()}\n\n{begin}{end}\n\n{mark}{rest}".rstrip() + "\n"
        head, _, rest = old.partition(begin)
        old = f"{head}{begin}\n\n{text}\n\n{end}{rest.partition(end)[2]}"
    page.write_text(old, encoding="utf-8")


def named_folders(words: Iterable[str]) -> dict[str, Path]:
    """Return folders by the names that go before them, NAME=DIR; of one alone its own name."""
    pairs = [word.partition("=") for word in words]
    return {name if path else Path(name).name: Path(path or name) for name, _, path in pairs}
