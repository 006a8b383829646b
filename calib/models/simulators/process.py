"""A program as a child: no shell, a group of its own that ends with it, a limit of time."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from calib.errors import CalibError
from calib.models.simulators.base import Failure, tail

__all__ = ["run_program"]

_PRINTED = ".printed"


def run_program(arguments: Sequence[str], folder: Path, limit: float) -> Failure | str:
    """Run a program in a folder and wait for it.

    Parameters
    ----------
    arguments : sequence of str
    folder : Path
        Its working directory.
    limit : float
        Seconds.

    Returns
    -------
    str or Failure
        What it printed, or why it failed.

    Raises
    ------
    CalibError
        If it cannot be started.

    Notes
    -----
    It leads a process group (a session of its own), which is killed when it has come to its end,
    when the limit has passed, and when this process is interrupted: what it started ends with it.
    """
    path = folder / _PRINTED
    with path.open("wb") as printed:
        try:
            child = subprocess.Popen(
                list(arguments), cwd=folder, stdin=subprocess.DEVNULL, stdout=printed,
                stderr=subprocess.STDOUT, start_new_session=True,
            )  # fmt: skip
        except OSError as error:
            # No fault of the parameters: nothing is learned from it.
            raise CalibError(
                f"{arguments[0]} cannot be started ({error.strerror})",
                mend="make it a program that can be run here; the runs that were made are kept",
            ) from None
        try:
            code: int | None = child.wait(limit)
        except subprocess.TimeoutExpired:
            code = None
        finally:
            _end(child)
    text = path.read_text(encoding="utf-8", errors="replace")
    if code is None:
        return Failure("time", f"it took longer than {limit:g} s", tail(text))
    if code:
        return Failure("exit", _ended(code), tail(text))
    return text


def _ended(code: int) -> str:
    if code > 0:
        return f"it ended with exit code {code}"
    with suppress(ValueError):
        return f"it was killed by the signal {signal.Signals(-code).name}"
    return f"it was killed by the signal {-code}"


def _end(child: subprocess.Popen[bytes]) -> None:
    """Kill what is left of the child's group, and collect the child."""
    with suppress(ProcessLookupError, PermissionError):
        if sys.platform == "win32":
            child.kill()
        else:
            os.killpg(child.pid, signal.SIGKILL)
    child.wait()
