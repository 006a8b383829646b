"""Kinds of task: a campaign's result is that of the verb it stands for."""

from __future__ import annotations

import json
import pickle
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from calib.batch.campaign import read_plan, run_campaign
from calib.batch.campaign.kinds import KINDS
from calib.batch.folders import check_folder
from calib.checking.check import check
from calib.cli.prediction import prepare_case
from calib.data import hold_out, read_table
from calib.gap.batch import diagnose_cases
from calib.gap.case import read_case
from calib.gap.diagnose import diagnose
from calib.he2019 import embedded
from calib.inference.calibration import calibrate
from calib.inference.emulation.prepared import emulated
from calib.inference.estimators import estimate
from calib.inference.io import load_calibration
from calib.inference.problem import build_problem
from calib.inference.random import generator
from calib.models import MODELS, example_csv, get_model
from calib.models.simulators.declaration import SIMULATED
from calib.models.simulators.emulator import emulator_of, load_emulator
from calib.models.simulators.files import register_file
from calib.validation.replicate import Item, replicate
from calib.validation.sbc import SETTINGS
from tests.batch.campaign.sites import EFFECT, NAMES, WIND, content, refuse_all
from tests.models.simulators.examples import lab, pull, write_program


def test_a_diagnosis_is_that_of_the_verb(site, serial, tmp_path):
    name = "sites.cases-case-0"
    seed = read_plan(site).tasks[name].seed
    diagnose_cases([site.parent / "cases" / "case-0"], tmp_path, seed)
    expected = content(tmp_path / "case-0")
    found = content(serial / "results" / name)
    assert {k: found[k] for k in expected} == expected
    assert set(found) - set(expected) == {"numbers.json", "task.json"}


def test_a_replicate_is_that_of_the_verb(serial):
    expected = json.loads(json.dumps(replicate(Item("bekker", 0, 3, SETTINGS))))
    found = serial / "results" / "ranks.bekker-0000"
    assert json.loads((found / "replicate.json").read_text()) == expected
    numbers = json.loads((found / "numbers.json").read_text())
    assert numbers["converged"] is expected["converged"]
    for name, (rank, draws) in expected["ranks"].items():
        assert numbers["rank"][name] == rank / draws


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


def write_columns(path: Path, columns: dict[str, np.ndarray]) -> None:
    rows = zip(*(v.tolist() for v in columns.values()), strict=True)
    text = "\n".join([",".join(columns), *(",".join(map(str, row)) for row in rows)])
    path.write_text(text + "\n")


@pytest.fixture
def wheel(tmp_path) -> Iterator[Path]:
    """The file of a simulator that has to be emulated, with its data beside it."""
    write_columns(tmp_path / "lab.csv", lab(np.random.default_rng(1)))
    (tmp_path / "own.py").write_text(
        "import numpy as np\ndef f(theta, x):\n    return 1000 * theta[:, :1] * x['w'] * "
        "(1 - np.exp(-x['s'] / 100 / theta[:, 1:2]))\n"
    )
    path = write_program(tmp_path, name='"campaign_wheel"', run="", python='"own.py:f"')
    yield path
    for registry in (MODELS, SIMULATED):
        registry.discard("campaign_wheel")


@pytest.mark.slow
def test_a_slow_simulator_is_emulated_where_the_campaign_is_started(wheel, tmp_path):
    found = register_file(wheel)
    text = '[[fit]]\nname = "a"\ndata = ["lab.csv"]\nmodels = ["campaign_wheel"]\n'
    numbers = run(tmp_path, text)
    ((name, told),) = numbers.items()
    task = read_plan(tmp_path / "plan.toml").tasks[name]
    assert task.settings["simulators"] == {"campaign_wheel": found.simulator.digest}
    problem = build_problem("campaign_wheel", read_table(tmp_path / "lab.csv"))
    emulation = emulated(problem, 2019)  # the seed of `calib fit`, whose runs are the same
    assert told["emulator"]["runs"] == len(emulation.runs)
    assert told["emulator"]["passed"] is told["converged"] is True
    # What is sent to a worker has the emulator with it, and asks nothing of the simulator.
    item = pickle.loads(pickle.dumps(KINDS["fit"].load(task)))
    SIMULATED.discard("campaign_wheel")
    assert KINDS["fit"].work(item, task.seed)[0] == told
    kept = tmp_path / "out" / "results" / name
    assert json.loads((kept / "emulation.json").read_text())["campaign_wheel"][0]["passed"]
    assert (kept / "run" / "emulator.npz").exists()


