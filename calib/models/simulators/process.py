"""A program as a child: no shell, a group of its own that ends with it, a limit of time."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from calib.batch.plugins import USER_MODULE
from calib.errors import CalibError
from calib.models.simulators.base import Failure, tail

_PRINTED = ".printed"


def run_program(arguments: Sequence[str], folder: Path, limit: float) -> Failure | str:
    """Run a program in a folder and wait for it, so many seconds at the most.

    Return what it printed, or why it failed. It leads a process group (a session of its own), which
    is killed when it has come to its end, when the limit has passed, and when this process is
    interrupted: what it started ends with it.

    Raises
    ------
    CalibError
        If it cannot be started.
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


def call_function(function: Callable[..., Any], arguments: Sequence[Any], limit: float) -> Any:
    """Call a Python function in a process of its own, which is ended when the limit has passed.

    It is handed over with whatever it refers to, as it is now: what it changes is lost. The limit
    is in seconds, the start of the process (a third of one, and what the function imports)
    included.

    Raises
    ------
    CalibError
        If it cannot be handed over.
    """
    with tempfile.TemporaryDirectory(prefix="calib-run-", ignore_cleanup_errors=True) as name:
        scratch = Path(name)
        given, taken = scratch / "call", scratch / "result"
        given.write_bytes(
            pickle.dumps((str(Path.cwd()), sys.path, _handed_over(function, arguments)))
        )
        child = Path(__file__).with_name("child.py")
        started = [sys.executable, "-P", str(child), str(given), str(taken)]
        printed = run_program(started, scratch, limit)
        if isinstance(printed, Failure):
            return printed
        found, raised = pickle.loads(taken.read_bytes())
    return found if raised is None else Failure("error", raised, tail(printed))


def _handed_over(function: Callable[..., Any], arguments: Sequence[Any]) -> bytes:
    import cloudpickle

    # Of a file that was loaded by its path another process knows nothing.
    module = sys.modules.get(getattr(function, "__module__", ""))
    by_path = module is not None and module.__name__.startswith(USER_MODULE)
    try:
        if by_path:
            cloudpickle.register_pickle_by_value(module)
        return bytes(cloudpickle.dumps((function, tuple(arguments))))
    except (TypeError, pickle.PicklingError) as error:
        raise CalibError(
            f"the function cannot be handed to a process of its own ({error})",
            where=getattr(function, "__qualname__", repr(function)),
            mend="open files and connections inside it, or give no limit of time",
        ) from None
    finally:
        if by_path:
            cloudpickle.unregister_pickle_by_value(module)


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
