"""Run a campaign: what is missing of it, here or on a Dask cluster."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from calib.batch.campaign.kinds import KINDS, Task
from calib.batch.campaign.plan import Plan
from calib.batch.campaign.record import RECORD, describe, discard_changed
from calib.batch.campaign.summary import NUMBERS, Summary, summarise, write_summary
from calib.batch.folders import check_folder, check_room, writing
from calib.batch.tasks import LateItems, check_names, run_folder_tasks
from calib.report.numbers import finite

PLAN = "plan.toml"


# Kind, seed, record and content of a task: all that a worker needs of it.
type _Item = tuple[str, int, Mapping[str, Any], Any]


def run_campaign(
    plan: Plan,
    out: Path,
    *,
    workers: int = 1,
    scheduler: str | None = None,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
    announce: Callable[[str], None] | None = None,
) -> Summary:
    """Do every task of a plan that has no result yet.

    Parameters
    ----------
    plan : Plan
    out : Path
        Gets ``results/<task>/`` with ``numbers.json``, ``task.json`` (what it was made from) and
        the files of its kind; ``results/failed.json`` and ``results/seconds.csv``; a
        ``summary.json`` and for each kind of task a CSV; and a copy of the plan.
    workers, scheduler, progress, announce
        As for `calib.batch.tasks.run_tasks`. The results do not depend on them.
    overwrite : bool
        Do again what was made from other data, another plan or other versions.

    Returns
    -------
    Summary

    Raises
    ------
    CalibError
        If the folder is not one of a campaign, holds results of something else, or there is no
        such cluster.
    """
    out, results = Path(out), Path(out) / "results"
    check_names(plan.tasks)
    if (out / PLAN).exists():
        check_room(out)
    else:
        check_folder(out)
    records = describe(plan.tasks.values())
    discard_changed(records, results, overwrite=overwrite)
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
        (out / PLAN).write_bytes(plan.text)

    def load(task: Task) -> _Item:
        return task.kind, task.seed, records[task.name], KINDS[task.kind].load(task)

    try:
        run_folder_tasks(
            _work, LateItems(plan.tasks, load), results,
            workers=workers, scheduler=scheduler, progress=progress, announce=announce,
        )  # fmt: skip
    finally:
        # An interrupted campaign has a summary too.
        summary = summarise(plan, results)
        write_summary(summary, out)
    return summary


def _work(item: _Item) -> dict[str, str | bytes]:
    kind, seed, record, content = item
    work = KINDS[kind].work(content, seed)
    numbers = json.dumps(finite(work.numbers), indent=1, allow_nan=False) + "\n"
    return {**work.files, NUMBERS: numbers, RECORD: json.dumps(record, indent=1) + "\n"}
