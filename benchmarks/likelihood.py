"""Throughput of the likelihood on one core, against the sines and arctangents it is made of.

    python benchmarks/likelihood.py --out likelihood.json

The joint drawbar pull (Eqs 12-15) takes two arctangents and a sine per row and parameter vector.
The floor is NumPy working out as many on the arguments that occur, in place, in blocks that stay
in the cache. Ours is the whole log posterior density. numexpr, Numba and JAX work out the same
sums of squares, written as each of them likes best.
"""

from __future__ import annotations

import argparse
import json
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from shared.machine import describe, use_one_core
from shared.measure import seconds, spread

from calib.data import table_from_arrays
from calib.inference.problem import Problem, build_problem
from calib.models.base import Array

ROWS = (42, 420, 4_200, 42_000, 1_000_000)
CELLS = 8_000_000
MOST_VECTORS = 16_384
PEER_ROWS = (42, 4_200, 1_000_000)
PRESSURES_PSI = np.array([18.0, 30.0, 42.0])
_BLOCK = 65_536
_TRUTH = {
    "K_lo": 0.2, "K_hi": 0.12, "K_bend": 0.05, "D_lo": 1.8, "D_hi": 1.2, "D_bend": 0.02,
    "G_lo": 3.0, "G_hi": 2.0, "G_bend": 0.1, "C": 1.4,
}  # fmt: skip


def problem_of(rows: int, *, distinct: int | None = None, seed: int = 1) -> Problem:
    """Simulate drawbar pull at three inflation pressures, all slips distinct unless said."""
    rng = np.random.default_rng(seed)
    n = distinct or rows
    slip = np.linspace(0.0, 0.6, n)
    pressure = PRESSURES_PSI[np.arange(n) % 3]
    picked = np.arange(rows) % n
    columns = {"slip_ratio": slip[picked], "inflation_pressure_psi": pressure[picked]}
    noise = rng.normal(0.0, 0.04, rows)
    start = table_from_arrays({**columns, "drawbar_pull_kn": noise})
    bound = build_problem("magic_formula_pressure", start).bound
    theta = np.array([[_TRUTH[name] for name in bound.model.parameters]])
    blocks = range(0, rows, _BLOCK)
    pull = np.concatenate(
        [
            bound.mean_response(theta, {k: v[i : i + _BLOCK] for k, v in columns.items()})[0]
            for i in blocks
        ]
    )
    table = table_from_arrays({**columns, "drawbar_pull_kn": pull + noise})
    return build_problem("magic_formula_pressure", table)


def vectors_about_the_truth(problem: Problem, k: int) -> Array:
    """Parameter vectors where a sampler would ask for them, internal coordinates, (k, d)."""
    theta = np.array([[_TRUTH[name] for name in problem.bound.model.parameters] + [0.04]])
    rng = np.random.default_rng(2)
    centre = problem.priors.to_internal(theta)
    return centre + 0.02 * rng.standard_normal((k, problem.n_dim))


def floor(problem: Problem, t: Array) -> Callable[[], None]:
    """As many arctangents and sines as the likelihood takes, on arguments of its kind."""
    cells = t.shape[0] * problem.response.size
    # B X runs from zero to about three, the sine's argument to about two.
    argument = np.linspace(0.0, 3.0, min(cells, _BLOCK))
    out = np.empty_like(argument)

    def work() -> None:
        for i in range(0, cells, _BLOCK):
            n = min(_BLOCK, cells - i)
            np.arctan(argument[:n], out=out[:n])
            np.arctan(argument[:n], out=out[:n])
            np.sin(argument[:n], out=out[:n])

    return work


def coefficients(problem: Problem, t: Array) -> tuple[Array, ...]:
    """B, C, D and E of every vector at every pressure, each (k, 3): what peers are handed."""
    from calib.models.magic_formula import coefficients_at

    theta = problem.theta(t)[:, :-1]
    found = coefficients_at(theta, PRESSURES_PSI, problem.bound.references)
    return tuple(np.ascontiguousarray(found[name]) for name in "BCDE")


def plain(problem: Problem, t: Array) -> Array:
    """Sums of squares written as the equation is printed, (k,)."""
    B, C, D, E = coefficients(problem, t)
    x, y, level = data(problem)
    found = np.empty(len(t))
    for i in range(len(t)):
        b, c, d, e = (v[i, level] for v in (B, C, D, E))
        bx = b * x
        fit = d * np.sin(c * np.arctan(bx - e * (bx - np.arctan(bx))))
        found[i] = np.square(y - fit).sum()
    return found


def data(problem: Problem) -> tuple[Array, Array, Any]:
    """Slip in percent, pull, and the index of the pressure of each row, sorted by pressure."""
    conditions = problem.conditions
    level = np.searchsorted(PRESSURES_PSI, conditions["inflation_pressure_psi"])
    order = np.argsort(level, kind="stable")
    return 100.0 * conditions["slip_ratio"][order], problem.response[order], level[order]


