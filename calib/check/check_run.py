"""Check a run folder: its hashes, its inputs, and its posterior sampled again from them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from calib.check.inputs import GROUP as INPUTS
from calib.check.inputs import verify_files, verify_label
from calib.check.montecarlo import Place, count_drawn, describe, drawn_in_run
from calib.check.numbers import compare_entries, flatten
from calib.check.outcome import Item, Status, mostly_different
from calib.check.posteriors import GROUP as POSTERIORS
from calib.check.posteriors import compare_posterior, read_draws, summary_of, verify_density
from calib.check.recompute import estimate_again, not_computed, recompute_run
from calib.check.schema import RunRecord
from calib.errors import CalibError
from calib.inference.calibration import Calibration
from calib.inference.io import describe_estimates, run_problem
from calib.inference.problem import Problem
from calib.report.study import Progress

_RECORD, _POSTERIOR, _PRIORS, _DATA = "run.json", "posterior.nc", "priors.toml", "data.csv"
_FILES = (_POSTERIOR, _PRIORS, _DATA)
# Durations, and hashes that are verified as such.
_NOT_COMPARED = ("seconds", "sha256")


def check_run(
    record: RunRecord,
    folder: Path,
    scratch: Path,
    progress: Progress,
    *,
    quick: bool,
) -> tuple[list[Item], str]:
    """Return what was found in a run, and what Monte Carlo error was allowed, in words.

    `scratch` is an empty folder; `quick` skips the sampling.
    """
    items = verify_run(record, folder)
    allowed = ""
    with not_computed(items, folder, _RECORD):
        problem = run_problem(record.document, folder / _DATA)
        items += consistent_run(record, folder, problem)
        if quick:
            items += estimates_of_run(record, folder, problem)
        else:
            calibration = recompute_run(record, problem, scratch / "again", progress)
            allowed = describe(count_drawn(calibration))
            items += compare_run(record, calibration, folder, scratch / "again")
    return items, allowed


def verify_run(record: RunRecord, folder: Path) -> list[Item]:
    """Hold the files of a run against their hashes."""
    items = verify_files(folder, record.sha256, _RECORD, {})
    return items + [
        Item(INPUTS, name, Status.DIFFERENT, note="run.json has no hash of it")
        for name in _FILES
        if name not in record.sha256
    ]


def estimates_of_run(record: RunRecord, folder: Path, problem: Problem) -> list[Item]:
    """Compare the point estimates alone, computed again without sampling."""
    again = {"estimates": describe_estimates(estimate_again(record, problem))}
    recorded = {"estimates": record.document["estimates"]}
    old, new = _entries(recorded, folder), _entries(again, folder)
    return [item for item in compare_entries(old, new, _group) if item.group == "estimates"]


def compare_run(
    record: RunRecord, calibration: Calibration, folder: Path, made: Path
) -> list[Item]:
    """Compare a run with the same sampled again, and written into the folder `made`."""
    again = json.loads((made / _RECORD).read_text(encoding="utf-8"))
    recorded, found = _entries(record.document, folder), _entries(again, made)
    if not any(path[1] == "posterior" for path in recorded):  # unreadable, which has been said
        found = {path: value for path, value in found.items() if path[1] != "posterior"}
    drawn = drawn_in_run(calibration, recorded.get((_RECORD, "gate", "steps")))
    sizes = {(_RECORD, *path): size for path, size in drawn.items()}
    items = compare_entries(recorded, found, _group, sizes)
    if (folder / _POSTERIOR).is_file():
        items += compare_posterior(_POSTERIOR, folder / _POSTERIOR, made / _POSTERIOR)
    return items + _blame(items)


def consistent_run(record: RunRecord, folder: Path, problem: Problem) -> list[Item]:
    """Hold the parts of the folder against each other, without computing anything again."""
    items = [verify_label(_DATA, problem.table, record.data_label)]
    priors = folder / _PRIORS
    if priors.is_file() and priors.read_text("utf-8", "replace") != record.prior_text:
        note = "not the priors that run.json repeats"
        items.append(Item(INPUTS, _PRIORS, Status.DIFFERENT, note=note))
    if (folder / _POSTERIOR).is_file():
        try:
            file = read_draws(folder / _POSTERIOR)
        except CalibError as error:
            return [*items, Item(POSTERIORS, _POSTERIOR, Status.DIFFERENT, note=error.message)]
        items.append(verify_density(_POSTERIOR, file, problem))
    return items


def _entries(record: Mapping[str, Any], folder: Path) -> dict[Place, Any]:
    """Return what is compared of a run: its record, and the summary of its draws."""
    document = {key: value for key, value in record.items() if key not in _NOT_COMPARED}
    with suppress(CalibError):
        document["posterior"] = summary_of(read_draws(folder / _POSTERIOR).draws)
    return dict(flatten(json.loads(json.dumps(document)), (_RECORD,)))


def _group(path: Place) -> str:
    if path[1] in ("posterior", "gate", "mode", "log_evidence", "efficiency", "acceptance",
                   "evaluations"):  # fmt: skip
        return "posterior"
    return "estimates" if path[1] == "estimates" else "what was computed"


def _blame(items: list[Item]) -> list[Item]:
    """Name the input that the recorded numbers cannot have been computed from."""
    mode = [item for item in items if item.name.startswith(f"{_RECORD}: mode.")]
    if not mostly_different(mode):
        return []
    note = "the posterior mode in run.json does not follow from the data and priors here"
    return [Item(INPUTS, f"{_DATA} or {_PRIORS}", Status.DIFFERENT, note=note)]
