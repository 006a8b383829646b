"""Pages and JSON schemas made from declarations: models, effects, quantities, commands.

Written below ``docs/declared`` before the pages are read; a file whose content is the same is left
alone, so that what depends on it is not built again.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import declared_commands
import declared_effects
import declared_models
import declared_quantities
import declared_schemas
from declared_text import toctree


def _lists(title: str, lead: str, pages: Mapping[str, str], first: Iterable[str]) -> str:
    return f"# {title}\n\n{lead}\n\n{''.join(first)}\n{toctree(pages)}"


def pages() -> dict[str, str]:
    """Return the text of every page by its path below ``docs/declared``."""
    found = {"commands.md": declared_commands.page()}
    for folder, part in (
        ("models", declared_models), ("effects", declared_effects),
        ("quantities", declared_quantities),
    ):  # fmt: skip
        own = part.pages()
        found |= {f"{folder}/{name}.md": text for name, text in own.items()}
        found[f"{folder}/index.md"] = _lists(part.TITLE, part.LEAD, own, part.overview())
    schemas = declared_schemas.schemas()
    found |= {f"schemas/{n}.json": json.dumps(s, indent=1) + "\n" for n, s in schemas.items()}
    return found


def write(folder: Path) -> None:
    """Write all pages into a folder, and remove those of declarations that are gone."""
    wanted = pages()
    for name, text in wanted.items():
        path = folder / name
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
    pictures = {
        f"{kind}/{name}": draw
        for kind, part in (("models", declared_models), ("effects", declared_effects))
        for name, draw in part.pictures().items()
    }
    for name, draw in pictures.items():
        if not (folder / name).is_file():  # its name says what it shows
            (folder / name).write_bytes(draw())
    for path in folder.rglob("*.*"):
        if path.relative_to(folder).as_posix() not in {*wanted, *pictures}:
            path.unlink()


def setup(app: Any) -> dict[str, bool]:
    """Write the pages when a build begins."""
    app.connect("builder-inited", lambda a: write(Path(a.srcdir) / "declared"))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
