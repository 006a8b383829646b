"""The `calib` command: its entry, which imports nothing before it can be interrupted politely."""

from __future__ import annotations

import atexit
import codecs
import gc
import io
import os
import signal
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from threading import Timer
from typing import Any

__all__ = ["INTERRUPTED", "STOPPED", "interruptible", "main", "program", "was_interrupted"]

INTERRUPTED = 130
# What was printed could not be written, although files were.
LOST = 2
_came: list[bool] = []
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
    signal.signal(signal.SIGTERM, _interrupt)
    # So does a terminal that is closed.
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is signal.SIG_DFL:
        signal.signal(signal.SIGHUP, _interrupt)
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _interrupt)
    usual = sys.unraisablehook
    sys.unraisablehook = partial(_interrupt_again, usual)
    before, outputs = (sys.stdout, sys.stderr), _lasting_outputs()
    try:
        command(sys.argv[1] if len(sys.argv) > 1 else "")(prog_name="calib")
    finally:
        sys.unraisablehook = usual
        lost = _is_lost(outputs)
        sys.stdout, sys.stderr = before
        if lost:
            raise SystemExit(LOST)


def program() -> None:
    """Run the command line in a process of its own, which ends at once when it is stopped."""
    # In the background of a shell Ctrl-C is ignored, and stays so.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _stop)
    outputs = _lasting_outputs()
    try:
        main()
    except SystemExit as ended:
        code = LOST if _is_lost(outputs) else ended.code
        if isinstance(ended.code, str) or _others_at_work():
            raise SystemExit(code) from None
        # The interpreter would take long to give back, one by one, what it holds.
        atexit._run_exitfuncs()
        for output in outputs:
            output.flush()
        os._exit(int(code or 0))


def _others_at_work() -> bool:
    """Whether threads, or code that is not calib's, may still have something to do or to write."""
    plugins: Any = sys.modules.get("calib.batch.plugins")
    threads = set(threading.enumerate()) - {threading.main_thread()}
    return any(not t.daemon for t in threads) or (plugins is not None and plugins.others_loaded())


class _Output(io.TextIOWrapper):
    """An output that the work does not depend on.

    What its encoding lacks is written otherwise; where nobody reads it any more, or its disk is
    full, the rest goes nowhere.
    """

    lost: OSError | None = None

    def write(self, text: str) -> int:
        try:
            return super().write(text)
        except OSError as error:
            self._go_nowhere(error)
        return len(text)

    def flush(self) -> None:
        try:
            super().flush()
        except OSError as error:
            self._go_nowhere(error)

    def __del__(self) -> None:
        """Leave open what is another's."""

    def _go_nowhere(self, error: OSError) -> None:
        self.lost = self.lost or error
        with suppress(OSError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), self.fileno())
            super().flush()


def _lasting_outputs() -> list[_Output]:
    """Print to outputs that the work does not depend on, and return those that are new."""
    codecs.register_error(_READABLE, _readable)
    made = []
    for name in ("stdout", "stderr"):
        usual = getattr(sys, name)
        if hasattr(usual, "buffer") and not isinstance(usual, _Output):
            usual.flush()
            output = _Output(usual.buffer, usual.encoding, _READABLE, line_buffering=usual.isatty())
            setattr(sys, name, output)
            made.append(output)
    return made


def _is_lost(outputs: list[_Output]) -> bool:
    """Whether something printed went nowhere, which is said; a reader that leaves has enough."""
    for output in outputs:
        output.flush()
        if output.lost is not None and not isinstance(output.lost, BrokenPipeError):
            why = f"calib: what was printed is lost ({output.lost.strerror}); files are written\n"
            with suppress(OSError):
                os.write(2, why.encode())
            return True
    return False


_READABLE = "calib.readable"
_SIGNS = {
    "\N{MINUS SIGN}": "-", "\N{EN DASH}": "-", "\N{EM DASH}": "-", "\N{MULTIPLICATION SIGN}": "x",
    "\N{PLUS-MINUS SIGN}": "+-", "\N{MIDDLE DOT}": "*", "\N{RIGHTWARDS ARROW}": "->",
    "\N{LESS-THAN OR EQUAL TO}": "<=", "\N{GREATER-THAN OR EQUAL TO}": ">=",
    "\N{ALMOST EQUAL TO}": "~", "\N{SQUARE ROOT}": "sqrt",
}  # fmt: skip


def _readable(error: UnicodeError) -> tuple[str, int]:
    """Return what stands for characters that an encoding lacks: theta, 10^-7, or their codes."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    import unicodedata

    written, was_raised = "", False
    for character in error.object[error.start : error.end]:
        raised = unicodedata.decomposition(character).startswith("<super>")
        plain = ""
        for part in unicodedata.normalize("NFKD", character):
            words = unicodedata.name(part, "").split()
            letter = words[-1].lower() if words[:1] == ["GREEK"] else ""
            plain += _SIGNS.get(part, part if part.isascii() else letter)
        code = character.encode("ascii", "backslashreplace").decode()
        written += "^" * (raised and not was_raised) + (plain or code)
        was_raised = raised
    return written, error.end


def _open_what_is_closed() -> None:
    """Have a place to print to where there is none, as of a job that closed its output."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: PTH123, SIM115


def interruptible() -> None:
    """Make Ctrl-C an exception, which cleans up: from here on there may be something to."""
    _came.clear()
    if signal.getsignal(signal.SIGINT) is _stop:
        signal.signal(signal.SIGINT, _interrupt)


def _interrupt(*_: object) -> None:
    _came.append(True)
    raise KeyboardInterrupt


def was_interrupted() -> bool:
    """Whether an interruption came, whatever the code that it came in has made of it."""
    return bool(_came)


def _stop(*_: object) -> None:
    """End while the commands are imported, where an exception would come out as any other."""
    os.write(2, f"calib: {STOPPED}\n".encode())
    os._exit(INTERRUPTED)


def _interrupt_again(usual: Callable[[Any], object], lost: Any) -> None:
    """Interrupt anew after one that came where Python raises nothing: in a callback, say."""
    if issubclass(lost.exc_type, KeyboardInterrupt):
        # Not from here, where it would be lost as well.
        Timer(0.01, os.kill, (os.getpid(), signal.SIGINT)).start()
    else:
        usual(lost)
