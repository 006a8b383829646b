"""Options that several verbs have."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

Seed = Annotated[int, typer.Option(help="Same seed, same numbers.", min=0)]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace an earlier result.")]
HoldOutOption = Annotated[
    str | None,
    typer.Option("--hold-out", help="Rows kept for validation, e.g. inflation_pressure_psi=30."),
]
MaxSteps = Annotated[int, typer.Option(help="Where extending the chains stops.", min=100)]
PriorFiles = Annotated[list[Path] | None, typer.Option(help="Prior file of a model; repeatable.")]
# As many processes as there are cores, of which two bring most of what there is to gain.
CORES = min(2, os.cpu_count() or 1)
Workers = Annotated[int, typer.Option(help="Processes on this machine.", min=1, max=1024)]
Scheduler = Annotated[
    str | None,
    typer.Option(help="A Dask scheduler in the place of --workers, e.g. tcp://host:8786."),
]


def _load(paths: list[Path] | None) -> list[Path] | None:
    """Register what the files declare, before names are looked up."""
    from calib.batch.plugins import load_files

    load_files(paths or ())
    return paths


def _files(name: str, what: str, *, first: bool) -> Any:
    return typer.Option(name, help=f"{what}; repeatable.", callback=_load, is_eager=first)


Models = Annotated[
    list[Path] | None,
    _files(
        "--models",
        "Python file that registers quantities, models or effects of your own",
        first=True,
    ),
]
Simulators = Annotated[
    list[Path] | None,
    _files(
        "--simulator", "TOML file of a simulator of your own, whose command is run", first=False
    ),
]


def command() -> list[str]:
    """Return the command line without the folder the program was started from."""
    from calib.data.documents import writable

    return ["calib", *map(writable, sys.argv[1:])]


def announce(line: str) -> None:
    """Say where the tasks are done."""
    print(f"calib: {line}", file=sys.stderr)
