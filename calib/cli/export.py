"""The command `export`: a calibration in the format of another program."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from calib.cli import options as opt
from calib.cli.options import announce, finish
from calib.errors import CalibError, meant
from calib.report.numbers import finite

if TYPE_CHECKING:
    from calib.inference.calibration import Calibration


class Wanted(NamedTuple):
    """What a format is asked for beside the posterior median."""

    out: Path
    at: Mapping[str, float]
    draws: int
    each: bool
    form: str


def export(
    run: Annotated[
        Path, typer.Argument(help="Run folder of `calib fit`; with --ro-crate any that checks.")
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="File (or folder) to write.")],
    form: Annotated[
        str,
        typer.Option(
            "--format",
            help="csv, json, parquet: draws of the parameters. tir: sections of a tyre property "
            "file. By default the ending of --out.",
        ),
    ] = "",
    at: Annotated[
        list[str] | None,
        typer.Option(
            help="Condition that a tyre property file is for, e.g. inflation_pressure_psi=30; "
            "repeatable."
        ),
    ] = None,
    draws: Annotated[
        int,
        typer.Option(
            help="Draws of the posterior, a row each, evenly spaced; beside a tyre property file.",
            min=0,
        ),
    ] = 0,
    each: Annotated[bool, typer.Option("--each", help="Also write a file of each draw.")] = False,
    overwrite: opt.Overwrite = False,
    ro_crate: Annotated[
        bool,
        typer.Option("--ro-crate", help="Pack it as a research object: a folder, or a .zip file."),
    ] = False,
    licence: Annotated[
        str, typer.Option("--license", help="Licence of the research object, e.g. CC-BY-4.0.")
    ] = "",
    author: Annotated[
        list[str] | None, typer.Option(help="Its author, with an ORCID if any; repeatable.")
    ] = None,
    plugins: opt.Models = None,
    simulator: opt.Simulators = None,
    json: opt.Json = False,
) -> None:
    """Write a calibrated model in the format of another program."""
    from calib import load_calibration
    from calib.batch.folders import write_whole, writing

    if ro_crate:
        from calib.checking.crate import write_crate

        packed = write_crate(run, out, licence=licence, authors=author or (), models=plugins or ())
        print(f"{len(packed)} files packed; README.md in it says how to compute them again")
        print(out)
        finish(0, {"crate": str(out), "files": packed})
        return
    form = form or out.suffix.removeprefix(".")
    if form not in FORMATS:
        hint = meant(form, FORMATS, "use one of these")
        raise CalibError(f"there is no format {form!r}", expected=", ".join(FORMATS), hint=hint)
    if each and not draws:
        raise CalibError("--each is for draws, and none are asked for", hint="add --draws N")
    conditions = dict(opt.column_value("--at", text) for text in at or ())
    calibration = load_calibration(run)
    if not calibration.converged:
        announce("this calibration did not converge; it is not to be used")
    wanted = Wanted(out, conditions, draws, each, form)
    files, said = FORMATS[form](calibration, wanted)
    for path in filter(Path.exists, files):
        if not overwrite:
            hint = "choose another --out, or pass --overwrite"
            raise CalibError("the file exists already", where=str(path), hint=hint)
        begun = files[path][:6]
        begun = begun if isinstance(begun, bytes) else begun.encode()
        if not (path.is_file() and path.read_bytes().startswith(begun)):
            found, hint = "what is there is no earlier export", "choose another --out"
            raise CalibError(found, where=str(path), hint=hint)
    print(said)
    with writing(out):
        for path, text in files.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            write_whole(path, text)
    for path in list(files)[:2]:
        print(path)
    finish(0 if calibration.converged else 3, {"files": [str(path) for path in files]})


def _parameters(calibration: Calibration, wanted: Wanted) -> Written:
    """Return draws of all parameters that vary, sampled and published, evenly spaced."""
    from calib.data.files import table_csv
    from calib.report.markup import to_text

    if wanted.at or wanted.each:
        raise CalibError(
            "draws of parameters are for no condition, and one file", where=str(wanted.out),
            hint="leave --at and --each out, or write a tyre property file: --format tir",
        )  # fmt: skip
    problem, picked = calibration.problem, calibration.picked(wanted.draws or 1000)
    model, n = problem.bound.model, len(picked)
    draws = {name: v.ravel()[picked].tolist() for name, v in calibration.parameters.items()}
    units = {name: calibration.summary[name].unit for name in draws}
    columns = {"draw": list(range(1, n + 1))}
    columns |= {f"{name} [{units[name]}]": values for name, values in draws.items()}
    entries: dict[str, dict[str, Any]] = {
        name: {
            "unit": unit, "meaning": model.meanings.get(name, ""), "sampled": name in problem.names,
        }
        for name, unit in units.items()
    }  # fmt: skip
    document = {
        "schema": "calib/draws/1", "model": model.name, "equation": model.equation,
        "output": model.output, "response": model.response, "conditions": list(model.conditions),
        "letters": to_text(model.letters),
        "references": dict(problem.bound.references), "noise": asdict(problem.noise),
        "fixed": {p.name: p.loc for p in problem.priors.entries if p.fixed},
        "converged": calibration.converged, "data_label": problem.table.label, "draws": n,
        "of_draws": len(calibration.draws.flat), "parameters": entries,
    }  # fmt: skip
    content: str | bytes
    if wanted.form == "csv":
        content = table_csv(columns)
    elif wanted.form == "json":
        for name, values in draws.items():
            entries[name]["values"] = values
        content = _json_text(document)
    else:
        content = _parquet(columns, _json_text(document), wanted.out)
    return {wanted.out: content}, f"{n} of {document['of_draws']} draws, evenly spaced"


def _json_text(document: Mapping[str, Any]) -> str:
    return dumps(finite(document), ensure_ascii=False, allow_nan=False) + "\n"


def _parquet(columns: Mapping[str, list[Any]], described: str, out: Path) -> bytes:
    """Return a Parquet file, described in its metadata."""
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError as error:
        raise CalibError(
            f"a package that writes such files is not installed ({error})", where=str(out),
            hint="install it: pip install 'terracalib[import]'; or write CSV",
        ) from None  # fmt: skip
    file = pyarrow.BufferOutputStream()
    table = pyarrow.table(dict(columns)).replace_schema_metadata({"calib": described})
    parquet.write_table(table, file)
    return bytes(file.getvalue().to_pybytes())


def _tir(calibration: Calibration, wanted: Wanted) -> Written:
    """Return the files with their texts, and what to say of them."""
    from calib.data.files import table_csv
    from calib.inference.tyre import tir_draws, to_tir
    from calib.models.tir import FORCE

    out, tyre = wanted.out, to_tir(calibration, at=wanted.at)
    files: dict[Path, str | bytes] = {out: tyre.text}
    said = "\n".join(tyre.comments)
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


# Files by their paths, and what to say of them.
type Written = tuple[dict[Path, str | bytes], str]
FORMATS: Mapping[str, Callable[[Calibration, Wanted], Written]] = {
    "csv": _parameters, "json": _parameters, "parquet": _parameters, "tir": _tir,
}  # fmt: skip
