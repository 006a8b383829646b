"""Numbers that the program computes, each with the largest change that counts as none.

They are the safety net of a redesign. The tolerance is six Monte Carlo errors of a difference for
what follows from posterior draws, 0.03 for a probability or an error reduction, and 1 % for what
follows from a search.

`python -m tests.golden.numbers` writes `golden.json` again, and says what moved.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import calib
from calib.batch.user_code import run_file
from calib.models import MODELS, example_csv
from calib.models.simulators.declaration import SIMULATED
from calib.validation.replicate import Item, replicate
from calib.validation.sbc import SETTINGS
from challenge.make import make
from challenge.measured.cases import HERE as MEASURED
from challenge.measured.cases import read_cases
from tests.models.simulators.examples import PRIORS, lab, pull
from tests.registered import forgotten

ROOT = Path(__file__).resolve().parents[2]
SHARED = ROOT.parent / "shared" / "cases"
FILE = Path(__file__).with_name("golden.json")

type Numbers = dict[str, tuple[float | str, float]]
"""By name: the value and what it may move by; words have to be the same."""

_ERRORS, _CHANCE, _SEARCHED = 6.0 * np.sqrt(2.0), 0.03, 0.01
_SEED = 7


def posterior(model: str) -> Numbers:
    """A model's posterior on its own example."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "data.csv"
        path.write_text(example_csv(model), encoding="utf-8")
        problem = calib.build_problem(model, calib.read_table(path))
    return _of_calibration(calib.calibrate(problem, _SEED))


def _of_calibration(found: calib.Calibration) -> Numbers:
    numbers: Numbers = {"converged": (str(found.converged), 0.0)}
    for name, s in found.summary.items():
        numbers[f"{name}.median"] = (s.median, _ERRORS * s.mcse_median)
        numbers[f"{name}.hdi_lower"] = (s.hdi_lower, _ERRORS * s.mcse_hdi_lower)
        numbers[f"{name}.hdi_upper"] = (s.hdi_upper, _ERRORS * s.mcse_hdi_upper)
    efficiency = max(found.draws.efficiency, 1e-3)
    error = float(np.sqrt((1.0 / efficiency - 1.0) / 1500.0))
    numbers["log_evidence"] = (found.draws.log_evidence, _ERRORS * max(error, 0.01))
    return numbers


def emulated(noise: str) -> Numbers:
    """The posterior of a small simulator by its emulator."""
    name = f"golden_{noise.replace('.', '_')}"
    simulator = calib.from_callable(
        pull, parameters=PRIORS, conditions=("slip_ratio", "normal_load_kn"),
        output="drawbar_pull_kn", name=name,
    )  # fmt: skip
    calib.register(simulator)
    table = calib.table_from_arrays(lab(np.random.default_rng(1), float(noise)))
    emulation = calib.emulated(calib.build_problem(name, table), _SEED)
    return _of_calibration(calib.calibrate(emulation.problem, _SEED))


def ranks(model: str) -> Numbers:
    """Ranks of the truth in simulation-based calibration, as parts of one."""
    numbers: Numbers = {}
    for i in range(2):
        record = replicate(Item(model, i, _SEED, SETTINGS))
        numbers |= {
            f"{i}.{name}": (below / draws, _ERRORS * 0.5 / np.sqrt(draws))
            for name, (below, draws) in record["ranks"].items()
        }
    return numbers


def diagnosis(name: str) -> Numbers:
    """A diagnosis: its verdict, which causes act, and how far the error shrinks."""
    kind, _, case = name.partition("/")
    if kind == "measured" and "janosi_traction" not in MODELS:
        MODELS.add(run_file(MEASURED / "traction.py", "models").MODEL)
    found = calib.diagnose(calib.read_case(_FOLDERS[kind]() / case), seed=1)
    numbers: Numbers = {"verdict": (found.verdict, 0.0), "first": (found.ranking.order[0], 0.0)}
    numbers |= {
        f"inclusion.{cause}": (i.probability, _CHANCE)
        for cause, i in found.inclusion.causes.items()
        if i.probability > _CHANCE
    }
    numbers["inclusion.unlisted"] = (found.inclusion.residual_discrepancy.probability, _CHANCE)
    for output, s in found.shrink.items():
        numbers[f"{output}.fraction"] = (s.fraction, _CHANCE)
        numbers[f"{output}.rmse_before"] = (s.rmse_before, _SEARCHED * abs(s.rmse_before))
    return numbers


