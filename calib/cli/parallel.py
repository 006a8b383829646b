"""Options of verbs that do many independent tasks."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated

import typer

# As many processes as there are cores, of which two bring most of what there is to gain.
CORES = min(2, os.cpu_count() or 1)
Workers = Annotated[int, typer.Option(help="Processes on this machine.", min=1)]
Scheduler = Annotated[
    str | None,
    typer.Option(help="A Dask scheduler in the place of --workers, e.g. tcp://host:8786."),
]


def _load(paths: list[Path] | None) -> list[Path] | None:
    """Register what the files declare, before names are looked up."""
    from calib.batch.plugins import load_files

    load_files(paths or ())
    return paths


Models = Annotated[
    list[Path] | None,
    typer.Option(
        "--models",
        help="Python file that registers quantities, models or effects of your own; repeatable.",
        callback=_load,
        is_eager=True,
    ),
]


Simulators = Annotated[
    list[Path] | None,
    typer.Option(
        "--simulator",
        help="TOML file of a simulator of your own, whose command is run; repeatable.",
        callback=_load,
        is_eager=True,
    ),
]


def announce(line: str) -> None:
    """Say where the tasks are done."""
    print(f"calib: {line}", file=sys.stderr)
