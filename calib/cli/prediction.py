"""The commands `diagnose` and `predict`."""

from __future__ import annotations

import csv
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from calib.cli import options as opt
from calib.cli import questions
from calib.cli.options import announce, finish, progress_bars, say
from calib.errors import CalibError

if TYPE_CHECKING:
    from calib.data import Table
    from calib.gap.case import Case
    from calib.gap.corrected import Corrected
    from calib.inference.calibration import Calibration
    from calib.inference.emulation import Emulation


def diagnose(
    ctx: typer.Context,
    case: Annotated[
        Path | None,
        typer.Argument(
            help="Folder with a case.toml, whose table \\[context] says what you suspect or rule "
            "out."
        ),
    ] = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder to write.")] = Path(
        "calib-diagnosis"
    ),
    seed: opt.Seed = 1,
    run: Annotated[Path | None, typer.Option(help="Run folder of `calib fit`.")] = None,
    field: Annotated[Path | None, typer.Option(help="CSV of the field campaign.")] = None,
    effects: opt.EffectsFile = None,
    overwrite: opt.Overwrite = False,
    dry_run: opt.DryRun = False,
    workers: opt.Workers = opt.CORES,
    plugins: opt.Models = None,
    simulator: opt.Simulators = None,
    json: opt.Json = False,
) -> None:
    """Find where a calibrated model misses, which effect it lacks, and how far adding it helps."""
    from functools import partial

    from calib.batch.folders import claimed, fresh_folder, keep
    from calib.batch.pool import pool
    from calib.batch.user_code import run_file
    from calib.gap.batch import INPUTS, inputs_record
    from calib.gap.campaigns import campaigns
    from calib.gap.case import case_from_run, read_case
    from calib.gap.describe import gap_document
    from calib.gap.diagnose import diagnose as diagnose_case
    from calib.gap.effects import EFFECTS
    from calib.gap.effects.user import check_effects, load_effects
    from calib.gap.files import write_diagnosis
    from calib.models import get_model
    from calib.models.simulators.emulator import emulator_of, save_emulator
    from calib.report.gap_words import Words
    from calib.report.page.diagnosis import write_page

    ctx.with_resource(claimed(out, overwrite=overwrite))
    if case is not None and run is None and field is None:
        given = read_case(case)
    elif case is None and run is not None and field is not None:
        given = case_from_run(run, field)
    else:
        raise CalibError(
            "it is not clear what to diagnose",
            expected="a case folder, or --run RUN together with --field CSV",
            hint="give one of the two",
        )
    own = {} if effects is None else load_effects(effects)
    files = [] if effects is None else [effects]
    files += [e.prior_file for e in own.values() if e.prior_file is not None]
    considered = {**EFFECTS, **own}
    # The diagnosis looks at them too, but only after simulators have been emulated.
    check_effects(considered, given)
    if dry_run:
        opt.planned([o.problem for o in campaigns(given).outputs], {}, out)
        return
    emulations = prepare_case(given, run, seed, workers)
    user_code = {} if effects is None else {effects: run_file}
    with pool(workers, user_code) as side, progress_bars() as tell:
        found = diagnose_case(given, seed, effects=considered, pool=side, progress=tell)
    keep("diagnosis", partial(write_diagnosis, found))
    document = gap_document(found, command=opt.command())
    with fresh_folder(out, overwrite=overwrite) as folder:
        write_diagnosis(found, folder, document)
        for model in given.models.values():
            if (emulator := emulator_of(get_model(model))) is not None:
                save_emulator(emulator, model, folder / "emulators" / f"{model}.npz")
        contents = {path.name: path.read_bytes() for path in files}
        (folder / INPUTS).write_bytes(inputs_record(found.data.case, seed, contents))
        write_page(document, folder)
    for warning in found.warnings:
        announce(warning)
    print(Words(document).terminal())
    print(out / "index.html")
    code = 0 if all(e.passed for e in emulations) else 3
    finish(code, out / "diagnosis.json", folder=str(out), warnings=list(found.warnings))


