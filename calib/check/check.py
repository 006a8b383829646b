"""Check a report, a run or a comparison: hashes first, then everything computed again."""

from __future__ import annotations

import math
import shutil
import tempfile
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from calib.batch.environment import Environment, sha256
from calib.batch.pool import HERE
from calib.check import compare, verify
from calib.check.compare import POSTERIORS, Job, count_drawn, flatten, verify_posterior
from calib.check.outcome import Item, Outcome, Status, claim
from calib.check.tolerances import describe, drawn_in_comparison, drawn_in_output, drawn_in_run
from calib.check.verify import (
    MANIFEST,
    SUMMARY,
    TEXT,
    Manifest,
    read_folder,
    read_text,
    verify_images,
)
from calib.data import has_rows, read_table
from calib.data.files import inside, read_json
from calib.data.quantities import OUTPUTS
from calib.errors import CalibError
from calib.inference.calibration import Calibration
from calib.inference.io import (
    DATA,
    POSTERIOR,
    PRIORS,
    RUN,
    Record,
    RunRecord,
    describe_estimates,
    estimate_again,
    read_record,
    recompute_run,
    run_problem,
)
from calib.inference.problem import Problem, build_problem
from calib.models import get_model
from calib.report import comparison
from calib.report.comparison import (
    FILE,
    FOLDER,
    ComparisonRecord,
    problem_of,
    recompute_comparison,
)
from calib.report.document import summarise_estimates
from calib.report.publish import publication
from calib.report.sections import SECTIONS, work_out
from calib.report.study import Progress, Study, Task, estimate_task, fitted_rows
from calib.report.writer import write_report
from calib.validation.comparison import stacking_weights
from calib.validation.validate import Place


def check_run(record: RunRecord, job: Job) -> list[Item]:
    """Return what was found in a run."""
    items = verify_run(record, job.folder)
    with compare.not_computed(items, job.folder, RUN):
        problem = run_problem(record, job.folder / DATA)
        items += consistent_run(record, problem, job)
        if not job.quick:
            calibration = recompute_run(record, problem, job.made, job.progress)
            items += compare_run(record, calibration, job)
    return items


def verify_run(record: RunRecord, folder: Path) -> list[Item]:
    """Hold a run's files against their hashes, and its priors against the copy in its record."""
    missed = [(n, "") for n in (POSTERIOR, PRIORS, DATA) if n not in record.sha256]
    priors = {RUN: lambda: {PRIORS: record.prior_text}}
    return [
        *verify.files(folder, RUN, record.sha256, more=missed),
        *verify.derived(folder, (), priors, sure=True),
    ]


def consistent_run(record: RunRecord, problem: Problem, job: Job) -> list[Item]:
    """Hold the parts of a run against each other; of a quick check, its estimates too."""
    items = [verify.label(DATA, problem.table, record.data_label)]
    items += verify_posterior(job.folder / POSTERIOR, lambda: problem)
    if job.quick:
        again = {"estimates": describe_estimates(estimate_again(record, problem))}
        items += compare.estimates(job, (RUN,), again)
    return items


def compare_run(record: RunRecord, calibration: Calibration, job: Job) -> list[Item]:
    """Compare a run with the same sampled again, and written."""
    steps = inside(record.document, "gate").get("steps")
    drawn = drawn_in_run(calibration, compare.count_drawn(job.made), steps)
    items = compare.document(RUN, job, {(RUN, *path): size for path, size in drawn.items()})
    items += compare.file(POSTERIOR, job)
    mode = (item for item in items if item.name.startswith(f"{RUN}: mode."))
    wrong = "the posterior mode in run.json does not follow from the data and priors here"
    return items + verify.blame(mode, f"{DATA} or {PRIORS}", wrong)


_GROUP = "comparison"
# Of what follows from rows by arithmetic; weights by iterations that stop at a billionth.
_ROUNDING = 1e-6


