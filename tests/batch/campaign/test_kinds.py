"""Kinds of task: a campaign's result is that of the verb it stands for."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from calib.batch.campaign import read_plan, run_campaign
from calib.check.check import check
from calib.data import hold_out, read_table
from calib.errors import CalibError
from calib.gap.batch import diagnose_cases
from calib.he2019.datasets import embedded
from calib.inference.calibration import calibrate
from calib.inference.estimators import estimate
from calib.inference.io import load_calibration
from calib.inference.problem import build_problem
from calib.inference.random import generator
from calib.models import example_csv
from calib.validation.sbc.run import run_sbc
from calib.validation.validate import validate_held_out
from challenge.make import make
from tests.batch.campaign.sites import EFFECT, NAMES, WIND, content, refuse_all


def test_a_diagnosis_is_that_of_the_verb(site, serial, tmp_path):
    name = "sites.cases-case-0"
    seed = read_plan(site).tasks[name].seed
    diagnose_cases([site.parent / "cases" / "case-0"], tmp_path, seed)
    expected = content(tmp_path / "case-0")
    found = content(serial / "results" / name)
    assert {k: found[k] for k in expected} == expected
    assert set(found) - set(expected) == {"numbers.json", "task.json"}


def test_a_challenge_case_is_that_of_the_verb(site, serial, tmp_path):
    make(tmp_path / "cases", tmp_path / "key", seed=5, n_cases=1, tiers=("easy",))
    case = serial / "results" / "blind.case-000" / "case"
    seed = read_plan(site).tasks["blind.case-000"].seed
    diagnose_cases([tmp_path / "cases" / "case-000"], tmp_path / "out", seed)
    expected = content(tmp_path / "out" / "case-000")
    found = content(case.parent)
    assert {k: found[k] for k in expected} == expected
    truth = json.loads((tmp_path / "key").read_text())["cases"]["case-000"]["truth"]
    numbers = json.loads((case.parent / "numbers.json").read_text())
    assert numbers["truth"] == truth
    assert numbers["right_first"] == (numbers["first"] == truth)
    probability = {
        e["name"]: e["probability"] for e in json.loads(found["diagnosis.json"])["effects"]
    }
    # With or without something unlisted besides.
    told = sum(p for name, p in probability.items() if name.removesuffix("+unknown") == truth)
    assert numbers["truth_probability"] == pytest.approx(told)


def test_a_replicate_is_that_of_the_verb(serial, tmp_path):
    run_sbc(tmp_path, models=["bekker"], simulations=2, seed=3)
    for i in range(2):
        expected = json.loads((tmp_path / "replicates" / f"bekker-000{i}.json").read_text())
        found = serial / "results" / f"ranks.bekker-000{i}"
        assert json.loads((found / "replicate.json").read_text()) == expected
        numbers = json.loads((found / "numbers.json").read_text())
        assert numbers["converged"] is expected["converged"]
        for name, (rank, draws) in expected["ranks"].items():
            assert numbers["rank"][name] == rank / draws


def test_a_replicate_of_no_model_is_refused(tmp_path):
    plan = tmp_path / "plan.toml"
    plan.write_text('[[sbc]]\nname = "a"\nsimulations = 1\ndraw_seed = 1\nmodels = ["bekkar"]\n')
    with pytest.raises(CalibError, match="bekkar") as refused:
        read_plan(plan)
    assert "[[sbc]], models" in str(refused.value)


def test_a_fit_is_that_of_the_verb(site, serial):
    name = NAMES[0]
    task = read_plan(site).tasks[name]
    problem = build_problem("bekker", read_table(site.parent / "data" / "rut.csv"))
    point = estimate(problem, "least_squares", generator(task.seed, "bekker", "least_squares"))
    expected = calibrate(problem, task.seed, estimates=(point,))
    found = load_calibration(serial / "results" / name / "run")
    np.testing.assert_allclose(found.draws.t, expected.draws.t, rtol=1e-12, atol=1e-12)
    numbers = json.loads((serial / "results" / name / "numbers.json").read_text())
    assert numbers["posterior"]["n"]["mean"] == expected.summary["n"].mean
    assert numbers["posterior"]["n"]["unit"] == "1"
    assert numbers["converged"] is True


@pytest.fixture
def folder(tmp_path) -> Path:
    (tmp_path / "rut.csv").write_text(example_csv("bekker"))
    return tmp_path


def run(folder: Path, text: str) -> dict[str, object]:
    (folder / "plan.toml").write_text(text)
    summary = run_campaign(read_plan(folder / "plan.toml"), folder / "out")
    assert summary.failed == {}
    return dict(summary.numbers)


def test_rows_held_out_are_scored_and_posteriors_can_be_left_out(folder):
    table = read_table(folder / "rut.csv")
    column = "average_ground_pressure_kpa"
    value = float(np.unique(table[column])[1])
    numbers = run(
        folder,
        f"""
        [[fit]]
        name = "a"
        data = ["*.csv"]
        models = ["bekker"]
        hold_out = ["{column}={value}"]
        posteriors = false
        """,
    )
    ((name, found),) = numbers.items()
    assert sorted(p.name for p in (folder / "out" / "results" / name).iterdir()) == [
        "numbers.json", "task.json",
    ]  # fmt: skip
    fitted, held = hold_out(table, column, value)
    seed = read_plan(folder / "plan.toml").tasks[name].seed
    problem = build_problem("bekker", fitted)
    point = estimate(problem, "least_squares", generator(seed, "bekker", "least_squares"))
    scores = validate_held_out(calibrate(problem, seed, estimates=(point,)), held).scores
    assert found["held_out"]["rmse"] == scores.rmse
    assert found["held_out"]["rows"] == len(held)


def test_the_embedded_data_are_called_reconstructed(folder):
    embedded.write(folder / "he2019")
    text = '[[fit]]\nname = "a"\ndata = ["he2019/rut*.csv"]\nmodels = ["bekker"]\n'
    ((name, _),) = run(folder, text).items()
    found = check(folder / "out" / "results" / name / "run", quick=True)
    assert found.same, found.verdict


def test_a_posterior_that_did_not_converge_is_named(folder, monkeypatch):
    refuse_all(monkeypatch)
    (folder / "plan.toml").write_text(
        '[[fit]]\nname = "a"\ndata = ["*.csv"]\nmodels = ["bekker"]\nmax_steps = 100\n'
    )
    summary = run_campaign(read_plan(folder / "plan.toml"), folder / "out")
    assert summary.unconverged == ("a.rut.bekker.shipped.nothing",)


def test_effects_and_pages_of_ones_own(site, tmp_path):
    (tmp_path / "my_effects.py").write_text(EFFECT)
    (tmp_path / "wind.toml").write_text(WIND)
    case = site.parent / "cases" / "case-1"
    numbers = run(
        tmp_path,
        f"""
        [[diagnose]]
        name = "a"
        cases = ["{case}"]
        effects = "my_effects.py"
        pages = true
        """,
    )
    ((name, _),) = numbers.items()
    results = tmp_path / "out" / "results" / name
    assert "wind" in {
        e["name"] for e in json.loads((results / "diagnosis.json").read_text())["effects"]
    }
    assert "<html" in (results / "index.html").read_text()[:500]
    assert list((results / "figures").glob("*.png"))
    inputs = json.loads((results / "task.json").read_text())["inputs"]
    assert {"effects", "effects, wind.toml"} <= set(inputs)
