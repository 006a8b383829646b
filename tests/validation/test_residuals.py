"""Tests of residuals with a stated chance of a false alarm, and rows that lie far off."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from calib.data.quantities import OUTPUTS
from calib.he2019.embedded import he2019_tasks
from calib.inference.likelihood import Noise
from calib.inference.mode import find_mode
from calib.inference.priors import Priors
from calib.inference.problem import Problem, build_problem
from calib.validation.constants import LEVEL, OUTLYING_LEVEL
from calib.validation.residuals import (
    Check,
    Remark,
    durbin_watson_moments,
    failed,
    linear,
    outlying_notes,
    outlying_rows,
    residual_checks,
)
from calib.validation.scores import holm
from tests.custom_problems import normal, problem_of
from tests.validation.lines import fitted_line, line_problem, notes, said, with_columns

SLIP = np.linspace(0.02, 0.6, 40)
Z = (SLIP - SLIP.mean()) / SLIP.std()
TASKS = {task.output: task for task in he2019_tasks()}


def never_too_often(alarms: int, trials: int, level: float = LEVEL) -> bool:
    return bool(stats.binom.sf(alarms - 1, trials, level) > 1e-3)


@pytest.mark.parametrize(
    ("n", "trials"),
    [(12, 200), (40, 200), *(pytest.param(n, 10_000, marks=pytest.mark.slow) for n in (15, 40))],
)
def test_independent_normal_rows_are_left_alone(n: int, trials: int) -> None:
    """All tests together alarm no more often than the level says, and nearly as often."""
    rng, count = np.random.default_rng(11), 0
    for _ in range(trials):
        slip = rng.random(n)
        count += bool(said(slip, slip + rng.standard_normal(n)))
    assert never_too_often(count, trials)
    assert stats.binom.cdf(count, trials, 0.5 * LEVEL) > 1e-3


def test_columns_that_mean_nothing_alarm_no_more_often_than_is_said() -> None:
    rng, alarms, trials = np.random.default_rng(7), 0, 100
    for _ in range(trials):
        pull = 1.0 + 2.0 * SLIP + 0.1 * rng.standard_normal(40)
        extra = {"bin": rng.choice(["A", "B", "C"], 40), "heat": rng.random(40)}
        problem = with_columns(line_problem(SLIP, pull), **extra)
        alarms += bool(notes(problem, fitted_line(SLIP, pull)))
    assert never_too_often(alarms, trials)


def test_holms_procedure_is_that_of_its_table() -> None:
    """Holm (1979): the i-th smallest of m against level/(m - i), and none beyond the first kept."""
    tests = [Check(p, Remark(str(p))) for p in (0.01, 0.04, 0.03, 0.005)]
    # 0.005 < 0.05/4 and 0.01 < 0.05/3, but 0.03 is not below 0.05/2, so 0.04 stays as well.
    assert [remark.text for remark in failed(tests, 0.05)] == ["0.01", "0.005"]
    assert holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])
    assert failed([Check(float("nan"), Remark("x"))]) == ()


def test_durbin_and_watsons_moments_are_exact() -> None:
    """Mean and variance of the statistic, in matrices as they print them."""
    rng = np.random.default_rng(4)
    n, k = 15, 2
    x = np.column_stack([np.ones(n), rng.random(n)])
    m = np.eye(n) - x @ np.linalg.solve(x.T @ x, x.T)
    a = 2.0 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
    a[0, 0] = a[-1, -1] = 1.0
    mean, variance = durbin_watson_moments(np.linalg.qr(x)[0])
    p, both = np.trace(m @ a), np.trace(m @ a @ m @ a)
    assert mean == pytest.approx(p / (n - k))
    assert variance == pytest.approx(2.0 * (both - p * mean) / ((n - k) * (n - k + 2.0)))
    # The beta distribution in the tail that is looked at.
    e = rng.standard_normal((200_000, n)) @ m
    d = np.square(np.diff(e, axis=1)).sum(axis=1) / np.square(e).sum(axis=1)
    at = mean / 4.0
    size = at * (1.0 - at) / (variance / 16.0) - 1.0
    edge = 4.0 * stats.beta.ppf(0.001, at * size, (1.0 - at) * size)
    assert np.mean(d < edge) == pytest.approx(0.001, abs=0.0005)


def test_rows_of_one_run_are_noticed_and_their_worth_is_said() -> None:
    rng = np.random.default_rng(5)
    slip, e = np.linspace(0.0, 0.6, 80), rng.standard_normal(80)
    for i in range(1, 80):
        e[i] = 0.8 * e[i - 1] + 0.6 * e[i]
    found = said(slip, slip + 0.1 * e)
    assert "neighbouring rows are alike" in found
    worth = int(found.split("worth about ")[1].split(" ")[0])
    assert 3 <= worth <= 25  # 80 (1 - 0.8)/(1 + 0.8) = 9
    # The same rows in any order are as independent as can be told.
    order = rng.permutation(80)
    assert "alike" not in said(slip[order], slip[order] + 0.1 * e[order])


@pytest.mark.parametrize(("slope", "word"), [(2.0, "grows"), (-2.0, "falls")])
def test_noise_that_depends_on_a_condition_is_noticed_and_the_remedy_works(
    slope: float, word: str
) -> None:
    rng = np.random.default_rng(6)
    pull = 1.0 + SLIP + 0.05 * np.exp(0.5 * slope * Z) * rng.standard_normal(40)
    problem = line_problem(SLIP, pull)
    found = notes(problem, fitted_line(SLIP, pull))
    assert f"scatter {word} with slip" in found
    assert 'noise_depends_on = "slip"' in found
    b, a = np.polyfit(SLIP, pull, 1, w=np.exp(-0.5 * slope * Z))
    assert notes(uneven(problem), np.array([a, b, 0.5 * slope, np.log(0.05)])) == ""


def uneven(problem: Problem) -> Problem:
    """The problem with noise that depends on slip."""
    noise = Noise("normal", "slip", "", "slip_ratio", SLIP.mean(), SLIP.std())
    *others, sigma = problem.priors.entries
    priors = Priors((*others, normal("sigma_slope", 0.0, 0.5), sigma))
    return replace(problem, noise=noise, priors=priors)


def test_scatter_concerns_the_rows_nearest_to_where_it_differs() -> None:
    """Of three levels of slip the last scatters most, the first least: the middle is as assumed."""
    slip = np.repeat([0.1, 0.2, 0.5], 15)
    noise = np.random.default_rng(9).standard_normal(45) * np.repeat([0.02, 0.1, 0.5], 15)
    problem = line_problem(slip, 1.0 + slip + noise)
    found = failed(residual_checks(problem, fitted_line(slip, 1.0 + slip + noise)))
    (uneven,) = (r for r in found if r.title == "Scatter is uneven")
    for at, concerned in ((0.0, True), (0.1, True), (0.2, False), (0.3, False), (0.9, True)):
        assert uneven.concerns({"slip_ratio": np.array([at])}) is concerned


def test_heavy_tails_are_noticed_and_the_remedy_works() -> None:
    rng = np.random.default_rng(7)
    slip = rng.random(60)
    pull = 1.0 + slip + 0.05 * stats.t(1.5).rvs(60, random_state=rng)
    problem = line_problem(slip, pull)
    found = notes(problem, fitted_line(slip, pull))
    assert "heavier tails" in found
    assert 'family = "student_t"' in found
    *others, sigma = problem.priors.entries
    priors = Priors((*others, normal("nu", 0.0, 1.0, log=True), sigma))
    student = replace(problem, noise=Noise("student_t"), priors=priors)
    assert "tails" not in notes(student, np.array([1.0, 1.0, np.log(1.5), np.log(0.05)]))


def test_too_few_rows_are_not_judged() -> None:
    assert said(np.linspace(0, 1, 8), np.array([0.0, 1, 0, 1, 0, 1, 0, 1])) == ""


BIN = np.tile(["A", "B"], 20)
DAY = np.tile([1.0, 2.0, 3.0, 4.0], 10)
ORDER = np.random.default_rng(8).permutation(40) + 1.0
HEAT = np.random.default_rng(6).random(40)


def explained(header: str, values: np.ndarray, effect: np.ndarray) -> list[str]:
    pull = 1.0 + 2.0 * SLIP + effect + 0.1 * np.random.default_rng(5).standard_normal(40)
    problem = with_columns(line_problem(SLIP, pull), **{header: values})
    found = failed(residual_checks(problem, fitted_line(SLIP, pull)))
    return [r.text for r in found if r.title == "A column explains the residuals"]


@pytest.mark.parametrize(
    ("header", "values", "effect", "words"),
    [
        ("soil bin", BIN, 0.2 * (BIN == "A"), "where it is A (20 rows)"),
        ("day", DAY, 0.4 * (DAY == 3.0), "where it is 3 (10 rows)"),
        ("day", DAY, 0.4 * (DAY == 3.0), "fit each of its values by itself"),
        ("run_order", ORDER, 0.02 * ORDER, 'correlated_along = "run_order"'),
        ("heat", HEAT, 8.0 * (HEAT - 0.5) ** 2, "where it is 0."),
        ("cone_index_kpa", 400.0 + 200.0 * HEAT, HEAT, "a column that is not used"),
    ],
)
def test_a_column_that_explains_the_residuals_is_named(
    header: str, values: np.ndarray, effect: np.ndarray, words: str
) -> None:
    """A category, a number of few values, a trend, a bow, and a quantity that is known."""
    (text,) = explained(header, values, effect)
    assert f"differ with {header!r}" in text
    assert words in text


def test_remarks_constants_and_other_outputs_explain_nothing() -> None:
    assert explained("remark", np.array([f"row {i}" for i in range(40)]), HEAT) == []
    assert explained("site", np.full(40, "north"), HEAT) == []
    assert explained("rut_depth_mm", 10.0 + 10.0 * HEAT, HEAT) == []


def test_the_linear_model_is_that_of_weighted_least_squares() -> None:
    pull = SLIP + np.random.default_rng(1).standard_normal(40)
    problem, used = line_problem(SLIP, pull), np.ones(40, dtype=bool)
    residual, design, rank = linear(problem, fitted_line(SLIP, pull), used)
    assert rank == 2
    np.testing.assert_allclose(design.T @ design, np.eye(2), atol=1e-9)
    np.testing.assert_allclose(design.T @ residual, 0.0, atol=1e-9)
    residual, design, _ = linear(uneven(problem), np.array([0.1, 0.9, 0.7, -1.0]), used)
    np.testing.assert_allclose(residual, (pull - 0.1 - 0.9 * SLIP) / np.exp(0.7 * Z), rtol=1e-9)
    weighted = np.column_stack([np.ones(40), SLIP]) / np.exp(0.7 * Z)[:, None]
    np.testing.assert_allclose(design @ design.T, weighted @ np.linalg.pinv(weighted), atol=1e-6)


# Outlying rows


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
    assert (found.line, found.value) == (problem.table.lines[9], pull[9])
    x, y = np.delete(slip, 9), np.delete(pull, 9)
    design = np.column_stack([np.ones_like(x), x])
    coefficients = np.linalg.solve(design.T @ design, design.T @ y)
    variance = np.sum((y - design @ coefficients) ** 2) / (x.size - 2)
    at = np.array([1.0, slip[9]])
    spread = variance * (1.0 + at @ np.linalg.solve(design.T @ design, at))
    # The line through the others is found by climbing, to its tolerance.
    expected = abs(pull[9] - at @ coefficients) / np.sqrt(spread)
    assert found.sds == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_beside_ground_without_a_value_the_slope_is_that_of_one_side(side: float) -> None:
    """A mode at the edge of where a simulator runs at all."""
    slip, pull = one_row_off()
    t, used, whole = fitted_line(slip, pull), np.ones(15, dtype=bool), line_problem(slip, pull)
    ends = problem_of(
        lambda a, b, s: np.where(side * (b - t[1]) > 0.0, np.nan, a + b * s),
        whole.priors.entries, slip, pull,
    )  # fmt: skip
    for found, expected in zip(linear(ends, t, used), linear(whole, t, used), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-6)


@pytest.mark.parametrize("second", [3.0, -3.0, 30.0])
def test_two_do_not_hide_each_other(second: float) -> None:
    rng = np.random.default_rng(1)
    slip = rng.random(20)
    pull = 1.0 + 2.0 * slip + 0.1 * rng.standard_normal(20)
    pull[[4, 13]] += (3.0, second)
    problem = line_problem(slip, pull)
    found = outlying_rows(problem, fitted_line(slip, pull))
    assert {row.line for row in found} == {problem.table.lines[i] for i in (4, 13)}


def test_data_as_the_likelihood_says_have_no_outlying_rows() -> None:
    """No more often than Bonferroni's bound says."""
    rng, named = np.random.default_rng(2), 0
    for _ in range(100):
        slip = rng.random(12)
        pull = slip + rng.standard_normal(12)
        named += bool(outlying_rows(line_problem(slip, pull), fitted_line(slip, pull)))
    assert never_too_often(named, 100, OUTLYING_LEVEL)