@pytest.mark.slow
def test_cases_of_a_slow_simulator_are_diagnosed_side_by_side(wheel, tmp_path):
    """Each with an emulator of its own, which does not stay behind."""
    register_file(wheel)
    for i, off in enumerate((0.97, 1.0)):
        case = tmp_path / "cases" / f"case-{i}"
        case.mkdir(parents=True)
        (case / "lab.csv").write_bytes((tmp_path / "lab.csv").read_bytes())
        columns = lab(np.random.default_rng(2))
        true = columns | {"slip_ratio": 1.0 - (1.0 - columns["slip_ratio"]) / off}
        y = pull(np.array([[0.6, 0.08]]), true)[0]
        y += 0.03 * np.random.default_rng(3).standard_normal(y.size)
        write_columns(case / "field.csv", columns | {"drawbar_pull_kn": y})
        (case / "case.toml").write_text(
            'calibration = "lab.csv"\nfield = "field.csv"\n'
            '[models]\ndrawbar_pull = "campaign_wheel"\n'
        )
    numbers = run(tmp_path, '[[diagnose]]\nname = "a"\ncases = ["cases/*"]\n')
    shifted, same = numbers["a.cases-case-0"], numbers["a.cases-case-1"]
    assert shifted["first"] == "slip_zero_shift"
    assert same["first"] == "none"
    for told in (shifted, same):
        assert told["emulator"]["campaign_wheel"]["passed"]
    assert emulator_of(get_model("campaign_wheel")) is None
    kept = tmp_path / "out" / "results" / "a.cases-case-0"
    model, _ = load_emulator(kept / "emulators" / "campaign_wheel.npz")
    assert model == "campaign_wheel"
    # With the runs that are kept the verb gives the same.
    case = read_case(tmp_path / "cases" / "case-0")
    seed = read_plan(tmp_path / "plan.toml").tasks["a.cases-case-0"].seed
    prepare_case(case, None, seed, 1)
    found = diagnose(case, seed)
    assert found.ranking.probability["slip_zero_shift"] == pytest.approx(
        shifted["probability"], abs=0.02
    )


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
    ((name, found),) = run(
        folder,
        f"""
        [[fit]]
        name = "a"
        data = ["*.csv"]
        models = ["bekker"]
        hold_out = ["{column}={value}"]
        posteriors = false
        max_steps = 100
        """,
    ).items()
    files = sorted(p.name for p in (folder / "out" / "results" / name).iterdir())
    assert files == ["numbers.json", "task.json"]
    fitted, held = hold_out(table, column, value)
    assert (found["rows"], found["held_out"]["rows"]) == (len(fitted), len(held))
    assert min(found["held_out"]["crps"], found["held_out"]["rmse"]) > 0.0


def test_the_embedded_data_are_called_reconstructed(folder):
    embedded.write(folder / "he2019")
    text = '[[fit]]\nname = "a"\ndata = ["he2019/rut*.csv"]\nmodels = ["bekker"]\n'
    ((name, _),) = run(folder, text).items()
    found = check(folder / "out" / "results" / name / "run", quick=True)
    assert found.exit_code == 0, found.verdict


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
    for name in ("numbers.json", "task.json"):
        (results / name).unlink()
    check_folder(results, overwrite=True)  # as the verb writes it, it may be replaced
