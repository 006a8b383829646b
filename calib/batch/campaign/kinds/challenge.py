"""Replicates of simulation-based calibration: simulate, calibrate, rank the truth.

Challenge cases: made of known cause, diagnosed without it, and held against it.

They are made by the repository's test bench, which a wheel does not have.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np
from pydantic import Field

from calib.batch.campaign.kinds.base import Kind, Planned, Section, Task, Work
from calib.batch.campaign.kinds.diagnose import diagnosis_numbers
from calib.batch.campaign.place import Place
from calib.batch.environment import from_the_bench, source_sha256
from calib.errors import CalibError
from calib.gap.batch import written
from calib.gap.case import read_case
from calib.gap.diagnose import diagnose
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


_TABLE = "[[challenge]]"


class ChallengeSection(Section):
    """``[[challenge]]``: cases drawn from a seed."""

    cases: int = Field(ge=1, description="how many, 1 or more")
    draw_seed: int = Field(ge=0, description="0 or a positive whole number: which cases are drawn")
    tier: Literal["both", "easy", "hard"] = Field(
        default="both", description="'easy', 'hard' or 'both'"
    )
    null_fraction: float = Field(
        default=1.0 / 3.0, ge=0.0, le=0.7, description="the share without a gap, 0 to 0.7"
    )


# A case's seed, tier and truth, and the hash of the code that makes it.
type ChallengeItem = tuple[np.random.SeedSequence, Literal["easy", "hard"], str, str]


class Challenge(Kind[ChallengeSection, ChallengeItem]):
    """Make, diagnose and mark one case.

    The cases are those of `calib challenge make --seed DRAW_SEED`, but their answers lie beside
    the diagnoses: this is for figures over many cases, not for a test that others should believe.
    """

    name = "challenge"
    section = ChallengeSection

    def plan(self, section: ChallengeSection, place: Place) -> Iterator[Planned]:
        """Yield a task for each case."""
        with from_the_bench(place.where):
            from challenge.make import case_jobs

        tiers: tuple[Any, ...] = ("easy", "hard") if section.tier == "both" else (section.tier,)
        jobs, _ = case_jobs(section.draw_seed, section.cases, tiers, section.null_fraction)
        for name, (own, tier, truth) in jobs.items():
            yield Planned(
                name,
                {"draw_seed": section.draw_seed, "spawn_key": list(own.spawn_key), "tier": tier,
                 "truth": truth, "bench": _bench()},
            )  # fmt: skip

    def load(self, task: Task) -> ChallengeItem:
        """Return what the case is made from."""
        s = task.settings
        own = np.random.SeedSequence(s["draw_seed"], spawn_key=tuple(s["spawn_key"]))
        return own, s["tier"], s["truth"], s["bench"]

    def work(self, item: ChallengeItem, seed: int) -> Work:
        """Make the case, diagnose its files, and mark the diagnosis with its key."""
        with from_the_bench(_TABLE):
            from challenge.answers import read_answer
            from challenge.make import make_case

        own, tier, truth, bench = item
        if _bench() != bench:
            raise CalibError(
                "this worker would make other cases", where=_TABLE,
                allowed=f"the folder `challenge` whose hash is {bench}",
                mend="give the worker the same checkout",
            )  # fmt: skip
        made = make_case(own, tier, truth)
        with TemporaryDirectory() as scratch:
            folder = Path(scratch) / "case"
            made.write(folder)
            found = diagnose(read_case(folder), seed)
            files = written(found)
            for name in ("diagnosis.json", "fresh_prediction.csv"):
                (folder / name).write_bytes(files[name])
            answer = read_answer("case", made.key, folder)
        numbers = {
            "tier": answer.tier,
            "truth": answer.truth,
            "truth_probability": answer.truth_probability,
            "right_first": answer.among_first(1),
            "right_first_two": answer.among_first(2),
            "localisation_auc": answer.auc,
            "gap_over_noise": made.key["gap_over_noise"],
            "actual_shrink": {s.output: s.actual for s in answer.shrinks},
            "shrink_covered": {s.output: s.covered for s in answer.shrinks},
        }
        return Work(numbers | diagnosis_numbers(found), files)


def _bench() -> str:
    """Return the hash of the bench's code here."""
    import challenge

    return source_sha256(Path(challenge.__path__[0]))[:12]
