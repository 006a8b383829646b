"""Check a report folder: its hashes, its inputs, and everything computed again from them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from calib.batch.environment import sha256
from calib.check.check_comparison import check_comparison
from calib.check.compare import (
    blame,
    compare_document,
    compare_estimates,
    compare_file,
    count_drawn,
    is_document,
    moved_parts,
    part_of,
)
from calib.check.derived import derived_files, verify_derived, verify_form, verify_gaps
from calib.check.inputs import verify_files, verify_label, verify_priors
from calib.check.montecarlo import Errors, drawn_in_output
from calib.check.numbers import inside, read_json
from calib.check.outcome import Item, claim
from calib.check.posteriors import GROUP as POSTERIORS
from calib.check.posteriors import DrawsFile, read_draws, verify_density, verify_summary
from calib.check.recompute import Job, not_computed, recompute_report, report_tasks
from calib.check.schema import MANIFEST, SUMMARY, ComparisonRecord, Manifest, read_record
from calib.check.text import GROUP as TEXT
from calib.check.text import verify_images
from calib.data import Table, read_table
from calib.data.quantities import OUTPUTS
from calib.errors import CalibError
from calib.inference.problem import build_problem
from calib.models import get_model
from calib.report.compared import FOLDER
from calib.report.comparison import HELD_OUT
from calib.report.publish import publication
from calib.report.sections import SECTIONS
from calib.report.study import Study, estimate_task
from calib.report.study_tasks import Task, fitted_rows
from calib.report.summary import summarise_estimates

_PAGE = "index.html"
_SEARCHES = (".genetic.", ".differential_evolution.")


def check_report(manifest: Manifest, job: Job) -> list[Item]:
    """Return what was found in a report."""
    folder, same_code = job.folder, manifest.code == job.here.code
    inputs = [(f.file, f.sha256) for t in manifest.tasks.values() for f in (t.data, t.priors)]
    items = verify_files(folder, MANIFEST, manifest.files, more=inputs, left_out=manifest.left_out)
    summary = read_json(folder / SUMMARY)
    if (folder / _PAGE).is_file():
        text = (folder / _PAGE).read_text(encoding="utf-8", errors="replace")
        items += verify_images(text, folder)
    posteriors = dict[str, DrawsFile]()
    for key in manifest.tasks:
        if (folder / f"{key}.nc").is_file():
            try:
                posteriors[key] = read_draws(folder / f"{key}.nc")
            except CalibError as error:
                items.append(claim(POSTERIORS, f"{key}.nc", error.message))
    for key, file in posteriors.items():
        stated = inside(summary, "models", key, "posterior")
        items.append(verify_summary(f"{key}.nc", file, stated))
    with not_computed(items, folder, MANIFEST):
        tasks = report_tasks(manifest, folder, job.made.with_name("inputs"))
        for task in tasks:
            said = manifest.tasks[task.output]
            items.append(verify_label(said.data.file, task.table, said.label))
            items.append(verify_priors(task.output, said, folder, same_code=same_code))
            if task.output in posteriors:
                items.append(_density(task, posteriors[task.output]))
        if job.quick:
            note = "left out on purpose, and not made again"
            items += [claim(POSTERIORS, name, note, sure=False) for name in manifest.left_out]
            items += [item for task in tasks for item in _estimates(task, manifest, summary, job)]
        else:
            study = recompute_report(manifest, tasks, job.made, job.progress, job.pool)
            numbers = _numbers(manifest, study, summary, job)
            items += numbers + _files(manifest, numbers, job)
        if "comparison" in manifest.sections:
            items += _compared(manifest, tasks, job.inside(FOLDER))
    items += verify_form(folder) + verify_gaps(folder, summary, same_code=same_code)
    writers: dict[str, Callable[[], Mapping[str, str]]] = {
        f"{SUMMARY} and {MANIFEST}": lambda: publication(manifest.document, summary).files,
        **{kind.name: partial(kind.derived, folder, manifest.files) for kind in SECTIONS.values()},
    }
    return items + verify_derived(folder, manifest.files, writers, sure=same_code)


def _density(task: Task, file: DrawsFile) -> Item:
    try:
        problem = build_problem(task.model, fitted_rows(task)[0], task.prior_path)
    except CalibError as error:
        return claim(POSTERIORS, f"{task.output}.nc", error.message)
    return verify_density(f"{task.output}.nc", file, problem)


def _estimates(task: Task, manifest: Manifest, summary: Mapping[str, Any], job: Job) -> list[Item]:
    """Compare the point estimates of an output, computed again without sampling."""
    place, recorded = (SUMMARY, "models", task.output), inside(summary, "models", task.output)
    if "error" in recorded:
        note = "it failed; to see whether it does again, check without --quick"
        name = f"{SUMMARY}: models.{task.output}"
        return [claim(f"{task.output}: error", name, note, sure=False)]
    estimates, by_pressure = estimate_task(task, manifest.seed, progress=job.progress)
    return compare_estimates(place, recorded, summarise_estimates(estimates, by_pressure))


def _numbers(manifest: Manifest, study: Study, summary: Mapping[str, Any], job: Job) -> list[Item]:
    """Compare every document entry by entry, and name the inputs that do not belong to them."""
    n = count_drawn(job.made)
    drawn: Errors = {}
    for key, result in study.successes.items():
        steps = inside(summary, "models", key, "sampling").get("steps")
        sizes = drawn_in_output(result.calibration, result.validation, n, steps)
        drawn |= {(SUMMARY, "models", key, *path): size for path, size in sizes.items()}
    items = compare_document(SUMMARY, job, drawn)
    for key, task in manifest.tasks.items():
        own = [item for item in items if part_of(item.group) == key]
        points = [item for item in own if item.group.endswith("estimates")]
        points = [i for i in points if not any(search in i.name for search in _SEARCHES)]
        mode = [item for item in own if ".sampling.mode." in item.name]
        found = blame(points, task.data.file,
                      "most estimates in summary.json do not follow from these rows")  # fmt: skip
        items += found or blame(
            mode, task.priors.file,
            "the posterior mode in summary.json does not follow from these priors and the data",
        )  # fmt: skip
    others = sorted(name for name in _names(job.made) if is_document(name) and name != SUMMARY)
    return items + [item for name in others for item in compare_document(name, job)]


def _names(folder: Path) -> set[str]:
    return {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}


def _files(manifest: Manifest, numbers: Iterable[Item], job: Job) -> list[Item]:
    """Compare every file but the documents and what follows from them."""
    same_program = manifest.environment.same_program(job.here)
    readings, moved = moved_parts(numbers)

    def judged(name: str, section: str) -> tuple[str | None, bool]:
        if name.startswith(("data/", "priors/")) or "/case/" in name:
            return None, True
        if not same_program:
            return "another version wrote it", False
        about = _about(manifest, name, section)
        why = "its numbers moved within their tolerance" if about & readings else None
        return why, not about & moved

    made = _names(job.made)
    items = []
    for name in sorted(n for n in made - derived_files(made) if not is_document(n)):
        if name in manifest.left_out:
            same = sha256((job.made / name).read_bytes()) == manifest.left_out[name]
            wrong = "" if same else "left out on purpose; its summary is compared"
            right = "left out on purpose; made again, it has the recorded hash"
            items.append(claim(POSTERIORS, name, wrong, right, sure=False))
        else:
            items += compare_file(name, job, partial(judged, name), sure=same_program)
    strangers = set(manifest.files) - derived_files(manifest.files) - made
    if "comparison" in manifest.sections:
        # Checked as a folder of `calib compare`.
        strangers = {name for name in strangers if not name.startswith(f"{FOLDER}/")}
    note = "this version makes no such file"
    return items + [claim(TEXT, name, note, sure=same_program) for name in sorted(strangers)]


def _about(manifest: Manifest, name: str, section: str) -> set[str]:
    """Return the parts of a report that a section of a page is about."""
    if name.startswith("gaps/"):
        return {f"gap: {name.split('/')[1]}"}
    parts = {
        "paper-gaps": {f"gap: {gap}" for gap in inside(manifest.sections, "paper_gaps")},
        "audit": {"audit"},
        # A comparison's words are those of the manifest's own numbers.
        "comparison": set[str](),
    }
    return parts.get(section, {section} & set(manifest.tasks) or set(manifest.tasks))


def _compared(manifest: Manifest, tasks: Iterable[Task], job: Job) -> list[Item]:
    """Check the comparison of models in a report: of its rows and seed, stated as it was found."""
    record = read_record(ComparisonRecord, job.folder)
    items = [
        replace(item, name=f"{FOLDER}/{item.name}", group=f"{FOLDER}: {item.group}")
        for item in check_comparison(record, job)
    ]
    stated = inside(manifest.sections, "comparison")
    same = all(record.document.get(key) == value for key, value in stated.items())
    output = get_model(next(iter(record.models))).output
    fitted = {OUTPUTS[task.output]: fitted_rows(task) for task in tasks}
    rows, held = fitted.get(output, (None, None))
    kept = [(job.folder / "runs" / name / "data.csv", rows) for name in record.models]
    if record.held_out or held is not None:
        kept.append((job.folder / HELD_OUT, held))
    own = record.seed == manifest.seed and all(_has_rows(path, table) for path, table in kept)
    # By them values are shown in the units of the file.
    named = {OUTPUTS[key]: said.data.header for key, said in manifest.tasks.items()}
    for fits, name, what in (
        (same and {"models", "verdict", "seed"} <= stated.keys(),
         "manifest.json: comparison", "what its comparison.json has"),
        (own, f"{FOLDER}/comparison.json", "of the report's own rows and seed"),
        (record.header == named.get(output),
         f"{FOLDER}/comparison.json: header", "the column names of the report's own file"),
    ):  # fmt: skip
        items.append(claim(FOLDER, name, "" if fits else f"it is not {what}", what))
    return items


def _has_rows(path: Path, table: Table | None) -> bool:
    """Whether a file has the rows of a table."""
    if table is None:
        return False
    kept = read_table(path, allow_missing=tuple(OUTPUTS.values())).columns
    return kept.keys() == table.columns.keys() and all(
        np.array_equal(values, table[name], equal_nan=True) for name, values in kept.items()
    )
