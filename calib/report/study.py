"""A study: what is calibrated on which rows, and what was found for each output.

A study is what a report shows. Each output is worked out on its own: one that fails is kept as a
`Failure`, and the others still come.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from calib.batch.environment import one_thread
from calib.batch.folders import keep
from calib.batch.pool import HERE
from calib.data import Table, hold_out, read_for_model
from calib.data.quantities import OUTPUTS
from calib.data.table import parse_header, renamed
from calib.errors import CalibError
from calib.inference.calibration import Calibration, calibrate
from calib.inference.estimators import PointEstimate, estimate, methods_for
from calib.inference.io import save_calibration
from calib.inference.prior_files import default_priors, prior_file_model
from calib.inference.problem import Problem, build_problem
from calib.inference.random import generator
from calib.inference.sampler import SamplerSettings
from calib.models import MODELS, get_model
from calib.models.base import Array
from calib.report.constants import MAX_ROWS
from calib.report.labels import degrees, joined
from calib.report.verdict import Evidence, gather
from calib.validation.comparison import NoisePreference, noise_preference
from calib.validation.prediction import prior_predictive, row_draws
from calib.validation.scores import Sensitivity, prior_sensitivity
from calib.validation.validate import Validation, leave_one_out, validate_held_out

type Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class HoldOut:
    """Rows kept for validation: a column as a header would name it, and its value or values."""

    column: str
    value: float | tuple[float, ...]

    @property
    def _numbers(self) -> list[str]:
        values = [self.value] if isinstance(self.value, int | float) else self.value
        return [f"{v:g}" for v in values]

    def __str__(self) -> str:
        return f"{self.column} = {', '.join(self._numbers)}"

    @property
    def words(self) -> str:
        """What is held out, as a heading says it: the quantity, its values and unit."""
        column = parse_header(self.column)
        if column is None:
            return str(self)
        unit = degrees(column.unit.replace("**", "^").replace("*", " "))
        value = f"{column.quantity.word} {joined(self._numbers)}"
        return value if unit == "dimensionless" else f"{value} {unit}"

    @classmethod
    def parse(cls, text: str) -> HoldOut:
        """Read ``COLUMN=VALUE`` or ``COLUMN=VALUE,VALUE``, or raise a CalibError."""
        column, equals, value = text.partition("=")
        try:
            if not equals:
                raise ValueError
            parse_header(column.strip())
            first, *others = map(float, value.split(","))
            return cls(column.strip(), (first, *others) if others else first)
        except CalibError as error:
            raise CalibError(
                error.message, where=f"--hold-out {text}", expected=error.expected,
                hint="write one of these before the equals sign",
            ) from None  # fmt: skip
        except ValueError:
            raise CalibError(
                f"cannot read --hold-out {text!r}",
                expected="COLUMN=VALUE, for instance inflation_pressure_psi=30 or 18,30",
                hint="name a column with its unit, an equals sign and numbers with commas between",
            ) from None

    def applies_to(self, table: Table) -> bool:
        """Whether a table has the column at all."""
        column = parse_header(self.column)
        return column is not None and column.quantity.canonical in table

    def split(self, table: Table) -> tuple[Table, Table]:
        """Return the rows that are left, and these; see `calib.data.hold_out`."""
        return hold_out(table, self.column, self.value)


def read_and_split(
    path: Path, columns: Sequence[str], kept: HoldOut | None
) -> tuple[Table, Table | None]:
    """Read a file, of which some columns are used; return the rows to fit and those held out."""
    table = read_for_model(path, columns)
    return kept.split(table) if kept else (table, None)


@dataclass(frozen=True)
class Task:
    """One output (a key of `OUTPUTS`) to calibrate; leave-one-out where no rows are held out."""

    output: str
    model: str
    table: Table
    held_out: HoldOut | None = None
    prior_path: Path | None = None


def choose_model(output: str, table: Table) -> str:
    """Pick the model of an output (a key of `OUTPUTS`) that suits a table.

    Of the models whose conditions are all there it is the one that makes use of most of those that
    vary; of several such, one that is not slow, the one of fewest conditions that do not vary, of
    fewest parameters, of fewest conditions, then the one known first. Which of them the data
    prefer, `calib.compare` says.

    Raises
    ------
    CalibError
        If no model of the output suits the table, with what those there are would need.
    """
    known = [m for m in MODELS.values() if m.output == OUTPUTS[output]]
    suited = [m for m in known if all(c in table for c in m.conditions)]
    if suited:
        varied = {c for m in suited for c in m.conditions if np.unique(table[c]).size > 1}
        uses = [
            (
                len(varied & set(m.conditions)),
                not m.slow,
                -len(set(m.conditions) - varied),
                -len(m.parameters),
                -len(m.conditions),
            )
            for m in suited
        ]
        return suited[uses.index(max(uses))].name
    conditions = {c for m in known for c in m.conditions}
    raise CalibError(
        f"no model of {output} suits the columns",
        where=table.source,
        expected="; ".join(f"{m.name}: {', '.join(m.conditions)}" for m in known)
        or "a model that is registered for this output",
        hint=f"{renamed(table.ignored, conditions)}add the columns of one of these models, "
        "declare a model of your own (--models), or report the other outputs (--only)",
    )


def plan_tasks(
    tables: Sequence[Table],
    held_out: HoldOut | None = None,
    *,
    models: Sequence[str] = (),
    prior_paths: Sequence[Path] = (),
    only: Sequence[str] = (),
) -> tuple[Task, ...]:
    """Find the outputs in some tables and choose a model for each.

    Models are used for their outputs, in the place of the ones the columns suggest; a prior file
    names the model it is for; `only` has outputs to work out (keys of `OUTPUTS`).

    Raises
    ------
    CalibError
        If no table has an output, two tables or two models have the same, none has the rows to
        hold out, a table is too long for a report, a name is unknown, or a model's output is in
        no table.
    """
    wanted: dict[str, str] = {}
    for name in models:
        other = wanted.setdefault(get_model(name).output, name)
        if other != name:
            raise CalibError(
                f"two models are given for the same output: {other}, {name}",
                expected="one model for each output",
                hint=f"report one of them; `calib compare {other} {name} FILE` tells which of them "
                "the data prefer",
            )
    priors = {prior_file_model(path): path for path in prior_paths}
    for name in only:
        if name not in OUTPUTS:
            wrong, hint = f"there is no output {name!r}", "name one of these"
            raise CalibError(wrong, expected=", ".join(OUTPUTS), hint=hint)
    tasks: dict[str, Task] = {}
    for table in tables:
        if len(table) > MAX_ROWS:
            raise CalibError(
                f"{len(table)} rows are too many for a report",
                where=table.source,
                expected=f"up to {MAX_ROWS} rows",
                hint="use `calib fit` and `calib predict`, or thin the rows",
            )
        found = [key for key, column in OUTPUTS.items() if column in table]
        found = [key for key in found if not only or key in only]
        if not found:
            raise CalibError(
                "there is no output to calibrate",
                where=table.source,
                expected=", ".join(OUTPUTS.values()) + " (in any known unit)",
                hint=f"{renamed(table.ignored, OUTPUTS.values())}add a column with the measured "
                "output",
            )
        for key in found:
            if key in tasks:
                raise CalibError(
                    f"two files give the output {key}",
                    where=f"{tasks[key].table.source}, {table.source}",
                    hint="report one of them, or join them into one file",
                )
            rows = table.take(np.isfinite(table[OUTPUTS[key]]))
            usable = held_out if held_out is not None and held_out.applies_to(rows) else None
            model = wanted.get(OUTPUTS[key]) or choose_model(key, rows)
            tasks[key] = Task(key, model, rows, usable, priors.get(model))
    planned = tuple(tasks[key] for key in OUTPUTS if key in tasks)
    for column, name in wanted.items():
        if column not in {OUTPUTS[task.output] for task in planned}:
            raise CalibError(
                f"the model {name} is for {column}, which is not reported",
                where=", ".join(table.source for table in tables),
                expected=f"models of {', '.join(task.output for task in planned)}",
                hint=f"leave it out, or give a file with {column}",
            )
    if held_out is not None:
        _check_held_out(planned, held_out)
    return planned


def _check_held_out(tasks: Sequence[Task], held_out: HoldOut) -> None:
    """Check that the rows to hold out are there for one output at least."""
    refusals = []
    for task in tasks:
        try:
            held_out.split(task.table)
        except CalibError as error:
            refusals.append(error)
    if len(refusals) == len(tasks):
        raise refusals[0]


def fitted_rows(task: Task) -> tuple[Table, Table | None]:
    """Return the rows that are fitted, and those held out."""
    if task.held_out is None:
        return task.table, None
    return task.held_out.split(task.table)


@dataclass(frozen=True)
class OutputResult:
    """What a study found for one output, calibrated on the rows that are not held out.

    The predictive measurements, shape (draws, n), are at the calibration conditions; seconds are of
    each step of the work.
    """

    task: Task
    calibration: Calibration
    validation: Validation
    estimates: tuple[PointEstimate, ...]  # by every method, on all rows that the source fitted
    # Of the Magic Formula at each inflation pressure (psi) on its own; empty for other models.
    by_pressure: Mapping[float, tuple[PointEstimate, ...]]
    prior_predictive: Array
    posterior_predictive: Array
    seconds: Mapping[str, float] = field(default_factory=dict)
    sensitivity: Mapping[str, Sensitivity] = field(default_factory=dict)
    preference: NoisePreference | None = None  # of the prior file's noise over the usual one

    @cached_property
    def evidence(self) -> Evidence:
        """What its verdict is made from."""
        return gather(self.calibration, self.validation, self.prior_predictive)


@dataclass(frozen=True)
class Failure:
    """An output that could not be worked out, and why."""

    task: Task
    error: str


@dataclass(frozen=True)
class Study:
    """Results of all outputs, by the keys of `OUTPUTS`."""

    results: Mapping[str, OutputResult | Failure]
    seed: int
    seconds: float

    @property
    def successes(self) -> dict[str, OutputResult]:
        """The outputs that were worked out."""
        return {k: r for k, r in self.results.items() if isinstance(r, OutputResult)}

    @property
    def failures(self) -> dict[str, Failure]:
        """The outputs that were not."""
        return {k: r for k, r in self.results.items() if isinstance(r, Failure)}


def work_out_study(
    tasks: Sequence[Task],
    seed: int,
    pool: Executor,
    *,
    settings: SamplerSettings | None = None,
    tell: Progress,
    workers: int = 1,
) -> Study:
    """Work every output out; see `calib.report.sections.work_out`."""
    began = time.perf_counter()
    inner, inside = (tell, workers) if pool is HERE else (silent, 1)
    pieces = {t.output: pool.submit(_attempt, t, seed, settings, inner, inside) for t in tasks}
    results = {}
    for i, (key, piece) in enumerate(pieces.items()):
        results[key] = piece.result()
        if pool is not HERE:
            tell("outputs", i + 1, len(pieces))
    return Study(results, seed, time.perf_counter() - began)


@one_thread()
def _attempt(
    task: Task, seed: int, settings: SamplerSettings | None, progress: Progress, workers: int
) -> OutputResult | Failure:
    try:
        return _work_out(task, seed, settings, progress, workers)
    except Exception as error:  # whatever fails, the other outputs still come
        # What failed, without the folder that the priors are in.
        path = task.prior_path or default_priors(task.model)
        return Failure(task, f"{type(error).__name__}: {error}".replace(str(path), path.name))


def silent(what: str, done: int, planned: int) -> None:
    """Tell nobody of progress."""


def _work_out(
    task: Task, seed: int, settings: SamplerSettings | None, progress: Progress, workers: int
) -> OutputResult:
    seconds, output = {}, task.output
    fitted, held = fitted_rows(task)
    problem = build_problem(task.model, fitted, task.prior_path)

    def telling(what: str) -> Callable[[int, int], None]:
        return lambda done, planned: progress(f"{output}: {what}", done, planned)

    clock = time.perf_counter()
    seeding = (estimate(problem, "least_squares", generator(seed, output, "seeding")),)
    estimates, by_pressure = estimate_task(task, seed, progress=progress)
    seconds["estimate"] = time.perf_counter() - clock
    clock = time.perf_counter()
    how: Any = {"estimates": seeding, "settings": settings, "progress": telling("sampling")}
    calibration = calibrate(problem, seed, label=output, **how)
    keep(output, partial(save_calibration, calibration))
    seconds["sample"] = time.perf_counter() - clock
    clock = time.perf_counter()
    how = {"settings": settings, "workers": workers}
    if held is not None:
        validation, loo = validate_held_out(calibration, held), None
    else:
        validation = leave_one_out(calibration, progress=telling("leaving rows out"), **how)
        loo = validation
    preference = noise_preference(
        calibration, loo=loo, progress=telling("with normal noise"), **how
    )
    seconds["validate"] = time.perf_counter() - clock
    replicated = row_draws(calibration, problem.table, generator(seed, output, "replicate"))
    expected = prior_predictive(problem, generator(seed, output, "prior"))
    found = validation, estimates, by_pressure, expected, replicated, seconds
    return OutputResult(task, calibration, *found, prior_sensitivity(calibration), preference)


def validated(calibration: Calibration, held: Table | None) -> Validation | None:
    """Score a calibration on rows held out, or on each left out in turn; None where neither can be.

    Rows are left out by weights alone, for to fit without each takes as long as all else. Of a
    posterior that did not converge, or of more rows than a report takes, none is.
    """
    if held is not None:
        return validate_held_out(calibration, held)
    if not calibration.converged or len(calibration.problem.table) > MAX_ROWS:
        return None
    return leave_one_out(calibration, refit=False)


def estimate_task(
    task: Task, seed: int, *, progress: Progress | None = None
) -> tuple[tuple[PointEstimate, ...], dict[float, tuple[PointEstimate, ...]]]:
    """Return the point estimates of a task, and those at each inflation pressure on its own."""
    tell = progress or silent
    # The paper fitted drawbar pull at all pressures, rut depth at the two outer ones.
    everything = task.held_out is None or get_model(task.model).estimates_all_rows
    rows = task.table if everything else fitted_rows(task)[0]
    problem = build_problem(task.model, rows, task.prior_path)
    estimates = _all_methods(
        problem, seed, (task.output,), lambda done, n: tell(f"{task.output}: estimating", done, n)
    )
    return estimates, _each_alone(task, seed)


def _all_methods(
    problem: Problem,
    seed: int,
    labels: tuple[str, ...],
    progress: Callable[[int, int], None] | None = None,
) -> tuple[PointEstimate, ...]:
    """Estimate by every method; one that cannot read these data is left out of the table."""
    methods = methods_for(problem.bound.model.name)
    found = []
    for i, method in enumerate(methods):
        with suppress(CalibError):
            found.append(estimate(problem, method, generator(seed, *labels, method)))
        if progress is not None:
            progress(i + 1, len(methods))
    return tuple(found)


def _each_alone(task: Task, seed: int) -> dict[float, tuple[PointEstimate, ...]]:
    """Estimate by the simpler model at each value of its condition, where a model has one."""
    alone = get_model(task.model).alone
    if alone is None:
        return {}
    found = {}
    for value in np.unique(task.table[alone.column]):
        rows = task.table.take(np.isclose(task.table[alone.column], value))
        # Too few rows, or an output that is constant: nothing is estimated there.
        with suppress(CalibError):
            problem = build_problem(alone.model, rows, fixed=alone.fixed)
            found[float(value)] = _all_methods(problem, seed, (task.output, f"{value:g}"))
    return found
