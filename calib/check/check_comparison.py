"""Check a folder of `calib compare`: its hashes, its runs, and the comparison made again."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from calib.check import compare, verify
from calib.check.check_run import compare_run, consistent_run, verify_run
from calib.check.compare import Job
from calib.check.montecarlo import drawn_in_comparison
from calib.check.numbers import flatten
from calib.check.outcome import Item, Status, claim
from calib.check.schema import MANIFEST, Manifest
from calib.data import has_rows
from calib.data.documents import inside
from calib.data.quantities import OUTPUTS
from calib.inference.record import DATA, RUN, RunRecord, read_record
from calib.models import get_model
from calib.report import comparison
from calib.report.again import problem_of, recompute_comparison
from calib.report.compared import FOLDER
from calib.report.comparison import FILE, ComparisonRecord
from calib.report.study_tasks import Task, fitted_rows
from calib.validation.comparison import stacking_weights

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
        same = len({path.read_bytes() for path in data.values()}) == 1
        wrong = "" if same else "the models were fitted to different rows"
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
            items += compare.file(comparison.FIGURE, job)
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
