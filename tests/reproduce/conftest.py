"""A small report and a run, made once, and copies of them to tamper with."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

import calib.reproduce.check_report as check_report_module
from calib.audit import Seeds
from calib.calibration import Calibration, calibrate
from calib.contents import work_out
from calib.data import Table
from calib.estimators import estimate
from calib.figures import Plate
from calib.figures.bands import bands_plate
from calib.figures.learned import learned_plate
from calib.figures.style import style
from calib.manifest import file_hashes, sha256
from calib.paper_gaps.cases import paper_gaps
from calib.problem import Problem, build_problem
from calib.publish import publication
from calib.report import write_report
from calib.reproduce.check import check
from calib.reproduce.items import Status
from calib.reproduce.outcome import Outcome
from calib.reproduce.recompute import recompute_report
from calib.sampling.gate import Gate
from calib.sampling.sampler import SamplerSettings
from calib.store import save_calibration
from calib.streams import generator
from calib.study import OutputResult, Study, run_study
from calib.study_tasks import he2019_tasks

# Short chains, and a gate that lets them pass.
SETTINGS = SamplerSettings(steps=100, gate=Gate(taus_min=20.0))


def two_plates(result: OutputResult, published: bool = False) -> list[Plate]:
    with style():
        return [
            bands_plate(result, published=published),
            learned_plate(result, published=published),
        ]


@pytest.fixture(scope="package", autouse=True)
def _few_figures() -> Iterator[None]:
    """Drawing takes most of the time of a report: two figures do for these tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("calib.report.plates", two_plates)
        yield


def rut_study(seed: int = 2019) -> Study:
    tasks = [task for task in he2019_tasks() if task.output == "rut_depth"]
    return run_study(tasks, seed, settings=SETTINGS)


def write(study: Study, out: Path, **kwargs: Any) -> Path:
    write_report(
        study, out, settings=SETTINGS, command=["calib", "report"], title="A report", **kwargs
    )
    return out


@pytest.fixture(scope="package")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A report of rut depth, posterior included."""
    return write(rut_study(), tmp_path_factory.mktemp("original") / "report")


@pytest.fixture(scope="package")
def original_whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A report with one of the source's gaps, the audit and figures for print."""
    tasks = [task for task in he2019_tasks() if task.output == "rut_depth"]
    gaps = [gap for gap in paper_gaps() if gap.name == "plain_bekker"]
    found = work_out(tasks, 2019, settings=SETTINGS, gaps=gaps, audit=Seeds(1, 1, 1))
    out = tmp_path_factory.mktemp("original") / "whole"
    return write(found.study, out, gaps=found.gaps, audit=found.audit, pdf=True)


@pytest.fixture(scope="package")
def original_run(rut_tables: tuple[Table, Table], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run as `calib fit` makes it."""
    folder = tmp_path_factory.mktemp("original") / "run"
    folder.mkdir()
    save_calibration(fitted_run(build_problem("modified_bekker", rut_tables[0]), 2019), folder)
    return folder


def fitted_run(problem: Problem, seed: int) -> Calibration:
    rng = generator(seed, problem.bound.model.name, "least_squares")
    point = estimate(problem, "least_squares", rng)
    return calibrate(problem, seed, estimates=(point,), settings=SETTINGS)


@pytest.fixture
def report(original: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(original, tmp_path / "report"))


@pytest.fixture
def whole(original_whole: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(original_whole, tmp_path / "whole"))


@pytest.fixture
def run(original_run: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(original_run, tmp_path / "run"))


@pytest.fixture(scope="package")
def _made(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[Any, tuple[Study, Path]], Path]:
    return {}, tmp_path_factory.mktemp("made")


@pytest.fixture
def computed_once(_made, monkeypatch: pytest.MonkeyPatch) -> None:
    """Do the work of equal inputs once: most tampering leaves them as they are."""
    cache, folder = _made

    def again(manifest, tasks, out, progress):
        key = (
            manifest.model_dump_json(exclude={"files", "left_out"}),
            *(t.table[c].tobytes() for t in tasks for c in t.table),
            *(t.prior_path.read_bytes() for t in tasks),
        )
        if key not in cache:
            kept = folder / str(len(cache))
            cache[key] = recompute_report(manifest, tasks, kept, progress), kept
        study, kept = cache[key]
        shutil.copytree(kept, out)
        return study

    monkeypatch.setattr(check_report_module, "recompute_report", again)


def edit_json(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content, indent=1) + "\n")


def seal(folder: Path, *, rewrite: bool = True) -> None:
    """Make a manifest agree with the files as they are now, as a thorough forger would.

    Tables and methods are written again from the numbers as they are now, unless told otherwise.
    """
    if rewrite:
        with suppress(ValueError, KeyError, TypeError, AttributeError):
            manifest = json.loads((folder / "manifest.json").read_text())
            summary = json.loads((folder / "summary.json").read_text())
            for name, entry in manifest["tasks"].items():
                for kind in ("data", "priors"):
                    path = folder / entry[kind]["file"]
                    manifest["tasks"][name][kind]["sha256"] = sha256(path.read_bytes())
            for name, text in publication(manifest, summary).files.items():
                (folder / name).write_text(text, encoding="utf-8")

    def change(manifest: dict[str, Any]) -> None:
        manifest["files"] = file_hashes(folder)
        for entry in manifest["tasks"].values():
            for kind in ("data", "priors"):
                path = folder / entry[kind]["file"]
                entry[kind]["sha256"] = sha256(path.read_bytes())

    edit_json(folder / "manifest.json", change)


def seal_run(folder: Path) -> None:
    def change(record: dict[str, Any]) -> None:
        record["sha256"] = {n: sha256((folder / n).read_bytes()) for n in record["sha256"]}

    edit_json(folder / "run.json", change)


def different(outcome: Outcome) -> dict[str, str]:
    """What a check calls different, and why."""
    # The first remark of several on the same thing.
    return {item.name: item.note for item in reversed(outcome.of(Status.DIFFERENT))}


def findings(folder: Path, *, quick: bool = False) -> dict[str, str]:
    return different(check(folder, quick=quick))