def prepare_case(case: Case, run: Path | None, seed: int, workers: int) -> list[Emulation]:
    """Emulate the slow simulators of a case for both of its campaigns; say how good each is."""
    import numpy as np

    from calib.data.quantities import OUTPUTS
    from calib.gap.campaigns import campaigns
    from calib.inference.emulation.prepared import prepare, prepare_field, reaches
    from calib.models.simulators.declaration import simulated_by
    from calib.models.simulators.files import load_files

    if run is None and not any(map(simulated_by, case.models.values())):
        return []
    campaigns(case)  # refuses, before any run is made, what cannot be diagnosed
    found: dict[str, Emulation | None] = {}
    others = [case.field, *([] if case.new_conditions is None else [case.new_conditions])]

    def measured(table: Table, column: str) -> Table:
        return table.take(np.isfinite(table[column]))

    with progress_bars() as tell:
        for output, model in case.models.items():
            column, priors = OUTPUTS[output], case.priors.get(output)
            if run is not None and (run / "emulator.npz").exists():
                load_files([run / "emulator.npz"])
            if not reaches(model, [case.lab, *others]):
                found[model] = prepare(
                    model, measured(case.lab, column), seed, priors=priors, elsewhere=others,
                    workers=workers, progress=tell,
                )  # fmt: skip
            found[f"{model}, field"] = prepare_field(
                model, measured(case.field, column), seed, priors=priors, workers=workers,
                progress=tell,
            )  # fmt: skip
    emulations = {what: emulation for what, emulation in found.items() if emulation is not None}
    for what, emulation in emulations.items():
        say(what, emulation)
    return list(emulations.values())


def predict(
    at: Annotated[Path, typer.Option(help="CSV with the conditions.")],
    run: Annotated[
        Path | None,
        typer.Argument(
            help="Folder of `calib fit`, `calib compare` or `calib diagnose`; without one, --model."
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="CSV to write; by default printed.")
    ] = None,
    model: Annotated[
        str | None,
        typer.Option(
            help="Model to predict with before there are data, from its priors.",
            autocompletion=opt.completing("models"),
        ),
    ] = None,
    priors: Annotated[Path | None, typer.Option(help="Prior file of --model.")] = None,
    exceeds: questions.Exceeds = None,
    below: questions.Below = None,
    quantiles: questions.Quantiles = None,
    draws: questions.DrawsBeside = 0,
    peak_over: questions.PeakOver = None,
    effects: opt.EffectsFile = None,
    without: Annotated[
        list[str] | None,
        typer.Option(
            help="Cause of a diagnosis that no longer acts, such as the "
            "fault of a repaired instrument; repeatable.",
            autocompletion=opt.completing("effects"),
        ),
    ] = None,
    group: Annotated[
        str | None,
        typer.Option(help="Group of a joint calibration; without it, a new group is predicted."),
    ] = None,
    overwrite: opt.Overwrite = False,
    plugins: opt.Models = None,
    simulator: opt.Simulators = None,
    json: opt.Json = False,
) -> None:
    """Predict at new conditions, with 50, 90 and 95 % bands (a diagnosis: 90 %), and answer."""
    from calib.batch.folders import check_room

    asked = questions.Asked.read(exceeds, below, quantiles, draws, peak_over, out)
    if out is not None:
        written: dict[Path, tuple[str, ...]] = {out: ("outside_calibrated_range", "converged")}
        written |= {questions.draws_beside(out): ("_reading",)} if draws else {}
        for path, last in written.items():
            if path.exists():
                _check_replaceable(path, at, overwrite, last)
        check_room(out)
    if (run is None) == (model is None) or (model is None and priors is not None):
        raise CalibError(
            "it is not clear what to predict with",
            expected="a folder of a run, or --model with or without --priors",
            hint="give one of the two; a run has its priors",
        )
    if run is not None and (run / "joint.json").exists():
        _predict_joint(run, at, out, group, asked)
        return
    if run is not None and (run / "corrected.json").exists():
        _predict_corrected(run, at, out, effects, without or [], asked)
        return
    if effects is not None or without:
        raise CalibError(
            "there is no diagnosis, which alone has effects",
            where=str(run or model),
            expected="a folder of `calib diagnose`",
            hint="correct its name, or leave --effects and --without out",
        )
    from calib import load_calibration
    from calib.data import read_for_model
    from calib.data.checks import check_conditions
    from calib.inference.problem import problem_without_data
    from calib.models import get_model
    from calib.models.simulators.emulator import emulator_of
    from calib.report.comparison import load_stack, verdicts_of
    from calib.validation.constants import MIN_DEFINED
    from calib.validation.prediction import predict as predict_at
    from calib.validation.prediction import predict_prior, predict_stacked, prediction_columns

    stack: list[tuple[float, Calibration]] = []
    converged = True
    if run is not None and (run / "comparison.json").exists():
        record, stack = load_stack(run)
        converged = bool(record["converged"])
    elif run is not None:
        stack = [(1.0, load_calibration(run))]
        converged = stack[0][1].converged
    if not converged:
        announce("this calibration did not converge; its bands are not to be used")
    problems = {c.problem.bound.model.name: c.problem for _, c in stack}
    models = [p.bound.model for p in problems.values()] or [get_model(str(model))]
    conditions = tuple(dict.fromkeys(n for m in models for n in m.conditions))
    read = read_for_model(at, conditions)
    known = {n: v for p in problems.values() for n, v in p.conditions.items()}
    given, table = asked.rows(read, conditions)
    check_conditions(read, known)
    kept, doubts = {} if run is None else verdicts_of(run), dict[str, None]()
    for name in problems:
        judged = kept.get(name) or kept.get("")
        for doubt in () if judged is None else judged.for_rows(table.columns):
            doubts[f"{name}: {doubt}" if len(stack) > 1 else doubt] = None
    if run is None:
        problem = problem_without_data(models[0].name, table, priors)
        doubts = dict.fromkeys(("no data are known: this is what priors expect", *problem.notes))
        prediction = predict_prior(problem, table)
    elif len(stack) == 1:
        prediction = predict_at(stack[0][1], table)
    else:
        prediction = predict_stacked(stack, table)
    for doubt in doubts:
        announce(doubt)
    columns = prediction_columns(prediction, table)
    found = {prediction.output: prediction}
    columns, everywhere, said = asked.columns(columns, found, given, out)
    if not converged:
        columns["converged"] = ["no"] * len(given)
    outside = _say_outside(read, known, columns)
    undefined = int((prediction.defined < MIN_DEFINED).sum())
    if undefined:
        why = f": the model has none there for much of the {'posterior' if stack else 'prior'}"
        if any(emulator_of(m) is not None for m in models):
            why = (
                "; an emulator ends where its runs do: give [ranges] in the simulator file, and "
                "fit again"
            )
        announce(f"no value (nan) at {undefined} of {len(table)} rows{why}")
    for line in said:
        announce(line)
    _give(columns, out, *(p.table for p in problems.values()))
    numbers = {"columns": _numbers(columns)} | ({"everywhere": everywhere} if everywhere else {})
    finish(
        0 if converged and undefined < len(table) else 3,
        numbers,
        outside=outside,
        doubts=list(doubts),
    )


