"""The verb that predicts: with a calibration, a stack of several, or a corrected model."""

from __future__ import annotations

import csv
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from calib.cli import options as opt
from calib.cli.machine import Json, finish
from calib.errors import CalibError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from calib.data import Table

# By which a file is known for a prediction: of a run, of one that did not converge, of a diagnosis.
_LAST_COLUMNS = ("outside_calibrated_range", "converged", "_after_upper")


def predict(
    run: Annotated[
        Path, typer.Argument(help="Folder of `calib fit`, `calib compare` or `calib diagnose`.")
    ],
    at: Annotated[Path, typer.Option(help="CSV with the conditions.")],
    out: Annotated[Path | None, typer.Option(help="CSV to write; printed if none.")] = None,
    effects: Annotated[
        Path | None, typer.Option(help="Python file with the effects of your own it was made with.")
    ] = None,
    without: Annotated[
        list[str] | None,
        typer.Option(
            help="Cause of a diagnosis that no longer acts, as of an "
            "instrument that was mended; repeatable."
        ),
    ] = None,
    overwrite: opt.Overwrite = False,
    plugins: opt.Models = None,
    simulator: opt.Simulators = None,
    json: Json = False,
) -> None:
    """Predict at new conditions: with 50, 90 and 95 % bands; a diagnosis with 90 % bands."""
    if out is not None and out.exists():
        _must_be_ours(out, at, overwrite)
    from calib import load_calibration
    from calib.batch.folders import check_room
    from calib.data import read_for_model
    from calib.data.checks import beyond_notes, check_conditions
    from calib.models.simulators.emulator import emulator_of
    from calib.report.comparison import load_stack, verdicts_of
    from calib.validation.prediction import MIN_DEFINED, predict_stacked, prediction_columns
    from calib.validation.prediction import predict as predict_at

    if out is not None:
        check_room(out)
    if (run / "corrected.json").exists():
        _predict_corrected(run, at, out, effects, without or [])
        return
    if effects is not None or without:
        raise CalibError(
            "there is no diagnosis, which alone has effects", where=str(run),
            expected="a folder of `calib diagnose`",
            hint="correct its name, or leave --effects and --without out",
        )  # fmt: skip
    if (run / "comparison.json").exists():
        found, parts = load_stack(run)
        converged = bool(found["converged"])
    else:
        parts = [(1.0, load_calibration(run))]
        converged = parts[0][1].converged
    if not converged:
        print("calib: this calibration did not converge; its bands are not to be used",
              file=sys.stderr)  # fmt: skip
    kept = verdicts_of(run)
    names = [c.problem.bound.model.name if len(parts) > 1 else "" for _, c in parts]
    used = dict.fromkeys(n for _, c in parts for n in c.problem.bound.model.conditions)
    table = read_for_model(at, tuple(used))
    known = {n: v for _, c in parts for n, v in c.problem.conditions.items()}
    check_conditions(table, known)
    doubts = list(dict.fromkeys(
        f"{name}: {doubt}" if name else doubt
        for name, (_, c) in zip(names, parts, strict=True)
        if (found_of := kept.get(name or c.problem.bound.model.name, kept.get(""))) is not None
        for doubt in found_of.for_rows(table.columns)
    ))  # fmt: skip
    for doubt in doubts:
        print(f"calib: {doubt}", file=sys.stderr)
    prediction = (
        predict_at(parts[0][1], table) if len(parts) == 1 else predict_stacked(parts, table)
    )
    columns = prediction_columns(prediction, table)
    if not converged:
        columns["converged"] = ["no"] * len(table)
    outside = sum(bool(flags) for flags in prediction.outside)
    if outside:
        lie = "row lies" if outside == 1 else "rows lie"
        print(
            f"warning: {outside} {lie} outside the calibrated range, where the prediction is not "
            "to be trusted", file=sys.stderr,
        )  # fmt: skip
        for note in beyond_notes(table, known):
            print(f"warning: {note}", file=sys.stderr)
    undefined = int((prediction.defined < MIN_DEFINED).sum())
    if undefined:
        emulated = any(emulator_of(c.problem.bound.model) is not None for _, c in parts)
        why = (
            "; an emulator ends where its runs do: give [ranges] in the simulator file, and fit "
            "again" if emulated else ": the model has none there for much of the posterior"
        )  # fmt: skip
        print(f"calib: no value (nan) at {undefined} of {len(table)} rows{why}", file=sys.stderr)
    _label(columns, *(c.problem.table for _, c in parts))
    _give(columns, out)
    finish(
        0 if converged else 3, {"columns": _lists(columns)}, outside=outside, doubts=doubts
    )  # fmt: skip


