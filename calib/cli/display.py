"""Progress bars and tables on the terminal."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from calib.report.numbers import centre_text, interval_text

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

    from calib.inference.calibration import Calibration
    from calib.report.verdict import Verdict

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

    from calib.data.numbers import plain_number

    class _Speed(ProgressColumn):
        def render(self, task: Task) -> Text:
            return Text("" if task.speed is None else f"{plain_number(task.speed, 2)}/s")

    return Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(),
        TimeElapsedColumn(), TimeRemainingColumn(), _Speed(), console=Console(stderr=True),
    )  # fmt: skip


def posterior_table(calibration: Calibration) -> None:
    """Print a calibration's posterior as a table."""
    from rich.console import Console
    from rich.table import Table as RichTable

    from calib.validation.assumptions import parameter_remarks

    model = calibration.problem.bound.model
    table = RichTable(title=f"{model.name}: posterior of {len(calibration.problem.table)} rows")
    words, numbers = ("parameter", "unit"), ("mean ± sd or median", "95 % HDI", "ESS bulk/tail")
    for heading in (*words, *numbers, "R-hat", "remark"):
        table.add_column(heading, justify="left" if heading in (*words, "remark") else "right")
    remarks = parameter_remarks(calibration)
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
