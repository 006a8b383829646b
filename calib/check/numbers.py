"""Compare two documents entry by entry, each within its own tolerance."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from calib.check.outcome import Item, Status
from calib.check.tolerances import ARITHMETIC, Entries, Tolerance, natural_scale, tolerance_of
from calib.data.documents import inside
from calib.validation.montecarlo import Errors, Place

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
