"""How often explanations that were as probable have been right, in cases with known answers."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

from scipy.special import betaincinv

# What the cases are, which is not what a user has.
BENCH = (
    "simulated campaigns of calib's own bench, whose mechanics share no formula with the "
    "diagnosis; no measured ones"
)


@dataclass(frozen=True)
class TrackRecord:
    """Blind cases whose first explanation was stated between two ends, and how many were right."""

    low: float
    high: float
    cases: int
    right: int

    @property
    def share(self) -> float:
        """Part of them that was right."""
        return self.right / self.cases

    @property
    def interval(self) -> tuple[float, float]:
        """Jeffreys 95 % interval of that part, closed at the ends where all or none were right."""
        a, b = self.right + 0.5, self.cases - self.right + 0.5
        low = float(betaincinv(a, b, 0.025)) if self.right else 0.0
        high = float(betaincinv(a, b, 0.975)) if self.right < self.cases else 1.0
        return low, high


def track_record(probability: float) -> TrackRecord:
    """Return the record of the bin that the probability of a first explanation lies in."""
    return next(r for r in reversed(_records()) if probability >= r.low)


@cache
def _records() -> tuple[TrackRecord, ...]:
    """The bins in order, all seeds together."""
    text = files("calib.gap").joinpath("track_record.toml").read_text(encoding="utf-8")
    pooled: dict[tuple[float, float], list[int]] = {}
    for record in tomllib.loads(text)["record"]:
        for low, high, cases, right in record["bins"]:
            sums = pooled.setdefault((low, high), [0, 0])
            sums[0] += cases
            sums[1] += right
    return tuple(TrackRecord(*ends, *sums) for ends, sums in sorted(pooled.items()))
