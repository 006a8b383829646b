"""Many independent tasks: on one process, on several, or on a Dask cluster, with the same results.

`run_tasks` and `run_folder_tasks` write one file or one folder for each task, whole or not at all,
and do only what is missing when they are called again; `completed` hands results over as they come
and writes nothing.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import time
import traceback
from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

from calib.batch.folders import check_room, lock, writing
from calib.errors import CalibError


@dataclass(frozen=True)
class Finished[R]:
    """A task that came to its end, with its result or why it failed, and how long it took."""

    name: str
    result: R | None
    error: str | None
    seconds: float


def attempt[I, R](function: Callable[[I], R], name: str, item: Callable[[], I]) -> Finished[R]:
    """Run a task on what `item` returns, and keep whatever goes wrong with it."""
    began = time.perf_counter()
    try:
        result = function(item())
    # A library that calls sys.exit ends its own task only.
    except (Exception, SystemExit) as error:
        return Finished(name, None, describe(error), time.perf_counter() - began)
    return Finished(name, result, None, time.perf_counter() - began)


def describe(error: BaseException) -> str:
    """Return an error as a reader needs it: what can be mended, or what broke and where."""
    if isinstance(error, CalibError):
        return str(error)
    text = "".join(traceback.format_exception_only(error)).strip()
    frames = traceback.extract_tb(error.__traceback__)
    if not frames:
        return text
    return f"{text} ({Path(frames[-1].filename).name}, line {frames[-1].lineno})"


class LateItems[S, I](Mapping[str, I]):
    """A mapping whose values are read anew from their sources each time they are asked for.

    What `read` raises is the error of that task alone.
    """

    def __init__(self, sources: Mapping[str, S], read: Callable[[S], I]) -> None:
        self._sources = sources
        self._read = read

    def __getitem__(self, name: str) -> I:
        return self._read(self._sources[name])

    def __iter__(self) -> Iterator[str]:
        return iter(self._sources)

    def __len__(self) -> int:
        return len(self._sources)

    def __contains__(self, name: object) -> bool:
        return name in self._sources  # without reading the item


def completed[I, R](
    function: Callable[[I], R],
    items: Mapping[str, I],
    *,
    names: Collection[str] | None = None,
    workers: int = 1,
    scheduler: str | None = None,
    announce: Callable[[str], None] | None = None,
) -> Generator[Finished[R]]:
    """Yield tasks as they come to their end, in any order.

    The parameters are those of `calib.batch.tasks.run_tasks`, and `names`, the tasks to do, in this
    order. An item is asked for when its task is sent off, so the mapping may read it only then;
    where that raises, the task has failed.

    What a task returns must not depend on where it is done: it takes every random number from a
    stream of its own (`calib.inference.random`). A task whose worker dies is done again elsewhere;
    one that takes its worker down every time fails.

    Raises
    ------
    CalibError
        If there is no such cluster, or it is lost.
    """
    if workers < 1:
        raise CalibError(f"{workers} workers were asked for", expected="1 or more")
    todo = list(items if names is None else names)
    if not todo:
        return
    if scheduler is None and workers == 1:
        for name in todo:
            yield attempt(function, name, lambda name=name: items[name])  # type: ignore[misc]
        return
    # Dask takes a second to import: only where it is used.
    from calib.batch.cluster import on_cluster

    yield from on_cluster(
        function, items, todo, workers=workers, scheduler=scheduler,
        announce=announce or (lambda line: None),
    )  # fmt: skip


FAILED = "failed.json"
SECONDS = "seconds.csv"
_SCRATCH = ".landing"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._+=-]{0,199}")


@dataclass(frozen=True)
class Kept[R, C]:
    """A way to keep the result of a task, in ``<name><suffix>``.

    `encode` runs beside the task, so that results that cannot be kept fail their task, and the
    work is shared; `write` runs in the one process that writes, to a path that is not there yet.
    """

    suffix: str
    encode: Callable[[R], C]
    write: Callable[[Path, C], object]


def _json(result: Mapping[str, Any]) -> bytes:
    """Return JSON text; NaN and infinity, which other programs could not read, are refused."""
    return (json.dumps(result, indent=1, allow_nan=False) + "\n").encode()


def _files(result: Mapping[str, str | bytes]) -> dict[str, bytes]:
    """Return the files' bytes; a name that leads out of the folder is refused."""
    for file in result:
        path = PurePosixPath(file)
        if path.is_absolute() or ".." in path.parts or not path.parts:
            raise ValueError(f"a task may not write {file!r}: it is not inside its folder")
    return {f: c.encode() if isinstance(c, str) else bytes(c) for f, c in result.items()}


