"""Compare figures: byte by byte, or as an eye would where other draws or versions drew them."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from calib.models.base import Array
from calib.reproduce.items import Item, Status

__all__ = ["GROUP", "compare_figure", "compare_pictures", "compare_print", "thumbnails"]

GROUP = "figures"
# Root mean square difference of grey levels from 0 to 1 of figures reduced to 64 x 64. Other draws
# of the same posterior move a figure by up to 0.05, most by 0.02; two different ones by over 0.04.
_ALIKE = 0.08
_SIDE = 64


def thumbnails(folder: Path) -> dict[str, Array]:
    """Return the PNG files below a folder by name, reduced to grey levels of shape (64, 64)."""
    found = {}
    for path in sorted(folder.rglob("*.png")):
        image = _thumbnail(path.read_bytes())
        if image is not None:
            found[path.relative_to(folder).as_posix()] = image
    return found


def compare_figure(
    name: str, recorded: bytes, drawn: bytes, others: Mapping[str, Array], *, exact: bool
) -> Item:
    """Compare a figure with the one drawn again.

    Parameters
    ----------
    name : str
        Its path in the folder.
    recorded, drawn : bytes
    others : mapping of str to ndarray
        All figures drawn again, as `thumbnails` returns them.
    exact : bool
        Whether the same draws were drawn by the same code and versions.
    """
    if recorded == drawn:
        return Item(GROUP, name, Status.IDENTICAL)
    if _pixels(recorded) == _pixels(drawn):
        return Item(GROUP, name, Status.WITHIN, note="the same picture, stored otherwise")
    image = _thumbnail(recorded)
    if image is None:
        return Item(GROUP, name, Status.DIFFERENT, note="it is no readable image")
    apart = {other: _distance(image, shown) for other, shown in others.items()}
    nearest = min(apart, key=lambda other: apart[other])
    facts: dict[str, Any] = {"recorded": round(apart[name], 4), "found": 0.0, "allowed": _ALIKE}
    if nearest != name:
        note = f"it looks like {nearest}, not like the one drawn again"
        return Item(GROUP, name, Status.DIFFERENT, note=note, **facts)
    if apart[name] > _ALIKE:
        note = "it does not look like the one drawn again (grey difference)"
        return Item(GROUP, name, Status.DIFFERENT, note=note, **facts)
    if exact:
        note = "the numbers are the same to the last bit, the figure is not"
        return Item(GROUP, name, Status.DIFFERENT, note=note)
    return Item(GROUP, name, Status.WITHIN, note="it looks like the one drawn again", **facts)


def compare_pictures(
    page: str, recorded: Sequence[bytes], drawn: Sequence[bytes], *, exact: bool
) -> list[Item]:
    """Compare the pictures that a page alone has with those drawn again, in their order.

    Parameters
    ----------
    page : str
        Its path in the folder.
    recorded, drawn : sequence of bytes
        PNG files.
    exact : bool
        As for `compare_figure`.
    """
    if len(recorded) != len(drawn):
        note = f"it has {len(recorded)} pictures of its own, not {len(drawn)}"
        return [Item(GROUP, page, Status.DIFFERENT, note=note)]
    names = [f"{page}: picture {i + 1}" for i in range(len(drawn))]
    reduced = {name: _thumbnail(image) for name, image in zip(names, drawn, strict=True)}
    others = {name: image for name, image in reduced.items() if image is not None}
    return [
        compare_figure(name, old, new, others, exact=exact)
        for name, old, new in zip(names, recorded, drawn, strict=True)
    ]


def compare_print(name: str, recorded: bytes, drawn: bytes, *, exact: bool) -> Item:
    """Compare a figure as PDF, of which only the bytes can be compared."""
    if recorded == drawn:
        return Item(GROUP, name, Status.IDENTICAL)
    if exact:
        note = "the numbers are the same to the last bit, the figure is not"
        return Item(GROUP, name, Status.DIFFERENT, note=note)
    return Item(GROUP, name, Status.UNJUDGED, note="for print; the PNG beside it is compared")


def _distance(one: Array, other: Array) -> float:
    return float(np.sqrt(np.mean(np.square(one - other))))


def _pixels(content: bytes) -> tuple[tuple[int, int], bytes] | None:
    image = _opened(content)
    return None if image is None else (image.size, image.tobytes())


def _thumbnail(content: bytes) -> Array | None:
    image = _opened(content)
    if image is None:
        return None
    grey = image.convert("L").resize((_SIDE, _SIDE), Image.Resampling.BOX)
    return np.asarray(grey, dtype=np.float64) / 255.0


def _opened(content: bytes) -> Image.Image | None:
    try:
        with Image.open(io.BytesIO(content), formats=("PNG",)) as image:
            return image.convert("RGB")
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return None
