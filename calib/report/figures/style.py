"""How every figure looks, and figures as files: the same bytes whatever the user's settings are.

Sizes are for print; colours are those of Okabe & Ito (2008) and survive greyscale; whatever a
colour says, a marker, a line style or a label says too. Ticks are placed when a figure is drawn,
so the style holds then as well.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Literal

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg, RendererAgg
from matplotlib.figure import Figure
from matplotlib.ticker import ScalarFormatter
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure

if TYPE_CHECKING:
    from calib.report.figures.plate import Plate


BLACK, ORANGE, SKY, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
BLUE, VERMILION, PURPLE, GREY = "#0072B2", "#D55E00", "#CC79A7", "#767676"
# Vermilion for words: dark enough on white (WCAG: 4.5 to 1).
EMBER = "#A84600"
CYCLE = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY)
MARKERS = ("o", "s", "^", "D", "v", "P")
DASHES: tuple[Any, ...] = ("-", (0, (5, 1.5)), (0, (1, 1)), (0, (5, 1.5, 1, 1.5)))

# Widths of one, one and a half and two columns of a journal.
SINGLE_MM, MIDDLE_MM, DOUBLE_MM = 90.0, 140.0, 190.0
# No text is smaller in print; where it has subscripts, which are 0.7 of it, these are 6 pt.
SMALLEST_PT, SYMBOL_PT = 7.0, 8.6
_MM = 1.0 / 25.4

# A positive parameter this wide (98 over 2 % point) is drawn by its decimal logarithm.
WIDE = 2.5

_RC: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.size": 8.0,
    "axes.titlesize": 8.0,
    "axes.labelsize": SYMBOL_PT,
    "xtick.labelsize": 7.0,
    "ytick.labelsize": 7.0,
    "legend.fontsize": 7.0,
    "legend.frameon": False,
    "legend.handlelength": 1.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.6,
    "axes.titlepad": 4.0,
    # Where it is put by default: to look for labels in its way takes longer than to draw it.
    "axes.titley": 1.0,
    "axes.labelpad": 2.5,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "lines.linewidth": 1.2,
    "lines.markersize": 4.0,
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
    "mathtext.fontset": "dejavusans",
    # At this resolution glyphs need no fitting to pixels, which takes a third of drawing text.
    "text.hinting": "none",
    "axes.unicode_minus": True,
    # Type 3 fonts, the default, are refused by publishers.
    "pdf.fonttype": 42,
    # Long tick labels would push the axis label off the figure: a common power of ten instead.
    "axes.formatter.limits": (-3, 4),
}


@contextmanager
def style() -> Iterator[None]:
    """Draw in the project's style, whatever the user's own settings are."""
    with mpl.rc_context():
        mpl.rcParams.update({k: v for k, v in mpl.rcParamsDefault.items() if k != "backend"})
        for key, value in _RC.items():
            mpl.rcParams[key] = value
        yield


def panels(
    rows: int,
    cols: int,
    *,
    height: float,
    width: float = DOUBLE_MM,
    left: float = 14.0,
    right: float = 3.0,
    top: float = 6.0,
    bottom: float = 10.0,
    gap_x: float = 4.0,
    gap_y: float = 6.0,
    sharex: bool | Literal["col", "row"] = False,
    sharey: bool | Literal["col", "row"] = False,
) -> tuple[Figure, NDArray[np.object_]]:
    """Return a figure and its panels, laid out in millimetres.

    Explicit margins take no time, whereas an automatic layout draws the figure twice.

    Parameters
    ----------
    height : float
        Of one panel.
    width : float
        Of the figure.
    left, right, top, bottom : float
        Margins about the panels.
    gap_x, gap_y : float
        Between panels.
    sharex, sharey : bool or {"col", "row"}

    Returns
    -------
    Figure
    ndarray of Axes, shape (rows, cols)
    """
    total = top + bottom + rows * height + (rows - 1) * gap_y
    panel_width = (width - left - right - (cols - 1) * gap_x) / cols
    figure = Figure(figsize=(width * _MM, total * _MM))
    axes = figure.subplots(
        rows,
        cols,
        squeeze=False,
        sharex=sharex,
        sharey=sharey,
        gridspec_kw={
            "left": left / width,
            "right": 1.0 - right / width,
            "bottom": bottom / total,
            "top": 1.0 - top / total,
            "wspace": gap_x / panel_width,
            "hspace": gap_y / height,
        },
    )
    return figure, np.asarray(axes, dtype=object)


def legend_below(figure: Figure, handles: list[Any], labels: list[str], ncols: int) -> None:
    """Put one legend for all panels at the foot of a figure; leave about 4 mm a row for it."""
    figure.legend(
        handles, labels, loc="lower center", ncols=ncols, borderaxespad=0.2, columnspacing=1.4,
        labelspacing=0.3,
    )  # fmt: skip


def note(ax: Axes, text: str, *, x: float = 0.03, y: float = 0.97, **kwargs: Any) -> None:
    """Write a remark into a corner of a panel; its upper left by default."""
    ax.text(
        x, y, text, transform=ax.transAxes, va="top" if y > 0.5 else "bottom",
        ha="left" if x < 0.5 else "right", fontsize=SMALLEST_PT, **kwargs,
    )  # fmt: skip


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
    """Render a figure, with a palette of 256 colours: a third of the size, no visible loss."""
    from PIL import Image

    # Bare pixels: as PNG they would be compressed only to be read again.
    _Canvas(figure)
    pixels = _saved(figure, format="raw", dpi=_DPI)
    width, height = (int(inches * _DPI) for inches in figure.get_size_inches())
    # A palette for the colours that there are, not for a million pixels; most equal the one before.
    flat = np.frombuffer(pixels, np.uint32)
    runs = np.flatnonzero(np.concatenate([[True], flat[1:] != flat[:-1]]))
    colours, which = np.unique(flat[runs], return_inverse=True)
    full_colour = Image.frombytes("RGBA", (colours.size, 1), colours.tobytes()).convert("RGB")
    few = full_colour.quantize(256, Image.Quantize.MAXCOVERAGE)
    indices = np.repeat(np.asarray(few)[0, which], np.diff(runs, append=flat.size))
    image = Image.frombytes("P", (width, height), indices.tobytes())
    image.putpalette(few.getpalette() or [])
    # With its resolution, by which a text processor takes it over at its size in print.
    small = io.BytesIO()
    image.save(small, format="png", dpi=(_DPI, _DPI))
    return small.getvalue()


def _saved(figure: Figure, **form: Any) -> bytes:
    """Return a figure as a file of some form, drawn in the project's style."""
    _set_powers(figure)
    content = io.BytesIO()
    with style():
        figure.savefig(content, **form)
    return content.getvalue()


def _set_powers(figure: Figure) -> None:
    """Set a common power of ten as a formula, and only that: parsing "0.5" takes milliseconds."""
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            formatter, ends = axis.get_major_formatter(), np.abs(axis.get_view_interval())
            if isinstance(formatter, ScalarFormatter):
                formatter.set_useMathText(not _PLAIN[0] < ends.max() < _PLAIN[1])


def pdf_bytes(figure: Figure) -> bytes:
    """Render a figure as PDF: fonts inside as TrueType, no date, so that its hash repeats."""
    return _saved(figure, format="pdf", metadata={"CreationDate": None})
