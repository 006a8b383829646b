"""Data that are known wherever they turn up, and what to call them.

Every table that is read is labelled here, whatever its file is called; the label goes wherever the
table goes, and a command says of which such data it has read.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace

from calib.data.quantities import OUTPUTS
from calib.data.registry import Registry
from calib.data.table import MAX_TEXT_ROWS, Table


@dataclass(frozen=True)
class KnownData:
    """A data set that must be called what it is.

    Parameters
    ----------
    words : str
        What it is, in a sentence.
    methods : str
        What a paper must say of it, a sentence with marks (`calib.report.publish.markup`).
    holds : callable
        ``table -> bool``: whether all rows of a table are rows of it.
    """

    label: str
    words: str
    methods: str
    holds: Callable[[Table], bool]

    def register(self) -> None:
        """Have it recognised."""
        KNOWN_DATA.add(self)


KNOWN_DATA: Registry[KnownData] = Registry("data set", lambda known: known.label)


# Labels of what has been read, since a command cleared them.
SEEN: dict[str, None] = {}


def label_of(table: Table) -> str:
    """Return what a table must be called, from its rows alone; empty if it is nothing known."""
    if len(table) > MAX_TEXT_ROWS or not any(column in table for column in OUTPUTS.values()):
        return ""
    return next((k.label for k in KNOWN_DATA.values() if k.holds(table)), "")


def labelled(table: Table) -> Table:
    """Return a table with the label that it has, or that its rows ask for, else as it is."""
    label = table.label or label_of(table)
    if label in KNOWN_DATA:
        SEEN[label] = None
    return table if label == table.label else replace(table, label=label)


def common_label(*tables: Table | None) -> str:
    """Return what must be said of what is made of tables; empty if nothing."""
    return ", ".join(dict.fromkeys(t.label for t in tables if t is not None and t.label))


def said_of(label: str) -> str:
    """Return the sentences that go with labels, without their citations."""
    known = [KNOWN_DATA[name].methods for name in label.split(", ") if name in KNOWN_DATA]
    return re.sub(r" ?\[@[^]]*\]", "", " ".join(known))
