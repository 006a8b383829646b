"""The main job: calibrate each output, predict it with bands, validate it, compare estimates.

A study is what a report shows. Each output is worked out on its own: one that fails is kept as a
`Failure`, and the others still come.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from calib.calibration import Calibration, calibrate
from calib.data import Table, hold_out
from calib.errors import CalibError
from calib.estimators import PointEstimate, estimate, methods_for
from calib.headers import parse_header
from calib.models import get_model
from calib.models.base import Array
from calib.outputs import OUTPUTS
from calib.prediction import predictive_draws
from calib.prior_files import default_prior_path, prior_file_model
from calib.problem import Problem, build_problem
from calib.sampling.sampler import SamplerSettings
from calib.sensitivity import Sensitivity, prior_sensitivity
from calib.streams import generator
from calib.threads import one_thread
from calib.validate import Validation, leave_one_out, validate_held_out

__all__ = [
    "Failure", "HoldOut", "OutputResult", "Study", "Task", "choose_model", "estimate_task",
    "fitted_rows", "he2019_tasks", "plan_tasks", "run_study",
]  # fmt: skip

N_PRIOR_PREDICTIVE = 1000
# Figures and leave-one-out hold a number for every draw and row.
MAX_ROWS = 5000

type Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class HoldOut:
    """Rows kept for validation: a column as a header would name it, and its value."""

    column: str
    value: float

    def __str__(self) -> str:
        return f"{self.column} = {self.value:g}"

    @classmethod
    def parse(cls, text: str) -> HoldOut:
        """Read ``COLUMN=VALUE``.

        Raises
        ------
        CalibError
            If it is not of this form.
        """
        column, equals, value = text.partition("=")
        try:
            if not equals:
                raise ValueError
            return cls(column.strip(), float(value))
        except ValueError:
            raise CalibError(
                f"cannot read --hold-out {text!r}",
                allowed="COLUMN=VALUE, for instance inflation_pressure_psi=30",
                mend="name a column with its unit, an equals sign and one number",
            ) from None

    def applies_to(self, table: Table) -> bool:
        """Whether a table has the column at all."""
        column = parse_header(self.column)
        return column is not None and column.quantity.canonical in table


@dataclass(frozen=True)
class Task:
    """One output to calibrate.

    Parameters
    ----------
    output : str
        Key of `OUTPUTS`.
    model : str
    table : Table
        All rows.
    held_out : HoldOut, optional
        Validation by held-out rows; by leave-one-out where there is none.
    prior_path : Path, optional
    """

    output: str
    model: str
    table: Table
    held_out: HoldOut | None = None
    prior_path: Path | None = None


@dataclass(frozen=True)
class OutputResult:
    """What a study found for one output.

    Parameters
    ----------
    task : Task
    calibration : Calibration
        On the rows that are not held out.
    validation : Validation
    estimates : tuple of PointEstimate
        Every applicable method, on all rows the source fitted.
    by_pressure : mapping of float to tuple of PointEstimate
        The Magic Formula at each inflation pressure (psi) on its own; empty for other models.
    prior_predictive : ndarray, shape (draws, n)
        Measurements the prior alone expects, at the calibration conditions.
    posterior_predictive : ndarray, shape (draws, n)
    seconds : mapping of str to float
        Of each stage.
    sensitivity : mapping of str to Sensitivity
        Of each parameter to prior and data.
    """

    task: Task
    calibration: Calibration
    validation: Validation
    estimates: tuple[PointEstimate, ...]
    by_pressure: Mapping[float, tuple[PointEstimate, ...]]
    prior_predictive: Array
    posterior_predictive: Array
    seconds: Mapping[str, float] = field(default_factory=dict)
    sensitivity: Mapping[str, Sensitivity] = field(default_factory=dict)


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


def choose_model(output: str, table: Table) -> str:
    """Pick the model that a table's columns allow for an output (a key of `OUTPUTS`)."""
    if output == "bulk_density":
        gravimetric = "gravimetric_water_content" in table
        return "ayers_perumpral" if gravimetric else "ayers_perumpral_volumetric"
    if output == "drawbar_pull":
        pressure = "inflation_pressure_psi"
        several = pressure in table and np.unique(table[pressure]).size > 1
        return "magic_formula_pressure" if several else "magic_formula"
    slips = "slip_ratio" in table and np.unique(table["slip_ratio"]).size > 1
    return "modified_bekker" if slips else "bekker"


