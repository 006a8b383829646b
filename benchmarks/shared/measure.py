"""Clocks and the spread of what they showed."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence

__all__ = ["seconds", "spread"]


def seconds(call: Callable[[], object], *, at_least: float = 0.2, repeats: int = 7) -> list[float]:
    """Processor seconds of one call, several times; short calls are made often enough to be timed.

    On one core they are the seconds on the clock of a machine that does nothing else.

    Parameters
    ----------
    call : callable
    at_least : float
        Seconds that one measurement lasts.
    repeats : int
    """
    call()
    began = time.process_time()
    call()
    times = max(1, round(at_least / max(time.process_time() - began, 1e-7)))
    found = []
    for _ in range(repeats):
        began = time.process_time()
        for _ in range(times):
            call()
        found.append((time.process_time() - began) / times)
    return found


def spread(values: Sequence[float]) -> dict[str, float]:
    """Median, smallest and largest."""
    return {"median": statistics.median(values), "low": min(values), "high": max(values)}
