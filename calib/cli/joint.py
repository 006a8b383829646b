"""The command `joint`, and predictions from its folders."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from calib.cli import options as opt
from calib.cli.calibration import print_posterior, scored, tell_verdict
from calib.cli.options import emulate_jointly, finish, progress_bars
from calib.errors import CalibError

if TYPE_CHECKING:
    from calib.data import Table
    from calib.inference.emulation import Emulation
    from calib.inference.joint import JointCalibration, JointProblem
    from calib.inference.problem import Problem
    from calib.report.verdict import Verdict
    from calib.validation.prediction import Prediction
    from calib.validation.validate import Validation


def joint(
    ctx: typer.Context,
    file: Annotated[Path, typer.Argument(help="CSV whose column names carry units.")],
    model: Annotated[
        list[str],
        typer.Option(
            "--model", help="A model of each output; repeatable.",
            autocompletion=opt.completing("models"),
        ),
    ],
    data: Annotated[
        list[str] | None,
        typer.Option(help="Other data of a model, MODEL=FILE.csv; repeatable."),
    ] = None,
    group: Annotated[
        str, typer.Option(help="Column whose values tell groups: run, soil bin, tyre, operator.")
    ] = "",
    pool: Annotated[
        list[str] | None,
        typer.Option(help="Parameter that differs between groups, by partial pooling; repeatable."),
    ] = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder to write.")] = Path(
        "calib-joint"
    ),
    priors: opt.PriorFiles = None,
    seed: opt.Seed = 2019,
    hold_out: Annotated[
        str | None,
        typer.Option(
            "--hold-out",
            help="Rows kept for validation, e.g. inflation_pressure_psi=30, or groups: bin=C,D.",
        ),
    ] = None,
    overwrite: opt.Overwrite = False,
    dry_run: opt.DryRun = False,
    max_steps: opt.MaxSteps = 25_600,
    workers: opt.Workers = opt.CORES,
    plugins: opt.Models = None,
    simulator: opt.Simulators = None,
    json: opt.Json = False,
) -> None:  # fmt: skip
    """Calibrate outputs that share parameters, or groups that are alike, in one posterior."""
    from dataclasses import asdict
    from functools import partial

    from calib.batch.folders import claimed, fresh_folder
    from calib.inference.joint import build_joint, calibrate_joint
    from calib.inference.joint_files import JOINT, save_joint
    from calib.inference.prior_files import prior_file_model
    from calib.inference.sampler import SamplerSettings

    ctx.with_resource(claimed(out, overwrite=overwrite))
    rows = _rows(file, model, data or ())
    fitted, held = _split(rows, hold_out, group)
    given = {prior_file_model(path): path for path in priors or ()}
    build = partial(build_joint, group=group, pooled=pool or (), priors=given)
    problem = build(fitted)
    if dry_run:
        left = {m: len(held[m]) if m in held else 0 for m in model}
        opt.planned(problem.wholes.values(), left, out)
        return
    if emulations := emulate_jointly(problem, seed, workers, [*held.values()]):
        problem = build(fitted)
    with progress_bars() as tell:
        found = calibrate_joint(
            problem, seed, settings=SamplerSettings(max_steps=max_steps),
            progress=partial(tell, "sampling"),
        )  # fmt: skip
    judged, scores = _judged(found, held, hold_out or "", emulations)
    with fresh_folder(out, overwrite=overwrite) as folder:
        save_joint(found, folder, verdicts={k: v.document() for k, v in judged.items()})
    for line in _headlines(problem):
        print(line)
    readings = sum(len(whole.table) for whole in problem.wholes.values())
    shared = {name: ", ".join(of) for name, of in problem.shared.items()}
    print_posterior(f"joint posterior of {readings} readings", found.summary, "in", shared)
    gate = found.draws.report
    if gate.passed:
        print(f"converged: {gate.steps} steps, R-hat at most {gate.rhat.max():.4f}")
    else:
        print(f"NOT CONVERGED, do not use these numbers: {'; '.join(gate.reasons[:3])}")
    for words in scores.values():
        print(words["sentence"])
    for place, one in judged.items():
        tell_verdict(one, f"{place}: ")
    for note in dict.fromkeys(n for whole in problem.wholes.values() for n in whole.notes):
        print(f"note: {note}", file=sys.stderr)
    print(f"folder: {out}")
    print(f"next: calib predict {out} --at CONDITIONS.csv")
    good = found.converged and all(e.passed for e in emulations.values())
    posterior = {name: asdict(s) for name, s in found.summary.items()}
    finish(0 if good else 3, out / JOINT, folder=str(out), posterior=posterior, scores=scores)


def _rows(file: Path, models: Sequence[str], data: Sequence[str]) -> dict[str, Table]:
    """Read the data of each model: those of its own, or of the file."""
    from calib.data import read_table
    from calib.data.quantities import OUTPUTS, QUANTITIES
    from calib.models import get_model

    own = {}
    for text in data:
        name, equals, path = text.partition("=")
        if not equals or name not in models:
            raise CalibError(
                f"cannot read --data {text!r}", expected=f"MODEL=FILE.csv, of {', '.join(models)}",
                hint="name one of the models, an equals sign and its file",
            )  # fmt: skip
        own[name] = Path(path)
    if len(set(models)) < len(models):
        raise CalibError("a model is named twice", where="--model", hint="name each once")
    found = {}
    for name in models:
        chosen, outputs = get_model(name), set(OUTPUTS.values())
        # Rows without the output of this model may be those of another.
        missing = [c for c in QUANTITIES if c not in chosen.conditions or c in outputs]
        found[name] = read_table(
            own.get(name, file), required=(*chosen.conditions, chosen.output),
            allow_missing=missing,
        )  # fmt: skip
    return found


def _split(
    rows: Mapping[str, Table], hold_out: str | None, group: str
) -> tuple[dict[str, Table], dict[str, Table]]:
    """Return the rows to fit and those held out, by model."""
    import numpy as np

    from calib.inference.joint import group_labels
    from calib.report.study import HoldOut

    if hold_out is None:
        return dict(rows), {}
    column, _, values = hold_out.partition("=")
    fitted, held = {}, {}
    for model, table in rows.items():
        if group and column.strip() == group:
            wanted = [value.strip() for value in values.split(",")]
            labels = group_labels(table, group)
            if unknown := sorted({*wanted} - {*labels}):
                raise CalibError(
                    f"there is no group {', '.join(unknown)}", where=f"--hold-out {hold_out}",
                    expected=", ".join(sorted({*labels})), hint="name some of these",
                )  # fmt: skip
            of = np.isin(labels, wanted)
            fitted[model], held[model] = (table.take(np.flatnonzero(b)) for b in (~of, of))
            continue
        kept = HoldOut.parse(hold_out)
        fitted[model] = table
        if kept.applies_to(table):
            fitted[model], held[model] = kept.split(table)
    if not held:
        raise CalibError(
            "none of the files has this column", where=f"--hold-out {hold_out}",
            expected="a column of the data", hint="name a column with its unit, or the groups'",
        )  # fmt: skip
    return fitted, held


def _headlines(problem: JointProblem) -> list[str]:
    """Say what the outputs share, and what differs between groups."""
    found = []
    if len(problem.outputs) > 1:
        shared = ", ".join(problem.shared) or "no parameter: each could be fitted by itself"
        found.append(f"{', '.join(problem.outputs)} share {shared}")
    if problem.groups:
        found.append(
            f"{', '.join(problem.pooled)} may differ between {len(problem.groups)} groups "
            f"({problem.column})"
        )
    return found


def _judged(
    found: JointCalibration, held: Mapping[str, Table], hold_out: str,
    emulations: Mapping[str, Emulation],
) -> tuple[dict[str, Verdict], dict[str, Mapping[str, Any]]]:  # fmt: skip
    """Judge every output and group, and score rows held out, or left out one by one.

    Rows of a group that was not fitted are those of a new one, which has a score and no verdict.
    """
    from calib.report.study import validated
    from calib.report.verdict import verdict
    from calib.validation.validate import validate_held_out

    aside = _by_place(held, found.problem)
    judged, scores = dict[str, "Verdict"](), dict[str, Mapping[str, Any]]()
    for output, group in found.problem.parts:
        of, place = found.calibration(output, group or None), f"{output} {group}".strip()
        own = aside.pop((output, group), None)
        emulation = emulations.get(of.problem.bound.model.name)
        validation = validated(of, own)
        reasons = () if emulation is None else emulation.reasons
        said = "" if own is None else hold_out
        judged[place] = verdict(of, validation, emulator_fails=reasons, held_out=said)
        if validation is not None:
            how = "left out one by one" if own is None else "held out"
            scores[place] = _score(validation, f"{place}, {how}")
    for (output, group), rows in aside.items():
        validation = validate_held_out(found.calibration(output), rows)
        place = f"{output} {group}".strip()
        scores[place] = _score(validation, f"{place}, held out as a new group")
    return judged, scores


def _by_place(held: Mapping[str, Table], problem: JointProblem) -> dict[tuple[str, str], Table]:
    """Return held-out rows by output and group."""
    import numpy as np

    from calib.inference.joint import group_labels

    found = {}
    for output, whole in problem.wholes.items():
        model = whole.bound.model
        if model.name not in held:
            continue
        table = held[model.name]
        rows = table.take(np.flatnonzero(np.isfinite(table[model.output])))
        labels = group_labels(rows, problem.column) if problem.column else np.full(len(rows), "")
        for label in sorted({*labels.tolist()}):
            found[output, label] = rows.take(np.flatnonzero(labels == label))
    return found


def _score(validation: Validation, what: str) -> Mapping[str, Any]:
    scores, ninety = validation.scores, validation.scores.coverage[0.9]
    return {
        "rows": ninety.n, "covered_90": ninety.hits, "rmse": scores.rmse, "crps": scores.crps,
        "sentence": f"{what}: {scored(validation)}",
    }  # fmt: skip


def doubts_of(run: Path, label: str | None) -> list[str]:
    """Return the warnings of the verdicts that a folder keeps: of a group, or of all."""
    from calib.report.verdict import joint_verdicts

    kept = joint_verdicts(run)
    of = {k: v for k, v in kept.items() if label is None or k.endswith(f" {label}")}
    said = (f"{place}: {w}" for place, one in of.items() for w in one.warnings)
    return list(dict.fromkeys(said))


def readable(found: JointCalibration, at: Path) -> tuple[Table, dict[str, Problem]]:
    """Read conditions, and return the outputs that can be predicted there, as fitted.

    A CalibError if there are none.
    """
    import numpy as np

    from calib.data import read_table
    from calib.data.checks import check_conditions
    from calib.data.quantities import QUANTITIES

    table = read_table(at, allow_missing=[*QUANTITIES])
    wholes = {
        output: w for output, w in found.problem.wholes.items()
        if all(c in table and np.isfinite(table[c]).all() for c in w.bound.model.conditions)
    }  # fmt: skip
    if not wholes:
        raise CalibError(
            "the conditions of no output are there, whole", where=str(at),
            expected="; or ".join(
                f"for {output} {', '.join(w.bound.model.conditions)}"
                for output, w in found.problem.wholes.items()
            ),
            hint="add columns, or fill empty cells",
        )  # fmt: skip
    check_conditions(table, {n: v for w in wholes.values() for n, v in w.conditions.items()})
    return table, wholes


def predicted(
    found: JointCalibration, wholes: Mapping[str, Problem], table: Table, label: str | None
) -> tuple[dict[str, Prediction], dict[str, Any]]:
    """Predict outputs for a group or a new one, and lay them out as columns of a CSV."""
    from calib.validation.prediction import band_columns, echoed, predict

    columns: dict[str, Any] = dict(echoed(table, *(w.bound.model.output for w in wholes.values())))
    predictions: dict[str, Prediction] = {}
    notes: list[dict[str, None]] = [{} for _ in range(len(table))]
    for output in wholes:
        prediction = predict(found.calibration(output, label), table)
        banded = band_columns(prediction)
        # The sinkage of a wheel and of a plate have one name.
        prefix = f"{output}." if prediction.output in predictions else ""
        predictions[prefix + prediction.output] = prediction
        for note, text in zip(notes, banded.pop("outside_calibrated_range"), strict=True):
            note.update(dict.fromkeys([str(text)] if text else []))
        columns |= {prefix + n: v for n, v in banded.items()}
    columns["outside_calibrated_range"] = ["; ".join(note) for note in notes]
    return predictions, columns
