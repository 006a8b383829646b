"""Check a folder of `calib compare`: its hashes, its runs, and the comparison made again."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from calib.check.check_run import compare_run, consistent_run, verify_run
from calib.check.compare import compare_document, compare_file, count_drawn
from calib.check.derived import verify_derived
from calib.check.inputs import verify_files
from calib.check.montecarlo import drawn_in_comparison
from calib.check.numbers import flatten, inside
from calib.check.outcome import Item, Status, claim
from calib.check.recompute import Job, not_computed
from calib.check.schema import DATA, ComparisonRecord, RunRecord, read_record
from calib.data import Table, read_for_model
from calib.inference.io import run_problem
from calib.inference.problem import Problem
from calib.report.comparison import (
    FIGURE,
    FILE,
    HELD_OUT,
    PAGE,
    page,
    stated_of_rows,
    write_comparison,
)
from calib.validation.comparison import compare_problems, stacking_weights

_GROUP = "comparison"
# Of what follows from rows by arithmetic; weights by iterations that stop at a billionth.
_ROUNDING = 1e-6


def check_comparison(record: ComparisonRecord, job: Job) -> list[Item]:
    """Return what was found in a comparison."""
    folder = job.folder
    items = verify_files(folder, FILE, record.files) + _follows(record, job)
    with not_computed(items, folder, FILE):
        runs = {name: read_record(RunRecord, folder / "runs" / name) for name in record.models}
        problems = {
            name: _problem(run, folder / "runs" / name / DATA, record) for name, run in runs.items()
        }
        for name, run in runs.items():
            inner = job.inside(f"runs/{name}")
            found = verify_run(run, inner.folder) + consistent_run(run, problems[name], inner)
            if run.model != name:
                other = Item(
                    _GROUP, "run.json", Status.DIFFERENT, run.model, name, note="the model"
                )
                found.append(other)
            items += _of(name, found)
        same = len({(folder / "runs" / name / DATA).read_bytes() for name in runs}) == 1
        items.append(claim(_GROUP, "runs/*/data.csv",
                           "" if same else "the models were fitted to different rows",
                           "the rows of all models are the same"))  # fmt: skip
        if not job.quick:
            items += _compare_again(record, runs, problems, job)
    return items


def _compare_again(
    record: ComparisonRecord, runs: Mapping[str, RunRecord], problems: Mapping[str, Problem],
    job: Job,
) -> list[Item]:  # fmt: skip
    again = compare_problems(
        list(problems.values()), record.seed, held_out=_held_out(record, job.folder, problems),
        settings=record.settings, progress=job.progress, workers=job.workers,
    )  # fmt: skip
    # Differences are from the first, which may be another one with other draws.
    order = list(record.models)
    ranked = sorted(again.candidates, key=lambda c: order.index(c.model))
    again = replace(again, candidates=tuple(ranked))
    job.made.mkdir()
    write_comparison(
        again, job.made, record.command, record.held_out, environment=record.environment
    )
    steps = {name: inside(run.document, "gate").get("steps") for name, run in runs.items()}
    drawn = drawn_in_comparison(again, count_drawn(job.made), steps)
    items = compare_document(FILE, job, {(FILE, "models", *k): size for k, size in drawn.items()})
    for c in ranked:
        found = compare_run(runs[c.model], c.calibration, job.inside(f"runs/{c.model}"))
        items += _of(c.model, found)
    if (job.folder / FIGURE).is_file():
        items += compare_file(FIGURE, job, lambda section: (None, True))
    return items


def _follows(record: ComparisonRecord, job: Job) -> list[Item]:
    """Check that what is said follows from the rows of all models, and the page from all of it."""
    rows = {name: np.array(m.elpd_rows) for name, m in record.models.items()}
    found: dict[str, object] = {"rows": "the same number for all models"}
    if len({r.size for r in rows.values()}) == 1:
        weights = stacking_weights(np.stack(list(rows.values()), axis=1))
        named = dict(zip(rows, weights.tolist(), strict=True))
        found = stated_of_rows(rows, named, record.unsound)
    items = []
    for place, value in flatten(found):
        stated = inside(record.document, *place[:-1]).get(place[-1])
        same = stated == value
        if isinstance(value, float) and isinstance(stated, int | float):
            same = math.isclose(stated, value, rel_tol=_ROUNDING, abs_tol=_ROUNDING)
        name = f"{FILE}: {'.'.join(place)}, as its elpd_rows give it"
        status = Status.IDENTICAL if same else Status.DIFFERENT
        items.append(Item(_GROUP, name, status, stated, value))

    def written() -> dict[str, str]:
        return {PAGE: page(record.document, (job.folder / FIGURE).read_bytes())}

    sure = record.environment.same_program(job.here)
    return items + verify_derived(job.folder, (), {FILE: written}, sure=sure)


def _problem(run: RunRecord, data: Path, record: ComparisonRecord) -> Problem:
    """Return a run's problem, its columns named as in the file that was compared on.

    Units are shown by these names, where they are not those of the copy that is kept.
    """
    problem = run_problem(run.document, data)
    if not record.header:
        return problem
    return problem.with_table(replace(problem.table, header=record.header, text=()))


def _of(model: str, items: Iterable[Item]) -> list[Item]:
    """Name items after the run that they were found in."""
    return [
        replace(item, name=f"runs/{model}/{item.name}", group=f"{model}: {item.group}")
        for item in items
    ]


def _held_out(
    record: ComparisonRecord, folder: Path, problems: Mapping[str, Problem]
) -> Table | None:
    if not record.held_out:
        return None
    models = [p.bound.model for p in problems.values()]
    used = sorted({c for m in models for c in (*m.conditions, m.output)})
    return read_for_model(folder / HELD_OUT, used)
