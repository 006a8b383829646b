"""The `calib` command: thin, every verb one call into the package, heavy imports only when used."""

from __future__ import annotations

import os
import signal
import sys

import typer

from calib.cli import (
    audit,
    calibration,
    campaign,
    challenge,
    check,
    compare,
    doctor,
    gap,
    sbc,
)

__all__ = ["app", "main"]

app = typer.Typer(
    name="calib",
    help="Probabilistic calibration of tyre-soil models.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
)
calibration.register(app)
compare.register(app)
gap.register(app)
challenge.register(app)
check.register(app)
audit.register(app)
campaign.register(app)
sbc.register(app)
doctor.register(app)


def main() -> None:
    """Run the command line: what the user can mend ends with exit code 2 and no traceback."""
    from calib.errors import CalibError

    # A figure is never shown on a screen: no display, no toolkit.
    os.environ.setdefault("MPLBACKEND", "Agg")
    # The matrices are small: threads of the linear algebra would only wait for each other.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # A polite kill cleans up as an interrupt does.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        app(prog_name="calib")
    except CalibError as error:
        print(f"calib: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    except KeyboardInterrupt:
        print("calib: interrupted; nothing was written", file=sys.stderr)
        raise SystemExit(130) from None
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(0) from None
