"""The code blocks of a page: commands, Python, files to write, and what a command prints."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
# Pages that are written, not made from declarations; the README is one of them.
PAGES = {
    path.relative_to(ROOT).as_posix(): path
    for path in (ROOT / "README.md", *sorted(DOCS.rglob("*.md")))
    if not path.is_relative_to(DOCS / "declared")
}
_FENCE = re.compile(r"^(`{3,}|:{3,})(.*)$")
_MARK = re.compile(r"^(?:%|<!--)\s*(slow|not run|exit \d)\b")


@dataclass(frozen=True)
class Block:
    """A block with its language, caption and marks."""

    language: str
    text: str
    line: int
    caption: str = ""
    marks: frozenset[str] = frozenset()

    @property
    def slow(self) -> bool:
        return "slow" in self.marks

    @property
    def exit_code(self) -> int:
        return next((int(m.split()[1]) for m in self.marks if m.startswith("exit")), 0)


def blocks(text: str) -> Iterator[Block]:
    """Yield the fenced blocks of a page, in order."""
    lines = text.splitlines()
    i, marks = 0, frozenset[str]()
    while i < len(lines):
        mark, fence = _MARK.match(lines[i]), _FENCE.match(lines[i])
        if mark:
            marks |= {mark[1]}
        elif fence:
            start = i
            i = next(j for j in range(i + 1, len(lines)) if lines[j].strip() == fence[1])
            yield _block(fence[2], lines[start + 1 : i], start + 2, marks)
            marks = frozenset()
        elif lines[i].strip():
            marks = frozenset()
        i += 1


def _block(head: str, inside: list[str], line: int, marks: frozenset[str]) -> Block:
    language = head.strip().partition(" ")[0]
    caption, first = "", 0
    if language.startswith("{"):
        options = [re.match(r":([\w-]+):\s*(.*)$", text) for text in inside]
        first = next((k for k, option in enumerate(options) if option is None), len(inside))
        caption = next((o[2] for o in options[:first] if o and o[1] == "caption"), "")
        while first < len(inside) and not inside[first].strip():
            first += 1
    text = "".join(f"{part}\n" for part in inside[first:])
    return Block(language.strip("{}"), text, line + first, caption, marks)
