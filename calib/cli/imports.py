"""The command `import`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from calib.cli import options as opt
from calib.cli.options import announce, finish
from calib.errors import CalibError


def import_(
    files: Annotated[
        list[Path],
        typer.Argument(
            help="CSV or text, a workbook, .mat up to version 7, or Parquet; several files of one "
            "rig are put together, each with its number in a column run."
        ),
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

    import numpy as np

    from calib.batch.folders import check_room
    from calib.data import write_table
    from calib.imports import read_log, suggest_mapping

    images = [out.with_suffix(".png")]
    if len(files) > 1:
        images = [out.with_name(f"{out.stem}_{i}.png") for i in range(1, len(files) + 1)]
    for path in (out, *images):
        check_room(path)
        given = [p.resolve() for p in (*files, mapping) if p is not None]
        if path.exists() and (path.resolve() in given or not overwrite):
            wrong, hint = "the file exists already", "choose another --out, or pass --overwrite"
            raise CalibError(wrong, where=str(path), hint=hint)
    if mapping is None:
        mapping = out.with_suffix(".mapping.toml")
        if mapping.exists():
            wrong, hint = "there is a mapping already", f"pass --mapping {mapping}, or delete it"
            raise CalibError(wrong, where=str(mapping), hint=hint)
        text = suggest_mapping(files[0], sheet=sheet)
        print(text)
        _write(mapping, text)
        if not yes:
            announce(f"nothing is imported yet: look at {mapping}, and run again with")
            named = " ".join(map(str, files))
            announce(f"  calib import {named} --mapping {mapping} --out {out}")
            finish(2, {"mapping": str(mapping)})
    found = [read_log(file, mapping) for file in files]
    from calib.report.figures.imported import imported_figure
    from calib.report.figures.style import png_bytes

    drawn = [png_bytes(imported_figure(one)) for one in found]
    columns = {n: np.concatenate([one.columns[n] for one in found]) for n in found[0].columns}
    if len(found) > 1 and "run" not in columns:
        columns["run"] = np.repeat(
            np.arange(1, len(found) + 1), [one.report.rows_written for one in found]
        )
    write_table(out, columns)
    reports = []
    for i, (file, one, image) in enumerate(zip(files, found, images, strict=True), start=1):
        _write(image, drawn[i - 1])
        if len(files) > 1:
            print(f"run {i}: {file}")
        for line in one.report.lines():
            print(line)
        if one.report.warning:
            announce(one.report.warning)
        reports.append({**asdict(one.report), "picture": str(image)})
    print(out, *images, sep="\n")
    whole = {"runs": reports} if len(files) > 1 else reports[0]
    finish(0, {**whole, "out": str(out), "mapping": str(mapping)})


def _write(path: Path, content: str | bytes) -> None:
    from calib.batch.folders import write_whole

    try:
        write_whole(path, content)
    except OSError as error:
        wrong = f"the file cannot be written ({error.strerror})"
        raise CalibError(wrong, where=str(path), hint="choose another --out") from None
