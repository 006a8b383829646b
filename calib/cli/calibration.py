"""The commands `report`, `fit` and `compare`."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from calib.cli import options as opt
from calib.cli.options import emulate, finish, progress_bars, say_failed
from calib.errors import CalibError

if TYPE_CHECKING:
    from calib.inference.calibration import Calibration, ParameterSummary
    from calib.inference.emulation import Emulation
    from calib.report.sections import Section
    from calib.report.verdict import Verdict
    from calib.validation.validate import Validation


def report(
    ctx: typer.Context,
    files: Annotated[
        list[Path] | None, typer.Argument(help="Your CSV files; without any, the embedded data.")
    ] = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder to write.")] = Path(
        "calib-report"
    ),
    seed: opt.Seed = 2019,
    hold_out: opt.HoldOutOption = None,
    model: Annotated[
        list[str] | None,
        typer.Option(help="Model to use instead of the suggested one; repeatable."),
    ] = None,
    priors: opt.PriorFiles = None,
    only: Annotated[
        list[str] | None,
        typer.Option(help="Report this output only, e.g. drawbar_pull; repeatable."),
    ] = None,
    compare: Annotated[
        list[str] | None,
        typer.Option(help="Also compare these models on the same rows; give two or more."),
    ] = None,
    overwrite: opt.Overwrite = False,
    dry_run: opt.DryRun = False,
    pdf: Annotated[bool, typer.Option("--pdf", help="Also write figures as PDF.")] = False,
    max_steps: opt.MaxSteps = 25_600,
    posteriors: Annotated[
        bool, typer.Option(help="Keep the posteriors (several megabytes of netCDF) in the folder.")
    ] = True,
    reviewer: Annotated[
        bool,
        typer.Option(
            "--reviewer",
            help="Instead, check the folder that is given, and write one "
            "page for a reviewer; without any, of the source paper.",
        ),
    ] = False,
    views: Annotated[
        bool,
        typer.Option(help="Write page, figures and tables as well as the numbers."),
    ] = True,
    workers: opt.Workers = opt.CORES,
    plugins: opt.Models = None,
    simulator: opt.Simulators = None,
    json: opt.Json = False,
) -> None:
    """Calibrate, predict, validate and write a report folder with an index.html."""
    from dataclasses import replace

    from calib import SamplerSettings, build_problem, read_table
    from calib.batch.folders import claimed
    from calib.batch.pool import pool
    from calib.data.quantities import OUTPUTS
    from calib.inference.prior_files import prior_file_model
    from calib.report.sections import EmulatorSection, work_out
    from calib.report.study import HoldOut, fitted_rows, plan_tasks
    from calib.report.verdict import judge_evidence
    from calib.report.writer import write_report

    if reviewer:
        # Without a folder, of what `calib report` writes without --out.
        folders, usual = files or [Path("calib-report")], out == Path("calib-report")
        out = Path("calib-review") if usual else out
        _review(ctx, folders, out, workers, overwrite=overwrite)
        return
    ctx.with_resource(claimed(out, overwrite=overwrite))
    title = "Calibration report"
    sections: list[Section[Any]] = []
    if files:
        tasks = plan_tasks(
            [read_table(f, allow_missing=tuple(OUTPUTS.values())) for f in files],
            None if hold_out is None else HoldOut.parse(hold_out),
            models=model or (),
            prior_paths=priors or (),
            only=only or (),
        )
    else:
        # The gaps and tables of the source have no place beside the user's own data.
        from calib.he2019.embedded import he2019_tasks
        from calib.he2019.sections import AuditSection, GapsSection

        own = {"--hold-out": hold_out, "--model": model, "--priors": priors and not compare}
        if ignored := [option for option, value in own.items() if value]:
            raise CalibError(
                f"{ignored[0]} is for files of your own, and none is given",
                expected="calib report FILE.csv …",
                hint=f"give your CSV files, or leave {ignored[0]} out",
            )
        tasks = he2019_tasks(only or ())
        sections = [] if only else [GapsSection(), AuditSection()]
        title = "Calibration report: He, Sandu & Osorio (2019), reconstructed data"
    settings = SamplerSettings(max_steps=max_steps)
    if dry_run:
        split = {task.model: fitted_rows(task) for task in tasks}
        problems = [build_problem(t.model, split[t.model][0], t.prior_path) for t in tasks]
        opt.planned(problems, {m: len(held or ()) for m, (_, held) in split.items()}, out)
        return
    prepared = {task.model: (task, task.prior_path) for task in tasks}
    if compare:
        from calib.report.comparison import plan_comparison

        given = {prior_file_model(path): path for path in priors or ()}
        planned = plan_comparison(tasks, compare, given)
        sections.append(replace(planned, settings=settings, command=opt.command(), workers=workers))
        prepared |= {name: (planned.task, planned.priors.get(name)) for name in compare}
    emulations: dict[str, Emulation] = {}
    for name, (task, path) in prepared.items():
        rows = {name: (fitted_rows(task)[0], path)}
        emulations |= emulate(rows, seed, workers, [task.table])
    if emulations:
        sections.append(EmulatorSection({name: e.document() for name, e in emulations.items()}))
    with pool(workers) as side, progress_bars() as tell:
        found = work_out(
            tasks, seed, settings=settings, sections=sections, progress=tell, workers=workers,
            pool=side,
        )  # fmt: skip
        page = write_report(
            found, out, settings=settings, command=opt.command(), title=title,
            overwrite=overwrite, posteriors=posteriors and views, views=views, pdf=pdf,
            progress=tell, pool=side,
        )  # fmt: skip
    study, verdicts = found.study, {}
    for key, result in study.successes.items():
        ninety = result.validation.scores.coverage[0.9]
        state = "converged" if result.calibration.converged else "NOT CONVERGED"
        emulation = emulations.get(result.task.model)
        fails = () if emulation is None else emulation.reasons
        judged = judge_evidence(replace(result.evidence, emulator_fails=fails))
        verdicts[key] = judged.document()
        print(f"{key}: {state}; 90 % band covers {ninety.hits} of {ninety.n} rows not fitted")
        tell_verdict(judged, f"{key}: ")
    for key, failure in study.failures.items():
        print(f"{key}: FAILED: {failure.error}", file=sys.stderr)
    print(page)
    print(f"next: open that page; calib check {out} computes it again")
    converged = all(r.calibration.converged for r in study.successes.values())
    for record in (s.record(part) for s, part in found.parts if s.name == "comparison"):
        tell_compared(record)
        print(record["verdict"])
        converged &= bool(record["converged"])
    good = converged and all(e.passed for e in emulations.values())
    code = 1 if study.failures else 0 if good else 3
    finish(code, out / "summary.json", folder=str(out), verdicts=verdicts)


def _review(
    ctx: typer.Context, folders: list[Path], out: Path, workers: int, *, overwrite: bool
) -> None:
    """Write the page for a reviewer of a folder."""
    from calib.batch.folders import claimed, fresh_folder
    from calib.checking.review import FILE, review, write_review
    from calib.cli.check import run_check

    if len(folders) != 1:
        raise CalibError("there are several folders to review", hint="review each by itself")
    ctx.with_resource(claimed(out, overwrite=overwrite))
    outcome = run_check(folders[0], False, workers)
    found = review(folders[0], outcome)
    with fresh_folder(out, overwrite=overwrite) as folder:
        write_review(found, folder, opt.command())
    print(found["verdict"])
    print(out / "index.html")
    finish(outcome.exit_code, out / FILE, folder=str(out))


def fit(
    ctx: typer.Context,
    file: Annotated[Path, typer.Argument(help="CSV whose column names carry units.")],
    model: opt.ModelOption,
    out: Annotated[Path, typer.Option("--out", "-o", help="Run folder to write.")] = Path(
        "calib-run"
    ),
    priors: Annotated[Path | None, typer.Option(help="Prior file; see `calib priors`.")] = None,
    seed: opt.Seed = 2019,
    hold_out: opt.HoldOutOption = None,
    overwrite: opt.Overwrite = False,
    dry_run: opt.DryRun = False,
    max_steps: opt.MaxSteps = 25_600,
    workers: opt.Workers = opt.CORES,
    plugins: opt.Models = None,
    simulator: opt.Simulators = None,
    json: opt.Json = False,
) -> None:
    """Calibrate one model on one file and save the posterior."""
    from dataclasses import asdict
    from functools import partial

    from calib import SamplerSettings, build_problem, calibrate, estimate, save_calibration
    from calib.batch.folders import claimed, fresh_folder, keep
    from calib.inference.random import generator
    from calib.models import get_model
    from calib.report.study import HoldOut, read_and_split, validated
    from calib.report.verdict import keep_verdict, verdict
    from calib.validation.comparison import noise_preference
    from calib.validation.constants import PARETO_K_MAX

    chosen = get_model(model)
    ctx.with_resource(claimed(out, overwrite=overwrite))
    settings = SamplerSettings(max_steps=max_steps)
    kept = None if hold_out is None else HoldOut.parse(hold_out)
    fitted, held = read_and_split(file, (*chosen.conditions, chosen.output), kept)
    if dry_run:
        opt.planned([build_problem(model, fitted, priors)], {model: len(held or ())}, out)
        return
    emulations = emulate({model: (fitted, priors)}, seed, workers, [held])
    with progress_bars() as tell:
        problem = build_problem(model, fitted, priors)
        point = estimate(problem, "least_squares", generator(seed, model, "least_squares"))
        calibration = calibrate(
            problem, seed, estimates=(point,), settings=settings, progress=partial(tell, "sampling")
        )
        keep("run", partial(save_calibration, calibration))
        preference = noise_preference(
            calibration, settings=settings, workers=workers,
            progress=partial(tell, "leaving rows out"),
        )  # fmt: skip
    with fresh_folder(out, overwrite=overwrite) as folder:
        save_calibration(calibration, folder)
    validation = validated(calibration, held)
    fails = tuple(reason for e in emulations.values() for reason in e.reasons)
    judged = verdict(calibration, validation, emulator_fails=fails, held_out=str(kept or ""))
    keep_verdict(judged, out)
    posterior_table(calibration, judged)
    print(verdict_line(calibration))
    say_failed(model)
    for note in problem.notes:
        print(f"note: {note}", file=sys.stderr)
    found: dict[str, Any] = {
        "folder": str(out), "notes": list(problem.notes), "warnings": list(judged.warnings),
        "posterior": {name: asdict(s) for name, s in calibration.summary.items()},
    }  # fmt: skip
    if preference is not None:
        print(preference.sentence)
        found["preference"] = asdict(preference)
    if validation is not None:
        scores, k = validation.scores, validation.pareto_k
        ninety = scores.coverage[0.9]
        rough = 0 if k is None else int((k > PARETO_K_MAX).sum())
        print(
            f"{'left out one by one' if held is None else f'held out ({kept})'}: "
            f"{scored(validation)}"
            + (f" ({rough} of them roughly: `calib report` fits without each)" if rough else "")
        )
        found["left_out" if held is None else "held_out"] = {
            "rows": ninety.n, "covered_90": ninety.hits, "rmse": scores.rmse, "crps": scores.crps,
            **({} if held is None else {"what": str(kept)}),
        }  # fmt: skip
    tell_verdict(judged)
    print(f"run folder: {out}")
    follow = f"calib predict {out} --at CONDITIONS.csv"
    if held is not None:
        follow = "fit all rows, without --hold-out, and predict from that run"
    print(f"next: {follow if calibration.converged else 'raise --max-steps, and fit again'}")
    good = calibration.converged and all(e.passed for e in emulations.values())
    finish(0 if good else 3, out / "run.json", **found)


def compare(
    ctx: typer.Context,
    what: Annotated[
        list[str], typer.Argument(help="Two or more models, then the CSV: A B my.csv.")
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder to write.")] = Path(
        "calib-comparison"
    ),
    priors: opt.PriorFiles = None,
    seed: opt.Seed = 2019,
    hold_out: opt.HoldOutOption = None,
    overwrite: opt.Overwrite = False,
    dry_run: opt.DryRun = False,
    max_steps: opt.MaxSteps = 25_600,
    workers: opt.Workers = opt.CORES,
    plugins: opt.Models = None,
    simulator: opt.Simulators = None,
    json: opt.Json = False,
) -> None:
    """Compare models on the same data: which they prefer, and which they cannot distinguish."""
    from functools import partial

    from calib.batch.folders import claimed, drop, fresh_folder, keep
    from calib.inference.prior_files import prior_file_model
    from calib.inference.problem import build_problem
    from calib.inference.sampler import SamplerSettings
    from calib.models import get_model
    from calib.report.comparison import text, write_comparison
    from calib.report.study import HoldOut, read_and_split
    from calib.validation.comparison import check_comparable
    from calib.validation.comparison import compare as compare_models

    *models, file = what
    ctx.with_resource(claimed(out, overwrite=overwrite))
    check_comparable(models)
    needed = {c for m in map(get_model, models) for c in (*m.conditions, m.output)}
    kept = None if hold_out is None else HoldOut.parse(hold_out)
    fitted, held = read_and_split(Path(file), sorted(needed), kept)
    given = {prior_file_model(path): path for path in priors or ()}
    rows = {name: (fitted, given.get(name)) for name in models}
    if dry_run:
        problems = [build_problem(name, table, path) for name, (table, path) in rows.items()]
        opt.planned(problems, dict.fromkeys(models, len(held or ())), out)
        return
    emulations = emulate(rows, seed, workers, [held])
    with progress_bars() as tell:
        found = compare_models(
            models, fitted, seed, held_out=held, priors=given,
            settings=SamplerSettings(max_steps=max_steps), progress=tell, workers=workers,
        )  # fmt: skip
    write = partial(
        write_comparison, found, command=opt.command(), hold_out=hold_out or "",
        emulator_fails={name: e.reasons for name, e in emulations.items()},
    )  # fmt: skip
    drop()
    keep("comparison", write)
    with fresh_folder(out, overwrite=overwrite) as folder:
        written = write(folder)
    tell_compared(written)
    print(text(written))
    print(out / "index.html")
    print(f"next: calib predict {out} --at CONDITIONS.csv")
    good = found.sound and all(e.passed for e in emulations.values())
    finish(0 if good else 3, written, folder=str(out))


def posterior_table(calibration: Calibration, judged: Verdict) -> None:
    """Print a calibration's posterior as a table, in agreement with its verdict."""
    from calib.validation.assumptions import parameter_remarks

    problem = calibration.problem
    title = f"{problem.bound.model.name}: posterior of {len(problem.table)} rows"
    print_posterior(
        title, calibration.summary, "remark", parameter_remarks(calibration, judged.remarks)
    )


