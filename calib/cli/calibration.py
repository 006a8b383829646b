"""Verbs of calibration: fit, predict, report, data, template, priors."""

from __future__ import annotations

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

    from calib.report.sections import Section


def report(
    ctx: typer.Context,
    files: Annotated[
        list[Path] | None, typer.Argument(help="Your CSV files; the embedded data if none.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder to write.")] = Path("calib-report"),
    seed: opt.Seed = 2019,
    hold_out: opt.HoldOutOption = None,
    model: Annotated[
        list[str] | None, typer.Option(help="Model for its output, not the suggested; repeatable.")
    ] = None,
    priors: opt.PriorFiles = None,
    only: Annotated[
        list[str] | None, typer.Option(help="Output to report, e.g. drawbar_pull; repeatable.")
    ] = None,
    compare: Annotated[
        list[str] | None,
        typer.Option(help="Model to compare with others on the same rows; two or more times."),
    ] = None,
    overwrite: opt.Overwrite = False,
    pdf: Annotated[bool, typer.Option("--pdf", help="Figures also as PDF, for print.")] = False,
    max_steps: opt.MaxSteps = 25_600,
    posteriors: Annotated[
        bool, typer.Option(help="Keep the posteriors, megabytes of netCDF, in the folder.")
    ] = True,
    workers: opt.Workers = opt.CORES,
    plugins: opt.Models = None,
    simulator: opt.Simulators = None,
    json: Json = False,
) -> None:
    """Calibrate, predict, validate and write a report folder with an index.html."""
    from calib.batch.folders import claimed
    from calib.batch.pool import begin_imports, pool

    ctx.with_resource(claimed(out, overwrite=overwrite))
    begin_imports(workers)
    from dataclasses import replace

    from calib import SamplerSettings, read_table
    from calib.cli.display import progress_bars
    from calib.cli.simulators import say
    from calib.data.labels import labelled
    from calib.data.quantities import OUTPUTS
    from calib.inference.emulation.prepared import prepare
    from calib.inference.prior_files import prior_file_model
    from calib.report.sections import EmulatorSection, work_out
    from calib.report.study_tasks import HoldOut, fitted_rows, plan_tasks
    from calib.report.writer import write_report

    if files:
        tasks = plan_tasks(
            [labelled(read_table(f, allow_missing=tuple(OUTPUTS.values()))) for f in files],
            None if hold_out is None else HoldOut.parse(hold_out),
            models=model or (),
            prior_paths=priors or (),
            only=only or (),
        )
        title = "Calibration report"
        sections: Sequence[Section] = ()
    else:
        from calib.he2019.designs import he2019_tasks
        from calib.he2019.sections import AuditSection, GapsSection

        tasks = he2019_tasks()
        # Beside the user's own data, the source's gaps and tables have no place.
        sections = (GapsSection(), AuditSection())
        title = "Calibration report: He, Sandu & Osorio (2019), reconstructed data"
    settings = SamplerSettings(max_steps=max_steps)
    to_prepare = {task.model: (task, task.prior_path) for task in tasks}
    if compare:
        from calib.report.compared import plan_comparison

        comparison = plan_comparison(
            tasks, compare, {prior_file_model(path): path for path in priors or ()}
        )
        comparison = replace(comparison, settings=settings, command=opt.command(), workers=workers)
        to_prepare |= {name: (comparison.task, comparison.priors.get(name)) for name in compare}
        sections = (*sections, comparison)
    with progress_bars() as tell:
        emulations = {
            name: prepare(
                name, fitted_rows(task)[0], seed, priors=path, elsewhere=[task.table],
                workers=workers, progress=tell,
            )
            for name, (task, path) in to_prepare.items()
        }  # fmt: skip
    good = [say(model, emulation) for model, emulation in emulations.items()]
    made = {model: e.document() for model, e in emulations.items() if e is not None}
    if made:
        sections = (*sections, EmulatorSection(made))
    with pool(workers) as side, progress_bars() as tell:
        found = work_out(
            tasks, seed, settings=settings, sections=sections, progress=tell, workers=workers,
            pool=side,
        )  # fmt: skip
        study = found.study
        page = write_report(
            study, out, settings=settings, command=opt.command(), title=title, sections=found.found,
            overwrite=overwrite, posteriors=posteriors, pdf=pdf, progress=tell, pool=side,
        )  # fmt: skip
    for key, result in study.successes.items():
        ninety = result.validation.scores.coverage[0.9]
        state = "converged" if result.calibration.converged else "NOT CONVERGED"
        print(f"{key}: {state}; 90 % band covers {ninety.hits} of {ninety.n} rows not fitted")
        for warning in result.warnings:
            print(f"warning: {warning}", file=sys.stderr)
    for key, failure in study.failures.items():
        print(f"{key}: FAILED: {failure.error}", file=sys.stderr)
    print(page)
    converged = all(r.calibration.converged for r in study.successes.values())
    for section in found.found:
        if section.name == "comparison":
            print(section.record()["verdict"])
            converged &= bool(section.record()["converged"])
    code = 1 if study.failures else 0 if converged and all(good) else 3
    finish(code, out / "summary.json", folder=str(out))


