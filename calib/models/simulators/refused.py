"""When a simulator is refused because its runs have no value, and what is said then."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from calib.data.numbers import plain_number
from calib.errors import CalibError
from calib.models.base import Array
from calib.models.simulators.base import Kind, Simulator
from calib.models.simulators.runs import Run

# Of a simulator with values in half of its prior, so many runs fail all of them once in 32 times at
# most, and less often as they are spread evenly. A mistake in its file or program fails in every
# run, and need not be paid for sixty times, or for every draw of a sampler.
FIRST = 5
FROM_THE_START = "it fails from the start, and no more runs were made"
_MEND: dict[Kind, str] = {
    "time": "give it more time (limit)",
    "exit": "correct the simulator where it fails: each run is made in a new folder (calib-run-... "
    "among the temporary files), and finds its own files where the variable CALIB_SIMULATOR says",
    "short": "have it give a number for each row, or ask for one row at a time (rows)",
    "unreadable": "have it give what [outputs] names, as output and patterns say, or correct these",
}


def fail_alike(runs: Sequence[Run]) -> bool:
    """Whether all runs have failed, and in the same way."""
    kinds = {None if run.failure is None else run.failure.kind for run in runs}
    return len(kinds) == 1 and None not in kinds


def without_value(
    why: str, simulator: Simulator, runs: Sequence[Run], folder: Path | None
) -> CalibError:
    """Return what to say where runs that failed are in the way; the folder is that of the runs."""
    failures = [run.failure for run in runs if run.failure is not None]
    if not failures:
        return CalibError(
            f"{why}, although every run has a value", where=simulator.place(),
            mend="check that the data's units and the priors' scales fit each other",
        )  # fmt: skip
    first, names = failures[0], simulator.parameters
    ok = np.array([run.ok for run in runs])
    theta = np.stack([run.theta for run in runs])
    at = f", at {_ranges(names, theta[~ok])}"
    at += f"; those with a value are at {_ranges(names, theta[ok])}" if ok.any() else ""
    kept = "" if folder is None else (
        f"; the runs, failed ones too, are kept in {folder}: delete it after a mend outside "
        "the files that the simulator's own names"
    )  # fmt: skip
    printed = f"; it printed: {first.printed.strip()}" if first.printed.strip() else ""
    mend = _MEND.get(first.kind, "correct the simulator where it fails")
    mend += "; or give priors that do not reach there" if ok.any() else ""
    some = f"only {ok.sum()} of the {ok.size} runs have"
    have = some if ok.any() else f"none of the {ok.size} runs has"
    return CalibError(
        f"{why}: {have} a value ({first.kind}: {first.reason}{printed}){at}",
        where=simulator.place(first.kind),
        allowed="a simulator with values in at least half of its prior, and where the data are",
        mend=f"{mend}{kept}",
    )


def _ranges(names: Sequence[str], theta: Array) -> str:
    low, high = theta.min(axis=0), theta.max(axis=0)
    return ", ".join(
        f"{n} {plain_number(a, 4)} to {plain_number(b, 4)}"
        for n, a, b in zip(names, low, high, strict=True)
    )  # fmt: skip
