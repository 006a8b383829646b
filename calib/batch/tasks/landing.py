"""Where results land: a file or a folder for each task, whole or not there at all."""

from __future__ import annotations

import json
import re
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath
from typing import Any, Protocol, cast

from calib.batch.folders import unwritable
from calib.batch.tasks.attempt import Finished
from calib.errors import CalibError

FAILED = "failed.json"
SECONDS = "seconds.csv"
_SCRATCH = ".landing"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._+=-]{0,199}")


class Landing[R, C](Protocol):
    """A way to keep the result of a task.

    `encode` runs beside the task, so that results that cannot be kept fail their task, and the
    work is shared; the other two run in the one process that writes.
    """

    folder: Path

    @staticmethod
    def encode(result: R) -> C:
        """Return what is kept of a result; picklable."""

    def path(self, name: str) -> Path:
        """Return where the result of a task is, if it is there."""

    def write(self, content: C, scratch: Path) -> None:
        """Write a result to a path that does not exist yet."""


class JsonFiles:
    """Results that are JSON-able mappings, each in ``<name>.json``."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @staticmethod
    def encode(result: Mapping[str, Any]) -> str:
        """Return JSON text; NaN and infinity, which other programs could not read, are refused."""
        return json.dumps(result, indent=1, allow_nan=False) + "\n"

    def path(self, name: str) -> Path:
        """Return the path of a task's file."""
        return self.folder / f"{name}.json"

    def write(self, content: str, scratch: Path) -> None:
        """Write a file."""
        scratch.write_text(content, encoding="utf-8")


class Folders:
    """Results that are files by relative name, each task's in a folder of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @staticmethod
    def encode(result: Mapping[str, str | bytes]) -> dict[str, bytes]:
        """Return the files' bytes; a name that leads out of the folder is refused."""
        for file in result:
            path = PurePosixPath(file)
            if path.is_absolute() or ".." in path.parts or not path.parts:
                raise ValueError(f"a task may not write {file!r}: it is not inside its folder")
        return {f: c.encode() if isinstance(c, str) else bytes(c) for f, c in result.items()}

    def path(self, name: str) -> Path:
        """Return the path of a task's folder."""
        return self.folder / name

    def write(self, content: Mapping[str, bytes], scratch: Path) -> None:
        """Write a folder."""
        scratch.mkdir()
        for file, data in content.items():
            path = scratch / file
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)


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
def landing_ground[C](landing: Landing[Any, C]) -> Iterator[Callable[[Finished[C]], None]]:
    """Yield a function that lands the result of a task that did not fail, atomically.

    A process that is killed leaves results that are whole, and at most a scratch folder that the
    next one removes. Nothing is synced to the disk: a machine that loses power may lose the last
    seconds' results.

    Raises
    ------
    CalibError
        If the folder cannot be written, or another process is landing results in it.
    """
    folder = landing.folder
    scratch = folder / _SCRATCH
    with _io(folder):
        folder.mkdir(parents=True, exist_ok=True)
    with _alone(folder):
        with _io(folder):
            shutil.rmtree(scratch, ignore_errors=True)
            scratch.mkdir()
            clock = (folder / SECONDS).open("a+", encoding="utf-8")
            clock.seek(0)
            if (times := clock.read()) and not times.endswith("\n"):
                clock.write("\n")  # after a line that a kill has cut short

        def land(task: Finished[C]) -> None:
            part = scratch / task.name
            with _io(folder):
                landing.write(cast(C, task.result), part)
                # The time first: whatever has landed has one.
                clock.write(f"{task.name},{task.seconds:.6f}\n")
                clock.flush()
                part.replace(landing.path(task.name))

        try:
            yield land
        finally:
            clock.close()
            shutil.rmtree(scratch, ignore_errors=True)


def failed_tasks(folder: Path) -> dict[str, str]:
    """Return the errors of the tasks that failed when they were last tried."""
    path = folder / FAILED
    found: dict[str, str] = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
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
def _io(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise unwritable(folder, error.strerror or str(error)) from error


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Hold the folder's lock, which the system releases however the process ends."""
    if sys.platform == "win32":
        yield
        return
    import fcntl
    import os

    with _io(folder):
        handle = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise CalibError(
                "another process is writing results to this folder",
                where=str(folder),
                mend="wait until it ends, or stop it",
            ) from None
        yield
    finally:
        os.close(handle)