def fit(
    ctx: typer.Context,
    file: Annotated[Path, typer.Argument(help="CSV whose column names carry units.")],
    model: Annotated[str, typer.Option(help="See `calib models`.")],
    out: Annotated[Path, typer.Option(help="Run folder to write.")] = Path("calib-run"),
    priors: Annotated[Path | None, typer.Option(help="Prior file; see `calib priors`.")] = None,
    seed: opt.Seed = 2019,
    hold_out: opt.HoldOutOption = None,
    overwrite: opt.Overwrite = False,
    max_steps: opt.MaxSteps = 25_600,
    workers: opt.Workers = opt.CORES,
    plugins: opt.Models = None,
    simulator: opt.Simulators = None,
    json: Json = False,
) -> None:
    """Calibrate one model on one file and save the posterior."""
    from dataclasses import asdict

    from calib import SamplerSettings, build_problem, calibrate, estimate, save_calibration
    from calib import validate_held_out as validate
    from calib.batch.folders import claimed, fresh_folder
    from calib.cli.display import posterior_table, progress_bars, verdict_line
    from calib.cli.simulators import say, say_failed
    from calib.inference.emulation.prepared import prepare
    from calib.inference.random import generator
    from calib.models import get_model
    from calib.report.numbers import format_number
    from calib.report.study_tasks import HoldOut, read_and_split
    from calib.validation.assumptions import warnings_of
    from calib.validation.noise_preference import noise_preference

    chosen = get_model(model)
    ctx.with_resource(claimed(out, overwrite=overwrite))
    settings = SamplerSettings(max_steps=max_steps)
    kept = None if hold_out is None else HoldOut.parse(hold_out)
    fitted, held = read_and_split(file, (*chosen.conditions, chosen.output), kept)
    with progress_bars() as tell:
        emulation = prepare(
            model, fitted, seed, priors=priors, elsewhere=[] if held is None else [held],
            workers=workers, progress=tell,
        )  # fmt: skip
        problem = build_problem(model, fitted, priors)
        point = estimate(problem, "least_squares", generator(seed, model, "least_squares"))
        calibration = calibrate(
            problem, seed, estimates=(point,), settings=settings,
            progress=lambda done, planned: tell("sampling", done, planned),
        )  # fmt: skip
        preference = noise_preference(
            calibration, settings=settings, workers=workers,
            progress=lambda done, planned: tell("leaving rows out", done, planned),
        )  # fmt: skip
    with fresh_folder(out, overwrite=overwrite) as folder:
        save_calibration(calibration, folder)
    posterior_table(calibration)
    print(verdict_line(calibration))
    good = say(model, emulation)
    say_failed(model)
    if preference is not None:
        print(preference.sentence)
    told = warnings_of(problem, calibration.draws.mode)
    for note in problem.notes:
        print(f"note: {note}", file=sys.stderr)
    for warning in told:
        print(f"warning: {warning}", file=sys.stderr)
    found: dict[str, Any] = {
        "folder": str(out), "notes": list(problem.notes), "warnings": list(told),
        "posterior": {name: asdict(s) for name, s in calibration.summary.items()},
    }  # fmt: skip
    if preference is not None:
        found["preference"] = asdict(preference)
    if held is not None:
        scores = validate(calibration, held).scores
        ninety = scores.coverage[0.9]
        print(
            f"held out ({kept}): 90 % band covers {ninety.hits} of {ninety.n}, "
            f"RMSE {format_number(scores.rmse)}, CRPS {format_number(scores.crps)}"
        )
        found["held_out"] = {
            "what": str(kept), "rows": ninety.n, "covered_90": ninety.hits,
            "rmse": scores.rmse, "crps": scores.crps,
        }  # fmt: skip
    print(f"run folder: {out}")
    finish(0 if calibration.converged and good else 3, out / "run.json", **found)


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
    if out is not None and out.exists() and not overwrite:
        raise CalibError(
            "the file exists already",
            where=str(out),
            mend="choose another --out, or pass --overwrite",
        )
    from calib import load_calibration
    from calib.batch.folders import check_room
    from calib.data import read_for_model
    from calib.data.units_check import beyond_notes, check_conditions
    from calib.models.simulators.emulator.model import emulator_of
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
            allowed="a folder of `calib diagnose`",
            mend="correct its name, or leave --effects and --without out",
        )  # fmt: skip
    if (run / "comparison.json").exists():
        from calib.report.comparison import load_stack

        found, parts = load_stack(run)
        converged = bool(found["converged"])
    else:
        parts = [(1.0, load_calibration(run))]
        converged = parts[0][1].converged
    if not converged:
        print("calib: this calibration did not converge; its bands are not to be used",
              file=sys.stderr)  # fmt: skip
    used = dict.fromkeys(n for _, c in parts for n in c.problem.bound.model.conditions)
    table = read_for_model(at, tuple(used))
    known = {n: v for _, c in parts for n, v in c.problem.conditions.items()}
    check_conditions(table, known)
    prediction = (
        predict_at(parts[0][1], table) if len(parts) == 1 else predict_stacked(parts, table)
    )
    columns = prediction_columns(prediction, table)
    if not converged:
        columns["converged"] = ["no"] * len(table)
    outside = sum(bool(flags) for flags in prediction.outside)
    if outside:
        lie = "row lies" if outside == 1 else "rows lie"
        print(f"calib: {outside} {lie} outside the calibrated range", file=sys.stderr)
        for note in beyond_notes(table, known):
            print(f"calib: {note}", file=sys.stderr)
    undefined = int((prediction.defined < MIN_DEFINED).sum())
    if undefined:
        emulated = any(emulator_of(c.problem.bound.model) is not None for _, c in parts)
        why = (
            "; an emulator ends where its runs do: give [ranges] in the simulator file, and fit "
            "again" if emulated else ": the model has none there for much of the posterior"
        )  # fmt: skip
        print(f"calib: no value (nan) at {undefined} of {len(table)} rows{why}", file=sys.stderr)
    _give(columns, out)
    finish(0 if converged else 3, {"columns": _lists(columns)}, outside=outside)


