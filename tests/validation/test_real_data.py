"""Measured data, which stay outside the repository."""

import json
from pathlib import Path

import numpy as np
import pytest

from calib.data import read_for_model
from calib.gap.batch import case_folders, diagnose_cases
from calib.gap.case import read_case
from calib.gap.diagnose import diagnose
from calib.inference.calibration import calibrate
from calib.inference.problem import build_problem
from calib.models import MODELS
from calib.validation.validate import leave_one_out

SHARED = Path(__file__).resolve().parents[3] / "shared"
here = pytest.mark.skipif(not SHARED.is_dir(), reason="the measured data are not on this machine")


def fitted(path: Path, model: str):
    chosen = MODELS[model]
    table = read_for_model(path, (*chosen.conditions, chosen.output))
    return calibrate(build_problem(model, table), seed=1)


@here
def test_density_from_penetration_resistance_says_little():
    """Resistance and water content alone hardly predict density on these cores."""
    calibration = fitted(SHARED / "data" / "soil_skp1994.csv", "ayers_perumpral")
    assert calibration.converged
    observed = calibration.problem.observed
    scores = leave_one_out(calibration).scores
    # The spread of the densities is 0.084 g/cm^3; a log-linear fit leaves 0.075.
    assert 0.07 < scores.rmse < np.std(observed)
    # Coverage of 64 rows: within the central 99.9 % of a binomial with p = 0.9.
    assert 49 <= scores.coverage[0.9].hits <= 64


@pytest.mark.slow
@here
def test_a_rigid_wheel_in_sand_has_no_peak_that_its_data_determine():
    calibration = fitted(SHARED / "cases" / "real-000" / "lab.csv", "magic_formula")
    assert calibration.converged
    assert calibration.summary["C"].sd_ratio > 0.7
    # Pull at zero slip is negative: the wheel's motion resistance, 5 % of its 25 N.
    problem = calibration.problem
    assert np.median(problem.observed[problem.conditions["slip_ratio"] < 0.01]) < 0.0


@pytest.mark.slow
@here
def test_the_measured_gap_is_found_and_is_in_the_pull():
    found = diagnose(read_case(SHARED / "cases" / "real-000"), 1)
    assert found.verdict != "none"
    assert found.shrink["drawbar_pull"].interval[0] > 0.0


@here
@pytest.mark.slow
def test_every_shared_case_runs_under_the_contract(tmp_path):
    cases = case_folders(SHARED / "cases")
    assert diagnose_cases(cases, tmp_path / "out", 1, workers=2) == {}
    for case in cases:
        document = json.loads((tmp_path / "out" / case.name / "diagnosis.json").read_text())
        total = sum(e["probability"] for e in document["effects"])
        assert total == pytest.approx(1.0, abs=1e-9)
        fresh = (tmp_path / "out" / case.name / "fresh_prediction.csv").exists()
        assert fresh == (case / "fresh.csv").exists()
