"""Folders of `calib diagnose`: made again from the case they keep; tampering is found and named."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from calib.checking.check import check
from calib.checking.compare import Status
from calib.cli.app import app
from calib.errors import CalibError
from calib.he2019.gaps import paper_gaps, write_cases
from tests.check.conftest import Change, edit_json, findings, in_text, swap_figures
from tests.gap_files import SOFT_PATCH

pytestmark = pytest.mark.usefixtures("computed_once")

DIAGNOSIS, CASE = "diagnosis.json", "case/case.toml"
CONTEXT = "\n[context]\nsuspected = {slip_sinkage = 0.6}\nexcluded = ['force_offset']\n"
CONTEXT += "[context.sizes.slip_sinkage]\ngrowth = {mean = 2.0, sd = 1.0}\n"


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A diagnosis of a case that has names of its own and a context."""
    root = tmp_path_factory.mktemp("diagnosis")
    write_cases([gap for gap in paper_gaps() if gap.name == "plain_bekker"], root)
    case = (root / "plain_bekker").rename(root / "mine")
    (case / "field.csv").rename(case / "my campaign.csv")
    text = (case / "case.toml").read_text().replace('"field.csv"', '"my campaign.csv"')
    # Conditions to predict at have whole numbers, and a column that no model knows.
    header, *rows = (case / "fresh.csv").read_text().splitlines()
    rows = [f"{header},note", *(f"{row.replace('.0,', ',', 1)},dry" for row in rows)]
    (case / "fresh.csv").write_text("\n".join(rows) + "\n")
    (case / "case.toml").write_text(text + CONTEXT)
    words = ["diagnose", str(case), "--out", str(root / "found"), "--workers", "1"]
    ran = CliRunner().invoke(app, words)
    assert ran.exit_code == 0, ran.output
    return root / "found"


@pytest.fixture
def diagnosis(original: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(original, tmp_path / "found"))


def test_an_untouched_diagnosis_is_the_same_bit_for_bit(diagnosis: Path) -> None:
    outcome = check(diagnosis)
    assert {item.name for item in outcome.items if item.status is not Status.IDENTICAL} == set()
    assert outcome.verdict.startswith("SAME, bit for bit")
    assert outcome.document()["kind"] == "diagnosis"
    assert not outcome.environment
    assert {
        f"{DIAGNOSIS}: effects.slip_sinkage.probability", f"{DIAGNOSIS}: where.0.gap",
        f"{DIAGNOSIS}: effects.slip_sinkage.parameters.growth.mean",
        f"{DIAGNOSIS}: inclusion.slip_sinkage.share",
        "corrected.json: lab_mode.rut_depth.0", "index.html", "document.json",
        "figures/where.png", CASE,
        "fresh_prediction.csv: 0.rut_depth_mm_after",
    } <= {item.name for item in outcome.items}  # fmt: skip


def test_quick_says_that_nothing_is_computed_again(diagnosis: Path) -> None:
    outcome = check(diagnosis, quick=True)
    assert outcome.exit_code == 0
    assert outcome.verdict == "NOTHING DIFFERENT, BUT NOTHING WAS COMPUTED AGAIN (--quick)"


def in_diagnosis(change: Any) -> Change:
    return lambda folder: edit_json(folder / DIAGNOSIS, change)


def probability(d: Any) -> None:
    d["effects"][0]["probability"] -= 0.1


def share(d: Any) -> None:
    d["inclusion"]["slip_sinkage"]["share"] -= 0.2


def size(d: Any) -> None:
    d["effects"][0]["parameters"]["growth"]["mean"] += 1.0


def field(folder: Path) -> None:
    path = folder / "case/field.csv"
    *rows, last = path.read_text().splitlines()
    *cells, value = last.split(",")
    path.write_text("\n".join([*rows, ",".join([*cells, repr(float(value) + 5.0)])]) + "\n")


def corrected(folder: Path) -> None:
    path = folder / "corrected.json"
    content = json.loads(path.read_text())
    content["fits"][0]["sample"] = [[1.3 * v for v in row] for row in content["fits"][0]["sample"]]
    path.write_text(json.dumps(content) + "\n")


def seed(folder: Path) -> None:
    edit_json(folder / "inputs.json", lambda m: m.update(seed=2))
    edit_json(folder / DIAGNOSIS, lambda d: d["where"][0].update(gap=9.0))


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (in_diagnosis(probability), f"{DIAGNOSIS}: effects.slip_sinkage.probability"),
        (in_diagnosis(share), f"{DIAGNOSIS}: inclusion.slip_sinkage.share"),
        (in_diagnosis(size), f"{DIAGNOSIS}: effects.slip_sinkage.parameters.growth.mean"),
        (in_diagnosis(lambda d: d.update(verdict="none")), f"{DIAGNOSIS}: verdict"),
        (seed, f"{DIAGNOSIS}: where.0.gap"),
        (corrected, "corrected.json"),
        (field, "fresh_prediction.csv: 6.rut_depth_mm_after_upper"),
        (in_text(CASE, "[context.suspected]\nslip_sinkage = 0.6", "[context.suspected]"), CASE),
        (in_text("inputs.json", '"bekker"', '"modified_bekker"'), CASE),
        (in_text("index.html", "sinkage", "wind"), "index.html"),
        (swap_figures("figures/where.png", "figures/which.png"), "figures/where.png"),
        (in_text("fresh_prediction.csv", "\n", ",more\n"), "fresh_prediction.csv: 0.more"),
        (lambda folder: (folder / DIAGNOSIS).write_text("{"), DIAGNOSIS),
        (lambda folder: (folder / "case/lab.csv").unlink(), "case/lab.csv"),
    ],
)
def test_what_is_tampered_with_is_named(diagnosis: Path, change: Change, named: str) -> None:
    change(diagnosis)
    found = findings(diagnosis)
    assert named in found, found


def test_a_diagnosis_of_an_earlier_version_has_no_document(diagnosis: Path) -> None:
    (diagnosis / "document.json").unlink()
    (note,) = findings(diagnosis).values()
    assert "not computed again" in note


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda m: m.pop("seed"), "seed"),
        (lambda m: m.update(seed=-1), "seed"),
        (lambda m: m["models"].update(rut_depth="pacejka"), "pacejka"),
        (lambda m: m.update(effects={"mine.py": "0" * 64}), "mine.py"),
    ],
)
def test_inputs_that_make_no_sense_cannot_be_checked(diagnosis: Path, change, words: str) -> None:
    edit_json(diagnosis / "inputs.json", change)
    with pytest.raises(CalibError, match=words):
        check(diagnosis)


def test_an_effect_of_ones_own_is_given_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    write_cases([gap for gap in paper_gaps() if gap.name == "plain_bekker"], Path())
    Path("mine.py").write_text(SOFT_PATCH)
    words = ["diagnose", "plain_bekker", "--effects", "mine.py", "--out", "found", "--workers", "1"]
    assert CliRunner().invoke(app, words).exit_code == 0
    words = ["check", "found", "--quick"]
    refused = CliRunner().invoke(app, words)
    assert refused.exit_code == 2
    assert "effects are not those" in refused.stderr
    given = CliRunner().invoke(app, [*words, "--effects", "mine.py"])
    assert given.exit_code == 0, given.output
    Path("mine.py").write_text(SOFT_PATCH.replace("0.15", "0.1"))
    assert CliRunner().invoke(app, [*words, "--effects", "mine.py"]).exit_code == 2
