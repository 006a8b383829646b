"""What commands share: options, progress bars, JSON, and what they say of emulated simulators."""

from __future__ import annotations

import io
import json
import logging
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TextIO

import typer
from typer.core import TyperCommand, TyperGroup

from calib.errors import CalibError
from calib.report.numbers import finite

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress

    from calib.data import Table
    from calib.inference.emulation import Emulation
    from calib.inference.joint import JointProblem
    from calib.inference.problem import Problem

type Tell = Callable[[str, int, int], None]


def completing(kind: Literal["models", "effects", "quantities"]) -> Callable[[str], list[str]]:
    """Return what completes the name of a declaration on the Tab key."""

    def complete(incomplete: str) -> list[str]:
        from calib.data.quantities import QUANTITIES
        from calib.gap.effects import EFFECTS
        from calib.models import MODELS

        stems = [q.stem for q in QUANTITIES.values()]
        names = {"models": [*MODELS], "effects": [*EFFECTS], "quantities": stems}[kind]
        return [name for name in names if name.startswith(incomplete)]

    return complete


OneModel = Annotated[
    str, typer.Argument(help="See `calib models`.", autocompletion=completing("models"))
]
ModelOption = Annotated[
    str, typer.Option("--model", help="See `calib models`.", autocompletion=completing("models"))
]
Seed = Annotated[
    int,
    typer.Option(help="Seed of the random numbers: the same seed gives the same result.", min=0),
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace an earlier result.")]
HoldOutOption = Annotated[
    str | None,
    typer.Option(
        "--hold-out", help="Rows kept for validation, e.g. inflation_pressure_psi=30 or =18,30."
    ),
]
MaxSteps = Annotated[
    int, typer.Option(help="Stop extending the chains after so many steps.", min=100)
]
DryRun = Annotated[
    bool,
    typer.Option("--dry-run", help="Check the input, print what would be done, and exit."),
]
PriorFiles = Annotated[list[Path] | None, typer.Option(help="Prior file of a model; repeatable.")]
EffectsFile = Annotated[
    Path | None,
    typer.Option("--effects", help="Python file with effects of your own, for this command only."),
]


class _Aside(io.TextIOBase):
    """A standard output that discards text; the JSON document, if one is asked for, is printed."""

    def __init__(self, output: TextIO, *, json: bool = True) -> None:
        self.output, self.json = output, json

    def write(self, text: str) -> int:
        return len(text)


def silence(ctx: typer.Context) -> None:
    """Print nothing until a command ends; warnings and errors have their own output."""
    ctx.with_resource(redirect_stdout(_Aside(sys.stdout, json=False)))


class _PlainFlags:
    """Help without the word bool beside each flag."""

    def get_params(self, ctx: Any) -> Any:
        params = super().get_params(ctx)  # type: ignore[misc]
        for param in params:
            if getattr(param, "is_flag", False):
                param.metavar = ""
        return params


class Command(_PlainFlags, TyperCommand):
    """A command of the program."""


class Group(_PlainFlags, TyperGroup):
    """Commands of the program."""


CORES = min(2, os.cpu_count() or 1)  # more than two processes bring little
Workers = Annotated[int, typer.Option(help="Processes on this machine.", min=1, max=1024)]
Scheduler = Annotated[
    str | None,
    typer.Option(help="Dask scheduler to use instead of --workers, e.g. tcp://host:8786."),
]


def _load(paths: list[Path] | None) -> list[Path] | None:
    """Register what the files declare, before names are looked up."""
    if paths:
        from calib.models.simulators.files import load_files

        load_files(paths)
    return paths


Models = Annotated[
    list[Path] | None,
    typer.Option(
        "--models",
        help="Python file that registers quantities, models or effects of your own; repeatable.",
        callback=_load,
        is_eager=True,
    ),
]
Simulators = Annotated[
    list[Path] | None,
    typer.Option(
        "--simulator",
        help="TOML file of a simulator of your own; its command is run; repeatable.",
        callback=_load,
    ),
]


def _set_aside(ctx: typer.Context, wanted: bool) -> bool:
    if wanted:
        real = sys.stdout.output if isinstance(sys.stdout, _Aside) else sys.stdout
        ctx.with_resource(redirect_stdout(_Aside(real)))
    return wanted


Json = Annotated[
    bool,
    typer.Option("--json", help="Print one JSON object instead of text.",
                 callback=_set_aside),
]  # fmt: skip


def finish(code: int, found: Mapping[str, Any] | Path, **more: Any) -> None:
    """Say what the data are called, print JSON if it is asked for, and end with an exit code.

    What is printed is a document, or the JSON file that holds it; `more` stands before it. What is
    not finite is null.
    """
    from calib.data.reader import SEEN, said_of

    if isinstance(sys.stdout, _Aside) and sys.stdout.json:
        document = found if isinstance(found, Mapping) else json.loads(found.read_bytes())
        data = {"data_label": ", ".join(SEEN)} if SEEN else {}
        whole = finite({"exit_code": code, **more, **data, **document})
        sys.stdout.output.write(json.dumps(whole, indent=1, allow_nan=False) + "\n")
    for label in SEEN:
        print(f"calib: {label} data: {said_of(label)}", file=sys.stderr)
    SEEN.clear()
    if code:
        raise typer.Exit(code)


def planned(problems: Iterable[Problem], held: Mapping[str, int], out: Path) -> None:
    """Print what a command would calibrate, the rows held out of each, and where it would write."""
    from calib.validation.assumptions import file_remarks

    found = {}
    for problem in problems:
        model, table = problem.bound.model.name, problem.table
        columns = [table.header_of(c) for c in (*problem.conditions, problem.bound.model.output)]
        aside = f", {held[model]} held out" if held.get(model) else ""
        left = f"; not used: {', '.join(table.ignored)}" if table.ignored else ""
        print(f"{model}: {len(table)} rows of {table.source}{aside}")
        print(f"  columns: {', '.join(columns)}{left}")
        print(f"  parameters: {', '.join(problem.names)}; priors: {problem.priors.source}")
        for note in problem.notes:
            print(f"  note: {note}")
        # Whether copied rows are chance depends on the scatter, which only a fit tells.
        warnings = [remark.text for remark in file_remarks(problem, 0.0)]
        for text in warnings:
            print(f"  warning: {text}")
        found[model] = {
            "rows": len(table), "held_out": held.get(model, 0), "columns": columns,
            "not_used": list(table.ignored), "parameters": list(problem.names),
            "notes": list(problem.notes), "warnings": warnings,
        }  # fmt: skip
    print(f"would write {out}; nothing was computed (--dry-run)")
    finish(0, {"would_write": str(out), "models": found})


def command() -> list[str]:
    """Return the command line without the folder the program was started from."""
    from calib.data.files import writable

    return ["calib", *map(writable, sys.argv[1:])]


def announce(line: str) -> None:
    """Say something on the error output."""
    print(f"calib: {line}", file=sys.stderr)


def wide_console(width: int = 160) -> Console:
    """Return a console for tables; a pipe has no width of its own."""
    from rich.console import Console

    return Console(width=None if sys.stdout.isatty() else width, highlight=False, markup=False)


_log = logging.getLogger("calib")


@contextmanager
def told() -> Iterator[None]:
    """Send what is logged to the error output, versions and processor first."""
    from calib.batch.environment import Environment

    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter("calib: %(message)s"))
    _log.addHandler(handler)
    _log.setLevel(logging.DEBUG)
    try:
        here = Environment.here()
        for facts in (here.versions, here.machine):
            _log.debug(", ".join(f"{name} {value}" for name, value in facts.items()))
        yield
    finally:
        _log.removeHandler(handler)
        _log.setLevel(logging.NOTSET)


