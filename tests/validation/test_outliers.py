"""Outlying rows: the textbook's test on a straight line, and slips of the pen in real tables."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from calib.data.quantities import OUTPUTS
from calib.he2019.designs import he2019_tasks
from calib.inference.mode import find_mode
from calib.inference.problem import Problem, build_problem
from calib.validation.residuals import OUTLYING_LEVEL, linear, outlying_notes, outlying_rows
from tests.custom_problems import normal, problem_of

TASKS = {task.output: task for task in he2019_tasks()}


def line_problem(slip: np.ndarray, pull: np.ndarray) -> Problem:
    priors = [normal("a", 0.0, 1e6), normal("b", 0.0, 1e6), normal("sigma", 0.0, 0.1, log=True)]
    return problem_of(lambda a, b, s: a + b * s, priors, slip, pull)


def fitted_line(slip: np.ndarray, pull: np.ndarray) -> np.ndarray:
    b, a = np.polyfit(slip, pull, 1)
    return np.array([a, b, 0.0])


def left_out(slip: np.ndarray, pull: np.ndarray, i: int) -> float:
    """Distance of a row from the line through the others, in sds of that distance."""
    x, y = np.delete(slip, i), np.delete(pull, i)
    design = np.column_stack([np.ones_like(x), x])
    coefficients = np.linalg.solve(design.T @ design, design.T @ y)
    variance = np.sum((y - design @ coefficients) ** 2) / (x.size - 2)
    at = np.array([1.0, slip[i]])
    spread = variance * (1.0 + at @ np.linalg.solve(design.T @ design, at))
    return float((pull[i] - at @ coefficients) / np.sqrt(spread))


def one_row_off() -> tuple[np.ndarray, np.ndarray]:
    """Slip and pull of 15 rows on a line, but for the tenth."""
    rng = np.random.default_rng(1)
    slip = rng.random(15)
    pull = 1.0 + 2.0 * slip + 0.1 * rng.standard_normal(15)
    pull[9] -= 2.0
    return slip, pull


def test_distances_are_those_from_a_line_through_the_other_rows() -> None:
    slip, pull = one_row_off()
    problem = line_problem(slip, pull)
    (found,) = outlying_rows(problem, fitted_line(slip, pull))
    assert found.line == problem.table.lines[9]
    assert found.value == pull[9]
    # The line through the others is found by climbing, to its tolerance.
    assert found.sds == pytest.approx(abs(left_out(slip, pull, 9)), rel=1e-5)


def test_beside_ground_without_a_value_the_slope_is_that_of_one_side() -> None:
    """A mode at the edge of where a simulator runs at all."""
    slip, pull = one_row_off()
    t = fitted_line(slip, pull)
    priors = [normal("a", 0.0, 1e6), normal("b", 0.0, 1e6), normal("sigma", 0.0, 0.1, log=True)]
    for side in (1.0, -1.0):
        ends = problem_of(
            lambda a, b, s, side=side: np.where(side * (b - t[1]) > 0.0, np.nan, a + b * s),
            priors, slip, pull,
        )  # fmt: skip
        used = np.ones(15, dtype=bool)
        for found, whole in zip(
            linear(ends, t, used), linear(line_problem(slip, pull), t, used), strict=True
        ):
            np.testing.assert_allclose(found, whole, atol=1e-6)


@pytest.mark.parametrize("second", [3.0, -3.0, 30.0])
def test_two_do_not_hide_each_other(second: float) -> None:
    rng = np.random.default_rng(1)
    slip = rng.random(20)
    pull = 1.0 + 2.0 * slip + 0.1 * rng.standard_normal(20)
    pull[4] += 3.0
    pull[13] += second
    problem = line_problem(slip, pull)
    found = outlying_rows(problem, fitted_line(slip, pull))
    assert {row.line for row in found} == {problem.table.lines[i] for i in (4, 13)}


def test_data_as_the_likelihood_says_are_left_alone() -> None:
    """No more often than Bonferroni's bound says."""
    rng, named = np.random.default_rng(2), 0
    for _ in range(200):
        slip = rng.random(12)
        pull = slip + rng.standard_normal(12)
        named += bool(outlying_rows(line_problem(slip, pull), fitted_line(slip, pull)))
    assert stats.binom.sf(named - 1, 200, OUTLYING_LEVEL) > 1e-3


@pytest.mark.parametrize("output", ["bulk_density", "drawbar_pull", "rut_depth"])
def test_a_slip_of_the_pen_is_found(output: str) -> None:
    """One reading of each table with its decimal point one place further on."""
    table, model = TASKS[output].table, TASKS[output].model
    column = OUTPUTS[output]
    for row in (2, len(table) // 2):
        values = table[column].copy()
        values[row] *= 10.0
        problem = build_problem(model, replace(table, columns={**table.columns, column: values}))
        mode = find_mode(problem.log_prob, problem.priors)
        found = outlying_rows(problem, mode)
        assert found[0].line == table.lines[row]
        note = outlying_notes(problem, mode)[0]
        assert f"line {table.lines[row]}" in note
        assert column in note


@pytest.mark.parametrize("output", ["drawbar_pull", "rut_depth"])
def test_two_slips_of_the_pen_are_found(output: str) -> None:
    table, model, column = TASKS[output].table, TASKS[output].model, OUTPUTS[output]
    values = table[column].copy()
    rows = [10, 18]
    values[rows] *= 10.0
    problem = build_problem(model, replace(table, columns={**table.columns, column: values}))
    mode = find_mode(problem.log_prob, problem.priors)
    found = outlying_rows(problem, mode)
    assert {row.line for row in found} == {table.lines[i] for i in rows}
    assert max(row.sds for row in found) < 1e4


@pytest.mark.parametrize("output", ["bulk_density", "drawbar_pull", "rut_depth"])
def test_the_data_of_the_source_have_none(output: str) -> None:
    problem = build_problem(TASKS[output].model, TASKS[output].table)
    mode = find_mode(problem.log_prob, problem.priors)
    assert outlying_rows(problem, mode) == ()


def test_rows_that_are_fitted_exactly_are_not_judged() -> None:
    slip, pull = np.array([0.1, 0.2, 0.3]), np.array([1.0, 2.0, 30.0])
    assert outlying_rows(line_problem(slip, pull), fitted_line(slip, pull)) == ()
    # A row alone at its condition: nothing else says what is expected there.
    slip, pull = np.array([0.0] * 9 + [1.0]), np.array([*np.linspace(-1.0, 1.0, 9), 50.0])
    assert outlying_rows(line_problem(slip, pull), fitted_line(slip, pull)) == ()
