"""Campaigns: the same on any number of workers, through kills, and never of mixed inputs."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import pytest

from calib.batch.campaign import read_plan, run_campaign
from calib.batch.campaign import run as run_module
from calib.errors import CalibError
from tests.batch.campaign.sites import N_CASES, NAMES, content, make_site, results

CASES_ONLY = '[[diagnose]]\nname = "sites"\ncases = ["cases/*"]\n'


def test_every_task_has_its_result(serial):
    assert results(serial) == sorted(NAMES)
    summary = json.loads((serial / "summary.json").read_text())
    assert summary["counts"] == {"done": len(NAMES), "failed": 0, "missing": 0}
    assert list(summary["tasks"]) == list(NAMES)
    found = summary["tasks"]["sites.cases-case-0"]
    assert (found["state"], found["numbers"]["first"]) == ("done", "force_offset")
    record = json.loads((serial / "results" / NAMES[1] / "task.json").read_text())
    assert set(record["inputs"]) == {"case.toml", "calibration", "field", "predict"}
    assert all(len(digest) == 64 for digest in record["inputs"].values())
    with (serial / "results" / "seconds.csv").open() as file:
        assert sorted(row[0] for row in csv.reader(file)) == sorted(NAMES)


def test_each_kind_has_a_table(serial):
    rows = {}
    for kind in ("fit", "diagnose", "sbc"):
        with (serial / f"{kind}.csv").open(newline="") as file:
            rows[kind] = list(csv.DictReader(file))
    assert [row["task"] for row in rows["diagnose"]] == list(NAMES[1 : N_CASES + 1])
    assert {row["state"] for kind in rows.values() for row in kind} == {"done"}
    fit = rows["fit"][0]
    assert fit["converged"] == "True"
    assert float(fit["posterior.n.hdi_lower"]) < float(fit["posterior.n.mean"])
    summary = json.loads((serial / "summary.json").read_text())
    numbers = summary["tasks"]["sites.cases-case-0"]["numbers"]
    assert float(rows["diagnose"][0]["probability"]) == numbers["probability"]


@pytest.mark.slow  # with workers that are killed the bytes are compared in every run
def test_two_workers_write_the_same_bytes(site, serial, tmp_path):
    run_campaign(read_plan(site), tmp_path / "two", workers=2)
    assert content(tmp_path / "two") == content(serial)


def test_nothing_is_done_twice(site, serial, tmp_path, monkeypatch):
    out = tmp_path / "out"
    shutil.copytree(serial, out)

    def refuse(item):
        raise AssertionError("done again")

    monkeypatch.setattr(run_module, "_work", refuse)
    seen = []
    run_campaign(read_plan(site), out, progress=lambda *p: seen.append(p))
    assert seen == [(len(NAMES), len(NAMES))]
    assert content(out) == content(serial)


@pytest.fixture
def own(tmp_path, monkeypatch) -> tuple[Path, Path]:
    """Plan of four cases, which a test may change and which are not diagnosed, and its folder."""

    def work(item):
        record = json.dumps(item[2])
        return {"numbers.json": "{}", "task.json": record}

    monkeypatch.setattr(run_module, "_work", work)
    return make_site(tmp_path / "site", CASES_ONLY, 4), tmp_path / "out"


def test_a_task_that_fails_is_listed_and_the_others_go_on(own):
    plan, out = own
    cases = plan.parent / "cases"
    text = (cases / "case-1" / "lab.csv").read_text()
    (cases / "case-1" / "lab.csv").unlink()
    (cases / "case-2" / "case.toml").write_text("[")
    summary = run_campaign(read_plan(plan), out)
    assert list(summary.failed) == [f"sites.cases-case-{i}" for i in (1, 2)]
    assert "lab.csv" in summary.failed["sites.cases-case-1"]
    assert "not valid TOML" in summary.failed["sites.cases-case-2"]
    document = json.loads((out / "summary.json").read_text())
    assert document["counts"] == {"done": 2, "failed": 2, "missing": 0}
    assert "lab.csv" in document["tasks"]["sites.cases-case-1"]["error"]
    with (out / "diagnose.csv").open(newline="") as file:
        assert [row["state"] for row in csv.DictReader(file)].count("failed") == 2
    (cases / "case-1" / "lab.csv").write_text(text)
    assert list(run_campaign(read_plan(plan), out).failed) == ["sites.cases-case-2"]


def test_an_interrupted_campaign_has_a_summary(own):
    plan, out = own

    def interrupt(done: int, planned: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt, match="2 of 4 results are kept"):
        run_campaign(read_plan(plan), out, progress=interrupt)
    counts = json.loads((out / "summary.json").read_text())["counts"]
    assert counts == {"done": 2, "failed": 0, "missing": 2}


def test_results_of_other_inputs_are_not_mixed_in(own):
    plan, out = own
    run_campaign(read_plan(plan), out)
    field = plan.parent / "cases" / "case-1" / "field.csv"
    field.write_text(field.read_text() + "\n")
    with pytest.raises(CalibError, match=r"sites\.cases-case-1 differs in field \(inputs\)"):
        run_campaign(read_plan(plan), out)
    before = {n: (out / "results" / n).stat().st_mtime_ns for n in results(out)}
    run_campaign(read_plan(plan), out, overwrite=True)
    after = {n: (out / "results" / n).stat().st_mtime_ns for n in results(out)}
    assert {n for n in after if after[n] != before[n]} == {"sites.cases-case-1"}
    run_campaign(read_plan(plan), out)


@pytest.mark.parametrize(
    ("change", "said"),
    [("seed = 8\n", "seed"), ("pages = true\n", r"pages \(settings\)"), ("", r"in .*versions")],
)
def test_results_of_another_plan_or_version_are_not_mixed_in(own, monkeypatch, change, said):
    plan, out = own
    run_campaign(read_plan(plan), out)
    plan.write_text(change + CASES_ONLY if "seed" in change else CASES_ONLY + change)
    if not change:
        monkeypatch.setattr(run_module, "versions", lambda: {"numpy": "0"})
    with pytest.raises(CalibError, match=f"differs in .*{said}" if change else said):
        run_campaign(read_plan(plan), out)


def test_a_folder_of_something_else_is_left_alone(site, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("x")
    with pytest.raises(CalibError, match="exists and is not empty"):
        run_campaign(read_plan(site), tmp_path / "mine")
    assert [p.name for p in (tmp_path / "mine").iterdir()] == ["thesis.txt"]
