"""Options of verbs that do many independent tasks."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated

import typer

__all__ = ["Scheduler", "Workers", "announce", "resumable"]

Workers = Annotated[int, typer.Option(help="Processes on this machine.", min=1)]
Scheduler = Annotated[
    str | None,
    typer.Option(help="A Dask scheduler in the place of --workers, e.g. tcp://host:8786."),
]


@contextmanager
def resumable() -> Iterator[None]:
    """Say what an interruption leaves."""
    try:
        yield
    except KeyboardInterrupt as stop:
        print(f"calib: {stop or 'interrupted'}", file=sys.stderr)
        raise typer.Exit(130) from None


def announce(line: str) -> None:
    """Say where the tasks are done."""
    print(f"calib: {line}", file=sys.stderr)
