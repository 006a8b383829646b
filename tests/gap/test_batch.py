"""Many cases: resumable, whole or not at all, and the same on any number of workers."""

from __future__ import annotations

import json
import shutil
from functools import partial
from pathlib import Path

import pytest

from calib.errors import CalibError
from calib.gap import batch
from calib.gap.batch import case_folders, diagnose_cases
from calib.gap.diagnose import diagnose
from calib.gap.effects import EFFECTS
from tests.gap.cases import PULL_ONLY, make_case, write_case


@pytest.fixture(scope="module")
def cases(tmp_path_factory) -> list[Path]:
    root = tmp_path_factory.mktemp("cases")
    for i, effect in enumerate((None, "force_offset")):
        case = make_case(effect, models=PULL_ONLY, n_lab=15, n_field=12, n_fresh=3, seed=i)
        write_case(case, root / f"case-{i}")
    (root / "not-a-case").mkdir()
    return case_folders(root)


@pytest.fixture(scope="module")
def done(cases, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("done")
    assert diagnose_cases(cases, out, 1) == {}
    return out


def content(out: Path) -> dict[str, bytes]:
    return {
        p.relative_to(out).as_posix(): p.read_bytes()
        for p in sorted(out.rglob("*"))
        if p.is_file() and p.suffix in (".json", ".csv") and p.name != "seconds.csv"
    }


def test_folders_with_a_case_in_them_are_found(cases, tmp_path):
    assert [c.name for c in cases] == ["case-0", "case-1"]
    with pytest.raises(CalibError, match="no cases"):
        case_folders(tmp_path)


def test_every_case_has_its_diagnosis(done):
    assert json.loads((done / "case-0" / "diagnosis.json").read_text())["verdict"] == "none"
    assert json.loads((done / "case-1" / "diagnosis.json").read_text())["verdict"] != "none"
    assert sorted(p.name for p in done.iterdir()) == ["case-0", "case-1", "seconds.csv"]


@pytest.mark.slow  # `tests/batch/test_cluster.py` has what it rests on
def test_two_workers_write_the_same_bytes(cases, done, tmp_path):
    assert diagnose_cases(cases, tmp_path / "two", 1, workers=2) == {}
    assert content(tmp_path / "two") == content(done)
    assert {"case-0/diagnosis.json", "case-1/diagnosis.json"} <= set(content(done))


def test_what_is_there_is_not_done_again(cases, done, monkeypatch):
    def refuse(*args, **kwargs):
        raise AssertionError("done again")

    monkeypatch.setattr(batch, "read_case", refuse)
    seen = []
    assert diagnose_cases(cases, done, 1, progress=lambda *p: seen.append(p)) == {}
    assert seen == [(2, 2)]


def test_it_takes_up_where_it_stopped(cases, done, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(done / "case-0", out / "case-0")
    before = (out / "case-0" / "diagnosis.json").stat().st_mtime_ns
    seen = []
    diagnose_cases(cases, out, 1, progress=lambda *p: seen.append(p))
    assert (out / "case-0" / "diagnosis.json").stat().st_mtime_ns == before
    assert seen == [(1, 2), (2, 2)]
    assert content(out) == content(done)


@pytest.fixture
def few_effects(monkeypatch) -> None:
    """Diagnose among one effect, where what is found does not matter."""
    few = {"force_offset": EFFECTS["force_offset"]}
    monkeypatch.setattr(batch, "diagnose", partial(diagnose, effects=few))


def test_a_case_that_fails_is_reported_and_leaves_nothing(cases, tmp_path, few_effects):
    bad = write_case(make_case(models=PULL_ONLY, n_lab=15, n_field=12), tmp_path / "bad")
    (bad / "lab.csv").unlink()
    failed = diagnose_cases([bad, cases[0]], tmp_path / "out", 1)
    assert list(failed) == ["bad"]
    assert "lab.csv" in failed["bad"]
    assert {p.name for p in (tmp_path / "out").iterdir() if p.is_dir()} == {"case-0"}
    assert json.loads((tmp_path / "out" / "failed.json").read_text()) == failed


def test_an_interruption_leaves_no_half_written_folder(cases, tmp_path, few_effects, monkeypatch):
    def stop(found, folder):
        (folder / "diagnosis.json").write_text("{")
        raise KeyboardInterrupt

    monkeypatch.setattr(batch, "write_diagnosis", stop)
    with pytest.raises(KeyboardInterrupt):
        diagnose_cases(cases[:1], tmp_path / "out", 1)
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["seconds.csv"]


def test_diagnoses_of_other_cases_are_not_taken_for_these(cases, done, tmp_path):
    made = make_case(models=PULL_ONLY, n_lab=15, n_field=12, seed=9)
    other = write_case(made, tmp_path / "case-0")
    with pytest.raises(CalibError, match="of other cases"):
        diagnose_cases([other], done, 1)
    with pytest.raises(CalibError, match="--seed 1, not 2"):
        diagnose_cases(cases, done, 2)
