"""Check a report folder: its hashes, its inputs, and everything computed again from them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from calib.batch.environment import Environment
from calib.batch.pool import HERE, Pool
from calib.check.check_comparison import check_comparison
from calib.check.compare import (
    RECORD,
    SUMMARY,
    Again,
    compare_estimates,
    compare_files,
    compare_numbers,
    count_numbers,
    moved_parts,
    output_entry,
)
from calib.check.derived import verify_derived, verify_form, verify_gaps
from calib.check.inputs import verify_files, verify_hashes, verify_label, verify_priors
from calib.check.montecarlo import describe
from calib.check.numbers import read_json
from calib.check.outcome import Item, Status
from calib.check.posteriors import GROUP as POSTERIORS
from calib.check.posteriors import DrawsFile, read_draws, verify_density, verify_summary
from calib.check.recompute import not_computed, recompute_report, report_tasks
from calib.check.schema import Manifest, read_comparison
from calib.check.text import verify_images
from calib.data import Table, read_table
from calib.data.quantities import OUTPUTS
from calib.errors import CalibError
from calib.inference.problem import build_problem
from calib.models import get_model
from calib.report.compared import FOLDER
from calib.report.comparison import HELD_OUT
from calib.report.study import Progress
from calib.report.study_tasks import Task, fitted_rows

_PAGE = "index.html"


def check_report(
    manifest: Manifest,
    folder: Path,
    scratch: Path,
    here: Environment,
    progress: Progress,
    *,
    quick: bool,
    pool: Pool = HERE,
    workers: int = 1,
) -> tuple[list[Item], str]:
    """Return what was found in a report, and what Monte Carlo error was allowed, in words.

    `scratch` is an empty folder; `quick` skips the sampling.
    """
    items = verify_files(folder, manifest.files, RECORD, manifest.left_out)
    for key, said in manifest.tasks.items():
        items += verify_hashes(key, said, folder)
    summary = read_json(folder / SUMMARY)
    posteriors, unreadable = _posteriors(folder, manifest)
    items += unreadable + _consistent(folder, summary, posteriors)
    allowed = ""
    same_code = manifest.code == here.code
    with not_computed(items, folder, RECORD):
        tasks = report_tasks(manifest, folder, scratch / "inputs")
        items += _named_rightly(manifest, folder, tasks, same_code=same_code)
        there = [task for task in tasks if task.output in posteriors]
        items += [_density(task, posteriors[task.output]) for task in there]
        if quick:
            items += _left_out(manifest)
            items += compare_estimates(tasks, manifest.seed, summary, progress)
        else:
            study = recompute_report(manifest, tasks, scratch / "again", progress, pool)
            allowed = describe(count_numbers(study))
            again = Again(manifest, folder, scratch / "again", study, here)
            numbers = compare_numbers(again)
            items += numbers + compare_files(again, moved_parts(numbers))
        if "comparison" in manifest.sections:
            items += _compared(
                manifest, folder, scratch / "compared", here, progress, tasks, quick=quick,
                workers=workers,
            )  # fmt: skip
    items += verify_form(folder) + verify_gaps(folder, summary, same_code=same_code)
    record = read_json(folder / RECORD)
    items += verify_derived(folder, manifest.files, record, summary, same_code=same_code)
    return items, allowed


def _compared(
    manifest: Manifest, folder: Path, scratch: Path, here: Environment, progress: Progress,
    tasks: tuple[Task, ...], *, quick: bool, workers: int,
) -> list[Item]:  # fmt: skip
    """Check the comparison of models in a report: of its rows and seed, stated as it was found."""
    scratch.mkdir()
    record = read_comparison(folder / FOLDER)
    found, _ = check_comparison(
        record, folder / FOLDER, scratch, here, progress, quick=quick, workers=workers
    )
    items = [
        replace(item, name=f"{FOLDER}/{item.name}", group=f"{FOLDER}: {item.group}")
        for item in found
    ]
    stated: Any = manifest.sections["comparison"]
    same = isinstance(stated, dict) and stated == {
        key: value for key, value in record.document.items() if key in stated
    }
    items.append(_agrees(same and {"models", "verdict", "seed"} <= stated.keys(),
                         "manifest.json: comparison", "what its comparison.json has"))  # fmt: skip
    output = get_model(next(iter(record.models))).output
    fitted = {OUTPUTS[task.output]: fitted_rows(task) for task in tasks}
    rows, held = fitted.get(output, (None, None))
    kept = [(folder / FOLDER / "runs" / name / "data.csv", rows) for name in record.models]
    if record.held_out or held is not None:
        kept.append((folder / FOLDER / HELD_OUT, held))
    own = record.seed == manifest.seed and all(_of_rows(path, table) for path, table in kept)
    items.append(_agrees(own, f"{FOLDER}/comparison.json", "of the report's own rows and seed"))
    # By them values are shown in the units of the file.
    named = {OUTPUTS[key]: said.data.header for key, said in manifest.tasks.items()}
    items.append(_agrees(record.header == named.get(output), f"{FOLDER}/comparison.json: header",
                         "the column names of the report's own file"))  # fmt: skip
    return items


def _agrees(same: bool, name: str, what: str) -> Item:
    status = Status.IDENTICAL if same else Status.DIFFERENT
    return Item(FOLDER, name, status, note=what if same else f"it is not {what}")


def _of_rows(path: Path, table: Table | None) -> bool:
    """Whether a file has the rows of a table."""
    if table is None:
        return False
    kept = read_table(path, allow_missing=tuple(OUTPUTS.values())).columns
    return kept.keys() == table.columns.keys() and all(
        np.array_equal(values, table[name], equal_nan=True) for name, values in kept.items()
    )


def _left_out(manifest: Manifest) -> list[Item]:
    note = "left out on purpose, and not made again"
    return [Item(POSTERIORS, name, Status.UNJUDGED, note=note) for name in manifest.left_out]


def _posteriors(folder: Path, manifest: Manifest) -> tuple[dict[str, DrawsFile], list[Item]]:
    """Read the netCDF files that are there, by output; and what cannot be read."""
    found, unreadable = {}, []
    for key in manifest.tasks:
        path = folder / f"{key}.nc"
        if path.is_file():
            try:
                found[key] = read_draws(path)
            except CalibError as error:
                item = Item(POSTERIORS, path.name, Status.DIFFERENT, note=error.message)
                unreadable.append(item)
    return found, unreadable


def _consistent(
    folder: Path, summary: Mapping[str, Any], posteriors: Mapping[str, DrawsFile]
) -> list[Item]:
    """Hold the parts of the folder against each other, without computing anything again."""
    items = []
    page = folder / _PAGE
    if page.is_file():
        items += verify_images(page.read_text(encoding="utf-8", errors="replace"), folder)
    for key, file in posteriors.items():
        stated = output_entry(summary, key).get("posterior")
        items.append(
            verify_summary(f"{key}.nc", file, stated if isinstance(stated, Mapping) else {})
        )
    return items


def _named_rightly(
    manifest: Manifest, folder: Path, tasks: tuple[Task, ...], *, same_code: bool
) -> list[Item]:
    items = []
    for task in tasks:
        said = manifest.tasks[task.output]
        items.append(verify_label(said.data.file, task.table, said.label))
        items.append(verify_priors(task.output, said, folder, same_code=same_code))
    return items


def _density(task: Task, file: DrawsFile) -> Item:
    name = f"{task.output}.nc"
    try:
        problem = build_problem(task.model, fitted_rows(task)[0], task.prior_path)
    except CalibError as error:
        return Item(POSTERIORS, name, Status.DIFFERENT, note=error.message)
    return verify_density(name, file, problem)
