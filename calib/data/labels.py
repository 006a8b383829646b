"""Data that are known wherever they turn up, and what to call them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from calib.data.registry import Registry
from calib.data.table import Table


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


def label_of(table: Table) -> str:
    """Return what a table must be called, from its rows alone; empty if it is nothing known."""
    return next((k.label for k in KNOWN_DATA.values() if k.holds(table)), "")


def labelled(table: Table) -> Table:
    """Return a table with the label that its rows ask for, else as it is."""
    label = label_of(table)
    return replace(table, label=label) if label else table
