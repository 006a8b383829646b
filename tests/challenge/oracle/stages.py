"""Stages and cases for the oracle, drawn by the generator itself."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from calib.challenge.build import DrawnCase, try_case
from calib.challenge.design import Needs, Tier
from calib.challenge.files import case_files
from calib.challenge.mechanism import Readings
from calib.challenge.oracle.lab import View, known_soil
from calib.challenge.oracle.search import Search
from calib.challenge.seal import KEY_SCHEMA, publish, seal
from calib.challenge.stage import Stage, draw_stage


@cache
def stage_with(outputs: tuple[str, ...], tier: Tier = "hard", seed: int = 0) -> Stage:
    """Return a stage with these outputs."""
    rng = np.random.default_rng(seed)
    while True:
        stage = draw_stage(rng, tier, Needs(varies=("run_order", "speed_m_s")))
        if stage is not None and stage.design.outputs == outputs:
            return stage


@cache
def drawn(truth: str, tier: Tier, seed: int) -> DrawnCase:
    """Return the first fair case of a truth."""
    rng = np.random.default_rng(seed)
    while True:
        case = try_case(rng, tier, truth)
        if case is not None:
            return case


def noisy(rng: np.random.Generator, readings: Readings, sd: Readings) -> Readings:
    """Return readings with noise."""
    return {name: r + sd[name] * rng.standard_normal(r.size) for name, r in readings.items()}


def search(stage: Stage, residual: np.ndarray, prior: dict[str, float], seed: int = 0) -> Search:
    """Return a search of one who knows the soil, among the states of a prior."""
    view: View = known_soil(residual)
    logs = {state: float(np.log(share)) for state, share in prior.items()}
    return Search(stage, view, view, logs, np.random.default_rng(seed))


def sealed(root: Path, cases: list[DrawnCase], seed: int = 0) -> tuple[Path, Path]:
    """Write cases and their key; return the cases' folder and the key."""
    rng, entries = np.random.default_rng(seed), {}
    for i, case in enumerate(cases):
        files = case_files(rng, case)
        files.write(root / "cases" / f"case-{i:03d}")
        entries[f"case-{i:03d}"] = files.key
    key: dict[str, Any] = {"schema": KEY_SCHEMA, "seed": 1, "salt": "ab", "cases": entries}
    digest = seal(key, root / "key.json")
    publish(root / "cases", key, digest, ("easy", "hard"))
    return root / "cases", root / "key.json"
