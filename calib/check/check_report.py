"""Check a report folder: its hashes, its inputs, and everything computed again from them."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from calib.batch.environment import sha256
from calib.batch.pool import Pool
from calib.check import compare, verify
from calib.check.check_comparison import check_compared
from calib.check.compare import Job
from calib.check.montecarlo import drawn_in_output
from calib.check.outcome import Item, claim
from calib.check.posteriors import GROUP as POSTERIORS
from calib.check.posteriors import verify_posterior
from calib.check.schema import MANIFEST, SUMMARY, Manifest
from calib.check.text import GROUP as TEXT
from calib.check.text import Judgement, read_text, verify_images
from calib.data import read_table
from calib.data.documents import inside, read_json
from calib.data.quantities import OUTPUTS
from calib.inference.problem import Problem, build_problem
from calib.report.compared import FOLDER
from calib.report.publish import publication
from calib.report.sections import SECTIONS, work_out
from calib.report.study import Progress, Study, estimate_task
from calib.report.study_tasks import Task, fitted_rows
from calib.report.summary import summarise_estimates
from calib.report.writer import write_report
from calib.validation.montecarlo import Place

_PAGE = "index.html"
_SEARCHES = (".genetic.", ".differential_evolution.")
# Where no number moved by more than this part, all that follow from them can be judged.
_LITTLE = 0.02


def check_report(manifest: Manifest, job: Job) -> list[Item]:
    """Return what was found in a report."""
    folder, same_code = job.folder, manifest.code == job.here.code
    inputs = [(f.file, f.sha256) for t in manifest.tasks.values() for f in (t.data, t.priors)]
    items = verify.files(folder, MANIFEST, manifest.files, more=inputs, left_out=manifest.left_out)
    summary = read_json(folder / SUMMARY)
    if (folder / _PAGE).is_file():
        items += verify_images(read_text(folder / _PAGE), folder)
    with compare.not_computed(items, folder, MANIFEST):
        tasks = report_tasks(manifest, folder, job.made.with_name("inputs"))
        for task in tasks:
            said, stated = manifest.tasks[task.output], inside(summary, "models", task.output)
            items.append(verify.label(said.data.file, task.table, said.label))
            items.append(verify.priors(task.output, said, folder, same_code=same_code))
            items += verify_posterior(
                folder / f"{task.output}.nc", partial(_problem, task), inside(stated, "posterior")
            )
            if job.quick:
                items += _estimates(task, stated, manifest, job)
        if job.quick:
            wrong = "left out on purpose, and not made again"
            items += [claim(POSTERIORS, name, wrong, sure=False) for name in manifest.left_out]
        else:
            study = recompute_report(manifest, tasks, job.made, job.progress, job.pool)
            numbers = _numbers(manifest, study, summary, job)
            items += numbers + _files(manifest, numbers, job)
        if "comparison" in manifest.sections:
            items += check_compared(manifest, tasks, job.inside(FOLDER))
    items += verify.form(folder) + verify.gaps(folder, summary, same_code=same_code)
    writers: dict[str, Callable[[], Mapping[str, str]]] = {
        f"{SUMMARY} and {MANIFEST}": lambda: publication(manifest.document, summary).files,
        **{kind.name: partial(kind.derived, folder, manifest.files) for kind in SECTIONS.values()},
    }
    return items + verify.derived(folder, manifest.files, writers, sure=same_code)


def report_tasks(manifest: Manifest, folder: Path, scratch: Path) -> tuple[Task, ...]:
    """Return the tasks of a report, with the folder's own data and priors.

    These are copied into `scratch` under their first names, which the page shows.
    """
    tasks = []
    for key, entry in manifest.tasks.items():
        said = entry.data
        table = read_table(folder / said.file, allow_missing=tuple(OUTPUTS.values()))
        table = replace(
            table, source=said.source, sha256=said.source_sha256, label=entry.label, text=(),
            header=said.header or table.header, ignored=said.ignored,
        )  # fmt: skip
        (scratch / key).mkdir(parents=True)
        priors = shutil.copyfile(folder / entry.priors.file, scratch / key / entry.priors.source)
        tasks.append(Task(key, entry.model, table, entry.held_out, priors))
    return tuple(tasks)


def _problem(task: Task) -> Problem:
    return build_problem(task.model, fitted_rows(task)[0], task.prior_path)


def recompute_report(
    manifest: Manifest, tasks: tuple[Task, ...], out: Path, progress: Progress, pool: Pool
) -> Study:
    """Work a report out again and write it into a new folder."""
    contents = work_out(
        tasks, manifest.seed, settings=manifest.settings, progress=progress, pool=pool,
        draw=True, pdf=manifest.pdf,
        sections=[SECTIONS[name].again(record) for name, record in manifest.sections.items()],
    )  # fmt: skip
    write_report(
        contents.study, out, sections=contents.found, pdf=manifest.pdf, settings=manifest.settings,
        command=manifest.command, title=manifest.title, environment=manifest.environment,
        drawn=contents.drawn, progress=progress, pool=pool,
    )  # fmt: skip
    return contents.study


def _estimates(task: Task, stated: Mapping[str, Any], manifest: Manifest, job: Job) -> list[Item]:
    """Compare the point estimates of an output, computed again without sampling."""
    place = (SUMMARY, "models", task.output)
    if "error" in stated:
        wrong = "it failed; to see whether it does again, check without --quick"
        name = f"{SUMMARY}: models.{task.output}"
        return [claim(f"{task.output}: error", name, wrong, sure=False)]
    found = summarise_estimates(*estimate_task(task, manifest.seed, progress=job.progress))
    return compare.estimates(job, place, found)


def _numbers(manifest: Manifest, study: Study, summary: Mapping[str, Any], job: Job) -> list[Item]:
    """Compare every document entry by entry, and name the inputs that do not belong to them."""
    n, drawn = compare.count_drawn(job.made), dict[Place, float | None]()
    for key, result in study.successes.items():
        steps = inside(summary, "models", key, "sampling").get("steps")
        sizes = drawn_in_output(result.calibration, result.validation, n, steps)
        drawn |= {(SUMMARY, "models", key, *path): size for path, size in sizes.items()}
    items = compare.document(SUMMARY, job, drawn)
    for key, task in manifest.tasks.items():
        points = [item for item in items if item.group == f"{key}: estimates"]
        points = [i for i in points if not any(search in i.name for search in _SEARCHES)]
        mode = [i for i in items if i.name.startswith(f"{SUMMARY}: models.{key}.sampling.mode.")]
        wrong = "most estimates in summary.json do not follow from these rows"
        other = "the posterior mode in summary.json does not follow from these priors and the data"
        blamed = verify.blame(points, task.data.file, wrong)
        items += blamed or verify.blame(mode, task.priors.file, other)
    for name in sorted(filter(compare.is_document, verify.files_in(job.made) - {SUMMARY})):
        items += compare.document(name, job)
    return items


def _files(manifest: Manifest, numbers: Iterable[Item], job: Job) -> list[Item]:
    """Compare every file but the documents and what follows from them."""
    same_program = manifest.environment.same_program(job.here)
    readings, moved = compare.moved_parts(numbers)

    def judged(name: str, section: str) -> Judgement:
        if name.startswith(("data/", "priors/")) or "/case/" in name:
            return Judgement()
        about = partial(_about, manifest, name, section)
        size = max((by for part, by in moved.items() if about(part)), default=0.0)
        if not same_program:
            return Judgement("another version wrote it", size, numbers=False)
        why = "its numbers moved within their tolerance" if any(map(about, readings)) else None
        return Judgement(why, size, size <= _LITTLE)

    made, items = verify.files_in(job.made), []
    for name in sorted(n for n in made - verify.derived_files(made) if not compare.is_document(n)):
        if name in manifest.left_out:
            same = sha256((job.made / name).read_bytes()) == manifest.left_out[name]
            wrong = "" if same else "left out on purpose; its summary is compared"
            right = "left out on purpose; made again, it has the recorded hash"
            items.append(claim(POSTERIORS, name, wrong, right, sure=False))
        else:
            items += compare.file(name, job, partial(judged, name), sure=same_program)
    # A comparison is checked as a folder of `calib compare`.
    inner = (f"{FOLDER}/",) if "comparison" in manifest.sections else ()
    strangers = set(manifest.files) - verify.derived_files(manifest.files) - made
    strangers = {name for name in strangers if not name.startswith(inner)}
    note = "this version makes no such file"
    return items + [claim(TEXT, name, note, sure=same_program) for name in sorted(strangers)]


def _about(manifest: Manifest, name: str, section: str, part: str) -> bool:
    """Whether a section of a page is about a part of a report: an output, a gap, or the audit."""
    if name.startswith("gaps/"):
        return part == f"gap: {name.split('/')[1]}"
    if section == "paper-gaps":
        return part.startswith("gap: ")
    if section == "audit" or section in manifest.tasks:
        return part == section
    # A comparison's words are those of the manifest's own numbers.
    return part in manifest.tasks and section != "comparison"
