"""Where results land: a file or a folder for each task, whole or not there at all."""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from calib.batch.folders import check_room, lock, writing
from calib.batch.tasks.stream import Finished
from calib.errors import CalibError

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
                allowed="up to 200 letters, digits and . _ + = -, starting with a letter or "
                "digit; not 'failed'",
                mend="rename it",
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
            mend="wait until it ends, or stop it",
        ) from None
    try:
        yield
    finally:
        if held is not None:
            os.close(held)
