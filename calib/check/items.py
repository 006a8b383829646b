"""What a check finds: one item for each number, file and claim that was looked at."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Any


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
