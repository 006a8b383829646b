"""Shared options, the commands `data`, `template` and `priors`, and progress bars."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from calib.errors import CalibError
from calib.report.numbers import centre_text, interval_text

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

    from calib.inference.calibration import Calibration
    from calib.report.verdict import Verdict

Seed = Annotated[int, typer.Option(help="Same seed, same numbers.", min=0)]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace an earlier result.")]
HoldOutOption = Annotated[
    str | None,
    typer.Option("--hold-out", help="Rows kept for validation, e.g. inflation_pressure_psi=30."),
]
MaxSteps = Annotated[int, typer.Option(help="Where extending the chains stops.", min=100)]
PriorFiles = Annotated[list[Path] | None, typer.Option(help="Prior file of a model; repeatable.")]
# As many processes as there are cores, of which two bring most of what there is to gain.
CORES = min(2, os.cpu_count() or 1)
Workers = Annotated[int, typer.Option(help="Processes on this machine.", min=1, max=1024)]
Scheduler = Annotated[
    str | None,
    typer.Option(help="A Dask scheduler in the place of --workers, e.g. tcp://host:8786."),
]


def _load(paths: list[Path] | None) -> list[Path] | None:
    """Register what the files declare, before names are looked up."""
    from calib.batch.plugins import load_files

    load_files(paths or ())
    return paths


def _files(name: str, what: str, *, first: bool) -> Any:
    return typer.Option(name, help=f"{what}; repeatable.", callback=_load, is_eager=first)


Models = Annotated[
    list[Path] | None,
    _files(
        "--models",
        "Python file that registers quantities, models or effects of your own",
        first=True,
    ),
]
Simulators = Annotated[
    list[Path] | None,
    _files(
        "--simulator", "TOML file of a simulator of your own, whose command is run", first=False
    ),
]


def command() -> list[str]:
    """Return the command line without the folder the program was started from."""
    from calib.data.files import writable

    return ["calib", *map(writable, sys.argv[1:])]


def announce(line: str) -> None:
    """Say where the tasks are done."""
    print(f"calib: {line}", file=sys.stderr)


def data(
    name: Annotated[str, typer.Argument(help="he2019 or he2019-gaps")],
    out: Annotated[Path | None, typer.Option(help="Folder to write; its name if none.")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Write the embedded, reconstructed data as CSV files, or as cases for `calib diagnose`."""
    writers = {"he2019": _write_he2019, "he2019-gaps": _write_he2019_gaps}
    if name not in writers:
        raise CalibError(
            f"there is no data set {name!r}", expected=", ".join(writers), hint="use one of these"
        )  # fmt: skip
    folder = Path(name) if out is None else out
    try:
        written = writers[name](folder, overwrite)
    except OSError as error:
        raise CalibError(
            f"the folder cannot be written ({error.strerror})", where=str(folder),
            hint="choose another --out",
        ) from None  # fmt: skip
    for path in written:
        print(f"{path} (reconstructed from published results, not measured)")


def _write_he2019(out: Path, overwrite: bool) -> list[Path]:
    from calib.he2019 import embedded

    existing = [f"{key}.csv" for key in embedded.tables() if (out / f"{key}.csv").exists()]
    if existing and not overwrite:
        raise CalibError(
            f"{', '.join(existing)} exist there already", where=str(out),
            hint="choose another --out, or pass --overwrite",
        )  # fmt: skip
    return embedded.write(out)


def _write_he2019_gaps(out: Path, overwrite: bool) -> list[Path]:
    from calib.he2019.gaps import paper_gaps, write_cases

    return write_cases(paper_gaps(), out, overwrite=overwrite)


def template(
    model: Annotated[str, typer.Argument(help="See `calib models`.")],
    out: Annotated[Path | None, typer.Option(help="CSV to write; printed if none.")] = None,
    plugins: Models = None,
    simulator: Simulators = None,
) -> None:
    """Write an example CSV of a model to fill in."""
    from calib.models import get_model, template_csv

    text = template_csv(get_model(model).name)
    _emit(text, out)
    if "run_order" in text:
        print("calib: run_order may be left out: number the rows as they were measured, or delete "
              "the column", file=sys.stderr)  # fmt: skip


