"""Posteriors of a third party's compiled tyre: emulated in 400 runs, and by the tyre itself.

    python benchmarks/compiled_tyre.py TYRE.TOML --out tyre.json

TYRE.TOML is examples/vdrift_tyre/tyre.toml, which says how to compile the tyre beside it. Its ten
parameters are calibrated on 48 simulated readings; eight and nine of them with the others, truly
zero, fixed. Brute force is the sampler on the tyre itself, four times as long as its gate asks for.
Means should be off by less than a tenth of a posterior sd, sds by less than a tenth.
"""

from __future__ import annotations

import argparse
import json
import re
import time
from pathlib import Path

import numpy as np
from shared.machine import describe

import calib
from calib.inference.calibration import Calibration
from calib.inference.sampler import SamplerSettings
from calib.models import MODELS
from calib.models.simulators.declaration import SIMULATED, Simulated

SEEDS = (1, 2, 3)
NOISE_KN = 0.05
TRUE = {
    "b0": 1.6, "b1": -25.0, "b2": 1250.0, "b3": 3.0, "b4": 220.0, "b5": 0.03, "b6": 0.004,
    "b7": 0.02, "b8": -0.6, "b9": 0.0, "b10": 0.15,
}  # fmt: skip
FIXED = {8: ("b3", "b6"), 9: ("b6",), 10: ()}
SLIPS = (0.01, 0.02, 0.03, 0.045, 0.06, 0.08, 0.1, 0.13, 0.17, 0.22, 0.3, 0.4)
LOADS_KN = (2.0, 4.0, 6.0, 8.0)


def declared(file: Path, fixed: tuple[str, ...], *, emulate: bool) -> Simulated:
    """Register the tyre with some parameters fixed at zero, and return it."""
    found, text = calib.read_simulator(file), file.read_text(encoding="utf-8")
    priors = text[text.index("[parameters]") :]
    for name in fixed:
        value = 'dist = "fixed", value = 0.0, unit = "1", reason = "As made", source = "Here"'
        priors = re.sub(rf"(?m)^{name} = .*$", f"{name} = {{{value}}}", priors)
    simulator = found.simulator
    made = calib.from_callable(
        simulator.runner.function, parameters=priors, conditions=simulator.conditions,
        output={o.column: o.header for o in simulator.outputs}, emulate=emulate,
        name=f"tyre_{10 - len(fixed)}_{'emulated' if emulate else 'itself'}",
        **found.emulation.model_dump(exclude_unset=True) if emulate else {},
    )  # fmt: skip
    for name in made.models:
        MODELS.discard(name)
    SIMULATED.discard(made.name)
    calib.register(made)
    return made


def readings(simulator: Simulated, fixed: tuple[str, ...], seed: int) -> calib.Table:
    """Return a campaign of the tyre."""
    slip, load = (v.ravel() for v in np.meshgrid(SLIPS, LOADS_KN, indexing="ij"))
    x = {"slip_ratio": slip, "normal_load_kn": load}
    theta = np.array([0.0 if name in fixed else value for name, value in TRUE.items()])
    pull = simulator.simulator.run(theta, x)["drawbar_pull_kn"]
    noise = NOISE_KN * np.random.default_rng(seed).standard_normal(pull.size)
    return calib.table_from_arrays(x | {"drawbar_pull_kn": pull + noise})


def off(found: Calibration, exact: Calibration) -> dict[str, dict[str, float]]:
    """Return by how much means and sds are off, and the Monte Carlo error of the former, in sds."""
    pairs = {name: (found.summary[name], s) for name, s in exact.summary.items() if s.sd > 0.0}
    return {
        name: {
            "mean_off": (e.mean - s.mean) / s.sd,
            "sd_off": e.sd / s.sd - 1.0,
            "error": float(np.hypot(e.mcse_mean, s.mcse_mean)) / s.sd,
        }
        for name, (e, s) in pairs.items()
    }


def compare(file: Path, free: int, seed: int) -> dict[str, object]:
    """Return both posteriors' difference for so many parameters."""
    fixed = FIXED[free]
    itself = declared(file, fixed, emulate=False)
    data = readings(itself, fixed, seed)
    began = time.perf_counter()
    exact = calib.calibrate(calib.build_problem(itself.name, data), seed=1)
    longer = SamplerSettings(steps=4 * exact.draws.report.steps)
    exact = calib.calibrate(calib.build_problem(itself.name, data), seed=1, settings=longer)
    middle = time.perf_counter()
    slow = declared(file, fixed, emulate=True)
    emulation = calib.emulated(calib.build_problem(slow.name, data), seed=seed)
    found = calib.calibrate(emulation.problem, seed=1)
    differ = off(found, exact)
    row: dict[str, object] = {
        "parameters": free, "seed": seed, "runs": len(emulation.runs), "passed": emulation.passed,
        "converged": found.converged, "exact_converged": exact.converged,
        "rmse": emulation.held_out.rmse if emulation.held_out else None,
        "seconds": time.perf_counter() - middle, "exact_seconds": middle - began, "off": differ,
        "mean_off": max(abs(d["mean_off"]) for d in differ.values()),
        "sd_off": max(abs(d["sd_off"]) for d in differ.values()),
    }  # fmt: skip
    print("{parameters} parameters, data {seed}: {runs} runs, passed {passed}; means off by "
          "{mean_off:.3f} sd, sds by {sd_off:.3f}; {seconds:.0f} s, itself {exact_seconds:.0f} s"
          .format(**row), flush=True)  # fmt: skip
    return row


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("simulator", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    rows = []
    for seed in SEEDS:
        for free in FIXED:
            rows.append(compare(options.simulator.resolve(), free, seed))
            said = {"machine": describe(), "rows": rows}
            options.out.write_text(json.dumps(said, indent=1) + "\n")


if __name__ == "__main__":
    main()
