"""The commands `report`, `fit` and `compare`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from calib.cli import options as opt
from calib.cli.machine import Json, finish

if TYPE_CHECKING:
    from collections.abc import Sequence

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
    views: Annotated[
        bool,
        typer.Option(help="Write page, figures and tables beside the numbers."),
    ] = True,
    workers: opt.Workers = opt.CORES,
    plugins: opt.Models = None,
    simulator: opt.Simulators = None,
    json: Json = False,
) -> None:
    """Calibrate, predict, validate and write a report folder with an index.html."""
    from calib.batch.folders import claimed
    from calib.batch.pool import pool

    ctx.with_resource(claimed(out, overwrite=overwrite))
    from dataclasses import replace

    from calib import SamplerSettings, read_table
    from calib.cli.options import progress_bars, tell_compared, tell_verdict
    from calib.cli.simulators import say
    from calib.data.quantities import OUTPUTS
    from calib.inference.emulation.prepared import prepare
    from calib.inference.prior_files import prior_file_model
    from calib.report.sections import EmulatorSection, work_out
    from calib.report.study_tasks import HoldOut, fitted_rows, plan_tasks
    from calib.report.verdict import judge_evidence
    from calib.report.writer import write_report

    if files:
        tasks = plan_tasks(
            [read_table(f, allow_missing=tuple(OUTPUTS.values())) for f in files],
            None if hold_out is None else HoldOut.parse(hold_out),
            models=model or (),
            prior_paths=priors or (),
            only=only or (),
        )
        title = "Calibration report"
        sections: Sequence[Section[Any]] = ()
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
        from calib.report.comparison import plan_comparison

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
            found, out, settings=settings, command=opt.command(), title=title,
            overwrite=overwrite, posteriors=posteriors and views, views=views, pdf=pdf,
            progress=tell, pool=side,
        )  # fmt: skip
    verdicts = {}
    for key, result in study.successes.items():
        ninety = result.validation.scores.coverage[0.9]
        state = "converged" if result.calibration.converged else "NOT CONVERGED"
        fails = made.get(result.task.model, {}).get("reasons", ())
        verdicts[key] = judge_evidence(replace(result.evidence, emulator_fails=fails))
        print(f"{key}: {state}; 90 % band covers {ninety.hits} of {ninety.n} rows not fitted")
        tell_verdict(verdicts[key], f"{key}: ")
    for key, failure in study.failures.items():
        print(f"{key}: FAILED: {failure.error}", file=sys.stderr)
    print(page)
    converged = all(r.calibration.converged for r in study.successes.values())
    for section, part in found.parts:
        if section.name == "comparison":
            record = section.record(part)
            tell_compared(record)
            print(record["verdict"])
            converged &= bool(record["converged"])
    code = 1 if study.failures else 0 if converged and all(good) else 3
    told = {key: found.document() for key, found in verdicts.items()}
    finish(code, out / "summary.json", folder=str(out), verdicts=told)


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
    from functools import partial

    from calib import SamplerSettings, build_problem, calibrate, estimate, save_calibration
    from calib.batch.folders import claimed, fresh_folder
    from calib.batch.foreign import keep
    from calib.cli.options import posterior_table, progress_bars, tell_verdict, verdict_line
    from calib.cli.simulators import say, say_failed
    from calib.inference.emulation.prepared import prepare
    from calib.inference.random import generator
    from calib.models import get_model
    from calib.report.numbers import format_number
    from calib.report.study_tasks import HoldOut, read_and_split
    from calib.report.verdict import keep_verdict, validated, verdict
    from calib.validation.comparison import noise_preference
    from calib.validation.validate import PARETO_K_MAX

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
        keep("run", partial(save_calibration, calibration))
        preference = noise_preference(
            calibration, settings=settings, workers=workers,
            progress=lambda done, planned: tell("leaving rows out", done, planned),
        )  # fmt: skip
    with fresh_folder(out, overwrite=overwrite) as folder:
        save_calibration(calibration, folder)
    fails = () if emulation is None else emulation.reasons
    validation = validated(calibration, held)
    judged = verdict(calibration, validation, emulator_fails=fails, held_out=str(kept or ""))
    keep_verdict(judged, out)
    posterior_table(calibration, judged)
    print(verdict_line(calibration))
    good = say(model, emulation)
    say_failed(model)
    if preference is not None:
        print(preference.sentence)
    for note in problem.notes:
        print(f"note: {note}", file=sys.stderr)
    found: dict[str, Any] = {
        "folder": str(out), "notes": list(problem.notes), "warnings": list(judged.warnings),
        "posterior": {name: asdict(s) for name, s in calibration.summary.items()},
    }  # fmt: skip
    if preference is not None:
        found["preference"] = asdict(preference)
    if validation is not None:
        scores = validation.scores
        ninety = scores.coverage[0.9]
        k = validation.pareto_k
        rough = 0 if k is None else int((k > PARETO_K_MAX).sum())
        print(
            f"{'left out one by one' if held is None else f'held out ({kept})'}: 90 % band covers "
            f"{ninety.hits} of {ninety.n}, RMSE {format_number(scores.rmse)}, "
            f"CRPS {format_number(scores.crps)}"
            + (f" ({rough} of them roughly: `calib report` fits without each)" if rough else "")
        )
        found["left_out" if held is None else "held_out"] = {
            "rows": ninety.n, "covered_90": ninety.hits, "rmse": scores.rmse, "crps": scores.crps,
            **({} if held is None else {"what": str(kept)}),
        }  # fmt: skip
    tell_verdict(judged)
    print(f"run folder: {out}")
    finish(0 if calibration.converged and good else 3, out / "run.json", **found)


def compare(
    ctx: typer.Context,
    what: Annotated[list[str], typer.Argument(help="Models, then the CSV: A B my.csv.")],
    out: Annotated[Path, typer.Option(help="Folder to write.")] = Path("calib-comparison"),
    priors: opt.PriorFiles = None,
    seed: opt.Seed = 2019,
    hold_out: opt.HoldOutOption = None,
    overwrite: opt.Overwrite = False,
    max_steps: opt.MaxSteps = 25_600,
    workers: opt.Workers = opt.CORES,
    plugins: opt.Models = None,
    simulator: opt.Simulators = None,
    json: Json = False,
) -> None:
    """Say which of several models the same data prefer, and what they cannot tell."""
    from functools import partial

    from calib.batch.folders import claimed, fresh_folder
    from calib.batch.foreign import drop, keep
    from calib.cli.options import progress_bars, tell_compared
    from calib.cli.simulators import say
    from calib.inference.emulation.prepared import prepare
    from calib.inference.prior_files import prior_file_model
    from calib.inference.sampling.sampler import SamplerSettings
    from calib.models import get_model
    from calib.report.comparison import text, write_comparison
    from calib.report.study_tasks import HoldOut, read_and_split
    from calib.validation.comparison import check_comparable
    from calib.validation.comparison import compare as find

    *models, file = what
    ctx.with_resource(claimed(out, overwrite=overwrite))
    check_comparable(models)
    chosen = [get_model(name) for name in models]
    needed = {c for m in chosen for c in (*m.conditions, m.output)}
    kept = None if hold_out is None else HoldOut.parse(hold_out)
    fitted, held = read_and_split(Path(file), sorted(needed), kept)
    elsewhere = [] if held is None else [held]
    given = {prior_file_model(path): path for path in priors or ()}
    with progress_bars() as tell:
        emulations = {
            name: prepare(
                name, fitted, seed, priors=given.get(name), elsewhere=elsewhere, workers=workers,
                progress=tell,
            )
            for name in models
        }  # fmt: skip
        found = find(
            fitted, models, seed, held_out=held, priors=given,
            settings=SamplerSettings(max_steps=max_steps), progress=tell, workers=workers,
        )  # fmt: skip
    fails = {name: e.reasons for name, e in emulations.items() if e is not None}
    write = partial(
        write_comparison, found, command=opt.command(), hold_out=hold_out or "",
        emulator_fails=fails,
    )  # fmt: skip
    drop()
    keep("comparison", write)
    good = [say(name, emulation) for name, emulation in emulations.items()]
    with fresh_folder(out, overwrite=overwrite) as folder:
        written = write(folder)
    tell_compared(written)
    print(text(written))
    print(out / "index.html")
    finish(0 if found.sound and all(good) else 3, written, folder=str(out))
