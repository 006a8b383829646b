"""The verb that checks a folder: everything computed again, and a verdict."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from calib.cli.parallel import CORES, Models, Simulators, Workers
from calib.errors import CalibError

__all__ = ["register"]


def register(app: typer.Typer) -> None:
    """Add the verb to an app."""
    app.command()(check)


def check(
    folder: Annotated[Path, typer.Argument(help="Folder of `calib report`, `fit` or `compare`.")],
    quick: Annotated[
        bool, typer.Option("--quick", help="Skip the sampling: hashes, inputs and estimates only.")
    ] = False,
    every: Annotated[
        bool, typer.Option("--all", help="List every number, not only what is not the same.")
    ] = False,
    json_to: Annotated[
        Path | None, typer.Option("--json", help="File for machines to read; - prints it.")
    ] = None,
    workers: Workers = CORES,
    plugins: Models = None,
    simulator: Simulators = None,
) -> None:
    """Compute a folder's results again from that folder alone and compare everything.

    Ends with 0 where all is the same, 1 where something differs, 2 where it cannot be checked.
    """
    from calib.batch.plugins import load_files
    from calib.batch.pool import pool
    from calib.check.check import check as find
    from calib.cli.check_display import show
    from calib.cli.display import progress_bars

    # A slow simulator is checked as it was emulated: nothing is run.
    load_files(sorted((folder / "emulators").glob("*.npz")))
    try:
        with pool(1 if quick else workers) as side, progress_bars() as tell:
            outcome = find(folder, quick=quick, progress=tell, pool=side, workers=workers)
    except CalibError as error:
        if json_to is not None:
            document = {"folder": str(folder), "verdict": "cannot be checked", "reason": str(error),
                        "exit_code": 2}  # fmt: skip
            _write(json.dumps(document, indent=1), json_to)
        raise
    if json_to is not None:
        _write(json.dumps(outcome.document(), indent=1), json_to)
    if json_to is None or str(json_to) != "-":
        show(outcome, every=every)
    if outcome.exit_code:
        raise typer.Exit(outcome.exit_code)


def _write(text: str, path: Path) -> None:
    if str(path) == "-":
        print(text)
        return
    try:
        path.write_text(text + "\n", encoding="utf-8")
    except OSError as error:
        raise CalibError(
            f"the file cannot be written ({error.strerror})", where=str(path),
            mend="choose another file with --json",
        ) from None  # fmt: skip
