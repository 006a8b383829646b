"""How every figure looks, and figures as files: the same bytes whatever the user's settings are.

Sizes are for print; colours are those of Okabe & Ito (2008) and survive greyscale; whatever a
colour says, a marker, a line style or a label says too. Ticks are placed when a figure is drawn,
so the style holds then as well.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Literal

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox
from numpy.typing import NDArray
from PIL import Image

from calib.report.constants import DPI
from calib.report.page.template import words

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
    "text.hinting": "none",
    "axes.unicode_minus": True,
    # Type 3 fonts, the default, are refused by publishers.
    "pdf.fonttype": 42,
    # Long tick labels would push the axis label off the figure: a common power of ten instead.
    "axes.formatter.limits": (-3, 4),
    "axes.formatter.use_mathtext": True,
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
    ratios: Sequence[float] | None = None,
) -> tuple[Figure, NDArray[np.object_]]:
    """Return a figure and its panels, laid out in millimetres.

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
    ratios : sequence of float, optional
        Widths of the columns, in any unit; equal by default.

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
        width_ratios=ratios,
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


def legend_below(figure: Figure, handles: Mapping[str, Any], ncols: int) -> None:
    """Put one legend for all panels at the foot of a figure; leave about 4 mm a row for it."""
    figure.legend(
        list(handles.values()), list(handles), loc="lower center", ncols=ncols, borderaxespad=0.2,
        columnspacing=1.4, labelspacing=0.3, bbox_to_anchor=(0.5, 0.0),
    )  # fmt: skip


def caption(figure: str, **facts: Any) -> str:
    """Say what a figure shows, by the words of ``captions.j2``."""
    return words("captions.j2", "calib.report.figures", figure=figure, **facts)


def note(ax: Axes, text: str, *, x: float = 0.03, y: float = 0.97, **kwargs: Any) -> None:
    """Write a remark into a corner of a panel; its upper left by default."""
    ax.text(
        x, y, text, transform=ax.transAxes, va="top" if y > 0.5 else "bottom",
        ha="left" if x < 0.5 else "right", fontsize=SMALLEST_PT, **kwargs,
    )  # fmt: skip


def png(plate: Plate) -> bytes:
    """Render a plate's figure; nothing where it has none."""
    return png_bytes(plate.figure) if plate.figure is not None else b""


def png_bytes(figure: Figure) -> bytes:
    """Render a figure with a palette of 256 colours: a third of the size, no visible loss."""
    full, small = io.BytesIO(_saved(figure, format="png", dpi=DPI)), io.BytesIO()
    few = Image.open(full).convert("RGB").quantize(256)
    # With its resolution, by which a text processor takes it over at its size in print.
    few.save(small, format="png", dpi=(DPI, DPI))
    return small.getvalue()


def pdf_bytes(figure: Figure) -> bytes:
    """Render a figure as PDF: fonts inside as TrueType, no date, so that its hash repeats."""
    return _saved(figure, format="pdf", metadata={"CreationDate": None})


def _saved(figure: Figure, **form: Any) -> bytes:
    """Return a figure as a file of some form, drawn in the project's style."""
    content = io.BytesIO()
    if any(text.get_position()[1] < 0.0 for text in figure.texts):
        # The mark of its data stands in a strip below it, where it meets no label.
        width, height = figure.get_size_inches()
        form |= {"bbox_inches": Bbox([[0.0, -4.0 * _MM], [width, height]]), "pad_inches": 0.0}
    with style():
        figure.savefig(content, **form)
    return content.getvalue()
