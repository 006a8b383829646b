"""The verb that compares models on the same data."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from calib.cli import options as opt
from calib.cli.machine import Json, finish


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
    from calib.batch.unfinished import drop, keep
    from calib.cli.display import progress_bars, tell_compared
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
