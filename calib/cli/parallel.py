"""Options of verbs that do many independent tasks."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

__all__ = ["Scheduler", "Workers", "announce"]

Workers = Annotated[int, typer.Option(help="Processes on this machine.", min=1)]
Scheduler = Annotated[
    str | None,
    typer.Option(help="A Dask scheduler in the place of --workers, e.g. tcp://host:8786."),
]


def announce(line: str) -> None:
    """Say where the tasks are done."""
    print(f"calib: {line}", file=sys.stderr)
