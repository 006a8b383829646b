"""What a check finds: one item for each number, file and claim, and the verdict on them all."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any, Literal

from calib.check.tolerances import MONTE_CARLO


class Status(StrEnum):
    """How something recorded compares with the same computed again."""

    IDENTICAL = "identical"
    WITHIN = "within tolerance"
    DIFFERENT = "different"
    UNJUDGED = "not judged"


@dataclass(frozen=True)
class Item:
    """One thing that was compared: a file, the path of a number in it, or a claim.

    It belongs to a group, such as ``"rut_depth: posterior"``. None stands for the recorded number,
    for the one found again, and for the largest difference allowed, where there is none to show.
    """

    group: str
    name: str
    status: Status
    recorded: Any = None
    found: Any = None
    allowed: float | None = None
    note: str = ""

    @property
    def share(self) -> float | None:
        """Difference over the allowed one; None where either is missing."""
        numbers = all(isinstance(v, int | float) for v in (self.recorded, self.found))
        return abs(self.recorded - self.found) / self.allowed if self.allowed and numbers else None


def claim(group: str, name: str, wrong: str, right: str = "", *, sure: bool = True) -> Item:
    """Return an item for what is `wrong`, if that is `sure`; if nothing is, for what is `right`."""
    if not wrong:
        return Item(group, name, Status.IDENTICAL, note=right)
    return Item(group, name, Status.DIFFERENT if sure else Status.UNJUDGED, note=wrong)


SCHEMA = "calib/check/1"
LINE_ENDS = "the same but for its line ends"
# Below this part of what is allowed, the draws are the same ones and rounding differs.
ROUNDED = 1e-3


@dataclass(frozen=True)
class Outcome:
    """What a check found; `quick` where sampling was skipped.

    And what differs in the environment, there and here; what Monte Carlo error was allowed, in
    words; the models whose posterior did not pass the convergence gate, as recorded.
    """

    folder: str
    kind: Literal["report", "run", "comparison"]
    quick: bool
    items: tuple[Item, ...]
    environment: Mapping[str, tuple[str, str]]
    allowed: str = ""
    not_converged: tuple[str, ...] = ()

    def of(self, *status: Status) -> tuple[Item, ...]:
        """Return the items of some status."""
        return tuple(item for item in self.items if item.status in status)

    @property
    def same(self) -> bool:
        """Whether nothing is different."""
        return not self.of(Status.DIFFERENT)

    @property
    def exit_code(self) -> int:
        """0 where everything is the same, 1 where something is different."""
        return 0 if self.same else 1

    @property
    def draws_differ(self) -> bool:
        """Whether the posterior was drawn by other random draws than those recorded."""
        return any(
            item.note == MONTE_CARLO and item.share is not None and item.share > ROUNDED
            for item in self.of(Status.WITHIN)
        )

    @property
    def verdict(self) -> str:
        """The verdict in one sentence."""
        different = list(dict.fromkeys(item.name for item in self.of(Status.DIFFERENT)))
        if different:
            return f"DIFFERENT: {', '.join(different[:4])}{', ...' if different[4:] else ''}"
        unjudged = len(self.of(Status.UNJUDGED))
        rest = f"; {unjudged} not judged" if unjudged else ""
        pages = [i.name for i in self.of(Status.UNJUDGED) if i.name.endswith(".html")]
        rest += f", THE PAGE {', '.join(pages)} AMONG THEM" if pages else ""
        other_ends = sum(item.note == LINE_ENDS for item in self.items)
        if other_ends:
            rest += f"; {other_ends} files have other line ends, as git's autocrlf makes them"
        if self.not_converged:
            rest += f"; NOT CONVERGED, not to be used: {', '.join(self.not_converged)}"
        if self.quick:
            return f"NOTHING DIFFERENT, BUT ONLY ESTIMATES WERE COMPUTED AGAIN (--quick){rest}"
        if not self.of(Status.WITHIN):
            identical = len(self.of(Status.IDENTICAL))
            return f"SAME, bit for bit: {identical} numbers and files{rest}"
        if len(self.of(Status.WITHIN)) == other_ends:
            return f"SAME but for line ends{rest}"
        how = "within Monte Carlo error" if self.draws_differ else "up to rounding"
        return f"SAME {how}, not bit for bit{rest}"

    def document(self) -> dict[str, Any]:
        """Return everything as plain dictionaries."""
        differing = {n: {"there": there, "here": h} for n, (there, h) in self.environment.items()}
        return {
            "schema": SCHEMA, "folder": self.folder, "kind": self.kind, "quick": self.quick,
            "verdict": "same" if self.same else "different", "headline": self.verdict,
            "exit_code": self.exit_code,
            "counts": {str(status): len(self.of(status)) for status in Status},
            "environment": differing, "allowed": self.allowed,
            "not_converged": list(self.not_converged),
            "items": [{**asdict(item), "status": str(item.status)} for item in self.items],
        }  # fmt: skip
