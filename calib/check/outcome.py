"""What a check finds: one item for each number, file and claim, and the verdict on them all."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any, Literal

from calib.check.montecarlo import MONTE_CARLO


class Status(StrEnum):
    """How something recorded compares with the same computed again."""

    IDENTICAL = "identical"
    WITHIN = "within tolerance"
    DIFFERENT = "different"
    UNJUDGED = "not judged"


@dataclass(frozen=True)
class Item:
    """One thing that was compared: a file, the path of a number in it, or a claim.

    Parameters
    ----------
    group : str
        What it belongs to, such as ``"rut_depth: posterior"``.
    recorded, found : object
        In the folder, and computed again; None where there is no number to show.
    allowed : float, optional
        The largest difference that is taken for the same.
    note : str
        Why, in a few words.
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
        values = (self.recorded, self.found)
        if not self.allowed or not all(isinstance(v, int | float) for v in values):
            return None
        return float(abs(self.recorded - self.found) / self.allowed)


def claim(group: str, name: str, wrong: str, right: str = "", *, sure: bool = True) -> Item:
    """Return an item for what is `wrong`, if that is `sure`; if nothing is, for what is `right`."""
    if not wrong:
        return Item(group, name, Status.IDENTICAL, note=right)
    return Item(group, name, Status.DIFFERENT if sure else Status.UNJUDGED, note=wrong)


SCHEMA = "calib/check/1"
# Below this part of what is allowed, the draws are the same ones and rounding differs.
ROUNDED = 1e-3


@dataclass(frozen=True)
class Outcome:
    """What a check found; `quick` where sampling was skipped.

    Parameters
    ----------
    environment : mapping of str to (str, str)
        What differs between where it was made and here: pairs of there and here.
    allowed : str
        What Monte Carlo error was allowed, in words.
    not_converged : tuple of str
        Models whose posterior did not pass the convergence gate, as recorded.
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
        if not self.same:
            first, *more = dict.fromkeys(item.name for item in self.of(Status.DIFFERENT))
            return f"DIFFERENT: {', '.join([first, *more[:3], *(['...'] if more[3:] else [])])}"
        unjudged = len(self.of(Status.UNJUDGED))
        rest = f"; {unjudged} not judged" if unjudged else ""
        if self.not_converged:
            rest += f"; NOT CONVERGED, not to be used: {', '.join(self.not_converged)}"
        if self.quick:
            return f"NOTHING DIFFERENT, BUT ONLY ESTIMATES WERE COMPUTED AGAIN (--quick){rest}"
        identical = len(self.of(Status.IDENTICAL))
        if not self.of(Status.WITHIN):
            return f"SAME, bit for bit: {identical} numbers and files{rest}"
        if self.draws_differ:
            return f"SAME within Monte Carlo error, not bit for bit{rest}"
        return f"SAME up to rounding, not bit for bit{rest}"

    def document(self) -> dict[str, Any]:
        """Return everything as plain dictionaries."""
        return {
            "schema": SCHEMA,
            "folder": self.folder,
            "kind": self.kind,
            "quick": self.quick,
            "verdict": "same" if self.same else "different",
            "headline": self.verdict,
            "exit_code": self.exit_code,
            "counts": {str(status): len(self.of(status)) for status in Status},
            "environment": {
                name: {"there": there, "here": here}
                for name, (there, here) in self.environment.items()
            },
            "allowed": self.allowed,
            "not_converged": list(self.not_converged),
            "items": [{**asdict(item), "status": str(item.status)} for item in self.items],
        }
