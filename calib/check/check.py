"""Check a folder: hashes first, then everything computed again and compared."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any, Literal

from calib.batch.environment import Environment
from calib.batch.pool import HERE, Pool
from calib.check.check_comparison import check_comparison
from calib.check.check_report import check_report
from calib.check.check_run import check_run
from calib.check.outcome import Outcome
from calib.check.schema import (
    ComparisonRecord,
    Manifest,
    Record,
    RunRecord,
    read_comparison,
    read_folder,
)
from calib.errors import CalibError
from calib.report.compared import FOLDER
from calib.report.study import Progress


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

    Returns
    -------
    Outcome

    Raises
    ------
    CalibError
        If it cannot be checked: the folder is none of ours, or does not say how it was made.
    """
    folder = Path(folder)
    record = read_folder(folder)
    here = Environment.here()
    tell = progress or (lambda what, done, planned: None)
    kind: Literal["report", "run", "comparison"]
    with tempfile.TemporaryDirectory(prefix="calib-check-") as name:
        scratch = Path(name)
        match record:
            case Manifest():
                kind = "report"
                items, allowed = check_report(
                    record, folder, scratch, here, tell, quick=quick, pool=pool, workers=workers
                )
            case ComparisonRecord():
                kind = "comparison"
                items, allowed = check_comparison(
                    record, folder, scratch, here, tell, quick=quick, workers=workers
                )
            case RunRecord():
                kind = "run"
                items, allowed = check_run(record, folder, scratch, tell, quick=quick)
    differing = record.environment.differences(here)
    return Outcome(
        str(folder), kind, quick, tuple(items), differing, allowed, _not_converged(record, folder)
    )


def _not_converged(record: Record, folder: Path) -> tuple[str, ...]:
    """Models whose posterior is recorded as one that did not pass the gate.

    What is not as it should be in these records is found by comparing them.
    """
    if isinstance(record, ComparisonRecord):
        return record.unsound
    try:
        if isinstance(record, RunRecord):
            gate: Any = record.document["gate"]
            return () if gate["passed"] else (record.model,)
        models = json.loads((folder / "summary.json").read_text(encoding="utf-8"))["models"]
        missed = [m["model"] for m in models.values() if not m["sampling"]["converged"]]
        if "comparison" in record.sections:
            missed += read_comparison(folder / FOLDER).unsound
        return tuple(dict.fromkeys(missed))
    except (OSError, ValueError, KeyError, TypeError, AttributeError, CalibError):
        return ()