@contextmanager
def progress_bars() -> Iterator[Tell]:
    """Yield a callback ``(what, done, planned)`` that draws one bar for each kind of work."""
    shown: list[Progress] = []
    quiet = isinstance(sys.stdout, _Aside) and not sys.stdout.json

    def tell(what: str, done: int, planned: int) -> None:
        if quiet:
            return
        # Not before there is something to tell: an error that comes first has the terminal alone.
        if not shown:
            shown.append(_bars())
            shown[0].start()
        tasks = {task.description: task.id for task in shown[0].tasks}
        task = tasks[what] if what in tasks else shown[0].add_task(what)
        shown[0].update(task, completed=done, total=planned)

    try:
        yield tell
    finally:
        for bars in shown:
            bars.stop()
            for t in bars.tasks:
                _log.debug("%s: %g of %g, %.1f s", t.description, t.completed, t.total, t.elapsed)


def _bars() -> Progress:
    from rich import progress
    from rich.console import Console
    from rich.text import Text

    from calib.data.files import plain_number

    class Speed(progress.ProgressColumn):
        def render(self, task: progress.Task) -> Text:
            return Text("" if task.speed is None else f"{plain_number(task.speed, 2)}/s")

    return progress.Progress(
        progress.TextColumn("{task.description}"), progress.BarColumn(),
        progress.MofNCompleteColumn(), progress.TimeElapsedColumn(),
        progress.TimeRemainingColumn(), Speed(), console=Console(stderr=True),
    )  # fmt: skip


