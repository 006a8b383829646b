"""The commands `check` and `audit`, and the table that shows what a check found."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from json import loads
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from calib.cli import options as opt
from calib.cli.machine import Json, finish
from calib.errors import CalibError

if TYPE_CHECKING:
    from calib.check.outcome import Item, Outcome
    from calib.he2019.audit import Audit

_MOST = 40


def show(outcome: Outcome, *, every: bool) -> None:
    """Print what a check found: every number and file, or only those that are not the same."""
    from calib.check.outcome import Status

    # A pipe has no width of its own: wide enough for whole rows.
    console = Console(width=None if sys.stdout.isatty() else 160, highlight=False, markup=False)
    console.print(outcome.verdict, soft_wrap=True)
    console.print(_groups(outcome))
    for title, status in (("Different", Status.DIFFERENT), ("Not judged", Status.UNJUDGED)):
        _print_items(console, title, outcome.of(status), _MOST)
    if every:
        _print_items(console, "The same", outcome.of(Status.WITHIN, Status.IDENTICAL), sys.maxsize)
    if outcome.draws_differ:
        console.print(f"Allowed: {outcome.allowed}.", soft_wrap=True)
    if outcome.environment:
        console.print("It was made elsewhere:")
        for name, (there, here) in outcome.environment.items():
            console.print(f"  {name}: there {there[:60]}; here {here[:60]}", soft_wrap=True)
    elif outcome.draws_differ:
        console.print(
            "The draws are others although versions, code and processor are recorded as they are "
            "here: something that is not recorded rounds differently, or the record is not true.",
            soft_wrap=True,
        )


def _groups(outcome: Outcome) -> Table:
    """One row for each group: how many of its entries are what."""
    from calib.check.outcome import Status
    from calib.data.files import plain_number

    table = Table()
    table.add_column("compared")
    for status in Status:
        table.add_column(str(status), justify="right")
    table.add_column("largest difference\nof what is allowed", justify="right")
    groups: dict[str, list[Item]] = {}
    for item in outcome.items:
        groups.setdefault(item.group.partition(" (")[0], []).append(item)
    for name, items in groups.items():
        counts = [sum(item.status is status for item in items) for status in Status]
        shares = [item.share for item in items if item.share is not None]
        largest = f"{plain_number(100.0 * max(shares))} %" if any(shares) else ""
        table.add_row(name, *(str(n) if n else "" for n in counts), largest)
    return table


def _print_items(console: Console, title: str, items: Iterable[Item], most: int) -> None:

    listed = list(items)
    if not listed:
        return
    table = Table(title=title, title_justify="left")
    for heading in ("what", "recorded", "computed again", "allowed", "remark"):
        right = heading in ("recorded", "computed again", "allowed")
        table.add_column(heading, justify="right" if right else "left", overflow="fold")
    for item in listed[:most]:
        table.add_row(
            item.name, _short(item.recorded), _short(item.found), _short(item.allowed), item.note
        )
    console.print(table)
    if len(listed) > most:
        console.print(f"... and {len(listed) - most} more; --all or --json lists them")


def _short(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, float):
        return f"{value:.10g}"
    text = str(value)
    return text if len(text) <= 24 else f"{text[:16]}..."


def check(
    folder: Annotated[Path, typer.Argument(help="Folder of `calib report`, `fit` or `compare`.")],
    quick: Annotated[
        bool, typer.Option("--quick", help="Skip the sampling: hashes, inputs and estimates only.")
    ] = False,
    every: Annotated[
        bool, typer.Option("--all", help="List every number, not only what is not the same.")
    ] = False,
    workers: opt.Workers = opt.CORES,
    plugins: opt.Models = None,
    simulator: opt.Simulators = None,
    json: Json = False,
) -> None:
    """Compute a folder's results again from that folder alone and compare everything.

    Ends with 0 where all is the same, 1 where something differs, 2 where it cannot be checked.
    """
    from calib.batch.plugins import load_files
    from calib.batch.pool import pool
    from calib.check.check import check as find
    from calib.cli.options import progress_bars

    # A slow simulator is checked as it was emulated: nothing is run.
    load_files(sorted((folder / "emulators").glob("*.npz")))
    try:
        with pool(1 if quick else workers) as side, progress_bars() as tell:
            outcome = find(folder, quick=quick, progress=tell, pool=side, workers=workers)
    except CalibError as error:
        finish(0, {"folder": str(folder), "verdict": "cannot be checked", "reason": str(error),
                   "exit_code": 2})  # fmt: skip
        raise
    show(outcome, every=every)
    finish(outcome.exit_code, outcome.document())


def audit(
    ctx: typer.Context,
    out: Annotated[
        Path | None, typer.Option(help="Folder for audit.json, audit.csv, figures and a page.")
    ] = None,
    json: Json = False,
    seed: opt.Seed = 2019,
    overwrite: opt.Overwrite = False,
) -> None:
    """Audit the published tables of He, Sandu & Osorio (2019): every figure and its verdict."""
    from calib.batch.folders import claimed, fresh_folder
    from calib.cli.options import progress_bars
    from calib.he2019.audit import audit_json, run_audit

    if out is not None:
        ctx.with_resource(claimed(out, overwrite=overwrite))
    with progress_bars() as tell:
        found = run_audit(seed, progress=tell)
        if out is not None:
            from calib.he2019.sections import write_audit_page

            tell("drawing figures", 0, 1)
            with fresh_folder(out, overwrite=overwrite) as folder:
                write_audit_page(found, folder, opt.command())
            tell("drawing figures", 1, 1)
    _print(found)
    if out is not None:
        print(out / "index.html")
    finish(0, loads(audit_json(found)))


def _print(found: Audit) -> None:
    from rich.console import Console
    from rich.table import Table as RichTable
    from rich.text import Text

    from calib.he2019.sections import AUDIT_MARKS

    table = RichTable(title="Audit of He, Sandu & Osorio (2019)", show_lines=True)
    for heading in ("verdict", "where", "claim or reading", "evidence"):
        table.add_column(heading)
    for f in found.findings:
        where = f"{f.where}\n[reconstructed data]" if f.reconstructed else f.where
        cells = (f"{AUDIT_MARKS[f.verdict]} {f.verdict.value}", where, f.claim, f.evidence)
        table.add_row(*map(Text, cells))
    # A pipe has no width of its own: wide enough for whole rows.
    console = Console(width=None if sys.stdout.isatty() else 160)
    console.print(table)
    counts = ", ".join(f"{n} {verdict.value}" for verdict, n in found.counts.items())
    print(f"{len(found.findings)} findings: {counts}")
    print(
        "Verdicts marked [reconstructed data] show what a method does with such data and prove "
        "nothing about the measured ones."
    )
