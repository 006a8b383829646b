"""Figures as PNG files."""

from __future__ import annotations

import io

from matplotlib.figure import Figure

__all__ = ["png"]


def png(figure: Figure, dpi: int = 150) -> bytes:
    """Render a figure, with a palette of 256 colours: a third of the size, no visible loss."""
    from PIL import Image

    full, small = io.BytesIO(), io.BytesIO()
    figure.savefig(full, format="png", dpi=dpi)
    full.seek(0)
    with Image.open(full) as image:
        image.convert("RGB").quantize(256).save(small, format="png")
    return small.getvalue()
