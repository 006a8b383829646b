"""The source's own gaps at the command line; a report of own data has none (`test_cli.py`)."""

from __future__ import annotations

import inspect
import json
import re
from pathlib import Path

import pytest

from calib.batch.environment import sha256
from calib.cli.gap import diagnose as cli_diagnose
from calib.gap.diagnose import diagnose
from tests.cli.test_cli import Calib, assert_refused, calib, contents  # noqa: F401


def test_the_four_cases_are_written_and_can_be_diagnosed(calib: Calib) -> None:  # noqa: F811
    written = calib("data", "he2019-gaps", "--out", "gaps")
    assert written.code == 0, written.err
    assert written.out.count("reconstructed from published results, not measured") == 4
    diagnosed = calib("diagnose", "gaps/plain_bekker", "--out", "found")
    assert diagnosed.code == 0, diagnosed.err
    assert "verdict: effect" in diagnosed.out
    assert "slip_sinkage" in diagnosed.out
    assert re.search(r"-> \S+ mm rms, shrink \d+ % \(90 % interval \d+ to \d+ %\)", diagnosed.out)
    assert re.search(r"noise sd \S+ mm\n", diagnosed.out)
    inputs = json.loads(Path("found/inputs.json").read_text())
    assert inputs["sha256"]["field"] == sha256(Path("gaps/plain_bekker/field.csv").read_bytes())
    assert Path("found/fresh_prediction.csv").exists()
    again = calib("data", "he2019-gaps", "--out", "gaps")
    assert_refused(again, ["plain_bekker", "exist there already", "--overwrite"])
    assert calib("data", "he2019-gaps", "--out", "gaps", "--overwrite").code == 0


def test_a_users_effect_that_does_not_run_is_named(calib: Calib) -> None:  # noqa: F811
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
    assert_refused(refused, ["mine.py, effect wind, line 10", "NameError", "gust", "to mend"])


def test_the_folder_is_called_by_the_name_of_the_data(calib: Calib, tmp_path: Path) -> None:  # noqa: F811
    assert calib("data", "he2019").code == 0
    assert calib("data", "he2019-gaps").code == 0
    assert {p for p in contents(tmp_path) if "/" not in p} == {"he2019", "he2019-gaps"}


def test_a_folder_that_cannot_be_made_is_said_so(calib: Calib) -> None:  # noqa: F811
    Path("file").write_text("")
    refused = calib("data", "he2019-gaps", "--out", "file/gaps")
    assert_refused(refused, ["file/gaps", "cannot be written"])


@pytest.mark.slow
def test_the_report_of_the_embedded_data_has_the_section(
    calib: Calib,  # noqa: F811
    monkeypatch: pytest.MonkeyPatch,
    found_gaps,
    audit,
) -> None:
    """The command passes the gaps on; what is tested elsewhere is left out here."""
    asked = []

    def begin(seed, *_):
        asked.append(seed)
        return lambda tell: (found_gaps["plain_bekker"],)

    monkeypatch.setattr("calib.he2019.designs.he2019_tasks", lambda: ())
    monkeypatch.setattr("calib.he2019.sections.begin_gaps", begin)
    monkeypatch.setattr("calib.he2019.sections.begin_audit", lambda *_: lambda *_: audit)
    ran = calib("report", "--out", "rep", "--seed", 5)
    assert ran.code == 0, ran.err
    assert asked == [5]
    assert set(json.loads(Path("rep/summary.json").read_text())["paper_gaps"]) == {"plain_bekker"}
    assert 'id="paper-gaps"' in Path("rep/index.html").read_text()


def test_in_python_a_diagnosis_is_the_commands() -> None:
    """Without a seed both draw the same."""
    default = inspect.signature(cli_diagnose).parameters["seed"].default
    assert inspect.signature(diagnose).parameters["seed"].default == default
