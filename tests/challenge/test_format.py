"""The open format: ten examples follow it, faults are all told, other programs take part."""

from __future__ import annotations

import json
import re
import shutil
import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib.data.documents import read_numbers
from calib.errors import CalibError
from calib.gap.validator import faults
from challenge.answers import read_answer
from challenge.board import line, markdown, named_folders, write_board
from challenge.format import Answer, read_document
from challenge.format import faults as of_others
from challenge.measured.cases import read_cases
from challenge.programs import run_programs
from challenge.score import Proportion, score
from tests.commands import Calib
from tests.docs.pages import DOCS

FORMATS = DOCS / "formats"
CASES = sorted((FORMATS / "cases").iterdir())
ANSWERS = FORMATS / "answers"
PAGE = (FORMATS / "cases.md").read_text(encoding="utf-8")


def rival(folder: Path, name: str) -> Path:
    """Write a program of the page to a folder."""
    text = re.search(rf":caption: {re.escape(name)}\n\n(.*?)```", PAGE, re.S)
    assert text is not None
    (folder / name).write_text(text.group(1), encoding="utf-8")
    return folder / name


@pytest.fixture
def case(tmp_path: Path) -> Path:
    """Return a copy of an example, to be spoilt."""
    return shutil.copytree(CASES[0], tmp_path / CASES[0].name)


def test_ten_examples_have_answers_and_no_faults() -> None:
    assert len(CASES) == 10
    for folder in CASES:
        answer = ANSWERS / folder.name / "answer.json"
        assert [*map(str, faults(folder)), *map(str, of_others(folder, answer, None))] == []
        said, _ = read_document(answer, Answer)
        assert said.salt
        assert said.fresh_truth.keys() == said.noise_sd.keys()


def test_simulations_of_the_examples_are_the_calibrated_simulators() -> None:
    for folder in CASES:
        answer, _ = read_document(ANSWERS / folder.name / "answer.json", Answer)
        without = (answer.model_extra or {})["fresh_without"]
        for path in folder.glob("simulated_*.csv"):
            truth = np.array(without[path.stem.removeprefix("simulated_")])
            names = [f"predict_{row}" for row in range(truth.size)]
            mean = np.stack([*read_numbers(path, names, 20).values()]).mean(axis=1)
            # Rows in another order, or another unit, would miss by more than the truth varies.
            assert np.std(mean - truth) < 0.5 * np.std(truth), path


@pytest.mark.usefixtures("simulators")
def test_measured_cases_follow_the_format(tmp_path: Path) -> None:
    left_out = 0
    for measured in read_cases():
        folder, answers = tmp_path / "cases" / measured.name, tmp_path / "answers"
        measured.write(folder, answers, leave_out=4)
        answer = answers / measured.name / "answer.json"
        assert [*map(str, faults(folder)), *map(str, of_others(folder, answer, None))] == []
        said, _ = read_document(answer, Answer)
        for output, values in said.fresh_truth.items():
            readings = [row for row in measured.field if row not in _rows(folder / "field.csv")]
            assert len(readings) == len(values), output
            left_out += len(values)
    assert left_out > 50


def _rows(path: Path) -> list[dict[str, str]]:
    names, *rows = (text.split(",") for text in path.read_text(encoding="utf-8").splitlines())
    return [dict(zip(names, row, strict=True)) for row in rows]


def schemas() -> Any:
    """Return the module that makes the schemas of the documentation."""
    sys.path.insert(0, str(DOCS / "_ext"))
    try:
        spec = spec_from_file_location("declared_schemas", DOCS / "_ext" / "declared_schemas.py")
        assert spec is not None
        assert spec.loader is not None
        module = module_from_spec(spec)
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(DOCS / "_ext"))
        sys.modules.pop("result_schemas", None)
    return module


def test_the_committed_schemas_are_those_of_the_code() -> None:
    made = schemas().open_format()
    stored = {p.name: p.read_text(encoding="utf-8") for p in (FORMATS / "schemas").iterdir()}
    # `python docs/_ext/declared_schemas.py` writes them.
    assert {name: json.loads(text) for name, text in stored.items()} == {
        name: json.loads(text) for name, text in made.items()
    }


def test_another_validator_agrees_with_the_schemas() -> None:
    jsonschema = pytest.importorskip("jsonschema")
    stored = {p.stem: json.loads(p.read_bytes()) for p in (FORMATS / "schemas").iterdir()}
    for schema in stored.values():
        jsonschema.Draft202012Validator.check_schema(schema)
    for path in ANSWERS.glob("*/answer.json"):
        jsonschema.validate(json.loads(path.read_bytes()), stored["answer"])
    block = re.search(r"```json\n(.*?)```", PAGE, re.S)
    assert block is not None
    shown = json.loads(block.group(1))
    jsonschema.validate(shown, stored["diagnosis"])
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate({**shown, "effects": []}, stored["diagnosis"])


