"""Compare pages and tables, and hold a page against the figures beside it."""

from __future__ import annotations

import base64
import binascii
import difflib
import re
from collections.abc import Sequence
from pathlib import Path

from calib.manifest import sha256
from calib.reproduce.items import Item, Status
from calib.reproduce.numbers import without_numbers

__all__ = [
    "GROUP", "compare_text", "differing_lines", "own_pictures", "readable", "verify_images",
]  # fmt: skip

GROUP = "page and tables"
_IMAGE = re.compile(r"data:image/png;base64,([A-Za-z0-9+/=]*)")
_TAG = re.compile(r"<[^>]*>")
_PICTURE = re.compile(r"\[picture [^\]]*\]")
_SHOWN = 3
_WIDTH = 120


def verify_images(page: str, folder: Path) -> list[Item]:
    """Check that every picture in a page is one of the folder's figures, and the other way."""
    figures = _figures(folder)
    shown = {_hash(match) for match in _IMAGE.findall(page)}
    items = [
        Item(GROUP, name, Status.DIFFERENT, note="it is not the picture that index.html shows")
        for key, name in figures.items()
        if key not in shown
    ]
    strangers = len(shown - set(figures))
    if strangers:
        note = f"{strangers} of its pictures are none of the figures"
        items.append(Item(GROUP, "index.html", Status.DIFFERENT, note=note))
    return items or [
        Item(GROUP, "pictures in index.html", Status.IDENTICAL, note="they are the figures")
    ]


def _figures(folder: Path) -> dict[str, str]:
    """Names of the PNG files of a folder by their hashes."""
    return {
        sha256(path.read_bytes()): path.relative_to(folder).as_posix()
        for path in sorted(folder.rglob("*.png"))
    }


def _hash(encoded: str) -> str:
    return sha256(_decoded(encoded))


def _decoded(encoded: str) -> bytes:
    try:
        return base64.b64decode(encoded, validate=True)
    except binascii.Error:
        return b""


def readable(content: bytes, folder: Path) -> list[str]:
    """Return the lines of a text, with the names of the folder's figures in their place."""
    text = content.decode("utf-8", errors="replace")
    names = _figures(folder) if _IMAGE.search(text) else {}
    return _IMAGE.sub(
        lambda m: f"[picture {names.get(_hash(m[1]), 'of another file')}]", text
    ).splitlines()


def own_pictures(content: bytes, folder: Path) -> list[bytes]:
    """Return the pictures of a page that are none of the folder's figures, in their order."""
    known = _figures(folder)
    encoded = _IMAGE.findall(content.decode("utf-8", errors="replace"))
    return [_decoded(text) for text in encoded if _hash(text) not in known]


def compare_text(
    name: str,
    recorded: Sequence[str],
    written: Sequence[str],
    *,
    same: bool,
    exact: bool,
    why_not: str,
) -> Item:
    """Compare a file of text with the one written again.

    Parameters
    ----------
    name : str
    recorded, written : sequence of str
        Their lines, as `readable` returns them.
    same : bool
        Whether their bytes are the same.
    exact : bool
        Whether the same numbers were written by the same code and versions.
    why_not : str
        Why differences cannot be judged otherwise.
    """
    if same:
        return Item(GROUP, name, Status.IDENTICAL)
    if list(recorded) == list(written):
        note = "the same but for its pictures, which are compared as figures, or its line ends"
        return Item(GROUP, name, Status.WITHIN, note=note)
    if exact:
        return Item(GROUP, name, Status.DIFFERENT, note=differing_lines(recorded, written))
    old, new = ("\n".join(text) for text in (recorded, written))
    if _PICTURE.findall(old) != _PICTURE.findall(new):
        note = "it shows other pictures, or in another order"
        return Item(GROUP, name, Status.DIFFERENT, note=note)
    old_words, new_words = (
        [without_numbers(_TAG.sub(" ", line)).strip() for line in text]
        for text in (recorded, written)
    )
    if old_words == new_words:
        lines = sum(a != b for a, b in zip(recorded, written, strict=True))
        note = f"{why_not}; the words are the same, {lines} lines differ in their numbers"
        return Item(GROUP, name, Status.UNJUDGED, note=note)
    note = f"{why_not}; beside numbers, {differing_lines(old_words, new_words)}"
    return Item(GROUP, name, Status.UNJUDGED, note=note)


def differing_lines(old: Sequence[str], new: Sequence[str]) -> str:
    """Return how many lines two texts do not share, and the first of them."""
    changed = [
        line
        for line in difflib.unified_diff(old, new, "recorded", "written again", n=0, lineterm="")
        if line[0] in "+-" and not line.startswith(("---", "+++"))
    ]
    shown = "; ".join(f"{line[0]} {line[1:].strip()[:_WIDTH]}" for line in changed[: 2 * _SHOWN])
    return f"{len(changed)} lines differ: {shown}"
