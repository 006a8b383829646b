"""A model's simulator emulated for data at hand, and the model made the emulator from then on."""

from __future__ import annotations

import csv
import hashlib
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from calib.batch.plugins import load_files
from calib.data import Table
from calib.errors import CalibError
from calib.inference.emulation.sequential import emulate, extend
from calib.inference.emulation.settings import Emulation, EmulationSettings, Progress
from calib.inference.emulation.tabulated import emulate_table
from calib.inference.prior_files import PriorFile
from calib.inference.problem import Problem, build_problem
from calib.models import get_model
from calib.models.simulators.base import FAILED
from calib.models.simulators.emulator import Emulator
from calib.models.simulators.emulator.files import save_emulator
from calib.models.simulators.emulator.model import emulator_of
from calib.models.simulators.registered import SIMULATED, Simulated, simulated_by, slow_simulator
from calib.models.simulators.runs import Run, RunKeeper
from calib.models.simulators.ways import TableWay

_MORE = 100


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
    problem : Problem
    seed : int
    elsewhere : sequence of Table
        Whose conditions will be predicted beside those of the problem.
    workers : int
    scheduler : str, optional
    progress : callable, optional
        Called with what is done, how much of it, and of how much.

    Raises
    ------
    CalibError
        If the model is no simulator's.
    """
    problem.noise.must_be_usual(problem.priors.source, "an emulator")
    found = _simulated(problem.bound.model.name)
    settings = EmulationSettings(**(found.budget or {}))  # type: ignore[arg-type]
    if isinstance(found.simulator.way, TableWay):
        return emulate_table(problem, found.simulator, seed, settings, progress)
    keeper = _keeper(found, workers, scheduler, progress, settings.runs)
    return emulate(
        problem, keeper, seed, settings=settings, elsewhere=[t.columns for t in elsewhere],
        progress=progress,
    )  # fmt: skip


def _simulated(model: str) -> Simulated:
    found = simulated_by(model)
    if found is None:
        raise CalibError(
            f"the model {model} is none of a simulator", allowed=", ".join(SIMULATED) or "none yet",
            mend="register it first, see calib.from_callable and --simulator",
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
    load_files([_kept(found, model, emulation)])
    return emulation


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
    if found is None or emulator is None or not found.simulator.way.runs:
        return None
    problem = build_problem(model, field, priors)
    emulation = _extended(found, emulator, problem, seed, workers, progress)
    load_files([_kept(found, model, emulation)])
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
    if not found.simulator.way.runs:
        return [first]
    problem = build_problem(model, field, priors)
    return [first, _extended(found, first.emulator, problem, seed, 1, None)]


def _extended(
    found: Simulated, emulator: Emulator, problem: Problem, seed: int, workers: int,
    progress: Progress | None,
) -> Emulation:  # fmt: skip
    settings = EmulationSettings(**(found.budget or {}))  # type: ignore[arg-type]
    keeper = _keeper(found, workers, None, progress, _MORE)
    return extend(emulator, problem, keeper, seed, settings=settings, more=_MORE, progress=progress)


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
