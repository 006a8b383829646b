"""Studies: results of each output, what becomes of a failure, the summary and the manifest."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import calib.report.study as study_module
from calib.batch.environment import Environment, sha256
from calib.data import read_table, table_from_arrays, write_table
from calib.data.reader import label_of
from calib.he2019 import embedded
from calib.he2019.designs import he2019_tasks
from calib.he2019.embedded import load_he2019
from calib.he2019.published import PUBLISHED
from calib.inference.prior_files import default_priors
from calib.inference.sampler import SamplerSettings
from calib.report.document import summarise
from calib.report.sections import Report, work_out
from calib.report.study import Failure, OutputResult, Study, Task, plan_tasks
from calib.report.writer import build_manifest, file_hashes
from tests.user_tables import pulls, table


@pytest.fixture(scope="module")
def study() -> Study:
    """Rut depth and bulk density of the embedded data, and an output that cannot be had."""
    tasks = {task.output: task for task in he2019_tasks()}
    few = tasks["drawbar_pull"].table.take([0, 1])
    broken = replace(tasks["drawbar_pull"], table=few, held_out=None)
    return work_out([tasks["bulk_density"], broken, tasks["rut_depth"]], 2019).study


def test_an_output_column_without_a_value_fails_alone() -> None:
    empty = table(
        slip_ratio=np.array([0.1, 0.2]),
        average_ground_pressure_kpa=np.array([100.0, 120.0]),
        rut_depth_mm=np.full(2, np.nan),
    )
    (task,) = plan_tasks([empty])
    found = work_out([task], 1).study.failures["rut_depth"]
    assert "0 rows cannot calibrate" in found.error


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


# Results


def test_a_failure_leaves_the_others(study: Study) -> None:
    assert list(study.results) == ["bulk_density", "drawbar_pull", "rut_depth"]
    assert set(study.failures) == {"drawbar_pull"}
    assert set(study.successes) == {"bulk_density", "rut_depth"}
    assert "2 rows cannot calibrate magic_formula_pressure" in study.failures["drawbar_pull"].error


@pytest.mark.parametrize("error", [KeyError("x"), RuntimeError("x"), MemoryError("x")])
def test_any_error_of_one_output_leaves_the_others(
    error: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*args: object) -> OutputResult:
        raise error

    monkeypatch.setattr(study_module, "_work_out", fail)
    found = work_out(he2019_tasks(), 1).study
    assert set(found.failures) == {t.output for t in he2019_tasks()}
    assert all(type(error).__name__ in f.error for f in found.failures.values())


def test_an_interruption_is_no_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*args: object) -> OutputResult:
        raise KeyboardInterrupt

    monkeypatch.setattr(study_module, "_work_out", interrupt)
    with pytest.raises(KeyboardInterrupt):
        work_out(he2019_tasks(), 1)


def test_rut_depth_is_validated_on_30_psi_and_density_by_leaving_one_out(study: Study) -> None:
    rut, density = (study.results[k] for k in ("rut_depth", "bulk_density"))
    assert isinstance(rut, OutputResult)
    assert isinstance(density, OutputResult)
    assert rut.validation.method == "held_out"
    assert set(rut.validation.table["inflation_pressure_psi"]) == {30.0}
    assert set(rut.calibration.problem.table["inflation_pressure_psi"]) == {18.0, 42.0}
    assert density.validation.method == "leave_one_out"
    assert len(density.validation.observed) == len(density.task.table) == 36
    assert rut.prior_predictive.shape == (1000, 18)
    assert rut.posterior_predictive.shape == (4000, 18)
    assert rut.by_pressure == {}


def test_the_prior_predictive_is_wide_and_the_posterior_predictive_is_not(study: Study) -> None:
    rut = study.results["rut_depth"]
    assert isinstance(rut, OutputResult)
    prior, posterior = (
        np.nanstd(np.log(draws), axis=0).mean()
        for draws in (rut.prior_predictive, rut.posterior_predictive)
    )
    # By the priors: sd of ln z about 1; by 18 rows: the noise, about 0.1.
    assert prior > 0.7
    assert posterior < 0.2


def test_the_published_regression_comes_out(study: Study) -> None:
    rut = study.results["rut_depth"]
    assert isinstance(rut, OutputResult)
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
    document = summarise(study)
    models = document["models"]
    assert list(models) == ["bulk_density", "drawbar_pull", "rut_depth"]
    assert set(models["drawbar_pull"]) == {"model", "error"}
    for key in ("bulk_density", "rut_depth"):
        entry = models[key]
        result = study.results[key]
        assert isinstance(result, OutputResult)
        for parameter, s in result.calibration.summary.items():
            found = entry["posterior"][parameter]
            for name in ("mean", "sd", "hdi_lower", "hdi_upper", "ess_bulk", "ess_tail", "rhat"):
                assert found[name] == getattr(s, name)
            for name in ("mcse_mean", "mcse_median", "mcse_hdi_lower", "mcse_hdi_upper"):
                assert found[name] == getattr(s, name)
        report = result.calibration.draws.report
        gate = entry["sampling"]["gate"]
        assert gate["largest_rhat"] == max(report.rhat)
        assert gate["smallest_ess_bulk"] == min(report.ess_bulk)
        assert gate["smallest_ess_tail"] == min(report.ess_tail)
        assert gate["smallest_steps_over_tau"] == min(report.steps / report.tau)
        assert set(entry["priors"]) == {p.name for p in result.calibration.problem.priors.entries}
        for name, found in entry["data"]["ranges"].items():
            values = result.calibration.problem.table[name]
            assert (found["lower"], found["upper"]) == (values.min(), values.max())
            assert found["distinct"] == len(set(values.tolist()))
        sensitivity = entry["prior_sensitivity"]["parameters"]
        assert set(sensitivity) == set(entry["posterior"])
        for parameter, reaction in result.sensitivity.items():
            assert sensitivity[parameter]["prior"] == reaction.prior
            assert sensitivity[parameter]["identified"] is reaction.identified
        assert set(entry["validation"]["coverage"]) == {"50", "90", "95"}
        scores = result.validation.scores
        for name in ("n", "rmse", "crps", "max_relative_error"):
            assert entry["validation"][name] == getattr(scores, name)
        assert entry["validation"]["coverage"]["90"] == scores.coverage[0.9].proportion
        assert entry["sampling"]["converged"] is True
        assert entry["sampling"]["ensembles"] >= 4
        assert entry["sampling"]["steps"] == result.calibration.draws.report.steps
        for e in result.estimates:
            assert entry["estimates"][e.method] == e.reported
        assert entry["data"]["label"] == "reconstructed"
    assert models["rut_depth"]["data"]["held_out"] == "inflation_pressure_psi = 30"
    assert models["bulk_density"]["validation"]["refits_not_converged"] == []


def test_the_summary_is_strict_json(study: Study) -> None:
    text = json.dumps(summarise(study), allow_nan=False)

    def numbers(value):
        if isinstance(value, dict):
            for v in value.values():
                yield from numbers(v)
        elif isinstance(value, list):
            for v in value:
                yield from numbers(v)
        elif isinstance(value, float):
            yield value

    assert all(math.isfinite(x) for x in numbers(json.loads(text)))
    # A derived parameter has no prior of its own.
    posterior = json.loads(text)["models"]["rut_depth"]["posterior"]
    assert posterior["k"]["posterior_to_prior_sd"] is None


def test_the_manifest_says_what_a_result_was_made_from(study: Study, tmp_path: Path) -> None:
    inputs = {key: {"data": {"file": f"data/{key}.csv"}} for key in study.results}
    settings = SamplerSettings(max_steps=1000)
    found = build_manifest(
        Report(study), settings, ["calib", "report"], "", Environment.here(), inputs
    )
    assert json.loads(json.dumps(found)) == found
    assert found["command"] == ["calib", "report"]
    assert found["seed"] == 2019
    assert found["settings"]["max_steps"] == 1000
    assert found["settings"]["gate"]["rhat_max"] == 1.01
    assert set(found["versions"]) >= {"python", "numpy", "emcee", "arviz"}
    # Table 2 of the source.
    assert [found["genetic_algorithm"][k] for k in ("F", "CP", "MP", "NP")] == [0.4, 0.6, 0.1, 50]
    task = found["tasks"]["rut_depth"]
    assert task["held_out"] == {"column": "inflation_pressure_psi", "value": 30.0}
    assert task["label"] == "reconstructed"
    assert task["data"] == {"file": "data/rut_depth.csv"}


def test_durations_are_in_the_manifest_alone(study: Study) -> None:
    inputs = {key: {} for key in study.results}
    seconds = build_manifest(Report(study), SamplerSettings(), [], "", Environment.here(), inputs)[
        "seconds"
    ]
    assert seconds["study"] == study.seconds
    assert set(seconds) == {"study", *study.successes}
    assert seconds["rut_depth"]["sample"] > 0.0
    assert set(seconds["rut_depth"]["methods"]) >= {"genetic", "least_squares"}
    assert "seconds" not in json.dumps(summarise(study))


def test_the_mode_is_stated_with_its_density(study: Study) -> None:
    rut = study.results["rut_depth"]
    assert isinstance(rut, OutputResult)
    sampling = summarise(study)["models"]["rut_depth"]["sampling"]
    problem = rut.calibration.problem
    natural = np.array([list(sampling["mode"].values())])
    assert list(sampling["mode"]) == ["z_ref", "n0", "n1", "sigma"]
    t = problem.priors.to_internal(natural)
    assert problem.log_prob(t)[0] == pytest.approx(sampling["log_posterior_at_mode"], abs=1e-9)
    # A mode: nowhere near it is the density larger.
    around = t + 0.05 * np.random.default_rng(1).standard_normal((200, 4))
    assert problem.log_prob(around).max() < sampling["log_posterior_at_mode"]


def test_a_failure_does_not_say_where_the_priors_lie(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(default_priors("bekker").read_text().replace("sd_log = ", "sd_log = -"))
    (task,) = plan_tasks([load_he2019("rut_depth")], models=["bekker"], prior_paths=[path])
    error = work_out([task], 1).study.failures["rut_depth"].error
    assert "mine.toml, parameters." in error
    assert str(tmp_path) not in error


def test_hashes_are_of_every_file_but_the_manifest(tmp_path: Path) -> None:
    (tmp_path / "figures").mkdir()
    (tmp_path / "figures" / "a.png").write_bytes(b"abc")
    (tmp_path / "manifest.json").write_text("{}")
    # FIPS 180-2, appendix B.1.
    digest = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert file_hashes(tmp_path) == {"figures/a.png": digest}
    assert sha256(b"abc") == digest


def test_failures_and_tasks_are_plain_records() -> None:
    task = Task("rut_depth", "bekker", pulls())
    assert Failure(task, "x").task is task


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


def test_embedded_data_are_recognised_in_other_units_and_rounded(tmp_path: Path) -> None:
    pull = load_he2019("drawbar_pull")
    for name, values in (
        ("Drawbar pull [N]", 1e3 * pull["drawbar_pull_kn"]),
        ("drawbar_pull_kn", np.array([float(f"{v:.4g}") for v in pull["drawbar_pull_kn"]])),
    ):
        path = tmp_path / "renamed.csv"
        kept = {n: pull[n] for n in ("inflation_pressure_psi", "slip_ratio")}
        write_table(path, {**kept, name: values})
        assert read_table(path).label == "reconstructed"


def test_readings_that_agree_by_chance_are_not_called_reconstructed() -> None:
    """Tables of 1 to 1000 rows, of 1 to 4 decimals, near the curves of the embedded data."""
    for seed in range(300):
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