def test_every_key_of_the_format_is_told() -> None:
    told = set(re.findall(r"`(\w+)`|^(\w+) = |\[(\w+)\]", PAGE, re.M))
    words = {word for found in told for word in found if word}
    for path in (FORMATS / "schemas").iterdir():
        assert set(json.loads(path.read_bytes())["properties"]) <= words, path.name


def test_all_faults_of_a_case_are_told_at_once_with_their_places(case: Path) -> None:
    text = (case / "case.toml").read_text(encoding="utf-8")
    text = re.sub('answer_sha256 = ".*"', 'answer_sha256 = "ab"', text)
    (case / "case.toml").write_text(f"colour = 3\n{text}", encoding="utf-8")
    lines = (case / "field.csv").read_text(encoding="utf-8").splitlines()
    lines[2], lines[9] = lines[2].replace(",", ",x", 1), lines[9] + ",1"
    (case / "field.csv").write_text("\n".join(lines), encoding="utf-8")
    (case / "fresh.csv").unlink()
    shutil.copy(ANSWERS / case.name / "answer.json", case)
    said = "\n".join(map(str, faults(case)))
    for words in (
        "case.toml, colour: ", "case.toml, answer_sha256: ", "64 digits",
        "field.csv, line 3, column", "field.csv, line 10: the row has",
        "fresh.csv: there is no such file", "the answer lies in the case",
    ):  # fmt: skip
        assert words in said
    with pytest.raises(CalibError, match="cannot be read"):
        faults(case.parent)


def test_a_simulator_takes_part_by_what_it_predicts(case: Path) -> None:
    path = case / "case.toml"
    text = re.sub('drawbar_pull = "magic.*"', 'drawbar_pull = "our_own"', path.read_text())
    path.write_text(text)
    assert faults(case) == []
    simulated = case / "simulated_drawbar_pull.csv"
    simulated.write_text(simulated.read_text().replace("field_3,", "field_x,"))
    (fault,) = faults(case)
    assert "there is no column field_3" in str(fault)
    path.write_text(re.sub("(?m)^drawbar_pull = .simulated.*$", "", text))
    (fault,) = faults(case)
    assert "there is no model 'our_own'" in str(fault)


def test_the_command_checks_a_case_its_answer_and_a_diagnosis(run: Calib, case: Path) -> None:
    good = run("validate", case, "--answer", ANSWERS / case.name / "answer.json")
    assert (good.code, good.out) == (0, f"{case}: no faults\n")
    answer = ANSWERS / CASES[1].name / "answer.json"
    Path("said").mkdir()
    said = {
        "verdict": "maybe",
        "effects": [{"name": "none", "probability": 1.4}],
        "where": [{"output": "drawbar_pull", "row": -1, "probability": 0.5}],
    }
    Path("said/diagnosis.json").write_text(json.dumps(said))
    bad = run("validate", case, "--answer", answer, "--diagnosis", "said")
    assert bad.code == 1
    for words in (
        "its SHA-256 is",
        "verdict = 'maybe' is not",
        "effects.0.probability",
        "where.0.row",
    ):
        assert words in bad.out
    said = {"verdict": "none", "effects": [{"name": "none", "probability": 0.9}]}
    said["where"] = [{"output": "drawbar_pull", "row": 999, "probability": 0.5}]
    Path("said/diagnosis.json").write_text(json.dumps(said))
    found = json.loads(run("validate", case, "--diagnosis", "said", "--json").out)
    assert "sum to 0.9, not 1" in found["faults"][0]
    said["effects"] = [{"name": "none", "probability": 1.0}]
    Path("said/diagnosis.json").write_text(json.dumps(said))
    Path("said/fresh_prediction.csv").write_text("drawbar_pull_kn_after\n1\n")
    found = json.loads(run("validate", case, "--diagnosis", "said", "--json").out)
    told = "\n".join(found["faults"])
    assert "the case has no row 999 of drawbar_pull" in told
    assert "there is no column drawbar_pull_kn_before" in told
    assert "1 rows, not" in told


