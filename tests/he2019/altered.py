"""Published figures with one of them changed, as a misprint would."""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType

from calib.he2019.published import PUBLISHED, Published
from calib.report.reference import Figure, FittedTable

__all__ = ["altered", "flipped", "printed_figures"]


def printed_figures(published: Published) -> dict[str, Figure]:
    """Return every printed figure by where it stands, such as ``"Table 4, 18 psi: E"``."""
    tables = (
        published.bulk_density, *published.geometric.values(), *published.genetic.values(),
        published.pressure, published.rut_depth,
    )  # fmt: skip
    found = {
        f"{table.source}: {name}": figure
        for table in tables
        for name, figure in (*table.estimates.items(), *table.quality.items())
    }
    setup = published.setup
    found |= {f"Table 2: {name}": figure for name, figure in setup.genetic_settings.items()}
    found |= {f"Setup: contact length, {p} psi": f for p, f in setup.contact_length_mm.items()}
    found |= {f"Setup: named slip {i}": f for i, f in enumerate(setup.named_slips, start=1)}
    plain = (
        "tyre_width_mm", "normal_load_kn", "speed_m_s", "contact_width_mm", "slip_levels",
        "largest_rut_slip", "rebound_slip", "largest_water_content",
    )  # fmt: skip
    return found | {f"Setup: {name}": getattr(setup, name) for name in plain}


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
