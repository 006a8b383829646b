"""Comparing models: weights against an optimiser and ArviZ, and data whose model is known."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import minimize

import calib
from calib.data import hold_out, table_from_arrays
from calib.errors import CalibError
from calib.inference.calibration import Calibration, calibrate
from calib.inference.diagnostics import Gate
from calib.inference.likelihood import Noise
from calib.inference.priors import Priors
from calib.inference.problem import Problem
from calib.inference.sampler import SamplerSettings
from calib.models import MODELS
from calib.report.comparison import document, load_stack, write_comparison
from calib.validation import comparison
from calib.validation.comparison import (
    Comparison,
    NoisePreference,
    compare,
    compare_problems,
    noise_preference,
    stacking_weights,
    with_usual_noise,
)
from calib.validation.constants import N_DRAWS
from calib.validation.prediction import predict, predict_stacked
from calib.validation.validate import Validation, leave_one_out
from tests.custom_problems import normal, problem_of

SHARED = Path(__file__).resolve().parents[3] / "shared"
# Where what is asked does not need many draws.
FEW = SamplerSettings(steps=100, max_steps=100, gate=Gate(rhat_max=2, ess_min=0, taus_min=0))
PLATE = ("average_ground_pressure_kpa", "plate_width_mm", "rut_depth_mm")


def plates(seed: int, friction: float) -> calib.Table:
    """Sinkages by Reece's equation with a known part of friction, 10 % noise."""
    rng = np.random.default_rng(seed)
    pressure, width = (a.ravel() for a in np.meshgrid(np.geomspace(5, 80, 8), [50.0, 100.0, 300.0]))
    modulus = 60.0 * (1.0 - friction + friction * width / 100.0)
    depth = width * (pressure / modulus) ** (1.0 / 1.1)
    depth = depth * np.exp(0.1 * rng.standard_normal(depth.size))
    return table_from_arrays(dict(zip(PLATE, (pressure, width, depth), strict=True)))


@pytest.fixture(scope="module")
def frictional() -> Comparison:
    fitted, held = hold_out(plates(1, 1.0), "plate_width_mm", 100.0)
    return compare(["bekker", "reece", "bekker_plate"], fitted, 3, held_out=held, settings=FEW)


def test_weights_are_those_of_an_optimiser() -> None:
    rng = np.random.default_rng(2)
    elpd = rng.normal(-1.0, 1.0, (60, 3)) - np.array([0.0, 0.3, 2.5])
    found = stacking_weights(elpd)

    def loss(free: np.ndarray) -> float:
        weights = np.append(free, 1.0 - free.sum())
        return -float(np.log(np.clip(np.exp(elpd) @ weights, 1e-300, None)).sum())

    best = minimize(
        loss, [0.3, 0.3], method="SLSQP", bounds=[(0, 1)] * 2, options={"ftol": 1e-12},
        constraints={"type": "ineq", "fun": lambda w: 1.0 - w.sum()},
    )  # fmt: skip
    np.testing.assert_allclose(found[:2], best.x, atol=2e-4)
    assert found.sum() == pytest.approx(1.0)


def test_the_model_that_made_the_data_is_preferred(frictional: Comparison) -> None:
    """Bekker's plate has Reece's equation within it, and says the same of these plates."""
    assert frictional.sound
    assert frictional.differences["bekker"].clear
    assert frictional.differences["reece"].elpd < 0.2
    assert not frictional.differences["reece"].clear
    best = frictional.candidates[0].model
    assert frictional.sentence.startswith(f"The data prefer {best} to bekker.")
    assert frictional.weights["bekker"] < 0.05
    held = {c.model: c.held_elpd for c in frictional.candidates}
    assert held["reece"] > held["bekker"]


def test_leave_one_out_is_that_of_arviz(frictional: Comparison) -> None:
    import arviz as az

    from calib.inference.io import to_datatree

    best = frictional.candidates[0]
    theirs = az.loo(to_datatree(best.calibration), pointwise=True)
    # ArviZ smooths with the effective sample size, which weighs the tail a little otherwise.
    assert best.loo.elpd == pytest.approx(float(theirs.elpd), abs=0.1)


