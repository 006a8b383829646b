"""The genetic algorithm of the source against SciPy's differential evolution, at equal final cost.

    python benchmarks/genetic.py --out genetic.json

Both minimise the sums of squares of the source's problems in the same box, a whole population per
call of the same likelihood, on one core, over the same twenty seeds. The final cost is compared
with the lowest that any method reached from any seed.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from shared.machine import describe, use_one_core
from shared.measure import spread

from calib.data import Table, hold_out
from calib.he2019.embedded import he2019_tasks
from calib.inference.estimators import estimate_genetic
from calib.inference.problem import Problem, build_problem
from calib.inference.search import PointEstimate, estimate_differential_evolution

SEEDS = 20
# A final cost is the optimum's if it exceeds it by less than this part.
EQUAL = 1e-6

type Estimator = Callable[[Problem, np.random.Generator], PointEstimate]

METHODS: dict[str, Estimator] = {
    "genetic algorithm (Table 2)": estimate_genetic,
    "SciPy DE, defaults": estimate_differential_evolution,
    "SciPy DE, tol 1e-8, not polished": lambda problem, rng: estimate_differential_evolution(
        problem, rng, polish=False, tol=1e-8
    ),
}


def problems() -> dict[str, Problem]:
    """The joint problems, and the Magic Formula at each pressure, where the source used it."""
    found: dict[str, Problem] = {}
    for task in he2019_tasks():
        found[task.output] = build_problem(task.model, task.table)
        if task.output == "drawbar_pull":
            for psi in (18.0, 30.0, 42.0):
                table: Table = hold_out(task.table, "inflation_pressure_psi", psi)[1]
                found[f"drawbar_pull at {psi:g} psi"] = build_problem(
                    "magic_formula", table, fixed={"Sh": 0.0, "Sv": 0.0}
                )
    return found


def compare(problem: Problem) -> dict[str, object]:
    """Processor seconds and final costs of every method, the methods taking turns."""
    runs: dict[str, list[tuple[float, float, int]]] = {name: [] for name in METHODS}
    for seed in range(SEEDS + 1):
        for name, method in METHODS.items():
            began = time.process_time()
            found = method(problem, np.random.default_rng(seed))
            taken = time.process_time() - began
            if seed:  # the first warms up
                runs[name].append((taken, found.cost, found.n_evaluations))
    optimum = min(cost for found in runs.values() for _, cost, _ in found)
    return {
        "optimum": optimum,
        "methods": {
            name: {
                "seconds": spread([r[0] for r in found]),
                "relative_excess_of_cost": spread([r[1] / optimum - 1.0 for r in found]),
                "at_the_optimum": sum(r[1] / optimum - 1.0 < EQUAL for r in found),
                "seeds": SEEDS,
                "evaluations": spread([float(r[2]) for r in found]),
            }
            for name, found in runs.items()
        },
    }


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    options = parser.parse_args()
    use_one_core()
    result: dict[str, object] = {"machine": describe(), "equal_within": EQUAL, "problems": {}}
    for name, problem in problems().items():
        found = compare(problem)
        result["problems"][name] = found
        print(name)
        for method, m in found["methods"].items():
            print(
                f"  {method:34s} {1e3 * m['seconds']['median']:7.0f} ms, at the optimum "
                f"{m['at_the_optimum']}/{m['seeds']}"
            )
    options.out.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
