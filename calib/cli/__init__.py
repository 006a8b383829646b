"""The `calib` command: its entry, which imports nothing before it can be interrupted politely."""

from __future__ import annotations

import atexit
import gc
import os
import signal
import sys
import threading
from collections.abc import Callable
from functools import partial
from threading import Timer
from typing import Any

__all__ = ["INTERRUPTED", "STOPPED", "interruptible", "main", "program"]

INTERRUPTED = 130
STOPPED = (
    "interrupted; nothing was written. Start the same command again; what simulators of your own "
    "have run, if there are any, is kept and not run again"
)


def main() -> None:
    """Run the command line."""
    # A figure is never shown on a screen: no display, no toolkit.
    os.environ.setdefault("MPLBACKEND", "Agg")
    # The matrices are small: threads of the linear algebra would only wait for each other.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Little of what is made is garbage that refers to itself: to look for it takes a twelfth of a
    # report's time as Python does by default, after every 700 objects.
    gc.set_threshold(20_000, 20)
    _open_what_is_closed()
    from calib.cli.verbs import command

    # A polite kill cleans up as an interrupt does.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    usual = sys.unraisablehook
    sys.unraisablehook = partial(_interrupt_again, usual)
    try:
        command(sys.argv[1] if len(sys.argv) > 1 else "")(prog_name="calib")
    except BrokenPipeError:
        _print_nowhere()
        raise SystemExit(0) from None
    finally:
        sys.unraisablehook = usual


def program() -> None:
    """Run the command line in a process of its own, which ends at once when it is stopped."""
    # In the background of a shell Ctrl-C is ignored, and stays so.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _stop)
    try:
        main()
    except SystemExit as ended:
        written = _written()
        if ended.code == INTERRUPTED:
            _end_server()
        elif isinstance(ended.code, str) or _others_at_work() or not written:
            raise
        # The interpreter would take long to give back, one by one, what it holds.
        atexit._run_exitfuncs()
        os._exit(ended.code or 0)


def _others_at_work() -> bool:
    """Whether threads, or code that is not calib's, may still have something to do or to write."""
    plugins: Any = sys.modules.get("calib.batch.plugins")
    threads = set(threading.enumerate()) - {threading.main_thread()}
    return any(not t.daemon for t in threads) or (plugins is not None and plugins.others_loaded())


def _written() -> bool:
    """Whether what was printed has gone out; what has not is for the interpreter to say."""
    try:
        for stream in (sys.stdout, sys.stderr):
            if stream is not None:
                stream.flush()
    except BrokenPipeError:  # nobody reads it any more
        _print_nowhere()
    except OSError:
        return False
    return True


def _open_what_is_closed() -> None:
    """Have a place to print to where there is none, as of a job that closed its output."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: PTH123, SIM115


def _print_nowhere() -> None:
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def interruptible() -> None:
    """Make Ctrl-C an exception, which cleans up: from here on there may be something to."""
    if signal.getsignal(signal.SIGINT) is _stop:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _stop(*_: object) -> None:
    """End while the commands are imported, where an exception would come out as any other."""
    os.write(2, f"calib: {STOPPED}\n".encode())
    _end_server()
    os._exit(INTERRUPTED)


def _end_server() -> None:
    """End what processes are forked from, if it was begun: nothing is imported for that."""
    end = getattr(sys.modules.get("calib.batch.pool"), "end_server", None)
    if end is not None:
        end()


def _interrupt_again(usual: Callable[[Any], object], lost: Any) -> None:
    """Interrupt anew after one that came where Python raises nothing: in a callback, say."""
    if issubclass(lost.exc_type, KeyboardInterrupt):
        # Not from here, where it would be lost as well.
        Timer(0.01, os.kill, (os.getpid(), signal.SIGINT)).start()
    else:
        usual(lost)
