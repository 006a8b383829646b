"""The commands `campaign`, `sbc` and `challenge`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

import typer

from calib.batch.environment import from_the_bench
from calib.cli import options as opt
from calib.cli.options import announce, finish, progress_bars
from calib.errors import CalibError


def _tell_failed(failed: Mapping[str, str]) -> None:
    for name, error in failed.items():
        announce(f"{name} failed: {error}")


def campaign(
    plan: Annotated[Path, typer.Argument(help="TOML file with the tasks: docs/formats/inputs.md.")],
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Folder for the results; a run there is resumed.")
    ] = Path("calib-campaign"),
    workers: opt.Workers = 2,
    scheduler: opt.Scheduler = None,
    only_list: Annotated[
        bool, typer.Option("--list", help="Check the plan, list its tasks and exit.")
    ] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Redo results made from other inputs.")
    ] = False,
    plugins: opt.Models = None,
    simulator: opt.Simulators = None,
    json: opt.Json = False,
) -> None:
    """Run many fits, diagnoses or SBC replicates; run again to resume."""
    from calib.batch.campaign import read_plan, run_campaign
    from calib.data.reader import SEEN

    planned = read_plan(plan)
    if only_list:
        print("\n".join(planned.tasks))
        finish(0, {"tasks": list(planned.tasks)})
        return
    with progress_bars() as tell:
        summary = run_campaign(
            planned, out, workers=workers, scheduler=scheduler, overwrite=overwrite,
            progress=lambda done, n: tell("tasks", done, n), announce=announce,
        )  # fmt: skip
    # Tasks of another process, or of before, have read them.
    labels = (numbers.get("data_label", "") for numbers in summary.numbers.values())
    SEEN.update(dict.fromkeys(filter(None, labels)))
    _tell_failed(summary.failed)
    counts = summary.counts
    print(f"{counts['done']} of {len(summary.kinds)} tasks done, {counts['failed']} failed")
    if summary.unconverged:
        print(f"NOT CONVERGED, not to be used: {', '.join(summary.unconverged)}")
    print(out / "summary.json")
    finish(1 if summary.failed else 3 if summary.unconverged else 0, out / "summary.json")


def sbc(
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Folder to write; a run there is resumed.")
    ],
    model: Annotated[
        list[str] | None,
        typer.Option(help="Model to test; by default all but slow ones; repeatable."),
    ] = None,
    simulations: Annotated[int, typer.Option(help="Simulated campaigns per model.", min=10)] = 300,
    seed: opt.Seed = 2019,
    priors: opt.PriorFiles = None,
    data: Annotated[
        Path | None,
        typer.Option(help="CSV with the conditions to simulate, instead of the example's."),
    ] = None,
    workers: opt.Workers = 2,
    scheduler: opt.Scheduler = None,
    plugins: opt.Models = None,
    simulator: opt.Simulators = None,
    json: opt.Json = False,
) -> None:
    """Test posteriors and bands on simulated data whose truth is known."""
    from dataclasses import asdict

    from calib.models import MODELS
    from calib.report.sbc import text_table, write_sbc
    from calib.validation.sbc import SETTINGS, chosen_models, run_sbc

    slow = [name for name in MODELS if name not in chosen_models()]
    if slow and not model:
        announce(
            f"left out: {', '.join(slow)}, of which each campaign takes minutes; name them with "
            "--model"
        )
    with progress_bars() as tell:
        score = run_sbc(
            out, models=model or (), simulations=simulations, seed=seed, priors=priors or (),
            data=data, workers=workers, scheduler=scheduler, announce=announce,
            progress=lambda done, n: tell("simulating and calibrating", done, n),
        )  # fmt: skip
    page = write_sbc(score, out, asdict(SETTINGS), opt.command())
    print(text_table(score))
    for of_model in score.models:
        _tell_failed(of_model.failed)
    print(page)
    bad = score.alarms or any(m.failed for m in score.models)
    finish(1 if bad else 0, out / "sbc.json", folder=str(out))


_Cases = Annotated[Path, typer.Argument(help="Folder with cases.")]
_Key = Annotated[Path, typer.Option(help="Folder with the answers.")]

challenge = typer.Typer(
    cls=opt.Group, no_args_is_help=True, help="The blind test of the diagnosis."
)


@challenge.command(
    cls=opt.Command,
    epilog="Example: calib challenge make --out cases --key answers --seed 1 --cases 20",
)
def make(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the cases.")],
    key: Annotated[Path, typer.Option(help="Folder for the answers, outside it.")],
    seed: opt.Seed,
    cases: Annotated[int, typer.Option(help="Number of cases.", min=1)] = 300,
    tier: Annotated[
        Literal["both", "easy", "hard", "large"],
        typer.Option(help="Difficulty; large: gaps of 5 to 30 noise sds, up to three causes."),
    ] = "both",
    workers: opt.Workers = 2,
    scheduler: opt.Scheduler = None,
    json: opt.Json = False,
) -> None:
    """Write cases of known cause, and their answers into another folder."""
    with from_the_bench("calib challenge make"):
        from challenge.make import make as make_cases
    with progress_bars() as tell:
        make_cases(
            out, key, seed=seed, n_cases=cases, workers=workers, scheduler=scheduler,
            tiers=("easy", "hard") if tier == "both" else (tier,),
            progress=lambda done, n: tell("making cases", done, n),
        )  # fmt: skip
    print(f"{cases} cases in {out}, their answers in {key}")
    finish(0, {"folder": str(out), "cases": cases})


@challenge.command(cls=opt.Command, epilog="Example: calib challenge run cases --out diagnoses")
def run(
    folder: _Cases,
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Folder for the diagnoses; a run there is resumed.")
    ],
    seed: opt.Seed = 1,
    workers: opt.Workers = 2,
    scheduler: opt.Scheduler = None,
    program: Annotated[
        str, typer.Option(help="Another program's command, such as 'python rival.py {case} {out}'.")
    ] = "",
    limit: Annotated[float, typer.Option(help="Seconds it may take for a case.", min=0.1)] = 3600.0,
    plugins: opt.Models = None,
    json: opt.Json = False,
) -> None:
    """Diagnose every case of a folder, by calib or another program; run again to resume."""
    from functools import partial

    from calib.gap.batch import case_folders, diagnose_cases

    cases = case_folders(folder)
    diagnosed = partial(diagnose_cases, cases, out, seed, scheduler=scheduler)
    if program:
        if scheduler:
            raise CalibError("--program runs on this machine alone", hint="leave --scheduler out")
        with from_the_bench("calib challenge run --program"):
            from challenge.programs import run_programs
        diagnosed = partial(run_programs, program, cases, out, limit=limit)
    with progress_bars() as tell:
        failed = diagnosed(
            workers=workers, announce=announce,
            progress=lambda done, n: tell("diagnosing", done, n),
        )  # fmt: skip
    _tell_failed(failed)
    print(f"{len(cases) - len(failed)} of {len(cases)} cases diagnosed in {out}")
    finish(1 if failed else 0, {"folder": str(out), "cases": len(cases), "failed": failed})


@challenge.command(
    "well-specified",
    cls=opt.Command,
    epilog="Example: calib challenge well-specified cases --key answers --out plain --out-key "
    "plain-answers",
)
def well_specified(
    folder: _Cases,
    key: _Key,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the well-specified cases.")],
    out_key: Annotated[Path, typer.Option(help="Folder for their answers, outside it.")],
    seed: opt.Seed = 1,
    workers: opt.Workers = 2,
    scheduler: opt.Scheduler = None,
    json: opt.Json = False,
) -> None:
    """Write the same designs again, with effects of exactly the forms that the diagnosis has."""
    with from_the_bench("calib challenge well-specified"):
        from challenge.redraw import redraw
    from functools import partial

    from calib.gap.well_specified import well_specified_case

    with progress_bars() as tell:
        without = redraw(
            folder, key, out, out_key, partial(well_specified_case, seed), seed=seed,
            workers=workers, scheduler=scheduler, announce=announce,
            progress=lambda done, n: tell("drawing cases", done, n),
        )  # fmt: skip
    for name, why in without.items():
        announce(f"{name} has no well-specified case: {why}")
    print(f"well-specified cases in {out}; diagnose and score them as any others")
    finish(0, {"folder": str(out), "without": without})


@challenge.command(
    cls=opt.Command,
    epilog="Example: calib challenge score cases --results diagnoses --key answers",
)
def score(
    ctx: typer.Context,
    folder: _Cases,
    results: Annotated[
        list[str],
        typer.Option(help="Folder with the diagnoses; NAME=FOLDER for each of several programs."),
    ],
    key: _Key,
    outputs: Annotated[
        str,
        typer.Option(help="Only cases that measure these outputs, e.g. drawbar_pull,rut_depth."),
    ] = "",
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for the table and figures.")
    ] = None,
    page: Annotated[
        Path | None, typer.Option(help="Markdown page for a table and a figure of all programs.")
    ] = None,
    section: Annotated[
        str, typer.Option(help="Name of the cases on that page; by default the folder's.")
    ] = "",
    plugins: opt.Models = None,
    overwrite: opt.Overwrite = False,
    json: opt.Json = False,
) -> None:
    """Compare diagnoses with the answers; --out and --json report the first program only."""
    from dataclasses import asdict

    with from_the_bench("calib challenge score"):
        from challenge.board import named_folders, write_board
        from challenge.figures import levels_figure, reliability_figure
        from challenge.score import score as score_all
        from challenge.table import text_table
    from calib.batch.folders import claimed, fresh_folder

    if out is not None:
        ctx.with_resource(claimed(out, overwrite=overwrite))
    only = [o.strip() for o in outputs.split(",") if o.strip()]
    scores = {n: score_all(folder, d, key, only) for n, d in named_folders(results).items()}
    for name, one in scores.items():
        for warning in one.warnings:
            announce(f"{name}: {warning}")
        print(*[f"{name}\n"] * (len(scores) > 1), text_table(one), sep="\n")
    found = next(iter(scores.values()))
    table = text_table(found)
    if page is not None:
        write_board(page, section or folder.resolve().name, scores)
        print(page)
    if out is not None:
        with fresh_folder(out, overwrite=overwrite) as scratch:
            (scratch / "score.txt").write_text(table + "\n", encoding="utf-8")
            levels_figure(list(found.tiers.values())).savefig(scratch / "levels.png", dpi=150)
            for tier in found.tiers:
                bins = found.tiers[tier].reliability
                reliability_figure(bins, f"{tier} cases").savefig(
                    scratch / f"reliability_{tier}.png", dpi=150
                )
        print(out)
    finish(0, {**asdict(found), "folder": out and str(out)})
