"""Measured cases can be read and calibrated, and are marked as a hand would mark them."""

from __future__ import annotations

import csv
import json
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from calib.errors import CalibError
from calib.gap.case import read_case
from calib.gap.constants import MIN_FIELD_ROWS
from calib.gap.effects import EFFECTS
from calib.gap.effects.base import View
from calib.inference.problem import build_problem
from calib.models import MODELS
from calib.models.magic_formula import magic_formula
from challenge.answers import FAILED, read_answer
from challenge.measured.__main__ import run
from challenge.measured.cases import HERE, NONE, UNLISTED, MeasuredCase, read_cases
from challenge.measured.marks import documented, markdown, wrong
from challenge.seal import open_answers

CASES = read_cases()
PAGE = Path(__file__).parents[2] / "reports" / "challenge" / "measured.md"
REPORT, _, SECOND = PAGE.read_text(encoding="utf-8").partition("\n## The 53 of the second draw")
FIRST = [c for c in CASES if f"\n| {c.name} |" in REPORT]
LATER = [c for c in CASES if c not in FIRST]
READINGS = ("drift", "gain", "offset", "step")


def named(name: str) -> MeasuredCase:
    """Return a case by its name."""
    return next(c for c in CASES if c.name == name)


@pytest.mark.parametrize("case", CASES, ids=lambda c: c.name)
def test_a_case_can_be_calibrated_and_predicted(
    case: MeasuredCase, tmp_path: Path, simulators: None
) -> None:
    case.write(tmp_path / "case", tmp_path / "answers")
    read = read_case(tmp_path / "case")
    lab, field = read.lab, read.field
    assert len(field) >= MIN_FIELD_ROWS
    for model in case.models.values():
        problem = build_problem(model, lab)
        drawn = problem.theta(problem.priors.sample(np.random.default_rng(1), 20))
        for table in (lab, field):
            conditions = problem.bound.model.select(table.columns)
            predicted = problem.bound.mean_response(problem.of_model(drawn), conditions)
            # A soil may be too soft for the wheel; a row must not be beyond the model.
            assert np.isfinite(predicted).any(axis=0).all()


def test_the_tyre_s_curve_is_the_magic_formula_over_the_load(simulators: None) -> None:
    named_parameters = {
        "mu": 1.4, "k": 0.3, "mu_falls": 0.2, "k_falls": 0.4, "C": 1.3, "G": 2.0, "G_falls": 0.5,
        "G_sides": 0.25, "Sh": 0.1, "Sv": 0.02,
    }  # fmt: skip
    model = MODELS["belt_cornering"]
    angle, load = np.array([-6.0, -1.0, 0.5, 4.0]), np.array([1.0, 2.0, 3.0, 2.0])
    theta = np.array([[named_parameters[p] for p in model.parameters]])
    predicted = model.predict(theta, {"steering_angle_deg": angle, "normal_load_kn": load})
    for x, w, force in zip(angle, load, predicted[0], strict=True):
        peak, slope = 1.4 * w * (w / 2) ** -0.2, 0.3 * w * (w / 2) ** -0.4
        curvature = 1 - 2 * (w / 2) ** -0.5 * np.exp(0.25 if x > 0.1 else -0.25)
        by_hand = magic_formula(x, slope / (1.3 * peak), 1.3, peak, curvature, 0.1, 0.02 * w)
        assert force == pytest.approx(float(by_hand), rel=1e-9)


def test_written_cases_hold_no_answer(tmp_path: Path) -> None:
    named("hit_lugs").write(tmp_path / "case", tmp_path / "answers")
    text = "".join(p.read_text(encoding="utf-8") for p in (tmp_path / "case").iterdir())
    assert "lug" not in text
    assert "rut_depth" not in text
    assert "slip_ratio" in text


