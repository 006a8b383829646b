"""A check as a table: the verdict first, then what was compared, then what is not the same."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from typing import Any

from rich.console import Console
from rich.table import Table

from calib.check.outcome import Item, Outcome, Status
from calib.data.numbers import plain_number

_MOST = 40


def show(outcome: Outcome, *, every: bool) -> None:
    """Print what a check found: every number and file, or only those that are not the same."""
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
