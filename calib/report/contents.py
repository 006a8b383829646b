"""What a report shows: the study, and the sections that were asked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from calib.batch.pool import HERE, Pool
from calib.inference.sampling.sampler import SamplerSettings
from calib.report.sections import Found, Section
from calib.report.study import Progress, Study, begin_study
from calib.report.study_tasks import Task


@dataclass(frozen=True)
class Contents:
    """What `calib.report.writer.write_report` writes: the study, and what its sections found."""

    study: Study
    found: tuple[Found, ...]


def work_out(
    tasks: Sequence[Task],
    seed: int,
    *,
    settings: SamplerSettings | None = None,
    sections: Sequence[Section] = (),
    progress: Progress | None = None,
    workers: int = 1,
    pool: Pool = HERE,
) -> Contents:
    """Work everything out that a report shows.

    Parameters
    ----------
    sections : sequence of Section
        What the report has beside its outputs.
    progress : callable, optional
        Called with what is being done, steps done and steps planned.
    workers : int
        Processes for leaving rows out, where outputs are worked out here.
    pool : Pool, optional
        Where outputs and sections are worked out, in any order. The numbers depend neither on it
        nor on `workers`.
    """
    tell = progress or (lambda what, done, planned: None)
    study = begin_study(
        tasks, seed, pool, settings=settings, progress=progress,
        workers=workers if pool.here else 1,
    )  # fmt: skip
    begun = [section.begin(seed, pool) for section in sections]
    studied = study(tell)
    # What was asked for last comes last; what its section has to do here is done meanwhile.
    found = [finish(studied, tell) for finish in reversed(begun)]
    return Contents(studied, tuple(reversed(found)))
