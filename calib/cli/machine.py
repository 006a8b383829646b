"""`--json`: one object for programs on the output, and nothing else there."""

from __future__ import annotations

import io
import json
import sys
from collections.abc import Mapping
from contextlib import redirect_stdout
from pathlib import Path
from typing import Annotated, Any, TextIO

import typer

from calib.report.numbers import finite


class _Aside(io.TextIOBase):
    """An output that forgets what it is told, before the one that a program reads."""

    def __init__(self, output: TextIO) -> None:
        self.output = output

    def write(self, text: str) -> int:
        return len(text)


def _turn(ctx: typer.Context, wanted: bool) -> bool:
    """Keep words for people from the output, until the command has ended."""
    if wanted:
        ctx.with_resource(redirect_stdout(_Aside(sys.stdout)))
    return wanted


Json = Annotated[
    bool,
    typer.Option("--json", help="Print one JSON object in the place of words.", callback=_turn),
]


def finish(code: int, found: Mapping[str, Any] | Path, **more: Any) -> None:
    """Print what was found if JSON is asked for, and end with an exit code.

    It is a document, or the JSON file that holds it; `more` stands before it. What is not finite is
    null.
    """
    if isinstance(sys.stdout, _Aside):
        from calib.data.labels import SEEN

        document = found if isinstance(found, Mapping) else json.loads(found.read_bytes())
        data = {"data_label": ", ".join(SEEN)} if SEEN else {}
        whole = finite({"exit_code": code, **more, **data, **document})
        sys.stdout.output.write(json.dumps(whole, indent=1, allow_nan=False) + "\n")
    if code:
        raise typer.Exit(code)
