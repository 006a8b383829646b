"""Tests to run next after a diagnosis."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.data import as_table
from calib.errors import CalibError
from calib.gap.campaigns import campaigns
from calib.gap.corrected import Corrected, predict_columns
from calib.gap.effects import EFFECTS
from calib.gap.fit import Fit
from calib.gap.forward import Forward
from calib.gap.hypotheses import Hypothesis, singles
from calib.gap.identifiability import next_measurements
from calib.gap.mixture import Mixture
from calib.gap.noise import Noise
from calib.gap.plan import plan_tests
from tests.gap.cases import NOISE, make_case

SIGMA = {o: NOISE[o] for o in ("drawbar_pull", "rut_depth")}
# What the laboratory had, but in the third row, where the wheel is quick.
GRID = {
    "slip_percent": [10.0, 30.0, 30.0, 50.0], "inflation_pressure_psi": [30.0] * 4,
    "average_ground_pressure_kpa": [164.3] * 4, "normal_load_kn": [5.0] * 4,
    "speed_m_s": [0.3, 0.3, 2.0, 0.3], "pass_number": [1.0] * 4,
}  # fmt: skip


@pytest.fixture(scope="module")
def two() -> Corrected:
    """Two explanations that differ where speed does: none, and an effect of speed."""
    data = campaigns(make_case(n_lab=12, n_field=9))
    fits = []
    for h in (Hypothesis("none"), *singles(data, {"rate_effect": EFFECTS["rate_effect"]})):
        forward = Forward(data, h, SIGMA)
        psi = np.array([p.loc for p in forward.priors.free])
        rng = np.random.default_rng(1)
        draws = psi + 0.01 * rng.standard_normal((400, psi.size))
        if h.name != "none":
            draws[:, forward.phi_slices[0]] += 0.012
        fits.append(Fit(forward, {o: Noise(s) for o, s in SIGMA.items()}, 0.0, {}, draws))
    mixed = Mixture(data, tuple(fits), (0.6, 0.4), 1)
    return Corrected(mixed, {o.name: np.zeros(len(o.priors.free)) for o in data.outputs})


@pytest.mark.parametrize("aim", ["causes", "bands"])
def test_causes_that_differ_at_one_condition_are_tested_there(two: Corrected, aim: str) -> None:
    found = plan_tests(two, GRID, 1, aim=aim)
    assert found.table["speed_m_s"].tolist() == [2.0]
    assert found.names == ("none", "rate_effect")
    assert found.outputs == ("drawbar_pull_kn", "rut_depth_mm")
    assert found.forecast["causes"][0] == pytest.approx(1.0 - 0.6**2 - 0.4**2)
    for name in ("causes", "bands"):
        value, error = found.simulated[name]
        # Of 256 truths that the forecast averages over, the error is as large.
        assert abs(value - found.forecast[name][-1]) < 6.0 * error


def test_the_measurement_that_a_diagnosis_proposes_is_as_good_as_any(two: Corrected) -> None:
    fits = {fit.forward.hypothesis.name: fit for fit in two.mixture.fits}
    (proposed,) = next_measurements(two.data, fits, seed=1)
    both = {name: [*values] for name, values in GRID.items()}
    for header, column, factor in (("slip_percent", "slip_ratio", 100.0),) + tuple(
        (name, name, 1.0) for name in [*GRID][1:]
    ):
        both[header].append(proposed.conditions[column] * factor)
    found = plan_tests(two, both, 1, aim="causes")
    assert found.table["speed_m_s"][0] == pytest.approx(proposed.conditions["speed_m_s"])


def test_of_one_explanation_no_causes_are_separated(two: Corrected) -> None:
    alone = replace(two.mixture, fits=two.mixture.fits[:1], probability=(1.0,))
    with pytest.raises(CalibError, match="causes are as good as certain"):
        plan_tests(Corrected(alone, two.lab_mode), GRID, 1, aim="causes")
    with pytest.raises(CalibError, match="needs inflation_pressure_psi"):
        plan_tests(two, {n: v for n, v in GRID.items() if n != "inflation_pressure_psi"}, 1)
    many = {n: np.resize(v, 51) for n, v in GRID.items()}
    with pytest.raises(CalibError, match="51 conditions"):
        plan_tests(two, many, 1, exceeds={"rut_depth_mm": 25.0})


def test_a_limit_that_only_one_explanation_keeps_is_decided_where_they_differ(
    two: Corrected,
) -> None:
    at = {name: values[2:3] for name, values in GRID.items()}
    (level,) = predict_columns(two, as_table(at))["rut_depth_mm_after"]
    decided = plan_tests(two, GRID, 1, at, exceeds={"rut_depth_cm": 0.1 * level})
    assert decided.table["speed_m_s"].tolist() == [2.0]
    now, then = decided.forecast["decision"]
    assert then < 0.8 * now
    value, error = decided.simulated["decision"]
    assert abs(value - then) < 6.0 * error
