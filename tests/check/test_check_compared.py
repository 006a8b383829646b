"""A comparison in a report: made again with it, and what is tampered with is found and named."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from calib.batch.environment import sha256
from calib.check.check import check
from calib.check.outcome import Status
from calib.data import read_table
from calib.errors import CalibError
from calib.models import example_csv
from calib.report.comparison import StatedComparison, plan_comparison
from calib.report.sections import work_out
from calib.report.study import HoldOut, plan_tasks
from calib.report.writer import file_hashes
from tests.check.conftest import edit_json

from . import made

MODELS = ("bekker_plate", "reece")


@pytest.fixture(scope="module")
def untouched(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("compared")
    (folder / "plates.csv").write_text(example_csv("reece"))
    table = read_table(folder / "plates.csv")
    tasks = plan_tasks([table], HoldOut("plate_width_mm", 80.0))
    section = plan_comparison(tasks, MODELS, {})
    found = work_out(tasks, 2019, settings=made.SETTINGS, sections=[section])
    return made.write(found, folder / "report")


def seal(folder: Path) -> None:
    """Make all hashes agree with what is there."""
    inner = folder / "compared"
    edit_json(inner / "comparison.json", lambda m: m.update(
        files={n: sha256((inner / n).read_bytes()) for n in m["files"]}))  # fmt: skip
    edit_json(folder / "manifest.json", lambda m: m.update(files=file_hashes(folder)))


def test_it_is_the_same_bit_for_bit_and_on_the_page(untouched: Path) -> None:
    outcome = check(untouched)
    assert {i.name for i in outcome.items if i.status is not Status.IDENTICAL} == set()
    names = {item.name for item in outcome.items}
    assert "compared/comparison.json: models.reece.held_out.crps" in names
    assert "compared/runs/reece/posterior.nc" in names
    stated = json.loads((untouched / "manifest.json").read_text())["comparison"]
    page = (untouched / "index.html").read_text()
    assert stated["verdict"] in page
    assert 'href="compared/index.html"' in page
    assert set(stated["models"]) == set(MODELS)


def in_manifest(m: dict[str, Any]) -> None:
    m["comparison"]["models"]["reece"]["weight"] += 0.1


def change_manifest(folder: Path) -> None:
    edit_json(folder / "manifest.json", in_manifest)


def change_seed(folder: Path) -> None:
    edit_json(folder / "compared/comparison.json", lambda m: m.update(seed=1))
    edit_json(folder / "manifest.json", lambda m: m["comparison"].update(seed=1))


def change_rows(folder: Path) -> None:
    path = folder / "compared/held_out.csv"
    path.write_text("\n".join(path.read_text().splitlines()[:-1]) + "\n")


def change_header(folder: Path) -> None:
    header = [*read_table(folder / "compared/held_out.csv").header]
    header[header.index("rut_depth_mm")] = "rut_depth_in"
    edit_json(folder / "compared/comparison.json", lambda m: m.update(header=header))


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (change_manifest, "manifest.json: comparison"),
        (change_seed, "compared/comparison.json"),
        (change_rows, "compared/comparison.json"),
        (change_header, "compared/comparison.json: header"),
    ],
)
def test_what_does_not_belong_together_is_found(
    untouched: Path, tmp_path: Path, change: Callable[[Path], None], named: str
) -> None:
    folder = tmp_path / "report"
    shutil.copytree(untouched, folder)
    change(folder)
    seal(folder)
    outcome = check(folder, quick=True)
    assert named in {i.name for i in outcome.items if i.status is Status.DIFFERENT}


def test_a_folder_that_no_section_is_of_is_a_stranger(untouched: Path, tmp_path: Path) -> None:
    folder = tmp_path / "report"
    shutil.copytree(untouched, folder)
    edit_json(folder / "manifest.json", lambda m: m.pop("comparison"))
    found = {i.name for i in check(folder).items if i.status is Status.DIFFERENT}
    assert {"compared/index.html", "index.html"} <= found


def test_what_cannot_be_compared_in_a_report_is_refused(tmp_path: Path) -> None:
    (tmp_path / "plates.csv").write_text(example_csv("reece"))
    tasks = plan_tasks([read_table(tmp_path / "plates.csv")])
    with pytest.raises(CalibError, match="nothing to compare in reece"):
        plan_comparison(tasks, ["reece"], {})
    with pytest.raises(CalibError, match="predict drawbar_pull_kn, which the report does not have"):
        plan_comparison(tasks, ["magic_formula", "wismer_luth"], {})
    with pytest.raises(CalibError, match="slip_ratio"):
        plan_comparison(tasks, ["reece", "lyasko"], {})
    with pytest.raises(ValueError, match="no record"):
        StatedComparison.again({"models": {"reece": 1}})
