"""Compare two documents number by number.

How strictly depends on what they themselves show, not on what a folder claims. Where nearly all
numbers of a section are the same to the last bit, the work was the same, and the others must be
so too. Where they all differ a little, another processor rounded differently: if they agree a
thousand times better than they need to, the draws are the same ones, and no number may stand
out. Otherwise the draws are others, and each number has its allowance.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from calib.reproduce.allowances import MONTE_CARLO, Allowance
from calib.reproduce.items import Item, Status
from calib.reproduce.montecarlo import Place

__all__ = ["Section", "compare_section", "flatten", "read_json", "same_words", "without_numbers"]

_MOSTLY = 0.9
_ROUNDED, _STANDS_OUT = 1e-3, 0.05
# The last bits of a sum, which libraries round as they like; and of what has no stated rule.
_LAST_BITS, _DETERMINISTIC = 1e-9, 1e-6
_NUMBER = re.compile(
    r"[-+\u2212]?\d+(?:[.,]\d+)*(?:[eE][-+]?\d+|\u00d710[\u2070-\u2079\u00b2\u00b3\u00b9\u207b]+)?"
)


@dataclass(frozen=True)
class Section:
    """A part of a document whose numbers stand and fall together.

    Parameters
    ----------
    file : str
        The file it is in.
    place : tuple of str
        Where in the file.
    recorded, found : mapping
        Entries by path below `place`.
    """

    file: str
    place: Place
    recorded: Mapping[Place, Any]
    found: Mapping[Place, Any]

    @property
    def exact(self) -> bool:
        """Whether nearly all numbers are the same to the last bit."""
        both = [path for path in self.recorded if path in self.found]
        floats = [p for p in both if isinstance(self.recorded[p], float)] or both
        same = sum(_equal(self.recorded[p], self.found[p]) for p in floats)
        return same >= _MOSTLY * len(floats)


def read_json(path: Path) -> dict[str, Any]:
    """Return a JSON object; empty where the file is missing or damaged."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def flatten(document: Any, place: Place = ()) -> Iterator[tuple[Place, Any]]:
    """Yield the path and the value of every entry of a JSON document.

    Entries of a list are known by their ``name`` or ``key`` where each has its own, otherwise by
    their position.
    """
    if isinstance(document, Mapping):
        for key, value in document.items():
            yield from flatten(value, (*place, str(key)))
    elif isinstance(document, Sequence) and not isinstance(document, str):
        for name, value in zip(_names(document), document, strict=True):
            yield from flatten(value, (*place, name))
    else:
        yield place, document


def _names(entries: Sequence[Any]) -> list[str]:
    for key in ("name", "key"):
        names = [entry.get(key) for entry in entries if isinstance(entry, Mapping)]
        if len(names) == len(set(map(str, names))) == len(entries) and None not in names:
            return [str(name) for name in names]
    return [str(i) for i in range(len(entries))]


def compare_section(
    section: Section,
    allowances: Mapping[Place, Allowance],
    *,
    group_of: Callable[[Place], str],
    exact: bool | None = None,
) -> list[Item]:
    """Return one item for each entry of a section.

    Parameters
    ----------
    section : Section
    allowances : mapping
        By path; other numbers may differ by a millionth, and are not judged beyond.
    group_of : callable
        Names the group of an entry, within which numbers that stand out are looked for.
    exact : bool, optional
        Whether every entry must be identical: by default as the section itself shows.
    """
    strict = section.exact if exact is None else exact
    paths = [*section.recorded, *(p for p in section.found if p not in section.recorded)]
    items = {p: _compare(section, p, allowances.get(p), strict, group_of(p)) for p in paths}
    if not strict:
        drawn = {p: item for p, item in items.items() if _is_drawn(allowances.get(p))}
        for group in {item.group for item in drawn.values()}:
            items |= _outliers({p: item for p, item in drawn.items() if item.group == group})
    return list(items.values())


