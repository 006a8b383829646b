"""The verb of simulation-based calibration."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from calib.cli import options as opt
from calib.cli.machine import Json, finish


def sbc(
    out: Annotated[Path, typer.Option(help="Folder to write; a run there is resumed.")],
    model: Annotated[
        list[str] | None, typer.Option(help="Model to test; all but slow ones if none; repeatable.")
    ] = None,
    simulations: Annotated[int, typer.Option(help="Campaigns per model.", min=10)] = 300,
    seed: opt.Seed = 2019,
    priors: opt.PriorFiles = None,
    data: Annotated[
        Path | None,
        typer.Option(help="CSV at whose conditions to simulate, not those of the example."),
    ] = None,
    workers: opt.Workers = 2,
    scheduler: opt.Scheduler = None,
    plugins: opt.Models = None,
    simulator: opt.Simulators = None,
    json: Json = False,
) -> None:
    """Prove posteriors and bands calibrated on simulated data whose truth is known."""
    from dataclasses import asdict

    from calib.cli.display import progress_bars
    from calib.models import MODELS
    from calib.report.sbc import text_table, write_sbc
    from calib.validation.sbc.run import SETTINGS, chosen_models, run_sbc

    slow = [name for name in MODELS if name not in chosen_models()]
    if slow and not model:
        opt.announce(
            f"left out: {', '.join(slow)}, of which each campaign takes minutes; name them with "
            "--model"
        )
    with progress_bars() as tell:
        score = run_sbc(
            out, models=model or (), simulations=simulations, seed=seed, priors=priors or (),
            data=data, workers=workers, scheduler=scheduler, announce=opt.announce,
            progress=lambda done, n: tell("simulating and calibrating", done, n),
        )  # fmt: skip
    page = write_sbc(score, out, asdict(SETTINGS), opt.command())
    print(text_table(score))
    for of_model in score.models:
        for name, error in of_model.failed.items():
            print(f"calib: {name} failed: {error}", file=sys.stderr)
    print(page)
    bad = score.alarms or any(m.failed for m in score.models)
    finish(1 if bad else 0, out / "sbc.json", folder=str(out))