def _predict_corrected(
    run: Path, at: Path, out: Path | None, effects: Path | None, without: Sequence[str]
) -> None:
    """Predict with the corrected model of a diagnosis, beside the calibrated simulator."""
    from calib.batch.plugins import load_files
    from calib.data import read_for_model
    from calib.gap.corrected import conditions_outside, load_corrected, predict_columns
    from calib.gap.effects import EFFECTS
    from calib.gap.effects.load import load_effects

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
        print(f"calib: outside what either campaign covered: {told}", file=sys.stderr)
    _give(columns, out)
    finish(0, {"columns": _lists(columns)}, outside=beyond)


def _give(columns: Mapping[str, Any], out: Path | None) -> None:
    """Write columns to a file, or print them."""
    from calib.data import write_table

    if out is not None:
        write_table(out, {name: [_cell(c, "") for c in column] for name, column in columns.items()})
        print(f"{len(next(iter(columns.values())))} rows written to {out}")
        return
    print(",".join(columns))
    for row in zip(*columns.values(), strict=True):
        print(",".join(map(_cell, row)))


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


def data(
    name: Annotated[str, typer.Argument(help="he2019 or he2019-gaps")],
    out: Annotated[Path | None, typer.Option(help="Folder to write; its name if none.")] = None,
    overwrite: opt.Overwrite = False,
) -> None:
    """Write the embedded, reconstructed data as CSV files, or as cases for `calib diagnose`."""
    writers = {"he2019": _write_he2019, "he2019-gaps": _write_he2019_gaps}
    if name not in writers:
        raise CalibError(
            f"there is no data set {name!r}", allowed=", ".join(writers), mend="use one of these"
        )  # fmt: skip
    folder = Path(name) if out is None else out
    try:
        written = writers[name](folder, overwrite)
    except OSError as error:
        raise CalibError(
            f"the folder cannot be written ({error.strerror})", where=str(folder),
            mend="choose another --out",
        ) from None  # fmt: skip
    for path in written:
        print(f"{path} (reconstructed from published results, not measured)")


