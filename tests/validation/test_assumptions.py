"""What the data say against the prior, and what is odd in the rows themselves."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from calib.data import Table, read_for_model, table_from_arrays
from calib.inference.calibration import calibrate
from calib.inference.mode import find_mode
from calib.inference.priors import Prior
from calib.inference.problem import build_problem
from calib.inference.sampler import SamplerSettings
from calib.models import MODELS, example_csv
from calib.report.verdict import verdict
from calib.validation.assumptions import (
    checks_of,
    cut_off,
    file_remarks,
    parameter_remarks,
    remarks_of,
)
from calib.validation.constants import LEVEL
from calib.validation.prediction import predict
from calib.validation.residuals import failed
from calib.validation.validate import leave_one_out
from tests.custom_problems import normal, problem_of
from tests.validation.lines import calibrated, line_problem, notes, with_columns

SLIP = np.linspace(0.0, 1.0, 40)
NOISE = 0.1 * np.random.default_rng(3).standard_normal(40)
LINE = 1.0 + 2.0 * SLIP + NOISE


def test_a_prior_that_the_data_contradict_is_named_with_its_numbers() -> None:
    """The slope is 2; its prior has 0 +- 0.05, so that the posterior lies between."""
    found = calibrated(normal("b", 0.0, 0.05), SLIP, LINE)
    (check,) = (c for c in checks_of(found) if "the prior: " in c.remark.text)
    line = np.polyfit(SLIP, LINE, 1)
    assert f"b = {line[0]:.3g}" in check.remark.text
    # The F test of the sums of squares at the mode and of least squares.
    problem = found.problem
    at_mode = np.square(problem.residuals(problem.theta(found.draws.mode[None]))).sum()
    least = np.square(LINE - np.polyval(line, SLIP)).sum()
    p = stats.f.sf((at_mode - least) / 2.0 / (least / 38.0), 2, 38)
    assert check.p == pytest.approx(p, rel=1e-6)
    assert p < 1e-6
    judged = verdict(found)
    assert check.remark in judged.remarks
    assert "by least squares" in parameter_remarks(found, judged.remarks)["b"]


@pytest.mark.parametrize("sd", [0.1, 100.0])
def test_a_prior_that_is_right_is_left_alone(sd: float) -> None:
    found = calibrated(normal("b", 2.05, sd), SLIP, LINE)
    assert "Prior contradicted" not in {r.title for r in failed(checks_of(found))}


@pytest.mark.parametrize(("median", "told"), [(0.01, True), (0.1, False), (1.0, True)])
def test_a_prior_of_the_noise_that_the_data_contradict(median: float, told: bool) -> None:
    """The rows scatter by 0.1 about the line."""
    sigma = normal("sigma", np.log(median), 0.05, log=True)
    found = failed(checks_of(calibrated(normal("b", 0.0, 10.0), SLIP, LINE, sigma)))
    said = [r.text for r in found if r.title == "Prior contradicted"]
    assert bool(said) is told
    if told:
        least = np.square(LINE - np.polyval(np.polyfit(SLIP, LINE, 1), SLIP)).sum()
        assert f"the rows scatter by {np.sqrt(least / 38.0):.3g} where" in said[0]


def test_weak_data_do_not_contradict_a_sharp_prior_that_is_right() -> None:
    """Least squares are many posterior sds off then: the posterior is as narrow as the prior."""
    rng, alarms, told, trials = np.random.default_rng(4), 0, [], 2
    for _ in range(trials):
        pull = 1.0 + 2.0 * SLIP + rng.standard_normal(40)
        found = calibrated(normal("b", 2.0, 0.01), SLIP, pull)
        remarks = failed(checks_of(found))
        alarm = "Prior contradicted" in {r.title for r in remarks}
        alarms += alarm
        told.append(parameter_remarks(found, remarks)["b"])
        assert ("sds off" in told[-1]) is alarm
    assert sum("least squares fit as well with" in said for said in told) >= trials // 2
    assert stats.binom.sf(alarms - 1, trials, LEVEL) > 1e-3


@pytest.mark.parametrize(
    ("slope", "family", "bound"),
    [(-1.0, "uniform", 0.0), (3.0, "uniform", 1.0), (0.5, "uniform", None), (0, "half", None)],
)
def test_a_posterior_pressed_against_a_bound_is_said(
    slope: float, family: str, bound: float | None
) -> None:
    """Zero is what a half-normal prior itself holds for most probable."""
    prior = Prior("b", "1", "a test", "nobody", "uniform", False, 0.5, np.inf, 0.0, 1.0)
    if family == "half":
        prior = Prior("b", "1", "a test", "nobody", "half-normal", False, 0.0, 1.0, 0.0)
    pull = 1.0 + slope * SLIP + NOISE
    found = calibrated(prior, SLIP, pull)
    said = [r.text for r in remarks_of(found) if r.title == "Posterior at a bound"]
    if bound is None:
        assert said == []
        return
    assert f"the posterior of b is pressed against {bound:g}" in said[0]
    line = f"least squares give b = {np.polyfit(SLIP, pull, 1)[0]:.3g}"
    assert line in said[0].replace("\N{MINUS SIGN}", "-")
    assert parameter_remarks(found, ())["b"] == f"pressed against its bound {bound:g}"


@pytest.mark.parametrize(
    ("edge", "sd", "told"), [(1.0, 10.0, True), (4.0, 10.0, False), (1.0, 0.1, False)]
)
def test_a_posterior_that_is_cut_off_by_its_model_is_said(
    edge: float, sd: float, told: bool
) -> None:
    """A slope of 2 +- 0.1, by the data or the prior, and no value beyond an edge so far above."""
    rng, beyond = np.random.default_rng(2), 2.0 + 0.1 * edge
    priors = [normal("a", 0.0, 1.0), normal("b", 2.0, sd), normal("sigma", 0.0, 0.1, log=True)]
    problem = problem_of(
        lambda a, b, s: np.where(b > beyond, np.nan, a + b * s), priors, SLIP, 1.0 + 2.0 * SLIP
    )
    t = np.array([1.0, 2.0, 0.0]) + 0.1 * rng.standard_normal((4000, 3))
    found = " | ".join(remark.text for remark in cut_off(problem, t[t[:, 1] <= beyond]))
    assert ("ends where the model has no value, at large b" in found) is told


def test_a_wide_gap_in_a_condition_is_outside_the_calibrated_range() -> None:
    slip = np.tile([*np.linspace(0.01, 0.04, 4), *np.linspace(0.45, 0.6, 4)], 2)
    pull = 1.0 + slip + 0.01 * np.random.default_rng(8).standard_normal(16)
    sigma = normal("sigma", -5.0, 2.0, log=True)
    found = calibrated(normal("b", 0.0, 10.0), slip, pull, sigma)
    trust = verdict(found, leave_one_out(found, refit=False)).trust
    assert trust.startswith("median and bands for slip 1 to 4 % and 45 to 60 %")
    asked = table_from_arrays({"slip_ratio": [0.02, 0.1, 0.44, 0.5, 0.7]})
    out = ("slip_ratio",)
    assert predict(found, asked).outside == ((), out, out, (), out)


def test_part_of_a_table_keeps_its_other_columns() -> None:
    bins = np.tile(["A", "B"], 20)
    table = with_columns(line_problem(SLIP, SLIP), **{"soil bin": bins}).table
    assert table.extra == {"soil bin": tuple(bins)}
    assert table.take(bins == "B").extra == {"soil bin": ("B",) * 20}


# The rows themselves


def rut(n: int = 12, **columns: np.ndarray) -> Table:
    rng = np.random.default_rng(8)
    pressure = np.linspace(60.0, 200.0, n)
    found = {
        "average_ground_pressure_kpa": pressure,
        "rut_depth_mm": 0.2 * pressure * np.exp(0.05 * rng.standard_normal(n)),
    }
    return table_from_arrays({**found, **columns}, source="my ruts.csv")


def notes_of(table: Table, scatter: float = 0.05, model: str = "bekker") -> str:
    found = file_remarks(build_problem(model, table), scatter)
    return " | ".join(remark.text for remark in found)


@pytest.mark.slow
def test_every_example_is_left_alone(tmp_path: Path) -> None:
    for name, model in MODELS.items():
        path = tmp_path / f"{name}.csv"
        path.write_text(example_csv(name), encoding="utf-8")
        problem = build_problem(name, read_for_model(path, (*model.conditions, model.output)))
        mode = find_mode(problem.log_prob, problem.priors)
        scatter = float(problem.theta(mode[None])[0, -1])
        assert (name, notes(problem, mode), file_remarks(problem, scatter)) == (name, "", ())


def test_a_column_that_may_be_left_out_is_asked_after_when_misspelt() -> None:
    assert notes_of(rut()) == ""
    names = {"run_ordr": np.arange(12), "operator": np.ones(12), "rut_depth_mm_sd": np.ones(12)}
    said = "my ruts.csv: a column is not used: 'run_ordr': did you mean run_order?"
    assert notes_of(rut(**names)) == said


def test_residuals_are_not_judged_while_a_column_looks_to_be_in_another_unit() -> None:
    # More than half of the pulls could be kN.
    slip = np.concatenate([np.linspace(1e-4, 5e-3, 18), np.linspace(0.02, 0.5, 12)])
    columns = {"slip_ratio": slip, "drawbar_pull_kn": 160.0 * np.sin(20.0 * slip)}
    table = table_from_arrays({**columns, "normal_load_kn": np.full(30, 20.0)}, source="n.csv")
    problem = build_problem("magic_formula", table)
    assert "neighbouring rows are alike" in notes(
        problem, find_mode(problem.log_prob, problem.priors)
    )
    calibration = calibrate(problem, 1, settings=SamplerSettings(max_steps=100))
    assert not any("neighbouring" in test.remark.text for test in checks_of(calibration))
    unit, withheld = (remark.text for remark in remarks_of(calibration))
    assert "the largest drawbar pull is 159.8 kN" in unit
    assert "is not judged while a column looks to be in another unit" in withheld


@pytest.mark.parametrize(("mean", "told"), [(2.0, False), (1.9, False), (1.6, True)])
def test_a_posterior_at_the_edge_of_its_prior_is_told(mean: float, told: bool) -> None:
    """The slope is 2; its prior has 95 % within 0.3 of its mean."""
    found = calibrated(normal("b", mean, 0.3 / stats.norm.ppf(0.975)), SLIP, LINE)
    said = " ".join(remark.text for remark in remarks_of(found))
    expected = f"prior {mean - 0.3:.2g} to {mean + 0.3:.2g} (95 % each)"
    assert ("conflict with the prior of b: " in said and expected in said) is told


def test_copies_are_named_by_line() -> None:
    table = rut()
    found = notes_of(table.take(np.append(np.arange(12), [3, 3, 5])))
    assert "lines 3, 3, 5: these 3 rows repeat another one exactly" in found
    assert "line 5: this row repeats" in notes_of(table.take(np.append(np.arange(12), 5)))


def test_coarse_readings_may_agree() -> None:
    """Forty repeats read to the millimetre, where the scatter is half of one."""
    rng = np.random.default_rng(9)
    pressure = np.repeat([80.0, 120.0], 20)
    depth = np.round(0.2 * pressure * np.exp(0.03 * rng.standard_normal(40)))
    at = {"average_ground_pressure_kpa": pressure}
    assert notes_of(rut(40, rut_depth_mm=depth, **at), 0.03) == ""
    # The same readings to a micrometre would be copies.
    assert "repeat another" in notes_of(rut(40, rut_depth_mm=depth + 0.001, **at), 0.03)


def test_conditions_that_do_not_vary_or_are_in_mixed_units_are_named() -> None:
    columns = {"rut_depth_mm": rut()["rut_depth_mm"], "Slip [%]": np.full(12, 5.0)}
    columns["average_ground_pressure_kpa"] = np.arange(60.0, 72.0)
    found = notes_of(table_from_arrays(columns, source="r.csv"), model="modified_bekker")
    assert "slip ('Slip [%]') is the same in all rows" in found
    pressure = np.tile([124.0, 207.0, 290.0], 4)
    pressure[7] = 30.0  # psi, which are 206.8 kPa
    found = notes_of(rut(average_ground_pressure_kpa=pressure))
    assert "line 7: average ground pressure is 6.895 times smaller" in found
    slip, psi = np.tile(np.linspace(0.0, 0.5, 11), 2), np.repeat([18.0, 30.0], 11) / 6.894757
    columns = {"slip_ratio": slip, "inflation_pressure_psi": psi, "drawbar_pull_kn": slip}
    found = notes_of(table_from_arrays(columns, source="p.csv"), 0.1, "magic_formula_pressure")
    assert "inflation pressure is outside 6 to 150 psi" in found
    assert "and 17 more" in found
