"""Do the work of a report or a run again, from the folder's own data, priors, seed and settings."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calib.batch.environment import Environment
from calib.batch.pool import HERE, Pool
from calib.check.inputs import GROUP as INPUTS
from calib.check.outcome import Item, claim
from calib.check.schema import Manifest, RunRecord, TaskRecord
from calib.data import read_table
from calib.data.quantities import OUTPUTS
from calib.errors import CalibError
from calib.inference.calibration import Calibration, calibrate
from calib.inference.estimators import PointEstimate, estimate
from calib.inference.io import save_calibration
from calib.inference.problem import Problem
from calib.inference.random import generator
from calib.report.sections import SECTIONS, work_out
from calib.report.study import Progress, Study
from calib.report.study_tasks import Task
from calib.report.writer import write_report


@dataclass(frozen=True)
class Job:
    """A folder to be checked, where it is made again (not there yet), and how."""

    folder: Path
    made: Path
    progress: Progress
    here: Environment
    quick: bool = False
    pool: Pool = HERE
    workers: int = 1

    def inside(self, name: str) -> Job:
        """Return the job of a folder in it."""
        return replace(self, folder=self.folder / name, made=self.made / name)


@contextmanager
def not_computed(items: list[Item], folder: Path, record: str) -> Iterator[None]:
    """Turn whatever stops the work into one more item.

    The record is somebody else's: what it makes fail is a finding, with what was found before.
    """
    try:
        yield
    except CalibError as error:
        path = Path((error.where or "").partition(",")[0])
        where = path.relative_to(folder).as_posix() if path.is_relative_to(folder) else record
        items.append(claim(INPUTS, where, f"not computed again: {error.message}"))
    except Exception as error:
        note = f"not computed again: {type(error).__name__}: {error}"
        items.append(claim(INPUTS, record, note))


def report_tasks(manifest: Manifest, folder: Path, scratch: Path) -> tuple[Task, ...]:
    """Return the tasks of a report, with the folder's own data and priors.

    These are copied into `scratch` under their first names, which the page shows.
    """
    return tuple(_task(key, entry, folder, scratch / key) for key, entry in manifest.tasks.items())


def _task(key: str, entry: TaskRecord, folder: Path, scratch: Path) -> Task:
    said = entry.data
    table = read_table(folder / said.file, allow_missing=tuple(OUTPUTS.values()))
    table = replace(
        table, source=said.source, sha256=said.source_sha256, label=entry.label,
        header=said.header or table.header, text=(), ignored=said.ignored,
    )  # fmt: skip
    scratch.mkdir(parents=True)
    prior_path = scratch / entry.priors.source
    shutil.copyfile(folder / entry.priors.file, prior_path)
    return Task(key, entry.model, table, entry.held_out, prior_path)


def recompute_report(
    manifest: Manifest, tasks: tuple[Task, ...], out: Path, progress: Progress, pool: Pool = HERE
) -> Study:
    """Work a report out again and write it into a new folder."""
    contents = work_out(
        tasks, manifest.seed, settings=manifest.settings, progress=progress, pool=pool,
        sections=[SECTIONS[name].again(record) for name, record in manifest.sections.items()],
    )  # fmt: skip
    write_report(
        contents.study, out, sections=contents.found, pdf=manifest.pdf, settings=manifest.settings,
        command=manifest.command, title=manifest.title, environment=manifest.environment,
        progress=progress, pool=pool,
    )  # fmt: skip
    return contents.study


def estimate_again(record: RunRecord, problem: Problem) -> tuple[PointEstimate, ...]:
    """Return the point estimates of a run, computed again."""
    return tuple(
        estimate(problem, e.method, generator(record.seed, record.model, e.method))
        for e in record.estimates
    )


def recompute_run(
    record: RunRecord, problem: Problem, out: Path, progress: Progress
) -> Calibration:
    """Sample a run again and write it into a new folder.

    Sampled from the recorded starts, whoever chose them; the estimates in the new folder are
    computed again, to be compared with them.
    """
    starts = tuple(
        PointEstimate(
            e.method, np.array(e.theta), dict(e.reported), e.cost, "", e.rmse, float("nan"), 0,
            float("nan"), True,
        )
        for e in record.estimates
    )  # fmt: skip
    calibration = calibrate(
        problem, record.seed, label=record.label, estimates=starts, settings=record.settings,
        progress=lambda done, planned: progress("sampling", done, planned),
    )  # fmt: skip
    calibration = replace(calibration, estimates=estimate_again(record, problem))
    out.mkdir()
    save_calibration(calibration, out, environment=record.environment)
    return calibration
