"""Replicates of simulation-based calibration: simulate, calibrate, rank the truth."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict

from pydantic import Field

from calib.batch.campaign.kinds.base import Kind, Planned, Section, Task, Work
from calib.batch.campaign.place import Place
from calib.errors import CalibError
from calib.models import get_model
from calib.models.simulators.registered import slow_simulator
from calib.validation.sbc.replicate import Item, replicate
from calib.validation.sbc.run import SETTINGS, chosen_models


class SbcSection(Section):
    """``[[sbc]]``: simulated campaigns of some models."""

    simulations: int = Field(ge=1, description="how many of each model, 1 or more")
    draw_seed: int = Field(
        ge=0, description="0 or a positive whole number: which campaigns are drawn"
    )
    models: list[str] = Field(
        default=chosen_models(), min_length=1,
        description="a list of models, see `calib models`; by default all that are not slow",
    )  # fmt: skip


class Sbc(Kind[SbcSection, Item]):
    """One replicate, that of `calib sbc --seed DRAW_SEED`, which judges them all together."""

    name = "sbc"
    section = SbcSection

    def plan(self, section: SbcSection, place: Place) -> Iterator[Planned]:
        """Yield a task for each replicate."""
        with place.telling("models"):
            names = [get_model(name).name for name in section.models]
        for model in names:
            if slow_simulator(model) is not None:
                # Its truths are runs, and so it is emulated on the way: for one process at a time.
                raise CalibError(
                    f"the simulator behind {model} is emulated for every replicate, which a "
                    "campaign cannot do side by side", where=f"{place.where}, models",
                    allowed="closed forms, and simulators with emulate = false",
                    mend=f"use calib sbc --model {model} --data CSV, which spreads the runs "
                    "themselves over --workers",
                )  # fmt: skip
            for i in range(section.simulations):
                yield Planned(
                    f"{model}-{i:04d}",
                    {"model": model, "index": i, "draw_seed": section.draw_seed,
                     "sampler": asdict(SETTINGS)},
                )  # fmt: skip

    def load(self, task: Task) -> Item:
        """Return what the replicate needs."""
        s = task.settings
        return Item(s["model"], s["index"], s["draw_seed"], SETTINGS)

    def work(self, item: Item, seed: int) -> Work:
        """Run the replicate; its record is what `calib sbc` keeps of it."""
        record = replicate(item)
        numbers = {key: record[key] for key in ("model", "converged", "steps", "extended")}
        # As a fraction of the draws: uniform between 0 and 1 if all is right.
        numbers |= {"rank": {name: rank / n for name, (rank, n) in record["ranks"].items()}}
        return Work(numbers, {"replicate.json": json.dumps(record, indent=1) + "\n"})
