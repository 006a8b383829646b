"""Folders of `calib compare`: made again, and whatever is tampered with is found and named."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import h5py
import pytest
from matplotlib.figure import Figure

from calib.batch.environment import sha256
from calib.checking.check import check
from calib.checking.compare import Status
from calib.data import read_table
from calib.errors import CalibError
from calib.models import example_csv
from calib.report.comparison import StatedComparison, page, plan_comparison, table
from calib.report.figures.style import png_bytes
from calib.report.sections import work_out
from calib.report.study import HoldOut, plan_tasks
from calib.report.writer import file_hashes
from tests.check.conftest import Change, different, edit_json, findings, in_manifest, seal_run

from . import made

pytestmark = pytest.mark.usefixtures("computed_once")

FILE = "comparison.json"


def seal(folder: Path) -> None:
    """Make hashes and page agree with what is there, as a thorough forger would."""
    for run in (folder / "runs").iterdir():
        seal_run(run)
    found = json.loads((folder / FILE).read_text())
    (folder / "index.html").write_text(page(found, (folder / "figures/bands.png").read_bytes()))
    hash_again(folder)


def hash_again(folder: Path) -> None:
    hashes = {path: sha256(path.read_bytes()) for path in folder.rglob("*") if path.is_file()}
    edit_json(folder / FILE, lambda m: m.update(files={n: hashes[folder / n] for n in m["files"]}))


MODELS = ("bekker_plate", "reece")
PSI, INCH = 6.894757293168361, 25.4


@pytest.fixture(scope="module")
def untouched(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Figure]:
    """A report with a comparison, in the units of its file; the figure as it was drawn."""
    folder = tmp_path_factory.mktemp("compared")
    rows = [line.split(",") for line in example_csv("reece").split()]
    lines = ["Average ground pressure [psi],Plate width [mm],Sinkage [inch]"]
    lines += [f"{float(p) / PSI!r},{w},{float(z) / INCH!r}" for p, w, z in rows[1:]]
    (folder / "plates.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    tasks = plan_tasks([read_table(folder / "plates.csv")], HoldOut("plate_width_mm", 80.0))
    section = replace(plan_comparison(tasks, MODELS, {}), settings=made.SETTINGS)
    found = work_out(tasks, 2019, settings=made.SETTINGS, sections=[section])
    drawn: list[Figure] = []
    with patch(
        "calib.report.comparison.png_bytes", lambda f, **how: drawn.append(f) or png_bytes(f, **how)
    ):
        report = made.write(found, folder / "report")
    return report, drawn[0]


@pytest.fixture
def report(untouched: tuple[Path, Figure], tmp_path: Path) -> Path:
    return Path(shutil.copytree(untouched[0], tmp_path / "report"))


@pytest.fixture
def compared(report: Path) -> Path:
    """A folder as of `calib compare`: a report has the same inside."""
    return report / "compared"


def test_it_is_the_same_bit_for_bit_and_on_the_page(report: Path) -> None:
    outcome = check(report)
    assert {i.name for i in outcome.items if i.status is not Status.IDENTICAL} == set()
    assert {
        f"compared/{FILE}: models.bekker_plate.elpd",
        f"compared/{FILE}: models.bekker_plate.weight, as its elpd_rows give it",
        f"compared/{FILE}: models.reece.held_out.crps", "compared/figures/bands.png",
        "compared/runs/bekker_plate/run.json: posterior.n.mean",
        "compared/runs/reece/posterior.nc", "compared/index.html",
    } <= {item.name for item in outcome.items}  # fmt: skip
    stated = json.loads((report / "manifest.json").read_text())["comparison"]
    text = (report / "index.html").read_text()
    assert stated["verdict"] in text
    assert 'href="compared/index.html"' in text
    assert set(stated["models"]) == set(MODELS)


@pytest.mark.slow  # quick for a report and for a run
def test_a_comparison_of_other_draws_is_the_same_within_their_error(tmp_path: Path) -> None:
    """Another seed stands for another processor: it says a seed that it was not made with."""
    folder = made.comparison(tmp_path / "c", seed=5)
    edit_json(folder / FILE, lambda m: m.update(seed=2019))
    for run in (folder / "runs").iterdir():
        edit_json(run / "run.json", lambda m: m.update(seed=2019))
    seal(folder)
    outcome = check(folder)
    assert different(outcome) == {}
    assert outcome.verdict.startswith("SAME within Monte Carlo error")


def test_a_comparison_is_shown_in_the_units_of_its_file(
    untouched: tuple[Path, Figure], compared: Path
) -> None:
    """All but the page and the figure is in canonical units."""
    found, text = json.loads((compared / FILE).read_text()), (compared / "index.html").read_text()
    assert found["header"][-1] == "Sinkage [inch]"
    head, body = table(found)
    errors = [i for i, cell in enumerate(head) if "RMSE" in cell or "CRPS" in cell]
    assert [head[i] for i in errors] == [
        "RMSE (inch)", "held-out RMSE (inch)", "held-out CRPS (inch)",
    ]  # fmt: skip
    assert "RMSE (mm)" in table({k: v for k, v in found.items() if k != "header"})[0]
    for row in body:
        m = found["models"][row[0]]
        errors_mm = m["rmse"], m["held_out"]["rmse"], m["held_out"]["crps"]
        # The readings are off by half a millimetre or more.
        assert errors_mm[0] > 0.2
        assert [float(row[i]) for i in errors] == pytest.approx(
            [e / INCH for e in errors_mm], rel=5e-3
        )
    assert all(cell in text for cell in (*head, *body[0]))
    assert "(mm)" not in text
    told = re.findall(
        r"<title>(Ground pressure [\d.]+ psi, (?:left|held) out: measured [\d.]+ inch;)", text
    )
    shown = sum(len(m["elpd_rows"]) + m["held_out"]["rows"] for m in found["models"].values())
    assert len(told) == shown
    axes = untouched[1].axes[0]
    assert "Ground pressure (psi)" in axes.get_xlabel()
    assert "Rut depth (inch)" in axes.get_ylabel()
    assert axes.dataLim.ymax < 4.0  # the deepest rut is 38.85 mm


def of_model(change: Callable[[dict[str, Any]], object]) -> Change:
    return lambda folder: edit_json(folder / FILE, lambda m: change(m["models"]["bekker_plate"]))


def change_draws(folder: Path) -> None:
    with h5py.File(folder / "runs/bekker_plate/posterior.nc", "a") as file:
        file["posterior/n"][:] = file["posterior/n"][:] * 1.001


def change_rows_of_one(folder: Path) -> None:
    path = folder / "runs/bekker_plate/data.csv"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([lines[0], *reversed(lines[1:])]) + "\n")


def exchange_bands(folder: Path) -> None:
    from PIL import Image, ImageOps

    path = folder / "figures/bands.png"
    with Image.open(path) as image:
        other = ImageOps.invert(image.convert("RGB"))
    other.save(path)


RAW = "comparison.json: models.bekker_plate"
QUICK: dict[str, tuple[Change, str]] = {
    "a weight": (of_model(lambda m: m.update(weight=m["weight"] + 0.01)),
                 f"{RAW}.weight, as its elpd_rows give it"),
    "a difference": (of_model(lambda m: m.update(below_best=1.0)),
                     f"{RAW}.below_best, as its elpd_rows give it"),
    "what is told apart": (of_model(lambda m: m.update(told_apart=not m["told_apart"])),
                           f"{RAW}.told_apart, as its elpd_rows give it"),
    "the verdict": (lambda f: edit_json(f / FILE, lambda m: m.update(verdict="Bekker is right.")),
                    "comparison.json: verdict, as its elpd_rows give it"),
    "draws": (change_draws, "runs/bekker_plate/posterior.nc"),
    "the order of rows": (change_rows_of_one, "runs/*/data.csv"),
}  # fmt: skip


@pytest.mark.parametrize("what", QUICK)
def test_what_does_not_hang_together_is_named_without_sampling(compared: Path, what: str) -> None:
    tamper, name = QUICK[what]
    tamper(compared)
    seal(compared)
    assert name in findings(compared, quick=True)


@pytest.mark.parametrize("gone", ["rows", "verdict", "converged"])
def test_what_a_record_lacks_is_a_difference_and_no_traceback(compared: Path, gone: str) -> None:
    def change(m: dict[str, Any]) -> None:
        (m["models"]["bekker_plate"] if gone == "converged" else m).pop(gone)

    edit_json(compared / FILE, change)  # no page can be written of it
    if gone == "converged":
        with pytest.raises(CalibError, match=gone):
            findings(compared, quick=True)
    else:
        assert findings(compared, quick=True)


def test_what_only_sampling_tells_is_named(compared: Path) -> None:
    def change(m: dict[str, Any]) -> None:
        best = next(iter(m["models"].values()))
        best["held_out"]["elpd"] += 1.0
        best["rmse"] *= 10.0

    edit_json(compared / FILE, change)
    exchange_bands(compared)
    path = compared / "runs/bekker_plate/run.json"
    edit_json(path, lambda m: m.update(log_evidence=m["log_evidence"] + 0.5))
    seal(compared)
    assert findings(compared, quick=True) == {}
    first = next(iter(json.loads((compared / FILE).read_text())["models"]))
    best = f"{FILE}: models.{first}"
    assert findings(compared).keys() == {
        f"{best}.held_out.elpd", f"{best}.rmse", "runs/bekker_plate/run.json: log_evidence",
        "figures/bands.png",
    }  # fmt: skip


def test_files_and_pages_are_held_against_the_record(compared: Path) -> None:
    (compared / "notes.txt").write_text("mine")
    (compared / "held_out.csv").write_text("a\n1\n")
    text = (compared / "index.html").read_text()
    (compared / "index.html").write_text(text.replace("prefer", "love"))
    found = findings(compared, quick=True)
    assert found["notes.txt"] == "not listed"
    assert found["held_out.csv"] == "changed"
    assert "index.html" in found
    (compared / "runs/bekker_plate/run.json").unlink()
    assert findings(compared, quick=True)["runs/bekker_plate/run.json"] == "missing"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda m: m.pop("settings"), "settings"),
        (lambda m: m.update(schema="calib/comparison/1"), "calib/comparison/2"),
        (lambda m: m["models"].pop("bekker_plate"), "models"),
        (lambda m: m["models"].update(pacejka=m["models"]["bekker_plate"]), "models"),
        (lambda m: m["models"]["bekker_plate"].update(elpd_rows=["x", "y"]), "elpd_rows"),
    ],
)
def test_a_record_that_makes_no_sense_cannot_be_checked(
    compared: Path, change: Callable[[dict[str, Any]], object], words: str
) -> None:
    edit_json(compared / FILE, change)
    with pytest.raises(CalibError, match=words):
        check(compared)


# In a report


def change_weight(m: dict[str, Any]) -> None:
    m["comparison"]["models"]["reece"]["weight"] += 0.1


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
        (in_manifest(change_weight), "manifest.json: comparison"),
        (change_seed, "compared/comparison.json"),
        (change_rows, "compared/comparison.json"),
        (change_header, "compared/comparison.json: header"),
    ],
)
def test_what_does_not_belong_together_is_found(report: Path, change: Change, named: str) -> None:
    change(report)
    hash_again(report / "compared")
    in_manifest(lambda m: m.update(files=file_hashes(report)))(report)
    outcome = check(report, quick=True)
    assert named in {i.name for i in outcome.items if i.status is Status.DIFFERENT}


def test_a_folder_that_no_section_is_of_is_a_stranger(report: Path) -> None:
    in_manifest(lambda m: m.pop("comparison"))(report)
    found = findings(report)
    assert {"compared/index.html", "index.html"} <= found.keys()


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
