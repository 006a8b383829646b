"""Results as a study gives them, from the shared calibrations: nothing is sampled again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib.data import Table
from calib.data.quantities import OUTPUTS
from calib.inference.calibration import Calibration
from calib.inference.estimators import PointEstimate, estimate
from calib.inference.problem import Problem, build_problem
from calib.models.base import Array
from calib.report.study import HoldOut, OutputResult, Task
from calib.validation.prediction import predictive_draws
from calib.validation.scores import prior_sensitivity
from calib.validation.validate import leave_one_out, validate_held_out

HELD = HoldOut("inflation_pressure_psi", 30.0)


def joined(*tables: Table) -> Table:
    columns = {name: np.concatenate([t[name] for t in tables]) for name in tables[0]}
    return replace(tables[0], columns=columns, lines=np.arange(sum(map(len, tables))), text=())


def _points(problem: Problem, *methods: str) -> tuple[PointEstimate, ...]:
    rng = np.random.default_rng(3)
    return tuple(estimate(problem, method, rng) for method in methods)


def _prior_predictive(problem: Problem, rng: np.random.Generator) -> Array:
    natural = problem.theta(problem.priors.sample(rng, 300))
    location = problem.bound.mean_response(natural[:, :-1], problem.conditions)
    noise = natural[:, -1:] * rng.standard_normal(location.shape)
    return problem.bound.from_response(location + noise)


def build(calibration: Calibration, held: Table | None = None) -> OutputResult:
    problem = calibration.problem
    rng = np.random.default_rng(4)
    model = problem.bound.model
    whole = problem.table if held is None else joined(problem.table, held)
    output = next(key for key, column in OUTPUTS.items() if column == model.output)
    methods = ["least_squares"]
    methods += ["geometric"] if model.name.startswith("magic") else []
    methods += ["published_regression"] if model.name.endswith("bekker") else []
    by_pressure = {}
    if model.name == "magic_formula_pressure":
        for psi in np.unique(whole["inflation_pressure_psi"]):
            rows = whole.take(whole["inflation_pressure_psi"] == psi)
            alone = build_problem("magic_formula", rows, fixed={"Sh": 0.0, "Sv": 0.0})
            by_pressure[float(psi)] = _points(alone, "geometric", "least_squares")
    return OutputResult(
        Task(output, model.name, whole, None if held is None else HELD),
        calibration,
        leave_one_out(calibration) if held is None else validate_held_out(calibration, held),
        _points(problem, *methods),
        by_pressure,
        _prior_predictive(problem, rng),
        predictive_draws(calibration, problem.conditions, rng, 500)[1],
        {"sample": 1.0},
        prior_sensitivity(calibration),
    )
