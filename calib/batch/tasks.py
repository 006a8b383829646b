"""Many independent tasks: in this process, in several, or on a Dask cluster, with equal results.

`run_tasks` keeps one file or one folder for each task, whole or not at all, and does only what is
missing when it is called again; `completed` hands results over as they come and writes nothing.
"""

from __future__ import annotations

import json
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

from calib.batch.folders import alone, check_room, writing
from calib.errors import CalibError

FAILED = "failed.json"
SECONDS = "seconds.csv"


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
    """Return an error as a reader needs it: what the user can correct, or what broke and where."""
    if isinstance(error, CalibError):
        return str(error)
    text = "".join(traceback.format_exception_only(error)).strip()
    frames = traceback.extract_tb(error.__traceback__)
    return (
        f"{text} ({Path(frames[-1].filename).name}, line {frames[-1].lineno})" if frames else text
    )


def completed[S, R](
    function: Callable[[Any], R],
    items: Mapping[str, S],
    *,
    read: Callable[[S], Any] | None = None,
    names: Collection[str] | None = None,
    workers: int = 1,
    scheduler: str | None = None,
    announce: Callable[[str], None] | None = None,
) -> Generator[Finished[R]]:
    """Yield tasks as they come to their end, in any order.

    The parameters are those of `calib.batch.tasks.run_tasks`, and `names`, the tasks to do, in this
    order.

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

    def item(name: str) -> Any:
        return items[name] if read is None else read(items[name])

    todo = list(items if names is None else names)
    if not todo:
        return
    if scheduler is None and workers == 1:
        for name in todo:
            yield attempt(function, name, partial(item, name))
        return
    # Dask takes a second to import: only where it is used.
    from calib.batch.cluster import on_cluster

    yield from on_cluster(
        function, item, todo, workers=workers, scheduler=scheduler,
        announce=announce or (lambda line: None),
    )  # fmt: skip


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


def run_tasks[S](
    function: Callable[[Any], Mapping[str, Any]],
    items: Mapping[str, S],
    folder: Path,
    *,
    read: Callable[[S], Any] | None = None,
    folders: bool = False,
    workers: int = 1,
    scheduler: str | None = None,
    progress: Callable[[int, int], None] | None = None,
    announce: Callable[[str], None] | None = None,
    give_up: int | None = None,
) -> Outcome:
    """Do every task whose result is not there; each gives one JSON file, or a folder of files.

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
    read : callable, optional
        Makes an item of what `items` has for it, in this process, when the task is sent off. What
        it raises is the error of that task alone.
    folders : bool
        Whether `function` returns text or bytes by file name, for a folder ``<name>`` of each task.
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
    suffix, encode = ("", _files) if folders else (".json", _json)
    # Encoded beside the task, so that a result that cannot be kept fails its task.
    work = partial(_encoded, function, encode)
    resumed = tuple(name for name in items if (folder / f"{name}{suffix}").exists())
    found, failed, in_a_row = set(resumed), dict[str, str](), 0
    tell = progress or (lambda done, planned: None)
    with (
        _landing(folder, suffix) as land,
        closing(
            completed(
                work, items, read=read, names=[name for name in items if name not in found],
                workers=workers, scheduler=scheduler, announce=announce,
            )
        ) as coming,
    ):  # fmt: skip
        tell(len(found), len(items))
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
            if failed:
                text = json.dumps(failed, indent=1) + "\n"
                (folder / FAILED).write_text(text, encoding="utf-8")
            else:
                (folder / FAILED).unlink(missing_ok=True)
    seconds = read_seconds(folder)
    done = tuple(name for name in items if name in found)
    return Outcome(done, resumed, failed, {n: seconds[n] for n in done if n in seconds})


def _encoded(function: Callable[[Any], Any], encode: Callable[[Any], Any], item: Any) -> Any:
    return encode(function(item))


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


def check_names(names: Iterable[str]) -> None:
    """Check that every task can have a file of its name; a CalibError names one that cannot."""
    for name in names:
        fits = re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._+=-]{0,199}", name)
        if not fits or name in ("failed", SECONDS, FAILED):
            raise CalibError(
                f"{name!r} cannot be the name of a task",
                expected="up to 200 letters, digits and . _ + = -, starting with a letter or "
                "digit; not 'failed'",
                hint="rename it",
            )


@contextmanager
def _landing(folder: Path, suffix: str) -> Iterator[Callable[[Finished[Any]], None]]:
    """Yield a function that puts the result of a task into the folder, atomically.

    A process that is killed leaves results that are whole, and at most a scratch folder that the
    next one removes. Nothing is synced to the disk: a machine that loses power may lose the last
    seconds' results.
    """
    scratch = folder / ".landing"
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
                if isinstance(task.result, bytes):
                    part.write_bytes(task.result)
                else:
                    part.mkdir()
                    for file, content in (task.result or {}).items():
                        (part / file).parent.mkdir(parents=True, exist_ok=True)
                        (part / file).write_bytes(content)
                # The time first: whatever is there has one.
                clock.write(f"{task.name},{task.seconds:.6f}\n")
                clock.flush()
                part.replace(folder / f"{task.name}{suffix}")

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