def _write_files(folder: Path, content: Mapping[str, bytes]) -> None:
    folder.mkdir()
    for file, data in content.items():
        path = folder / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)


# Results that JSON can hold, each in a file; or files by relative name, each task's in a folder.
JSON_FILES: Kept[Any, Any] = Kept(".json", _json, Path.write_bytes)
FOLDERS: Kept[Any, Any] = Kept("", _files, _write_files)


def check_names(names: Iterable[str]) -> None:
    """Check that every task can have a file of its name; a CalibError names one that cannot."""
    for name in names:
        if not _NAME.fullmatch(name) or name in ("failed", SECONDS, FAILED):
            raise CalibError(
                f"{name!r} cannot be the name of a task",
                expected="up to 200 letters, digits and . _ + = -, starting with a letter or "
                "digit; not 'failed'",
                hint="rename it",
            )


@contextmanager
def landing_ground(folder: Path, kept: Kept[Any, Any]) -> Iterator[Callable[[Finished[Any]], None]]:
    """Yield a function that lands the result of a task that did not fail, atomically.

    A process that is killed leaves results that are whole, and at most a scratch folder that the
    next one removes. Nothing is synced to the disk: a machine that loses power may lose the last
    seconds' results.

    Raises
    ------
    CalibError
        If the folder cannot be written, or another process is landing results in it.
    """
    scratch = folder / _SCRATCH
    check_room(folder)
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    with alone(folder):
        with writing(folder):
            shutil.rmtree(scratch, ignore_errors=True)
            scratch.mkdir()
            clock = (folder / SECONDS).open("a+", encoding="utf-8")
            clock.seek(0)
            if (times := clock.read()) and not times.endswith("\n"):
                clock.write("\n")  # after a line that a kill has cut short

        def land(task: Finished[Any]) -> None:
            part = scratch / task.name
            with writing(folder):
                kept.write(part, task.result)
                # The time first: whatever has landed has one.
                clock.write(f"{task.name},{task.seconds:.6f}\n")
                clock.flush()
                part.replace(folder / f"{task.name}{kept.suffix}")

        try:
            yield land
        finally:
            clock.close()
            shutil.rmtree(scratch, ignore_errors=True)


def failed_tasks(folder: Path) -> dict[str, str]:
    """Return the errors of the tasks that failed when they were last tried."""
    path = folder / FAILED
    found: dict[str, str] = json.loads(path.read_bytes()) if path.exists() else {}
    return found


def read_seconds(folder: Path) -> dict[str, float]:
    """Return how long each task took when it was last done, in seconds."""
    path = folder / SECONDS
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    found = {}
    for line in lines:
        # The last line of a process that was killed may be cut short.
        with suppress(ValueError):
            name, seconds = line.split(",")
            found[name] = float(seconds)
    return found


@contextmanager
def alone(folder: Path) -> Iterator[None]:
    """Hold the lock of a folder that is there; the system releases it however the process ends.

    Raises
    ------
    CalibError
        If another process holds it.
    """
    try:
        with writing(folder):
            held = lock(folder)
    except CalibError as error:
        if not isinstance(error.__cause__, BlockingIOError):
            raise
        raise CalibError(
            "another process is writing results to this folder",
            where=str(folder),
            hint="wait until it ends, or stop it",
        ) from None
    try:
        yield
    finally:
        if held is not None:
            os.close(held)


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
