"""What a report shows: the study, and for the embedded data the source's gaps and its audit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from calib.batch.pool import HERE, Pool
from calib.he2019.audit import Audit, Seeds, run_audit
from calib.he2019.audit.convergence import begin_convergence
from calib.he2019.datasets.published import PUBLISHED
from calib.he2019.gaps.cases import PaperGap
from calib.he2019.gaps.find import FoundGap, begin_gaps
from calib.inference.sampling.sampler import SamplerSettings
from calib.report.study import Progress, Study, begin_study
from calib.report.study_tasks import Task

__all__ = ["Contents", "work_out"]


@dataclass(frozen=True)
class Contents:
    """What `calib.report.writer.write_report` writes.

    Parameters
    ----------
    study : Study
    gaps : tuple of FoundGap
        Empty where none were asked for.
    audit : Audit, optional
    """

    study: Study
    gaps: tuple[FoundGap, ...]
    audit: Audit | None


def work_out(
    tasks: Sequence[Task],
    seed: int,
    *,
    settings: SamplerSettings | None = None,
    gaps: Sequence[PaperGap] = (),
    audit: Seeds | None = None,
    progress: Progress | None = None,
    workers: int = 1,
    pool: Pool = HERE,
) -> Contents:
    """Work everything out that a report shows.

    Parameters
    ----------
    tasks : sequence of Task
    seed : int
        Same seed, same numbers.
    settings : SamplerSettings, optional
    gaps : sequence of PaperGap
        The source's gaps to diagnose.
    audit : Seeds, optional
        How often the audit of the source's tables repeats each search; none, no audit.
    progress : callable, optional
        Called with what is being done, steps done and steps planned.
    workers : int
        Processes for leaving rows out, where outputs are worked out here.
    pool : Pool, optional
        Where outputs, gaps and searches are worked out, in any order. The numbers depend neither
        on it nor on `workers`.
    """
    tell = progress or (lambda what, done, planned: None)
    study = begin_study(
        tasks, seed, pool, settings=settings, progress=progress,
        workers=workers if pool.here else 1,
    )  # fmt: skip
    searches = begin_convergence(PUBLISHED, seed, audit, pool) if audit is not None else None
    diagnoses = begin_gaps(seed, gaps, pool)
    studied = study(tell)
    if audit is None:
        return Contents(studied, diagnoses(tell), None)
    rut = studied.successes.get("rut_depth")
    audited = run_audit(
        seed,
        seeds=audit,
        rut_calibration=None if rut is None else rut.calibration,
        progress=progress,
        genetic=searches,
    )
    return Contents(studied, diagnoses(tell), audited)
