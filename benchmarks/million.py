"""One calibration of a million rows on all cores, and whether its posterior is that of every row.

    python benchmarks/million.py --out million.json

The joint drawbar pull at three inflation pressures, no two rows alike. The sampler looks for the
modes on a part of the rows and takes fewer draws of long data; the density that it samples is that
of all rows. The same posterior is then worked out in another way: draws from a Student-t, weighted
by the equation as printed, evaluated at every row in plain NumPy.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import time
from pathlib import Path

import numpy as np
from likelihood import plain, problem_of
from shared.machine import describe

from calib.inference.calibration import calibrate
from calib.inference.diagnostics import ess
from calib.inference.problem import Problem
from calib.inference.proposal import StudentT
from calib.models.base import Array

_DRAWS, _DOF, _WIDER = 600, 12.0, 1.1


def log_posterior(problem: Problem, t: Array) -> Array:
    """Log density written out, of every row: nothing of the sampler's or the likelihood's code."""
    sigma = problem.theta(t)[:, -1]
    squares = plain(problem, t)
    n = problem.response.size
    return problem.priors.log_prob(t) - n * np.log(sigma) - 0.5 * squares / sigma**2


def weighted(problem: Problem, draws: Array) -> dict[str, object]:
    """Compare draws of the sampler, (chains, draws, d), with importance sampling."""
    flat = draws.reshape(-1, draws.shape[-1])
    q = StudentT(flat.mean(axis=0), _WIDER * np.linalg.cholesky(np.cov(flat.T)), _DOF)
    t = q.sample(np.random.default_rng(3), _DRAWS)
    began = time.perf_counter()
    log_weight = log_posterior(problem, t) - q.log_prob(t)
    taken = time.perf_counter() - began
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    mean, sd = weight @ t, np.sqrt(weight @ np.square(t - weight @ t))
    z: dict[str, list[float]] = {}
    for what, theirs, ours in (
        ("mean", t, draws),
        ("variance", np.square(t - mean), np.square(draws - flat.mean(axis=0))),
    ):
        expected = weight @ theirs
        error = np.sqrt(np.square(weight) @ np.square(theirs - expected))
        size = np.minimum(ess(ours, "mean"), flat.shape[0])
        mcse = np.sqrt(ours.var(axis=(0, 1)) / size)
        found = (ours.mean(axis=(0, 1)) - expected) / np.sqrt(error**2 + mcse**2)
        z[what] = found.tolist()
    return {
        "draws": _DRAWS,
        "effective_draws": float(1.0 / np.square(weight).sum()),
        "seconds_of_the_check": taken,
        "z_scores": z,
        "sd_ratio": (flat.std(axis=0) / sd).tolist(),
    }


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    parser.add_argument("--rows", type=int, default=1_000_000)
    parser.add_argument("--repeats", type=int, default=2)
    options = parser.parse_args()
    machine = describe()
    problem = problem_of(options.rows)
    taken = []
    for seed in range(options.repeats):
        fresh = problem_of(options.rows)
        began = time.perf_counter()
        calibration = calibrate(fresh, seed)
        taken.append(time.perf_counter() - began)
        print(f"{options.rows} rows in {taken[-1]:.1f} s, converged: {calibration.converged}")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    draws = calibration.draws
    result = {
        "machine": machine,
        "rows": options.rows,
        "parameters": problem.n_dim,
        "names": problem.names,
        "threads": len(os.sched_getaffinity(0)),
        "seconds": taken,
        "converged": calibration.converged,
        "evaluations": draws.evaluations,
        "ess_bulk": float(draws.report.ess_bulk.min()),
        "peak_mib": peak,
        "check": weighted(problem, draws.t.reshape(-1, *draws.t.shape[2:])),
    }
    options.out.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
