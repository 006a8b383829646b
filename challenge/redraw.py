"""Other readings for the cases of a blind test: the same designs and truths, a key of their own."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from calib.batch.folders import writing
from calib.batch.tasks import completed
from calib.errors import CalibError
from challenge.files import CaseFiles
from challenge.seal import KEY_SCHEMA, check_new, new_folder, open_key, publish, seal

type Draw = Callable[[Path, str, float], tuple[dict[str, str], dict[str, Any]]]


@dataclass(frozen=True)
class _Job:
    folder: Path
    tier: str
    truth: str
    gap_over_noise: float


def redraw(
    cases: Path,
    key_path: Path,
    out: Path,
    out_key: Path,
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
    cases, key_path : Path
        The other one, as `challenge.make.make` wrote it.
    out, out_key : Path
        New: the cases, and their sealed answers, outside them.
    draw : callable
        Returns files and key entry from a case's folder, truth and size of gap in noise sds, or
        raises CalibError where it cannot. It can be pickled.
    seed : int
        Of `draw`; kept in the key.
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
        If the key is not that of the cases, a path will not do, or no case could be drawn.
    """
    key = open_key(cases, key_path)
    check_new(out, out_key)
    jobs = {
        name: _Job(cases / name, entry["tier"], entry["truth"], entry["gap_over_noise"])
        for name, entry in key["cases"].items()
    }
    entries: dict[str, Any] = {}
    without: dict[str, str] = {}
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
                with writing(out):
                    task.result.write(out / task.name)
                entries[task.name] = task.result.key
            if progress is not None:
                progress(len(entries) + len(without), len(jobs))
    if not entries:
        raise CalibError(
            f"no case could be drawn: {next(iter(without.values()))}", where=str(cases)
        )
    kept = {name: entries[name] for name in jobs if name in entries}
    new = {"schema": KEY_SCHEMA, "seed": seed, "salt": key["salt"], "cases": kept}
    tiers = tuple(dict.fromkeys(entry["tier"] for entry in kept.values()))
    publish(out, new, seal(new, out_key), tiers)
    return {name: without[name] for name in jobs if name in without}


def _redrawn(draw: Draw, job: _Job) -> CaseFiles:
    files, key = draw(job.folder, job.truth, job.gap_over_noise)
    return CaseFiles(files, {"tier": job.tier, "truth": job.truth, **key})