def test_other_programs_take_part_and_are_on_the_board(tmp_path: Path) -> None:
    silent, offset = (rival(tmp_path, name) for name in ("rival.sh", "rival.py"))
    chosen = [c for c in CASES if "drawbar_pull" in (c / "case.toml").read_text()][:3]
    cases = tmp_path / "cases"
    for folder in chosen:
        shutil.copytree(folder, cases / folder.name)
        shutil.copytree(ANSWERS / folder.name, tmp_path / "answers" / folder.name)
    folders = sorted(cases.iterdir())
    given = {"limit": 60.0}
    assert run_programs(f"sh {silent} {{case}} {{out}}", folders, tmp_path / "a", **given) == {}
    command = f"{sys.executable} {offset} {{case}} {{out}}"
    assert run_programs(command, folders, tmp_path / "b", **given) == {}
    found = {n: score(cases, tmp_path / n, tmp_path / "answers") for n in ("a", "b")}
    assert found["a"].warnings == found["b"].warnings == ()
    lines = {name: line(one) for name, one in found.items()}
    truths = [a.truth for a in found["a"].answers]
    nulls = truths.count("none")
    causes = sum(len(t.split("+")) for t in truths if t != "none")
    assert lines["a"].silent == Proportion(nulls, nulls)
    assert lines["a"].named == Proportion(0, causes)
    assert lines["a"].missed_by.value == 1.0
    assert lines["b"].before.n >= 3
    assert all(one.seconds.n == 3 for one in lines.values())
    page = tmp_path / "page.md"
    page.write_text("# Ours\n\nSaid by hand.\n", encoding="utf-8")
    for section in ("simulated", "again", "simulated"):
        write_board(page, section, found)
    text = page.read_text(encoding="utf-8")
    assert text.startswith("# Ours\n\nSaid by hand.\n")
    assert text.count(markdown(lines, 3)) == 2
    assert text.count("- Causes named") == 1
    assert (tmp_path / "board_simulated.png").stat().st_size > 5000


def test_a_program_that_fails_is_told_and_counts_as_wrong(tmp_path: Path) -> None:
    programs = {
        "exit": ("exit 3", "exit code 3"),
        "slow": ("sleep 60", "longer than 0.5 s"),
        "nothing": ("true", "diagnosis.json: it cannot be read"),
        "wrong": ('echo "{}" > $2/diagnosis.json', "2 problems"),
    }
    for name, (does, why) in programs.items():
        (tmp_path / name).write_text(does + "\n", encoding="utf-8")
        command = f"sh {tmp_path / name} {{case}} {{out}}"
        failed = run_programs(command, CASES[:1], tmp_path / f"out-{name}", limit=0.5)
        assert why in failed[CASES[0].name]
        answer, _ = read_document(ANSWERS / CASES[0].name / "answer.json", Answer)
        found = read_answer(CASES[0].name, answer, tmp_path / f"out-{name}" / CASES[0].name)
        assert found.verdict == "failed"
        assert why in found.problem
    # A Python of an environment has its packages.
    command = f"{sys.executable} -c 'import numpy' {{case}} {{out}}"
    (why,) = run_programs(command, CASES[:1], tmp_path / "numpy", limit=60.0).values()
    assert "diagnosis.json: it cannot be read" in why
    with pytest.raises(CalibError, match="of another program"):
        run_programs("other {case} {out}", CASES[:1], tmp_path / "out-exit", limit=1.0)
    with pytest.raises(CalibError, match=r"there is no \{out\}"):
        run_programs("other {case}", CASES[:1], tmp_path / "new", limit=1.0)
    assert not (tmp_path / "new").exists()


def test_results_are_named() -> None:
    assert named_folders(["a=x/b", "y/c"]) == {"a": Path("x/b"), "c": Path("y/c")}


def of_measured(tmp_path: Path, said: dict[str, Any], **more: Any) -> Any:
    content = {"schema": "calib/answer/1", "tier": "measured", **more}
    (tmp_path / "diagnosis.json").write_text(json.dumps(said), encoding="utf-8")
    return read_answer("case", Answer.model_validate(content), tmp_path)


def test_a_measured_cause_is_scored_by_its_name_alone(tmp_path: Path) -> None:
    said = {
        "verdict": "effect",
        "effects": [
            {"name": "lug_thrust+unknown", "probability": 0.5},
            {"name": "force_offset", "probability": 0.3},
            {"name": "none", "probability": 0.2},
        ],
    }
    found = of_measured(tmp_path, said, truth="lug_thrust", defensible=["force_offset"])
    assert {c.name: (c.probability, c.acts) for c in found.causes} == {
        "lug_thrust": (0.5, True), "unknown": (0.5, False), "force_offset": (0.3, None),
    }  # fmt: skip
    assert found.right == {"lug_thrust", "force_offset", "force_offset+lug_thrust"}
    assert found.truth_probability == pytest.approx(0.8)
    assert (found.auc, found.shrinks, found.predictions) == (None, (), ())
    null = of_measured(tmp_path, said, truth="none")
    assert (null.right, null.truth_probability) == ({"none"}, 0.2)
    unlisted = of_measured(tmp_path, said, truth="unknown")
    assert [c.name for c in unlisted.causes if c.acts] == ["unknown"]