def _must_be_ours(out: Path, at: Path, overwrite: bool) -> None:
    """Refuse to replace a file unless it is a prediction, and that is wanted."""
    if not overwrite:
        raise CalibError(
            "the file exists already", where=str(out),
            hint="choose another --out, or pass --overwrite",
        )  # fmt: skip
    if at.exists() and out.samefile(at):
        raise CalibError(
            "it holds the conditions, which --out would replace", where=str(out),
            hint="choose another --out",
        )  # fmt: skip
    if not out.is_file():
        return
    with out.open(encoding="utf-8", errors="replace") as file:
        header = file.readline().strip()
    if header and not header.endswith(_LAST_COLUMNS):
        raise CalibError(
            "the file is no prediction, so it is not replaced", where=str(out),
            expected="a CSV that calib predict wrote", hint="choose another --out",
        )  # fmt: skip


def _predict_corrected(
    run: Path, at: Path, out: Path | None, effects: Path | None, without: Sequence[str]
) -> None:
    """Predict with the corrected model of a diagnosis, beside the calibrated simulator."""
    from calib.batch.plugins import load_files
    from calib.data import read_for_model
    from calib.gap.corrected import conditions_outside, load_corrected, predict_columns
    from calib.gap.effects import EFFECTS
    from calib.gap.effects.user import load_effects

    load_files(sorted((run / "emulators").glob("*.npz")))
    own = {} if effects is None else load_effects(effects)
    corrected = load_corrected(run, {**EFFECTS, **own})
    used = {c for o in corrected.data.outputs for c in o.problem.bound.model.conditions}
    table = read_for_model(at, sorted(used))
    columns = predict_columns(corrected, table, without)
    if "run_order" in corrected.data.view.conditions and "run_order" not in table:
        print("calib: no run_order is given: what depends on it is predicted as it stood at the "
              "end of the campaign", file=sys.stderr)  # fmt: skip
    if faults := [cause for cause in corrected.faults if cause not in without]:
        print(f"calib: what is predicted is the reading, with {', '.join(faults)} in it; once the "
              f"instrument is mended, predict --without {' --without '.join(faults)}",
              file=sys.stderr)  # fmt: skip
    beyond = conditions_outside(corrected, table)
    if beyond:
        told = ", ".join(f"{name} in {count} rows" for name, count in beyond.items())
        print(f"calib: outside what the campaigns covered: {told}", file=sys.stderr)
    _label(columns, corrected.data.case.lab, corrected.data.case.field)
    _give(columns, out)
    finish(0, {"columns": _lists(columns)}, outside=beyond)


def _label(columns: dict[str, Any], *tables: Table) -> None:
    """Say in a column what the data of a calibration must be called, if anything."""
    from calib.data.reader import common_label

    if label := common_label(*tables):
        # The last column stays last: by it a prediction is known.
        name, last = columns.popitem()
        columns |= {"data_label": [label] * len(last), name: last}


def _give(columns: Mapping[str, Any], out: Path | None) -> None:
    """Write columns to a file, or print them."""
    from calib.data import write_table

    if out is not None:
        write_table(out, {name: [_cell(c, "") for c in column] for name, column in columns.items()})
        print(f"{len(next(iter(columns.values())))} rows written to {out}")
        return
    writer = csv.writer(sys.stdout, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(map(_cell, row) for row in zip(*columns.values(), strict=True))


def _cell(cell: Any, empty: str = "nan") -> str:
    """Write a number with as many digits as draws of a posterior bear, and text as it is."""
    if isinstance(cell, str):
        return cell
    return (
        empty if math.isnan(cell) else f"{cell:.0f}" if float(cell).is_integer() else f"{cell:.6g}"
    )


def _lists(columns: Mapping[str, Any]) -> dict[str, list[float | str]]:
    return {name: [_number(cell) for cell in column] for name, column in columns.items()}


def _number(cell: Any) -> float | str:
    """Return a cell, which may be the user's own text, as a number if it is one."""
    try:
        return float(cell)
    except ValueError:
        return str(cell)
