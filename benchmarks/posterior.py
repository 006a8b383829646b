"""One posterior on one core: ours, PyMC with nutpie, and emcee's default stretch move.

    python benchmarks/posterior.py --out posterior.json

Same data, priors and likelihood; the peers' repeats take turns with ours. Time is everything but
compilation: search for modes, adaptation, tuning, burn-in, sampling, our gate. Effective sample
sizes are ArviZ's, of all draws that were kept, each walker taken as a chain. What a sampler frees
stays with the process: no run pays for memory that the machine's host had taken back.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import emcee
import numpy as np
from shared.agreement import z_scores
from shared.machine import describe, hold_memory, use_one_core
from shared.measure import spread
from shared.peers import pymc_model

from calib.he2019.embedded import he2019_tasks
from calib.inference.diagnostics import Gate, ess
from calib.inference.problem import Problem, build_problem
from calib.inference.sampler import SamplerSettings, sample_posterior
from calib.models.base import Array

# Draws of each sampler: its defaults, and so many that what comes before them is of no account.
OURS = {"default": {}, "long": {"walkers": 1024, "steps": 640}}
NUTPIE = {"default": 1000, "long": 10_000}
NUTPIE_CHAINS = 4
STRETCH_WALKERS, STRETCH_STEPS, STRETCH_THIN = 128, 16_000, 20
REPLICATES = 40
# Long runs whose draws are compared; of the others the times and sizes count.
KEPT = 5
# What those and the run at work take up, at most.
HELD_GIB = 2.0


class Clock:
    """Processor time of all threads, kept on one core, and time on the wall.

    They are the same on a machine that does nothing else; what else it does is in the second only.
    """

    def __init__(self) -> None:
        self.began = time.process_time(), time.perf_counter()

    def taken(self) -> tuple[float, float]:
        """Return seconds of both since the start."""
        return time.process_time() - self.began[0], time.perf_counter() - self.began[1]


def ours(problem: Problem, seed: int, length: str) -> tuple[dict[str, float], Array]:
    """Sample with calib; keep all draws."""
    settings = SamplerSettings(keep=10**9, **OURS[length])
    clock = Clock()
    draws = sample_posterior(problem, seed, settings=settings)
    taken = clock.taken()
    t = draws.t.reshape(-1, *draws.t.shape[2:])
    return {**worth(t, taken, draws.evaluations), "passed": float(draws.report.passed)}, t


def nutpie(compiled: Any, names: tuple[str, ...], seed: int, length: str) -> tuple[dict, Array]:
    """Sample with nutpie at its own settings, compiled before."""
    import nutpie as package

    clock = Clock()
    found = package.sample(
        compiled, draws=NUTPIE[length], chains=NUTPIE_CHAINS, cores=1, seed=seed,
        progress_bar=False, save_warmup=True,
    )  # fmt: skip
    taken = clock.taken()
    t = np.stack([np.asarray(found["posterior"][name]) for name in names], axis=-1)
    steps = sum(
        float(np.asarray(found[g]["n_steps"]).sum())
        for g in ("sample_stats", "warmup_sample_stats")
    )
    divergences = float(np.asarray(found["sample_stats"]["diverging"]).sum())
    return {**worth(t, taken, int(steps)), "divergences": divergences}, t


def stretch(problem: Problem, start: Array, seed: int) -> tuple[dict[str, float], Array]:
    """Sample with emcee as it comes; a tenth of the steps is burn-in, counted as time."""
    sampler = emcee.EnsembleSampler(
        STRETCH_WALKERS, problem.n_dim, problem.log_prob, vectorize=True
    )
    sampler.random_state = np.random.RandomState(seed).get_state()
    clock = Clock()
    stored = STRETCH_STEPS // STRETCH_THIN
    sampler.run_mcmc(start, stored, thin_by=STRETCH_THIN, skip_initial_state_check=True)
    taken = clock.taken()
    t = sampler.get_chain(discard=stored // 10).transpose(1, 0, 2)
    tau = sampler.get_autocorr_time(discard=stored // 10, quiet=True).max() * STRETCH_THIN
    measured = worth(t, taken, STRETCH_WALKERS * (STRETCH_STEPS + 1))
    return {**measured, "steps_over_tau": 0.9 * STRETCH_STEPS / tau, "tau_steps": tau}, t


def worth(t: Array, taken: tuple[float, float], evaluations: int) -> dict[str, float]:
    """Effective sample sizes of the worst parameter, and what each draw's worth cost."""
    seconds, on_the_clock = taken
    bulk, tail = float(ess(t, "bulk").min()), float(ess(t, "tail").min())
    return {
        "seconds": seconds,
        "seconds_on_the_clock": on_the_clock,
        "ess_bulk": bulk,
        "ess_tail": tail,
        "bulk_per_second": bulk / seconds,
        "tail_per_second": tail / seconds,
        "evaluations": float(evaluations),
        "evaluations_per_bulk": evaluations / bulk,
        "rhat": rhat(t),
    }


