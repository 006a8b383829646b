"""Calibrations of the embedded data: summaries of the draws, and what they are seeded by."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from calib.data import Table
from calib.inference.calibration import Calibration, calibrate
from calib.inference.diagnostics import ess
from calib.inference.estimators import estimate
from calib.inference.problem import build_problem
from calib.inference.sampler import SamplerSettings

CALIBRATIONS = pytest.mark.parametrize(
    "name", ["rut_calibration", "pull_calibration", "density_calibration"]
)


@pytest.fixture
def calibration(name: str, request: pytest.FixtureRequest) -> Calibration:
    found: Calibration = request.getfixturevalue(name)
    return found


@CALIBRATIONS
def test_the_embedded_data_converge_in_every_parameter_that_is_shown(
    calibration: Calibration,
) -> None:
    assert calibration.converged
    assert calibration.draws.t.shape[0] >= 4
    model = calibration.problem.bound.model
    assert set(calibration.summary) == {*model.parameters, *model.reported, "sigma"}
    for s in calibration.summary.values():
        assert s.rhat <= 1.01, s
        assert min(s.ess_bulk, s.ess_tail) >= 400, s


@CALIBRATIONS
def test_summaries_are_those_of_the_draws(calibration: Calibration) -> None:
    for name, s in calibration.summary.items():
        draws = calibration.parameters[name].ravel()
        assert s.mean == pytest.approx(draws.mean())
        assert s.sd == pytest.approx(draws.std(ddof=1))
        assert s.median == pytest.approx(np.median(draws))
        within = (draws >= s.hdi_lower) & (draws <= s.hdi_upper)
        assert within.mean() == pytest.approx(0.95, abs=2.0 / draws.size + 1e-3)
        # No central interval of that probability is shorter than the highest-density one.
        low, high = np.quantile(draws, [0.025, 0.975])
        assert s.hdi_upper - s.hdi_lower <= (high - low) * (1.0 + 1e-6)
        size = float(ess(calibration.parameters[name][..., None], "mean")[0])
        assert s.mcse_mean == pytest.approx(s.sd / np.sqrt(size))


@CALIBRATIONS
def test_published_parameters_follow_from_the_sampled(calibration: Calibration) -> None:
    bound = calibration.problem.bound
    natural = calibration.natural[3, 7, :-1]
    reported = {name: float(v[3, 7]) for name, v in calibration.reported.items()}
    np.testing.assert_allclose(bound.theta(reported), natural, rtol=1e-6, atol=1e-9)


def test_what_the_data_do_not_say_is_set_by_the_prior(pull_calibration: Calibration) -> None:
    """Two pressures cannot determine a curvature, but they do determine the ends."""
    ratio = {name: s.sd_ratio for name, s in pull_calibration.summary.items()}
    for name in ("D_bend", "K_bend"):
        assert 0.8 < ratio[name] < 1.1
    for name in ("D_lo", "D_hi", "K_lo", "K_hi", "sigma"):
        assert ratio[name] < 0.3
    assert np.isnan(ratio["c1"])
    # The bends keep their prior distribution: normal(0.05, 0.15) for D.
    draws = pull_calibration.parameters["D_bend"]
    size = pull_calibration.summary["D_bend"].ess_bulk
    assert abs(draws.mean() - 0.05) < 0.03
    assert abs(draws.std() - 0.15) < 0.15 * 5.0 / np.sqrt(2.0 * size) + 0.02


def test_rut_depth_against_a_flat_prior_regression(rut_tables: tuple[Table, Table]) -> None:
    """With n1 = 0, ln z is linear in ln p: the posterior of (ln z_ref, 1/n) is nearly that of
    ordinary least squares where the priors are wide; its Student-t errors are known."""
    rng = np.random.default_rng(4)
    pressure = np.tile(np.geomspace(60.0, 240.0, 20), 3)
    ln_rut = np.log(22.0) + np.log(pressure / 120.0) / 1.1 + 0.05 * rng.standard_normal(60)
    from calib.data import table_from_arrays

    table = table_from_arrays(
        {"average_ground_pressure_kpa": pressure, "rut_depth_mm": np.exp(ln_rut)}
    )
    found = calibrate(build_problem("bekker", table), 5)
    assert found.converged
    x = np.log(pressure) - np.log(pressure).mean()
    line = stats.linregress(x, ln_rut)
    ln_z_ref = np.log(found.parameters["z_ref"])
    slope = 1.0 / found.parameters["n"]
    # The priors (sd 1 on ln z_ref, 0.5 on ln n) against data of sd 0.0065 and 0.015: they move
    # the means by less than 1e-3 of a posterior sd at most; five Monte Carlo errors of ~10^4 draws.
    assert abs(ln_z_ref.mean() - ln_rut.mean()) < 0.1 * line.intercept_stderr
    assert abs(slope.mean() - line.slope) < 0.1 * line.stderr
    # t of 58 dof over normal: sd is larger by 1.018; the noise prior narrows or widens by little.
    assert ln_z_ref.std() / (ln_rut - ln_rut.mean() - line.slope * x).std(ddof=2) == pytest.approx(
        60**-0.5, rel=0.05
    )
    assert slope.std() / line.stderr == pytest.approx(1.0, rel=0.05)


def test_it_is_the_seed_and_the_label_that_count(rut_tables: tuple[Table, Table]) -> None:
    quick = SamplerSettings(walkers=32, steps=50, max_steps=50, keep=1600)
    problem = build_problem("modified_bekker", rut_tables[0])
    one, again, other_seed, other_label = (
        calibrate(problem, seed, label=label, settings=quick)
        for seed, label in ((1, ""), (1, "rut_depth_mm"), (2, ""), (1, "x"))
    )
    assert one.label == "rut_depth_mm"
    np.testing.assert_array_equal(one.draws.t, again.draws.t)
    assert not (one.draws.t == other_seed.draws.t).any()
    assert not (one.draws.t == other_label.draws.t).any()
    assert not one.converged


def test_estimates_lead_to_the_same_posterior(
    rut_tables: tuple[Table, Table], rut_calibration: Calibration
) -> None:
    blind = calibrate(build_problem("modified_bekker", rut_tables[0]), 8)
    assert len(rut_calibration.estimates) == 1
    assert blind.estimates == ()
    for name, s in rut_calibration.summary.items():
        t = blind.summary[name]
        # Both means and sds carry Monte Carlo error; k is skewed, so its sd more than a normal's.
        assert abs(s.mean - t.mean) < 5.0 * np.hypot(s.mcse_mean, t.mcse_mean)


def test_held_parameters_do_not_vary(pull_tables: tuple[Table, Table]) -> None:
    table = pull_tables[0].take(np.isclose(pull_tables[0]["inflation_pressure_psi"], 18.0))
    problem = build_problem("magic_formula", table, fixed={"Sh": 0.0, "Sv": 0.0})
    point = estimate(problem, "least_squares", np.random.default_rng(1))
    found = calibrate(problem, 3, estimates=(point,))
    assert found.converged
    assert set(found.parameters) == {"K", "C", "D", "G", "B", "E", "sigma"}
    assert found.natural.shape[-1] == 7
    assert np.all(found.natural[..., 4:6] == 0.0)
