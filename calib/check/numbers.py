"""Compare two documents entry by entry, each within its own tolerance."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from calib.check.montecarlo import Place
from calib.check.outcome import Item, Status
from calib.check.tolerances import ARITHMETIC, Of, Tolerance, natural_scale, tolerance_of

NUMBER = re.compile(
    r"[-+\u2212]?\d+(?:[.,]\d+)*(?:[eE][-+]?\d+|\u00d710[\u2070-\u2079\u00b2\u00b3\u00b9\u207b]+)?"
)
# Most entries by far; to ask whether they are an abstract collection takes longer than the rest.
_PLAIN = (float, str, int, type(None))
_ABSENT = object()
SAME_WORDS = "the same words"


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
    if isinstance(document, _PLAIN):
        yield place, document
    elif isinstance(document, Mapping):
        for key, value in document.items():
            yield from flatten(value, (*place, str(key)))
    elif isinstance(document, Sequence):
        for name, value in zip(_names(document), document, strict=True):
            yield from flatten(value, (*place, name))
    else:
        yield place, document


def _names(entries: Sequence[Any]) -> list[str]:
    for key in ("name", "key") if entries and isinstance(entries[0], Mapping) else ():
        names = [entry.get(key) for entry in entries if isinstance(entry, Mapping)]
        if len(names) == len(set(map(str, names))) == len(entries) and None not in names:
            return [str(name) for name in names]
    return [str(i) for i in range(len(entries))]


def compare_entries(
    recorded: Mapping[Place, Any],
    found: Mapping[Place, Any],
    group_of: Callable[[Place], str],
    drawn: Mapping[Place, float | None] | None = None,
) -> list[Item]:
    """Return one item for each entry, by path, the file first, of a document or a part of one.

    `drawn` is what Monte Carlo error allows, by path; None where there is no such error.
    """
    errors = drawn or {}
    paths = [*recorded, *(path for path in found if path not in recorded)]
    items = []
    for path in paths:
        tolerance = tolerance_of(path, found)
        name, group = f"{path[0]}: {'.'.join(path[1:])}", group_of(path)
        old, new = recorded.get(path, _ABSENT), found.get(path, _ABSENT)
        if old is _ABSENT or new is _ABSENT:
            items.append(_one_sided(group, name, old, new, tolerance))
        elif _equal(old, new):
            items.append(Item(group, name, Status.IDENTICAL, old, new))
        elif _is_number(old) and type(old) is type(new):
            size = _size(tolerance, path, min(abs(old), abs(new)), found, errors)
            items.append(_number(group, name, old, new, tolerance, size))
        else:
            same = tolerance.words and without_numbers(str(old)) == without_numbers(str(new))
            status = Status.WITHIN if same else _beyond(tolerance)
            note = SAME_WORDS if same else tolerance.kind
            items.append(Item(group, name, status, old, new, note=note))
    return items


def _one_sided(group: str, name: str, old: Any, new: Any, tolerance: Tolerance) -> Item:
    if old is _ABSENT:
        return Item(group, name, _beyond(tolerance), found=new, note="missing")
    return Item(group, name, _beyond(tolerance), old, note="not computed by this version")


def _size(
    tolerance: Tolerance, path: Place, smaller: float, found: Mapping[Place, Any],
    errors: Mapping[Place, float | None],
) -> float | None:  # fmt: skip
    """Largest difference that is taken for the same; None where none can be stated."""
    if tolerance == ARITHMETIC and isinstance(found[path], int):
        return 0.0  # a count, or a seed
    scale = natural_scale(tolerance.of, path, found, errors)
    if scale is None:
        return None
    if tolerance.of is Of.RATIO:
        return (tolerance.part - 1.0) * smaller
    return tolerance.part * scale + tolerance.floor


def _number(
    group: str, name: str, old: float, new: float, tolerance: Tolerance, size: float | None
) -> Item:
    if math.isnan(old) or math.isnan(new):
        return Item(group, name, Status.DIFFERENT, old, new, note="not a number")
    rounded = 1e-6 * max(abs(old), abs(new)) if isinstance(old, float) else 0.0
    if abs(old - new) <= max(size or 0.0, rounded):
        return Item(group, name, Status.WITHIN, old, new, size, tolerance.kind)
    if size is None:
        note = "tail too heavy for a Monte Carlo error"
        return Item(group, name, Status.UNJUDGED, old, new, note=note)
    return Item(group, name, _beyond(tolerance), old, new, size, tolerance.kind)


def _beyond(tolerance: Tolerance) -> Status:
    return Status.DIFFERENT if tolerance.judged else Status.UNJUDGED


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
