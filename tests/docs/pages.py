"""The code blocks of a page: commands, Python, files to write, and what a command prints.

Of a notebook of the gallery the cells, run in order as a kernel runs them.
"""

from __future__ import annotations

import ast
import re
import shlex
from collections.abc import Callable, Iterator
from contextlib import redirect_stdout
from dataclasses import dataclass, field
from html import unescape
from io import StringIO
from pathlib import Path
from typing import Any

from tests.commands import Calib

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
# Pages that are written, not made from declarations; the README is one of them.
PAGES = {
    path.relative_to(ROOT).as_posix(): path
    for path in (ROOT / "README.md", *sorted(DOCS.rglob("*.md")))
    if not path.is_relative_to(DOCS / "declared")
}
NOTEBOOKS = {
    path.stem: path for path in sorted((DOCS / "gallery").glob("*.md")) if path.stem != "index"
}


def told() -> set[str]:
    """Return the keys that the page of the files that calib writes names."""
    return set(re.findall(r"`(\w+)`", (DOCS / "formats" / "results.md").read_text("utf-8")))


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
        if language == "{code-cell}" and inside[first] == "---":  # its metadata
            first = inside.index("---", first + 1) + 1
        while first < len(inside) and not inside[first].strip():
            first += 1
    text = "".join(f"{part}\n" for part in inside[first:])
    return Block(language.strip("{}"), text, line + first, caption, marks)


@dataclass
class Notebook:
    """A notebook that has been run: the names in it at its end, and what its cells showed."""

    names: dict[str, Any] = field(default_factory=lambda: {"__name__": "__main__"})
    shown: list[str] = field(default_factory=list)

    def __getitem__(self, name: str) -> Any:
        return self.names[name]

    @property
    def text(self) -> str:
        """All that was shown, in one line."""
        return " ".join(" ".join(self.shown).split())

    @property
    def figures(self) -> int:
        return self.shown.count("<figure>")

    def show(self, value: Any) -> None:
        """Show the value of a cell as a notebook does: a picture, or a page, or its name."""
        if value is None:
            return
        if draw := getattr(value, "_repr_png_", None):
            assert draw().startswith(b"\x89PNG")
            self.shown.append("<figure>")
        else:
            page: Callable[[], str] = getattr(value, "_repr_html_", value.__repr__)
            self.shown.append(
                unescape(re.sub(r"<style.*?</style>|<[^>]*>", " ", page(), flags=re.S))
            )


def run_notebook(path: Path, run: Calib) -> Notebook:
    """Run the cells of a notebook in the folder of the test; lines after ! are commands."""
    found = Notebook()
    for block in blocks(path.read_text(encoding="utf-8")):
        if block.language != "code-cell":
            continue
        if block.text.startswith("!"):
            _commands(block.text, run, found)
            continue
        # So that a traceback names the line of the page.
        body = ast.parse("\n" * (block.line - 1) + block.text, str(path)).body
        last = body.pop() if body and isinstance(body[-1], ast.Expr) else None
        printed = StringIO()
        with redirect_stdout(printed):
            exec(compile(ast.Module(body, []), str(path), "exec"), found.names)
        found.shown.append(printed.getvalue())
        if isinstance(last, ast.Expr):
            with redirect_stdout(printed):
                value = eval(compile(ast.Expression(last.value), str(path), "eval"), found.names)
            found.shown[-1] = printed.getvalue()
            found.show(value)
    return found


def _commands(text: str, run: Calib, found: Notebook) -> None:
    for line in text.splitlines():
        program, *arguments = shlex.split(line.removeprefix("!"))
        assert program == "calib", line
        ran = run(*arguments)
        assert (ran.code, ran.err) == (0, ""), ran
        found.shown.append(ran.out)