@pytest.mark.parametrize(
    ("output", "wrong"),
    [
        ("bulk_density", []), ("drawbar_pull", []), ("rut_depth", []),
        ("bulk_density", [2]), ("drawbar_pull", [2]), ("rut_depth", [-1]),
        ("drawbar_pull", [10, 18]), ("rut_depth", [10, 18]),
    ],
)  # fmt: skip
def test_slips_of_the_pen_are_found_in_real_tables(output: str, wrong: list[int]) -> None:
    """Readings with the decimal point one place further on; the tables themselves have none."""
    table, column = TASKS[output].table, OUTPUTS[output]
    values = table[column].copy()
    values[wrong] *= 10.0
    table = replace(table, columns={**table.columns, column: values})
    problem = build_problem(TASKS[output].model, table)
    mode = find_mode(problem.log_prob, problem.priors)
    lines = {int(table.lines[i]) for i in wrong}
    assert {row.line for row in outlying_rows(problem, mode)} == lines
    for note in outlying_notes(problem, mode):
        assert any(f"line {line}: {column}" in note for line in lines)


def test_rows_that_are_fitted_exactly_are_not_judged() -> None:
    slip, pull = np.array([0.1, 0.2, 0.3]), np.array([1.0, 2.0, 30.0])
    assert outlying_rows(line_problem(slip, pull), fitted_line(slip, pull)) == ()
    # A row alone at its condition: nothing else says what is expected there.
    slip, pull = np.array([0.0] * 9 + [1.0]), np.array([*np.linspace(-1.0, 1.0, 9), 50.0])
    assert outlying_rows(line_problem(slip, pull), fitted_line(slip, pull)) == ()
