"""Compare pages, and hold a page against the figures beside it.

What a page says follows from numbers. Where those agree up to rounding it must say the same, and
show the same digits but for the last. Where they moved within their tolerance, a reading beside a
threshold may be another and its words cannot be judged, but no number moves by far more than they.
"""

from __future__ import annotations

import base64
import binascii
import difflib
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from calib.batch.environment import sha256
from calib.check.numbers import NUMBER, without_numbers
from calib.check.outcome import Item, Status, claim
from calib.data.documents import decoded
from calib.report.compared import FOLDER as COMPARED

GROUP = "page and tables"
_IMAGE = re.compile(r"data:image/png;base64,([A-Za-z0-9+/=]*)")
_TAG = re.compile(r"<[^>]*>")
_PICTURE = re.compile(r"\[picture [^\]]*\]")
# Where a section begins, and what it is labelled by.
_SECTION = re.compile(r'(?=<section\b[^>]*aria-labelledby="([^"]*)")')
_SHOWN, _WIDTH = 6, 120
# What follows from numbers may have moved by so many times their part, but not beyond the other.
_TIMES, _MOST = 10.0, 0.15
_PLAIN = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻\u2212", "0123456789--")


class Judgement(NamedTuple):
    """Why a section cannot be judged, if so; by what part its numbers moved; whether these can."""

    excuse: str | None = None
    moved: float = 0.0
    numbers: bool = True


type Judged = Callable[[str], Judgement]
"""By the name of a section."""


def read_text(path: Path) -> str:
    """Return a text, whatever somebody made of it."""
    return decoded(path.read_bytes(), "replace")


def verify_images(page: str, folder: Path) -> list[Item]:
    """Check that every picture in a page is one of the folder's figures, and the other way."""
    figures = _figures(folder)
    shown = {sha256(_decoded(text)) for text in _IMAGE.findall(page)}
    wrong = "it is not the picture that index.html shows"
    items = [claim(GROUP, n, wrong) for key, n in figures.items() if key not in shown]
    if strangers := len(shown - set(figures)):
        wrong = f"{strangers} of its pictures are none of the figures"
        items.append(claim(GROUP, "index.html", wrong))
    return items or [claim(GROUP, "pictures in index.html", "", "they are the figures")]


def _figures(folder: Path) -> dict[str, str]:
    """Names of the PNG files of a folder by their hashes; a comparison in it has its own page."""
    names = (path.relative_to(folder).as_posix() for path in sorted(folder.rglob("*.png")))
    return {sha256((folder / n).read_bytes()): n for n in names if not n.startswith(f"{COMPARED}/")}


def _decoded(encoded: str) -> bytes:
    try:
        return base64.b64decode(encoded, validate=True)
    except binascii.Error:
        return b""


def own_pictures(content: str, folder: Path) -> list[bytes]:
    """Return the pictures of a page that are none of the folder's figures, in their order."""
    pictures = [_decoded(encoded) for encoded in _IMAGE.findall(content)]
    known = _figures(folder) if pictures else {}
    return [picture for picture in pictures if sha256(picture) not in known]


def compare_page(name: str, recorded: Path, written: Path, judged: Judged) -> Item:
    """Compare a page, or another text, by its path in two folders, with the one written again."""
    if (recorded / name).read_bytes() == (written / name).read_bytes():
        return Item(GROUP, name, Status.IDENTICAL)
    old, new = (_readable(folder, name) for folder in (recorded, written))
    if old.splitlines() == new.splitlines():
        note = "the same but for its pictures, which are compared as figures, or its line ends"
        return Item(GROUP, name, Status.WITHIN, note=note)
    if _PICTURE.findall(old) != _PICTURE.findall(new):
        return claim(GROUP, name, "it shows other pictures, or in another order")
    parts, again = (("", *_SECTION.split(text)) for text in (old, new))
    if parts[::2] != again[::2]:
        return claim(GROUP, name, "it has other sections")
    why: set[str | None] = set()
    apart: tuple[list[str], list[str]] = [], []
    for section, *texts in zip(parts[::2], parts[1::2], again[1::2], strict=True):
        excuse, moved, numbers = judged(section)
        one, other = (text.splitlines() for text in texts)
        if not _alike(one, other, moved):
            if _alike(one, other, None):
                excuse = None if numbers else excuse or "its numbers moved"
            why.add(excuse)
            apart[0].extend(one)
            apart[1].extend(other)
    if not why:
        note = "the same words; its numbers moved no more than those that they come from"
        return Item(GROUP, name, Status.WITHIN, note=note)
    said = differing_lines(*apart)
    if None in why:
        return claim(GROUP, name, said)
    return claim(GROUP, name, f"{'; '.join(sorted(filter(None, why)))}: {said}", sure=False)


def _readable(folder: Path, name: str) -> str:
    """Return a text with the names of the folder's figures in the place of the pictures."""
    text = read_text(folder / name)
    names = _figures(folder) if _IMAGE.search(text) else {}

    def named(match: re.Match[str]) -> str:
        return f"[picture {names.get(sha256(_decoded(match[1])), 'of its own')}]"

    return _IMAGE.sub(named, text)


def _alike(old: Sequence[str], new: Sequence[str], moved: float | None) -> bool:
    """Whether texts have the same words in order, and numbers that moved so far, if they count."""
    return len(old) == len(new) and all(
        a == b
        or (without_numbers(a) == without_numbers(b) and (moved is None or _near(a, b, moved)))
        for a, b in zip(old, new, strict=True)
    )


def _near(old: str, new: str, moved: float) -> bool:
    """Whether the numbers of two lines differ by little more than a unit of their last digit."""
    part = min(_TIMES * moved, _MOST)
    for a, b in zip(*(NUMBER.findall(_TAG.sub(" ", line)) for line in (old, new)), strict=False):
        if a == b:
            continue
        (one, unit), (other, other_unit) = parsed(a), parsed(b)
        allowed = 1.001 * max(unit, other_unit) + part * max(abs(one), abs(other))
        if not abs(one - other) <= allowed:
            return False
    return True


def parsed(text: str) -> tuple[float, float]:
    """Return a number as shown and one unit of its last digit."""
    plain = text.translate(_PLAIN).replace("\u00d710", "e").replace(",", "")
    mantissa, _, exponent = plain.lower().partition("e")
    decimals, power = len(mantissa.partition(".")[2]), int(exponent or 0)
    try:
        # Part of a hash may look like 4e5127: read so, it is infinite; as a power it would raise.
        return float(f"{mantissa}e{power}"), float(f"1e{power - decimals}")
    except ValueError:  # such as 1.2.3 of a version
        return float("nan"), 0.0


def differing_lines(old: Sequence[str], new: Sequence[str]) -> str:
    """Return how many lines two texts do not share, and the first of them."""
    # Below the names of the two.
    diff = list(difflib.unified_diff(old, new, n=0, lineterm=""))[2:]
    changed = [line for line in diff if not line.startswith("@@")]
    shown = "; ".join(f"{line[0]} {line[1:].strip()[:_WIDTH]}" for line in changed[:_SHOWN])
    return f"{len(changed)} lines differ: {shown}"
