"""Verbs of the blind test that the diagnosis is held against; most need the repository's bench."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Literal

import typer

from calib.batch.bench import from_the_bench
from calib.cli import options as opt
from calib.cli.machine import Json, finish

_Cases = Annotated[Path, typer.Argument(help="Folder with cases.")]
_Key = Annotated[Path, typer.Option(help="Their sealed answers.")]

verbs = typer.Typer(no_args_is_help=True, help="The blind test of the diagnosis.")


@verbs.command()
def make(
    out: Annotated[Path, typer.Option(help="Folder for the cases.")],
    key: Annotated[Path, typer.Option(help="File for the sealed answers, outside it.")],
    seed: opt.Seed,
    cases: Annotated[int, typer.Option(help="How many.", min=1)] = 300,
    tier: Annotated[
        Literal["both", "easy", "hard", "large"],
        typer.Option(help="Difficulty; large: gaps of 5 to 30 noise sds, up to three causes."),
    ] = "both",
    workers: opt.Workers = 2,
    scheduler: opt.Scheduler = None,
    json: Json = False,
) -> None:
    """Write cases of known cause, and their answers into a sealed key."""
    with from_the_bench("calib challenge make"):
        from challenge.make import make as make_cases
    from calib.cli.display import progress_bars

    with progress_bars() as tell:
        digest = make_cases(
            out, key, seed=seed, n_cases=cases, workers=workers, scheduler=scheduler,
            tiers=("easy", "hard") if tier == "both" else (tier,),
            progress=lambda done, n: tell("making cases", done, n),
        )  # fmt: skip
    print(f"{cases} cases in {out}; the key's SHA-256 is {digest}")
    finish(0, {"folder": str(out), "cases": cases, "key_sha256": digest})


@verbs.command()
def run(
    folder: _Cases,
    out: Annotated[Path, typer.Option(help="Folder for the diagnoses; resumed if it is there.")],
    seed: opt.Seed = 1,
    workers: opt.Workers = 2,
    scheduler: opt.Scheduler = None,
    plugins: opt.Models = None,
    json: Json = False,
) -> None:
    """Diagnose every case of a folder; run again to resume."""
    from calib.cli.display import progress_bars
    from calib.gap.batch import case_folders, diagnose_cases

    cases = case_folders(folder)
    with progress_bars() as tell:
        failed = diagnose_cases(
            cases, out, seed, workers=workers, scheduler=scheduler, announce=opt.announce,
            progress=lambda done, n: tell("diagnosing", done, n),
        )  # fmt: skip
    for name, error in failed.items():
        print(f"calib: {name} failed: {error}", file=sys.stderr)
    print(f"{len(cases) - len(failed)} of {len(cases)} cases diagnosed in {out}")
    finish(1 if failed else 0, {"folder": str(out), "cases": len(cases), "failed": failed})


@verbs.command("well-specified")
def well_specified(
    folder: _Cases,
    key: _Key,
    out: Annotated[Path, typer.Option(help="Folder for the well-specified cases.")],
    out_key: Annotated[Path, typer.Option(help="File for their answers, outside it.")],
    seed: opt.Seed = 1,
    workers: opt.Workers = 2,
    scheduler: opt.Scheduler = None,
    json: Json = False,
) -> None:
    """Write the same designs again, with effects that act exactly as the diagnosis believes."""
    with from_the_bench("calib challenge well-specified"):
        from challenge.redraw import redraw
    from functools import partial

    from calib.cli.display import progress_bars
    from calib.gap.well_specified import well_specified_case

    with progress_bars() as tell:
        without = redraw(
            folder, key, out, out_key, partial(well_specified_case, seed), seed=seed,
            workers=workers, scheduler=scheduler, announce=opt.announce,
            progress=lambda done, n: tell("drawing cases", done, n),
        )  # fmt: skip
    for name, why in without.items():
        print(f"calib: {name} has no well-specified case: {why}", file=sys.stderr)
    print(f"well-specified cases in {out}; diagnose and score them as any others")
    finish(0, {"folder": str(out), "without": without})


@verbs.command()
def score(
    ctx: typer.Context,
    folder: _Cases,
    results: Annotated[Path, typer.Option(help="Folder with the diagnoses.")],
    key: _Key,
    outputs: Annotated[
        str, typer.Option(help="Only cases that measure these, e.g. drawbar_pull,rut_depth.")
    ] = "",
    out: Annotated[Path | None, typer.Option(help="Folder for the table and figures.")] = None,
    overwrite: opt.Overwrite = False,
    json: Json = False,
) -> None:
    """Compare diagnoses with the sealed answers."""
    from dataclasses import asdict

    with from_the_bench("calib challenge score"):
        from challenge.figures import levels_figure, reliability_figure
        from challenge.score import score as score_all
        from challenge.table import text_table
    from calib.batch.folders import claimed, fresh_folder

    if out is not None:
        ctx.with_resource(claimed(out, overwrite=overwrite))
    found = score_all(folder, results, key, [o.strip() for o in outputs.split(",") if o.strip()])
    table = text_table(found)
    for warning in found.warnings:
        print(f"calib: {warning}", file=sys.stderr)
    print(table)
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
