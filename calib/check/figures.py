"""Compare figures as an eye would: other processors and other draws move them a little.

Pictures are compared by their grey levels, and figures for print by what is drawn in them, numbers
apart, among all that are drawn again: one may look like another.
"""

from __future__ import annotations

import io
import re
import zlib
from collections import Counter
from collections.abc import Callable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from calib.check.outcome import Item, Status, claim
from calib.check.text import NUMBER
from calib.models.base import Array

GROUP = "figures"
# Root mean square difference of grey levels from 0 to 1 of figures reduced to 64 x 64. Other draws
# move a figure by up to 0.05, most by 0.02; two figures are apart by over 0.04.
_ALIKE, _SIDE = 0.08, 64
_STREAM = re.compile(rb"stream\r?\n(.*?)\r?\nendstream", re.DOTALL)


def compare_figure(name: str, recorded: bytes, drawn: Mapping[str, Path | bytes]) -> Item:
    """Compare a figure with the one of its name among all drawn again, all of them PNG or PDF.

    They are looked at where it is not the same byte for byte.
    """
    again = _content(drawn[name])
    if recorded == again:
        return Item(GROUP, name, Status.IDENTICAL)
    printed = again.startswith(b"%PDF")
    look: Callable[[bytes], Any] = _ink if printed else _thumbnail
    distance: Callable[[Any, Any], float] = _unshared if printed else _distance
    seen = look(recorded)
    if seen is None:
        return claim(GROUP, name, "it is no readable image")
    shown = {other: look(_content(image)) for other, image in drawn.items()}
    apart = {other: distance(seen, one) for other, one in shown.items() if one is not None}
    nearest, own = min(apart, key=lambda other: apart[other]), apart[name]
    # Other draws move every line of a figure for print; the picture beside it is compared.
    allowed, status, note = 1.0 if printed else _ALIKE, Status.DIFFERENT, "it does not look like"
    if apart[nearest] < own:
        note = f"it looks like {nearest}, not like"
    elif own <= allowed:
        status, note = Status.WITHIN, "it looks like"
    return Item(GROUP, name, status, round(own, 4), 0.0, allowed, f"{note} the one drawn again")


def _content(image: Path | bytes) -> bytes:
    return image.read_bytes() if isinstance(image, Path) else image


@lru_cache(maxsize=100)
def _ink(content: bytes) -> Counter[str] | None:
    """Count what the streams of a PDF file draw, with a sign in the place of each number."""
    found: Counter[str] = Counter()
    for stream in _STREAM.findall(content):
        try:
            text = zlib.decompress(stream).decode("latin-1")
        except zlib.error:
            continue
        found.update(NUMBER.sub("#", text).splitlines())
    return found or None


def _unshared(one: Counter[str], other: Counter[str]) -> float:
    """Part of what two files draw that only one of them does."""
    return 1.0 - (one & other).total() / (one | other).total()


@lru_cache(maxsize=100)
def _thumbnail(content: bytes) -> Array | None:
    """Reduce a PNG file to grey levels of shape (64, 64)."""
    try:
        with Image.open(io.BytesIO(content), formats=("PNG",)) as image:
            grey = image.convert("L").resize((_SIDE, _SIDE), Image.Resampling.BOX)
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return None
    return np.asarray(grey, dtype=np.float64) / 255.0


def _distance(one: Array, other: Array) -> float:
    return float(np.sqrt(np.mean(np.square(one - other))))
