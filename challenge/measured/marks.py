"""What was said of the measured cases, held against their documented causes."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from challenge.answers import CaseAnswer, CauseAnswer
from challenge.measured.cases import MeasuredCase
from challenge.mechanism import NONE, UNKNOWN
from challenge.score import Proportion

__all__ = ["documented", "markdown", "wrong"]


def documented(answer: CaseAnswer) -> float:
    """Return the probability given to the documented cause, of several the least; NaN of none."""
    stated = {c.name: c.probability for c in answer.causes}
    causes = [] if answer.truth == NONE else answer.truth.split("+")
    return min((stated.get(name, 0.0) for name in causes), default=float("nan"))


def wrong(answer: CaseAnswer, at: float) -> list[CauseAnswer]:
    """Return listed causes that are said to act, at this probability or more, and do not."""
    return [c for c in _listed(answer) if c.acts is False and c.probability >= at]


def _listed(answer: CaseAnswer) -> list[CauseAnswer]:
    return sorted((c for c in answer.causes if c.name != UNKNOWN), key=lambda c: -c.probability)


def markdown(answers: Sequence[CaseAnswer], cases: Sequence[MeasuredCase]) -> str:
    """Return the scores and a table with a row for each case."""
    gaps = [a for a in answers if a.truth != NONE]
    nulls = [a for a in answers if a.truth == NONE]
    scores = (
        ("documented cause included at 0.5 or more", gaps, lambda a: documented(a) >= 0.5),
        ("cases with another listed cause at 0.5 or more", answers, lambda a: bool(wrong(a, 0.5))),
        ("cases with another listed cause at 0.9 or more", answers, lambda a: bool(wrong(a, 0.9))),
        ("no gap, and a verdict other than none", nulls, lambda a: a.verdict != NONE),
    )
    lines = ["| | cases | 95 % interval |", "|---|---|---|"]
    lines += [_score_line(*score) for score in scores]
    lines += [
        "", "| case | documented | size, sds | verdict, first explanation | documented cause "
        "| other listed causes from 0.1 (of how many testable) | unlisted besides |",
        "|---|---|---|---|---|---|---|",
        *(_case_line(a, case) for a, case in zip(answers, cases, strict=True)),
    ]  # fmt: skip
    return "\n".join(lines) + "\n"


def _score_line(what: str, among: Sequence[CaseAnswer], hit: Callable[[CaseAnswer], bool]) -> str:
    share = Proportion(sum(map(hit, among)), len(among))
    low, high = share.interval
    return f"| {what} | {share.successes}/{share.n} | {low:.2f} to {high:.2f} |"


def _case_line(a: CaseAnswer, case: MeasuredCase) -> str:
    others = ", ".join(f"{c.name} {c.probability:.2f}" for c in wrong(a, 0.1)) or "-"
    sizes = ", ".join(f"{size:g}" for size in case.sizes.values()) or "-"
    cause = "-" if a.truth == NONE else f"{documented(a):.2f}"
    unlisted = sum(c.probability for c in a.causes if c.name == UNKNOWN)
    return (
        f"| {a.case} | {case.expected} | {sizes} | {a.verdict}, {a.called} | {cause} "
        f"| {others} ({len(_listed(a))}) | {unlisted:.2f} |"
    )
