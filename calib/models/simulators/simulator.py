"""A simulator: parameters and conditions in, outputs or a reason why not out; every run is kept.

A run is one parameter vector at all conditions asked for. That is the unit that is counted, kept
and limited in time, whatever carries it out (`runner`, beside this).
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
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from calib.batch.folders import writing
from calib.batch.tasks import read_seconds, run_tasks
from calib.data.files import plain_number
from calib.data.quantities import QUANTITIES, real_array
from calib.data.table import Column, parse_header
from calib.errors import CalibError
from calib.models.base import Array
from calib.models.constants import FIRST_RUNS, TAIL_CHARACTERS
from calib.models.simulators.derived import evaluate

_log = logging.getLogger(__name__)

type Kind = Literal["time", "exit", "nan", "short", "unreadable", "error"]
type Values = Mapping[str, Array]
# Raw outputs by the simulator's own names.
type RawOutputs = Mapping[str, Any]

# Columns of the list of failed runs, next to their parameters.
FAILED = ("kind", "reason", "printed")


@dataclass(frozen=True)
class Failure:
    """A run without a value: its kind, the reason in a sentence, and the tail of what it printed.

    ``time`` (limit passed), ``exit`` (code other than zero), ``nan``, ``short`` (fewer values than
    rows), ``unreadable`` (no output, or none that can be read), ``error`` (an exception).
    """

    kind: Kind
    reason: str
    printed: str = ""


type Result = Values | Failure
type Given = RawOutputs | Failure


class Printed(dict[str, Any]):
    """Outputs of a run with what it printed, for error messages."""

    def __init__(self, outputs: RawOutputs, printed: str) -> None:
        super().__init__(outputs)
        self.printed = printed


class Runner(Protocol):
    """How a simulator is run."""

    @property
    def identity(self) -> str:
        """What else results depend on, as text."""

    @property
    def key(self) -> str:
        """The key of a simulator file that says how it is run."""

    @property
    def runs(self) -> bool:
        """Whether new runs can be made."""

    def run(self, parameters: Mapping[str, float], conditions: Mapping[str, Array]) -> Given:
        """Return the outputs by the simulator's own names, n values each, or a failure."""


@dataclass(frozen=True)
class Output:
    """An output that is calibrated.

    `header` is a column name of `calib.data.quantities` in the simulator's own unit, such as
    ``drawbar_pull_n``, `column` the simulator's name for it, and `sigma` the prior of its noise as
    the TOML text of a table. The noise is additive on the scale of the `response`, ``identity`` or
    ``log``; by default on that of the quantity.
    """

    header: str
    column: str
    sigma: str
    response: str = ""