_SCRATCH = tempfile.TemporaryDirectory(prefix="golden-")


@cache
def _measured() -> Path:
    folder = Path(_SCRATCH.name) / "measured"
    for case in read_cases():
        case.write(folder / case.name, folder.with_name("answers"))
    return folder


@cache
def _bench() -> Path:
    folder = Path(_SCRATCH.name) / "bench"
    make(folder, Path(_SCRATCH.name) / "sealed", seed=_SEED, n_cases=8)
    return folder


def recorded() -> dict[str, dict[str, Any]]:
    """Return what was computed before the redesign, by kind and name, then number."""
    return json.loads(FILE.read_text(encoding="utf-8")) if FILE.exists() else {}


def _recorded(case: str) -> bool:
    return f"diagnosis/measured/{case}" in recorded()


_FOLDERS: Mapping[str, Callable[[], Path]] = {
    "shared": lambda: SHARED, "measured": _measured, "bench": _bench,
}  # fmt: skip
_SHARED = [*(f"case-{i:03d}" for i in range(32)), "real-000"]
KINDS: Mapping[str, tuple[Callable[[str], Numbers], tuple[str, ...]]] = {
    "posterior": (posterior, tuple(m.name for m in MODELS.values())),
    "emulated": (emulated, ("0.03", "0.1")),
    "ranks": (ranks, ("bekker", "magic_formula", "ayers_perumpral")),
    "diagnosis": (
        diagnosis,
        (
            *(f"shared/{name}" for name in _SHARED),
            # Cases that came later have their own report.
            *(f"measured/{case.name}" for case in read_cases() if _recorded(case.name)),
            *(f"bench/case-{i:03d}" for i in range(8)),
        ),
    ),
}
"""By kind: how numbers are made, and of what."""


def moved(before: Mapping[str, Any], now: Numbers) -> list[str]:
    """Say which numbers moved, and by how much of what they may."""
    said = []
    for name in sorted({*before, *now}):
        value, allowed = now.get(name, (0.0, 0.0))
        old, old_allowed = before.get(name, (0.0, 0.0))
        if isinstance(value, str) or isinstance(old, str):
            if value != old:
                said.append(f"{name}: {old} before, {value} now")
            continue
        # An entry that is not there is a cause of hardly any probability.
        least = max(allowed, old_allowed)
        if not abs(value - old) <= least + 1e-9 * abs(old):
            said.append(f"{name}: {old:.6g} before, {value:.6g} now; {least:.2g} is allowed")
    return said


def computed(kind: str, name: str) -> Numbers:
    """Return the numbers of an entry."""
    make_numbers, _ = KINDS[kind]
    with forgotten(MODELS, SIMULATED):
        numbers = make_numbers(name)
    return {
        key: (value if isinstance(value, str) else float(f"{value:.7g}"), float(f"{allowed:.3g}"))
        for key, (value, allowed) in numbers.items()
    }


def main() -> None:
    """Compute entries again, all or those named by their beginnings, and write them."""
    document = recorded()
    for kind, (_, names) in KINDS.items():
        for name in names:
            key = f"{kind}/{name}"
            if sys.argv[1:] and not key.startswith(tuple(sys.argv[1:])):
                continue
            now = computed(kind, name)
            for line in moved(document.get(key, {}), now) if key in document else ():
                print(f"{key}: {line}", flush=True)
            document[key] = {k: list(v) for k, v in now.items()}
            print(key, flush=True)
            text = json.dumps(document, separators=(",", ":")).replace("},", "},\n")
            FILE.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
