"""Do what is missing of many tasks, and keep every result as it comes."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from calib.batch.tasks.landing import (
    FAILED,
    FOLDERS,
    JSON_FILES,
    Kept,
    check_names,
    landing_ground,
    read_seconds,
)  # fmt: skip
from calib.batch.tasks.stream import completed

type Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Outcome:
    """What came of some tasks, in the order in which they were given.

    Tasks whose result is there, and those of them that were there before; errors of those that
    failed; wall-clock time of each that is done, when it was done.
    """

    done: tuple[str, ...]
    resumed: tuple[str, ...]
    failed: Mapping[str, str]
    seconds: Mapping[str, float]


def run_tasks[I, R](
    function: Callable[[I], R],
    items: Mapping[str, I],
    folder: Path,
    *,
    workers: int = 1,
    scheduler: str | None = None,
    progress: Progress | None = None,
    announce: Callable[[str], None] | None = None,
    kept: Kept[R, Any] = JSON_FILES,
    give_up: int | None = None,
) -> Outcome:
    """Do every task whose result is not there; each gives one JSON file.

    Parameters
    ----------
    function : callable
        Of a module, so that another process can import it. Called with an item, it returns a
        mapping that JSON can hold (no NaN, no infinity).
    items : mapping of str to object
        What each task works on, by the task's name; picklable.
    folder : Path
        Gets ``<name>.json`` for each task, whole or not at all; ``failed.json``, the errors of
        those that failed, if any; and ``seconds.csv``, how long each took.
    workers : int
        Processes on this machine; with 1 the tasks are done here, one after the other. More are
        spawned, so a script that asks for them needs ``if __name__ == "__main__":``.
    scheduler : str, optional
        Address of a Dask scheduler, such as ``tcp://host:8786``, in the place of `workers`. Its
        workers need calib, but no disk in common with this process.
    progress : callable, optional
        Called with tasks finished and tasks in all.
    announce : callable, optional
        Called with one line that says where the tasks are done.
    kept : Kept
        How results are kept, if not as JSON.
    give_up : int, optional
        After so many failures with nothing done between them no more tasks are done.

    Returns
    -------
    Outcome
        Failed tasks among it; they are tried again the next time.

    Raises
    ------
    CalibError
        If the folder cannot be written, a name will not do, or there is no such cluster.

    Notes
    -----
    Killed at any moment and called again, it does what is missing. Results are the same on any
    number of workers as long as a task draws from its own stream (`calib.inference.random`).
    """
    folder = Path(folder)
    check_names(items)
    tell = progress or (lambda done, planned: None)
    resumed = tuple(name for name in items if (folder / f"{name}{kept.suffix}").exists())
    found = set(resumed)
    failed: dict[str, str] = {}
    with (
        landing_ground(folder, kept) as land,
        closing(
            completed(
                partial(_encoded, function, kept.encode), items,
                names=[name for name in items if name not in found],
                workers=workers, scheduler=scheduler, announce=announce,
            )
        ) as coming,
    ):  # fmt: skip
        tell(len(found), len(items))
        in_a_row = 0
        try:
            for task in coming:
                if task.error is None:
                    land(task)
                    found.add(task.name)
                    in_a_row = 0
                else:
                    failed[task.name] = task.error
                    in_a_row += 1
                    if in_a_row == give_up:
                        break
                tell(len(found) + len(failed), len(items))
        except KeyboardInterrupt:
            raise KeyboardInterrupt(
                f"interrupted; {len(found)} of {len(items)} results are kept in {folder}, "
                "and the same command does the others"
            ) from None
        finally:
            failed = {name: failed[name] for name in items if name in failed}
            _list(failed, folder / FAILED)
    seconds = read_seconds(folder)
    done = tuple(name for name in items if name in found)
    return Outcome(done, resumed, failed, {n: seconds[n] for n in done if n in seconds})


def run_folder_tasks[I](
    function: Callable[[I], Mapping[str, str | bytes]],
    items: Mapping[str, I],
    folder: Path,
    **where: Any,
) -> Outcome:
    """Do every task whose result is not there; each gives a folder of files.

    As `run_tasks`, but `function` returns the content of files by their names relative to the
    task's own folder, ``folder/<name>``, which appears whole or not at all.
    """
    return run_tasks(function, items, folder, kept=FOLDERS, **where)


def _encoded[I, R, C](function: Callable[[I], R], encode: Callable[[R], C], item: I) -> C:
    return encode(function(item))


def _list(failed: Mapping[str, str], path: Path) -> None:
    if failed:
        path.write_text(json.dumps(failed, indent=1) + "\n", encoding="utf-8")
    else:
        path.unlink(missing_ok=True)