def rhat(t: Array) -> float:
    """Largest rank-normalised split R-hat over the chains."""
    from arviz_stats.base import array_stats

    return float(np.max(array_stats.rhat(t, chain_axis=0, draw_axis=1)))


def replicated(problem: Problem) -> dict[str, object]:
    """Effective sizes by what scatters: means and tail shares of many runs of other seeds.

    An effective size is right if means of runs scatter by sd/sqrt(size).
    """
    runs = [ours(problem, 10_000 + seed, "default")[1] for seed in range(REPLICATES)]
    # Runs differ in their steps: one that is too short goes on.
    draws = np.concatenate([t.reshape(-1, t.shape[-1]) for t in runs])
    low, high = np.quantile(draws, (0.05, 0.95), axis=0)
    functions = {
        "variance_over_claimed": lambda t: t,
        "low_tail_variance_over_claimed": lambda t: (t < low).astype(float),
        "high_tail_variance_over_claimed": lambda t: (t > high).astype(float),
    }
    found: dict[str, object] = {
        "runs": REPLICATES,
        # Of each parameter, if the claim is right.
        "standard_error_each": float(np.sqrt(2.0 / (REPLICATES - 1))),
    }
    for name, function in functions.items():
        values = [function(t) for t in runs]
        claimed = np.mean([v.var(axis=(0, 1)) / ess(v, "mean") for v in values], axis=0)
        ratio = np.var([v.mean(axis=(0, 1)) for v in values], axis=0, ddof=1) / claimed
        found[name] = ratio.tolist()
    return found


def compare(problem: Problem, repeats: int, long_repeats: int) -> dict[str, object]:
    """Run all samplers on a problem, in turn."""
    import nutpie as package

    began = time.perf_counter()
    compiled = package.compile_pymc_model(pymc_model(problem))
    compile_seconds = time.perf_counter() - began
    # What is imported, allocated or cached at first use is no part of a sampler's speed.
    ours(problem, 999, "default")
    nutpie(compiled, problem.names, 999, "default")

    runs: dict[str, list[dict[str, float]]] = {}
    kept: dict[str, list[Array]] = {"calib": [], "nutpie": [], "stretch": []}
    for length, n in (("default", repeats), ("long", long_repeats)):
        for seed in range(n):
            for name in ("calib", "nutpie"):
                if name == "calib":
                    found, t = ours(problem, seed, length)
                else:
                    found, t = nutpie(compiled, problem.names, seed, length)
                runs.setdefault(f"{name} {length}", []).append(found)
                if length == "long" and seed < KEPT:
                    kept[name].append(t)
    for seed in range(3):
        # From where our long run has been: it has no search of its own.
        start = kept["calib"][seed][:STRETCH_WALKERS, -1]
        found, t = stretch(problem, start, seed)
        runs.setdefault("stretch", []).append(found)
        kept["stretch"].append(t)

    # Chains that never joined the others are left out of the comparison, as any user would.
    sound = [t for t in kept["nutpie"] if rhat(t) <= Gate().rhat_max]
    a = np.concatenate(kept["calib"])
    agreement = {
        "nutpie": z_scores(a, np.concatenate(sound)) if sound else {},
        "stretch": z_scores(a, np.concatenate(kept["stretch"])),
    }
    return {
        "rows": int(problem.response.size),
        "parameters": problem.n_dim,
        "names": problem.names,
        "nutpie_compile_seconds": compile_seconds,
        "runs": runs,
        "spread": {
            name: {key: spread([r[key] for r in found]) for key in found[0]}
            for name, found in runs.items()
        },
        "z_scores": {
            peer: {what: z.tolist() for what, z in found.items()}
            for peer, found in agreement.items()
        },
        "replicates": replicated(problem),
    }


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--long-repeats", type=int, default=9)
    options = parser.parse_args()
    use_one_core()
    result: dict[str, object] = {"machine": describe(), "problems": {}}
    result["memory_held"] = hold_memory(HELD_GIB)
    for task in he2019_tasks():
        problem = build_problem(task.model, task.table)
        print(f"{task.output}: {problem.response.size} rows, {problem.n_dim} parameters")
        found = compare(problem, options.repeats, options.long_repeats)
        result["problems"][task.output] = found
        for name, s in found["spread"].items():
            print(
                f"  {name:16s} {s['bulk_per_second']['median']:10.0f} bulk ESS/s "
                f"{s['evaluations_per_bulk']['median']:8.1f} evaluations per ESS"
            )
    options.out.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
