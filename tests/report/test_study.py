"""Studies: what is calibrated on which rows, what becomes of a failure, summary and manifest."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import calib.report.study as study_module
from calib.batch.environment import Environment
from calib.data import read_table, table_from_arrays
from calib.data.quantities import OUTPUTS
from calib.data.reader import label_of
from calib.errors import CalibError
from calib.he2019 import embedded
from calib.he2019.embedded import he2019_tasks, load_he2019
from calib.he2019.published import PUBLISHED
from calib.inference.prior_files import default_priors
from calib.inference.sampler import SamplerSettings
from calib.models import example_csv
from calib.report.document import summarise
from calib.report.sections import Report, work_out
from calib.report.study import HoldOut, OutputResult, Study, choose_model, plan_tasks
from calib.report.writer import build_manifest
from tests.user_tables import pulls, table

# What a study is of

HELD = HoldOut("inflation_pressure_psi", 30.0)
PSI, GROUND, CONE = "inflation_pressure_psi", "average_ground_pressure_kpa", "cone_index_kpa"
MASS, VOLUME = "gravimetric_water_content", "volumetric_water_content"


@pytest.mark.parametrize(
    ("output", "columns", "model"),
    [
        ("drawbar_pull", {"slip_ratio": [0.1, 0.2]}, "magic_formula"),
        ("drawbar_pull", {"slip_ratio": [0.1, 0.2], PSI: [30, 30]}, "magic_formula"),
        ("drawbar_pull", {"slip_ratio": [0.1, 0.2], PSI: [18, 30]}, "magic_formula_pressure"),
        ("rut_depth", {GROUND: [100, 120]}, "bekker"),
        ("rut_depth", {"slip_ratio": [0.1, 0.1], GROUND: [100, 120]}, "bekker"),
        ("rut_depth", {"slip_ratio": [0.1, 0.2], GROUND: [100, 120]}, "modified_bekker"),
        ("rut_depth", {"slip_ratio": [0.1, 0.2], GROUND: [100, 100]}, "modified_bekker"),
        ("bulk_density", {CONE: [300, 400], MASS: [0.1, 0.2]}, "ayers_perumpral"),
        ("bulk_density", {CONE: [300, 400], VOLUME: [0.1, 0.2]}, "ayers_perumpral_volumetric"),
        ("bulk_density", {CONE: [3, 4], MASS: [0.1, 0.2], VOLUME: [0.1, 0.2]}, "ayers_perumpral"),
    ],
)
def test_the_columns_choose_the_model(output: str, columns, model: str) -> None:
    assert (
        choose_model(output, table(**{k: np.array(v, float) for k, v in columns.items()})) == model
    )


def test_among_models_that_use_the_same_the_one_of_fewest_parameters_is_chosen() -> None:
    lines = example_csv("wismer_luth").splitlines()
    rows = np.array([[float(cell) for cell in line.split(",")] for line in lines[1:]])
    table = table_from_arrays(dict(zip(lines[0].split(","), rows.T, strict=True)))
    assert choose_model("drawbar_pull", table) == "wismer_luth"
    # What is the same in all rows does not speak for a slower model, nor for one that needs it.
    soft = table.columns["cone_index_kpa"] == 600.0
    assert choose_model("drawbar_pull", table.take(soft)) == "upadhyaya"
    one = table.take(soft & (table.columns["normal_load_kn"] == 6.0))
    assert choose_model("drawbar_pull", one) == "magic_formula"
    with pytest.raises(CalibError, match="janosi_hanamoto: normal_stress_kpa, shear_displ"):
        choose_model("shear_stress", table)


def test_outputs_and_hold_outs_are_found_in_the_columns() -> None:
    nan = np.nan
    both = table(
        slip_ratio=np.linspace(0, 0.3, 6),
        average_ground_pressure_kpa=np.full(6, 100.0),
        drawbar_pull_kn=np.array([0.0, 0.2, nan, 0.4, 0.5, 0.5]),
        rut_depth_mm=np.array([nan, 20.0, 21.0, 22.0, 23.0, nan]),
    )
    tasks = plan_tasks([both])
    assert [(t.output, t.model, len(t.table), t.held_out) for t in tasks] == [
        ("drawbar_pull", "magic_formula", 5, None), ("rut_depth", "modified_bekker", 4, None),
    ]  # fmt: skip
    assert [t.output for t in plan_tasks([both], only=["rut_depth"])] == ["rut_depth"]
    density = table(
        "density.csv", cone_index_kpa=np.linspace(300, 900, 6),
        gravimetric_water_content=np.full(6, 0.1), bulk_density_g_cm3=np.linspace(1.4, 1.6, 6),
    )  # fmt: skip
    tasks = plan_tasks([pulls(), density], HELD)
    assert {t.output: t.held_out for t in tasks} == {"bulk_density": None, "drawbar_pull": HELD}
    tasks = he2019_tasks()
    assert [(t.output, t.held_out) for t in tasks] == list(
        zip(list(OUTPUTS)[:3], (None, HELD, HELD), strict=True)
    )
    assert all(t.table.label == "reconstructed" for t in tasks)


RUT = load_he2019("rut_depth")
LONG = {GROUND: np.linspace(100, 200, 5001), "slip_ratio": np.linspace(0, 0.2, 5001),
        "rut_depth_mm": np.linspace(20, 30, 5001)}  # fmt: skip


@pytest.mark.parametrize(
    ("tables", "held", "others", "words"),
    [
        ([table("a.csv", slip_ratio=np.array([0.1]))], None, {}, ["a.csv", "no output",
         "drawbar_pull_kn"]),
        ([table("a.csv", slip_ratio=np.array([0.1]), drawbr_pul_kn=np.array([1.0]))], None, {},
         ["no output", "did you mean drawbar_pull_kn?"]),
        ([table("a.csv", slp_ratio=np.array([0.1]), drawbar_pull_kn=np.array([1.0]))], None, {},
         ["no model", "did you mean slip_ratio?"]),
        ([pulls(source="a.csv"), pulls(source="b.csv")], None, {},
         ["a.csv, b.csv", "drawbar_pull"]),
        ([pulls()], HoldOut("speed_m_s", 1.0), {},
         ["my.csv", "speed_m_s", "inflation_pressure_psi"]),
        ([pulls()], HoldOut("spede", 1.0), {}, ["my.csv", "spede"]),
        ([pulls()], HoldOut("inflation_pressure_psi", 31.0), {}, ["my.csv", "31", "18, 30, 42"]),
        ([pulls()], HoldOut("inflation_pressure", 30.0), {}, ["inflation_pressure", "unit"]),
        ([pulls(psi=(30.0,))], HELD, {}, ["my.csv", "every row"]),
        ([table(slip_ratio=np.linspace(0, 0.3, 6), rut_depth_mm=np.linspace(20, 30, 6))], None, {},
         ["no model of rut_depth", "bekker: average_ground_pressure_kpa", "--only"]),
        ([RUT], None, {"models": ["bekker", "modified_bekker"]},
         ["two models are given for", "`calib compare bekker modified_bekker FILE`"]),
        ([RUT], None, {"models": ["bekker", "magic_formula"]},
         ["magic_formula is for drawbar_pull_kn", "give a file with drawbar_pull_kn"]),
        ([RUT], None, {"only": ["ruts"]}, ["no output 'ruts'", "rut_depth"]),
        ([table_from_arrays(LONG)], None, {}, ["too many for a report"]),
    ],
)  # fmt: skip
def test_what_cannot_be_planned_is_told_before_the_work(tables, held, others, words) -> None:
    with pytest.raises(CalibError) as caught:
        plan_tasks(tables, held, **others)
    for word in words:
        assert word in str(caught.value)


def test_models_and_priors_can_be_given(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(default_priors("bekker").read_text())
    assert plan_tasks([RUT])[0].model == "modified_bekker"
    (task,) = plan_tasks([RUT], models=["bekker"], prior_paths=[path])
    assert (task.model, task.prior_path) == ("bekker", path)
    assert plan_tasks([RUT], prior_paths=[path])[0].prior_path is None
    # What fails does not say where the priors lie.
    path.write_text(path.read_text().replace("sd_log = ", "sd_log = -"))
    error = work_out([task], 1).study.failures["rut_depth"].error
    assert "mine.toml, parameters." in error
    assert str(tmp_path) not in error
    path.write_text("x = 1\n")
    with pytest.raises(CalibError, match="which model"):
        plan_tasks([RUT], prior_paths=[path])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("inflation_pressure_psi=30", "inflation pressure 30 psi"),
        ("inflation_pressure_kpa=160", "inflation pressure 160 kPa"),
        ("bulk_density_g_cm3=1.5", "bulk density 1.5 g/cm^3"),
        ("pass_number=2", "pass number 2"),
        ("inflation_pressure_psi=18,30", "inflation pressure 18 and 30 psi"),
    ],
)
def test_a_hold_out_is_read_and_said(text: str, words: str) -> None:
    assert HoldOut.parse(text).words == words
    assert str(HoldOut.parse(text)).replace(" ", "") == text


# What was found


@pytest.fixture(scope="module")
def study() -> Study:
    """Rut depth and bulk density of the embedded data, and an output that cannot be had."""
    tasks = {task.output: task for task in he2019_tasks()}
    few = tasks["drawbar_pull"].table.take([0, 1])
    broken = replace(tasks["drawbar_pull"], table=few, held_out=None)
    return work_out([tasks["bulk_density"], broken, tasks["rut_depth"]], 2019).study


def test_estimates_are_of_the_rows_that_the_source_estimated_from(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """He et al. (2019): drawbar pull at all pressures, rut depth without the one in the middle."""
    rows: dict[str, int] = {}

    def counted(problem, *_):
        rows[problem.bound.model.name] = len(problem.table)
        return ()

    monkeypatch.setattr(study_module, "_all_methods", counted)
    tasks = {task.output: task for task in he2019_tasks()}
    for output in ("drawbar_pull", "rut_depth"):
        study_module.estimate_task(tasks[output], 1)
    pull, rut = tasks["drawbar_pull"], tasks["rut_depth"]
    assert rows["magic_formula_pressure"] == len(pull.table)
    outer = rut.table["inflation_pressure_psi"] != 30
    assert rows["modified_bekker"] == outer.sum() < len(rut.table)


def test_a_failure_leaves_the_others(study: Study, monkeypatch: pytest.MonkeyPatch) -> None:
    assert list(study.results) == ["bulk_density", "drawbar_pull", "rut_depth"]
    assert set(study.successes) == {"bulk_density", "rut_depth"}
    assert "2 rows cannot calibrate magic_formula_pressure" in study.failures["drawbar_pull"].error

    def fail(*args: object) -> OutputResult:
        raise error

    monkeypatch.setattr(study_module, "_work_out", fail)
    for error in (KeyError("x"), RuntimeError("x"), MemoryError("x")):
        found = work_out(he2019_tasks(), 1).study
        assert set(found.failures) == {t.output for t in he2019_tasks()}
        assert all(type(error).__name__ in f.error for f in found.failures.values())
    error = KeyboardInterrupt()
    with pytest.raises(KeyboardInterrupt):
        work_out(he2019_tasks(), 1)


def test_rut_depth_is_validated_on_30_psi_and_density_by_leaving_one_out(study: Study) -> None:
    rut, density = (study.successes[k] for k in ("rut_depth", "bulk_density"))
    assert rut.validation.method == "held_out"
    assert set(rut.validation.table["inflation_pressure_psi"]) == {30.0}
    assert set(rut.calibration.problem.table["inflation_pressure_psi"]) == {18.0, 42.0}
    assert density.validation.method == "leave_one_out"
    assert len(density.validation.observed) == len(density.task.table) == 36
    assert rut.prior_predictive.shape == (1000, 18)
    assert rut.posterior_predictive.shape == (4000, 18)
    # By the priors: sd of ln z about 1; by 18 rows: the noise, about 0.1.
    spread = [np.nanstd(np.log(d), axis=0).mean()
              for d in (rut.prior_predictive, rut.posterior_predictive)]  # fmt: skip
    assert spread[0] > 0.7
    assert spread[1] < 0.2
    regression = next(e for e in rut.estimates if e.method == "published_regression")
    for name, figure in PUBLISHED.rut_depth.estimates.items():
        assert figure.agrees(regression.reported[name]), name


def test_pressures_that_cannot_be_fitted_alone_are_left_out() -> None:
    """Six rows at one pressure, as many as parameters; a constant pull at another."""
    full = pulls()
    psi = full["inflation_pressure_psi"]
    columns = {name: np.array(v) for name, v in full.columns.items()}
    columns["drawbar_pull_kn"][psi == 42.0] = 0.3
    keep = np.ones(len(psi), dtype=bool)
    keep[np.flatnonzero(psi == 30.0)[6:]] = False
    tasks = plan_tasks([table(**columns).take(keep)])
    (task,) = tasks
    assert task.model == "magic_formula_pressure"
    found = study_module._each_alone(task, 1)
    assert set(found) == {18.0}
    assert {e.method for e in found[18.0]} >= {"least_squares", "genetic"}


def test_progress_names_what_is_done() -> None:
    seen: list[tuple[str, int, int]] = []
    task = next(t for t in he2019_tasks() if t.output == "rut_depth")
    work_out([task], 1, settings=SamplerSettings(steps=50, max_steps=50),
              progress=lambda *told: seen.append(told))  # fmt: skip
    assert {what for what, _, _ in seen} == {"rut_depth: estimating", "rut_depth: sampling"}
    last = {what: (done, planned) for what, done, planned in seen}
    assert all(done == planned for done, planned in last.values())


# Numbers for machines


def test_the_summary_carries_what_was_promised(study: Study) -> None:
    models = json.loads(json.dumps(summarise(study), allow_nan=False))["models"]
    assert list(models) == ["bulk_density", "drawbar_pull", "rut_depth"]
    assert set(models["drawbar_pull"]) == {"model", "error"}
    for key, result in study.successes.items():
        entry, calibration = models[key], result.calibration
        report, scores = calibration.draws.report, result.validation.scores
        for parameter, s in calibration.summary.items():
            found = entry["posterior"][parameter]
            stated = set(found) - {"posterior_to_prior_sd"}
            assert {name: found[name] for name in stated} == {n: getattr(s, n) for n in stated}
        assert entry["sampling"]["converged"] is True
        assert entry["sampling"]["steps"] == report.steps
        assert entry["sampling"]["gate"]["largest_rhat"] == max(report.rhat)
        assert entry["sampling"]["gate"]["smallest_ess_bulk"] == min(report.ess_bulk)
        assert entry["sampling"]["gate"]["smallest_steps_over_tau"] == min(
            report.steps / report.tau
        )
        for name, found in entry["data"]["ranges"].items():
            values = calibration.problem.table[name]
            assert (found["lower"], found["upper"]) == (values.min(), values.max())
        for name in ("n", "rmse", "crps", "max_relative_error"):
            assert entry["validation"][name] == getattr(scores, name)
        assert entry["validation"]["coverage"]["90"] == scores.coverage[0.9].proportion
        assert entry["estimates"] == {e.method: e.reported for e in result.estimates}
        assert entry["data"]["label"] == "reconstructed"
    assert models["rut_depth"]["data"]["held_out"] == "inflation_pressure_psi = 30"
    # A derived parameter has no prior of its own.
    assert models["rut_depth"]["posterior"]["k"]["posterior_to_prior_sd"] is None


def test_the_manifest_says_what_a_result_was_made_from(study: Study) -> None:
    inputs = {key: {"data": {"file": f"data/{key}.csv"}} for key in study.results}
    found = build_manifest(
        Report(study), SamplerSettings(max_steps=1000), ["calib", "report"], "",
        Environment.here(), inputs,
    )  # fmt: skip
    assert json.loads(json.dumps(found)) == found
    assert (found["command"], found["seed"]) == (["calib", "report"], 2019)
    assert found["settings"]["max_steps"] == 1000
    assert found["settings"]["gate"]["rhat_max"] == 1.01
    assert set(found["versions"]) >= {"python", "numpy", "emcee", "arviz"}
    # Table 2 of the source.
    assert [found["genetic_algorithm"][k] for k in ("F", "CP", "MP", "NP")] == [0.4, 0.6, 0.1, 50]
    task = found["tasks"]["rut_depth"]
    assert task["held_out"] == {"column": "inflation_pressure_psi", "value": 30.0}
    assert (task["label"], task["data"]) == ("reconstructed", {"file": "data/rut_depth.csv"})
    # Durations are in the manifest alone.
    assert set(found["seconds"]) == {"study", *study.successes}
    assert found["seconds"]["rut_depth"]["sample"] > 0.0
    assert set(found["seconds"]["rut_depth"]["methods"]) >= {"genetic", "least_squares"}
    assert "seconds" not in json.dumps(summarise(study))


def test_the_mode_is_stated_with_its_density(study: Study) -> None:
    rut = study.successes["rut_depth"]
    sampling = summarise(study)["models"]["rut_depth"]["sampling"]
    problem = rut.calibration.problem
    natural = np.array([list(sampling["mode"].values())])
    assert list(sampling["mode"]) == ["z_ref", "n0", "n1", "sigma"]
    t = problem.priors.to_internal(natural)
    assert problem.log_prob(t)[0] == pytest.approx(sampling["log_posterior_at_mode"], abs=1e-9)
    # A mode: nowhere near it is the density larger.
    around = t + 0.05 * np.random.default_rng(1).standard_normal((200, 4))
    assert problem.log_prob(around).max() < sampling["log_posterior_at_mode"]


# The embedded data are recognised


def test_the_embedded_data_are_recognised_in_a_file(tmp_path: Path) -> None:
    for path in embedded.write(tmp_path):
        read = read_table(path)
        assert read.label == "reconstructed"
        assert label_of(read.take([3, 1])) == "reconstructed"
        # Where a condition was changed, as a slip whose zero is another, the reading tells.
        path.write_text(path.read_text().replace("0.0", "0.1", 1))
        assert read_table(path).label == "reconstructed"
        *rows, last = path.read_text().splitlines()
        path.write_text("\n".join([*rows, last.rpartition(",")[0] + ",1.23"]))
        assert read_table(path).label == "partly reconstructed"


def test_readings_that_agree_by_chance_are_not_called_reconstructed() -> None:
    """Tables of 1 to 1000 rows, of 1 to 4 decimals, near the curves of the embedded data."""
    for seed in range(60):
        rng = np.random.default_rng(seed)
        n, places = int(rng.choice([1, 3, 40, 200, 1000])), int(rng.integers(1, 5))
        slip = rng.uniform(0.02, 0.5, n)
        pull = 5.0 * (0.62 * (1.0 - np.exp(-slip / 0.14)) - 0.06) + 0.3 * rng.standard_normal(n)
        columns = {
            "slip_ratio": slip, "inflation_pressure_psi": rng.choice([18.0, 30.0, 42.0], n),
            "drawbar_pull_kn": pull, "rut_depth_mm": rng.uniform(15.0, 60.0, n),
            "bulk_density_g_cm3": rng.uniform(1.7, 1.9, n),
        }  # fmt: skip
        made = {name: np.round(values, places) for name, values in columns.items()}
        assert table_from_arrays(made).label == "", seed


@pytest.mark.parametrize(("output", "copied"), [
    ("drawbar_pull", 20), ("rut_depth", 14), ("bulk_density", 14),
])  # fmt: skip
def test_rounded_copies_among_other_rows_are_recognised(output: str, copied: int) -> None:
    source, rng = load_he2019(output), np.random.default_rng(5)
    *_, reading = source
    # Rounded alone, and in another order.
    every = {**source.columns, reading: [float(f"{v:.4g}") for v in source[reading]]}
    assert table_from_arrays(every).label == "reconstructed"
    rows = rng.permutation(len(source))[:copied]
    columns = {name: [*source[name][rows], *rng.choice(source[name], 60)] for name in source}
    four = [float(f"{v:.4g}") for v in source[reading][rows]]
    ends = source[reading].min(), source[reading].max()
    columns[reading] = [*four, *np.round(rng.uniform(*ends, 60), 3)]
    assert table_from_arrays(columns).label == "partly reconstructed"


def test_other_readings_at_the_same_conditions_are_no_embedded_data() -> None:
    pull = load_he2019("drawbar_pull")
    noise = 0.03 * np.random.default_rng(1).standard_normal(len(pull))
    table = {n: pull[n] for n in ("inflation_pressure_psi", "slip_ratio")}
    own = table_from_arrays({**table, "drawbar_pull_kn": pull["drawbar_pull_kn"] + noise})
    assert own.label == ""
