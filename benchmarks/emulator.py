"""Runs of a slow simulator against accuracy of the posterior: sequential, Latin hypercube, a peer.

    python benchmarks/emulator.py --out emulator.json

A wheel of five parameters (Bekker's resistance, Janosi & Hanamoto's thrust), quick enough that its
exact posterior is known: calib on the simulator itself. Its data are 28 readings at seven slips and
four loads. Every way gets the same runs in
number, the same nodes, the same sampler; what is compared is how far means and sds of the posterior
are off. The peer is scikit-learn's GaussianProcessRegressor on principal components of a Latin
hypercube, its mean in the place of the simulator, as most tutorials have it.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from shared.machine import describe, use_one_core
from sklearn.decomposition import PCA
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

import calib
from calib.gap.case import Case
from calib.inference.design import prior_design
from calib.inference.emulation import EmulationSettings, emulate
from calib.inference.emulation.prepared import prepare, prepare_field
from calib.inference.emulation.state import State
from calib.inference.problem import Problem
from calib.models.simulators.declaration import SIMULATED
from calib.models.simulators.simulator import RunKeeper

SEEDS = (11, 12, 13)
BUDGETS = (60, 100, 200)
NOISE_KN = 0.05
TRUE = np.array([[4.0, 30.0, 0.015, 0.9, 350.0]])
WIDTH_M, PRINT_M, DIAMETER_M = 0.25, 0.35, 0.9
PRIORS = {
    "c": 'dist = "lognormal"\nmedian = 5.0\nsd_log = 0.6\nunit = "kPa"',
    "phi": 'dist = "normal"\nmean = 28.0\nsd = 6.0\nlower = 5.0\nupper = 50.0\nunit = "deg"',
    "K": 'dist = "lognormal"\nmedian = 0.02\nsd_log = 0.5\nunit = "m"',
    "n": 'dist = "lognormal"\nmedian = 0.8\nsd_log = 0.3\nunit = "1"',
    "p1": 'dist = "lognormal"\nmedian = 300.0\nsd_log = 0.4\nunit = "kPa"',
    "sigma": 'dist = "half_normal"\nsd = 0.1\nunit = "kN"',
}


def wheel(theta: np.ndarray, x: dict[str, np.ndarray]) -> np.ndarray:
    """Return the drawbar pull (kN) of a wheel on soft ground, shape (k, n)."""
    c, phi, shear, n, p1 = (theta[:, j : j + 1] for j in range(5))
    slip, load = np.maximum(x["slip_ratio"], 1e-6), x["normal_load_kn"]
    sinkage = 0.1 * (load / (WIDTH_M * PRINT_M) / p1) ** (1.0 / n)
    contact = np.sqrt(DIAMETER_M * sinkage) + 0.1
    u = shear / (slip * contact)
    thrust = WIDTH_M * contact * c + load * np.tan(np.radians(phi))
    resistance = WIDTH_M * p1 * 0.1 * (sinkage / 0.1) ** (n + 1.0) / (n + 1.0)
    return thrust * (1.0 - u * (1.0 - np.exp(-1.0 / u))) - resistance


def register(name: str, *, slow: bool, folder: Path | None = None) -> str:
    """Make the wheel known as a model."""
    text = "".join(
        f'[parameters.{key}]\n{prior}\nreason = "Mineral soils"\nsource = "Wong (2008)"\n\n'
        for key, prior in PRIORS.items()
    )
    calib.register(
        calib.from_callable(
            wheel, parameters=text, conditions=["slip_ratio", "normal_load_kn"],
            output="drawbar_pull_kn", name=name, emulate=slow, folder=folder,
        )
    )  # fmt: skip
    return name


def readings(seed: int, slip_error: float = 0.0) -> calib.Table:
    """Return a campaign; with an error of the rolling radius, recorded slips are too large."""
    slip, load = np.meshgrid(
        [0.02, 0.05, 0.1, 0.2, 0.3, 0.45, 0.6], [2.0, 4.0, 6.0, 8.0], indexing="ij"
    )
    x = {"slip_ratio": slip.ravel(), "normal_load_kn": load.ravel()}
    true = x | {"slip_ratio": 1.0 - (1.0 - x["slip_ratio"]) / (1.0 - slip_error)}
    noise = NOISE_KN * np.random.default_rng(seed).standard_normal(28)
    return calib.table_from_arrays(x | {"drawbar_pull_kn": wheel(TRUE, true)[0] + noise})


@dataclass(frozen=True)
class Peer:
    """Predicts by scikit-learn's regressors of principal components; nodes only."""

    pca: PCA
    regressors: list[GaussianProcessRegressor]
    state: State

    def __call__(self, theta: np.ndarray, x: dict[str, np.ndarray]) -> np.ndarray:
        """Return predictions at the data's conditions, which are nodes."""
        z = self.state.axes.of(theta)
        scores = np.stack([r.predict(z) for r in self.regressors], axis=1)
        at = self.pca.inverse_transform(scores)
        nodes = np.stack(list(self.state.nodes.values()), axis=1)
        asked = np.stack(list(x.values()), axis=1)
        rows = [int(np.square(nodes - row).sum(axis=1).argmin()) for row in asked]
        return at[:, rows]