def test_documented_causes_have_names_of_the_list_and_a_source(simulators: None) -> None:
    sources = (HERE / "SOURCES.md").read_text(encoding="utf-8")
    for path in (HERE / "cases").glob("*.toml"):
        assert f"| `{tomllib.loads(path.read_text(encoding='utf-8'))['source']}` |" in sources
    other = {NONE, UNLISTED, "parameter_shift"}
    for case in CASES:
        readings = {f"{output}_{kind}" for output in case.models for kind in READINGS}
        for name in (case.expected, *case.defensible):
            condition = name.removeprefix("depends_on_").removesuffix("_bias")
            recorded = condition != name and any(c.startswith(condition) for c in case.field[0])
            assert name in other | readings or name in EFFECTS or recorded, case.name


def test_a_wrong_reading_is_the_right_one_with_the_error_that_is_told() -> None:
    zeroed = {row["run_order"]: _pull_n(row) for row in _series("cmu_runs", "smooth_30_b")}
    case = named("cmu_zero_smooth_30")
    assert zeroed.keys().isdisjoint(row["run_order"] for row in case.lab)
    errors = [_pull_n(row) - zeroed[row["run_order"]] for row in case.field]
    assert errors == pytest.approx([1.37, 1.37, 1.37, 1.26, 1.26], abs=0.01)
    deepest = (
        max(float(row["rut_depth_mm"]) for row in rows)
        for rows in (named("cmu_compliance_100").field, _series("cmu_plate_raw", "corrected_100_3"))
    )
    force_n = 28e3 * np.pi * 0.05**2
    assert next(deepest) - next(deepest) == pytest.approx(1.27e-2 * force_n, rel=0.02)


def _pull_n(row: dict[str, str]) -> float:
    return 1000.0 * float(row["drawbar_pull_kn"])


def _series(table: str, name: str) -> list[dict[str, str]]:
    with (HERE / "data" / f"{table}.csv").open(encoding="utf-8", newline="") as file:
        return [row for row in csv.DictReader(file) if row["series"] == name]


def test_drag_is_what_integration_of_the_motion_gives(simulators: None) -> None:
    drag, times = EFFECTS["air_drag"], np.linspace(0.3, 3.0, 10)
    area, coefficient, gravity = 8.0, 0.47, 9.81

    def motion(_: float, y: Any) -> list[float]:
        return [y[1], gravity - 0.5 * 1.2 * coefficient / area * y[1] ** 2]

    solved = solve_ivp(motion, (0.0, 3.0), [0.0, 0.0], t_eval=times, rtol=1e-8, atol=1e-8)
    view = View({"mass_per_area_kg_m2": np.full(10, area)}, {}, 5.0, 1.0, (0.0, 1.0))
    free = 0.5 * gravity * times[None, :] ** 2
    found = drag.on_output(np.array([[coefficient]]), "fall_distance", free, view)
    assert found[0] == pytest.approx(solved.y[0], rel=1e-5)


