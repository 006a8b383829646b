"""A small report, a whole one, a run and a comparison, and copies of them to tamper with.

They are made in processes that round as another processor would; what is tampered with is to be
found there as here. ``CALIB_MADE_UNDER`` names another setting (`kernels.Setting`).
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest

import calib.check.check as check_module
from calib.batch.environment import sha256
from calib.check import compare, tolerances
from calib.check.check import check, recompute_report
from calib.check.outcome import Outcome, Status
from calib.he2019 import sections
from calib.he2019.audit import begin_audit
from calib.inference.calibration import Calibration
from calib.inference.io import recompute_run
from calib.report.publish import publication
from calib.report.writer import file_hashes
from calib.validation.validate import posterior_errors
from tests.check.kernels import ALL, FEW, Setting

from . import made

# What a manifest has of the hashes of its files, from which nothing is computed.
_OWN = {"files", "left_out"}


def made_under() -> Setting | None:
    """The processor that the originals are made on; None for this one."""
    named = os.environ.get("CALIB_MADE_UNDER")
    if named:
        return next(setting for setting in ALL if str(setting) == named)
    return FEW[0] if FEW else None


@pytest.fixture(scope="package")
def originals(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of all of them (`made.KINDS`); importing takes as long as making one."""
    setting, out = made_under(), tmp_path_factory.mktemp("original")
    if setting is not None:
        return made.elsewhere(out, setting, *made.KINDS)
    for kind, make in made.KINDS.items():
        make(out / kind)
    return out


@pytest.fixture(autouse=True)
def _few_figures() -> Any:
    with patch("calib.report.figures.collect.plates", made.two_plates):
        yield


@pytest.fixture
def report(originals: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(originals / "report", tmp_path / "report"))


@pytest.fixture(scope="package")
def original_here(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report as this processor makes it."""
    return made.report(tmp_path_factory.mktemp("original") / "here")


@pytest.fixture
def report_here(original_here: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(original_here, tmp_path / "here"))


@pytest.fixture
def whole(originals: Path, tmp_path: Path) -> Path:
    """A report with one of the source's gaps, the audit and figures for print."""
    return Path(shutil.copytree(originals / "whole", tmp_path / "whole"))


@pytest.fixture(scope="package")
def whole_original_here(tmp_path_factory: pytest.TempPathFactory) -> Path:
    with patch("calib.report.figures.collect.plates", made.two_plates):
        return made.whole(tmp_path_factory.mktemp("original") / "whole_here")


@pytest.fixture
def whole_here(whole_original_here: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(whole_original_here, tmp_path / "whole_here"))


@pytest.fixture
def run(originals: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(originals / "run", tmp_path / "run"))


@pytest.fixture
def compared(originals: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(originals / "comparison", tmp_path / "compared"))


@pytest.fixture(scope="package")
def compared_original_here(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made.comparison(tmp_path_factory.mktemp("original") / "compared_here")


@pytest.fixture
def compared_here(compared_original_here: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(compared_original_here, tmp_path / "compared_here"))


@pytest.fixture(scope="package")
def _made(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[Any, Any], Path]:
    return {}, tmp_path_factory.mktemp("made")


@pytest.fixture(scope="package")
def _read() -> dict[Any, Any]:
    return {}


@pytest.fixture
def audited_once(_made, monkeypatch: pytest.MonkeyPatch) -> None:
    """Audit once with the same calibration."""
    cache, _ = _made

    def audit_again(seed, seeds, pool):
        def finish(calibration, tell):
            key = "audit", seed, seeds, calibration and calibration.draws.t.tobytes()
            if key not in cache:
                cache[key] = begin_audit(seed, seeds, pool)(calibration, tell)
            return cache[key]

        return finish

    monkeypatch.setattr(sections, "begin_audit", audit_again)


@pytest.fixture
def computed_once(_made, _read, audited_once, monkeypatch: pytest.MonkeyPatch) -> None:
    """Do the work of equal inputs once, and read equal posteriors once.

    Most tampering leaves them as they are.
    """
    cache, folder = _made

    def once(key: Any, out: Path, make: Callable[[Path], Any]) -> Any:
        if key not in cache:
            kept = folder / str(len(cache))
            cache[key] = make(kept), kept
        result, kept = cache[key]
        shutil.copytree(kept, out)
        return result

    def report_again(manifest, tasks, out, progress, pool):
        key = (
            manifest.model_dump_json(exclude={**dict.fromkeys(_OWN, True), "document": _OWN}),
            *(t.table[c].tobytes() for t in tasks for c in t.table),
            *(t.prior_path.read_bytes() for t in tasks),
        )
        return once(key, out, lambda kept: recompute_report(manifest, tasks, kept, progress, pool))

    def run_again(record, problem, out, progress):
        # All but its numbers that nothing is computed from.
        said = {
            k: v for k, v in record.document.items() if k not in ("sha256", "log_evidence", "gate")
        }
        key = (json.dumps(said), *(problem.table[c].tobytes() for c in problem.table))
        return once(key, out, lambda kept: recompute_run(record, problem, kept, progress))

    def reading_once(read: Callable[[Path], Any]) -> Callable[[Path], Any]:
        def read_once(path: Path) -> Any:
            if not path.is_file():
                return read(path)
            key = read, sha256(path.read_bytes())
            if key not in _read:
                _read[key] = read(path)
            return _read[key]

        return read_once

    def errors_once(calibration: Calibration) -> dict[Any, Any]:
        key = "errors", id(calibration)
        if key not in cache:
            cache[key] = calibration, posterior_errors(calibration)
        return dict(cache[key][1])

    monkeypatch.setattr(tolerances, "posterior_errors", errors_once)
    monkeypatch.setattr(check_module, "recompute_report", report_again)
    monkeypatch.setattr(check_module, "recompute_run", run_again)
    for name in ("_groups", "read_draws"):
        monkeypatch.setattr(compare, name, reading_once(getattr(compare, name)))


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
