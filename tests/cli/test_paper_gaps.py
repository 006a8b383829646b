"""The source's own gaps at the command line; a report of own data has none (`test_cli.py`)."""

from __future__ import annotations

import csv
import inspect
import json
import re
from pathlib import Path

import pytest

from calib.batch.environment import sha256
from calib.cli.prediction import diagnose as cli_diagnose
from calib.gap.diagnose import diagnose
from tests.commands import Calib, assert_refused, contents
from tests.gap_files import SOFT_PATCH


def test_the_four_cases_are_written_and_can_be_diagnosed(calib: Calib) -> None:
    written = calib("data", "he2019-gaps", "--out", "gaps")
    assert written.code == 0, written.err
    assert written.out.count("reconstructed from published results, not measured") == 4
    diagnosed = calib("diagnose", "gaps/plain_bekker", "--out", "found")
    assert diagnosed.code == 0, diagnosed.err
    assert "verdict: effect" in diagnosed.out
    assert "slip_sinkage" in diagnosed.out
    assert re.search(
        r"-> \S+ mm rms, error reduction \d+ % \(90 % interval \d+ to \d+ %\)", diagnosed.out
    )
    assert re.search(r"noise sd \S+ mm\n", diagnosed.out)
    inputs = json.loads(Path("found/inputs.json").read_text())
    assert inputs["sha256"]["field"] == sha256(Path("gaps/plain_bekker/field.csv").read_bytes())
    assert Path("found/fresh_prediction.csv").exists()
    again = calib("data", "he2019-gaps", "--out", "gaps")
    assert_refused(again, ["plain_bekker", "exist there already", "--overwrite"])
    assert calib("data", "he2019-gaps", "--out", "gaps", "--overwrite").code == 0


def test_a_users_effect_that_does_not_run_is_named(calib: Calib) -> None:
    assert calib("data", "he2019-gaps", "--out", "gaps").code == 0
    Path("mine.py").write_text(
        "from calib.gap.effects import Effect\n\n\nclass Wind(Effect):\n    name = 'wind'\n"
        "    parameters = ('deeper',)\n    outputs = ('sinkage',)\n\n"
        "    def on_output(self, phi, output, location, view):\n        return location + gust\n"
    )
    Path("wind.toml").write_text(
        'model = "wind"\n[parameters.deeper]\ndist = "normal"\nmean = 0.0\nsd = 0.1\n'
        'unit = "1"\nreason = "a guess"\nsource = "test"\n'
    )
    refused = calib("diagnose", "gaps/plain_bekker", "--effects", "mine.py", "--out", "found")
    assert_refused(refused, ["mine.py, effect wind, line 10", "NameError", "gust", "hint"])


def test_the_folder_is_called_by_the_name_of_the_data(calib: Calib, tmp_path: Path) -> None:
    assert calib("data", "he2019").code == 0
    assert calib("data", "he2019-gaps").code == 0
    assert {p for p in contents(tmp_path) if "/" not in p} == {"he2019", "he2019-gaps"}


def test_a_folder_that_cannot_be_made_is_said_so(calib: Calib) -> None:
    Path("file").write_text("")
    refused = calib("data", "he2019-gaps", "--out", "file/gaps")
    assert_refused(refused, ["file/gaps", "cannot be written"])


@pytest.mark.slow
def test_the_report_of_the_embedded_data_has_the_section(
    calib: Calib,
    monkeypatch: pytest.MonkeyPatch,
    found_gaps,
    audit,
) -> None:
    """The command passes the gaps on; what is tested elsewhere is left out here."""
    asked = []

    def diagnosed(seed, *_):
        asked.append(seed)
        return (found_gaps["plain_bekker"],)

    monkeypatch.setattr("calib.he2019.embedded.he2019_tasks", lambda _: ())
    monkeypatch.setattr("calib.he2019.sections.diagnose_gaps", diagnosed)
    monkeypatch.setattr("calib.he2019.sections.run_audit", lambda *_, **how: audit)
    ran = calib("report", "--out", "rep", "--seed", 5)
    assert ran.code == 0, ran.err
    assert asked == [5]
    assert set(json.loads(Path("rep/summary.json").read_text())["paper_gaps"]) == {"plain_bekker"}
    assert 'id="paper-gaps"' in Path("rep/index.html").read_text()


def test_a_report_of_one_embedded_output_has_no_other(calib: Calib) -> None:
    told = ("--only", "bulk_density", "--no-views", "--max-steps", 200, "--workers", 1)
    assert calib("report", *told, "--out", "rep").code in (0, 3)
    found = json.loads(Path("rep/summary.json").read_text())
    assert set(found["models"]) == {"bulk_density"}
    assert "paper_gaps" not in found
    assert not Path("rep/audit.json").exists()