def emulate(
    models: Mapping[str, tuple[Table, Path | None]],
    seed: int,
    workers: int,
    elsewhere: Iterable[Table | None] = (),
) -> dict[str, Emulation]:
    """Emulate the slow simulators among models, and say of each how good it is.

    By model the rows that it is fitted to and its prior file; `elsewhere` it is to predict too.
    """
    from calib.inference.emulation.prepared import prepare

    others = [table for table in elsewhere if table is not None]
    with progress_bars() as tell:
        found = {
            name: prepare(
                name, table, seed, priors=path, elsewhere=others, workers=workers, progress=tell
            )
            for name, (table, path) in models.items()
        }
    return _said({name: emulation for name, emulation in found.items() if emulation is not None})


def emulate_jointly(
    joint: JointProblem, seed: int, workers: int, elsewhere: Iterable[Table | None] = ()
) -> dict[str, Emulation]:
    """Emulate the slow simulators of a joint problem, to be built again, and say how good each is.

    Emulations by model; `elsewhere` it is to predict too.
    """
    from calib.inference.emulation.prepared import emulated_jointly, put_in_use

    others = [table for table in elsewhere if table is not None]
    with progress_bars() as tell:
        found = emulated_jointly(joint, seed, elsewhere=others, workers=workers, progress=tell)[1]
    put_in_use(found)
    return _said(found)


def _said(emulations: dict[str, Emulation]) -> dict[str, Emulation]:
    for name, emulation in emulations.items():
        say(name, emulation)
    return emulations


def say(model: str, emulation: Emulation) -> None:
    """Say what became of an emulation."""
    from calib.data.files import plain_number
    from calib.report.sections import coverage_words

    h = emulation.held_out
    seen = "" if h is None else (
        f"; on {h.runs} runs not seen it is off by {h.rmse:.3f} noise sds (rms); of their values "
        f"its 90 % intervals hold {coverage_words(h.covered, h.pit.size)}"
    )  # fmt: skip
    n = len(emulation.runs)
    print(f"{model}: emulated {f'with {n} more' if emulation.extended else f'from {n}'} runs{seen}")
    if emulation.own_noise:
        sd = plain_number(emulation.own_noise)
        print(f"{model}: the simulator has a noise of its own, sd {sd}")
    if emulation.failed:
        first = emulation.failed[0].failure
        why = "" if first is None else f", the first as {first.reason}"
        announce(
            f"{len(emulation.failed)} of {len(emulation.runs)} runs failed{why}; they are "
            "listed beside the runs, and the posterior keeps out of where there is no value"
        )
    for reason in emulation.reasons:
        print(f"EMULATOR NOT GOOD ENOUGH: {reason}")


def say_failed(model: str) -> None:
    """Say which runs failed of a simulator that the sampler asked itself, and list them."""
    from calib.inference.emulation.prepared import write_failed
    from calib.models import get_model
    from calib.models.simulators.declaration import Direct, simulated_by

    direct, found = get_model(model).predict, simulated_by(model)
    if not isinstance(direct, Direct) or found is None or not direct.tally.failed:
        return
    tally, listed = direct.tally, ""
    if found.folder is not None:
        path = found.folder / f"{model}-failed.csv"
        write_failed(tally.failed, direct.simulator.parameters, path)
        listed = f"; the first {len(tally.failed)} are listed in {path}"
    first = tally.failed[0].failure
    announce(
        f"{tally.lost} of {tally.made} runs failed, the first as "
        f"{'' if first is None else first.reason}{listed}; the posterior keeps out of where there "
        "is no value"
    )


def column_value(option: str, text: str) -> tuple[str, float]:
    """Read COLUMN=VALUE."""
    column, _, value = text.partition("=")
    try:
        return column.strip(), float(value)
    except ValueError:
        raise CalibError(
            f"cannot read {option} {text!r}",
            expected="COLUMN=VALUE, for instance inflation_pressure_psi=30",
            hint="name a column with its unit, an equals sign and one number",
        ) from None