def plan_tasks(
    tables: Sequence[Table],
    held_out: HoldOut | None = None,
    *,
    models: Sequence[str] = (),
    prior_paths: Sequence[Path] = (),
    only: Sequence[str] = (),
) -> tuple[Task, ...]:
    """Find the outputs in some tables and choose a model for each.

    Parameters
    ----------
    tables : sequence of Table
    held_out : HoldOut, optional
    models : sequence of str
        Models to use for their outputs, in the place of the ones the columns suggest.
    prior_paths : sequence of Path
        Prior files; each names the model it is for.
    only : sequence of str
        Outputs to work out (keys of `OUTPUTS`); all by default.

    Raises
    ------
    CalibError
        If no table has an output, two have the same, none has the rows to hold out, a table is
        too long for a report, or a name is unknown.
    """
    wanted = {get_model(name).output: name for name in models}
    priors = {prior_file_model(path): path for path in prior_paths}
    for name in only:
        if name not in OUTPUTS:
            raise CalibError(f"there is no output {name!r}", allowed=", ".join(OUTPUTS))
    tasks: dict[str, Task] = {}
    for table in tables:
        if len(table) > MAX_ROWS:
            raise CalibError(
                f"{len(table)} rows are too many for a report",
                where=table.source,
                allowed=f"up to {MAX_ROWS} rows",
                mend="use `calib fit` and `calib predict`, or thin the rows",
            )
        found = [key for key, column in OUTPUTS.items() if column in table]
        found = [key for key in found if not only or key in only]
        if not found:
            raise CalibError(
                "there is no output to calibrate",
                where=table.source,
                allowed=", ".join(OUTPUTS.values()) + " (in any known unit)",
                mend="add a column with the measured output",
            )
        for key in found:
            if key in tasks:
                raise CalibError(
                    f"two files give the output {key}",
                    where=f"{tasks[key].table.source}, {table.source}",
                    mend="report one of them, or join them into one file",
                )
            rows = table.take(np.isfinite(table[OUTPUTS[key]]))
            usable = held_out if held_out is not None and held_out.applies_to(rows) else None
            model = wanted.get(OUTPUTS[key]) or choose_model(key, rows)
            tasks[key] = Task(key, model, rows, usable, priors.get(model))
    planned = tuple(tasks[key] for key in OUTPUTS if key in tasks)
    if held_out is not None:
        _check_held_out(planned, held_out)
    return planned


def _check_held_out(tasks: Sequence[Task], held_out: HoldOut) -> None:
    """Check that the rows to hold out are there for one output at least."""
    refusals = []
    for task in tasks:
        try:
            hold_out(task.table, held_out.column, held_out.value)
        except CalibError as error:
            refusals.append(error)
    if len(refusals) == len(tasks):
        raise refusals[0]


def he2019_tasks() -> tuple[Task, ...]:
    """Return the paper's three calibrations on the embedded, reconstructed data.

    The 30 psi rows of drawbar pull and rut depth are held out.
    """
    from calib.datasets.he2019 import load_he2019

    held = HoldOut("inflation_pressure_psi", 30.0)
    models = {
        "bulk_density": ("ayers_perumpral", None),
        "drawbar_pull": ("magic_formula_pressure", held),
        "rut_depth": ("modified_bekker", held),
    }
    return tuple(Task(key, model, load_he2019(key), rows) for key, (model, rows) in models.items())


@one_thread()
def run_study(
    tasks: Sequence[Task],
    seed: int,
    *,
    settings: SamplerSettings | None = None,
    progress: Progress | None = None,
    workers: int = 1,
) -> Study:
    """Work every task out.

    Parameters
    ----------
    tasks : sequence of Task
    seed : int
    settings : SamplerSettings, optional
    progress : callable, optional
        Called with what is being done, steps done and steps planned.
    workers : int
        Processes for leaving rows out; the numbers do not depend on it.
    """
    began = time.perf_counter()
    results: dict[str, OutputResult | Failure] = {}
    for task in tasks:
        try:
            results[task.output] = _work_out(task, seed, settings, progress or _silent, workers)
        except Exception as error:  # whatever fails, the other outputs still come
            results[task.output] = Failure(task, _without_folder(task, error))
    return Study(results, seed, time.perf_counter() - began)


