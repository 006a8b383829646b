"""Measured cases can be read and calibrated, and are marked as a hand would mark them."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib.batch.user_code import run_file
from calib.data import read_table
from calib.errors import CalibError
from calib.gap.constants import MIN_FIELD_ROWS
from calib.gap.effects import EFFECTS
from calib.inference.problem import build_problem
from calib.models import MODELS
from challenge.answers import FAILED, read_answer
from challenge.measured.__main__ import run
from challenge.measured.cases import HERE, NONE, UNLISTED, MeasuredCase, read_cases
from challenge.measured.marks import documented, markdown, wrong
from challenge.seal import open_answers

CASES = read_cases()
REPORT = Path(__file__).parents[2] / "reports" / "measured.md"


def named(name: str) -> MeasuredCase:
    """Return a case by its name."""
    return next(c for c in CASES if c.name == name)


@pytest.fixture(scope="module")
def traction() -> Iterator[None]:
    """Register the bench's own simulator, and take it back."""
    module = run_file(HERE / "traction.py", "models")
    if "janosi_traction" not in MODELS:
        MODELS.add(module.MODEL)
    yield
    MODELS.discard("janosi_traction")


@pytest.mark.parametrize("case", CASES, ids=lambda c: c.name)
def test_a_case_can_be_calibrated_and_predicted(
    case: MeasuredCase, tmp_path: Path, traction: None
) -> None:
    case.write(tmp_path / "case", tmp_path / "answers")
    lab, field = (read_table(tmp_path / "case" / f"{part}.csv") for part in ("lab", "field"))
    assert len(field) >= MIN_FIELD_ROWS
    for model in case.models.values():
        problem = build_problem(model, lab)
        drawn = problem.theta(problem.priors.sample(np.random.default_rng(1), 20))
        for table in (lab, field):
            conditions = problem.bound.model.select(table.columns)
            predicted = problem.bound.mean_response(problem.of_model(drawn), conditions)
            # A soil may be too soft for the wheel; a row must not be beyond the model.
            assert np.isfinite(predicted).any(axis=0).all()


def test_written_cases_hold_no_answer(tmp_path: Path) -> None:
    named("hit_lugs").write(tmp_path / "case", tmp_path / "answers")
    text = "".join(p.read_text(encoding="utf-8") for p in (tmp_path / "case").iterdir())
    assert "lug" not in text
    assert "rut_depth" not in text
    assert "slip_ratio" in text


def test_documented_causes_have_names_of_the_list_and_a_source() -> None:
    sources = (HERE / "SOURCES.md").read_text(encoding="utf-8")
    for path in (HERE / "cases").glob("*.toml"):
        assert f"| `{tomllib.loads(path.read_text(encoding='utf-8'))['source']}` |" in sources
    other = {NONE, UNLISTED, "parameter_shift"}
    for case in CASES:
        for name in (case.expected, *case.defensible):
            condition = name.removeprefix("depends_on_")
            recorded = condition != name and any(c.startswith(condition) for c in case.field[0])
            assert name in other or name in EFFECTS or recorded, case.name


def test_a_third_was_set_aside_by_the_draw_that_is_told() -> None:
    rng = np.random.default_rng(20261123)
    drawn: set[str] = set()
    for null in (False, True):
        names = sorted(c.name for c in CASES if (c.expected == NONE) == null)
        drawn |= set(rng.choice(names, len(names) // 3, replace=False))
    assert {c.name for c in CASES if c.set_aside} == drawn


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
    worked_on, heading, set_aside = REPORT.read_text(encoding="utf-8").partition(
        "\n## The seven that were set aside"
    )
    assert heading
    assert sum(case.set_aside for case in CASES) == 7
    for case in CASES:
        row = f"\n| {case.name} |"
        assert (row in set_aside, row in worked_on) == (case.set_aside, not case.set_aside)