def check_comparison(record: ComparisonRecord, job: Job) -> list[Item]:
    """Return what was found in a comparison."""
    items = verify.files(job.folder, FILE, record.files) + _follows(record, job)
    with compare.not_computed(items, job.folder, FILE):
        inner = {name: job.inside(f"runs/{name}") for name in record.models}
        runs = {name: read_record(RunRecord, of.folder) for name, of in inner.items()}
        data = {name: of.folder / DATA for name, of in inner.items()}
        problems = {name: problem_of(run, data[name], record) for name, run in runs.items()}
        for name, run in runs.items():
            found = verify_run(run, inner[name].folder)
            found += consistent_run(run, problems[name], inner[name])
            if run.model != name:
                found.append(claim(_GROUP, RUN, f"it is of the model {run.model}"))
            items += compare.within(f"runs/{name}", name, found)
        alike = len({path.read_bytes() for path in data.values()}) == 1
        wrong = "" if alike else "the models were fitted to different rows"
        right = "the rows of all models are the same"
        items.append(claim(_GROUP, f"runs/*/{DATA}", wrong, right))
        if not job.quick:
            job.made.mkdir()
            again = recompute_comparison(
                record, problems, job.folder, job.made, job.progress, job.workers
            )
            steps = {name: inside(r.document, "gate").get("steps") for name, r in runs.items()}
            drawn = drawn_in_comparison(again, compare.count_drawn(job.made), steps)
            sizes = {(FILE, "models", *place): size for place, size in drawn.items()}
            items += compare.document(FILE, job, sizes)
            for c in again.candidates:
                found = compare_run(runs[c.model], c.calibration, inner[c.model])
                items += compare.within(f"runs/{c.model}", c.model, found)
            same = record.environment.same_program(job.here)
            drawn_of = (i for i in items if i.found is not None)
            items += compare.file(comparison.FIGURE, job, sure=same, exact=compare.exact(drawn_of))
    return items


def _follows(record: ComparisonRecord, job: Job) -> list[Item]:
    """Check that what is said follows from the rows of all models, and the page from all of it."""
    rows = {name: np.array(m.elpd_rows) for name, m in record.models.items()}
    found: dict[str, object] = {"rows": "the same number for all models"}
    if len({r.size for r in rows.values()}) == 1:
        weights = stacking_weights(np.stack(list(rows.values()), axis=1))
        named = dict(zip(rows, weights.tolist(), strict=True))
        found = comparison.stated_of_rows(rows, named, record.unsound)
    items = []
    for place, value in flatten(found):
        stated = inside(record.document, *place[:-1]).get(place[-1])
        same = stated == value
        if isinstance(value, float) and isinstance(stated, int | float):
            same = math.isclose(stated, value, rel_tol=_ROUNDING, abs_tol=_ROUNDING)
        name = f"{FILE}: {'.'.join(place)}, as its elpd_rows give it"
        status = Status.IDENTICAL if same else Status.DIFFERENT
        items.append(Item(_GROUP, name, status, stated, value))

    def shown() -> dict[str, str]:
        image = (job.folder / comparison.FIGURE).read_bytes()
        return {comparison.PAGE: comparison.page(record.document, image)}

    sure = record.environment.same_program(job.here)
    return items + verify.derived(job.folder, (), {FILE: shown}, sure=sure)


def check_compared(manifest: Manifest, tasks: Iterable[Task], job: Job) -> list[Item]:
    """Check the comparison of models in a report: of its rows and seed, stated as it was found."""
    record = read_record(ComparisonRecord, job.folder)
    items = compare.within(FOLDER, FOLDER, check_comparison(record, job))
    stated = inside(manifest.sections, "comparison")
    same = {"models", "verdict", "seed"} <= stated.keys()
    same = same and stated.items() <= record.document.items()
    output = get_model(next(iter(record.models))).output
    [task] = [task for task in tasks if OUTPUTS[task.output] == output]
    rows, held = fitted_rows(task)
    own = record.seed == manifest.seed and bool(record.held_out) == (held is not None)
    own = own and all(has_rows(job.folder / "runs" / n / DATA, rows) for n in record.models)
    own = own and (held is None or has_rows(job.folder / comparison.HELD_OUT, held))
    # By the names of columns values are shown in the units of the file.
    header = record.header == manifest.tasks[task.output].data.header
    for fits, name, what in (
        (same, f"{MANIFEST}: comparison", "what its comparison.json has"),
        (own, f"{FOLDER}/{FILE}", "of the report's own rows and seed"),
        (header, f"{FOLDER}/{FILE}: header", "the column names of the report's own file"),
    ):
        items.append(claim(FOLDER, name, "" if fits else f"it is not {what}", what))
    return items