def _predict_joint(
    run: Path, at: Path, out: Path | None, group: str | None, asked: questions.Asked
) -> None:
    """Predict the outputs of a joint calibration whose conditions are there, for a group."""
    from calib.cli.joint import doubts_of, predicted, readable
    from calib.inference.joint_files import load_joint

    found = load_joint(run)
    if not found.converged:
        announce("this calibration did not converge; its bands are not to be used")
    for doubt in doubts_of(run, group):
        announce(doubt)
    read, wholes = readable(found, at)
    known = {n: v for w in wholes.values() for n, v in w.conditions.items()}
    given, table = asked.rows(read, [*known])
    predictions, columns = predicted(found, wholes, table, group)
    columns, everywhere, said = asked.columns(columns, predictions, given, out)
    if not found.converged:
        columns["converged"] = ["no"] * len(given)
    outside = _say_outside(read, known, columns)
    for line in said:
        announce(line)
    _give(columns, out, *(w.table for w in wholes.values()))
    numbers = {"columns": _numbers(columns)} | ({"everywhere": everywhere} if everywhere else {})
    finish(0 if found.converged else 3, numbers, outside=outside)


def loaded(run: Path, effects: Path | None) -> Corrected:
    """Load the corrected model of a diagnosis, with emulators and effects of one's own."""
    from calib.gap.corrected import load_corrected
    from calib.gap.effects import EFFECTS
    from calib.gap.effects.user import load_effects
    from calib.models.simulators.files import load_files

    load_files(sorted((run / "emulators").glob("*.npz")))
    own = {} if effects is None else load_effects(effects)
    return load_corrected(run, {**EFFECTS, **own})