@dataclass(frozen=True)
class Simulator:
    """A simulator of the user's own.

    Parameters
    ----------
    priors : str
        TOML text of their tables ``parameters.NAME``, as in a prior file.
    conditions : mapping of str to str
        The simulator's own name of each condition to a header in the unit it takes.
    limit : float
        Seconds a run may take.
    retries : int
        How often a failed run is tried again.
    deterministic : bool
        Whether equal input gives equal output.
    emulate : bool
        Whether it is too slow for the sampler to evaluate it.
    ranges : mapping of str to (float, float)
        Bounds within which it may be asked, by canonical condition.
    made_of : tuple of str
        SHA-256 of what else its results depend on: libraries, tables of soils.
    file : str
        The simulator file, if any.
    derived : mapping of str to str
        Formulas of parameters that follow from others, and are passed to it behind these.
    along : str
        Its own name of a condition, such as time: a run is then made of a call for each setting of
        the other conditions, which gives a series along this one.
    """

    name: str
    runner: Runner
    parameters: tuple[str, ...]
    priors: str
    conditions: Mapping[str, str]
    outputs: tuple[Output, ...]
    title: str = ""
    source: str = ""
    limit: float = 600.0
    retries: int = 1
    deterministic: bool = True
    emulate: bool = True
    ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    made_of: tuple[str, ...] = ()
    file: str = ""
    derived: Mapping[str, str] = field(default_factory=dict)
    along: str = ""

    @property
    def digest(self) -> str:
        """SHA-256 of whatever else its results depend on."""
        what = [self.runner.identity, list(self.parameters), dict(self.conditions)]
        what += [[o.header, o.column] for o in self.outputs]
        what += [part for part in (list(self.made_of), dict(self.derived), self.along) if part]
        return hashlib.sha256(json.dumps(what).encode()).hexdigest()

    def canonical(self, header: str) -> str:
        """Return the canonical column of one of its headers, which must name a known quantity."""
        return _parsed(header, self.name).quantity.canonical

    def place(self, kind: Kind = "error") -> str:
        """Return where to look if runs fail in some way: the file and the key, for messages."""
        if not self.file:
            return f"simulator {self.name}"
        keys: dict[str, str] = {"time": "limit", "short": "outputs", "unreadable": "outputs"}
        return f"{self.file}, {keys.get(kind, self.runner.key)}"

    @property
    def takes(self) -> tuple[str, ...]:
        """Canonical columns of its conditions."""
        return tuple(dict.fromkeys(map(self.canonical, self.conditions.values())))

    @property
    def series_along(self) -> str:
        """Canonical column of the condition that its series are along; empty without one."""
        return self.canonical(self.conditions[self.along]) if self.along else ""

    def with_derived(self, parameters: Mapping[str, Any]) -> dict[str, Any]:
        """Return parameters by name, numbers or arrays, and those that follow from them."""
        found = dict(parameters)
        for name, formula in self.derived.items():
            try:
                found[name] = evaluate(formula, found)
            except CalibError as error:
                raise error.within(f"simulator {self.name}, derived.{name}") from None
        return found

    def whole(self, theta: Array) -> Array:
        """Return parameters (k, d) and those that follow from them, (k, d + e)."""
        found = self.with_derived(dict(zip(self.parameters, theta.T, strict=True)))
        return np.stack(np.broadcast_arrays(*found.values()), axis=1)

    def series(self, conditions: Mapping[str, Array]) -> list[NDArray[np.intp]]:
        """Return the places of the rows of each call, by conditions (n,) of its own names."""
        n = next(iter(conditions.values())).size
        if not self.along:
            return [np.arange(n)]
        others = [v for name, v in conditions.items() if name != self.along]
        rows = np.stack([np.zeros(n), *others], axis=1)
        of = np.unique(rows, axis=0, return_inverse=True)[1].ravel()
        order = np.lexsort((conditions[self.along], of))
        return np.split(order, np.flatnonzero(np.diff(of[order])) + 1)

    def run(self, theta: Array, conditions: Mapping[str, Array]) -> Result:
        """Make one run, and try again if it fails.

        Parameters (d,) are in the order and units of the priors; conditions and outputs (n,) by
        canonical column, in canonical units.
        """
        parameters = dict(zip(self.parameters, map(float, theta), strict=True))
        n = next(iter(conditions.values())).size
        found: Result = Failure("error", "it was not run")
        try:
            for _ in range(1 + self.retries):
                # Each try gets copies.
                found = self._once(self.with_derived(parameters), self.asked(conditions), n)
                if not isinstance(found, Failure):
                    return found
        except CalibError as error:
            raise error.within(self.place()) from None
        return found

    def asked(self, conditions: Mapping[str, Array]) -> dict[str, Array]:
        """Return conditions by the simulator's own names and in its units."""
        found = {}
        for name, header in self.conditions.items():
            column = _parsed(header, self.name)
            found[name] = column.written(conditions[column.quantity.canonical])
        return found

    def converted(self, found: RawOutputs, output: str) -> Array:
        """Return an output, by its canonical column, in its canonical unit."""
        own = next(o for o in self.outputs if self.canonical(o.header) == output)
        column = _parsed(own.header, self.name)
        try:
            values = real_array(found[own.column], column.unit)
        except CalibError as error:
            raise error.within(own.column) from None
        return column.to_canonical(values)

    def resampled(self, found: RawOutputs, conditions: Mapping[str, Array]) -> RawOutputs:
        """Return outputs at the rows of a series that says where its own values are.

        Between these it is taken to be straight; a CalibError if it does not reach all rows.
        """
        if not self.along or self.along not in found:
            return found
        own, at = real_array(found[self.along]).ravel(), conditions[self.along]
        slack = 1e-9 * np.ptp(own) if own.size > 1 and (np.diff(own) > 0.0).all() else np.nan
        if not (at.min() >= own[0] - slack and at.max() <= own[-1] + slack):
            raise CalibError(
                f"{self.along} does not grow from {at.min():g} or less to {at.max():g} or more in "
                f"{own.size} steps"
            )
        i = np.clip(np.searchsorted(own, at, "right") - 1, 0, own.size - 2)
        ahead = (at - own[i]) / (own[i + 1] - own[i])
        taken = {}
        for output in (o for o in self.outputs if o.column in found):
            values = real_array(found[output.column], _parsed(output.header, self.name).unit)
            if values.shape[-1:] != own.shape:
                raise CalibError(f"{output.column} and {self.along} differ in length")
            taken[output.column] = (1.0 - ahead) * values[..., i] + ahead * values[..., i + 1]
        return Printed(taken, getattr(found, "printed", ""))

    def _once(
        self, parameters: Mapping[str, float], conditions: Mapping[str, Array], n: int
    ) -> Result:
        canonical = {self.canonical(output.header): np.empty(n) for output in self.outputs}
        for rows in self.series(conditions):
            part = {name: v[rows] for name, v in conditions.items()}
            found = self.runner.run(dict(parameters), dict(part))
            if isinstance(found, Failure):
                return found
            try:
                found = self.resampled(found, part)
            except CalibError as error:
                return Failure("short", error.message)
            for output in self.outputs:
                column = _parsed(output.header, self.name)
                values = checked(found, output.column, rows.size, column.unit)
                if isinstance(values, Failure):
                    return values
                canonical[column.quantity.canonical][rows] = column.to_canonical(values)
        return canonical


