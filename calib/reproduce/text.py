"""Compare pages and tables, and hold a page against the figures beside it."""

from __future__ import annotations

import base64
import binascii
import difflib
import re
from pathlib import Path

from calib.manifest import sha256
from calib.reproduce.items import Item, Status
from calib.reproduce.numbers import without_numbers

__all__ = ["GROUP", "compare_text", "verify_images"]

GROUP = "page and tables"
_IMAGE = re.compile(r"data:image/png;base64,([A-Za-z0-9+/=]*)")
_TAG = re.compile(r"<[^>]*>")
_SHOWN = 3
_WIDTH = 120


def verify_images(page: str, folder: Path) -> list[Item]:
    """Check that every picture in a page is one of the folder's figures, and the other way."""
    figures = {
        sha256(path.read_bytes()): path.relative_to(folder).as_posix()
        for path in sorted(folder.rglob("*.png"))
    }
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


def _hash(encoded: str) -> str:
    try:
        return sha256(base64.b64decode(encoded, validate=True))
    except binascii.Error:
        return ""


def compare_text(name: str, recorded: bytes, written: bytes, *, exact: bool, why_not: str) -> Item:
    """Compare a file of text with the one written again.

    Parameters
    ----------
    name : str
    recorded, written : bytes
    exact : bool
        Whether the same numbers were written by the same code and versions.
    why_not : str
        Why differences cannot be judged otherwise.
    """
    if recorded == written:
        return Item(GROUP, name, Status.IDENTICAL)
    old, new = _readable(recorded), _readable(written)
    if exact:
        return Item(GROUP, name, Status.DIFFERENT, note=_differing(old, new))
    old_words, new_words = (
        [without_numbers(_TAG.sub(" ", line)).strip() for line in text] for text in (old, new)
    )
    if old_words == new_words:
        lines = sum(a != b for a, b in zip(old, new, strict=True))
        note = f"{why_not}; the words are the same, {lines} lines differ in their numbers"
        return Item(GROUP, name, Status.UNJUDGED, note=note)
    note = f"{why_not}; beside numbers, {_differing(old_words, new_words)}"
    return Item(GROUP, name, Status.UNJUDGED, note=note)


def _readable(content: bytes) -> list[str]:
    text = content.decode("utf-8", errors="replace")
    return _IMAGE.sub("[picture]", text).splitlines()


def _differing(old: list[str], new: list[str]) -> str:
    changed = [
        line
        for line in difflib.unified_diff(old, new, "recorded", "written again", n=0, lineterm="")
        if line[0] in "+-" and not line.startswith(("---", "+++"))
    ]
    shown = "; ".join(f"{line[0]} {line[1:].strip()[:_WIDTH]}" for line in changed[: 2 * _SHOWN])
    return f"{len(changed)} lines differ: {shown}" if changed else "a picture differs"