def _silent(what: str, done: int, planned: int) -> None:
    pass


def _without_folder(task: Task, error: Exception) -> str:
    """Return what failed; where the priors lie on this computer is nobody's business."""
    text = f"{type(error).__name__}: {error}"
    path = task.prior_path or default_prior_path(task.model)
    return text.replace(str(path), path.name)


def fitted_rows(task: Task) -> tuple[Table, Table | None]:
    """Return the rows that are fitted, and those held out."""
    if task.held_out is None:
        return task.table, None
    return hold_out(task.table, task.held_out.column, task.held_out.value)


def _work_out(
    task: Task, seed: int, settings: SamplerSettings | None, progress: Progress, workers: int
) -> OutputResult:
    seconds: dict[str, float] = {}
    fitted, held = fitted_rows(task)
    problem = build_problem(task.model, fitted, task.prior_path)
    clock = time.perf_counter()
    seeding = (estimate(problem, "least_squares", generator(seed, task.output, "seeding")),)
    estimates, by_pressure = estimate_task(task, seed, progress=progress)
    seconds["estimate"] = time.perf_counter() - clock
    clock = time.perf_counter()
    calibration = calibrate(
        problem,
        seed,
        label=task.output,
        estimates=seeding,
        settings=settings,
        progress=lambda done, planned: progress(f"{task.output}: sampling", done, planned),
    )
    seconds["sample"] = time.perf_counter() - clock
    clock = time.perf_counter()
    if held is not None:
        validation = validate_held_out(calibration, held)
    else:
        validation = leave_one_out(
            calibration,
            settings=settings,
            progress=lambda done, n: progress(f"{task.output}: leaving rows out", done, n),
            workers=workers,
        )
    seconds["validate"] = time.perf_counter() - clock
    _, replicated = predictive_draws(
        calibration, problem.conditions, generator(seed, task.output, "replicate")
    )
    return OutputResult(
        task,
        calibration,
        validation,
        estimates,
        by_pressure,
        _prior_predictive(problem, generator(seed, task.output, "prior")),
        replicated,
        seconds,
        prior_sensitivity(calibration),
    )


def estimate_task(
    task: Task, seed: int, *, progress: Progress | None = None
) -> tuple[tuple[PointEstimate, ...], dict[float, tuple[PointEstimate, ...]]]:
    """Return the point estimates of a task, and those at each inflation pressure on its own.

    Parameters
    ----------
    task : Task
    seed : int
    progress : callable, optional

    Raises
    ------
    CalibError
        If the data or the priors do not fit the model.
    """
    tell = progress or _silent
    # The paper fitted drawbar pull at all pressures, rut depth at the two outer ones.
    everything = task.held_out is None or task.model.startswith("magic_formula")
    rows = task.table if everything else fitted_rows(task)[0]
    problem = build_problem(task.model, rows, task.prior_path)
    estimates = _all_methods(
        problem, seed, (task.output,), lambda done, n: tell(f"{task.output}: estimating", done, n)
    )
    pressures = _by_pressure(task, seed) if task.model == "magic_formula_pressure" else {}
    return estimates, pressures


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


def _by_pressure(task: Task, seed: int) -> dict[float, tuple[PointEstimate, ...]]:
    found = {}
    for psi in np.unique(task.table["inflation_pressure_psi"]):
        rows = task.table.take(np.isclose(task.table["inflation_pressure_psi"], psi))
        # Too few rows, or a pull that is constant: nothing is estimated at this pressure.
        with suppress(CalibError):
            problem = build_problem("magic_formula", rows, fixed={"Sh": 0.0, "Sv": 0.0})
            found[float(psi)] = _all_methods(problem, seed, (task.output, f"{psi:g}"))
    return found


def _prior_predictive(problem: Problem, rng: np.random.Generator) -> Array:
    natural = problem.theta(problem.priors.sample(rng, N_PRIOR_PREDICTIVE))
    location = problem.bound.location(natural[:, :-1], problem.conditions)
    noise = natural[:, -1:] * rng.standard_normal(location.shape)
    return problem.bound.from_response(location + noise)
