"""The verb that checks a folder: everything computed again, and a verdict."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from calib.cli import options as opt
from calib.cli.machine import Json, finish
from calib.errors import CalibError


def check(
    folder: Annotated[Path, typer.Argument(help="Folder of `calib report`, `fit` or `compare`.")],
    quick: Annotated[
        bool, typer.Option("--quick", help="Skip the sampling: hashes, inputs and estimates only.")
    ] = False,
    every: Annotated[
        bool, typer.Option("--all", help="List every number, not only what is not the same.")
    ] = False,
    workers: opt.Workers = opt.CORES,
    plugins: opt.Models = None,
    simulator: opt.Simulators = None,
    json: Json = False,
) -> None:
    """Compute a folder's results again from that folder alone and compare everything.

    Ends with 0 where all is the same, 1 where something differs, 2 where it cannot be checked.
    """
    from calib.batch.plugins import load_files
    from calib.batch.pool import begin_imports, pool

    begin_imports(1 if quick else workers)
    from calib.check.check import check as find
    from calib.cli.check_display import show
    from calib.cli.display import progress_bars

    # A slow simulator is checked as it was emulated: nothing is run.
    load_files(sorted((folder / "emulators").glob("*.npz")))
    try:
        with pool(1 if quick else workers) as side, progress_bars() as tell:
            outcome = find(folder, quick=quick, progress=tell, pool=side, workers=workers)
    except CalibError as error:
        finish(0, {"folder": str(folder), "verdict": "cannot be checked", "reason": str(error),
                   "exit_code": 2})  # fmt: skip
        raise
    show(outcome, every=every)
    finish(outcome.exit_code, outcome.document())
