"""What a calibration assumes of its rows: tests with a stated chance of a false alarm."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from calib.data import Table, read_for_model, table_from_arrays
from calib.inference.calibration import calibrate
from calib.inference.likelihood import Noise, NoiseChoice
from calib.inference.mode import find_mode
from calib.inference.priors import Priors
from calib.inference.problem import Problem, build_problem
from calib.inference.sampler import SamplerSettings
from calib.models import MODELS, example_csv
from calib.validation.assumptions import _cut_off, checks_of, file_remarks, remarks_of
from calib.validation.residuals import (
    LEVEL,
    Check,
    Remark,
    durbin_watson_moments,
    failed,
    linear,
    residual_checks,
)
from tests.custom_problems import normal, problem_of
from tests.validation.test_outliers import fitted_line, line_problem

SLIP = np.linspace(0.02, 0.6, 40)


def along_a_run(rng: np.random.Generator, n: int, rho: float) -> np.ndarray:
    e = rng.standard_normal(n)
    for i in range(1, n):
        e[i] = rho * e[i - 1] + np.sqrt(1.0 - rho**2) * e[i]
    return e


def notes(problem: Problem, t: np.ndarray) -> str:
    return " | ".join(remark.text for remark in failed(residual_checks(problem, t)))


def said(slip: np.ndarray, pull: np.ndarray) -> str:
    return notes(line_problem(slip, pull), fitted_line(slip, pull))


@pytest.mark.parametrize("n", [12, 40])
def test_independent_normal_rows_are_left_alone(n: int) -> None:
    """All tests together, no more often than the level says."""
    rng, count, trials = np.random.default_rng(11), 0, 400
    for _ in range(trials):
        slip = rng.random(n)
        count += bool(said(slip, slip + rng.standard_normal(n)))
    assert stats.binom.sf(count - 1, trials, LEVEL) > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("n", [15, 40])
def test_the_tests_alarm_as_often_as_they_say(n: int) -> None:
    """Not much less often either: Holm's bound is nearly reached by tests that are independent."""
    rng, count, trials = np.random.default_rng(12), 0, 10_000
    for _ in range(trials):
        slip = rng.random(n)
        count += bool(said(slip, slip + rng.standard_normal(n)))
    assert stats.binom.sf(count - 1, trials, LEVEL) > 1e-3
    assert stats.binom.cdf(count, trials, 0.5 * LEVEL) > 1e-3


def test_holms_procedure_is_that_of_its_table() -> None:
    """Holm (1979): the i-th smallest of m against level/(m - i), and none beyond the first kept."""
    tests = [Check(p, Remark(str(p))) for p in (0.01, 0.04, 0.03, 0.005)]
    # 0.005 < 0.05/4 and 0.01 < 0.05/3, but 0.03 is not below 0.05/2, so 0.04 stays as well.
    assert [remark.text for remark in failed(tests, 0.05)] == ["0.01", "0.005"]
    assert failed([Check(float("nan"), Remark("x"))]) == ()


def test_durbin_and_watsons_moments_are_exact() -> None:
    """Mean and variance of the statistic, in matrices as they print them and by simulation."""
    rng = np.random.default_rng(4)
    n, k = 15, 2
    x = np.column_stack([np.ones(n), rng.random(n)])
    m = np.eye(n) - x @ np.linalg.solve(x.T @ x, x.T)
    a = 2.0 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
    a[0, 0] = a[-1, -1] = 1.0
    q, _ = np.linalg.qr(x)
    e = rng.standard_normal((200_000, n)) @ m
    d = np.square(np.diff(e, axis=1)).sum(axis=1) / np.square(e).sum(axis=1)
    mean, variance = durbin_watson_moments(q)
    p, both = np.trace(m @ a), np.trace(m @ a @ m @ a)
    assert mean == pytest.approx(p / (n - k))
    assert variance == pytest.approx(2.0 * (both - p * mean) / ((n - k) * (n - k + 2.0)))
    assert mean == pytest.approx(d.mean(), abs=5.0 * d.std() / np.sqrt(d.size))
    assert variance == pytest.approx(d.var(), rel=0.02)
    # The beta distribution in the tail that is looked at.
    at = mean / 4.0
    size = at * (1.0 - at) / (variance / 16.0) - 1.0
    edge = 4.0 * stats.beta.ppf(0.001, at * size, (1.0 - at) * size)
    assert np.mean(d < edge) == pytest.approx(0.001, abs=0.0005)


def test_rows_of_one_run_are_noticed_and_their_worth_is_said() -> None:
    rng = np.random.default_rng(5)
    slip = np.linspace(0.0, 0.6, 80)
    found = said(slip, slip + 0.1 * along_a_run(rng, 80, 0.8))
    assert "neighbouring rows are alike" in found
    worth = int(found.split("worth about ")[1].split(" ")[0])
    assert 3 <= worth <= 25  # 80 (1 - 0.8)/(1 + 0.8) = 9
    # The same rows in any order are as independent as can be told.
    order = rng.permutation(80)
    mixed = slip + 0.1 * along_a_run(np.random.default_rng(5), 80, 0.8)
    assert "alike" not in said(slip[order], mixed[order])