def _write_he2019(out: Path, overwrite: bool) -> list[Path]:
    from calib.he2019.datasets import embedded

    existing = [f"{key}.csv" for key in embedded.tables() if (out / f"{key}.csv").exists()]
    if existing and not overwrite:
        raise CalibError(
            f"{', '.join(existing)} exist there already", where=str(out),
            mend="choose another --out, or pass --overwrite",
        )  # fmt: skip
    return embedded.write(out)


def _write_he2019_gaps(out: Path, overwrite: bool) -> list[Path]:
    from calib.he2019.gaps.cases import paper_gaps, write_cases

    return write_cases(paper_gaps(), out, overwrite=overwrite)


def template(
    model: Annotated[str, typer.Argument(help="See `calib models`.")],
    out: Annotated[Path | None, typer.Option(help="CSV to write; printed if none.")] = None,
    plugins: opt.Models = None,
    simulator: opt.Simulators = None,
) -> None:
    """Write an example CSV of a model to fill in."""
    from calib.models import get_model, template_csv

    text = template_csv(get_model(model).name)
    _emit(text, out)
    if "run_order" in text:
        print("calib: run_order may be left out: number the rows as they were measured, or delete "
              "the column", file=sys.stderr)  # fmt: skip


def priors(
    model: Annotated[str, typer.Argument(help="See `calib models`.")],
    out: Annotated[Path | None, typer.Option(help="TOML to write; printed if none.")] = None,
    plugins: opt.Models = None,
    simulator: opt.Simulators = None,
) -> None:
    """Write the shipped priors of a model, to copy and edit."""
    from calib.inference.prior_files import default_priors
    from calib.models import get_model

    _emit(default_priors(get_model(model).name).read_text(encoding="utf-8"), out)


def _emit(text: str, out: Path | None) -> None:
    if out is None:
        sys.stdout.write(text)
        return
    from calib.batch.folders import write_whole

    try:
        if out.exists():
            raise CalibError("the file exists already", where=str(out), mend="choose another --out")
        write_whole(out, text)
    except OSError as error:
        raise CalibError(
            f"the file cannot be written ({error.strerror})", where=str(out),
            mend="choose another --out",
        ) from None  # fmt: skip
    print(out)