def print_posterior(
    title: str, summary: Mapping[str, ParameterSummary], last: str, words: Mapping[str, str]
) -> None:
    """Print summaries of parameters as a table, with words on each in a last column."""
    from rich.table import Table as RichTable

    from calib.report.numbers import centre_text, interval_text

    table = RichTable(title=title)
    for heading in ("parameter", "unit"):
        table.add_column(heading)
    for heading in ("mean ± sd or median", "95 % HDI", "ESS bulk/tail", "R-hat"):
        table.add_column(heading, justify="right")
    table.add_column(last)
    for s in summary.values():
        ess = f"{s.ess_bulk:.0f}/{s.ess_tail:.0f}"
        numbers = (centre_text(s), interval_text(s), ess, f"{s.rhat:.3f}")
        table.add_row(s.name, s.unit, *numbers, words.get(s.name, ""))
    opt.wide_console(120).print(table)


def scored(validation: Validation) -> str:
    """Say how well unseen rows were predicted."""
    from calib.report.numbers import format_number

    scores, ninety = validation.scores, validation.scores.coverage[0.9]
    return (
        f"90 % band covers {ninety.hits} of {ninety.n}, RMSE {format_number(scores.rmse)}, "
        f"CRPS {format_number(scores.crps)}"
    )


def tell_verdict(found: Verdict, of: str = "") -> None:
    """Print a verdict, the warnings behind it first."""
    for warning in found.warnings:
        print(f"warning: {of}{warning}", file=sys.stderr)
    for line in found.lines:
        print(f"{of}{line}")


def tell_compared(found: Mapping[str, Any]) -> None:
    """Print the verdict on each model of a comparison, as `comparison.json` has it."""
    from calib.report.verdict import Verdict

    for name, model in found["models"].items():
        tell_verdict(Verdict.of(model["verdict"]), f"{name}: ")


def verdict_line(calibration: Calibration) -> str:
    """Say whether a calibration passed the gate, and what to do if not."""
    gate = calibration.draws.report
    if gate.passed:
        return (
            f"converged: {calibration.draws.t.shape[0]} ensembles, {gate.steps} steps, "
            f"R-hat at most {gate.rhat.max():.4f}, ESS at least "
            f"{min(gate.ess_bulk.min(), gate.ess_tail.min()):.0f}"
        )
    return (
        "NOT CONVERGED, do not use these numbers: "
        + "; ".join(gate.reasons[:3])
        + ". Raise --max-steps, or give tighter priors for parameters the data do not determine."
    )
