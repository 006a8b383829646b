"""The `calib` command: its entry, which suits any terminal and ends every interruption politely."""

from __future__ import annotations

import codecs
import io
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress

__all__ = ["INTERRUPTED", "STOPPED", "interrupted", "main", "program"]

INTERRUPTED = 130
STOPPED = (
    "interrupted; nothing was written. Start the same command again; what simulators of your own "
    "have run, if there are any, is kept and not run again"
)
# Signals that came: code that was interrupted may turn KeyboardInterrupt into an error of its own,
# as extension modules do while they are imported.
interrupted: list[int] = []


def main() -> None:
    """Run the command line."""
    # A figure is never shown on a screen: no display, no toolkit.
    os.environ.setdefault("MPLBACKEND", "Agg")
    # The matrices are small: threads of the linear algebra would only wait for each other.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # A polite kill and a closed terminal clean up as Ctrl-C does, unless they are ignored.
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)
        if number and signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler):
            signal.signal(number, _interrupt)
    with _lasting_outputs():
        try:
            from calib.cli.app import app

            app(prog_name="calib")
        except KeyboardInterrupt:
            pass
        except Exception:
            if not interrupted:
                raise
        print(f"calib: {STOPPED}", file=sys.stderr)
        raise SystemExit(INTERRUPTED)


def _interrupt(number: int, _: object) -> None:
    interrupted.append(number)
    raise KeyboardInterrupt


class _Output(io.TextIOWrapper):
    """An output that the work does not depend on.

    What its encoding lacks is written otherwise. Where nobody reads it any more, or its disk is
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

    def _go_nowhere(self, error: OSError) -> None:
        self.lost = self.lost or error
        with suppress(OSError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), self.fileno())
            super().flush()


@contextmanager
def _lasting_outputs() -> Iterator[None]:
    """Print to outputs that the work does not depend on; end with 2 if something printed is lost.

    A reader that leaves has enough: that is no loss.
    """
    codecs.register_error("calib.readable", _readable)
    usual = {name: getattr(sys, name) for name in ("stdout", "stderr")}
    outputs = []
    for name, stream in usual.items():
        if stream is None:  # closed, as by a job
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: PTH123, SIM115
        elif hasattr(stream, "buffer"):
            stream.flush()
            lines = stream.isatty()
            output = _Output(stream.buffer, stream.encoding, "calib.readable", line_buffering=lines)
            setattr(sys, name, output)
            outputs.append(output)
    try:
        yield
    finally:
        for output in outputs:
            output.flush()
            output.detach()
        for name, stream in usual.items():
            setattr(sys, name, stream)
        for error in (output.lost for output in outputs):
            if error is not None and not isinstance(error, BrokenPipeError):
                said = f"calib: what was printed is lost ({error.strerror}); files are written\n"
                with suppress(OSError):
                    os.write(2, said.encode())
                raise SystemExit(2)


def _readable(error: UnicodeError) -> tuple[str, int]:
    """Return what stands for characters that an encoding lacks: theta, 10^-7, or their codes."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    import unicodedata

    signs = {
        "\N{MINUS SIGN}": "-", "\N{EN DASH}": "-", "\N{EM DASH}": "-",
        "\N{MULTIPLICATION SIGN}": "x", "\N{PLUS-MINUS SIGN}": "+-", "\N{MIDDLE DOT}": "*",
        "\N{RIGHTWARDS ARROW}": "->", "\N{LESS-THAN OR EQUAL TO}": "<=",
        "\N{GREATER-THAN OR EQUAL TO}": ">=", "\N{ALMOST EQUAL TO}": "~", "\N{SQUARE ROOT}": "sqrt",
    }  # fmt: skip
    written, was_raised = "", False
    for character in error.object[error.start : error.end]:
        raised = unicodedata.decomposition(character).startswith("<super>")
        plain = ""
        for part in unicodedata.normalize("NFKD", character):
            words = unicodedata.name(part, "").split()
            letter = words[-1].lower() if words[:1] == ["GREEK"] else ""
            plain += signs.get(part, part if part.isascii() else letter)
        code = character.encode("ascii", "backslashreplace").decode()
        written += "^" * (raised and not was_raised) + (plain or code)
        was_raised = raised
    return written, error.end
