"""Check a folder of `calib compare`: its hashes, its runs, and the comparison made again."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from calib.batch.environment import Environment
from calib.check.check_run import compare_run, consistent_run, estimates_of_run, verify_run
from calib.check.figures import compare_figure, thumbnails
from calib.check.inputs import verify_files
from calib.check.montecarlo import Place, count_compared, describe, drawn_in_comparison
from calib.check.numbers import compare_entries, flatten
from calib.check.outcome import Item, Status
from calib.check.recompute import not_computed
from calib.check.schema import ComparisonRecord, RunRecord, read_run
from calib.check.text import GROUP as TEXT
from calib.check.text import differing_lines
from calib.data import Table, read_for_model
from calib.errors import CalibError
from calib.inference.io import run_problem
from calib.inference.problem import Problem
from calib.report.comparison import FIGURE, FILE, HELD_OUT, PAGE, document, page, write_comparison
from calib.report.study import Progress
from calib.validation.comparison import (
    Comparison,
    compare_problems,
    difference,
    sentence,
    stacking_weights,
)

_GROUP = "comparison"
# Of what follows from rows by arithmetic; weights by iterations that stop at a billionth.
_ROUNDING = 1e-6
# Of the file itself, and what was taken over from it.
_NOT_COMPARED = ("files", "header", "command", "settings", "versions", "machine", "code")


def check_comparison(
    record: ComparisonRecord,
    folder: Path,
    scratch: Path,
    here: Environment,
    progress: Progress,
    *,
    quick: bool,
    workers: int = 1,
) -> tuple[list[Item], str]:
    """Return what was found in a comparison, and what Monte Carlo error was allowed, in words.

    `scratch` is an empty folder; `quick` skips the sampling.
    """
    items = verify_files(folder, record.files, FILE, {})
    items += _follows(record, folder, same_program=record.environment.same_program(here))
    allowed = ""
    with not_computed(items, folder, FILE):
        runs = {name: read_run(folder / "runs" / name) for name in record.models}
        problems = {
            name: _problem(run, folder / "runs" / name / "data.csv", record.header)
            for name, run in runs.items()
        }
        for name, run in runs.items():
            items += _inputs(name, run, folder, problems[name], quick=quick)
        items += _same_rows(problems)
        if not quick:
            again = compare_problems(
                list(problems.values()), record.seed, held_out=_held_out(record, folder, problems),
                settings=record.settings, progress=progress, workers=workers,
            )  # fmt: skip
            made = scratch / "again"
            made.mkdir()
            write_comparison(
                again, made, record.command, record.held_out, environment=record.environment
            )
            allowed = describe(count_compared(again))
            items += _numbers(record, runs, again)
            for c in again.candidates:
                path = Path("runs") / c.model
                found = compare_run(runs[c.model], c.calibration, folder / path, made / path)
                items += _of(c.model, found)
            if (folder / FIGURE).is_file():
                old, new = ((f / FIGURE).read_bytes() for f in (folder, made))
                items.append(compare_figure(FIGURE, old, new, partial(thumbnails, made)))
    return items, allowed


def _problem(run: RunRecord, data: Path, header: tuple[str, ...]) -> Problem:
    """Return a run's problem, its columns named as in the file that was compared on.

    Units are shown by these names, where they are not those of the copy that is kept.
    """
    problem = run_problem(run.document, data)
    if not header:
        return problem
    return problem.with_table(replace(problem.table, header=header, text=()))


def _of(model: str, items: Iterable[Item]) -> list[Item]:
    """Name items after the run that they were found in."""
    return [
        replace(item, name=f"runs/{model}/{item.name}", group=f"{model}: {item.group}")
        for item in items
    ]


def _inputs(
    name: str, run: RunRecord, folder: Path, problem: Problem, *, quick: bool
) -> list[Item]:
    path = folder / "runs" / name
    items = verify_run(run, path) + consistent_run(run, path, problem)
    if quick:
        items += estimates_of_run(run, path, problem)
    if run.model != name:
        items.append(Item(_GROUP, "run.json", Status.DIFFERENT, run.model, name, note="the model"))
    return _of(name, items)


def _same_rows(problems: Mapping[str, Problem]) -> list[Item]:
    """Check that all models were fitted to the same rows."""
    first, *others = problems.values()
    same = all(
        other.table.columns.keys() == first.table.columns.keys()
        and all(np.array_equal(v, first.table[c]) for c, v in other.table.columns.items())
        for other in others
    )
    status = Status.IDENTICAL if same else Status.DIFFERENT
    return [Item(_GROUP, "runs/*/data.csv", status, note="the rows of all models are the same"
                 if same else "the models were fitted to different rows")]  # fmt: skip


def _held_out(
    record: ComparisonRecord, folder: Path, problems: Mapping[str, Problem]
) -> Table | None:
    if not record.held_out:
        return None
    models = [p.bound.model for p in problems.values()]
    used = sorted({c for m in models for c in (*m.conditions, m.output)})
    return read_for_model(folder / HELD_OUT, used)


def _follows(record: ComparisonRecord, folder: Path, *, same_program: bool) -> list[Item]:
    """Check that all that is said follows from the rows, and the page from all of it."""
    items = []
    for path, value in _derived(record).items():
        stated = _at(record.document, path)
        same = math.isclose(stated, value, rel_tol=_ROUNDING, abs_tol=_ROUNDING) if (
            isinstance(value, float) and isinstance(stated, int | float)
        ) else stated == value  # fmt: skip
        status = Status.IDENTICAL if same else Status.DIFFERENT
        name = f"{FILE}: {'.'.join(path)}, as its elpd_rows give it"
        items.append(Item(_GROUP, name, status, stated, value))
    try:
        image, text = (folder / FIGURE).read_bytes(), (folder / PAGE).read_text(encoding="utf-8")
        expected = page(record.document, image)
    except (OSError, KeyError, ValueError, TypeError, AttributeError, CalibError) as error:
        note = f"it cannot be made from {FILE} ({type(error).__name__})"
        return [*items, Item(TEXT, PAGE, Status.DIFFERENT, note=note)]
    if text == expected:
        return [*items, Item(TEXT, PAGE, Status.IDENTICAL)]
    status = Status.DIFFERENT if same_program else Status.UNJUDGED
    note = differing_lines(text.splitlines(), expected.splitlines())
    return [*items, Item(TEXT, PAGE, status, note=note)]


def _derived(record: ComparisonRecord) -> dict[Place, Any]:
    """Work out from the rows of all models what is stated of them, by path."""
    rows = {name: np.array(m.elpd_rows) for name, m in record.models.items()}
    if len({r.size for r in rows.values()}) > 1:
        return {("rows",): "the same number for all models"}
    best = next(iter(rows))
    below = {name: difference(rows[best] - r) for name, r in rows.items()}
    weights = stacking_weights(np.stack(list(rows.values()), axis=1))
    found: dict[Place, Any] = {
        ("verdict",): sentence({name: d.clear for name, d in below.items()}, record.unsound),
        ("rows",): rows[best].size,
    }
    for (name, d), weight in zip(below.items(), weights, strict=True):
        found |= {
            ("models", name, "elpd"): float(rows[name].sum()),
            ("models", name, "below_best"): d.elpd,
            ("models", name, "below_best_se"): d.se,
            ("models", name, "told_apart"): d.clear,
            ("models", name, "weight"): float(weight),
        }
    return found


def _at(document: Any, path: Place) -> Any:
    for key in path:
        document = document.get(key) if isinstance(document, Mapping) else None
    return document


def _numbers(
    record: ComparisonRecord, runs: Mapping[str, RunRecord], again: Comparison
) -> list[Item]:
    """Compare the numbers, differences from the model that was the best in the record."""
    best = next(iter(record.models))
    found = json.loads(json.dumps(document(again, record.held_out, best)))
    steps = {name: _steps(run) for name, run in runs.items()}
    drawn = {
        (FILE, "models", *place): size
        for place, size in drawn_in_comparison(again, best, steps).items()
    }
    return compare_entries(_entries(record.document), _entries(found), lambda _: _GROUP, drawn)


def _steps(run: RunRecord) -> object:
    gate = run.document.get("gate")
    return gate.get("steps") if isinstance(gate, dict) else None


def _entries(content: Mapping[str, Any]) -> dict[Place, Any]:
    kept = {key: value for key, value in content.items() if key not in _NOT_COMPARED}
    return dict(flatten(kept, (FILE,)))
