"""Check a folder: hashes first, then everything computed again and compared."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any, Literal

from calib.batch.environment import Environment
from calib.batch.pool import HERE, Pool
from calib.check.check_report import check_report
from calib.check.check_run import check_run
from calib.check.outcome import Outcome
from calib.check.schema import Manifest, RunRecord, read_folder
from calib.report.study import Progress

__all__ = ["check"]


def check(
    folder: Path, *, quick: bool = False, progress: Progress | None = None, pool: Pool = HERE
) -> Outcome:
    """Compute a report or a run again from its own folder and compare.

    Parameters
    ----------
    folder : Path
        Written by `calib report` or `calib fit`; nothing in it is changed.
    quick : bool
        Skip the sampling: hashes, data, priors and point estimates only.
    progress : callable, optional
        Called with what is being done, steps done and steps planned.
    pool : Pool, optional
        Where a report is made again; what is found does not depend on it.

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
    with tempfile.TemporaryDirectory(prefix="calib-check-") as scratch:
        if isinstance(record, Manifest):
            items, allowed = check_report(
                record, folder, Path(scratch), here, tell, quick=quick, pool=pool
            )
        else:
            items, allowed = check_run(record, folder, Path(scratch), here, tell, quick=quick)
    kind: Literal["report", "run"] = "report" if isinstance(record, Manifest) else "run"
    differing = record.environment.differences(here)
    return Outcome(
        str(folder), kind, quick, tuple(items), differing, allowed, _not_converged(record, folder)
    )


def _not_converged(record: Manifest | RunRecord, folder: Path) -> tuple[str, ...]:
    """Models whose posterior is recorded as one that did not pass the gate.

    What is not as it should be in these records is found by comparing them.
    """
    try:
        if isinstance(record, RunRecord):
            gate: Any = record.document["gate"]
            return () if gate["passed"] else (record.model,)
        models = json.loads((folder / "summary.json").read_text(encoding="utf-8"))["models"]
        return tuple(m["model"] for m in models.values() if not m["sampling"]["converged"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return ()