def _parsed(header: str, name: str) -> Column:
    found = parse_header(header, where=f"simulator {name}")
    if found is None:
        raise CalibError(
            f"{header!r} is no known quantity with a unit", where=f"simulator {name}",
            expected=", ".join(QUANTITIES) + ", or the same in another unit",
            hint="correct the name, or calib.register a Quantity of it (in a file for --models)",
        )  # fmt: skip
    return found


def not_made(why: str, hint: str = "correct that") -> CalibError:
    """Return the error for a run that its surroundings prevented; it is not kept."""
    return CalibError(
        f"the run could not be made: {why}",
        hint=f"{hint}, and call the same command again: the runs that were made are kept",
    )


def no_output(column: str, found: Iterable[str]) -> str:
    """Name a missing output and those that were given."""
    return f"there is no output {column!r}; it gave {', '.join(map(str, found)) or 'nothing'}"


def checked(found: RawOutputs, column: str, n: int, unit: str) -> Array | Failure:
    """Return one output as n numbers in a unit, or a failure."""
    printed = found.printed if isinstance(found, Printed) else ""
    if column not in found:
        return Failure("unreadable", no_output(column, found), printed)
    try:
        values = real_array(found[column], unit)
    except CalibError as error:
        return Failure("unreadable", f"{column}: {error.message}", printed)
    if values.size != n:
        what = f"{column} has {values.size} values for {n} rows of conditions"
        return Failure("short", what, printed)
    if max(values.shape, default=1) != n:
        what = f"{column} has the shape {values.shape} for {n} rows of conditions"
        return Failure("short", what, printed)
    values = values.ravel()
    bad = np.flatnonzero(~np.isfinite(values))
    if bad.size:
        what = f"{column} is not finite in {bad.size} of {n} rows, first in row {bad[0] + 1}"
        return Failure("nan", what, printed)
    return values


def tail(printed: str) -> str:
    """Return the end of what a run printed, without control characters."""
    end = printed if len(printed) <= TAIL_CHARACTERS else f"...{printed[-TAIL_CHARACTERS:]}"
    return "".join(c if c.isprintable() or c in "\n\t" else "\ufffd" for c in end)


type Progress = Callable[[int, int], None]


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


# What one task works on: parameters (d,) and conditions (n,) of a simulator.
type _Item = tuple[Simulator, Array, Mapping[str, Array]]


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
            name: (self.simulator, theta, conditions)
            for name, theta in zip(names, thetas, strict=True)
        }
        with getattr(self.simulator.runner, "watched", nullcontext)():
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
        _say_unshared(self.simulator.name, getattr(self.simulator.runner, "unshared", ""))
        with writing(folder):
            self._forget_failures(folder, items)
        if self.workers > 1 and not self.seconds:
            # Time the first run.
            missing = [name for name in items if not (folder / f"{name}.json").exists()]
            if len(missing) > 1:
                run_tasks(_carry_out, {missing[0]: items[missing[0]]}, folder)
                self.seconds = read_seconds(folder).get(missing[0], 0.0)
                self.made, self.kept = self.made + 1, self.kept - 1
        parallel = self.seconds * len(items) > 8.0  # s, from which starting processes pays off
        outcome = run_tasks(
            _carry_out, items, folder, workers=self.workers if parallel else 1,
            scheduler=self.scheduler, progress=self.progress, give_up=FIRST_RUNS,
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
    simulator, theta, conditions = item
    found = simulator.run(theta, conditions)
    described: dict[str, Any] = {
        "simulator": simulator.name,
        "parameters": dict(zip(simulator.parameters, map(float, theta), strict=True)),
        "conditions": {name: values.tolist() for name, values in conditions.items()},
    }
    if isinstance(found, Failure):
        failure = [found.kind, found.reason, found.printed]
        return described | {"failure": failure, "granted": [simulator.limit, simulator.retries]}
    return described | {"outputs": {name: values.tolist() for name, values in found.items()}}


def _run(described: Mapping[str, Any], theta: Array) -> Run:
    if "failure" in described:
        return Run(theta, {}, Failure(*described["failure"]))
    outputs = described["outputs"].items()
    return Run(theta, {name: np.array(values, dtype=np.float64) for name, values in outputs})


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
        f"; the runs, failed ones too, are kept in {folder}: delete it after a change outside "
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
