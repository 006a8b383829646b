"""Compare the models of a folder of `calib compare` again, from its record alone."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

from calib.data import read_for_model
from calib.inference.io import run_problem
from calib.inference.problem import Problem
from calib.inference.record import RunRecord
from calib.report.comparison import HELD_OUT, ComparisonRecord, write_comparison
from calib.validation.comparison import Comparison, compare_problems


def recompute_comparison(
    record: ComparisonRecord, problems: Mapping[str, Problem], folder: Path, out: Path,
    progress: Callable[[str, int, int], None], workers: int,
) -> Comparison:  # fmt: skip
    """Compare the models of a folder again, and write that into an empty one, as in the record."""
    held_out = None
    if record.held_out:
        models = [p.bound.model for p in problems.values()]
        used = sorted({c for m in models for c in (*m.conditions, m.output)})
        held_out = read_for_model(folder / HELD_OUT, used)
    again = compare_problems(
        list(problems.values()), record.seed, held_out=held_out, settings=record.settings,
        progress=progress, workers=workers,
    )  # fmt: skip
    # Differences are from the first, which with other draws may not be the best.
    by_name = {c.model: c for c in again.candidates}
    again = replace(again, candidates=tuple(by_name[name] for name in record.models))
    write_comparison(again, out, record.command, record.held_out, environment=record.environment)
    return again


def problem_of(run: RunRecord, data: Path, record: ComparisonRecord) -> Problem:
    """Return a run's problem, its columns named as in the file that was compared on.

    Units are shown by these names, where they are not those of the copy that is kept.
    """
    problem = run_problem(run, data)
    if not record.header:
        return problem
    return problem.with_table(replace(problem.table, header=record.header, text=()))
