"""Every run kept: on disk by its content, done where it is missing, in parallel where that pays.

And the message when a simulator is refused because its runs have no value.
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.batch.folders import writing
from calib.batch.tasks import read_seconds, run_tasks
from calib.data.files import plain_number
from calib.errors import CalibError
from calib.models.base import Array
from calib.models.simulators.base import Failure, Kind, Result, Simulator

_log = logging.getLogger(__name__)

type Progress = Callable[[int, int], None]

# Seconds of work from which starting processes pays off.
_WORTH_SECONDS = 8.0


@dataclass(frozen=True)
class Run:
    """A run that was made: parameters (d,), and outputs (n,) by canonical column if it has any."""

    theta: Array
    outputs: Mapping[str, Array]
    failure: Failure | None = None

    @property
    def ok(self) -> bool:
        """Whether there is a value."""
        return self.failure is None


@dataclass(frozen=True)
class _Item:
    """What one task works on."""

    simulator: Simulator
    theta: Array
    conditions: Mapping[str, Array]


@dataclass
class RunKeeper:
    """Makes runs that were not made before, and keeps all.

    Parameters
    ----------
    folder : Path, optional
        Where runs are kept, each a file named after a hash of simulator, parameters and
        conditions, written whole or not at all; without one, in memory.
    workers : int
        Processes on this machine, used for batches that take more than a few seconds.
    scheduler : str, optional
        A Dask scheduler in their place.
    progress : callable, optional
        Called with runs done and runs asked for, of each batch.

    Attributes
    ----------
    made, kept : int
        Runs carried out, and runs that were there.
    seconds : float
        That a run has typically taken; zero while none was made.
    """

    simulator: Simulator
    folder: Path | None = None
    workers: int = 1
    scheduler: str | None = None
    progress: Progress | None = None
    made: int = 0
    kept: int = 0
    seconds: float = 0.0
    _memory: dict[str, Mapping[str, Any]] = field(default_factory=dict)

    def runs(
        self, thetas: Array, conditions: Mapping[str, Array], replicate: Sequence[int] | int = 0
    ) -> list[Run]:
        """Return runs of parameters (k, d) at canonical conditions (n,), in the order asked for.

        `replicate` tells runs with equal input apart. A CalibError if the folder cannot be written
        or is in use, or if runs cannot be made at all: the program does not start, the server is
        not there.
        """
        replicates = np.broadcast_to(np.asarray(replicate), (len(thetas),))
        names = [_name(t, conditions, r) for t, r in zip(thetas, replicates, strict=True)]
        items = {
            name: _Item(self.simulator, theta, conditions)
            for name, theta in zip(names, thetas, strict=True)
        }
        with getattr(self.simulator.way, "watched", nullcontext)():
            found = self._in_memory(items) if self.folder is None else self._on_disk(items)
        return [_run(found[name], t) for name, t in zip(names, thetas, strict=True)]

    def _in_memory(self, items: Mapping[str, _Item]) -> Mapping[str, Mapping[str, Any]]:
        for name, item in items.items():
            if name in self._memory:
                self.kept += 1
            else:
                self._memory[name] = _carry_out(item)
                self.made += 1
        return self._memory

    def _on_disk(self, items: Mapping[str, _Item]) -> Mapping[str, Mapping[str, Any]]:
        folder = Path(self.folder or ".") / self.simulator.digest[:16]
        _say_unshared(self.simulator.name, getattr(self.simulator.way, "unshared", ""))
        with writing(folder):
            self._forget_failures(folder, items)
        if self.workers > 1 and not self.seconds:
            # Time the first run.
            missing = [name for name in items if not (folder / f"{name}.json").exists()]
            if len(missing) > 1:
                run_tasks(_carry_out, {missing[0]: items[missing[0]]}, folder)
                self.seconds = read_seconds(folder).get(missing[0], 0.0)
                self.made, self.kept = self.made + 1, self.kept - 1
        outcome = run_tasks(
            _carry_out, items, folder, workers=self._workers(len(items)),
            scheduler=self.scheduler, progress=self.progress, give_up=FIRST,
        )  # fmt: skip
        new = [s for n, s in outcome.seconds.items() if n not in outcome.resumed]
        self.seconds = float(np.median(new)) if new else self.seconds
        self.kept += len(outcome.resumed)
        self.made += len(items) - len(outcome.resumed)
        if outcome.failed:
            first, place = next(iter(outcome.failed.values())), self.simulator.place()
            raise CalibError(
                f"{len(outcome.failed)} of {len(items)} runs could not be made: {first}",
                where=None if place in first else place,
            )
        return {name: _read(folder / f"{name}.json") for name in outcome.done}

    def _forget_failures(self, folder: Path, names: Iterable[str]) -> None:
        """Forget runs that failed with less time or fewer tries than now."""
        for name in names:
            path = folder / f"{name}.json"
            if path.exists() and "failure" in (kept := _read(path)):
                now = self.simulator.limit, self.simulator.retries
                if any(a > b for a, b in zip(now, kept["granted"], strict=True)):
                    path.unlink()

    def _workers(self, count: int) -> int:
        return self.workers if self.seconds * count > _WORTH_SECONDS else 1


@cache
def _say_unshared(name: str, why: str) -> None:
    if why:
        _log.warning(
            "simulator %s: it cannot be told what its function is (%s), so that its runs are kept "
            "but not taken another time; a function that holds no open files, locks or connections "
            "can be told from others", name, why,
        )  # fmt: skip


def _read(path: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(path.read_bytes())
    return found


def _name(theta: Array, conditions: Mapping[str, Array], replicate: int) -> str:
    digest = hashlib.sha256(theta.astype("<f8").tobytes())
    for column, values in sorted(conditions.items()):
        digest.update(f"{column}\0{values.size}\0".encode() + values.astype("<f8").tobytes())
    return f"{digest.hexdigest()[:40]}-{int(replicate)}"


def _carry_out(item: _Item) -> dict[str, Any]:
    """Make one run and describe it for JSON."""
    found: Result = item.simulator.run(item.theta, item.conditions)
    described: dict[str, Any] = {
        "simulator": item.simulator.name,
        "parameters": dict(zip(item.simulator.parameters, map(float, item.theta), strict=True)),
        "conditions": {name: values.tolist() for name, values in item.conditions.items()},
    }
    if isinstance(found, Failure):
        granted = [item.simulator.limit, item.simulator.retries]
        return described | {
            "failure": [found.kind, found.reason, found.printed], "granted": granted,
        }  # fmt: skip
    return described | {"outputs": {name: values.tolist() for name, values in found.items()}}


def _run(described: Mapping[str, Any], theta: Array) -> Run:
    if "failure" in described:
        return Run(theta, {}, Failure(*described["failure"]))
    outputs: dict[str, NDArray[np.float64]] = {
        name: np.array(values, dtype=np.float64) for name, values in described["outputs"].items()
    }
    return Run(theta, outputs)


# If the first runs all fail, the file or the program is wrong: by chance this happens once in 32
# times at most if the simulator has values in half of its prior.
FIRST = 5
FROM_THE_START = "it fails from the start, and no more runs were made"
_HINT: dict[Kind, str] = {
    "time": "give it more time (limit)",
    "exit": "correct the simulator where it fails: each run is made in a new folder (calib-run-... "
    "among the temporary files), and finds its own files where the variable CALIB_SIMULATOR says",
    "short": "have it give a number for each row, or ask for one row at a time (rows)",
    "unreadable": "have it give what [outputs] names, as output and patterns say, or correct these",
}


def fail_alike(runs: Sequence[Run]) -> bool:
    """Whether all runs failed in the same way."""
    kinds = {None if run.failure is None else run.failure.kind for run in runs}
    return len(kinds) == 1 and None not in kinds


def without_value(
    why: str, simulator: Simulator, runs: Sequence[Run], folder: Path | None
) -> CalibError:
    """Return the error for a simulator whose runs failed; the folder is that of the runs."""
    failures = [run.failure for run in runs if run.failure is not None]
    if not failures:
        return CalibError(
            f"{why}, although every run has a value", where=simulator.place(),
            hint="check that the data's units and the priors' scales fit each other",
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
    hint = _HINT.get(first.kind, "correct the simulator where it fails")
    hint += "; or give priors that do not reach there" if ok.any() else ""
    some = f"only {ok.sum()} of the {ok.size} runs have"
    have = some if ok.any() else f"none of the {ok.size} runs has"
    return CalibError(
        f"{why}: {have} a value ({first.kind}: {first.reason}{printed}){at}",
        where=simulator.place(first.kind),
        expected="a simulator with values in at least half of its prior, and where the data are",
        hint=f"{hint}{kept}",
    )


def _ranges(names: Sequence[str], theta: Array) -> str:
    low, high = theta.min(axis=0), theta.max(axis=0)
    return ", ".join(
        f"{n} {plain_number(a, 4)} to {plain_number(b, 4)}"
        for n, a, b in zip(names, low, high, strict=True)
    )  # fmt: skip