_PAGE = "index.html"
_SEARCHES = (".genetic.", ".differential_evolution.")


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
    if not manifest.views:
        writers = {}
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
    manifest: Manifest, tasks: tuple[Task, ...], out: Path, progress: Progress, pool: Executor
) -> Study:
    """Work a report out again and write it into a new folder."""
    report = work_out(
        tasks, manifest.seed, settings=manifest.settings, progress=progress, pool=pool,
        sections=[SECTIONS[name].again(record) for name, record in manifest.sections.items()],
    )  # fmt: skip
    write_report(
        report, out, pdf=manifest.pdf, settings=manifest.settings, command=manifest.command,
        title=manifest.title, environment=manifest.environment, progress=progress, pool=pool,
    )  # fmt: skip
    return report.study


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
    made = verify.files_in(job.made) if manifest.views else {*manifest.files, MANIFEST}
    for name in sorted(filter(compare.is_document, made - {SUMMARY})):
        items += compare.document(name, job)
    return items


def _files(manifest: Manifest, numbers: Iterable[Item], job: Job) -> list[Item]:
    """Compare every file but the documents and what follows from them."""
    numbers = list(numbers)
    same_program = manifest.environment.same_program(job.here)
    moved = compare.moved_parts(numbers)
    exact = compare.exact(numbers)
    made, items = verify.files_in(job.made), []
    if not manifest.views:
        made &= {*manifest.files, *manifest.left_out}
    for name in sorted(n for n in made - verify.derived_files(made) if not compare.is_document(n)):
        if name in manifest.left_out:
            same = sha256((job.made / name).read_bytes()) == manifest.left_out[name]
            wrong = "" if same else "left out on purpose; its summary is compared"
            right = "left out on purpose; made again, it has the recorded hash"
            items.append(claim(POSTERIORS, name, wrong, right, sure=False))
        else:
            own = name.startswith(("data/", "priors/")) or "/case/" in name
            shown = {f"gap: {name.split('/')[1]}"} if name.startswith("gaps/") else moved
            items += compare.file(
                name,
                job,
                sure=own or same_program,
                same_draws=own or not moved & shown,
                exact=own or exact,
            )
    # A comparison is checked as a folder of `calib compare`.
    inner = (f"{FOLDER}/",) if "comparison" in manifest.sections else ()
    strangers = set(manifest.files) - verify.derived_files(manifest.files) - made
    strangers = {name for name in strangers if not name.startswith(inner)}
    note = "this version makes no such file"
    return items + [claim(TEXT, name, note, sure=same_program) for name in sorted(strangers)]


_CHECKS: Mapping[str, Callable[[Any, Job], list[Item]]] = {
    "report": check_report, "run": check_run, "comparison": check_comparison,
}  # fmt: skip


def check(
    folder: Path, *, quick: bool = False, progress: Progress | None = None, pool: Executor = HERE,
    workers: int = 1,
) -> Outcome:  # fmt: skip
    """Compute a report, a run or a comparison again from its own folder and compare.

    Parameters
    ----------
    folder : Path
        Written by `calib report`, `calib fit` or `calib compare`; nothing in it is changed.
    quick : bool
        Skip the sampling: hashes, data, priors and point estimates only.
    progress : callable, optional
        Called with what is being done, steps done and steps planned.
    pool : Executor, optional
        Where a report is made again; what is found does not depend on it.
    workers : int
        Processes that leave rows out of a comparison.

    Raises
    ------
    CalibError
        If it cannot be checked: the folder is none of ours, or does not say how it was made.
    """
    folder = Path(folder)
    record = read_folder(folder)
    tell = progress or (lambda what, done, planned: None)
    with tempfile.TemporaryDirectory(prefix="calib-check-") as scratch:
        made, here = Path(scratch) / "again", Environment.here()
        job = Job(folder, made, tell, here, quick=quick, pool=pool, workers=workers)
        items = _CHECKS[record.kind](record, job)
        allowed = describe(count_drawn(made)) if made.is_dir() else ""
    differing = record.environment.differences(here)
    missed = _not_converged(record, folder)
    return Outcome(str(folder), record.kind, quick, tuple(items), differing, allowed, missed)


def _not_converged(record: Record, folder: Path) -> tuple[str, ...]:
    """Models whose posterior is recorded as one that did not pass the gate.

    What is not as it should be in these records is found by comparing them.
    """
    if isinstance(record, ComparisonRecord):
        return record.unsound
    gates = {str(record.document.get("model")): inside(record.document, "gate").get("passed")}
    for found in inside(read_json(folder / SUMMARY), "models").values():
        gates[str(inside(found).get("model"))] = inside(found, "sampling").get("converged")
    missed = [model for model, passed in gates.items() if passed is False]
    with suppress(CalibError):
        if record.kind == "report" and (folder / FOLDER).is_dir():
            missed += read_record(ComparisonRecord, folder / FOLDER).unsound
    return tuple(dict.fromkeys(missed))