def _outliers(items: Mapping[Place, Item]) -> dict[Place, Item]:
    """Numbers that stand out where the others agree far better than they need to."""
    shares = {path: item.share for path, item in items.items() if item.share is not None}
    if not shares or median(shares.values()) > _ROUNDED:
        return {}
    return {
        path: _restated(items[path], "the numbers beside it agree far better")
        for path, share in shares.items()
        if share > _STANDS_OUT and items[path].status is Status.WITHIN
    }


def _is_drawn(allowance: Allowance | None) -> bool:
    """Whether a number is drawn: estimates amplify rounding each in its own way."""
    return allowance is not None and allowance.why == MONTE_CARLO


def _restated(item: Item, note: str) -> Item:
    return Item(
        item.group, item.name, Status.DIFFERENT, item.recorded, item.found, item.allowed, note
    )


def _compare(
    section: Section, path: Place, allowance: Allowance | None, strict: bool, group: str
) -> Item:
    name = f"{section.file}: {'.'.join((*section.place, *path))}"
    absent = object()
    old, new = section.recorded.get(path, absent), section.found.get(path, absent)
    if old is absent or new is absent:
        note = "missing" if old is absent else "not computed by this version"
        value = {"found": new} if old is absent else {"recorded": old}
        chance = not strict and allowance is not None and _no_rule(allowance)
        status = Status.UNJUDGED if chance else Status.DIFFERENT
        return Item(group, name, status, note=note, **value)
    if _equal(old, new):
        return Item(group, name, Status.IDENTICAL, old, new)
    if strict:
        note = "all else is the same to the last bit"
        return Item(group, name, Status.DIFFERENT, old, new, note=note)
    status, allowed, note = _judge(old, new, allowance)
    return Item(group, name, status, old, new, allowed, note)


def _judge(old: Any, new: Any, allowance: Allowance | None) -> tuple[Status, float | None, str]:
    numbers = _is_number(old) and _is_number(new)
    if allowance is None:
        if not numbers:
            return Status.DIFFERENT, None, ""
        allowed = _DETERMINISTIC * max(abs(old), abs(new))
        status = Status.WITHIN if abs(old - new) <= allowed else Status.UNJUDGED
        return status, allowed, "" if status is Status.WITHIN else "no allowance is stated for it"
    if allowance.words and isinstance(old, str) and isinstance(new, str):
        same = same_words(old, new)
        return (Status.WITHIN if same else Status.UNJUDGED), None, "the same words" * same
    if _no_rule(allowance):
        rounded = numbers and abs(old - new) <= _DETERMINISTIC * max(abs(old), abs(new))
        return (Status.WITHIN if rounded else Status.UNJUDGED), None, allowance.why
    if not numbers:
        return Status.DIFFERENT, None, ""
    size = allowance.size
    if allowance.factor is not None:
        size = (allowance.factor - 1.0) * min(abs(old), abs(new))
    within = size is not None and abs(old - new) <= size
    if not within and abs(old - new) <= _LAST_BITS * max(abs(old), abs(new)):
        return Status.WITHIN, None, "the last bits"
    return (Status.WITHIN if within else Status.DIFFERENT), size, allowance.why


def _no_rule(allowance: Allowance) -> bool:
    return allowance.size is None and allowance.factor is None and not allowance.words


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _equal(old: Any, new: Any) -> bool:
    if isinstance(old, float) and isinstance(new, float) and math.isnan(old) and math.isnan(new):
        return True
    # 1 and True, or 1 and 1.0, are not the same entry.
    return type(old) is type(new) and bool(old == new)


def same_words(old: str, new: str) -> bool:
    """Whether two texts differ in their numbers alone."""
    return without_numbers(old) == without_numbers(new)


def without_numbers(text: str) -> str:
    """Return a text with a sign in the place of each number."""
    return _NUMBER.sub("#", text)
