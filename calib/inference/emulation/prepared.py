"""Emulate a simulator from a table of runs that were made already: nothing is carried out.

A model's simulator emulated for data at hand, and the model made the emulator from then on.
"""

from __future__ import annotations

import csv
import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calib.data import Table
from calib.data.files import open_csv
from calib.data.quantities import real_array
from calib.data.table import parse_header
from calib.errors import CalibError
from calib.inference.design import check_moves, check_scale
from calib.inference.emulation import (
    check_outputs,
    emulate,
    emulate_together,
    extend,
    judged,
    left_out,
)
from calib.inference.emulation.state import Emulation, Progress, State, has_value
from calib.inference.joint import JointProblem
from calib.inference.prior_files import PriorFile
from calib.inference.problem import Problem, build_problem
from calib.models import get_model
from calib.models.base import Array
from calib.models.simulators.declaration import (
    SIMULATED,
    EmulationSettings,
    Simulated,
    simulated_by,
    slow_simulator,
)
from calib.models.simulators.emulator import Emulator, Training, emulator_of, save_emulator
from calib.models.simulators.files import load_files
from calib.models.simulators.runner import TableRunner, columns_of
from calib.models.simulators.simulator import FAILED, Failure, Run, RunKeeper, Simulator


def emulate_table(
    problems: Sequence[Problem], simulator: Simulator, seed: int, settings: EmulationSettings,
    progress: Progress | None = None, joint: JointProblem | None = None,
) -> tuple[Emulation, ...]:  # fmt: skip
    """Emulate from a table; each run where the posterior is checks what the others say of it."""
    read = [read_runs(simulator, problem) for problem in problems]
    theta, nodes = read[0].theta, read[0].nodes
    state = State(
        problems, RunKeeper(simulator), nodes, seed, progress=progress, joint=joint
    )  # fmt: skip
    values = np.stack([training.values for training in read], axis=1)
    ok = has_value(values)
    values[~ok] = np.nan
    lacks = Failure("nan", "the table has no value for it")
    state.runs = [Run(t, {}, None if good else lacks) for t, good in zip(theta, ok, strict=True)]
    check_outputs(state, values, check_scale, check_moves)
    state.learn(theta, values)
    for step in range(2):
        state.rebuild()
        z = state.sample(step)
    state.rebuild()
    history = [(len(theta), state.error(z))]
    return judged(state, z, settings, [left_out(known) for known in state.outputs], history)


def read_runs(simulator: Simulator, problem: Problem) -> Training:
    """Read a table of runs: a row for each row of conditions of each run, in any order.

    Raises
    ------
    CalibError
        If a column is missing, a cell is no number, there are too few runs, or the runs do not
        all have the same conditions.
    """
    way = simulator.runner
    if not isinstance(way, TableRunner):
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
            expected=", ".join(needed), hint="add it, or correct its name in the simulator file",
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
                expected="each run once at each row of conditions",
                hint="delete one of the two; of a simulator that scatters a table has one run of "
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
    if not same or len(vectors) < 8:
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
            expected="at least 8 runs, each at the same rows of conditions",
            hint="make the runs at the same conditions",
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
            expected="CSV with a header, and a cell for each column in each row; decimal points",
            hint="correct it",
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
                expected="a number for each parameter and condition; outputs may be missing",
                hint="add it, or leave the run out",
            )  # fmt: skip


