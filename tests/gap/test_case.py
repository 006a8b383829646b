"""Reading a case: what is wrong is named."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

from calib.data import write_table
from calib.errors import CalibError
from calib.gap.batch import case_hashes, inputs_record
from calib.gap.campaigns import campaigns
from calib.gap.case import case_files, case_from_run, read_case
from calib.gap.corrected import load_corrected, save_corrected
from calib.gap.diagnose import diagnose_once
from calib.gap.effects import EFFECTS
from calib.inference.calibration import calibrate
from calib.inference.io import save_calibration
from calib.inference.prior_files import DeclaredPriors, default_priors
from calib.inference.problem import build_problem
from tests.gap.cases import MODELS, PULL_ONLY, make_case, write_case


def test_a_written_case_is_read_back(tmp_path):
    case = make_case("force_offset", n_fresh=4)
    found = read_case(write_case(case, tmp_path / "a-case"))
    assert found.name == "a-case"
    assert dict(found.models) == MODELS
    assert found.new_conditions is not None
    assert len(found.new_conditions) == 4
    for name, values in case.field.columns.items():
        np.testing.assert_allclose(found.field[name], values, rtol=1e-12)


def test_the_file_of_a_case_is_not_its_folder(tmp_path):
    folder = write_case(make_case("force_offset"), tmp_path / "case")
    with pytest.raises(CalibError, match=f"give its folder: {re.escape(str(folder))}$"):
        read_case(folder / "case.toml")


def test_units_in_column_names_are_converted(tmp_path):
    folder = write_case(make_case(), tmp_path / "case")
    columns = dict(make_case().field.columns)
    columns["inflation_pressure_kpa"] = columns.pop("inflation_pressure_psi") * 6.894757293168361
    write_table(folder / "field.csv", columns)
    psi = read_case(folder).field["inflation_pressure_psi"]
    np.testing.assert_allclose(np.unique(psi.round(6)), [18.0, 30.0, 42.0])


@pytest.mark.parametrize(
    ("toml", "words"),
    [
        (None, "cannot be read"),
        ("calibration = ", "not valid TOML"),
        ('calibration = "lab.csv"\nfield = "field.csv"\n', "models is missing"),
        ('field = "field.csv"\n[models]\nrut_depth = "bekker"\n', "calibration"),
        ('calibration = 3\nfield = "field.csv"\n[models]\nrut_depth = "bekker"\n', "calibration"),
        (
            'calibration = "lab.csv"\nfield = "field.csv"\nprdict = "fresh.csv"\n[models]\n'
            'rut_depth = "bekker"\n',
            "unknown key prdict\n  expected: calibration, field, predict, models, priors, "
            "covariates, context\n"
            "  hint: did you mean predict?",
        ),
        (
            'calibration = "lab.csv"\nfield = "field.csv"\n[models]\nsinkage = "bekker"\n',
            "unknown output sinkage",
        ),
        (
            'calibration = "nowhere.csv"\nfield = "field.csv"\n[models]\nrut_depth = "bekker"\n',
            "nowhere.csv",
        ),
    ],
)
def test_what_is_wrong_with_a_case_is_named(tmp_path, toml, words):
    folder = write_case(make_case(), tmp_path / "case")
    (folder / "case.toml").unlink()
    if toml is not None:
        (folder / "case.toml").write_text(toml)
    with pytest.raises(CalibError) as caught:
        read_case(folder)
    assert words in str(caught.value)


@pytest.mark.parametrize("name", ["../outside.csv", "/etc/passwd", "a/../../outside.csv", "\0"])
@pytest.mark.parametrize("key", ["calibration", "field", "predict"])
def test_a_case_opens_no_file_but_its_own(tmp_path, key, name):
    folder = write_case(make_case("force_offset", n_fresh=4), tmp_path / "case")
    (tmp_path / "outside.csv").write_bytes((folder / "field.csv").read_bytes())
    toml = (folder / "case.toml").read_text()
    named = {"calibration": "lab.csv", "field": "field.csv", "predict": "fresh.csv"}[key]
    written = name.replace("\0", "\\u0000")
    (folder / "case.toml").write_text(toml.replace(f'"{named}"', f'"{written}"'))
    with pytest.raises(CalibError, match=f"{key} = .* is not a file of the case"):
        read_case(folder)
    assert key not in case_files(folder)[1]


def test_a_link_out_of_a_case_is_not_followed(tmp_path):
    folder = write_case(make_case("force_offset"), tmp_path / "case")
    (folder / "field.csv").rename(tmp_path / "field.csv")
    (folder / "field.csv").symlink_to(tmp_path / "field.csv")
    with pytest.raises(CalibError, match="not reached by a link out of it"):
        read_case(folder)


def narrow_priors(text: str) -> str:
    """The shipped priors, the peak pull a tenth as wide."""
    content = text.split("\n")
    return "\n".join(
        re.sub(r"sd_log = [0-9.]+", "sd_log = 0.02", line) if "sd_log" in line else line
        for line in content
    )


def test_a_case_may_bring_the_priors_of_its_simulators(tmp_path):
    """And they go with it, to where a corrected model is kept."""
    folder = write_case(make_case("force_offset", models=PULL_ONLY), tmp_path / "case")
    text = narrow_priors(default_priors(PULL_ONLY["drawbar_pull"]).read_text(encoding="utf-8"))
    (folder / "mine.toml").write_text(text, encoding="utf-8")
    with (folder / "case.toml").open("a", encoding="utf-8") as file:
        file.write('\n[priors]\ndrawbar_pull = "mine.toml"\n')
    case = read_case(folder)
    assert case_files(folder)[1]["priors.drawbar_pull"] == folder / "mine.toml"
    (output,) = campaigns(case).outputs
    assert output.problem.priors.text == text
    found = diagnose_once(case, 1, effects={"force_offset": EFFECTS["force_offset"]})
    (tmp_path / "out").mkdir()
    save_corrected(found.corrected, tmp_path / "out")
    kept = load_corrected(tmp_path / "out").data.outputs[0].problem.priors
    assert kept.text == text
    recorded = json.loads(inputs_record(case, 1))
    assert recorded["priors"] == case_hashes(folder)["priors"]


@pytest.mark.parametrize(
    ("priors", "said"),
    [
        ('drawbar_pull = "../mine.toml"', "not a file of the case"),
        ('drawbar_pull = "none.toml"', "cannot be read"),
        ('rut_depth = "mine.toml"', "it says"),
        ("drawbar_pull = 3", "drawbar_pull = 3 is not"),
    ],
)
def test_priors_that_are_not_there_are_refused(tmp_path, priors, said):
    folder = write_case(make_case(models=PULL_ONLY), tmp_path / "case")
    with (folder / "case.toml").open("a", encoding="utf-8") as file:
        file.write(f"\n[priors]\n{priors}\n")
    with pytest.raises(CalibError, match=said):
        read_case(folder)


def test_a_case_of_a_run_has_the_priors_of_the_run(tmp_path):
    made = make_case("force_offset", models=PULL_ONLY)
    model = PULL_ONLY["drawbar_pull"]
    text = narrow_priors(default_priors(model).read_text(encoding="utf-8"))
    problem = build_problem(model, made.lab, DeclaredPriors("mine.toml", text))
    run = tmp_path / "run"
    run.mkdir()
    save_calibration(calibrate(problem, 1), run)
    write_table(tmp_path / "field.csv", dict(made.field.columns))
    case = case_from_run(run, tmp_path / "field.csv")
    assert campaigns(case).outputs[0].problem.priors.text == text
