"""The command `import`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from calib.cli import options as opt
from calib.cli.options import announce, finish
from calib.errors import CalibError


def import_(
    file: Annotated[
        Path, typer.Argument(help="CSV or text, a workbook, .mat up to version 7, or Parquet.")
    ],
    out: Annotated[
        Path, typer.Option("--out", "-o", help="CSV to write; a picture of it stands beside it.")
    ],
    mapping: Annotated[
        Path | None,
        typer.Option(help="TOML file that says which column is what; one is suggested if none."),
    ] = None,
    sheet: Annotated[str, typer.Option(help="Sheet of a workbook, for the suggestion.")] = "",
    yes: Annotated[
        bool, typer.Option("--yes", help="Accept the mapping that is suggested and shown.")
    ] = False,
    overwrite: opt.Overwrite = False,
    plugins: opt.Models = None,
    json: opt.Json = False,
) -> None:
    """Turn a rig's file into a CSV of calib's columns, by a mapping that you have seen."""
    from dataclasses import asdict

    from calib.batch.folders import check_room
    from calib.data import write_table
    from calib.imports import read_log, suggest_mapping

    image = out.with_suffix(".png")
    for path in (out, image):
        check_room(path)
        given = [p.resolve() for p in (file, mapping) if p is not None]
        if path.exists() and (path.resolve() in given or not overwrite):
            wrong, hint = "the file exists already", "choose another --out, or pass --overwrite"
            raise CalibError(wrong, where=str(path), hint=hint)
    if mapping is None:
        mapping = out.with_suffix(".mapping.toml")
        if mapping.exists():
            wrong, hint = "there is a mapping already", f"pass --mapping {mapping}, or delete it"
            raise CalibError(wrong, where=str(mapping), hint=hint)
        text = suggest_mapping(file, sheet=sheet)
        print(text)
        _write(mapping, text)
        if not yes:
            announce(f"nothing is imported yet: look at {mapping}, and run again with")
            announce(f"  calib import {file} --mapping {mapping} --out {out}")
            finish(2, {"mapping": str(mapping)})
    found = read_log(file, mapping)
    from calib.report.figures.imported import imported_figure
    from calib.report.figures.style import png_bytes

    drawn = png_bytes(imported_figure(found))
    write_table(out, found.columns)
    _write(image, drawn)
    for line in found.report.lines():
        print(line)
    if found.report.warning:
        announce(found.report.warning)
    print(out, image, sep="\n")
    finish(
        0, {**asdict(found.report), "out": str(out), "picture": str(image), "mapping": str(mapping)}
    )


def _write(path: Path, content: str | bytes) -> None:
    from calib.batch.folders import write_whole

    try:
        write_whole(path, content)
    except OSError as error:
        wrong = f"the file cannot be written ({error.strerror})"
        raise CalibError(wrong, where=str(path), hint="choose another --out") from None