@pytest.mark.parametrize(("slope", "word"), [(2.0, "grows"), (-2.0, "falls")])
def test_noise_that_depends_on_a_condition_is_noticed_and_the_remedy_works(
    slope: float, word: str
) -> None:
    rng = np.random.default_rng(6)
    z = (SLIP - SLIP.mean()) / SLIP.std()
    pull = 1.0 + SLIP + 0.05 * np.exp(0.5 * slope * z) * rng.standard_normal(40)
    problem = line_problem(SLIP, pull)
    # Of noise so uneven the tails are heavy, too.
    t = fitted_line(SLIP, pull)
    (note,) = (n for n in notes(problem, t).split(" | ") if "scatter" in n)
    assert f"scatter {word} with slip" in note
    assert 'noise_depends_on = "slip"' in note
    # With that noise there is nothing to warn of.
    noise = Noise(NoiseChoice("normal", "slip"), "slip_ratio", SLIP.mean(), SLIP.std())
    entries = problem.priors.entries
    priors = Priors((*entries[:-1], normal("sigma_slope", 0.0, 0.5), entries[-1]))
    mended = replace(problem, noise=noise, priors=priors)
    b, a = np.polyfit(SLIP, pull, 1, w=np.exp(-0.5 * slope * z))
    t = np.array([a, b, 0.5 * slope, np.log(0.05)])
    assert notes(mended, t) == ""


def test_heavy_tails_are_noticed_and_the_remedy_works() -> None:
    rng = np.random.default_rng(7)
    slip = rng.random(60)
    noise = stats.t(1.5).rvs(60, random_state=rng)
    pull = 1.0 + slip + 0.05 * noise
    problem = line_problem(slip, pull)
    found = notes(problem, fitted_line(slip, pull))
    assert "heavier tails" in found
    assert 'family = "student_t"' in found
    entries = problem.priors.entries
    priors = Priors((*entries[:-1], normal("nu", 0.0, 1.0, log=True), entries[-1]))
    mended = replace(problem, noise=Noise(NoiseChoice("student_t")), priors=priors)
    t = np.array([1.0, 1.0, np.log(1.5), np.log(0.05)])
    assert "tails" not in notes(mended, t)


def test_too_few_rows_are_not_judged() -> None:
    assert said(np.linspace(0, 1, 8), np.array([0.0, 1, 0, 1, 0, 1, 0, 1])) == ""


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


def test_good_rows_have_no_notes() -> None:
    assert notes_of(rut()) == ""


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
    names = {"run_ordr": np.arange(12), "operator": np.ones(12), "rut_depth_mm_sd": np.ones(12)}
    assert notes_of(rut(**names)) == (
        "my ruts.csv: a column is not used: 'run_ordr': did you mean run_order?"
    )


def test_residuals_are_not_judged_while_a_column_looks_to_be_in_another_unit() -> None:
    # More than half of the pulls could be kN.
    slip = np.concatenate([np.linspace(1e-4, 5e-3, 18), np.linspace(0.02, 0.5, 12)])
    pull = 160.0 * np.sin(20.0 * slip)
    table = table_from_arrays(
        {"slip_ratio": slip, "drawbar_pull_kn": pull, "normal_load_kn": np.full(30, 20.0)},
        source="n.csv",
    )
    problem = build_problem("magic_formula", table)
    t = find_mode(problem.log_prob, problem.priors)
    assert "neighbouring rows are alike" in notes(problem, t)
    calibration = calibrate(problem, 1, settings=SamplerSettings(max_steps=100))
    assert not any("neighbouring" in test.remark.text for test in checks_of(calibration))
    unit, withheld = (remark.text for remark in remarks_of(calibration))
    assert "the largest drawbar pull is 159.8 kN" in unit
    assert "is not judged while a column looks to be in another unit" in withheld


@pytest.mark.parametrize(
    ("edge", "sd", "told"), [(1.0, 10.0, True), (4.0, 10.0, False), (1.0, 0.1, False)]
)
def test_a_posterior_that_is_cut_off_by_its_model_is_said(
    edge: float, sd: float, told: bool
) -> None:
    """A slope of 2 +- 0.1, by the data or the prior, and no value beyond an edge so far above."""
    rng, slip = np.random.default_rng(2), np.linspace(0.0, 1.0, 40)
    beyond = 2.0 + 0.1 * edge
    priors = [normal("a", 0.0, 1.0), normal("b", 2.0, sd), normal("sigma", 0.0, 0.1, log=True)]
    problem = problem_of(
        lambda a, b, s: np.where(b > beyond, np.nan, a + b * s), priors, slip, 1.0 + 2.0 * slip
    )
    t = np.array([1.0, 2.0, 0.0]) + 0.1 * rng.standard_normal((4000, 3))
    found = " | ".join(remark.text for remark in _cut_off(problem, t[t[:, 1] <= beyond]))
    assert ("ends where the model has no value, at large b" in found) is told


