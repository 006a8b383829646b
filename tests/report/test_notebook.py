"""What results show in a notebook, and tables that come from pandas or a dictionary."""

from __future__ import annotations

import re
from functools import cache

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

import calib
from calib.gap.mixture import UNLISTED
from tests.gap.cases import diagnosis_of

PULLS = ("slip_ratio", "inflation_pressure_psi")


@cache
def calibrated():
    data = calib.load_he2019("drawbar_pull")
    return calib.calibrate(calib.build_problem("magic_formula_pressure", data), seed=1)


@cache
def compared():
    columns = dict(calib.load_he2019("rut_depth").columns)
    return calib.compare(["bekker", "modified_bekker"], columns)


@cache
def shown():
    field = diagnosis_of("lug_thrust").data.case.field
    return [
        calibrated(),
        calib.predict(calibrated(), calib.load_he2019("drawbar_pull")),
        compared(),
        diagnosis_of("lug_thrust"),
        calib.predict(diagnosis_of("lug_thrust"), field),
    ]


@pytest.mark.parametrize("i", range(5))
def test_every_result_has_a_short_name_a_table_a_figure_and_a_view(i):
    found = shown()[i]
    assert len(repr(found)) < 300
    drawn = found.plot()
    assert isinstance(drawn, Figure)
    assert drawn._repr_png_().startswith(b"\x89PNG")  # in a notebook without pyplot
    frame = found.to_dataframe()
    assert len(frame) >= 2
    assert "<table" in found._repr_html_()


def test_a_card_has_one_unit_for_a_quantity():
    pulls = calib.load_he2019("drawbar_pull")
    newtons = {name: pulls[name] for name in PULLS}
    newtons["drawbar_pull_n"] = 1000.0 * pulls["drawbar_pull_kn"]
    problem = calib.build_problem("magic_formula_pressure", newtons)
    card = calib.calibrate(problem, seed=1)._repr_html_()
    assert "kN" not in card
    cells = re.search(r"<th>D_lo</th>\s*<td>(.*?)</td>\s*<td>(.*?)</td>", card)
    assert cells is not None
    assert cells[1] == "N"
    assert float(cells[2]) == pytest.approx(1000.0 * calibrated().summary["D_lo"].median, rel=0.02)


def test_parameters_come_first_and_then_what_is_published_of_them():
    found = calibrated()
    frame = found.to_dataframe()
    sampled = list(found.problem.names)
    assert set(frame.index[: len(sampled)]) == set(sampled)
    assert frame.loc["D_lo", "median"] == found.summary["D_lo"].median
    assert frame.loc["D_lo", "unit"] == "kN"


def test_a_prediction_has_a_row_for_each_row_of_conditions():
    at = pd.DataFrame({"slip_percent": [5.0, 90.0], "inflation_pressure_psi": [30.0, 30.0]})
    found = calib.predict(calibrated(), at)
    frame = found.to_dataframe()
    np.testing.assert_allclose(frame["slip_ratio"], [0.05, 0.9])
    np.testing.assert_array_equal(frame["drawbar_pull_kn_median"], found.predictive.median)
    assert list(frame["outside_calibrated_range"]) == ["", "slip_ratio"]


def test_a_diagnosis_predicts_with_its_causes_and_without_them():
    found = diagnosis_of("lug_thrust")
    field = pd.DataFrame(dict(found.data.case.field.columns)).drop(columns="drawbar_pull_kn")
    acting, mended = (
        calib.predict(found, field, without).to_dataframe()["drawbar_pull_kn_after"]
        for without in ((), ["lug_thrust"])
    )
    truth = found.truth.means["drawbar_pull"]
    np.testing.assert_allclose(acting, truth, rtol=1e-9)
    assert (acting - mended).mean() > 0.05
    with pytest.raises(calib.CalibError, match="no causes"):
        calib.predict(calibrated(), calib.load_he2019("drawbar_pull"), ["lug_thrust"])


def test_a_diagnosis_lists_causes_and_the_unlisted():
    found = diagnosis_of("lug_thrust")
    frame = found.to_dataframe()
    assert frame.index[0] == "lug_thrust"
    assert UNLISTED in frame.index
    assert (
        frame.loc["lug_thrust", "probability"] == found.inclusion.causes["lug_thrust"].probability
    )


def test_a_comparison_lists_models_by_weight():
    frame = compared().to_dataframe()
    assert frame["weight"].sum() == pytest.approx(1.0)
    assert frame.loc["modified_bekker", "elpd_behind_best"] == 0.0


def test_a_table_may_be_a_dictionary_or_a_data_frame():
    table = calib.load_he2019("drawbar_pull")
    columns = {name: table[name] for name in (*PULLS, "drawbar_pull_kn")}
    problems = [
        calib.build_problem("magic_formula_pressure", data)
        for data in (table, columns, pd.DataFrame(columns))
    ]
    start = problems[0].priors.sample(np.random.default_rng(1), 3)
    values = [problem.log_prob(start) for problem in problems]
    np.testing.assert_allclose(values[1], values[0])
    np.testing.assert_allclose(values[2], values[0])
    rest, held = calib.hold_out(pd.DataFrame(columns), "inflation_pressure_psi", 30)
    assert (len(rest), len(held)) == (28, 14)


