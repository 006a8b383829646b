"""Compare two documents entry by entry, each within its own tolerance.

Compare pages, and hold a page against the figures beside it.

What a page says follows from numbers. Where those agree up to rounding it must say the same, and
show the same digits but for the last. Where they moved within their tolerance, a reading beside a
threshold may be another and its words cannot be judged, but no number moves by far more than they.
"""

from __future__ import annotations

import base64
import binascii
import difflib
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from calib.batch.environment import sha256
from calib.check.outcome import Item, Status, claim
from calib.check.tolerances import ARITHMETIC, Entries, Tolerance, natural_scale, tolerance_of
from calib.data.files import decoded, inside
from calib.report.compared import FOLDER as COMPARED
from calib.validation.validate import Errors, Place

NUMBER = re.compile(
    r"[-+\u2212]?\d+(?:[.,]\d+)*(?:[eE][-+]?\d+|\u00d710[\u2070-\u2079\u00b2\u00b3\u00b9\u207b]+)?"
)
# Most entries by far; to ask whether they are an abstract collection takes longer than the rest.
_PLAIN = (float, str, int, type(None))
_ABSENT = object()
SAME_WORDS = "the same words"


def flatten(document: Any, place: Place = ()) -> Iterator[tuple[Place, Any]]:
    """Yield path and value of every entry of a JSON document.

    Those of a list are known by their ``name`` or ``key`` where each has its own, or by position.
    """
    if isinstance(document, _PLAIN):
        yield place, document
    elif isinstance(document, Mapping | list | tuple):
        named = document if isinstance(document, Mapping) else _named(document)
        for key, value in named.items():
            yield from flatten(value, (*place, str(key)))
    else:
        yield place, document


def _named(entries: Sequence[Any]) -> Mapping[Any, Any]:
    for key in ("name", "key") if entries and isinstance(entries[0], Mapping) else ():
        names = [inside(entry).get(key) for entry in entries]
        if None not in names and len(set(map(str, names))) == len(entries):
            return dict(zip(map(str, names), entries, strict=True))
    return dict(enumerate(entries))


def compare_entries(
    recorded: Entries, found: Entries, group_of: Callable[[Place], str],
    drawn: Errors | None = None,
) -> list[Item]:  # fmt: skip
    """Return one item for each entry, by path, the file first, of a document or a part of one.

    `drawn` is what Monte Carlo error allows, by path; None where there is no such error.
    """
    items = []
    for path in [*recorded, *(path for path in found if path not in recorded)]:
        name, group = f"{path[0]}: {'.'.join(path[1:])}", group_of(path)
        old, new = recorded.get(path, _ABSENT), found.get(path, _ABSENT)
        if _equal(old, new):
            items.append(Item(group, name, Status.IDENTICAL, old, new))
            continue
        tolerance = tolerance_of(path, found)
        beyond = Status.DIFFERENT if tolerance.judged else Status.UNJUDGED
        if old is _ABSENT:
            items.append(Item(group, name, beyond, found=new, note="missing"))
        elif new is _ABSENT:
            items.append(Item(group, name, beyond, old, note="not computed by this version"))
        elif _is_number(old) and type(old) is type(new):
            size = _size(tolerance, path, old, found, drawn or {})
            items.append(_number(Item(group, name, beyond, old, new, size, tolerance.kind)))
        elif tolerance.words and without_numbers(str(old)) == without_numbers(str(new)):
            items.append(Item(group, name, Status.WITHIN, old, new, note=SAME_WORDS))
        else:
            items.append(Item(group, name, beyond, old, new, note=tolerance.kind))
    return items


def _size(
    tolerance: Tolerance, path: Place, old: float, entries: Entries, errors: Errors
) -> float | None:
    """Largest difference that is taken for the same; None where none can be stated."""
    new = entries[path]
    if tolerance == ARITHMETIC and isinstance(new, int):
        return 0.0  # a count, or a seed
    scale = natural_scale(tolerance.of, path, entries, errors)
    if scale is not None and tolerance.of == "ratio":
        return float((tolerance.part - 1.0) * min(abs(old), abs(new)))
    return None if scale is None else tolerance.part * scale + tolerance.floor


def _number(item: Item) -> Item:
    """Judge two numbers that are not equal, given how they are judged beyond what is allowed."""
    old, new = item.recorded, item.found
    if math.isnan(old) or math.isnan(new):
        return replace(item, status=Status.DIFFERENT, allowed=None, note="not a number")
    rounded = 1e-6 * max(abs(old), abs(new)) if isinstance(old, float) else 0.0
    if abs(old - new) <= max(item.allowed or 0.0, rounded):
        return replace(item, status=Status.WITHIN)
    heavy = replace(item, status=Status.UNJUDGED, note="tail too heavy for a Monte Carlo error")
    return heavy if item.allowed is None else item


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _equal(old: Any, new: Any) -> bool:
    if isinstance(old, float) and isinstance(new, float) and math.isnan(old) and math.isnan(new):
        return True
    # 1 and True, or 1 and 1.0, are not the same entry.
    return type(old) is type(new) and bool(old == new)


def without_numbers(text: str) -> str:
    """Return a text with a sign in the place of each number."""
    return NUMBER.sub("#", text)


GROUP = "page and tables"
_IMAGE = re.compile(r"data:image/png;base64,([A-Za-z0-9+/=]*)")
_TAG = re.compile(r"<[^>]*>")
_PICTURE = re.compile(r"\[picture [^\]]*\]")
# Where a section begins, and what it is labelled by.
_SECTION = re.compile(r'(?=<section\b[^>]*aria-labelledby="([^"]*)")')
_SHOWN, _WIDTH = 6, 120
# What follows from numbers may have moved by so many times their part, but not beyond the other.
_TIMES, _MOST = 10.0, 0.15
_AS_ASCII = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻\u2212", "0123456789--")


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
    plain = text.translate(_AS_ASCII).replace("\u00d710", "e").replace(",", "")
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
