"""A folder with a plan: small cases and a small data file, quick to work on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np

from calib.inference import sampler
from calib.inference.diagnostics import judge
from calib.models import example_csv
from tests.gap.cases import PULL_ONLY, make_case, write_case

N_CASES = 2
PLAN = """
seed = 7

[[fit]]
name = "ruts"
data = ["data/*.csv"]
models = ["bekker"]

[[diagnose]]
name = "sites"
cases = ["cases/*"]

[[sbc]]
name = "ranks"
simulations = 2
draw_seed = 3
models = ["bekker"]
"""
NAMES = (
    "ruts.data-rut.bekker.shipped.nothing",
    *(f"sites.cases-case-{i}" for i in range(N_CASES)),
    *(f"ranks.bekker-000{i}" for i in range(2)),
)

EFFECT = """
from calib.gap.effects import Effect

class Wind(Effect):
    name = "wind"
    title = "wind on the rig adds to the pull"
    parameters = ("force",)
    outputs = ("pull",)
    covariates = ("order",)

    def on_output(self, phi, output, location, view):
        return location + phi[:, :1] * (view.of("order") % 2)
"""
WIND = """
model = "wind"

[parameters.force]
dist = "normal"
mean = 0.0
sd = 0.3
unit = "kN"
reason = "a gust is felt"
source = "test"
"""


def make_site(folder: Path, plan: str = PLAN, n_cases: int = N_CASES) -> Path:
    """Write data, cases and a plan; return the plan's path."""
    (folder / "data").mkdir(parents=True)
    (folder / "data" / "rut.csv").write_text(example_csv("bekker"))
    for i in range(n_cases):
        effect = ("force_offset", None)[i % 2]
        case = make_case(effect, models=PULL_ONLY, n_lab=15, n_field=12, n_fresh=4, seed=i)
        write_case(case, folder / "cases" / f"case-{i}")
    (folder / "plan.toml").write_text(plan)
    return folder / "plan.toml"


def content(out: Path) -> dict[str, bytes]:
    """Return the files of a campaign but the one that holds times.

    Of a posterior, its numbers: HDF5 leaves whatever memory held in the unused bytes of a file.
    """
    return {
        p.relative_to(out).as_posix(): _numbers(p) if p.suffix == ".nc" else p.read_bytes()
        for p in sorted(out.rglob("*"))
        if p.is_file() and p.name != "seconds.csv"
    }


def _numbers(path: Path) -> bytes:
    parts: list[bytes] = []
    with h5py.File(path) as file:
        file.visititems(
            lambda name, node: (
                parts.append(name.encode() + np.asarray(node[()]).tobytes())
                if isinstance(node, h5py.Dataset)
                else None
            )
        )
    return b"".join(parts)


def results(out: Path) -> list[str]:
    """Return the names of the tasks that have a result."""
    return sorted(p.parent.name for p in (out / "results").glob("*/task.json"))


def refuse_all(monkeypatch) -> None:
    """Let the gate refuse every posterior."""

    def refuse(*args, **kwargs):
        return replace(judge(*args, **kwargs), passed=False, reasons=("refused",))

    monkeypatch.setattr(sampler, "judge", refuse)