def priors(
    model: Annotated[str, typer.Argument(help="See `calib models`.")],
    out: Annotated[Path | None, typer.Option(help="TOML to write; printed if none.")] = None,
    plugins: Models = None,
    simulator: Simulators = None,
) -> None:
    """Write the shipped priors of a model, to copy and edit."""
    from calib.inference.prior_files import default_priors
    from calib.models import get_model

    _emit(default_priors(get_model(model).name).read_text(encoding="utf-8"), out)


def _emit(text: str, out: Path | None) -> None:
    if out is None:
        sys.stdout.write(text)
        return
    from calib.batch.folders import write_whole

    try:
        if out.exists():
            raise CalibError("the file exists already", where=str(out), hint="choose another --out")
        write_whole(out, text)
    except OSError as error:
        raise CalibError(
            f"the file cannot be written ({error.strerror})", where=str(out),
            hint="choose another --out",
        ) from None  # fmt: skip
    print(out)


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
def progress_bars() -> Iterator[Callable[[str, int, int], None]]:
    """Yield a callback ``(what, done, planned)`` that draws one bar for each kind of work."""
    tasks: dict[str, TaskID] = {}
    shown: list[Progress] = []

    def tell(what: str, done: int, planned: int) -> None:
        # Not before there is something to tell: an error that comes first has the terminal alone.
        if not shown:
            shown.append(_bars())
            shown[0].start()
        if what not in tasks:
            tasks[what] = shown[0].add_task(what, total=planned)
        shown[0].update(tasks[what], completed=done, total=planned)

    try:
        yield tell
    finally:
        for bars in shown:
            bars.stop()
            for t in bars.tasks:
                _log.debug("%s: %g of %g, %.1f s", t.description, t.completed, t.total, t.elapsed)


def _bars() -> Progress:
    # Late: many a command has nothing to tell.
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        ProgressColumn,
        Task,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )
    from rich.text import Text

    from calib.data.files import plain_number

    class _Speed(ProgressColumn):
        def render(self, task: Task) -> Text:
            return Text("" if task.speed is None else f"{plain_number(task.speed, 2)}/s")

    return Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(),
        TimeElapsedColumn(), TimeRemainingColumn(), _Speed(), console=Console(stderr=True),
    )  # fmt: skip


def posterior_table(calibration: Calibration, judged: Verdict) -> None:
    """Print a calibration's posterior as a table, in agreement with its verdict."""
    from rich.console import Console
    from rich.table import Table as RichTable

    from calib.validation.assumptions import parameter_remarks

    model = calibration.problem.bound.model
    table = RichTable(title=f"{model.name}: posterior of {len(calibration.problem.table)} rows")
    words, numbers = ("parameter", "unit"), ("mean ± sd or median", "95 % HDI", "ESS bulk/tail")
    for heading in (*words, *numbers, "R-hat", "remark"):
        table.add_column(heading, justify="left" if heading in (*words, "remark") else "right")
    remarks = parameter_remarks(calibration, judged.remarks)
    for s in calibration.summary.values():
        table.add_row(
            s.name, s.unit, centre_text(s),
            interval_text(s), f"{s.ess_bulk:.0f}/{s.ess_tail:.0f}",
            f"{s.rhat:.3f}", remarks[s.name],
        )  # fmt: skip
    # A pipe has no width of its own: wide enough for whole rows.
    width = None if sys.stdout.isatty() else 120
    Console(width=width).print(table)


def tell_verdict(found: Verdict, of: str = "") -> None:
    """Print a verdict, the warnings behind it first."""
    for warning in found.warnings:
        print(f"warning: {of}{warning}", file=sys.stderr)
    for line in found.lines:
        print(f"{of}{line}")


def tell_compared(found: Mapping[str, Any]) -> None:
    """Print the verdict on each model of a comparison, as `comparison.json` has it."""
    from calib.report.verdict import Verdict

    for name, model in found["models"].items():
        tell_verdict(Verdict.of(model["verdict"]), f"{name}: ")


def verdict_line(calibration: Calibration) -> str:
    """Say whether a calibration passed the gate, and what to do if not."""
    report = calibration.draws.report
    if report.passed:
        return (
            f"converged: {calibration.draws.t.shape[0]} ensembles, {report.steps} steps, "
            f"R-hat at most {report.rhat.max():.4f}, ESS at least "
            f"{min(report.ess_bulk.min(), report.ess_tail.min()):.0f}"
        )
    return (
        "NOT CONVERGED, do not use these numbers: "
        + "; ".join(report.reasons[:3])
        + ". Raise --max-steps, or give tighter priors for parameters the data do not determine."
    )
