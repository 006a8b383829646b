"""Other readings for the cases of a blind test: the same designs and truths, their own answers."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from calib.batch.tasks import completed
from calib.errors import CalibError
from challenge.files import CaseFiles
from challenge.seal import check_new, new_folder, open_answers, sha256, write_case

type Draw = Callable[[Path, str, float], tuple[dict[str, str], dict[str, Any]]]


@dataclass(frozen=True)
class _Job:
    folder: Path
    tier: str
    truth: str
    gap_over_noise: float | None


def redraw(
    cases: Path,
    answers_dir: Path,
    out: Path,
    out_answers: Path,
    draw: Draw,
    *,
    seed: int,
    workers: int = 1,
    scheduler: str | None = None,
    progress: Callable[[int, int], None] | None = None,
    announce: Callable[[str], None] | None = None,
) -> dict[str, str]:
    """Write a blind test with the designs, truths and sizes of gap of another one.

    Parameters
    ----------
    cases, answers_dir : Path
        The other one, as `challenge.make.make` wrote it.
    out, out_answers : Path
        New: the cases, and their answers, outside them.
    draw : callable
        Returns files and answer from a case's folder, truth and size of gap in noise sds, or
        raises CalibError where it cannot. It can be pickled.
    seed : int
        Of `draw`; kept in the answers.
    workers, scheduler, announce
        As for `calib.batch.tasks.completed`; the result does not depend on them.
    progress : callable, optional
        Called with the number of cases done and their total.

    Returns
    -------
    dict of str to str
        Cases that could not be drawn, and why.

    Raises
    ------
    CalibError
        If the answers are not those of the cases, a path will not do, or no case could be drawn.
    """
    answers = open_answers(cases, answers_dir)
    check_new(out, out_answers)
    jobs = {
        name: _Job(cases / name, a.tier, a.truth, (a.model_extra or {}).get("gap_over_noise"))
        for name, a in answers.items()
    }
    done, without = 0, dict[str, str]()
    work = partial(_redrawn, draw)
    with (
        new_folder(out),
        closing(
            completed(work, jobs, workers=workers, scheduler=scheduler, announce=announce)
        ) as coming,
    ):
        for task in coming:
            if task.result is None:
                without[task.name] = str(task.error)
            else:
                salt = sha256(f"{answers[task.name].salt}:{seed}".encode())[:32]
                answer = task.result.answer | {"salt": salt, "seed": seed}
                write_case(out / task.name, task.result.files, out_answers, answer)
            done += 1
            if progress is not None:
                progress(done, len(jobs))
    if len(without) == len(jobs):
        raise CalibError(
            f"no case could be drawn: {next(iter(without.values()))}", where=str(cases)
        )
    return {name: without[name] for name in jobs if name in without}


def _redrawn(draw: Draw, job: _Job) -> CaseFiles:
    if job.gap_over_noise is None:
        raise CalibError("its answer does not say gap_over_noise")
    files, answer = draw(job.folder, job.truth, job.gap_over_noise)
    return CaseFiles(files, {"tier": job.tier, "truth": job.truth, **answer})
