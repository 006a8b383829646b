"""What the data say against the prior, and columns that the model leaves out: right values."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from calib.data import table_from_arrays
from calib.inference.calibration import Calibration, calibrate
from calib.inference.estimators import estimate_least_squares
from calib.inference.priors import Prior
from calib.inference.problem import Problem
from calib.report.verdict import verdict
from calib.validation.assumptions import checks_of, parameter_remarks, remarks_of
from calib.validation.prediction import predict
from calib.validation.residuals import LEVEL, failed, residual_checks
from calib.validation.validate import leave_one_out
from tests.custom_problems import normal, problem_of
from tests.validation.test_outliers import fitted_line, line_problem

SLIP = np.linspace(0.0, 1.0, 40)
NOISE = 0.1 * np.random.default_rng(3).standard_normal(40)


def fitted(slope: Prior, pull: np.ndarray) -> Calibration:
    priors = [normal("a", 0.0, 10.0), slope, normal("sigma", np.log(0.1), 1.0, log=True)]
    problem = problem_of(lambda a, b, s: a + b * s, priors, SLIP, pull)
    point = estimate_least_squares(problem, np.random.default_rng(1))
    return calibrate(problem, 1, estimates=(point,))


def test_a_prior_that_the_data_contradict_is_named_with_its_numbers() -> None:
    """The slope is 2; its prior has 0 +- 0.05, so that the posterior lies between."""
    pull = 1.0 + 2.0 * SLIP + NOISE
    found = fitted(normal("b", 0.0, 0.05), pull)
    (check,) = (c for c in checks_of(found) if "the prior: " in c.remark.text)
    line = np.polyfit(SLIP, pull, 1)
    assert f"b = {line[0]:.3g}" in check.remark.text
    # The F test of the sums of squares at the mode and of least squares.
    problem = found.problem
    at_mode = np.square(problem.residuals(problem.theta(found.draws.mode[None]))).sum()
    least = np.square(pull - np.polyval(line, SLIP)).sum()
    p = stats.f.sf((at_mode - least) / 2.0 / (least / 38.0), 2, 38)
    assert check.p == pytest.approx(p, rel=1e-6)
    assert p < 1e-6
    judged = verdict(found)
    assert check.remark in judged.remarks
    assert "by least squares" in parameter_remarks(found, judged.remarks)["b"]


@pytest.mark.parametrize("sd", [0.1, 1.0, 100.0])
def test_a_prior_that_is_right_is_left_alone(sd: float) -> None:
    found = fitted(normal("b", 2.05, sd), 1.0 + 2.0 * SLIP + NOISE)
    assert "Prior contradicted" not in {r.title for r in failed(checks_of(found))}


@pytest.mark.parametrize(("median", "told"), [(0.01, True), (0.1, False), (1.0, True)])
def test_a_prior_of_the_noise_that_the_data_contradict(median: float, told: bool) -> None:
    """The rows scatter by 0.1 about the line."""
    priors = [normal("a", 0.0, 10.0), normal("b", 0.0, 10.0),
              normal("sigma", np.log(median), 0.05, log=True)]  # fmt: skip
    pull = 1.0 + 2.0 * SLIP + NOISE
    problem = problem_of(lambda a, b, s: a + b * s, priors, SLIP, pull)
    point = estimate_least_squares(problem, np.random.default_rng(1))
    found = failed(checks_of(calibrate(problem, 1, estimates=(point,))))
    said = [r.text for r in found if r.title == "Prior contradicted"]
    assert bool(said) is told
    if told:
        least = np.square(pull - np.polyval(np.polyfit(SLIP, pull, 1), SLIP)).sum()
        assert f"the rows scatter by {np.sqrt(least / 38.0):.3g} where" in said[0]


def test_weak_data_do_not_contradict_a_sharp_prior_that_is_right() -> None:
    """Least squares are many posterior sds off then: the posterior is as narrow as the prior."""
    rng, alarms, told = np.random.default_rng(4), 0, []
    for _ in range(20):
        pull = 1.0 + 2.0 * SLIP + rng.standard_normal(40)
        found = fitted(normal("b", 2.0, 0.01), pull)
        remarks = verdict(found).remarks
        alarm = "Prior contradicted" in {r.title for r in remarks}
        alarms += alarm
        told.append(parameter_remarks(found, remarks)["b"])
        assert ("sds off" in told[-1]) is alarm
    assert sum("least squares fit as well with" in said for said in told) > 10
    assert stats.binom.sf(alarms - 1, 20, LEVEL) > 1e-3


@pytest.mark.parametrize(("slope", "bound"), [(-1.0, 0.0), (3.0, 1.0), (0.5, None)])
def test_a_posterior_pressed_against_a_bound_is_said(slope: float, bound: float | None) -> None:
    uniform = Prior("b", "1", "a test", "nobody", "uniform", False, 0.5, np.inf, 0.0, 1.0)
    pull = 1.0 + slope * SLIP + NOISE
    found = fitted(uniform, pull)
    said = [r.text for r in remarks_of(found) if r.title == "Posterior at a bound"]
    if bound is None:
        assert said == []
        return
    assert f"the posterior of b is pressed against {bound:g}" in said[0]
    assert f"least squares give b = {np.polyfit(SLIP, pull, 1)[0]:.3g}" in said[0].replace(
        "\u2212", "-"
    )
    assert parameter_remarks(found, ())["b"] == f"pressed against its bound {bound:g}"


def test_a_half_normal_prior_may_be_heaped_up_at_zero() -> None:
    """Zero is then what the prior itself holds for most probable."""
    half = Prior("b", "1", "a test", "nobody", "half-normal", False, 0.0, 1.0, 0.0)
    found = fitted(half, 1.0 + NOISE)
    assert not [r for r in remarks_of(found) if r.title == "Posterior at a bound"]


def with_column(problem: Problem, header: str, values: object) -> Problem:
    table = problem.table
    columns = {**table.columns, header: values}
    return problem.with_table(table_from_arrays(columns, source="my.csv"))


def told(header: str, values: np.ndarray, effect: np.ndarray, seed: int = 5) -> list[str]:
    pull = 1.0 + 2.0 * SLIP + effect + 0.1 * np.random.default_rng(seed).standard_normal(40)
    problem = with_column(line_problem(SLIP, pull), header, values)
    found = failed(residual_checks(problem, fitted_line(SLIP, pull)))
    return [r.text for r in found if r.title == "A column explains the residuals"]


BIN = np.tile(["A", "B"], 20)
DAY = np.tile([1.0, 2.0, 3.0, 4.0], 10)
ORDER = np.random.default_rng(8).permutation(40) + 1.0
HEAT = np.random.default_rng(6).random(40)


@pytest.mark.parametrize(("header", "values", "effect", "where"), [
    ("soil bin", BIN, 0.2 * (BIN == "A"), "where it is A (20 rows)"),
    ("day", DAY, 0.4 * (DAY == 3.0), "where it is 3 (10 rows)"),
    ("heat", HEAT, HEAT, "where it is 0."),
    ("run_order", ORDER, 0.02 * ORDER, 'correlated_along = "run_order"'),
    ("day", DAY, 0.4 * (DAY == 3.0), "fit each of its values by itself"),
    ("heat", HEAT, 8.0 * (HEAT - 0.5) ** 2, "where it is 0."),
    ("cone_index_kpa", 400.0 + 200.0 * HEAT, HEAT, "a column that is not used"),
])  # fmt: skip
def test_a_column_that_explains_the_residuals_is_named(
    header: str, values: np.ndarray, effect: np.ndarray, where: str
) -> None:
    """A category, a number of few values, a trend, a bow, and a quantity that is known."""
    (said,) = told(header, values, effect)
    assert f"differ with {header!r}" in said
    assert where in said


@pytest.mark.parametrize(("header", "values"), [
    ("remark", np.array([f"row {i}" for i in range(40)])),
    ("site", np.full(40, "north")),
    ("rut_depth_mm", 10.0 + 10.0 * HEAT),
])  # fmt: skip
def test_remarks_constants_and_other_outputs_explain_nothing(
    header: str, values: np.ndarray
) -> None:
    assert told(header, values, HEAT) == []


def test_columns_that_mean_nothing_alarm_no_more_often_than_is_said() -> None:
    rng, alarms, trials = np.random.default_rng(7), 0, 300
    for _ in range(trials):
        pull = 1.0 + 2.0 * SLIP + 0.1 * rng.standard_normal(40)
        problem = line_problem(SLIP, pull)
        extra = {"bin": rng.choice(["A", "B", "C"], 40), "heat": rng.random(40)}
        table = table_from_arrays({**problem.table.columns, **extra}, source="my.csv")
        alarms += bool(failed(residual_checks(problem.with_table(table), fitted_line(SLIP, pull))))
    assert stats.binom.sf(alarms - 1, trials, LEVEL) > 1e-3


def test_part_of_a_table_keeps_its_other_columns() -> None:
    table = with_column(line_problem(SLIP, SLIP), "soil bin", BIN).table
    assert table.extra == {"soil bin": tuple(BIN)}
    assert table.take(BIN == "B").extra == {"soil bin": ("B",) * 20}
    assert replace(table, extra={}).ignored == ("soil bin",)


def test_a_wide_gap_in_a_condition_is_outside_the_calibrated_range() -> None:
    slip = np.tile([*np.linspace(0.01, 0.04, 4), *np.linspace(0.45, 0.6, 4)], 2)
    noise = 0.01 * np.random.default_rng(8).standard_normal(16)
    priors = [normal("a", 0.0, 10.0), normal("b", 0.0, 10.0), normal("sigma", -5.0, 2.0, log=True)]
    problem = problem_of(lambda a, b, s: a + b * s, priors, slip, 1.0 + slip + noise)
    found = calibrate(problem, 1)
    trust = verdict(found, leave_one_out(found, refit=False)).trust
    assert trust.startswith("median and bands for slip 1 to 4 % and 45 to 60 %")
    asked = table_from_arrays({"slip_ratio": [0.02, 0.1, 0.44, 0.5, 0.7]})
    assert predict(found, asked).outside == ((), ("slip_ratio",), ("slip_ratio",), (),
                                             ("slip_ratio",))  # fmt: skip


def test_scatter_concerns_the_rows_nearest_to_where_it_differs() -> None:
    """Of three levels of slip the last scatters most, the first least: the middle is as assumed."""
    slip = np.repeat([0.1, 0.2, 0.5], 15)
    noise = np.random.default_rng(9).standard_normal(45) * np.repeat([0.02, 0.1, 0.5], 15)
    problem = line_problem(slip, 1.0 + slip + noise)
    found = failed(residual_checks(problem, fitted_line(slip, 1.0 + slip + noise)))
    (uneven,) = (r for r in found if r.title == "Scatter is uneven")
    concerned = {
        at: uneven.concerns({"slip_ratio": np.array([at])}) for at in (0.0, 0.1, 0.2, 0.3, 0.4, 0.9)
    }
    assert concerned == {0.0: True, 0.1: True, 0.2: False, 0.3: False, 0.4: True, 0.9: True}
