"""Calibrations of the embedded data: summaries of the draws, and what they are seeded by."""

from __future__ import annotations

import numpy as np
import pytest

from calib.data import Table
from calib.inference.calibration import Calibration, calibrate
from calib.inference.diagnostics import ess
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


def test_it_is_the_seed_and_the_label_that_count(rut_tables: tuple[Table, Table]) -> None:
    quick = SamplerSettings(walkers=32, steps=50, max_steps=50, keep=1600)
    problem = build_problem("modified_bekker", rut_tables[0])
    one, again, other = (
        calibrate(problem, 1, label=label, settings=quick) for label in ("", "rut_depth_mm", "x")
    )
    assert one.label == "rut_depth_mm"
    np.testing.assert_array_equal(one.draws.t, again.draws.t)
    assert not (one.draws.t == other.draws.t).any()
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
