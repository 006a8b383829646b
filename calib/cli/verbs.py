"""The command line: every command with an example, and how an error ends it."""

from __future__ import annotations

import errno
import sys
from collections.abc import Iterable
from copy import copy
from functools import cache
from typing import Annotated, Any, Never

import typer
from typer.core import TyperGroup

from calib.cli import (
    INTERRUPTED,
    STOPPED,
    calibration,
    campaign,
    check,
    gap,
    interruptible,
    machine,
    options,
    predict,
    was_interrupted,
)

EXAMPLES = {
    "report": "calib report my.csv --hold-out inflation_pressure_psi=30 --out report",
    "fit": "calib fit my.csv --model magic_formula_pressure --out run",
    "predict": "calib predict run --at conditions.csv --out predicted.csv",
    "data": "calib data he2019-gaps --out cases",
    "template": "calib template magic_formula_pressure --out my.csv",
    "priors": "calib priors magic_formula_pressure --out my.toml",
    "models": "calib models magic_formula",
    "effects": "calib effects slip_sinkage",
    "quantities": "calib quantities rut_depth --json",
    "compare": "calib compare bekker reece plates.csv --hold-out plate_width_mm=80 --out compared",
    "diagnose": "calib diagnose --run run --field field.csv --out diagnosis",
    "check": "calib check run --json > check.json",
    "audit": "calib audit --out audit",
    "campaign": "calib campaign plan.toml --out results --workers 2",
    "sbc": "calib sbc --model bekker --simulations 100 --out sbc",
    "doctor": "calib doctor --quick",
    "make": "calib challenge make --out cases --key key.json --seed 1 --cases 20",
    "run": "calib challenge run cases --out diagnoses",
    "well-specified": "calib challenge well-specified cases --key key.json --out plain --out-key "
    "plain.json",
    "score": "calib challenge score cases --results diagnoses --key key.json",
}


def add_examples(app: typer.Typer) -> None:
    """Put an example under the help of every verb of an app."""
    for command in _commands(app):
        name = command.name or str(getattr(command.callback, "__name__", ""))
        command.epilog = f"Example: {EXAMPLES[name]}"


def _commands(app: typer.Typer) -> Iterable[typer.models.CommandInfo]:
    yield from app.registered_commands
    for group in app.registered_groups:
        if group.typer_instance is not None:
            yield from _commands(group.typer_instance)


class _Verbs(TyperGroup):
    """All verbs: what the user can mend, or stops, ends with a line and no traceback."""

    def invoke(self, ctx: Any) -> Any:
        from calib.batch import foreign
        from calib.batch.folders import NO_ROOM
        from calib.errors import CalibError

        foreign.saved.clear()
        _seen().clear()
        try:
            interruptible()
            found = super().invoke(ctx)
            _tell_data()
            return found
        except KeyboardInterrupt as stop:
            _end(str(stop) or _stopped(), INTERRUPTED)
        except typer.Exit:
            # It did not converge, or a check found something.
            _tell_data()
            raise
        except Exception as error:
            if was_interrupted():  # in code that has made another error of it
                _end(_stopped(), INTERRUPTED)
            if isinstance(error, CalibError):
                if ctx.params["verbose"]:
                    import traceback

                    traceback.print_exc()
                _end(str(error), 2)
            # Of a disk that fills up while something is written nothing more can be known before.
            known = (*NO_ROOM, errno.EACCES, errno.EPERM, None)
            if not isinstance(error, OSError) or error.errno not in known:
                raise
            _end(
                f"{error.filename or 'a file'} cannot be written ({error.strerror or error}): "
                "make room, or change its permissions", 2,
            )  # fmt: skip


def _stopped() -> str:
    from calib.batch import foreign

    return "interrupted" if foreign.saved else STOPPED


def _tell_data() -> None:
    """Say of which known data a command has read: no others tell it that these are no others."""
    for label in _seen():
        from calib.data.reader import said_of

        print(f"calib: {label} data: {said_of(label)}", file=sys.stderr)


def _seen() -> dict[str, None]:
    """Labels of the data that were read; nothing is imported where none were."""
    seen: dict[str, None] = getattr(sys.modules.get("calib.data.reader"), "SEEN", {})
    return seen


def _end(why: str, code: int) -> Never:
    """Say why a command ends, and where what it had finished is, and end it."""
    from calib.batch import foreign

    print(f"calib: {why}", file=sys.stderr)
    for folder in foreign.saved:
        print(f"calib: what was finished is in {folder}", file=sys.stderr)
    raise typer.Exit(code) from None


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
    calibration.report, calibration.fit, predict.predict, options.data, options.template,
    options.priors, gap.models, gap.effects,
    gap.quantities, calibration.compare, gap.diagnose, check.check, check.audit,
    campaign.campaign, campaign.sbc, machine.doctor,
):  # fmt: skip
    app.command()(verb)
app.add_typer(campaign.verbs, name="challenge")
add_examples(app)


@cache
def command(first: str) -> Any:
    """Return the command line: of one verb alone if that is the first word, for all take 30 ms."""
    one = copy(app)
    if verbs := [c for c in app.registered_commands if c.callback.__name__ == first]:  # type: ignore[union-attr]
        one.registered_commands, one.registered_groups = verbs, []
    return typer.main.get_command(one)


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
        from calib.cli.options import told

        ctx.with_resource(told())
