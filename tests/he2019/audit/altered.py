"""Published figures with one of them changed, as a misprint would."""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType

from calib.he2019.datasets.published import (
    PUBLISHED,
    Figure,
    FittedTable,
    Published,
    printed_figures,
)

__all__ = ["altered", "flipped"]


def _in_table(table: FittedTable, name: str, text: str) -> FittedTable:
    part = "estimates" if name in table.estimates else "quality"
    figures = dict(getattr(table, part))
    figures[name] = Figure(text, figures[name].unit)
    return replace(table, **{part: MappingProxyType(figures)})


def altered(changes: dict[str, str], published: Published = PUBLISHED) -> Published:
    """Return the published figures with some printed otherwise; keys of `printed_figures`."""
    for where, text in changes.items():
        source, _, name = where.partition(": ")
        assert where in printed_figures(published), where
        for part in ("bulk_density", "pressure", "rut_depth"):
            if getattr(published, part).source == source:
                table = _in_table(getattr(published, part), name, text)
                published = replace(published, **{part: table})
        for part in ("geometric", "genetic"):
            tables = dict(getattr(published, part))
            for psi, table in tables.items():
                if table.source == source:
                    tables[psi] = _in_table(table, name, text)
            published = replace(published, **{part: MappingProxyType(tables)})
        assert printed_figures(published)[where].text == text, where
    return published


def flipped(*where: str) -> Published:
    """Return the published figures with the signs of some changed."""
    figures = printed_figures(PUBLISHED)
    text = {w: figures[w].text for w in where}
    return altered({w: t[1:] if t.startswith("-") else f"-{t}" for w, t in text.items()})