def test_a_third_was_set_aside_by_the_draw_that_is_told() -> None:
    rng = np.random.default_rng(20261123)
    drawn: set[str] = set()
    for null in (False, True):
        names = sorted(c.name for c in FIRST if (c.expected == NONE) == null)
        drawn |= set(rng.choice(names, len(names) // 3, replace=False))
    assert {c.name for c in FIRST if c.set_aside} == drawn


def test_a_series_that_is_not_there_is_refused(tmp_path: Path) -> None:
    (tmp_path / "cases").mkdir()
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "a.csv").write_text("series,slip_ratio\none,0.1\n")
    (tmp_path / "cases" / "a.toml").write_text(
        'data = "a.csv"\nlab = ["one"]\nfield = ["two"]\n[models]\n[answer]\n'
    )
    with pytest.raises(CalibError, match="there is no series two"):
        read_cases(tmp_path)


def said(inclusion: dict[str, float], remainder: float, verdict: str) -> dict[str, Any]:
    """Return a diagnosis."""
    return {
        "verdict": verdict,
        "effects": [{"name": "some", "probability": 1.0}],
        "inclusion": {name: {"probability": p} for name, p in inclusion.items()},
        "remainder": {"probability": remainder},
    }


def test_marks_are_those_of_a_hand(tmp_path: Path) -> None:
    diagnoses = {
        "hit_lugs": said({"lug_thrust": 0.7, "force_offset": 0.95}, 0.2, "effect"),
        "cmu_side_15": said({"lug_thrust": 0.3}, 0.6, "unknown"),
        "cmu_plate_size": said(
            {"depends_on_plate_width": 0.4, "parameter_shift": 0.6}, 0, "effect"
        ),
        "trec_null": said({"force_offset": 0.5}, 0.1, "ambiguous"),
        "kls_null_plate": None,
    }
    marks = []
    for name, diagnosis in diagnoses.items():
        folder = tmp_path / "results" / name
        folder.mkdir(parents=True)
        if diagnosis:
            (folder / "diagnosis.json").write_text(json.dumps(diagnosis))
        named(name).write(tmp_path / "cases" / name, tmp_path / "answers")
        answers = open_answers(tmp_path / "cases", tmp_path / "answers")
        marks.append(read_answer(name, answers[name], folder))
    right, unlisted, size, alarm, failed = marks
    assert [documented(a) for a in (right, unlisted, size)] == [0.7, 0.6, 0.4]
    assert [(c.name, c.probability) for c in wrong(right, 0.9)] == [("force_offset", 0.95)]
    assert wrong(unlisted, 0.5) == wrong(size, 0.5) == []  # parameter_shift is defensible there
    assert [c.name for c in wrong(alarm, 0.5)] == ["force_offset"]
    assert failed.verdict == FAILED
    lines = markdown(marks, [named(name) for name in diagnoses]).splitlines()
    assert [line.split("|")[2].strip() for line in lines[2:6]] == ["2/3", "2/5", "1/5", "2/2"]
    row = "| cmu_side_15 | unlisted | 3.4 | unknown, some | 0.60 | lug_thrust 0.30 (1) | 0.60 |"
    assert row in lines


def test_it_does_not_write_over_a_folder_nor_run_what_is_set_aside_by_name(tmp_path: Path) -> None:
    with pytest.raises(CalibError, match="there already"):
        run(tmp_path, only=["trec_null"])
    aside = next(c.name for c in CASES if c.set_aside)
    with pytest.raises(CalibError, match=f"no such case: {aside}"):
        run(tmp_path / "new", only=[aside])
    assert not (tmp_path / "new").exists()


@pytest.mark.slow
def test_the_command_diagnoses_and_marks(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    table = run(tmp_path / "out", only=["trec_null"])
    assert "| no gap, and a verdict other than none | 0/1 |" in table
    assert (tmp_path / "out" / "measured.md").read_text(encoding="utf-8") == table


def test_the_stored_report_keeps_what_was_set_aside_apart() -> None:
    worked_on, heading, set_aside = REPORT.partition("\n## The seven that were set aside")
    assert heading
    assert len(FIRST) == 22
    assert sum(case.set_aside for case in FIRST) == 7
    for case in FIRST:
        row = f"\n| {case.name} |"
        assert (row in set_aside, row in worked_on) == (case.set_aside, not case.set_aside)


def test_of_the_second_draw_half_is_set_aside_and_the_other_half_reported() -> None:
    rng = np.random.default_rng(20261129)
    drawn = set[str]()
    for null, size in ((False, 21), (True, 5)):
        names = sorted(c.name for c in LATER if (c.expected == NONE) == null)
        drawn |= set(rng.choice(names, size, replace=False))
    assert {c.name for c in LATER if c.set_aside} == drawn
    assert {c.name for c in LATER if f"\n| {c.name} |" in SECOND} == {
        c.name for c in LATER if not c.set_aside
    }
