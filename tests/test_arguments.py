"""Arguments of the wrong kind are refused where people call, with what is expected."""

from __future__ import annotations

import pandas as pd
import pytest

import calib

RUTS = calib.load_he2019("rut_depth")
PROBLEM = calib.build_problem("bekker", RUTS)


@pytest.mark.parametrize(
    ("call", "said", "expected"),
    [
        (lambda: calib.calibrate(PROBLEM, seed=-1), "seed = -1", "a whole number from 0 on"),
        (lambda: calib.calibrate(PROBLEM, seed=1.5), "seed = 1.5", "a whole number from 0 on"),
        (lambda: calib.calibrate(PROBLEM, seed=True), "seed = True", "a whole number from 0 on"),
        (lambda: calib.calibrate(RUTS, seed=1), "problem is of the type Table", "calib.Problem"),
        (
            lambda: calib.calibrate(PROBLEM, seed=1, settings={"steps": 3}),
            "settings is of the type dict", "calib.SamplerSettings",
        ),
        (
            lambda: calib.build_problem("bekker", RUTS, fixed=["n"]),
            "fixed is of the type list", "a dictionary",
        ),
        (lambda: calib.build_problem(None, RUTS), "model_name is of the type NoneType", "text"),
        (lambda: calib.SamplerSettings(steps=-1), "steps = -1", "a whole number from 1 on"),
        (lambda: calib.SamplerSettings(max_steps=1.5), "max_steps = 1.5", "a whole number"),
        (
            lambda: calib.diagnose(pd.DataFrame({"a": [1.0]})),
            "case is of the type DataFrame", "calib.Case or a path",
        ),
        (
            lambda: calib.diagnose("case", context=["sensor_drift"]),
            "context is of the type list", "a dictionary",
        ),
        (
            lambda: calib.hold_out(RUTS, "inflation_pressure_psi", "30"),
            "value = '30'", "a number or a list or an array",
        ),
        (
            lambda: calib.hold_out(RUTS, "inflation_pressure_psi", [30.0, None]),
            "value = [30.0, None]", "a number, or some in a list",
        ),
        (
            lambda: calib.hold_out(RUTS, "inflation_pressure_psi", []),
            "value = []", "a number, or some in a list",
        ),
        (lambda: calib.predict(PROBLEM, RUTS), "Problem predicts nothing", "calib.calibrate"),
        (
            lambda: calib.leave_one_out(PROBLEM),
            "calibration is of the type Problem", "calib.Calibration",
        ),
        (lambda: calib.gap_verdict(PROBLEM), "found is of the type Problem", "calib.Diagnosis"),
        (
            lambda: calib.compare([PROBLEM, PROBLEM], RUTS, seed=1),
            "a model is given as Problem, Problem", "the names of models",
        ),
        (
            lambda: calib.build_problem("bekker", RUTS.to_dataframe().iloc[:0]),
            "the table has no rows", "at least one row",
        ),
        (
            lambda: calib.build_problem("bekker", {"rut_depth_mm": 3.0}),
            "the columns are single numbers", "a list of values",
        ),
        (
            lambda: calib.build_problem("bekker", {"rut_depth_mm": [3.0, "x"]}),
            "row 1: 'x'", "a number",
        ),
        (lambda: calib.read_case(None), "folder is of the type NoneType", "a path"),
        (lambda: calib.read_table(3), "path = 3", "a path"),
        (
            lambda: calib.verdict(PROBLEM),
            "calibration is of the type Problem", "calib.Calibration",
        ),
    ],
)  # fmt: skip
def test_it_is_refused(call, said, expected):
    with pytest.raises(calib.CalibError) as refused:
        call()
    assert said in refused.value.message
    assert expected in refused.value.expected
    assert refused.value.hint


def test_the_path_of_a_prior_file_may_be_text(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(PROBLEM.priors.text)
    assert calib.build_problem("bekker", RUTS, str(path)).priors.names == PROBLEM.priors.names


def test_too_many_arguments_are_for_python_to_refuse():
    with pytest.raises(TypeError, match="levels"):
        calib.predict(PROBLEM, RUTS, levels=[0.9])


def test_few_names_are_listed_and_all_are_there():
    assert len(dir(calib)) < 30
    assert all(hasattr(calib, name) for name in calib.__all__)


def test_another_unit_than_the_calibrated_one_is_refused():
    pulls = calib.load_he2019("drawbar_pull")
    fitted, held = calib.hold_out(pulls, "inflation_pressure_psi", 30)
    problem = calib.build_problem("magic_formula_pressure", fitted)
    calibration = calib.calibrate(problem, seed=1)
    rows = {
        "slip_ratio": held["slip_ratio"],
        "inflation_pressure_psi": 30.0 + 0.0 * held["slip_ratio"],
    }
    newtons = {**rows, "drawbar_pull_kn": 1000.0 * held["drawbar_pull_kn"]}
    with pytest.raises(calib.CalibError, match="readings are in N or"):
        calib.validate_held_out(calibration, newtons)
    with pytest.raises(calib.CalibError, match="readings are in MPa"):
        calib.predict(
            calibration, {**rows, "inflation_pressure_psi": 0.2068 + 0.0 * rows["slip_ratio"]}
        )


def test_rows_keep_the_labels_of_their_data_frame():
    fitted, held = calib.hold_out(calib.load_he2019("drawbar_pull"), "inflation_pressure_psi", 30)
    problem = calib.build_problem("magic_formula_pressure", fitted)
    calibration = calib.calibrate(problem, seed=1)
    shuffled = held.to_dataframe().sample(frac=1.0, random_state=2)
    at = calib.predict(calibration, shuffled).to_dataframe()
    assert list(at.index) == list(shuffled.index)
    scored = calib.validate_held_out(calibration, shuffled).to_dataframe()
    off = shuffled["drawbar_pull_kn"] - at["drawbar_pull_kn_median"]
    assert off.std() == pytest.approx((scored["observed"] - scored["median"]).std(), abs=0.01)
    assert off.std() < 0.2


def test_units_are_those_of_the_file_after_a_run_was_saved(tmp_path):
    pulls = calib.load_he2019("drawbar_pull")
    table, _ = calib.hold_out(pulls, "inflation_pressure_psi", 30)
    columns = {
        "slip_percent": 100.0 * table["slip_ratio"],
        "inflation_pressure_kpa": 6.894757 * table["inflation_pressure_psi"],
        "drawbar_pull_n": 1000.0 * table["drawbar_pull_kn"],
    }
    calibration = calib.calibrate(calib.build_problem("magic_formula_pressure", columns), seed=1)
    before = calib.verdict(calibration)
    calib.save_calibration(calibration, tmp_path / "run")
    after = calib.verdict(calib.load_calibration(tmp_path / "run"))
    assert after.lines == before.lines
    assert "kPa" in before.trust
    assert " rms" not in before.trust
