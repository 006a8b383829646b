"""The command line: every command with an example, and how an error ends it."""

from __future__ import annotations

import errno
import sys
import traceback
from collections.abc import Callable, Mapping
from typing import Annotated, Any

import typer

from calib.cli import (
    INTERRUPTED,
    STOPPED,
    calibration,
    campaign,
    check,
    declared,
    export,
    imports,
    interrupted,
    joint,
    options,
    plan,
    prediction,
)
from calib.errors import CalibError


class _Commands(options.Group):
    """All commands: what the user can put right, or stops, ends with a line and no traceback."""

    def invoke(self, ctx: Any) -> Any:
        from calib.batch import folders

        folders.saved.clear()
        interrupted.clear()
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt as stop:
            why, code = str(stop), INTERRUPTED
        except CalibError as error:
            why, code = str(error), 2
            if ctx.params["verbose"]:
                traceback.print_exc()
        except Exception as error:
            why, code = _unwritable(error), 2
            if interrupted:
                why, code = "", INTERRUPTED
            elif not why:
                raise
        why = why or ("interrupted" if folders.saved else STOPPED)
        print(f"calib: {why}", file=sys.stderr)
        for folder in folders.saved:
            print(f"calib: what was finished is in {folder}", file=sys.stderr)
        raise typer.Exit(code)


def _unwritable(error: Exception) -> str:
    """Say of a file that cannot be written why, and what to do; of another error nothing."""
    from calib.batch.folders import NO_ROOM

    if not isinstance(error, OSError):
        return ""
    # NumPy gives no number for a full disk.
    if error.errno not in (*NO_ROOM, errno.EACCES, errno.EPERM, None):
        return ""
    return (
        f"{error.filename or 'a file'} cannot be written ({error.strerror or error}): "
        "make room, or change its permissions"
    )


app = typer.Typer(
    name="calib",
    cls=_Commands,
    help="Probabilistic calibration of tyre-soil models.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
)
# Commands with an example each, in groups as the help shows them.
_COMMANDS: Mapping[str, Mapping[Callable[..., None], str]] = {
    "Everyday": {
        imports.import_: "import run7.xlsx --out my.csv",
        calibration.fit: "fit my.csv --model magic_formula_pressure --out run",
        joint.joint: "joint plates.csv --model bekker --group bin --pool z_ref --out bins",
        prediction.predict: "predict run --at conditions.csv --out predicted.csv",
        plan.plan: "plan run --grid conditions.csv --budget 6 --out tests.csv",
        export.export: "export run --at inflation_pressure_psi=30 --out tyre.tir",
        calibration.report: "report my.csv --hold-out inflation_pressure_psi=30 --out report",
        calibration.compare: "compare bekker reece plates.csv --hold-out plate_width_mm=80 "
        "--out compared",
        prediction.diagnose: "diagnose --run run --field field.csv --out diagnosis",
    },
    "Look up": {
        declared.models: "models magic_formula",
        declared.effects: "effects slip_sinkage",
        declared.quantities: "quantities rut_depth --json",
        declared.template: "template magic_formula_pressure --out my.csv",
        declared.priors: "priors magic_formula_pressure --out my.toml",
        declared.data: "data he2019-gaps --out cases",
    },
    "Verify": {
        check.check: "check run --json > check.json",
        check.validate: "validate run my.csv",
        check.doctor: "doctor --quick",
        check.audit: "audit --out audit",
        campaign.sbc: "sbc --model bekker --simulations 100 --out sbc",
    },
    "Many runs, and work on calib": {
        campaign.campaign: "campaign plan.toml --out results --workers 2",
    },
}
for panel, commands in _COMMANDS.items():
    for command, example in commands.items():
        app.command(
            command.__name__.rstrip("_"),  # `import` is a word of Python
            cls=options.Command, rich_help_panel=panel, epilog=f"Example: calib {example}",
        )(command)  # fmt: skip
app.add_typer(campaign.challenge, name="challenge", rich_help_panel=panel)


def _version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        print(f"calib {version('terracalib')}")
        raise typer.Exit


@app.callback()
def start(
    ctx: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", help="Print the version and exit.", callback=_version,
                           is_eager=True)
    ] = False,
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="Log versions, files read and times to "
                           "standard error, and show where an error came from.")
    ] = False,
    quiet: Annotated[
        bool, typer.Option("--quiet", "-q", help="Print only warnings and errors.")
    ] = False,
) -> None:  # fmt: skip
    """Probabilistic calibration of tyre-soil models."""
    if quiet:
        options.silence(ctx)
    if verbose:
        ctx.with_resource(options.told())
