"""Figures as files: the same bytes every time, whatever the user's own settings are.

Ticks are placed when a figure is drawn, so the style holds then as well.
"""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg, RendererAgg
from matplotlib.figure import Figure
from matplotlib.ticker import ScalarFormatter

from calib.report.figures.plate import Plate
from calib.report.figures.style import style

__all__ = ["pdf_bytes", "png", "png_bytes", "png_size"]

_DPI = 150
# Where the larger end of an axis lies here, its tick labels have no common power of ten
# (``axes.formatter.limits``).
_PLAIN = (0.02, 9e3)


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

    _set_powers(figure)
    full, small = io.BytesIO(), io.BytesIO()
    # Bare pixels: as PNG they would be compressed only to be read again.
    _Canvas(figure)
    with style():
        figure.savefig(full, format="raw", dpi=_DPI)
    width, height = (int(inches * _DPI) for inches in figure.get_size_inches())
    image = Image.frombytes("RGBA", (width, height), full.getvalue())
    # With its resolution, by which a text processor takes it over at its size in print.
    image.convert("RGB").quantize(256).save(small, format="png", dpi=(_DPI, _DPI))
    return small.getvalue()


def _set_powers(figure: Figure) -> None:
    """Set a common power of ten as a formula, and only that: parsing "0.5" takes milliseconds."""
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            formatter, ends = axis.get_major_formatter(), np.abs(axis.get_view_interval())
            if isinstance(formatter, ScalarFormatter):
                formatter.set_useMathText(not _PLAIN[0] < ends.max() < _PLAIN[1])


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
    _set_powers(figure)
    content = io.BytesIO()
    with style():
        figure.savefig(content, format="pdf", metadata={"CreationDate": None})
    return content.getvalue()
