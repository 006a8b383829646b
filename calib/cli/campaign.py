"""Verb of campaigns: many tasks of one plan, here or on a Dask cluster."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from calib.cli import options as opt
from calib.cli.machine import Json, finish


def campaign(
    plan: Annotated[Path, typer.Argument(help="TOML file with the tasks: docs/formats/inputs.md.")],
    out: Annotated[Path, typer.Option(help="Folder of results; resumed if it is there.")] = Path(
        "calib-campaign"
    ),
    workers: opt.Workers = 2,
    scheduler: opt.Scheduler = None,
    only_list: Annotated[
        bool, typer.Option("--list", help="Check the plan, list its tasks and stop.")
    ] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Do again what was made from other inputs.")
    ] = False,
    plugins: opt.Models = None,
    simulator: opt.Simulators = None,
    json: Json = False,
) -> None:
    """Run many fits, diagnoses, challenge cases or SBC replicates as tasks; run again to resume."""
    from calib.batch.campaign import read_plan, run_campaign
    from calib.cli.display import progress_bars
    from calib.data.labels import SEEN

    planned = read_plan(plan)
    if only_list:
        print("\n".join(planned.tasks))
        finish(0, {"tasks": list(planned.tasks)})
        return
    with progress_bars() as tell:
        summary = run_campaign(
            planned, out, workers=workers, scheduler=scheduler, overwrite=overwrite,
            progress=lambda done, n: tell("tasks", done, n), announce=opt.announce,
        )  # fmt: skip
    # Tasks of another process, or of before, have read them.
    labels = (numbers.get("data_label", "") for numbers in summary.numbers.values())
    SEEN.update(dict.fromkeys(filter(None, labels)))
    for name, error in summary.failed.items():
        print(f"calib: {name} failed: {error}", file=sys.stderr)
    counts = summary.counts
    print(f"{counts['done']} of {len(summary.kinds)} tasks done, {counts['failed']} failed")
    if summary.unconverged:
        print(f"NOT CONVERGED, not to be used: {', '.join(summary.unconverged)}")
    print(out / "summary.json")
    finish(1 if summary.failed else 3 if summary.unconverged else 0, out / "summary.json")