def emulated(
    problem: Problem,
    seed: int,
    *,
    elsewhere: Sequence[Table] = (),
    workers: int = 1,
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> Emulation:
    """Emulate the simulator behind a problem; the emulation's problem can be calibrated.

    Parameters
    ----------
    elsewhere : sequence of Table
        Whose conditions will be predicted beside those of the problem.
    scheduler : str, optional
    progress : callable, optional
        Called with what is done, how much of it, and of how much.

    Raises
    ------
    CalibError
        If the model is no simulator's.

    Examples
    --------
    >>> import calib
    >>> simulator = calib.read_simulator("wheel.toml")  # doctest: +SKIP
    >>> calib.register(simulator)  # doctest: +SKIP
    >>> data = calib.read_table("lab.csv")  # doctest: +SKIP
    >>> emulation = calib.emulated(calib.build_problem("wheel", data), seed=1)  # doctest: +SKIP
    >>> calibration = calib.calibrate(emulation.problem, seed=1)  # doctest: +SKIP
    """
    problem.noise.must_be_normal_of_one_sd(problem.priors.source, "an emulator", errors=False)
    found = _simulated(problem.bound.model.name)
    settings = found.emulation
    if isinstance(found.simulator.runner, TableRunner):
        return emulate_table([problem], found.simulator, seed, settings, progress)[0]
    keeper = _keeper(found, workers, scheduler, progress, settings.runs)
    return emulate(
        problem, keeper, seed, settings=settings, elsewhere=[t.columns for t in elsewhere],
        progress=progress,
    )  # fmt: skip


def emulated_jointly(
    joint: JointProblem,
    seed: int,
    *,
    elsewhere: Sequence[Table] = (),
    workers: int = 1,
    progress: Progress | None = None,
) -> tuple[JointProblem, dict[str, Emulation]]:
    """Emulate the slow simulators behind a joint problem, each once for all of its outputs.

    Parameters
    ----------
    elsewhere : sequence of Table
        Whose conditions will be predicted beside those of the problem.
    progress : callable, optional
        Called with what is done, how much of it, and of how much.

    Returns
    -------
    joint : JointProblem
        With emulators in the place of the simulators: it can be calibrated.
    emulations : dict of str to Emulation
        By model; those of one simulator stand on the same runs.

    Raises
    ------
    CalibError
        As of `emulated`; if outputs of one simulator have priors that differ.

    Examples
    --------
    >>> from calib.inference.joint import build_joint, calibrate_joint
    >>> joint = build_joint({"wheel_drawbar_pull": data, "wheel_rut_depth": data})  # doctest: +SKIP
    >>> joint, emulations = emulated_jointly(joint, seed=1)  # doctest: +SKIP
    >>> found = calibrate_joint(joint, seed=1)  # doctest: +SKIP
    """
    by_simulator: dict[str, list[str]] = {}
    for output, model in zip(joint.outputs, joint.models, strict=True):
        if model.uncertain is None and (slow := slow_simulator(model.name)) is not None:
            by_simulator.setdefault(slow.name, []).append(output)
    waiting = {o for outputs in by_simulator.values() for o in outputs}
    emulations: dict[str, Emulation] = {}
    for name, outputs in by_simulator.items():
        waiting -= {*outputs}  # another simulator cannot be asked before it is emulated
        known = joint.without(waiting)
        problems = [joint.wholes[output] for output in outputs]
        d = len(problems[0].bound.model.parameters)
        held = [[(p.name, p.fixed, p.loc) for p in q.priors.entries[:d]] for q in problems]
        for problem in problems:
            problem.noise.must_be_normal_of_one_sd(
                problem.priors.source, "an emulator", errors=False
            )
        if any(one != held[0] for one in held):
            raise CalibError(
                f"the priors of {', '.join(outputs)} differ", where=f"simulator {name}",
                expected="the same for all outputs, which come from the same runs",
                hint="give the models prior files that agree in all but sigma",
            )  # fmt: skip
        simulated = SIMULATED[name]
        settings = simulated.emulation
        if isinstance(simulated.simulator.runner, TableRunner):
            found = emulate_table(problems, simulated.simulator, seed, settings, progress, known)
        else:
            keeper = _keeper(simulated, workers, None, progress, settings.runs)
            found = emulate_together(
                problems, keeper, seed, joint=known, settings=settings, progress=progress,
                elsewhere=[t.columns for t in elsewhere],
            )  # fmt: skip
        joint = joint.with_models([e.problem.bound.model for e in found])
        emulations |= {e.problem.bound.model.name: e for e in found}
    return joint, emulations


def _simulated(model: str) -> Simulated:
    found = simulated_by(model)
    if found is None:
        raise CalibError(
            f"the model {model} is none of a simulator",
            expected=", ".join(SIMULATED) or "none yet",
            hint="register it first, see calib.from_callable and --simulator",
        )  # fmt: skip
    return found


def _keeper(
    found: Simulated, workers: int, scheduler: str | None, progress: Progress | None, planned: int
) -> RunKeeper:
    tell = None if progress is None else _Tell(progress, planned)
    return RunKeeper(found.simulator, found.folder, workers, scheduler, tell)


class _Tell:
    """Runs of all batches in one count."""

    def __init__(self, progress: Progress, planned: int) -> None:
        self._progress, self._planned, self._before, self._batch = progress, planned, 0, 0

    def __call__(self, done: int, planned: int) -> None:
        """Tell what is done of a batch."""
        if done < self._batch:
            self._before, self._batch = self._before + self._batch, 0
        self._batch = done
        self._progress("simulator runs", self._before + done, self._planned)


def prepare(
    model: str,
    table: Table,
    seed: int,
    *,
    priors: PriorFile | None = None,
    elsewhere: Sequence[Table] = (),
    workers: int = 1,
    progress: Progress | None = None,
) -> Emulation | None:
    """Emulate a model's simulator if it has to be, for all that this process does from now on.

    For the calibration on `table`; None for a model that is none of a slow simulator.
    """
    found = slow_simulator(model)
    if found is None:
        return None
    emulation = emulated(
        build_problem(model, table, priors), seed, elsewhere=elsewhere, workers=workers,
        progress=progress,
    )  # fmt: skip
    put_in_use({model: emulation})
    return emulation


def put_in_use(emulations: Mapping[str, Emulation]) -> None:
    """Make models their emulators, for all that this process does from now on; keep these."""
    load_files([_kept(_simulated(name), name, e) for name, e in emulations.items()])


def prepare_field(
    model: str,
    field: Table,
    seed: int,
    *,
    priors: PriorFile | None = None,
    workers: int = 1,
    progress: Progress | None = None,
) -> Emulation | None:
    """Have an emulator in use serve a field campaign as well, with 100 more runs at the most.

    None where no run can be made: of no slow simulator, or of a table of runs.
    """
    found, emulator = simulated_by(model), emulator_of(get_model(model))
    if found is None or emulator is None or not found.simulator.runner.runs:
        return None
    problem = build_problem(model, field, priors)
    emulation = _extended(found, emulator, problem, seed, workers, progress)
    put_in_use({model: emulation})
    return emulation


def emulated_for_both(
    model: str,
    lab: Table,
    field: Table,
    seed: int,
    *,
    priors: PriorFile | None = None,
    elsewhere: Sequence[Table] = (),
) -> list[Emulation]:
    """Emulate a model's simulator for a diagnosis, as `prepare` and `prepare_field` do.

    The model is not made the emulator here: that of the last emulation's problem is it.
    """
    found = _simulated(model)
    first = emulated(build_problem(model, lab, priors), seed, elsewhere=[field, *elsewhere])
    if not found.simulator.runner.runs:
        return [first]
    problem = build_problem(model, field, priors)
    return [first, _extended(found, first.emulator, problem, seed, 1, None)]


def _extended(
    found: Simulated, emulator: Emulator, problem: Problem, seed: int, workers: int,
    progress: Progress | None,
) -> Emulation:  # fmt: skip
    more = 100
    keeper = _keeper(found, workers, None, progress, more)
    return extend(
        emulator, problem, keeper, seed, settings=found.emulation, more=more, progress=progress
    )


def reaches(model: str, tables: Sequence[Table]) -> bool:
    """Whether the emulator that a model is now has a value at all conditions of some tables."""
    emulator = emulator_of(get_model(model))
    if emulator is None:
        return False
    return all(
        bool(np.isfinite(emulator.curves_at(get_model(model).select(t.columns))).all())
        for t in tables
    )


def _kept(found: Simulated, model: str, emulation: Emulation) -> Path:
    """Write the emulator beside the runs; return where."""
    folder = (found.folder or Path(f"{found.name}.runs")) / "emulators"
    theta = emulation.emulator.training.theta
    digest = hashlib.sha256(theta.tobytes() + found.simulator.digest.encode()).hexdigest()[:16]
    path = folder / f"{model}-{digest}.npz"
    save_emulator(emulation.emulator, model, path)
    write_failed(emulation.failed, found.simulator.parameters, folder / f"{model}-failed.csv")
    report = json.dumps(emulation.document(), indent=1)
    (folder / f"{model}-{digest}.json").write_text(report + "\n", encoding="utf-8")
    return path


def write_failed(failed: Sequence[Run], parameters: Sequence[str], path: Path) -> None:
    """List runs that failed with their parameters and the tail of what they printed."""
    if not failed:
        path.unlink(missing_ok=True)
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([*parameters, *FAILED])
        for run in failed:
            if run.failure is not None:
                what = run.failure.kind, run.failure.reason, run.failure.printed.strip()
                writer.writerow([*map(repr, run.theta.tolist()), *what])