def numexpr_squares(problem: Problem, t: Array) -> Callable[[], Array]:
    """Numexpr on one thread: rows along one axis, vectors along the other."""
    import numexpr

    numexpr.set_num_threads(1)
    B, C, D, E = coefficients(problem, t)
    x, y, level = data(problem)
    at_once = max(1, 4 * _BLOCK // x.size)

    def work() -> Array:
        total = np.empty(len(t))
        for i in range(0, len(t), at_once):
            b, c, d, e = (v[i : i + at_once][:, level] for v in (B, C, D, E))
            total[i : i + at_once] = numexpr.evaluate(
                "sum((y - d*sin(c*arctan(b*x - e*(b*x - arctan(b*x)))))**2, axis=1)",
                {"b": b, "c": c, "d": d, "e": e, "x": x, "y": y},
            )
        return total

    return work


def numba_squares(problem: Problem, t: Array) -> Callable[[], Array]:
    """Loops compiled by Numba with fastmath, on one thread."""
    import numba

    @numba.njit(fastmath=True, error_model="numpy")  # type: ignore[untyped-decorator]
    def loops(B, C, D, E, x, y, level, out):  # type: ignore[no-untyped-def]
        for i in range(out.size):
            total = 0.0
            for j in range(x.size):
                p = level[j]
                bx = B[i, p] * x[j]
                inner = bx - E[i, p] * (bx - np.arctan(bx))
                r = y[j] - D[i, p] * np.sin(C[i, p] * np.arctan(inner))
                total += r * r
            out[i] = total

    arguments = (*coefficients(problem, t), *data(problem))
    out = np.empty(len(t))

    def work() -> Array:
        loops(*arguments, out)
        return out

    return work


def jax_squares(problem: Problem, t: Array) -> Callable[[], Array]:
    """JAX in double precision on the CPU, a block of vectors in each call."""
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)
    x, y, level = (jnp.asarray(v) for v in data(problem))
    B, C, D, E = (jnp.asarray(v) for v in coefficients(problem, t))
    at_once = max(1, 4 * _BLOCK // x.size)

    @jax.jit  # type: ignore[untyped-decorator]
    def block(b, c, d, e):  # type: ignore[no-untyped-def]
        b, c, d, e = (v[:, level] for v in (b, c, d, e))
        bx = b * x
        fit = d * jnp.sin(c * jnp.arctan(bx - e * (bx - jnp.arctan(bx))))
        return jnp.square(y - fit).sum(axis=1)

    def work() -> Array:
        parts = [
            block(*(v[i : i + at_once] for v in (B, C, D, E))) for i in range(0, len(t), at_once)
        ]
        return np.concatenate([np.asarray(p) for p in parts])

    return work


PEERS = {"numexpr": numexpr_squares, "Numba": numba_squares, "JAX": jax_squares}


def throughput(rows: int, repeats: int, *, distinct: int | None = None) -> dict[str, object]:
    """Cells per second of the density and of the floor, and the density's memory."""
    problem = problem_of(rows, distinct=distinct)
    k = max(4, min(MOST_VECTORS, CELLS // rows))
    t = vectors_about_the_truth(problem, k)
    n_distinct = problem.squares.mean.size
    # The data arranged, the first call, which allocates the workspace that later ones reuse.
    tracemalloc.start()
    problem.log_prob(t)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    # In turn, so that what else the machine does disturbs both.
    taken: dict[str, list[float]] = {"density": [], "floor": []}
    for _ in range(repeats):
        taken["density"] += seconds(lambda: problem.log_prob(t), repeats=1)
        taken["floor"] += seconds(floor(problem, t), repeats=1)
    cells = k * rows
    ratios = [a / b for a, b in zip(taken["density"], taken["floor"], strict=True)]
    return {
        "rows": rows,
        "distinct": n_distinct,
        "vectors": k,
        "cells_per_second": spread([cells / s for s in taken["density"]]),
        "floor_cells_per_second": spread([cells / s for s in taken["floor"]]),
        "time_over_floor": spread(ratios),
        "peak_mib_of_a_call": peak / 2**20,
        "mib_if_all_at_once": 8 * cells / 2**20,
    }


def peers(rows: int, repeats: int) -> dict[str, object]:
    """Seconds of the sums of squares by each library over ours, and that they agree."""
    problem = problem_of(rows)
    k = max(4, min(MOST_VECTORS, CELLS // rows // 2))
    t = vectors_about_the_truth(problem, k)
    theta = problem.theta(t)[:, :-1]
    few = slice(0, min(k, 16))
    expected = plain(problem, t[few])
    calls: dict[str, Callable[[], Array]] = {"calib": lambda: problem.squares(theta)}
    first: dict[str, float] = {}
    for name, make in PEERS.items():
        try:
            call = make(problem, t)
        except ImportError:
            continue
        began = time.perf_counter()
        call()
        first[name] = time.perf_counter() - began
        calls[name] = call
    taken: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(repeats):
        for name, call in calls.items():
            taken[name] += seconds(call, repeats=1)
    return {
        "rows": rows,
        "vectors": k,
        "cells_per_second": {n: spread([k * rows / s for s in v]) for n, v in taken.items()},
        "speed_over_calib": {
            n: spread([a / b for a, b in zip(taken["calib"], v, strict=True)])
            for n, v in taken.items()
        },
        "first_call_seconds": first,
        "largest_relative_difference": {
            n: float(np.max(np.abs(call()[few] / expected - 1.0))) for n, call in calls.items()
        },
    }


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    parser.add_argument("--repeats", type=int, default=7)
    options = parser.parse_args()
    use_one_core()
    result: dict[str, Any] = {"machine": describe(), "rows": [], "peers": []}
    for rows in ROWS:
        result["rows"].append(throughput(rows, options.repeats))
        ratio = result["rows"][-1]["time_over_floor"]["median"]
        print(f"{rows:8d} rows: {ratio:.2f} of the floor's time")
    result["repeated_conditions"] = throughput(1_000_000, options.repeats, distinct=42)
    for rows in PEER_ROWS:
        result["peers"].append(peers(rows, options.repeats))
        speeds = result["peers"][-1]["speed_over_calib"]
        print(f"{rows:8d} rows:", {n: round(s["median"], 2) for n, s in speeds.items()})
    options.out.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
