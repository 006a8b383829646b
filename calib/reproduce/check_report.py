"""Check a report folder: its hashes, its inputs, and everything computed again from them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from calib.environment import Environment
from calib.errors import CalibError
from calib.problem import build_problem
from calib.reproduce.allowances import describe
from calib.reproduce.compare_report import (
    PAGE,
    RECORD,
    SUMMARY,
    Again,
    compare_estimates,
    compare_report,
    count_numbers,
    read_json,
)
from calib.reproduce.files import verify_files
from calib.reproduce.inputs import GROUP, verify_hashes, verify_label, verify_priors
from calib.reproduce.items import Item, Status
from calib.reproduce.posteriors import GROUP as POSTERIORS
from calib.reproduce.posteriors import verify_density, verify_summary
from calib.reproduce.recompute import recompute_report, report_tasks
from calib.reproduce.schema import Manifest
from calib.reproduce.text import verify_images
from calib.study import Progress, Task, fitted_rows

__all__ = ["check_report"]


def check_report(
    manifest: Manifest,
    folder: Path,
    scratch: Path,
    here: Environment,
    progress: Progress,
    *,
    quick: bool,
) -> tuple[list[Item], str]:
    """Return what was found, and what Monte Carlo error was allowed, in words.

    Parameters
    ----------
    manifest : Manifest
    folder, scratch : Path
        The report, and an empty folder.
    here : Environment
    progress : callable
    quick : bool
        Skip the sampling.
    """
    items = verify_files(folder, manifest.files, RECORD, manifest.left_out)
    for key, entry in manifest.tasks.items():
        items += verify_hashes(key, entry, folder)
    summary = read_json(folder / SUMMARY)
    items += _consistent(folder, manifest, summary)
    try:
        tasks = report_tasks(manifest, folder, scratch / "inputs")
    except CalibError as error:
        note = f"not computed again: {error.message}"
        return [*items, Item(GROUP, error.where or RECORD, Status.DIFFERENT, note=note)], ""
    same_code = manifest.code == here.code
    items += _named_rightly(manifest, folder, tasks, same_code=same_code)
    if quick:
        items += [
            Item(POSTERIORS, name, Status.UNJUDGED, note="left out on purpose, and not made again")
            for name in manifest.left_out
        ]
        return items + compare_estimates(tasks, manifest.seed, summary, progress), ""
    study = recompute_report(manifest, tasks, scratch / "again", progress)
    again = Again(manifest, folder, scratch / "again", study, here)
    return items + compare_report(again, summary), describe(count_numbers(study))


def _consistent(folder: Path, manifest: Manifest, summary: Mapping[str, Any]) -> list[Item]:
    """Hold the parts of the folder against each other, without computing anything again."""
    items = []
    page = folder / PAGE
    if page.is_file():
        items += verify_images(page.read_text(encoding="utf-8", errors="replace"), folder)
    models = summary.get("models")
    for key in manifest.tasks:
        file = folder / f"{key}.nc"
        if file.is_file():
            entry = models.get(key) if isinstance(models, Mapping) else None
            stated = entry.get("posterior") if isinstance(entry, Mapping) else None
            stated = stated if isinstance(stated, Mapping) else {}
            items.append(verify_summary(file.name, file, stated))
    return items


def _named_rightly(
    manifest: Manifest, folder: Path, tasks: tuple[Task, ...], *, same_code: bool
) -> list[Item]:
    items = []
    for task in tasks:
        entry = manifest.tasks[task.output]
        items.append(verify_label(entry.data.file, task.table, entry.label))
        items.append(verify_priors(task.output, entry, folder, same_code=same_code))
        file = folder / f"{task.output}.nc"
        if file.is_file():
            items.append(_density(task, file))
    return items


def _density(task: Task, file: Path) -> Item:
    try:
        rows = fitted_rows(task)[0]
        problem = build_problem(task.model, rows, task.prior_path)
    except CalibError as error:
        return Item(POSTERIORS, file.name, Status.DIFFERENT, note=error.message)
    return verify_density(file.name, file, problem)
