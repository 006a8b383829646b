"""Compare figures as an eye would: other processors and other draws move them a little."""

from __future__ import annotations

import io
import re
import zlib
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from calib.check.numbers import NUMBER
from calib.check.outcome import Item, Status
from calib.models.base import Array

GROUP = "figures"
# Root mean square difference of grey levels from 0 to 1 of figures reduced to 64 x 64. Other draws
# of the same posterior move a figure by up to 0.05, most by 0.02; two different ones by over 0.04.
_ALIKE = 0.08
_SIDE = 64
_STREAM = re.compile(rb"stream\r?\n(.*?)\r?\nendstream", re.DOTALL)


def thumbnails(folder: Path) -> dict[str, Array]:
    """Return the PNG files below a folder by name, reduced to grey levels of shape (64, 64)."""
    found = {}
    for path in sorted(folder.rglob("*.png")):
        image = _thumbnail(path.read_bytes())
        if image is not None:
            found[path.relative_to(folder).as_posix()] = image
    return found


def compare_figure(
    name: str, recorded: bytes, drawn: bytes, others: Callable[[], Mapping[str, Array]]
) -> Item:
    """Compare a figure with the one drawn again, among the `thumbnails` of all drawn again.

    These are asked for where the figure is not the same byte for byte.
    """
    if recorded == drawn:
        return Item(GROUP, name, Status.IDENTICAL)
    image = _thumbnail(recorded)
    if image is None:
        return Item(GROUP, name, Status.DIFFERENT, note="it is no readable image")
    apart = {other: _distance(image, shown) for other, shown in others().items()}
    nearest = min(apart, key=lambda other: apart[other])
    facts: dict[str, Any] = {"recorded": round(apart[name], 4), "found": 0.0, "allowed": _ALIKE}
    if apart[nearest] < apart[name]:
        return _like_another(name, nearest, **facts)
    if apart[name] > _ALIKE:
        note = "it does not look like the one drawn again (grey difference)"
        return Item(GROUP, name, Status.DIFFERENT, note=note, **facts)
    return Item(GROUP, name, Status.WITHIN, note="it looks like the one drawn again", **facts)


def compare_pictures(page: str, recorded: Sequence[bytes], drawn: Sequence[bytes]) -> list[Item]:
    """Compare the PNG files that a page alone has with those drawn again, in their order."""
    if len(recorded) != len(drawn):
        note = f"it has {len(recorded)} pictures of its own, not {len(drawn)}"
        return [Item(GROUP, page, Status.DIFFERENT, note=note)]
    names = [f"{page}: picture {i + 1}" for i in range(len(drawn))]

    @cache
    def others() -> dict[str, Array]:
        reduced = {name: _thumbnail(image) for name, image in zip(names, drawn, strict=True)}
        return {name: image for name, image in reduced.items() if image is not None}

    return [
        compare_figure(name, old, new, others)
        for name, old, new in zip(names, recorded, drawn, strict=True)
    ]


def compare_prints(recorded: Mapping[str, bytes], drawn: Mapping[str, bytes]) -> list[Item]:
    """Compare figures as PDF that are in both by what is drawn in them, numbers apart."""

    @cache
    def inks() -> dict[str, Counter[str]]:
        return {name: _ink(content) for name, content in drawn.items()}

    items = []
    for name in sorted(set(recorded) & set(drawn)):
        if recorded[name] == drawn[name]:
            items.append(Item(GROUP, name, Status.IDENTICAL))
            continue
        ink = _ink(recorded[name])
        apart = {other: _unshared(ink, shown) for other, shown in inks().items()}
        nearest = min(apart, key=lambda other: apart[other])
        if not ink or apart[nearest] < apart[name]:
            items.append(_like_another(name, nearest))
        else:
            note = "it draws what the one drawn again does; the PNG beside it is compared"
            items.append(Item(GROUP, name, Status.WITHIN, note=note))
    return items


def _like_another(name: str, nearest: str, **facts: Any) -> Item:
    note = f"it looks like {nearest}, not like the one drawn again"
    return Item(GROUP, name, Status.DIFFERENT, note=note, **facts)


def _ink(content: bytes) -> Counter[str]:
    """Count what the streams of a PDF file draw, with a sign in the place of each number."""
    found: Counter[str] = Counter()
    for stream in _STREAM.findall(content):
        try:
            text = zlib.decompress(stream).decode("latin-1")
        except zlib.error:
            continue
        found.update(NUMBER.sub("#", text).splitlines())
    return found


def _unshared(one: Counter[str], other: Counter[str]) -> float:
    """Part of what two files draw that only one of them does."""
    total = (one | other).total()
    return 1.0 - (one & other).total() / total if total else 0.0


def _distance(one: Array, other: Array) -> float:
    return float(np.sqrt(np.mean(np.square(one - other))))


def _thumbnail(content: bytes) -> Array | None:
    try:
        with Image.open(io.BytesIO(content), formats=("PNG",)) as image:
            grey = image.convert("L").resize((_SIDE, _SIDE), Image.Resampling.BOX)
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return None
    return np.asarray(grey, dtype=np.float64) / 255.0
