"""Check a folder: hashes first, then everything computed again and compared."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from calib.batch.environment import Environment
from calib.batch.pool import HERE, Pool
from calib.check.check_comparison import check_comparison
from calib.check.check_report import check_report
from calib.check.check_run import check_run
from calib.check.compare import Job, count_drawn
from calib.check.montecarlo import describe
from calib.check.outcome import Item, Outcome
from calib.check.schema import SUMMARY, read_folder
from calib.data.documents import inside, read_json
from calib.errors import CalibError
from calib.inference.record import Record, read_record
from calib.report.compared import FOLDER
from calib.report.comparison import ComparisonRecord
from calib.report.study import Progress

_CHECKS: Mapping[str, Callable[[Any, Job], list[Item]]] = {
    "report": check_report, "run": check_run, "comparison": check_comparison,
}  # fmt: skip


def check(
    folder: Path, *, quick: bool = False, progress: Progress | None = None, pool: Pool = HERE,
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
    pool : Pool, optional
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