def test_copies_are_named_by_line() -> None:
    table = rut()
    doubled = table.take(np.append(np.arange(12), [3, 3, 5]))
    found = notes_of(doubled)
    lines = ", ".join(str(table.lines[i]) for i in (3, 3, 5))
    assert f"lines {lines}: these 3 rows repeat another one exactly" in found
    assert "line 5: this row repeats" in notes_of(table.take(np.append(np.arange(12), 5)))


def test_coarse_readings_may_agree() -> None:
    """Forty repeats read to the millimetre, where the scatter is half of one."""
    rng = np.random.default_rng(9)
    pressure = np.repeat([80.0, 120.0], 20)
    depth = np.round(0.2 * pressure * np.exp(0.03 * rng.standard_normal(40)))
    assert notes_of(rut(40, average_ground_pressure_kpa=pressure, rut_depth_mm=depth), 0.03) == ""
    # The same readings to a micrometre would be copies.
    fine = depth + 0.001
    assert "repeat another" in notes_of(
        rut(40, average_ground_pressure_kpa=pressure, rut_depth_mm=fine), 0.03
    )


def test_a_condition_that_does_not_vary_is_named() -> None:
    same = {"average_ground_pressure_kpa": np.full(12, 100.0), "Slip [%]": np.arange(12.0)}
    table = rut()
    columns = {"rut_depth_mm": table["rut_depth_mm"], **same}
    found = notes_of(table_from_arrays(columns, source="r.csv"), model="modified_bekker")
    assert "average ground pressure is the same in all rows" in found
    # Named as the file has it.
    columns |= {"Slip [%]": np.full(12, 5.0), "average_ground_pressure_kpa": np.arange(60.0, 72.0)}
    found = notes_of(table_from_arrays(columns, source="r.csv"), model="modified_bekker")
    assert "slip ('Slip [%]') is the same in all rows" in found


def test_psi_among_kpa_is_noticed() -> None:
    pressure = np.tile([124.0, 207.0, 290.0], 4)
    pressure[7] = 30.0  # psi, which are 206.8 kPa
    found = notes_of(rut(average_ground_pressure_kpa=pressure))
    assert "line 7: average ground pressure is 6.895 times smaller" in found
    assert "psi" in found


def test_psi_typed_as_kpa_are_unusual_for_a_tyre() -> None:
    slip = np.tile(np.linspace(0.0, 0.5, 11), 2)
    kpa = np.repeat([18.0, 30.0], 11)
    table = table_from_arrays(
        {"slip_ratio": slip, "inflation_pressure_psi": kpa / 6.894757, "drawbar_pull_kn": slip},
        source="pull.csv",
    )
    found = notes_of(table, 0.1, "magic_formula_pressure")
    assert "inflation pressure is outside 6 to 150 psi" in found
    assert "and 17 more" in found


def test_a_linear_models_residuals_are_those_of_least_squares() -> None:
    rng = np.random.default_rng(1)
    pull = SLIP + rng.standard_normal(40)
    residual, design, rank = linear(
        line_problem(SLIP, pull), fitted_line(SLIP, pull), np.ones(40, dtype=bool)
    )
    assert rank == 2
    np.testing.assert_allclose(design.T @ design, np.eye(2), atol=1e-9)
    np.testing.assert_allclose(design.T @ residual, 0.0, atol=1e-9)


def test_of_uneven_noise_least_squares_are_weighted() -> None:
    rng = np.random.default_rng(2)
    z = (SLIP - SLIP.mean()) / SLIP.std()
    problem = line_problem(SLIP, SLIP + rng.standard_normal(40))
    noise = Noise(NoiseChoice("normal", "slip"), "slip_ratio", SLIP.mean(), SLIP.std())
    entries = problem.priors.entries
    priors = Priors((*entries[:-1], normal("sigma_slope", 0.0, 0.5), entries[-1]))
    t = np.array([0.1, 0.9, 0.7, -1.0])
    residual, design, _ = linear(
        replace(problem, noise=noise, priors=priors), t, np.ones(40, dtype=bool)
    )
    plain = problem.response - 0.1 - 0.9 * SLIP
    np.testing.assert_allclose(residual, plain / np.exp(0.7 * z), rtol=1e-9)
    weighted = np.column_stack([np.ones(40), SLIP]) / np.exp(0.7 * z)[:, None]
    np.testing.assert_allclose(design @ design.T, weighted @ np.linalg.pinv(weighted), atol=1e-6)
