"""What was said of the measured cases, held against their documented causes."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from challenge.measured.cases import NONE, UNLISTED, MeasuredCase
from challenge.score import Proportion

__all__ = ["Mark", "mark", "markdown"]

FAILED = "failed"


@dataclass(frozen=True)
class Mark:
    """One case's diagnosis against its documented cause.

    Parameters
    ----------
    case : MeasuredCase
    verdict : str
        As stated; ``failed`` without a diagnosis.
    inclusion : tuple of (str, float)
        Listed causes and the probabilities that they act, the most probable first.
    remainder : float
        Probability of something unlisted.
    first : str
        The most probable explanation.
    """

    case: MeasuredCase
    verdict: str
    inclusion: tuple[tuple[str, float], ...]
    remainder: float
    first: str

    @property
    def cause(self) -> float:
        """Probability given to the documented cause; NaN of none."""
        if self.case.expected == NONE:
            return float("nan")
        if self.case.expected == UNLISTED:
            return self.remainder
        return dict(self.inclusion).get(self.case.expected, 0.0)

    def wrong(self, at: float) -> tuple[tuple[str, float], ...]:
        """Listed causes that are said to act, at this probability or more, and are not it."""
        right = {self.case.expected, *self.case.defensible}
        return tuple((name, p) for name, p in self.inclusion if p >= at and name not in right)


def mark(case: MeasuredCase, folder: Path) -> Mark:
    """Read the diagnosis of a case; one that is not there has failed.

    Parameters
    ----------
    case : MeasuredCase
    folder : Path
        Of its diagnosis.
    """
    path = folder / "diagnosis.json"
    if not path.exists():
        return Mark(case, FAILED, (), 0.0, FAILED)
    said = json.loads(path.read_bytes())
    inclusion = {name: float(found["probability"]) for name, found in said["inclusion"].items()}
    return Mark(
        case, said["verdict"], tuple(sorted(inclusion.items(), key=lambda item: -item[1])),
        float(said["remainder"]["probability"]), said["effects"][0]["name"],
    )  # fmt: skip


def markdown(marks: Sequence[Mark]) -> str:
    """Return the scores and a table with a row for each case."""
    gaps = [m for m in marks if m.case.expected != NONE]
    nulls = [m for m in marks if m.case.expected == NONE]
    scores = (
        ("documented cause included at 0.5 or more", gaps, lambda m: m.cause >= 0.5),
        ("cases with another listed cause at 0.5 or more", marks, lambda m: bool(m.wrong(0.5))),
        ("cases with another listed cause at 0.9 or more", marks, lambda m: bool(m.wrong(0.9))),
        ("no gap, and a verdict other than none", nulls, lambda m: m.verdict != NONE),
    )
    lines = ["| | cases | 95 % interval |", "|---|---|---|"]
    lines += [_score_line(*score) for score in scores]
    lines += [
        "", "| case | documented | size, sds | verdict, first explanation | documented cause "
        "| other listed causes from 0.1 (of how many testable) | unlisted besides |",
        "|---|---|---|---|---|---|---|",
        *(_case_line(m) for m in marks),
    ]  # fmt: skip
    return "\n".join(lines) + "\n"


def _score_line(what: str, among: Sequence[Mark], hit: Callable[[Mark], bool]) -> str:
    share = Proportion(sum(map(hit, among)), len(among))
    low, high = share.interval
    return f"| {what} | {share.successes}/{share.n} | {low:.2f} to {high:.2f} |"


def _case_line(m: Mark) -> str:
    others = ", ".join(_shown(name, p) for name, p in m.wrong(0.1)) or "-"
    sizes = ", ".join(f"{size:g}" for size in m.case.sizes.values()) or "-"
    cause = "-" if m.case.expected == NONE else _shown("", m.cause)
    return (
        f"| {m.case.name} | {m.case.expected} | {sizes} | {m.verdict}, {m.first} | {cause} "
        f"| {others} ({len(m.inclusion)}) | {m.remainder:.2f} |"
    )


def _shown(name: str, probability: float) -> str:
    return f"{name} {probability:.2f}".strip()
