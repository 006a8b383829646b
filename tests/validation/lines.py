"""Straight lines of pull against slip, whose least squares are those of the textbook."""

from __future__ import annotations

import numpy as np

from calib.data import Table, table_from_arrays
from calib.inference.calibration import Calibration, calibrate
from calib.inference.estimators import estimate_least_squares
from calib.inference.priors import Prior
from calib.inference.problem import Problem
from calib.inference.sampler import SamplerSettings
from calib.validation.residuals import failed, residual_checks
from tests.custom_problems import normal, problem_of

type Array = np.ndarray


def line_problem(slip: Array, pull: Array) -> Problem:
    priors = [normal("a", 0.0, 1e6), normal("b", 0.0, 1e6), normal("sigma", 0.0, 0.1, log=True)]
    return problem_of(lambda a, b, s: a + b * s, priors, slip, pull)


def fitted_line(slip: Array, pull: Array) -> Array:
    """Internal coordinates of the line by least squares."""
    b, a = np.polyfit(slip, pull, 1)
    return np.array([a, b, 0.0])


def notes(problem: Problem, t: Array) -> str:
    """What the tests of residuals that fail say."""
    return " | ".join(remark.text for remark in failed(residual_checks(problem, t)))


def said(slip: Array, pull: Array) -> str:
    return notes(line_problem(slip, pull), fitted_line(slip, pull))


def with_columns(problem: Problem, **columns: object) -> Problem:
    found: Table = table_from_arrays({**problem.table.columns, **columns}, source="my.csv")
    return problem.with_table(found)


def calibrated(slope: Prior, slip: Array, pull: Array, sigma: Prior | None = None) -> Calibration:
    """A line with a prior of its slope, started at least squares, with few but enough draws."""
    noise = sigma or normal("sigma", np.log(0.1), 1.0, log=True)
    problem = problem_of(
        lambda a, b, s: a + b * s, [normal("a", 0.0, 10.0), slope, noise], slip, pull
    )
    point = estimate_least_squares(problem, np.random.default_rng(1))
    few = SamplerSettings(steps=100, max_steps=100)
    return calibrate(problem, 1, estimates=(point,), settings=few)
