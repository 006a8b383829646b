"""Figures as files: the same bytes every time, whatever the user's own settings are.

Ticks are placed when a figure is drawn, so the style holds then as well.
"""

from __future__ import annotations

import io
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg, RendererAgg
from matplotlib.figure import Figure

from calib.report.figures.plate import Plate
from calib.report.figures.style import style

__all__ = ["pdf_bytes", "png", "png_bytes", "png_size"]

_DPI = 150


class _Canvas(FigureCanvasAgg):
    """Its renderers share what they know of formulas: parsing one takes longer than drawing it."""

    _parser: Any = None

    def get_renderer(self) -> RendererAgg:
        renderer: RendererAgg = super().get_renderer()  # type: ignore[no-untyped-call]
        _Canvas._parser = _Canvas._parser or renderer.mathtext_parser
        renderer.mathtext_parser = _Canvas._parser
        return renderer


def png(plate: Plate) -> bytes:
    """Render a plate's figure; nothing where it has none."""
    return png_bytes(plate.figure) if plate.figure is not None else b""


def png_bytes(figure: Figure) -> bytes:
    """Render a figure, with a palette of 256 colours: a third of the size, no visible loss.

    Parameters
    ----------
    figure : Figure
        Drawn in the project's style.
    """
    from PIL import Image

    full, small = io.BytesIO(), io.BytesIO()
    # Bare pixels: as PNG they would be compressed only to be read again.
    _Canvas(figure)
    with style():
        figure.savefig(full, format="raw", dpi=_DPI)
    width, height = (int(inches * _DPI) for inches in figure.get_size_inches())
    image = Image.frombytes("RGBA", (width, height), full.getvalue())
    # With its resolution, by which a text processor takes it over at its size in print.
    palette = image.convert("RGB").quantize(256, Image.Quantize.MAXCOVERAGE)
    palette.save(small, format="png", dpi=(_DPI, _DPI))
    return small.getvalue()


def png_size(image: bytes) -> tuple[int, int]:
    """Return width and height of a PNG file, which keep the page from jumping while it loads."""
    return int.from_bytes(image[16:20]), int.from_bytes(image[20:24])


def pdf_bytes(figure: Figure) -> bytes:
    """Render a figure as PDF: fonts inside as TrueType, no date, so that its hash repeats.

    Parameters
    ----------
    figure : Figure
        Drawn in the project's style.
    """
    content = io.BytesIO()
    with style():
        figure.savefig(content, format="pdf", metadata={"CreationDate": None})
    return content.getvalue()