def test_tables_problems_and_validations_are_short_too(tmp_path):
    table = calib.load_he2019("drawbar_pull")
    _, held = calib.hold_out(table, "inflation_pressure_psi", 30)
    with pytest.raises(calib.CalibError, match="all 14 rows to validate on are"):
        calib.validate_held_out(calibrated(), held)
    validation = calib.leave_one_out(calibrated())
    judged = calib.verdict(calibrated(), validation)
    for found in (table, calibrated().problem, validation, judged):
        assert len(repr(found)) < 300
    assert len(table.to_dataframe()) == len(table)
    frame = validation.to_dataframe()
    np.testing.assert_array_equal(frame["observed"], table["drawbar_pull_kn"])
    assert "<table" in validation._repr_html_()
    calib.save_calibration(calibrated(), str(tmp_path / "new" / "run"))
    again = calib.build_problem(
        "magic_formula_pressure", str(tmp_path / "new" / "run" / "data.csv")
    )
    assert len(again.table) == len(calibrated().problem.table)


def test_rows_that_were_held_out_keep_their_labels():
    data = pd.DataFrame(
        {"average_ground_pressure_kpa": [60, 80, 100, 120, 140, 160.0],
         "rut_depth_mm": [11.0, 15.2, 18.1, 22.3, 25.0, 29.4]}, index=list("uvwxyz"),
    )  # fmt: skip
    fitted, held = calib.hold_out(data, "average_ground_pressure_kpa", [80, 140])
    assert list(fitted.to_dataframe().index) == list("uwxz")
    calibration = calib.calibrate(calib.build_problem("bekker", fitted), seed=1)
    assert list(calib.predict(calibration, held).to_dataframe().index) == ["v", "y"]
    assert list(calib.validate_held_out(calibration, held).to_dataframe().index) == ["v", "y"]


def test_readings_to_one_side_are_no_good_validation():
    rng = np.random.default_rng(2)
    p = np.tile(np.linspace(60.0, 200.0, 10), 3)
    ruts = 24.0 * p / 130.0 * np.exp(0.05 * rng.standard_normal(30))
    data = pd.DataFrame({"average_ground_pressure_kpa": p, "rut_depth_mm": ruts})
    calibration = calib.calibrate(calib.build_problem("bekker", data[:15]), seed=1)
    for bias, headline in ((0.0, "Holds on unseen rows"), (3.0, "Predictions off to one side")):
        new = data[15:].assign(rut_depth_mm=data["rut_depth_mm"][15:] + bias)
        judged = calib.verdict(calibration, calib.validate_held_out(calibration, new))
        assert judged.headline == headline


def test_a_prior_that_the_data_contradict_is_said_without_an_estimate_too(tmp_path):
    (tmp_path / "mine.toml").write_text(
        'model = "modified_bekker"\n[parameters.n1]\ndist = "normal"\nmean = 0.0\nsd = 0.01\n'
        'unit = "1"\nreason = "wrong"\nsource = "this test"\n'
    )
    ruts = calib.load_he2019("rut_depth")
    problem = calib.build_problem("modified_bekker", ruts, tmp_path / "mine.toml")
    calibration = calib.calibrate(problem, seed=1)
    assert calib.verdict(calibration).headline == "Prior contradicted"
    calib.save_calibration(calibration, tmp_path / "run")
    assert calib.verdict(calib.load_calibration(tmp_path / "run")).headline == "Prior contradicted"


def test_priors_of_a_model_that_is_not_compared_are_refused():
    ruts = calib.load_he2019("rut_depth")
    with pytest.raises(calib.CalibError, match="priors are given for bekkr, which is not compared"):
        calib.compare(["bekker", "lyasko"], ruts, priors={"bekkr": "nothing.toml"})


def test_truth_values_are_no_readings():
    with pytest.raises(calib.CalibError, match="of type bool, not numbers"):
        calib.build_problem("bekker", {"average_ground_pressure_kpa": [True], "rut_depth_mm": [1]})


def test_what_is_no_table_is_refused_with_what_would_be_one():
    for given in (None, 3, np.zeros((2, 2))):
        with pytest.raises(calib.CalibError, match="is no table"):
            calib.build_problem("bekker", given)
    twice = pd.DataFrame([[0.1, 0.2]], columns=["slip_ratio", "slip_ratio"])
    with pytest.raises(calib.CalibError, match="given twice"):
        calib.predict(calibrated(), twice)
    with pytest.raises(calib.CalibError, match="bekker"):
        calib.compare("bekker", calib.load_he2019("rut_depth"))
