"""The command `export`: a calibration in the format of another program."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

from calib.cli import options as opt
from calib.cli.options import announce, finish
from calib.errors import CalibError, meant

if TYPE_CHECKING:
    from calib.inference.calibration import Calibration


class Wanted(NamedTuple):
    """What a format is asked for beside the posterior median."""

    out: Path
    at: Mapping[str, float]
    draws: int
    each: bool


def export(
    run: Annotated[Path, typer.Argument(help="Run folder of `calib fit`.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="File to write.")],
    form: Annotated[
        str, typer.Option("--format", help="tir: sections of a tyre property file.")
    ] = "tir",
    at: Annotated[
        list[str] | None,
        typer.Option(
            help="Condition that the file is for, e.g. inflation_pressure_psi=30; repeatable."
        ),
    ] = None,
    draws: Annotated[
        int, typer.Option(help="Draws of the posterior to write beside it, a row each.", min=0)
    ] = 0,
    each: Annotated[bool, typer.Option("--each", help="Also write a file of each draw.")] = False,
    plugins: opt.Models = None,
    simulator: opt.Simulators = None,
    json: opt.Json = False,
) -> None:
    """Write a calibrated model in the format of another program."""
    from calib import load_calibration
    from calib.batch.folders import write_whole, writing

    if form not in FORMATS:
        hint = meant(form, FORMATS, "use one of these")
        raise CalibError(f"there is no format {form!r}", expected=", ".join(FORMATS), hint=hint)
    if each and not draws:
        raise CalibError("--each is for draws, and none are asked for", hint="add --draws N")
    conditions = dict(map(condition, at or ()))
    calibration = load_calibration(run)
    if not calibration.converged:
        announce("this calibration did not converge; it is not to be used")
    wanted = Wanted(out, conditions, draws, each)
    files, said = FORMATS[form](calibration, wanted)
    if there := [path for path in files if path.exists()]:
        raise CalibError(
            "the file exists already", where=str(there[0]), hint="choose another --out"
        )
    print(said)
    with writing(out):
        for path, text in files.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            write_whole(path, text)
    for path in list(files)[:2]:
        print(path)
    finish(0 if calibration.converged else 3, {"files": [str(path) for path in files]})


def condition(text: str, option: str = "--at") -> tuple[str, float]:
    """Read an option such as inflation_pressure_psi=30."""
    column, _, value = text.partition("=")
    try:
        return column.strip(), float(value)
    except ValueError:
        raise CalibError(
            f"cannot read {option} {text!r}",
            expected="COLUMN=VALUE, for instance inflation_pressure_psi=30",
            hint="name a column with its unit, an equals sign and one number",
        ) from None


def _tir(calibration: Calibration, wanted: Wanted) -> tuple[dict[Path, str], str]:
    """Return the files with their texts, and what to say of them."""
    from calib.data.files import table_csv
    from calib.inference.tyre import tir_draws, to_tir
    from calib.models.tir import FORCE

    out, tyre = wanted.out, to_tir(calibration, at=wanted.at)
    files, said = {out: tyre.text}, "\n".join(tyre.comments)
    if not wanted.draws:
        return files, said
    drawn = tir_draws(calibration, wanted.draws, at=wanted.at)
    rows = [{**one.sections["VERTICAL"], **one.sections[FORCE]} for one in drawn]
    columns = {"draw": range(1, len(rows) + 1)} | {k: [row[k] for row in rows] for k in rows[0]}
    beside = out.with_name(f"{out.stem}_draws")
    files[beside.with_suffix(".csv")] = table_csv(columns)
    if wanted.each:
        files |= {beside / f"{i:04}.tir": one.text for i, one in enumerate(drawn, start=1)}
    return files, said


FORMATS: Mapping[str, Callable[[Calibration, Wanted], tuple[dict[Path, str], str]]] = {"tir": _tir}
