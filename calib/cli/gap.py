"""Verbs of the diagnosis: diagnose a case, and the blind test that proves it."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Literal

import typer

from calib.cli.parallel import CORES, Models, Scheduler, Workers, announce, resumable
from calib.errors import CalibError

__all__ = ["register"]

_Seed = Annotated[int, typer.Option(help="Same seed, same numbers.", min=0)]
_Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace an earlier result.")]


def register(app: typer.Typer) -> None:
    """Add the verbs to an app."""
    app.command()(diagnose)
    challenge = typer.Typer(no_args_is_help=True, help="The blind test of the diagnosis.")
    challenge.command("make")(make)
    challenge.command("run")(run)
    challenge.command("limit")(limit)
    challenge.command("twin")(twin)
    challenge.command("score")(score)
    app.add_typer(challenge, name="challenge")


def diagnose(
    case: Annotated[Path | None, typer.Argument(help="Case folder with a case.toml.")] = None,
    out: Annotated[Path, typer.Option(help="Folder to write.")] = Path("calib-diagnosis"),
    seed: _Seed = 1,
    run: Annotated[Path | None, typer.Option(help="Run folder of `calib fit`.")] = None,
    field: Annotated[Path | None, typer.Option(help="CSV of the field campaign.")] = None,
    effects: Annotated[Path | None, typer.Option(help="Python file with your effects.")] = None,
    overwrite: _Overwrite = False,
    workers: Workers = CORES,
    plugins: Models = None,
) -> None:
    """Find where a calibrated model misses, which effect it lacks, how far adding it gains."""
    from calib.batch.folders import check_folder, fresh_folder
    from calib.batch.pool import pool
    from calib.data.quantities import OUTPUTS, QUANTITIES
    from calib.gap.case import case_from_run, read_case
    from calib.gap.diagnose import diagnose as find
    from calib.gap.effects import EFFECTS
    from calib.gap.effects.check import check_on_case
    from calib.gap.effects.load import load_effects
    from calib.gap.files import write_diagnosis
    from calib.gap.provenance import INPUTS, inputs_record
    from calib.report.numbers import format_number
    from calib.report.page.gap_verdict import judge_gap

    check_folder(out, overwrite=overwrite)
    if case is not None and run is None and field is None:
        given = read_case(case)
    elif case is None and run is not None and field is not None:
        given = case_from_run(run, field)
    else:
        raise CalibError(
            "it is not clear what to diagnose",
            allowed="a case folder, or --run RUN together with --field CSV",
            mend="give one of the two",
        )
    own = {} if effects is None else load_effects(effects)
    files: dict[str, bytes] = {}
    if effects is not None:
        check_on_case(own, given, effects)
        paths = [effects, *(effects.with_name(f"{name}.toml") for name in own)]
        files = {path.name: path.read_bytes() for path in paths}
    manifest = {"seed": seed, "command": ["calib", *sys.argv[1:]]}
    with pool(workers, ["calib.report.page.diagnosis"]) as side:
        found = find(given, seed, effects={**EFFECTS, **own}, pool=side)
        from calib.report.page.diagnosis import gap_evidence, write_page

        with fresh_folder(out, overwrite=overwrite) as folder:
            write_diagnosis(found, folder)
            (folder / INPUTS).write_bytes(inputs_record(found.data.case, seed, files))
            write_page(found, folder, manifest, pool=side)
    for warning in found.data.case.warnings:
        print(f"calib: {warning}", file=sys.stderr)
    print(f"verdict: {found.verdict} ({judge_gap(gap_evidence(found)).headline})")
    for name in found.ranking.order[:4]:
        p = found.ranking.probability[name]
        text = ">0.999" if p >= 0.9995 else "<0.001" if p < 0.0005 else f"{p:.3f}"
        print(f"  {text:>6}  {name}")
    for output, s in found.shrink.items():
        low, high = s.interval
        unit = QUANTITIES[OUTPUTS[output]].unit.replace("**", "").replace("*", " ")
        print(
            f"{output}: error {format_number(s.rmse_before)} -> {format_number(s.rmse_after)} "
            f"{unit} rms, shrink {100 * s.fraction:.0f} % (90 % interval {100 * low:.0f} to "
            f"{100 * high:.0f} %), noise sd {format_number(s.noise_floor)} {unit}"
        )
    print(out / "index.html")


def make(
    out: Annotated[Path, typer.Option(help="Folder for the cases.")],
    key: Annotated[Path, typer.Option(help="File for the sealed answers, outside it.")],
    seed: _Seed,
    cases: Annotated[int, typer.Option(help="How many.", min=1)] = 300,
    tier: Annotated[Literal["both", "easy", "hard"], typer.Option(help="Difficulty.")] = "both",
    workers: Workers = 2,
    scheduler: Scheduler = None,
) -> None:
    """Write cases of known cause, and their answers into a sealed key."""
    from calib.challenge.make import make as make_cases
    from calib.cli.display import progress_bars

    with progress_bars() as tell:
        digest = make_cases(
            out, key, seed=seed, n_cases=cases, workers=workers, scheduler=scheduler,
            tiers=("easy", "hard") if tier == "both" else (tier,),
            progress=lambda done, n: tell("making cases", done, n),
        )  # fmt: skip
    print(f"{cases} cases in {out}; the key's SHA-256 is {digest}")


def run(
    folder: Annotated[Path, typer.Argument(help="Folder with cases.")],
    out: Annotated[Path, typer.Option(help="Folder for the diagnoses; resumed if it is there.")],
    seed: _Seed = 1,
    workers: Workers = 2,
    scheduler: Scheduler = None,
    plugins: Models = None,
) -> None:
    """Diagnose every case of a folder; run again to resume."""
    from calib.cli.display import progress_bars
    from calib.gap.batch import case_folders, diagnose_cases

    cases = case_folders(folder)
    with resumable(), progress_bars() as tell:
        failed = diagnose_cases(
            cases, out, seed, workers=workers, scheduler=scheduler, announce=announce,
            progress=lambda done, n: tell("diagnosing", done, n),
        )  # fmt: skip
    for name, error in failed.items():
        print(f"calib: {name} failed: {error}", file=sys.stderr)
    print(f"{len(cases) - len(failed)} of {len(cases)} cases diagnosed in {out}")
    if failed:
        raise typer.Exit(1)


def limit(
    folder: Annotated[Path, typer.Argument(help="Folder with cases.")],
    key: Annotated[Path, typer.Option(help="The sealed answers.")],
    out: Annotated[Path, typer.Option(help="Folder for limit.json; resumed if it is there.")],
    seed: _Seed = 1,
    effort: Annotated[int, typer.Option(help="Multiplies the places looked at.", min=1)] = 1,
    workers: Workers = 2,
    scheduler: Scheduler = None,
) -> None:
    """Find the best any method could do on these cases, by one who knows how they were made."""
    from calib.challenge.limit import find_limit
    from calib.cli.display import progress_bars

    with progress_bars() as tell:
        path = find_limit(
            folder, key, out, seed=seed, effort=effort, workers=workers, scheduler=scheduler,
            progress=lambda done, n: tell("asking the oracle", done, n), announce=announce,
        )  # fmt: skip
    print(path)


def twin(
    folder: Annotated[Path, typer.Argument(help="Folder with cases.")],
    key: Annotated[Path, typer.Option(help="Their sealed answers.")],
    out: Annotated[Path, typer.Option(help="Folder for the twins.")],
    twin_key: Annotated[Path, typer.Option(help="File for the twins' answers, outside it.")],
    seed: _Seed = 1,
    workers: Workers = 2,
    scheduler: Scheduler = None,
) -> None:
    """Write twins of cases, in which effects act exactly as the diagnosis believes."""
    from calib.cli.display import progress_bars
    from calib.twins import make_twins

    with progress_bars() as tell:
        without = make_twins(
            folder, key, out, twin_key, seed=seed, workers=workers, scheduler=scheduler,
            progress=lambda done, n: tell("drawing twins", done, n), announce=announce,
        )  # fmt: skip
    for name, why in without.items():
        print(f"calib: {name} has no twin: {why}", file=sys.stderr)
    print(f"twins in {out}; diagnose and score them as any other cases")


def score(
    folder: Annotated[Path, typer.Argument(help="Folder with cases.")],
    results: Annotated[Path, typer.Option(help="Folder with the diagnoses.")],
    key: Annotated[Path, typer.Option(help="The sealed answers.")],
    limit: Annotated[Path | None, typer.Option(help="limit.json of these cases.")] = None,
    outputs: Annotated[
        str, typer.Option(help="Only cases that measure these, e.g. drawbar_pull,rut_depth.")
    ] = "",
    out: Annotated[Path | None, typer.Option(help="Folder for the table and figures.")] = None,
    overwrite: _Overwrite = False,
) -> None:
    """Compare diagnoses with the sealed answers."""
    from calib.batch.folders import check_folder, fresh_folder
    from calib.challenge.figures import confusion_figure, levels_figure, reliability_figure
    from calib.challenge.limit import read_limit
    from calib.challenge.score import score as score_all
    from calib.challenge.table import text_table

    if out is not None:
        check_folder(out, overwrite=overwrite)
    found = score_all(folder, results, key, [o.strip() for o in outputs.split(",") if o.strip()])
    known = None if limit is None else read_limit(limit, folder).of({a.case for a in found.answers})
    table = text_table(found, known)
    for warning in found.warnings:
        print(f"calib: {warning}", file=sys.stderr)
    print(table)
    if out is None:
        return
    with fresh_folder(out, overwrite=overwrite) as scratch:
        (scratch / "score.txt").write_text(table + "\n", encoding="utf-8")
        levels = levels_figure(list(found.tiers.values()), known)
        levels.savefig(scratch / "levels.png", dpi=150)
        for tier, confusion in found.confusion.items():
            figure = confusion_figure(confusion, f"{tier} cases")
            figure.savefig(scratch / f"confusion_{tier}.png", dpi=150)
            bins = found.tiers[tier].reliability
            reliability_figure(bins, f"{tier} cases").savefig(
                scratch / f"reliability_{tier}.png", dpi=150
            )
    print(out)
