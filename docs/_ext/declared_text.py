"""Markdown: escaped words, tables, links between the pages that are made."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from hashlib import sha256

from calib.inference.priors import Prior
from calib.report.labels import degrees, role_columns, symbol

_SPECIAL = re.compile(r"([\\*_{}\[\]<>|$~])")


def words(text: str) -> str:
    """Escape a text in which nothing is meant as markup but code between backquotes."""
    parts = text.split("`")
    return "`".join(p if i % 2 else _SPECIAL.sub(r"\\\1", p) for i, p in enumerate(parts))


def with_symbols(text: str) -> str:
    """Escape a text with parameters marked as ``[$name]``, which become mathematics."""
    parts = re.split(r"\[\$(\w+)\]", text)
    return "".join(symbol(p) if i % 2 else words(p) for i, p in enumerate(parts))


def code(text: str) -> str:
    """Write a name as code."""
    return f"`{text}`"


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table; its cells are Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def quantity_link(column: str) -> str:
    """Link to the page of a quantity."""
    return f"[{code(column)}](../quantities/{column}.md)"


def role_links(roles: Iterable[str], *, output: bool) -> str:
    """Link to all quantities that have some physical roles, outputs or not."""
    return ", ".join(map(quantity_link, role_columns(roles, output=output)))


def unit(text: str) -> str:
    """Write a unit as people do; a dash where there is none."""
    if text in ("1", "", "dimensionless"):
        return "\N{EN DASH}"
    return words(degrees(text.replace("**", "^").replace("*", " ")))


def priors_table(priors: Iterable[Prior]) -> str:
    """Return a table of priors: parameter, unit, distribution, reason, source."""
    return table(
        ("parameter", "unit", "prior", "why", "source"),
        (
            (code(p.name), unit(p.unit), words(p.text), words(p.reason), words(p.source))
            for p in priors
        ),
    )


def picture_name(name: str, page: str) -> str:
    """Name the file of a picture by all that its page, without it, says."""
    return f"{name}-{sha256(page.encode()).hexdigest()[:8]}.png"


def with_picture(page: str, name: str, said: str, below: str = "") -> str:
    """Return a page with its picture above the equation, and what is said of it, in words."""
    shown = f"![{said}]({picture_name(name, page)})\n\n{below}## Equation"
    return page.replace("## Equation", shown, 1)


def toctree(pages: Mapping[str, str]) -> str:
    """Return a hidden table of contents of pages in the same folder."""
    return "```{toctree}\n:hidden:\n\n" + "\n".join(pages) + "\n```\n"
