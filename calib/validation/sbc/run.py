"""Run the replicates of all models, resumable, on this machine or a cluster."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from calib.batch.folders import check_room, write_whole, writing
from calib.batch.tasks import run_tasks
from calib.data.documents import read_text
from calib.errors import CalibError
from calib.inference.prior_files import DeclaredPriors, prior_file_model
from calib.inference.sampling.sampler import SamplerSettings
from calib.models import MODELS, get_model
from calib.models.simulators.registered import slow_simulator
from calib.validation.sbc.designs import design_of
from calib.validation.sbc.emulated import most_runs
from calib.validation.sbc.replicate import Item, replicate
from calib.validation.sbc.score import SbcScore, score

# As for a report, but a chain is extended to 3200 steps, not 25,600, before it counts as one that
# did not converge: simulated campaigns are many, and some tell next to nothing.
SETTINGS = SamplerSettings(max_steps=3200)
_RUN = "run.json"
REPLICATES = "replicates"


def run_sbc(
    out: Path,
    *,
    models: Sequence[str] = (),
    simulations: int = 300,
    seed: int,
    settings: SamplerSettings = SETTINGS,
    priors: Sequence[Path] = (),
    data: Path | None = None,
    workers: int = 1,
    scheduler: str | None = None,
    progress: Callable[[int, int], None] | None = None,
    announce: Callable[[str], None] | None = None,
) -> SbcScore:
    """Simulate, calibrate and rank; what is there already is not done again.

    The folder's ``replicates`` gets one JSON file for each replicate of each model, by default of
    all that are not slow. A prior file says which model it is for; `data`, a CSV, at which
    conditions to simulate, if not at those of the models' examples. The others are as for
    `calib.batch.tasks.run_tasks`. With a slow simulator among the models campaigns are done one
    after the other, and `workers` or `scheduler` make its runs: they share one folder of runs.

    Raises
    ------
    CalibError
        If there is no such model, it is a table of runs, or the folder holds a run of another seed
        or other settings.
    """
    names = chosen_models(models)
    # As text: replicates may run where the files are not.
    given = {prior_file_model(p): DeclaredPriors(p.name, read_text(p)) for p in priors}
    if unused := [model for model in given if model not in names]:
        raise CalibError(
            f"there are priors of {', '.join(unused)}, which is not among the models",
            allowed=", ".join(names), mend="name it with --model, or leave its priors out",
        )  # fmt: skip
    said: dict[str, Any] = (
        {"priors": {model: p.text for model, p in given.items()}} if given else {}
    )
    slow = {model: found for model in names if (found := slow_simulator(model)) is not None}
    asked = [*slow] if data is None else names
    designs = {model: design_of(model, data) for model in asked}
    if data is not None:
        said["data"] = read_text(Path(data))
    told = [most_runs(m, found, designs[m], simulations) for m, found in slow.items()]
    _claim(out, {"seed": seed, "settings": asdict(settings), **said})
    if announce is not None:
        for line in told:
            announce(line)
    spread: dict[str, Any] = {"workers": workers, "scheduler": scheduler}
    items = {
        f"{model}-{i:04d}": Item(
            model, i, seed, settings, given.get(model), None if data is None else designs[model],
            **(spread if model in slow else {}),
        )
        for model in names
        for i in range(simulations)
    }  # fmt: skip
    outcome = run_tasks(
        replicate, items, out / REPLICATES, **({} if slow else spread),
        progress=progress, announce=announce,
    )  # fmt: skip
    return score(read_records(out, outcome.done), seed, simulations, outcome.failed)


def chosen_models(models: Sequence[str] = ()) -> list[str]:
    """Return the names of models, which must be known; of all that are not slow by default."""
    named = [get_model(name).name for name in models]
    return named or [m.name for m in MODELS.values() if not m.slow]


def read_records(out: Path, names: Sequence[str]) -> list[dict[str, Any]]:
    """Return the records of some replicates of a run."""
    return [json.loads((out / REPLICATES / f"{name}.json").read_bytes()) for name in names]


def _claim(out: Path, run: dict[str, Any]) -> None:
    """Write what is run into the folder, or check that it is the same that is there."""
    check_room(out)
    path = out / _RUN
    text = json.dumps(run, indent=1) + "\n"
    with writing(out):
        if path.exists():
            if path.read_text(encoding="utf-8") != text:
                raise CalibError(
                    "the folder holds replicates of another seed, other sampler settings or priors",
                    where=str(path),
                    mend="choose another --out, or the seed that is there",
                )
            return
        if out.exists() and any(p.suffix != ".part" for p in out.iterdir()):
            raise CalibError(
                "the output folder exists, is not empty and holds no simulation-based calibration",
                where=str(out),
                mend="choose another --out",
            )
        out.mkdir(parents=True, exist_ok=True)
        write_whole(path, text)
