"""A block thrown on a bed of sand: how deep it is after 0.1 s, by a material point method.

    python sand.py rows.csv out.csv [setting=value]...    writes sinkage (mm), a line for each row

Columns: friction (deg), E (Pa), speed (m/s), load (N per metre of width). Settings, or columns of
these names: cells (of the grid, per metre), time_step_ms, seed (of the particles' places; without
one, each row has others). The solver is chhsiao93/mpm_simulator (commit 883e2fb), whose folder the
environment variable MPM_SIMULATOR names.
"""

import csv
import math
import os
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, os.environ.get("MPM_SIMULATOR", str(Path(__file__).parent / "mpm_simulator")))
import taichi as ti
import utils  # of the solver
from sand_wheel_simulator import MPMSolver

BED, DEPTH, WIDTH, TIME, MOST = 0.5, 0.2, 0.1, 0.1, 300.0  # m, m, m, s, N/m
SETTINGS = {"cells": 40.0, "time_step_ms": 0.1, "seed": -1.0}
SOLVERS: dict = {}  # by what their kernels hold as constants


def solver(friction, E, cells, time_step_ms):
    """Return the solver for this sand and grid, with room for the largest block."""
    key = (friction, E, cells, time_step_ms)
    if key not in SOLVERS:
        most = MOST / 9800 / WIDTH
        made = MPMSolver(
            n_particle=int(4 * cells**2 * (BED * DEPTH + WIDTH * most)) + 4,
            n_grid=int(cells), dt=time_step_ms / 1e3,
        )  # fmt: skip
        made.p_vol = made.dx**2 / 4  # four particles in a cell
        made.p_mass = made.p_vol * made.p_rho
        made.E, made.mu_0, made.lambda_0 = E, E / 2.4, E * 0.2 / (1.2 * 0.6)
        sine = math.sin(math.radians(friction))
        made.alpha = math.sqrt(2 / 3) * 2 * sine / (3 - sine)
        SOLVERS[key] = made
    return SOLVERS[key]


def sinkage(friction, E, speed, load, cells, time_step_ms, seed):
    """Return how far the middle of the block has gone down, in mm."""
    np.random.seed(None if seed < 0 else int(seed))  # noqa: NPY002  (the solver draws from it)
    mpm = solver(friction, E, cells, time_step_ms)
    floor, height = mpm.bound * mpm.dx, load / 9800 / WIDTH
    bed = utils.add_cube([(1 - BED) / 2, floor], [BED, DEPTH], mpm.dx)
    block = utils.add_cube([(1 - WIDTH) / 2, floor + DEPTH], [WIDTH, height], mpm.dx)
    n, most = len(bed) + len(block), mpm.max_num_particles
    place = np.full((most, 2), 0.5, np.float32)
    place[:n] = np.concatenate([bed, block])
    material = np.zeros(most, np.int32)  # 0 takes no part
    material[: len(bed)], material[len(bed) : n] = 3, 1
    is_block = material == 1
    velocity = np.zeros((most, 2), np.float32)
    velocity[is_block, 1] = -speed
    zeros, unit = np.zeros(most, np.int32), np.tile(np.eye(2, dtype=np.float32), (most, 1, 1))
    mpm.input_state(
        n, place, velocity, material, zeros, zeros, np.zeros((most, 2, 2), np.float32),
        is_block.astype(np.float32), unit,
    )  # fmt: skip
    for _ in range(round(TIME / mpm.dt)):
        mpm.substep()
    return 1000 * float((place[is_block, 1] - mpm.x.to_numpy()[is_block, 1]).mean())


if __name__ == "__main__":
    ti.init(arch=ti.cpu, cpu_max_num_threads=1, log_level=ti.WARN, offline_cache=False)
    given = {k: float(v) for k, v in (a.split("=") for a in sys.argv[3:])}
    with Path(sys.argv[1]).open(newline="") as file:
        rows = [{k: float(v) for k, v in row.items()} for row in csv.DictReader(file)]
    found = [sinkage(**{**SETTINGS, **given, **row}) for row in rows]
    with Path(sys.argv[2]).open("w") as file:
        print("sinkage", *(f"{z:.4f}" for z in found), sep="\n", file=file)
