"""The corrected model, saved and loaded, predicts what the diagnosis predicted."""

import json
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from calib.cli.verbs import app
from calib.data import table_from_arrays, write_table
from calib.data.quantities import OUTPUTS
from calib.errors import CalibError
from calib.gap.case import read_case
from calib.gap.corrected import (
    conditions_outside,
    load_corrected,
    predict_columns,
    save_corrected,
)
from calib.gap.diagnose import diagnose
from calib.gap.effects import EFFECTS
from calib.gap.effects.load import load_effects
from tests.gap.cases import LARGE, PULL_ONLY, make_case
from tests.gap.test_load_effects import write

FEW = {name: EFFECTS[name] for name in ("force_offset", "rate_effect")}


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    folder = tmp_path_factory.mktemp("diagnosis")
    case = make_case("force_offset")
    found = diagnose(replace(case, new_conditions=case.field), 1, effects=FEW)
    save_corrected(found.corrected, folder)
    return found, folder


def test_it_predicts_as_the_diagnosis_did(saved):
    found, folder = saved
    columns = predict_columns(load_corrected(folder), found.data.case.field)
    for name, prediction in found.new_predictions.items():
        column = {"drawbar_pull": "drawbar_pull_kn", "rut_depth": "rut_depth_mm"}[name]
        np.testing.assert_allclose(columns[f"{column}_before"], prediction.before, rtol=1e-9)
        np.testing.assert_allclose(columns[f"{column}_after"], prediction.after, rtol=1e-9)
        np.testing.assert_allclose(columns[f"{column}_after_lower"], prediction.lower, rtol=1e-9)


def test_a_damaged_one_is_refused(saved, tmp_path):
    _, folder = saved
    content = json.loads((folder / "corrected.json").read_text())
    content["fits"][0]["psi"] = content["fits"][0]["psi"][:-1]
    (tmp_path / "corrected.json").write_text(json.dumps(content))
    (tmp_path / "case").symlink_to(folder / "case")
    with pytest.raises(CalibError, match="no readable corrected model"):
        load_corrected(tmp_path)


def test_a_model_that_has_changed_since_is_refused(saved, tmp_path):
    """As when the file of one's own effects, or its priors, is no longer what it was."""

    class Other(type(EFFECTS["force_offset"])):
        def on_output(self, phi, output, location, view):
            return location + 1.01 * (super().on_output(phi, output, location, view) - location)

    _, folder = saved
    with pytest.raises(CalibError, match="no longer predicts the drawbar_pull"):
        load_corrected(folder, {**FEW, "force_offset": Other()})


def test_missing_covariates_are_named(saved):
    _, folder = saved
    few = table_from_arrays({"slip_ratio": np.array([0.1])})
    with pytest.raises(CalibError, match="the corrected model needs"):
        predict_columns(load_corrected(folder), few)


def test_conditions_beyond_both_campaigns_are_counted(saved):
    found, folder = saved
    case = found.data.case
    assert conditions_outside(load_corrected(folder), case.field) == {}
    fast = {
        **case.field.columns,
        "speed_m_s": case.field["speed_m_s"] * np.array([30.0] + [1.0] * 26),
    }
    assert conditions_outside(load_corrected(folder), table_from_arrays(fast)) == {"speed_m_s": 1}


def test_the_conditions_to_predict_are_kept(saved):
    found, folder = saved
    kept = read_case(folder / "case")
    assert kept.new_conditions is not None
    np.testing.assert_allclose(
        kept.new_conditions["slip_ratio"], found.data.case.new_conditions["slip_ratio"]
    )


def test_an_effect_of_ones_own_is_passed_to_predict(tmp_path, capsys):
    path = write(tmp_path)
    case = make_case("force_offset", models=PULL_ONLY, n_fresh=3)
    own = load_effects(path)
    (tmp_path / "found").mkdir()
    save_corrected(diagnose(case, 1, effects=own).corrected, tmp_path / "found")
    conditions = {k: v for k, v in case.field.columns.items() if k not in OUTPUTS.values()}
    write_table(tmp_path / "at.csv", {k: v for k, v in conditions.items() if k != "run_order"})
    given = ["predict", str(tmp_path / "found"), "--at", str(tmp_path / "at.csv")]
    refused = CliRunner().invoke(app, given)
    assert refused.exit_code == 2
    assert "--effects" in refused.stderr
    done = CliRunner().invoke(app, [*given, "--effects", str(path)])
    assert done.exit_code == 0
    assert "no run_order is given" in done.stderr
    header, *rows = done.stdout.splitlines()
    values = np.array([row.split(",") for row in rows], float).T
    columns = dict(zip(header.split(","), values, strict=True))
    change = columns["drawbar_pull_kn_after"] - columns["drawbar_pull_kn_before"]
    # The offset of the case, which the wind explains, to two noise sds of its mean and the lab's.
    np.testing.assert_allclose(change.mean(), LARGE["force_offset"]["offset"], atol=0.02)


def test_a_fault_that_was_mended_is_left_out(saved):
    found, folder = saved
    corrected, field = load_corrected(folder), found.data.case.field
    assert corrected.faults == ["force_offset"]
    with_it = predict_columns(corrected, field)
    mended = predict_columns(corrected, field, ["force_offset"])
    # The truth is the simulator again, to what the field taught it; the reading had the offset.
    change = with_it["drawbar_pull_kn_after"] - mended["drawbar_pull_kn_after"]
    np.testing.assert_allclose(change.mean(), LARGE["force_offset"]["offset"], atol=0.02)
    half = (mended["drawbar_pull_kn_after_upper"] - mended["drawbar_pull_kn_after_lower"]) / 2.0
    gap = np.abs(mended["drawbar_pull_kn_after"] - mended["drawbar_pull_kn_before"])
    assert (gap < half).all()
    np.testing.assert_allclose(mended["rut_depth_mm_after"], with_it["rut_depth_mm_after"])


def test_without_every_cause_the_simulator_is_left(saved):
    found, folder = saved
    for fit in load_corrected(folder).mixture.fits:
        forward, psi = fit.forward, fit.psi[None]
        left = forward.without(psi, found.data.view, *forward.causes)
        plain = forward.simulator(psi, found.data.view)
        for name, values in plain.items():
            np.testing.assert_allclose(left[name], values, rtol=1e-9)


def test_what_is_left_out_must_be_a_cause(saved, tmp_path):
    found, folder = saved
    with pytest.raises(CalibError, match="no cause offset to leave out") as refused:
        predict_columns(load_corrected(folder), found.data.case.field, ["offset"])
    assert "force_offset" in refused.value.allowed
    conditions = dict(found.data.case.field.columns)
    write_table(tmp_path / "at.csv", conditions)
    given = ["predict", str(folder), "--at", str(tmp_path / "at.csv")]
    told = CliRunner().invoke(app, given)
    assert "predict --without force_offset" in told.stderr
    mended = CliRunner().invoke(app, [*given, "--without", "force_offset"])
    assert mended.exit_code == 0
    assert "what is predicted is the reading" not in mended.stderr
    assert mended.stdout != told.stdout
