"""The blind test from the command line: cases made, diagnosed, drawn again, scored."""

from __future__ import annotations

import json
from pathlib import Path

from tests.blind import BlindTest
from tests.commands import Calib


def test_cases_are_made_diagnosed_and_scored(calib: Calib) -> None:
    made = calib("challenge", "make", "--out", "cases", "--key", "sealed", "--seed", 8,
                 "--cases", 1, "--tier", "easy", "--workers", 1)  # fmt: skip
    assert made.code == 0, made.err
    assert made.out == "1 cases in cases, their answers in sealed\n"
    # A case that cannot be diagnosed is named, and does not stop the others.
    Path("cases/damaged").mkdir()
    Path("cases/damaged/case.toml").write_text("name = ")
    ran = calib("challenge", "run", "cases", "--out", "found", "--workers", 1)
    assert ran.code == 1
    assert "calib: damaged failed: " in ran.err
    assert ran.out == "1 of 2 cases diagnosed in found\n"
    (case,) = (p.name for p in Path("found").iterdir() if p.is_dir())
    scored = calib("challenge", "score", "cases", "--results", "found", "--key", "sealed",
                   "--out", "score")  # fmt: skip
    assert scored.code == 0, scored.err
    table = Path("score/score.txt").read_text()
    assert scored.out == f"{table}score\n"
    assert "calib: found: 1 cases have no answer and are not scored, one is damaged" in scored.err
    assert {p.name for p in Path("score").iterdir()} == {
        "score.txt", "levels.png", "reliability_easy.png"
    }  # fmt: skip
    assert (Path("found") / case / "diagnosis.json").exists()
    given = ("challenge", "score", "cases", "--results", "found", "--key", "sealed")
    told = json.loads(calib(*given, "--json").out)
    assert (told["exit_code"], told["folder"]) == (0, None)
    assert told["tiers"]["easy"]["n_cases"] == 1
    assert [answer["case"] for answer in told["answers"]] == [case]
    again = json.loads(calib("challenge", "run", "cases", "--out", "found", "--json").out)
    assert (again["exit_code"], again["cases"], set(again["failed"])) == (1, 2, {"damaged"})


def test_cases_are_drawn_again_as_the_diagnosis_believes(
    calib: Calib,
    blind_test: BlindTest,
    believed_test: BlindTest,
) -> None:
    given = ("challenge", "well-specified", blind_test.cases, "--key", blind_test.key)
    drawn = calib(*given, "--out", "cases", "--out-key", "answers", "--workers", 1)
    assert drawn.code == 0, drawn.err
    assert drawn.out.startswith("well-specified cases in cases;")
    names = {p.name for p in blind_test.cases.iterdir() if p.is_dir()}
    assert {p.name for p in Path("cases").iterdir() if p.is_dir()} == names
    # The same seed, the same cases and answers.
    for mine, other in (("cases", believed_test.cases), ("answers", believed_test.key)):
        assert {p.name for p in Path(mine).iterdir()} == names
        for path in filter(Path.is_file, Path(mine).rglob("*")):
            assert path.read_bytes() == (other / path.relative_to(mine)).read_bytes()
