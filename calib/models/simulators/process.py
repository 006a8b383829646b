"""Programs and functions in processes of their own, which end at a limit of time.

A program is a child without a shell, in a process group of its own that ends with it.
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any
from uuid import uuid4

import psutil

from calib.batch.folders import check_room
from calib.batch.user_code import USER_MODULE
from calib.data.files import decoded
from calib.errors import CalibError
from calib.models.constants import END_BYTES, KILL_SECONDS
from calib.models.simulators.simulator import Failure, not_made, tail

# The environment variable with the folder of the simulator file.
HOME = "CALIB_SIMULATOR"


def run_program(
    arguments: Sequence[str], folder: Path, limit: float, *, whole: bool = True, home: str = ""
) -> Failure | str:
    """Run a program in a folder, and return what it printed (the end of it, if not the `whole`).

    It leads a process group, which is killed at its end, at the limit of seconds, and when this
    process is interrupted; on Linux so is what has left the group, known by a variable of its
    environment. A CalibError if it cannot be started, or if its surroundings and not its input have
    ended it.
    """
    path = folder / ".printed"
    mark = uuid4().hex
    with path.open("wb") as printed:
        try:
            child = subprocess.Popen(
                list(arguments), cwd=folder, stdin=subprocess.DEVNULL, stdout=printed,
                stderr=subprocess.STDOUT, start_new_session=True,
                env=os.environ | {"CALIB_RUN": mark} | ({HOME: home} if home else {}),
            )  # fmt: skip
        except OSError as error:
            why = _script(arguments[:1]) or error.strerror
            raise not_made(
                f"{arguments[0]} cannot be started ({why})", "make it a program that runs here"
            ) from None
        try:
            code: int | None = child.wait(limit)
        except subprocess.TimeoutExpired:
            code = None
        finally:
            _end(child, mark)
    if code is None:
        return Failure("time", f"it took longer than {limit:g} s", tail(_text(path, whole=False)))
    if code:
        end = tail(_text(path, whole=False))
        shells = ("sh", "bash", "dash", "ksh", "zsh", "env")
        of_shell = code in (126, 127) or Path(arguments[0]).stem in shells
        why = (_script(arguments) if of_shell else "") or _prevented(code, folder)
        if why:
            raise not_made(f"{_ended(code)}: {why}; it printed: {end.strip() or 'nothing'}")
        return Failure("exit", _ended(code), end)
    return _text(path, whole=whole)


def _prevented(code: int, folder: Path) -> str:
    """Return why a program was prevented from running, or an empty text."""
    # Signals sent by a shell, a scheduler or a system without memory.
    names = ("SIGKILL", "SIGTERM", "SIGHUP", "SIGINT", "SIGXFSZ")
    killed = [getattr(signal, name) for name in names if hasattr(signal, name)]
    # A shell that runs it adds 128 to the signal.
    if -code in killed or code - 128 in killed:
        return "something else has ended it; where memory is short, the system does"
    if code in (126, 127):  # of a shell or `env` whose program is missing or cannot be run
        return (
            f"a program that it starts is not there or cannot be run; it runs in {folder}, made "
            "for this run alone and removed after it, and finds its own files in the folder that "
            f"the variable {HOME} names"
        )
    try:
        check_room(folder)
    except CalibError as error:
        return error.message
    return ""


def _script(paths: Sequence[str]) -> str:
    """Say which script cannot run on this system, and why."""
    for path in filter(os.path.isfile, paths):
        with Path(path).open("rb") as file:
            head = file.readline(END_BYTES)
        if head.endswith(b"\r\n"):
            return (
                f"the lines of {path} end as on Windows (CR LF), and the system takes the CR for a "
                "part of a name: save it with the line ends of Unix"
            )
        words = head.removeprefix(b"#!").split()
        if head.startswith(b"#!") and words and not os.path.exists(words[0]):  # noqa: PTH110
            return f"the first line of {path} names {os.fsdecode(words[0])}, which is not there"
    return ""


def _text(path: Path, *, whole: bool) -> str:
    """Return what a program printed, or the end of it."""
    with path.open("rb") as printed:
        if not whole:
            printed.seek(max(path.stat().st_size - END_BYTES, 0))
        return decoded(printed.read(), "replace")


def call_function(function: Callable[..., Any], arguments: Sequence[Any], limit: float) -> Any:
    """Call a Python function in a process of its own, which is ended when the limit has passed.

    It is handed over with whatever it refers to; what it changes is lost. The limit in seconds
    includes the start of the process. A CalibError if the function cannot be handed over.
    """
    with tempfile.TemporaryDirectory(prefix="calib-run-", ignore_cleanup_errors=True) as name:
        scratch = Path(name)
        given, taken = scratch / "call", scratch / "result"
        given.write_bytes(
            pickle.dumps((str(Path.cwd()), sys.path, _handed_over(function, arguments)))
        )
        child = Path(__file__).with_name("child.py")
        started = [sys.executable, "-P", str(child), str(given), str(taken)]
        printed = run_program(started, scratch, limit, whole=False)
        if isinstance(printed, Failure):
            return printed
        found, raised, elsewhere = pickle.loads(taken.read_bytes())
    if elsewhere:
        raise not_made(raised)
    return found if raised is None else Failure("error", raised, tail(printed))


def _handed_over(function: Callable[..., Any], arguments: Sequence[Any]) -> bytes:
    import cloudpickle

    # Another process cannot import a file that was loaded by its path.
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
            hint="open files and connections inside it, or give no limit of time",
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


def _end(child: subprocess.Popen[bytes], mark: str) -> None:
    """Kill the child's group and what has left it, and reap the child."""
    with suppress(ProcessLookupError, PermissionError):
        if sys.platform == "win32":
            child.kill()
        else:
            os.killpg(child.pid, signal.SIGKILL)
    # A killed process may hang in the kernel.
    with suppress(subprocess.TimeoutExpired):
        child.wait(KILL_SECONDS)
    # A killed process may have started another.
    until = time.monotonic() + KILL_SECONDS
    while (left := _marked(mark)) and time.monotonic() < until:
        for process in left:
            with suppress(psutil.Error):
                process.kill()
        time.sleep(0.01)


def _marked(mark: str) -> list[psutil.Process]:
    """Return the processes with a mark in their environment; not those of other users."""
    running = psutil.process_iter(["environ"])
    return [
        one for one in running
        if (one.info["environ"] or {}).get("CALIB_RUN") == mark
    ]  # fmt: skip