def test_in_python_a_diagnosis_is_the_commands() -> None:
    """Without a seed both draw the same."""
    default = inspect.signature(cli_diagnose).parameters["seed"].default
    assert inspect.signature(diagnose).parameters["seed"].default == default


def test_a_diagnosis_with_an_effect_of_ones_own_is_predicted_from_with_it(calib: Calib) -> None:
    assert calib("data", "he2019-gaps", "--out", "gaps").code == 0
    Path("mine.py").write_text(SOFT_PATCH)
    made = calib("diagnose", "gaps/plain_bekker", "--effects", "mine.py", "--out", "found")
    assert made.code == 0, made.err
    found = json.loads(Path("found/diagnosis.json").read_text())
    assert "soft_patch" in found["inclusion"]
    recorded = json.loads(Path("found/inputs.json").read_text())["effects"]
    assert recorded == {"mine.py": sha256(Path("mine.py").read_bytes())}
    fresh = Path("gaps/plain_bekker/fresh.csv")
    whole = calib("predict", "found", "--at", fresh, "--effects", "mine.py", "--out", "p.csv")
    assert whole.code == 0, whole.err
    # Nothing but what the data are.
    assert whole.err.count("\n") == whole.err.count("reconstructed data:") == 1
    rows = Path("p.csv").read_text().splitlines()
    assert len(rows) == len(fresh.read_text().splitlines())
    assert "rut_depth_mm" in rows[0]
    # Beyond what either campaign covered it is said of each condition in which rows.
    head, first, *_ = fresh.read_text().splitlines()
    names, cells = head.split(","), first.split(",")
    cells[names.index("slip_ratio")] = "0.9"
    Path("far.csv").write_text(f"{head}\n{first}\n{','.join(cells)}\n")
    far = calib("predict", "found", "--at", "far.csv", "--effects", "mine.py")
    assert far.code == 0, far.err
    assert "far.csv, line 3: slip_ratio = 0.9, calibrated from" in far.err
    Path("percent.csv").write_text(fresh.read_text().replace("slip_ratio", "slip_percent"))
    percent = calib("predict", "found", "--at", "percent.csv", "--effects", "mine.py")
    assert_refused(percent, ["percent.csv", "'slip_percent'", "readings are in fractions"])
    without = calib("predict", "found", "--at", fresh)
    assert (without.code, "soft_patch" in without.err) in {(0, False), (2, True)}


def test_what_is_to_be_diagnosed_has_to_be_clear(calib: Calib) -> None:
    for given in ((), ("case", "--run", "run"), ("--run", "run"), ("--field", "field.csv")):
        told = calib("diagnose", *given, "--out", "found")
        assert_refused(told, ["it is not clear what to diagnose", "--run RUN together with"])
    assert not Path("found").exists()


def test_effects_are_of_a_diagnosis_alone(calib: Calib, run: Path) -> None:
    for option in (("--effects", "mine.py"), ("--without", "force_offset")):
        told = calib("predict", run, "--at", "my.csv", *option)
        assert_refused(told, ["there is no diagnosis, which alone has effects", "run"])


def test_what_comes_of_reconstructed_data_says_so(calib: Calib) -> None:
    said = (
        "They are not measurements: that models fit them follows in part from how they were made."
    )
    assert calib("data", "he2019-gaps", "--out", "gaps").code == 0
    # A copy under another name is what it is.
    Path("gaps/nominal_slip").rename("mine")
    ran = calib("diagnose", "mine", "--out", "found", "--workers", 1)
    assert said in ran.err
    assert said in Path("found/index.html").read_text()
    assert json.loads(Path("found/diagnosis.json").read_text())["data_label"] == "reconstructed"
    predicted = calib("predict", "found", "--at", "mine/fresh.csv", "--out", "p.csv")
    assert said in predicted.err
    for file in ("p.csv", "found/fresh_prediction.csv"):
        with Path(file).open(newline="") as text:
            assert {row["data_label"] for row in csv.DictReader(text)} == {"reconstructed"}
    rut = "mine.csv"
    Path("gaps/plain_bekker/lab.csv").rename(rut)
    few = ("--max-steps", 100, "--workers", 1)
    fitted = calib("fit", rut, "--model", "bekker", "--out", "fit", "--json", *few)
    assert said in fitted.err
    assert json.loads(fitted.out)["data_label"] == "reconstructed"
    compared = calib("compare", "bekker", "modified_bekker", rut, "--out", "both", *few)
    assert said in compared.err
    assert said in Path("both/index.html").read_text()
    assert json.loads(Path("both/comparison.json").read_text())["data_label"] == "reconstructed"
    assert said in calib("check", "fit", "--quick").err


def test_data_of_ones_own_are_called_nothing(calib: Calib) -> None:
    template = calib("template", "bekker", "--out", "own.csv")
    assert template.code == 0
    fitted = calib("fit", "own.csv", "--model", "bekker", "--out", "fit", "--max-steps", 100)
    assert "reconstructed" not in fitted.err
