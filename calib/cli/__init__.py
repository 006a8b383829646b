"""The `calib` command: thin, every verb one call into the package, heavy imports only when used."""

from __future__ import annotations

import atexit
import os
import signal
import sys
from collections.abc import Callable
from functools import partial
from threading import Timer
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

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
from calib.cli.examples import add_examples

__all__ = ["app", "main", "program"]


class _Verbs(TyperGroup):
    """All verbs: what the user can mend, or stops, ends with a line and no traceback."""

    def invoke(self, ctx: Any) -> Any:
        from calib.errors import CalibError

        try:
            return super().invoke(ctx)
        except CalibError as error:
            if ctx.params["verbose"]:
                import traceback

                traceback.print_exc()
            print(f"calib: {error}", file=sys.stderr)
            raise typer.Exit(2) from None
        except KeyboardInterrupt as stop:
            print(f"calib: {str(stop) or _STOPPED}", file=sys.stderr)
            raise typer.Exit(_INTERRUPTED) from None


_INTERRUPTED = 130
_STOPPED = (
    "interrupted; nothing was written. Start the same command again; what a simulator has run "
    "is kept and not run again"
)

app = typer.Typer(
    name="calib",
    cls=_Verbs,
    help="Probabilistic calibration of tyre-soil models.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
)
for verb in (
    calibration.report, calibration.fit, calibration.predict, calibration.data,
    calibration.template, calibration.priors, calibration.models, compare.compare, gap.diagnose,
    check.check, audit.audit, campaign.campaign, sbc.sbc, doctor.doctor,
):  # fmt: skip
    app.command()(verb)
app.add_typer(challenge.verbs, name="challenge")
add_examples(app)


def _version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        print(f"calib {version('terracalib')}")
        raise typer.Exit


@app.callback()
def start(
    ctx: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", help="Say which, and stop.", callback=_version,
                           is_eager=True)
    ] = False,
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="Say on the error output with what versions, "
                           "what was read and how long it took; where an error came from.")
    ] = False,
) -> None:  # fmt: skip
    """Probabilistic calibration of tyre-soil models."""
    if verbose:
        from calib.cli.display import told

        ctx.with_resource(told())


def main() -> None:
    """Run the command line."""
    # A figure is never shown on a screen: no display, no toolkit.
    os.environ.setdefault("MPLBACKEND", "Agg")
    # The matrices are small: threads of the linear algebra would only wait for each other.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # A polite kill cleans up as an interrupt does.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    usual = sys.unraisablehook
    sys.unraisablehook = partial(_interrupt_again, usual)
    try:
        app(prog_name="calib")
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(0) from None
    finally:
        sys.unraisablehook = usual


def program() -> None:
    """Run the command line in a process of its own, which ends at once when it is stopped."""
    try:
        main()
    except SystemExit as ended:
        if ended.code == _INTERRUPTED:
            # The interpreter would take as long again to give back, one by one, what it holds.
            atexit._run_exitfuncs()
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(_INTERRUPTED)
        raise


def _interrupt_again(usual: Callable[[Any], object], lost: Any) -> None:
    """Interrupt anew after one that came where Python raises nothing: in a callback, say."""
    if issubclass(lost.exc_type, KeyboardInterrupt):
        # Not from here, where it would be lost as well.
        Timer(0.01, os.kill, (os.getpid(), signal.SIGINT)).start()
    else:
        usual(lost)
