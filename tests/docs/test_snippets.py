"""Every command, Python block and file of the documentation, run page by page as it is printed."""

from __future__ import annotations

import re
import shlex
import tomllib
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import pytest

from tests.commands import Calib, Ran
from tests.docs.pages import PAGES, Block, blocks

BLOCKS = {page: list(blocks(path.read_text(encoding="utf-8"))) for page, path in PAGES.items()}
RUN = ("console", "python")
# Processes of their own would be tried elsewhere, and take their time to start.
ALONE = ("report", "check", "diagnose", "sbc", "campaign")


def follow(page: str, run: Calib, *, slow: bool) -> None:
    """Do what a page says, in order, in the folder of the test."""
    names: dict[str, Any] = {}
    printed = ""
    for block in BLOCKS[page]:
        if "not run" in block.marks or (block.slow and not slow):
            printed = ""
        elif block.caption:
            write(block)
        elif block.language == "console":
            printed = "".join(ran.out + ran.err for ran in commands(block, run, page))
        elif block.language == "python":
            # So that a traceback names the line of the page.
            code = "\n" * (block.line - 1) + block.text
            with redirect_stdout(StringIO()) as output:
                exec(compile(code, page, "exec"), names)
            printed = output.getvalue()
        elif block.language == "toml":
            tomllib.loads(block.text)
        elif block.language == "text" and printed:
            compare(block, printed, page)


def write(block: Block) -> None:
    path = Path(block.caption)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(block.text, encoding="utf-8")


def commands(block: Block, run: Calib, page: str) -> list[Ran]:
    found = []
    for line in block.text.replace("\\\n", " ").splitlines():
        words = shlex.split(line, comments=True)
        if not words:
            continue
        assert words[0] == "calib", f"{page}: {line}"
        words, into = (words[:-2], words[-1]) if ">" in words else (words, "")
        alone = ["--workers", "1"] if words[1] in ALONE and "--workers" not in words else []
        ran = run(*words[1:], *alone)
        assert ran.code == block.exit_code, f"{page}: {line}\n{ran.out}\n{ran.err}"
        if into:
            Path(into).write_text(ran.out, encoding="utf-8")
        found.append(ran)
    return found


def compare(block: Block, printed: str, page: str) -> None:
    """The lines that a page shows are printed, up to an ellipsis, whatever the numbers in them."""
    lines = [shape(line) for line in printed.splitlines()]
    for line in block.text.splitlines():
        start, cut, _ = shape(line).partition(" …")
        there = any(found.startswith(start) if cut else found == start for found in lines)
        assert there, f"{page}: {line!r} is not in\n{printed}"


def shape(line: str) -> str:
    return " ".join(re.sub(r"\d+(?:\.\d+)?", "#", line).split())


@pytest.mark.parametrize(
    "page", [p for p, found in BLOCKS.items() if any(b.language in RUN for b in found)]
)
@pytest.mark.usefixtures("_one_figure")
def test_a_page_does_what_it_says(page: str, run: Calib) -> None:
    follow(page, run, slow=False)


@pytest.mark.slow
@pytest.mark.parametrize("page", [p for p, found in BLOCKS.items() if any(b.slow for b in found)])
def test_a_page_does_what_it_says_to_the_end(page: str, run: Calib) -> None:
    follow(page, run, slow=True)


PAGE = """\
% slow
```console
calib models
```

```{code-block} toml
:caption: a.toml

x = 1
```
"""


def test_marks_and_files_of_a_page_are_seen() -> None:
    first, second = blocks(PAGE)
    assert (first.language, first.text, first.slow) == ("console", "calib models\n", True)
    assert first.line == 3
    assert (second.caption, second.text, second.slow) == ("a.toml", "x = 1\n", False)
