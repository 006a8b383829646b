"""The main job: calibrate each output, predict it with bands, validate it, compare estimates.

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

import numpy as np

from calib.batch.environment import one_thread
from calib.batch.folders import keep
from calib.batch.pool import HERE
from calib.errors import CalibError
from calib.inference.calibration import Calibration, calibrate
from calib.inference.estimators import PointEstimate, estimate, methods_for
from calib.inference.io import save_calibration
from calib.inference.prior_files import default_priors
from calib.inference.problem import Problem, build_problem
from calib.inference.random import generator
from calib.inference.sampler import SamplerSettings
from calib.models import get_model
from calib.models.base import Array
from calib.report.study_tasks import Task, fitted_rows
from calib.report.verdict import Evidence, gather
from calib.validation.comparison import NoisePreference, noise_preference
from calib.validation.prediction import predictive_draws, prior_predictive
from calib.validation.scores import Sensitivity, prior_sensitivity
from calib.validation.validate import Validation, leave_one_out, validate_held_out

type Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class OutputResult:
    """What a study found for one output, calibrated on the rows that are not held out.

    Parameters
    ----------
    estimates : tuple of PointEstimate
        Every applicable method, on all rows the source fitted.
    by_pressure : mapping of float to tuple of PointEstimate
        The Magic Formula at each inflation pressure (psi) on its own; empty for other models.
    prior_predictive, posterior_predictive : ndarray, shape (draws, n)
        Measurements that are expected at the calibration conditions.
    seconds : mapping of str to float
        Of each step of the work.
    preference : NoisePreference, optional
        Of the noise that the prior file asks for over the usual one.
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
    preference: NoisePreference | None = None

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
    inner, inside = (tell, workers) if pool is HERE else (_silent, 1)
    pieces = {t.output: pool.submit(_attempt, t, seed, settings, inner, inside) for t in tasks}
    results = {}
    for i, (key, piece) in enumerate(pieces.items()):
        results[key] = piece.result()
        if pool is not HERE:
            tell("outputs", i + 1, len(pieces))
    return Study(results, seed, time.perf_counter() - began)


@one_thread()
def _attempt(
    task: Task,
    seed: int,
    settings: SamplerSettings | None,
    progress: Progress,
    workers: int,
) -> OutputResult | Failure:
    try:
        return _work_out(task, seed, settings, progress, workers)
    except Exception as error:  # whatever fails, the other outputs still come
        return Failure(task, _without_folder(task, error))


def _silent(what: str, done: int, planned: int) -> None:
    pass


def _without_folder(task: Task, error: Exception) -> str:
    """Return what failed, without the folder that the priors are in."""
    text = f"{type(error).__name__}: {error}"
    path = task.prior_path or default_priors(task.model)
    return text.replace(str(path), path.name)


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
    keep(task.output, partial(save_calibration, calibration))
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
    preference = noise_preference(
        calibration, loo=validation if held is None else None, settings=settings, workers=workers,
        progress=lambda done, n: progress(f"{task.output}: with normal noise", done, n),
    )  # fmt: skip
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
        prior_predictive(problem, generator(seed, task.output, "prior")),
        replicated,
        seconds,
        prior_sensitivity(calibration),
        preference,
    )


def estimate_task(
    task: Task, seed: int, *, progress: Progress | None = None
) -> tuple[tuple[PointEstimate, ...], dict[float, tuple[PointEstimate, ...]]]:
    """Return the point estimates of a task, and those at each inflation pressure on its own."""
    tell = progress or _silent
    # The paper fitted drawbar pull at all pressures, rut depth at the two outer ones.
    everything = task.held_out is None or get_model(task.model).estimates_all_rows
    rows = task.table if everything else fitted_rows(task)[0]
    problem = build_problem(task.model, rows, task.prior_path)
    estimates = _all_methods(
        problem, seed, (task.output,), lambda done, n: tell(f"{task.output}: estimating", done, n)
    )
    pressures = _each_alone(task, seed)
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
