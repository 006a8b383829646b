"""What diagnoses are of: those of other cases, or of these before a change, are noticed."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from calib.batch.environment import sha256
from calib.errors import CalibError
from calib.gap.batch import INPUTS, case_hashes, check_resumable, inputs_record, recorded_inputs
from calib.gap.case import read_case
from tests.gap.cases import PULL_ONLY, make_case, write_case


@pytest.fixture
def diagnosed(tmp_path) -> tuple[Path, Path]:
    """Return a case folder, and a folder of results with its record."""
    made = make_case(models=PULL_ONLY, n_lab=15, n_field=12, n_fresh=3)
    case = write_case(made, tmp_path / "cases" / "case-0")
    (tmp_path / "out" / "case-0").mkdir(parents=True)
    (tmp_path / "out" / "case-0" / INPUTS).write_bytes(inputs_record(read_case(case), 1))
    return case, tmp_path / "out"


def test_the_record_of_a_case_is_what_its_folder_holds(diagnosed):
    case, out = diagnosed
    said = recorded_inputs(out / "case-0")
    assert said is not None
    kept = ("models", "sha256", "context", "priors", "covariates")
    assert {key: said.get(key) for key in kept} == case_hashes(case)
    assert set(said["sha256"]) == {"calibration", "field", "predict"}
    check_resumable([case], out, 1)


def test_a_changed_file_another_seed_or_version_are_refused(diagnosed):
    case, out = diagnosed
    with pytest.raises(CalibError, match="--seed 1, not 2"):
        check_resumable([case], out, 2)
    record = out / "case-0" / INPUTS
    said = json.loads(record.read_text())
    record.write_text(json.dumps(said | {"version": "0.0.0"}))
    with pytest.raises(CalibError, match=r"made by version 0\.0\.0"):
        check_resumable([case], out, 1)
    record.write_text(json.dumps(said | {"code_sha256": "0" * 64}))
    with pytest.raises(
        CalibError, match=re.escape(f"other code or priors of version {said['version']}")
    ):
        check_resumable([case], out, 1)
    with (case / "field.csv").open("a") as file:
        file.write("\n")
    with pytest.raises(CalibError, match="of other cases, or of these before") as caught:
        check_resumable([case], out, 1)
    assert "case-0" in str(caught.value)
    assert caught.value.hint is not None


@pytest.mark.parametrize(("n", "listed"), [
    (1, "1 of the diagnoses that are there do not say which cases they are of: case-0"),
    (5, "case-0, case-1, case-2, case-3, case-4"),
    (6, "case-0, case-1, case-2, case-3, case-4, ..."),
])  # fmt: skip
def test_a_few_of_many_are_named(tmp_path, n, listed):
    cases = [tmp_path / "cases" / f"case-{i}" for i in range(n)]
    for case in cases:
        (tmp_path / "out" / case.name).mkdir(parents=True)
    with pytest.raises(CalibError) as caught:
        check_resumable(cases, tmp_path / "out", 1)
    assert str(caught.value).splitlines()[0].endswith(listed)


@pytest.mark.parametrize("text", [None, "{", "[]"])
def test_results_that_do_not_say_what_they_are_of_are_not_resumed(diagnosed, text):
    case, out = diagnosed
    (out / "case-0" / INPUTS).unlink()
    if text is not None:
        (out / "case-0" / INPUTS).write_text(text)
    with pytest.raises(CalibError, match="do not say which cases"):
        check_resumable([case], out, 1)


def test_effects_of_ones_own_are_recorded_and_not_resumed_without_them(diagnosed):
    case, out = diagnosed
    files = {"mine.py": b"class Wind: ...", "wind.toml": b'model = "wind"'}
    record = inputs_record(read_case(case), 1, files)
    assert json.loads(record)["effects"] == {name: sha256(text) for name, text in files.items()}
    (out / "case-0" / INPUTS).write_bytes(record)
    with pytest.raises(CalibError, match="made with effects of one's own"):
        check_resumable([case], out, 1)


@pytest.mark.parametrize(
    ("table", "kinds"),
    [
        ("", None),
        ('[covariates]\ntyre_temperature_c = "number"\nshift = "category"\n',
         {"tyre_temperature_c": "number", "shift": "category"}),
        ('[covariates]\nshift = ["a", "b"]\n', {"shift": "category"}),
    ],
)  # fmt: skip
def test_declared_columns_are_recorded_by_their_kind(tmp_path, table, kinds):
    case = write_case(make_case(models=PULL_ONLY, n_lab=15, n_field=12), tmp_path / "case")
    for name in ("lab.csv", "field.csv"):
        head, *rows = (case / name).read_text().splitlines()
        rows = [f"{row},{20 + i},{'ab'[i % 2]}" for i, row in enumerate(rows)]
        (case / name).write_text("\n".join([f"{head},tyre_temperature_c,shift", *rows]) + "\n")
    with (case / "case.toml").open("a") as file:
        file.write(table)
    assert case_hashes(case)["covariates"] == kinds
    assert json.loads(inputs_record(read_case(case), 1)).get("covariates") == kinds