def _check_replaceable(out: Path, at: Path, overwrite: bool, last: tuple[str, ...]) -> None:
    """Refuse to replace a file unless it is a prediction, and that is wanted.

    The last column tells, of a run that did not converge another one, of draws that of readings.
    """
    if not overwrite:
        wrong, hint = "the file exists already", "choose another --out, or pass --overwrite"
        raise CalibError(wrong, where=str(out), hint=hint)
    hint = "choose another --out"
    if at.exists() and out.samefile(at):
        wrong = "it holds the conditions, which --out would replace"
        raise CalibError(wrong, where=str(out), hint=hint)
    if not out.is_file():
        return
    with out.open(encoding="utf-8", errors="replace") as file:
        header = file.readline().strip()
    if header and not header.endswith(last):
        wrong, expected = "the file is no prediction, so it is not replaced", "a CSV that calib"
        raise CalibError(wrong, where=str(out), expected=f"{expected} predict wrote", hint=hint)


def _predict_corrected(
    run: Path, at: Path, out: Path | None, effects: Path | None, without: Sequence[str],
    asked: questions.Asked,
) -> None:  # fmt: skip
    """Predict with the corrected model of a diagnosis, beside the calibrated simulator."""
    import numpy as np

    from calib.data import read_for_model
    from calib.data.quantities import OUTPUTS
    from calib.gap.corrected import check_units_of, covered, predict_corrected

    corrected = loaded(run, effects)
    used = sorted({c for o in corrected.data.outputs for c in o.problem.bound.model.conditions})
    read = read_for_model(at, used)
    check_units_of(corrected, read)
    if asked.over and corrected.data.case.covariates:
        raise CalibError(
            "a peak is not sought where a diagnosis has covariates of its own", where="--peak-over",
            hint="give the rows of each curve, and ask calib.predict(…).draws(output).peak(…)",
        )  # fmt: skip
    given, table = asked.rows(read, [n for n in read if n not in OUTPUTS.values()])
    prediction = predict_corrected(corrected, table, without)
    columns = dict(prediction.columns)
    if "run_order" in corrected.data.view.conditions and "run_order" not in table:
        announce(
            "no run_order is given: what depends on it is predicted as it stood at the end of the "
            "campaign"
        )
    if faults := [cause for cause in corrected.faults if cause not in without]:
        announce(
            f"what is predicted is the reading, with {', '.join(faults)} in it; once the "
            f"instrument is repaired, predict --without {' --without '.join(faults)}"
        )
    outputs = map(OUTPUTS.__getitem__, corrected.data.names if asked.anything else ())
    found = {column: prediction.draws(column) for column in outputs}
    columns, everywhere, said = asked.columns(columns, found, given, out)
    outside = _say_outside(read, covered(corrected, read), columns)
    of_outputs = [v for n, v in prediction.columns.items() if n.endswith(("_before", "_after"))]
    if nowhere := int(np.isnan(np.array(of_outputs, dtype=np.float64)).any(axis=0).sum()):
        announce(
            f"no value (nan) at {nowhere} of {len(table)} rows: the simulator has none there, or "
            "explanations differ too much"
        )
    for line in said:
        announce(line)
    _give(columns, out, corrected.data.case.lab, corrected.data.case.field)
    numbers = {"columns": _numbers(columns)} | ({"everywhere": everywhere} if everywhere else {})
    finish(0 if nowhere < len(table) else 3, numbers, outside=outside)


def _say_outside(table: Table, known: Mapping[str, Any], columns: Mapping[str, Any]) -> int:
    """Warn of rows outside the calibrated range; return how many there are."""
    from calib.data.checks import beyond_notes

    flags = columns["outside_calibrated_range"]
    outside = sum(bool(flag.partition(" (no value")[0]) for flag in flags)
    if outside:
        lie = "row lies" if outside == 1 else "rows lie"
        announce(
            f"{outside} {lie} outside the calibrated range, where the prediction is not to be "
            "trusted"
        )
        for note in beyond_notes(table, known):
            announce(note)
    return outside


def _give(columns: dict[str, Any], out: Path | None, *tables: Table) -> None:
    """Write columns to a file, or print them; a column says what data of `tables` are called."""
    from calib.data import write_table
    from calib.data.reader import common_label

    if label := common_label(*tables):
        n = len(next(iter(columns.values())))
        columns = questions.before_last(columns, {"data_label": [label] * n})
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
    if math.isnan(cell):
        return empty
    return f"{cell:.0f}" if float(cell).is_integer() else f"{cell:.6g}"


def _numbers(columns: Mapping[str, Any]) -> dict[str, list[float | str]]:
    """Return columns with their cells as numbers where possible; text of the user stays text."""

    def number(cell: Any) -> float | str:
        try:
            return float(cell)
        except ValueError:
            return str(cell)

    return {name: [number(cell) for cell in column] for name, column in columns.items()}
