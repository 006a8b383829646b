"""Compare the audit and the diagnoses in a report folder with those that were made again."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from calib.reproduce.allowances import Allowance
from calib.reproduce.derived import AUDIT_JSON
from calib.reproduce.items import Item, Status
from calib.reproduce.montecarlo import Place
from calib.reproduce.numbers import Section, compare_section, flatten
from calib.reproduce.stated import (
    audit_allowances,
    corrected_allowances,
    gap_allowances,
    prediction_allowances,
)

__all__ = ["AUDIT", "compare_document", "gap_group", "is_document"]

AUDIT = "audit"
_TABLE = 1e-9
# Entries of one status that are still listed one by one.
_MANY = 50


def gap_group(name: str) -> str:
    """Return what the items of one of the source's gaps are shown under."""
    return f"gap: {name}"


def is_document(name: str) -> bool:
    """Whether a file of a report is compared number by number, beside its summary."""
    return name == AUDIT_JSON or (name.startswith("gaps/") and name.endswith((".json", ".csv")))


def compare_document(
    name: str, recorded: Path, made: Path, best: str, *, same_program: bool
) -> tuple[list[Item], bool]:
    """Return what is not the same in a document, and whether its numbers are to the last bit.

    Parameters
    ----------
    name : str
        Its path in the folder.
    recorded, made : Path
        The file, and the same made again.
    best : str
        The most probable hypothesis of a gap.
    same_program : bool
        Whether equal numbers must give equal files.
    """
    group = AUDIT if name == AUDIT_JSON else gap_group(name.split("/")[1])
    if recorded.read_bytes() == made.read_bytes():
        return [Item(group, name, Status.IDENTICAL)], True
    try:
        old = _read(recorded)
    except (OSError, ValueError, RecursionError) as error:
        note = f"it cannot be read ({type(error).__name__})"
        return [Item(group, name, Status.DIFFERENT, note=note)], False
    section = Section(name, (), old, _read(made))
    items = compare_section(
        section, _allowances(name, section, best), group_of=lambda _: group
    )  # fmt: skip
    found = [item for item in items if item.status is not Status.IDENTICAL]
    if not found:
        status = Status.DIFFERENT if same_program else Status.UNJUDGED
        note = "the same numbers in another form than it is written in"
        found = [Item(group, name, status, note=note)]
    return _folded(found), section.exact


def _folded(items: list[Item]) -> list[Item]:
    """Put what is alike and not different into one item where there is much of it."""
    kept = [item for item in items if item.status is Status.DIFFERENT]
    for status in (Status.WITHIN, Status.UNJUDGED):
        alike = [item for item in items if item.status is status]
        if len(alike) > _MANY:
            first = alike[0]
            name = first.name.partition(":")[0]
            note = f"{len(alike)} of its entries, the first {first.name.partition(': ')[2]}"
            why = f"; {first.note}" if first.note else ""
            alike = [Item(first.group, name, status, note=note + why)]
        kept += alike
    return kept


def _read(path: Path) -> dict[Place, Any]:
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".csv":
        rows = csv.DictReader(text.splitlines())
        return dict(flatten([{str(k): _cell(v) for k, v in row.items()} for row in rows]))
    return dict(flatten(json.loads(text)))


def _cell(text: Any) -> Any:
    try:
        return float(text)
    except (TypeError, ValueError):
        return text


def _allowances(name: str, section: Section, best: str) -> Mapping[Place, Allowance]:
    paths = {**section.recorded, **section.found}
    if name == AUDIT_JSON:
        return audit_allowances(paths)
    if name.endswith("diagnosis.json"):
        return gap_allowances(paths, best)
    if name.endswith("corrected.json"):
        return corrected_allowances(paths)
    if "/case/" not in name:
        return prediction_allowances(section.found)
    return {
        path: Allowance(_TABLE * abs(value), why="data")
        for path, value in section.found.items()
        if isinstance(value, float)
    }