def peer(problem: Problem, keeper: RunKeeper, runs: int, seed: int) -> Problem:
    """Return the problem with the peer in the place of the simulator."""
    nodes = {name: v.copy() for name, v in problem.conditions.items()}
    state = State(problem, keeper, nodes, seed)
    theta = prior_design(problem, runs, seed, latin=True)
    values = state.carry_out(theta)
    pca = PCA(0.99999).fit(values)
    kernel = ConstantKernel() * RBF(np.ones(theta.shape[1]), (0.1, 1e3)) + WhiteKernel(1e-6)
    z, scores = state.axes.of(theta), pca.transform(values)
    found = [GaussianProcessRegressor(kernel, normalize_y=True).fit(z, s) for s in scores.T]
    model = replace(problem.bound.model, predict=Peer(pca, found, state))
    model = replace(model, mean_response=calib.models.base.not_given)
    return replace(problem, bound=replace(problem.bound, model=model))


def ways(
    problem: Problem, runs: int, seed: int
) -> dict[str, Callable[[], tuple[Problem, dict[str, float]]]]:
    """Return what makes an emulated problem each way, and what it says of itself."""
    simulator = SIMULATED["slow"].simulator

    def ours(sequential: bool) -> tuple[Problem, dict[str, float]]:
        settings = (
            EmulationSettings(runs=runs)
            if sequential
            else EmulationSettings(runs=runs, first=runs, checks=0)
        )
        found = emulate(problem, RunKeeper(simulator), seed, settings=settings)
        said = {"runs": float(len(found.runs)), "expected": found.expected}
        if found.held_out is not None:
            said |= {"rmse": found.held_out.rmse, "covered": found.held_out.covered}
        return found.problem, said | {"passed": float(found.passed)}

    return {
        "sequential": lambda: ours(True),
        "one design": lambda: ours(False),
        "scikit-learn, Latin hypercube": lambda: (
            peer(problem, RunKeeper(simulator), runs, seed), {"runs": float(runs)},
        ),
    }  # fmt: skip


def compare(seed: int) -> list[dict[str, object]]:
    """Return how far every way is off at every budget on one data set."""
    data = readings(seed)
    exact = calib.calibrate(calib.build_problem("exact", data), seed=1)
    problem = calib.build_problem("slow", data)
    rows: list[dict[str, object]] = []
    for runs in BUDGETS:
        for name, make in ways(problem, runs, seed).items():
            began = time.perf_counter()
            emulated, said = make()
            found = calib.calibrate(emulated, seed=1)
            pairs = [(found.summary[n], s) for n, s in exact.summary.items()]
            rows.append({
                "seed": seed, "budget": runs, "way": name, **said,
                "mean_off": max(abs(e.mean - s.mean) / s.sd for e, s in pairs),
                "sd_off": max(abs(e.sd / s.sd - 1.0) for e, s in pairs),
                "converged": found.converged, "seconds": time.perf_counter() - began,
            })  # fmt: skip
            print("{way:30s} {budget:4d} runs, data {seed}: means off by {mean_off:.3f} sd, "
                  "sds by {sd_off:.3f}".format(**rows[-1]), flush=True)  # fmt: skip
    return rows


def diagnosed(seed: int, folder: Path) -> dict[str, object]:
    """Return the runs of a diagnosis, and its verdict beside that of the simulator itself."""
    lab, field = readings(seed), readings(seed + 100, slip_error=0.04)
    name = register(f"slow_{seed}", slow=True, folder=folder)
    first = prepare(name, lab, seed, elsewhere=[field])
    more = prepare_field(name, field, seed)
    found, truth = (
        calib.diagnose(Case("wheel", lab, field, {"drawbar_pull": n})).ranking
        for n in (name, "exact")
    )
    best = truth.order[0]
    row: dict[str, object] = {
        "seed": seed, "runs": len(first.runs) if first else 0,
        "more": len(more.runs) if more else 0, "named": found.order[0], "exact_names": best,
        "probability": found.probability[best], "exact_probability": truth.probability[best],
    }  # fmt: skip
    said = "diagnosis, data {seed}: {runs} runs, {more} more; {named} {probability:.3f}, the "
    said += "simulator itself {exact_names} {exact_probability:.3f}"
    print(said.format(**row), flush=True)
    return row


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    use_one_core()
    register("exact", slow=False)
    register("slow", slow=True)
    rows = [row for seed in SEEDS for row in compare(seed)]
    kept = options.out.with_suffix(".runs")
    diagnoses = [diagnosed(seed, kept) for seed in SEEDS]
    content = {"machine": describe(), "rows": rows, "diagnoses": diagnoses}
    options.out.write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