def test_models_that_say_the_same_are_not_told_apart() -> None:
    rows = plates(4, 0.0).columns
    # Of one width, Reece's and Bekker's equations are the same curve.
    one = table_from_arrays({**rows, "plate_width_mm": np.full(len(rows[PLATE[0]]), 100.0)})
    found = compare(["reece", "bekker_plate"], one, 5, settings=FEW)
    assert not found.differences[found.candidates[1].model].clear
    assert "cannot tell" in found.sentence


def test_unlike_models_are_refused() -> None:
    table = plates(1, 1.0)
    with pytest.raises(CalibError, match="nothing to compare in reece"):
        compare(["reece"], table)
    with pytest.raises(CalibError, match="different outputs"):
        compare(["reece", "magic_formula"], table)
    with pytest.raises(CalibError, match="there is no model"):
        compare(["reece", "rice"], table)


def test_a_stack_is_written_and_predicts(frictional: Comparison, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    folder.mkdir()
    written = write_comparison(frictional, folder, ["calib", "compare"], "plate_width_mm=100")
    assert json.loads((folder / "comparison.json").read_text()) == written
    numbers = document(frictional, "plate_width_mm=100")
    assert {key: written[key] for key in numbers} == numbers
    page = (folder / "index.html").read_text()
    assert frictional.sentence in page
    assert "held-out elpd" in page
    found, parts = load_stack(folder)
    assert found["converged"] is True
    used = {c.problem.bound.model.name for _, c in parts}
    assert used == {m for m, w in frictional.weights.items() if round(w * N_DRAWS) > 0}
    best = frictional.candidates[0].calibration
    at = frictional.candidates[0].loo.table
    stacked = predict_stacked([(0.5, best), (0.5, best)], at)
    plain = predict(best, at)
    # Quantiles of 4000 draws of one distribution and the other.
    np.testing.assert_allclose(stacked.predictive.median, plain.predictive.median, rtol=0.02)
    np.testing.assert_allclose(
        stacked.predictive.lower[0.9], plain.predictive.lower[0.9], rtol=0.04
    )


def test_no_error_is_stated_that_is_better_than_that_of_leave_one_out(
    frictional: Comparison,
) -> None:
    """A model without width is luckiest at the middle plate."""
    stated = document(frictional, "plate_width_mm=100")["models"]["bekker"]
    assert stated["held_out"]["rmse"] < stated["rmse"]
    trust = stated["verdict"]["trust"]
    (said,) = re.findall(r"to ([\d.]+) mm rms", trust)
    assert float(said) == pytest.approx(stated["rmse"], rel=0.05)
    assert "each row left out in turn (the held-out rows are easier" in trust


@pytest.mark.slow
def test_measured_plates_prefer_a_law_with_width() -> None:
    """Sand of which the smaller plates sank deeper: kc is below zero, as published for sands."""
    path = SHARED / "data" / "cmu_plate_sinkage.csv"
    if not path.exists():
        pytest.skip("the measured plate data are not here")
    with path.open() as file:
        measured = [r for r in csv.DictReader(file)
                    if r["element"] == "plate" and r["container"] == "large"]  # fmt: skip
    rows = []
    # Readings along a run depend on each other: four of each, spread over it.
    for run in sorted({r["run_id"] for r in measured}):
        own = [r for r in measured if r["run_id"] == run and float(r["pressure_kPa"]) > 1.0]
        rows += [own[i] for i in np.linspace(0, len(own) - 1, 4).round().astype(int)]
    keys = ("pressure_kPa", "plate_diameter_m", "sinkage_corrected_m")
    columns = [np.array([float(r[k]) for r in rows]) for k in keys]
    table = table_from_arrays(
        dict(zip(PLATE, (columns[0], 1e3 * columns[1], 1e3 * columns[2]), strict=True))
    )
    found = compare(["bekker", "bekker_plate", "reece"], table, 7)
    assert found.sound
    assert found.candidates[0].model == "bekker_plate"
    assert found.differences["bekker"].clear
    assert found.candidates[0].calibration.summary["share"].hdi_upper < 0.0


def test_no_shipped_model_is_chosen_for_the_papers_tables_but_its_own() -> None:
    from calib.he2019.embedded import he2019_tasks
    from calib.report.study import choose_model

    for task in he2019_tasks():
        assert choose_model(task.output, task.table) == task.model
        assert MODELS[task.model].cited == "He_2019"


def test_a_model_that_gives_a_row_no_density_is_refused(
    frictional: Comparison, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It would be infinitely worse, and its weight a division by nothing."""
    rows = np.array(frictional.candidates[1].rows)
    rows[2] = -np.inf
    impossible = replace(
        frictional.candidates[1], loo=replace(frictional.candidates[1].loo, elpd_rows=rows)
    )
    given = iter([frictional.candidates[0], impossible])
    monkeypatch.setattr(comparison, "_candidate", lambda *_: next(given))
    problems = [c.calibration.problem for c in frictional.candidates[:2]]
    with pytest.raises(CalibError, match=r"gives 1 of \d+ rows no density") as refused:
        compare_problems(problems, 1)
    assert f"line {problems[1].table.lines[2]}" in refused.value.where


# The noise of a calibration against normal noise

SLIP = np.linspace(0.0, 0.6, 40)
NOISE = Noise("student_t", "slip", "", "slip_ratio", float(SLIP.mean()), float(SLIP.std()))


def noisy_line(noise: np.ndarray) -> Problem:
    priors = [
        normal("a", 0.0, 3.0), normal("b", 0.0, 3.0), normal("nu", 2.0, 1.0, log=True),
        normal("sigma_slope", 0.0, 0.5), normal("sigma", -2.0, 1.0, log=True),
    ]  # fmt: skip
    usual = problem_of(
        lambda a, b, s: a + b * s, [*priors[:2], priors[-1]], SLIP, 1.0 + SLIP + noise
    )
    return replace(usual, noise=NOISE, priors=Priors(tuple(priors), noise=NOISE))


def calibrated(noise: np.ndarray) -> Calibration:
    return calibrate(noisy_line(noise), 3, settings=FEW)


def preference(calibration: Calibration, loo: Validation | None = None) -> NoisePreference:
    found = noise_preference(calibration, loo=loo, settings=FEW)
    assert found is not None
    return found


def test_the_noise_that_made_the_rows_is_preferred() -> None:
    rng = np.random.default_rng(3)
    z = (SLIP - SLIP.mean()) / SLIP.std()
    found = preference(calibrated(0.1 * np.exp(z) * rng.standard_t(2.0, 40)))
    assert found.preferred == "chosen"
    assert found.sentence.startswith("The data prefer Student-t noise that depends on slip to nor")
    assert f"{found.elpd:+.1f}" in found.sentence


@pytest.fixture(scope="module")
def steady() -> Calibration:
    return calibrated(0.1 * np.random.default_rng(4).standard_normal(40))


def test_normal_rows_need_no_other_noise(steady: Calibration) -> None:
    own = leave_one_out(steady, settings=FEW)
    found = preference(steady, own)
    assert found.preferred == "neither"
    assert abs(found.elpd) < 4.0
    # The difference is that of the two sums of leave-one-out.
    problem = with_usual_noise(steady.problem)
    assert problem.names == ("a", "b", "sigma")
    usual = calibrate(problem, 3, label=" normal noise", settings=FEW)
    expected = own.elpd - leave_one_out(usual, settings=FEW).elpd
    assert found.elpd == pytest.approx(expected, abs=0.1)
    # What has normal noise already is not compared.
    assert noise_preference(usual) is None


def test_one_row_that_decides_is_named(
    steady: Calibration, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = leave_one_out(steady, settings=FEW, refit=False)
    rows = np.array(own.elpd_rows)
    rows[20] -= 30.0
    monkeypatch.setattr(comparison, "leave_one_out", lambda *_, **__: replace(own, elpd_rows=rows))
    found = preference(steady, own)
    assert found.line == steady.problem.table.lines[20]
    assert f"More than half of that is line {found.line}" in found.sentence


@pytest.mark.parametrize(
    ("elpd", "se", "sound", "preferred"),
    [
        (10.0, 4.0, True, "chosen"), (10.0, 6.0, True, "neither"), (3.0, 0.1, True, "neither"),
        (-10.0, 4.0, True, "normal"), (10.0, 4.0, False, "unknown"),
    ],
)  # fmt: skip
def test_small_or_uncertain_differences_prefer_nothing(
    elpd: float, se: float, sound: bool, preferred: str
) -> None:
    found = NoisePreference(NOISE, elpd, se, sound)
    assert found.preferred == preferred
    assert found.sentence.endswith(".")
