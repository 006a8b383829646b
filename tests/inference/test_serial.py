"""Noise that is correlated along a run, against the dense covariance of all rows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from calib.data import Table, table_from_arrays
from calib.errors import CalibError
from calib.gap.campaigns import campaigns
from calib.gap.case import case_from_run
from calib.inference.calibration import calibrate
from calib.inference.estimators import estimate
from calib.inference.io import load_calibration, save_calibration
from calib.inference.likelihood import serial_of
from calib.inference.problem import Problem, build_problem
from calib.inference.sampler import SamplerSettings
from calib.validation.comparison import noise_words
from calib.validation.replicate import design_of, simulate
from tests.conftest import SEED
from tests.inference.test_noise import WORDS, drawn, prior_text

ALONG = '[likelihood]\ncorrelated_along = "run_order"\n'
# Two runs out of order, with rows missing.
ORDER = np.array([3.0, 1.0, 2.0, 6.0, 1.0, 4.0, 2.0])
RUN = np.array([0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0])


def table(**columns: np.ndarray) -> Table:
    slip = np.linspace(0.05, 0.5, ORDER.size)
    return table_from_arrays(
        {"slip_ratio": slip, "average_ground_pressure_kpa": np.full(ORDER.size, 120.0),
         "rut_depth_mm": 20.0 * np.exp(slip), **columns}, source="ruts.csv",
    )  # fmt: skip


def problem_along(folder: Path, rows: Table, more: str = "") -> Problem:
    path = folder / "priors.toml"
    text = ALONG + more
    path.write_text(prior_text("modified_bekker", text), encoding="utf-8")
    return build_problem("modified_bekker", rows, path)


def covariance(rho: float, run: np.ndarray, place: np.ndarray) -> np.ndarray:
    same = run[:, None] == run[None, :]
    return np.where(same, rho ** np.abs(place[:, None] - place[None, :]), 0.0)


@pytest.mark.parametrize("more", ["", 'noise_depends_on = "slip"\n'])
def test_densities_are_those_of_the_covariance(tmp_path: Path, more: str) -> None:
    problem = problem_along(tmp_path, table(run=RUN, run_order=ORDER), more)
    t = drawn(problem, 20)
    natural = problem.theta(t)
    assert [p.name for p in problem.priors.entries][-2:] == ["rho", "sigma"]
    whole, left_out = problem.log_likelihood(t), problem.log_likelihood_left_out(t)
    scale = problem.noise.scale(natural, problem.conditions) * np.ones((len(t), 7))
    for k, residual in enumerate(problem.residuals(natural)):
        dense = np.outer(scale[k], scale[k]) * covariance(natural[k, -2], RUN, ORDER)
        jacobian = -np.log(problem.observed)
        joint = stats.multivariate_normal(np.zeros(7), dense)
        assert whole[k] == pytest.approx(joint.logpdf(residual) + jacobian.sum(), rel=1e-8)
        for i in range(7):
            rest = np.arange(7) != i
            others = stats.multivariate_normal(np.zeros(6), dense[np.ix_(rest, rest)])
            given = joint.logpdf(residual) - others.logpdf(residual[rest]) + jacobian[i]
            assert left_out[k, i] == pytest.approx(given, rel=1e-6, abs=1e-6)


def test_noise_is_drawn_with_the_covariance() -> None:
    serial = serial_of("run_order", table(run=RUN, run_order=ORDER))
    assert serial is not None
    k = 40_000
    z = np.random.default_rng(1).standard_normal((k, 7))
    found = serial.correlate(z, np.full((k, 1), 0.8))
    # A correlation of so many draws has an sd of 0.005 at most.
    np.testing.assert_allclose(np.cov(found.T), covariance(0.8, RUN, ORDER), atol=0.035)


def test_a_simulated_campaign_is_correlated(tmp_path: Path) -> None:
    fixed = f'[parameters.rho]\ndist = "fixed"\nvalue = 0.98\n{WORDS}'
    design = design_of("modified_bekker")
    problem = problem_along(tmp_path, design.table, fixed)
    rng = np.random.default_rng(SEED)
    alike = []
    for _ in range(10):
        made = simulate(problem, design, rng)
        natural = made.problem.theta(made.truth[None])
        z = made.problem.residuals(natural)[0] / natural[0, -1]
        alike.append(np.square(np.diff(z)).mean())
    # 2 (1 - rho) of neighbours, and 2 were they independent.
    assert np.mean(alike) < 0.1


def test_it_is_kept_and_named_and_refused_where_it_is_not_known(tmp_path: Path) -> None:
    rows = design_of("modified_bekker").table
    problem = problem_along(tmp_path, rows)
    assert noise_words(problem.noise) == "normal noise that is correlated along run_order"
    point = estimate(problem, "least_squares", np.random.default_rng(SEED))
    quick = SamplerSettings(walkers=32, steps=50, max_steps=50, keep=1600)
    found = calibrate(problem, SEED, estimates=(point,), settings=quick)
    (tmp_path / "run").mkdir()
    save_calibration(found, tmp_path / "run")
    again = load_calibration(tmp_path / "run").problem
    t = found.draws.flat[:5]
    np.testing.assert_allclose(again.log_likelihood(t), problem.log_likelihood(t), rtol=1e-9)
    field = tmp_path / "field.csv"
    readings = "".join(f"0.{i},1{i}0,2{i}\n" for i in range(1, 8))
    field.write_text(f"slip_ratio,average_ground_pressure_kpa,rut_depth_mm\n{readings}")
    case = case_from_run(tmp_path / "run", field)
    with pytest.raises(CalibError, match="correlated along run_order, and the data have no"):
        campaigns(case)


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({}, "correlated along run_order, and the data have no"),
        ({"run_order": np.array([1.0, 2.0, 2.0, 4.0, 5.0, 6.0, 7.0])}, "not say in which order"),
        ({"run_order": np.array([1.0, 1.5, 2.0, 4.0, 5.0, 6.0, 7.0])}, "not say in which order"),
    ],
)
def test_an_order_that_is_none_is_refused(
    tmp_path: Path, columns: dict[str, np.ndarray], message: str
) -> None:
    with pytest.raises(CalibError, match=message):
        problem_along(tmp_path, table(**columns))


@pytest.mark.parametrize("lower", [-0.5, 1.0])
def test_a_correlation_beyond_bounds_is_refused(tmp_path: Path, lower: float) -> None:
    prior = f'[parameters.rho]\ndist = "uniform"\nlower = {lower}\nupper = 1.5\n{WORDS}'
    with pytest.raises(CalibError, match=r"parameters\.rho"):
        problem_along(tmp_path, table(run_order=np.arange(7.0)), prior)


def test_the_order_is_the_tables_not_the_problems() -> None:
    assert serial_of("", table()) is None
    empty = table_from_arrays(
        {**table().columns, "run_order": np.array([1.0, 2.0, np.nan, 4.0, 5.0, 6.0, 7.0])},
        allow_missing=["run_order"],
    )
    with pytest.raises(CalibError, match="not say in which order"):
        serial_of("run_order", empty)
    # Nor is it right where the row is the only one of its run.
    order, run = np.append(np.arange(1.0, 7.0), np.nan), np.array([1.0] * 6 + [2.0])
    alone = table_from_arrays(
        {**table().columns, "run_order": order, "run": run}, allow_missing=["run_order"]
    )
    with pytest.raises(CalibError, match="not say in which order"):
        serial_of("run_order", alone)
