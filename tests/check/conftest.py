"""A small report, a whole one and a run, and copies of them to tamper with.

``CALIB_MADE_UNDER`` names the setting of another processor (`kernels.Setting`) that makes them.
"""

from __future__ import annotations

import base64
import json
import os
import shutil
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest

import calib.checking.check as check_module
from calib.batch.environment import sha256
from calib.checking import compare, folders, tolerances
from calib.checking.check import Outcome, check, recompute_report
from calib.checking.compare import Status
from calib.gap.diagnose import diagnose
from calib.he2019 import sections
from calib.he2019.audit import run_audit
from calib.inference.io import recompute_run
from calib.report.comparison import HELD_OUT, recompute_comparison
from calib.report.page.diagnosis import render_diagnosis
from calib.report.publish import publication
from calib.report.writer import file_hashes
from calib.validation.validate import posterior_errors
from tests.check.kernels import ALL

from . import made

type Change = Callable[[Path], object]


@pytest.fixture(scope="package")
def original(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Make each kind of folder once, as ``CALIB_MADE_UNDER`` says where it is set."""
    out = tmp_path_factory.mktemp("original")
    named = [s for s in ALL if str(s) == os.environ.get("CALIB_MADE_UNDER")]

    @cache
    def folder(kind: str, elsewhere: bool) -> Path:
        if elsewhere:
            return made.elsewhere(out, named[0], kind) / kind
        with patch("calib.report.figures.collect.plates", made.two_plates):
            return made.KINDS[kind](out / f"{kind}_here")

    return lambda kind, here=False: folder(kind, bool(named) and not here)


def _copy_of(kind: str, *, here: bool = False) -> Any:
    @pytest.fixture
    def copy(original: Callable[..., Path], tmp_path: Path) -> Path:
        return Path(shutil.copytree(original(kind, here), tmp_path / kind))

    return copy


# Figures are judged where numbers are the same to the last bit: on this processor.
report, report_here = _copy_of("report"), _copy_of("report", here=True)
# With one of the source's gaps, the audit and figures for print.
whole, whole_here = _copy_of("whole"), _copy_of("whole", here=True)
run = _copy_of("run")


@pytest.fixture(autouse=True)
def _few_figures() -> Any:
    with patch("calib.report.figures.collect.plates", made.two_plates):
        yield


@pytest.fixture(scope="package")
def _made(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[Any, Any], Path]:
    return {}, tmp_path_factory.mktemp("made")


@pytest.fixture
def audited_once(_made, monkeypatch: pytest.MonkeyPatch) -> None:
    """Audit once with the same calibration."""
    cache, _ = _made

    def audit_again(seed, *, seeds, rut_calibration, **how):
        key = "audit", seed, seeds, rut_calibration and rut_calibration.draws.t.tobytes()
        if key not in cache:
            cache[key] = run_audit(seed, seeds=seeds, rut_calibration=rut_calibration, **how)
        return cache[key]

    monkeypatch.setattr(sections, "run_audit", audit_again)


@pytest.fixture
def computed_once(_made, audited_once, monkeypatch: pytest.MonkeyPatch) -> None:
    """Do the work of equal inputs once, and read equal posteriors once.

    Most tampering leaves them as they are.
    """
    cache, folder = _made

    def once(key: Any, make: Callable[[], Any]) -> Any:
        if key not in cache:
            cache[key] = make()
        return cache[key]

    def made_once(key: Any, out: Path, make: Callable[[Path], Any]) -> Any:
        kept = folder / sha256(repr(key).encode())
        result = once(key, lambda: make(kept))
        shutil.copytree(kept, out, dirs_exist_ok=True)
        return result

    def report_again(manifest, tasks, out, progress, pool):
        own = {"files", "left_out"}  # from which nothing is computed
        key = (
            manifest.model_dump_json(exclude={**dict.fromkeys(own, True), "document": own}),
            *(t.table[c].tobytes() for t in tasks for c in t.table),
            *(t.prior_path.read_bytes() for t in tasks),
        )
        return made_once(
            key, out, lambda kept: recompute_report(manifest, tasks, kept, progress, pool)
        )

    def run_again(record, problem, out, progress):
        unused = ("sha256", "log_evidence", "gate")
        said = {k: v for k, v in record.document.items() if k not in unused}
        key = (json.dumps(said), *(problem.table[c].tobytes() for c in problem.table))
        return made_once(key, out, lambda kept: recompute_run(record, problem, kept, progress))

    def diagnosed_once(case, seed, **more):
        tables = (case.lab, case.field)
        key = "diagnosis", seed, *(t[c].tobytes() for t in tables for c in t.columns)
        return once(key, lambda: diagnose(case, seed, **more))

    def compared_again(record, problems, folder, out, progress, workers):
        tables = [p.table[c].tobytes() for p in problems.values() for c in p.table]
        tables.append((folder / HELD_OUT).read_bytes())
        key = "comparison", record.seed, record.settings, *problems, *tables

        def make(kept: Path) -> Any:
            kept.mkdir()
            return recompute_comparison(record, problems, folder, kept, progress, workers)

        return made_once(key, out, make)

    def reading_once(read: Callable[[Path], Any]) -> Callable[[Path], Any]:
        def read_once(path: Path) -> Any:
            return once((read, sha256(path.read_bytes())), lambda: read(path))

        return read_once

    def errors_once(calibration) -> dict[Any, Any]:
        # Kept with the calibration, whose id is no other's as long as it is there.
        key = "errors", id(calibration)
        return dict(once(key, lambda: (calibration, posterior_errors(calibration)))[1])

    monkeypatch.setattr(tolerances, "posterior_errors", errors_once)
    monkeypatch.setattr(check_module, "recompute_report", report_again)
    monkeypatch.setattr(folders, "recompute_run", run_again)

    def rendered_once(document):
        return once(("page", document.json()), lambda: render_diagnosis(document))

    monkeypatch.setattr(folders, "recompute_comparison", compared_again)
    monkeypatch.setattr(folders, "diagnose", diagnosed_once)
    monkeypatch.setattr(folders, "render_diagnosis", rendered_once)
    for name in ("_variables", "read_draws"):
        monkeypatch.setattr(compare, name, reading_once(getattr(compare, name)))


# Ways to tamper with a folder


def edit_json(path: Path, change: Callable[[Any], object]) -> None:
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content, indent=1) + "\n")


def in_manifest(change: Callable[[Any], object]) -> Change:
    return lambda folder: edit_json(folder / "manifest.json", change)


def in_text(name: str, old: str, new: str) -> Change:
    def change(folder: Path) -> None:
        text = (folder / name).read_text()
        assert old in text
        (folder / name).write_text(text.replace(old, new, 1))

    return change


def scaled(place: str, by: float) -> Change:
    """Multiply a number that a summary has of the rut depth."""
    *above, last = place.split(".")

    def change(summary: Any) -> None:
        entry = summary["models"]["rut_depth"]
        for key in above:
            entry = entry[key]
        entry[last] *= by

    return lambda folder: edit_json(folder / "summary.json", change)


def swap_figures(one: str, other: str, *, page: bool = False) -> Change:
    """Exchange two figures of a folder, on its page too if that is wanted."""

    def change(folder: Path) -> None:
        first, second = ((folder / name).read_bytes() for name in (one, other))
        (folder / one).write_bytes(second)
        (folder / other).write_bytes(first)
        if page:
            shown = [base64.b64encode(content).decode() for content in (first, second)]
            text = (folder / "index.html").read_text()
            text = text.replace(shown[0], "<first>").replace(shown[1], shown[0])
            (folder / "index.html").write_text(text.replace("<first>", shown[1]))

    return change


def seal(folder: Path, *, rewrite: bool = True) -> None:
    """Make a manifest agree with the files as they are now, as a thorough forger would.

    Tables and methods are written again from the numbers as they are now, unless told otherwise.
    """

    def hash_inputs(manifest: dict[str, Any]) -> None:
        for entry in manifest["tasks"].values():
            for kind in ("data", "priors"):
                entry[kind]["sha256"] = sha256((folder / entry[kind]["file"]).read_bytes())

    if rewrite:
        with suppress(ValueError, KeyError, TypeError, AttributeError):
            manifest = json.loads((folder / "manifest.json").read_text())
            hash_inputs(manifest)
            summary = json.loads((folder / "summary.json").read_text())
            for name, text in publication(manifest, summary).files.items():
                (folder / name).write_text(text, encoding="utf-8")
    in_manifest(hash_inputs)(folder)
    in_manifest(lambda m: m.update(files=file_hashes(folder)))(folder)


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
