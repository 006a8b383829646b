"""Emulate a simulator from a table of runs that were made already: nothing is carried out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calib.data.csvfile import open_csv
from calib.data.headers import parse_header
from calib.data.values import real_array
from calib.errors import CalibError
from calib.inference.emulation.judge import judged, left_out
from calib.inference.emulation.settings import Emulation, EmulationSettings, Progress
from calib.inference.emulation.state import State
from calib.inference.problem import Problem
from calib.inference.trial import check_scale
from calib.models.base import Array
from calib.models.simulators.base import Failure, Simulator
from calib.models.simulators.emulator import Training
from calib.models.simulators.exchange import columns_of
from calib.models.simulators.runs import Run, RunKeeper
from calib.models.simulators.ways import TableWay

_LEAST = 8


def emulate_table(
    problem: Problem, simulator: Simulator, seed: int, settings: EmulationSettings,
    progress: Progress | None = None,
) -> Emulation:  # fmt: skip
    """Emulate from a table; each run where the posterior is checks what the others say of it."""
    training = read_runs(simulator, problem)
    state = State(problem, RunKeeper(simulator), training.nodes, seed, progress=progress)
    state.runs = [
        Run(t, {problem.bound.model.output: v})
        if np.isfinite(v).all()
        else Run(t, {}, Failure("nan", "the table has no value for it"))
        for t, v in zip(training.theta, training.values, strict=True)
    ]
    check_scale(problem, state.outputs(training.values), simulator)
    state.learn(training.theta, training.values)
    for step in range(2):
        state.rebuild()
        z = state.sample(step)
    state.rebuild()
    history = [(len(training.theta), state.error(z))]
    return judged(state, z, settings, left_out(state), 0.0, history)


def read_runs(simulator: Simulator, problem: Problem) -> Training:
    """Read a table of runs: a row for each row of conditions of each run, in any order.

    Raises
    ------
    CalibError
        If a column is missing, a cell is no number, there are too few runs, or the runs do not
        all have the same conditions.
    """
    way = simulator.way
    if not isinstance(way, TableWay):
        raise ValueError(f"{simulator.name} is no table")
    found, lines = _columns(way.path)
    output = next(
        o for o in simulator.outputs if simulator.canonical(o.header) == problem.bound.model.output
    )
    needed = (*simulator.parameters, *simulator.conditions, output.column)
    missing = [name for name in needed if name not in found]
    if missing:
        raise CalibError(
            f"the table of runs has no column {', '.join(missing)}", where=str(way.path),
            allowed=", ".join(needed), mend="add it, or correct its name in the simulator file",
        )  # fmt: skip
    columns = {name: _numbers(found, name, way.path) for name in needed}
    _check_finite(columns, needed[:-1], lines, way.path)
    theta = np.stack([columns[name] for name in simulator.parameters], axis=1)
    _check_doubled(
        np.stack([columns[name] for name in needed[:-1]], axis=1), needed, lines, way.path
    )
    x = {
        simulator.canonical(h): _in_canonical(h, columns[n])
        for n, h in simulator.conditions.items()
    }
    y = _in_canonical(output.header, columns[output.column])
    with np.errstate(all="ignore"):
        y = problem.bound.to_response(y)
    return _by_run(theta, x, y, way.path)


def _check_doubled(rows: Array, names: Sequence[str], lines: Sequence[int], path: Path) -> None:
    """Check that no run has a row of conditions twice."""
    first: dict[bytes, int] = {}
    for row, line in zip(rows + 0.0, lines, strict=True):  # 0 and -0 are the same
        if (earlier := first.setdefault(row.tobytes(), line)) != line:
            told = ", ".join(f"{n} = {v:g}" for n, v in zip(names, row, strict=False))
            raise CalibError(
                f"the row of line {earlier} is there again ({told})", where=f"{path}, line {line}",
                allowed="each run once at each row of conditions",
                mend="delete one of the two; of a simulator that scatters a table has one run of "
                "each parameter vector",
            )  # fmt: skip


def _in_canonical(header: str, values: Array) -> Array:
    column = parse_header(header)
    return values if column is None else column.to_canonical(values)


def _by_run(theta: Array, x: Mapping[str, Array], y: Array, path: Path) -> Training:
    vectors, of_run = np.unique(theta, axis=0, return_inverse=True)
    # Every run's rows in one order of the conditions.
    order = np.lexsort((*reversed(list(x.values())), of_run.ravel()))
    m = len(y) // len(vectors)
    rows = np.stack(list(x.values()), axis=1)[order]
    same = m * len(vectors) == len(y) and np.allclose(
        rows.reshape(len(vectors), m, -1), rows[:m], rtol=1e-9, atol=1e-12
    )
    if not same or len(vectors) < _LEAST:
        counts = np.bincount(of_run.ravel())
        odd = np.flatnonzero(counts != np.bincount(counts).argmax())[:1]
        told = "".join(
            f" (that of {', '.join(f'{v:g}' for v in vectors[i])} has {counts[i]} rows)"
            for i in odd
        )
        raise CalibError(
            f"there are {len(vectors)} runs, not all at the same conditions{told}"
            if not same
            else f"there are {len(vectors)} runs",
            where=str(path),
            allowed=f"at least {_LEAST} runs, each at the same rows of conditions",
            mend="make the runs at the same conditions",
        )
    nodes = {name: rows[:m, i].copy() for i, name in enumerate(x)}
    return Training(vectors, y[order].reshape(len(vectors), m), nodes)


def _columns(path: Path) -> tuple[dict[str, Any], list[int]]:
    """Return the columns, and the line of each row."""
    file = open_csv(path)
    read = list(file.rows)
    lines, rows = [line for line, _ in read], [row for _, row in read]
    try:
        return columns_of(file.header, rows), lines
    except ValueError as error:
        raise CalibError(
            f"the table of runs cannot be read: {error}", where=str(path),
            allowed="CSV with a header, and a cell for each column in each row; decimal points",
            mend="correct it",
        ) from None  # fmt: skip


def _numbers(columns: Mapping[str, Any], name: str, path: Path) -> Array:
    try:
        return real_array(columns[name])
    except CalibError as error:
        raise error.within(f"{path}, column {name}") from None


def _check_finite(
    columns: Mapping[str, Array], names: Sequence[str], lines: Sequence[int], path: Path
) -> None:
    for name in names:
        bad = np.flatnonzero(~np.isfinite(columns[name]))
        if bad.size:
            raise CalibError(
                "there is no number", where=f"{path}, line {lines[bad[0]]}, column {name}",
                allowed="a number for each parameter and condition; outputs may be missing",
                mend="add it, or leave the run out",
            )  # fmt: skip
