"""The verb of the audit: test what the source paper prints."""

from __future__ import annotations

import sys
from json import loads
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calib.cli import options as opt
from calib.cli.machine import Json, finish

if TYPE_CHECKING:
    from calib.he2019.audit import Audit


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
    from calib.cli.display import progress_bars
    from calib.he2019.audit import audit_json, run_audit

    if out is not None:
        ctx.with_resource(claimed(out, overwrite=overwrite))
    with progress_bars() as tell:
        found = run_audit(seed, progress=tell)
        if out is not None:
            from calib.he2019.page.audit import write_audit_page

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

    from calib.he2019.page.audit import AUDIT_MARKS

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
