"""How figures look, and figures as files: the same bytes whatever the user's settings are.

Sizes are for print; colours are those of Okabe & Ito (2008) and survive greyscale; whatever a
colour says, a marker, a line style or a label says too. Ticks are placed when a figure is drawn,
so the style holds then as well.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox
from numpy.typing import NDArray
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from calib.report.constants import DPI
from calib.report.page.template import words

BLACK, ORANGE, SKY, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
BLUE, VERMILION, PURPLE, GREY = "#0072B2", "#D55E00", "#CC79A7", "#767676"
# Vermilion for words: dark enough on white (WCAG: 4.5 to 1).
EMBER = "#A84600"
CYCLE = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY)
MARKERS = ("o", "s", "^", "D", "v", "P")
DASHES: tuple[Any, ...] = ("-", (0, (5, 1.5)), (0, (1, 1)), (0, (5, 1.5, 1, 1.5)))

# Of filled markers: a thin white edge keeps them apart.
DOTS: Mapping[str, Any] = {"ls": "none", "mec": "white", "mew": 0.4}
BAND = "#e4e4e4"

# Widths of one, one and a half and two columns of a journal.
SINGLE_MM, MIDDLE_MM, DOUBLE_MM = 90.0, 140.0, 190.0
# As in print.mplstyle: no text is smaller; subscripts, of 0.7 the size, are 6 pt.
SMALLEST_PT, SYMBOL_PT = 7.0, 8.6
_MM = 1.0 / 25.4
_SAID = "said:"


@cache
def _settings() -> Mapping[Any, Any]:
    with resources.as_file(resources.files(__package__) / "print.mplstyle") as path:
        found = mpl.rc_params_from_file(path, use_default_template=True)
    return {name: value for name, value in found.items() if name != "backend"}


class NotebookFigure(Figure):
    """A figure that a notebook shows, even where nothing has imported pyplot."""

    def _repr_png_(self) -> bytes:
        return png_bytes(self)


@contextmanager
def style() -> Iterator[None]:
    """Draw in the project's style, whatever the user's own settings are."""
    with mpl.rc_context(dict(_settings())):
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
    **how: Any,
) -> tuple[Figure, NDArray[np.object_]]:
    """Return a figure and its panels (rows, cols), laid out in millimetres.

    The height is of one panel, the width of the figure; margins are about the panels, gaps between
    them. What else is given is for `Figure.subplots`.
    """
    total = top + bottom + rows * height + (rows - 1) * gap_y
    figure = NotebookFigure(figsize=(width * _MM, total * _MM))
    axes = figure.subplots(rows, cols, squeeze=False, **how)
    figure.subplots_adjust(
        left=left / width,
        right=1.0 - right / width,
        bottom=bottom / total,
        top=1.0 - top / total,
        wspace=gap_x / ((width - left - right - (cols - 1) * gap_x) / cols),
        hspace=gap_y / height,
    )
    return figure, np.asarray(axes, dtype=object)


def hide_rest(axes: NDArray[np.object_], shown: int) -> None:
    """Hide the panels that are left over after some."""
    for ax in axes.flat[shown:]:
        ax.set_visible(False)


def label_outer(axes: NDArray[np.object_], x: str = "", y: str = "") -> None:
    """Label the panels below and to the left, which share their axes with the others."""
    for ax in axes[-1]:
        ax.set_xlabel(x)
    for ax in axes[:, 0]:
        ax.set_ylabel(y)


def set_titles(axes: NDArray[np.object_], titles: Iterable[str]) -> None:
    """Write a title above each panel, at its left."""
    for ax, title in zip(axes.flat, titles, strict=True):
        ax.set_title(title, loc="left")


def legend_below(figure: Figure, handles: Mapping[str, Any], ncols: int) -> None:
    """Put one legend for all panels at the foot of a figure; leave about 4 mm a row for it."""
    figure.legend(
        list(handles.values()), list(handles), loc="lower center", ncols=ncols, borderaxespad=0.2,
        columnspacing=1.4, labelspacing=0.3, bbox_to_anchor=(0.5, 0.0),
    )  # fmt: skip


def stack(figure: Figure) -> bool:
    """Put the panels of a figure's only row below each other, for a narrow screen.

    False, and nothing is changed, where there is one panel, or more rows than one.
    """
    axes = [ax for ax in figure.axes if ax.get_visible()]
    if len(axes) < 2 or len({round(ax.get_position().y0, 3) for ax in axes}) > 1:
        return False
    height = figure.get_figheight() / _MM
    panel = axes[0].get_position().height * height
    for legend in list(figure.legends):
        handles, texts = legend.legend_handles, [t.get_text() for t in legend.get_texts()]
        legend.remove()
        with style():
            legend_below(figure, dict(zip(texts, handles, strict=True)), 1)
    below = 14.0 + sum(4.2 * len(legend.get_texts()) for legend in figure.legends)
    left, gap = 16.0, 16.0
    total = below + len(axes) * (panel + gap)
    figure.set_size_inches(SINGLE_MM * _MM, total * _MM)
    for i, ax in enumerate(axes):
        right = 24.0 if ax.child_axes else 3.0
        bottom = below + (len(axes) - 1 - i) * (panel + gap)
        width = SINGLE_MM - left - right
        ax.set_position((left / SINGLE_MM, bottom / total, width / SINGLE_MM, panel / total))
        ax.tick_params(labelbottom=True, labelleft=True)
        ax.set_ylabel(ax.get_ylabel() or axes[0].get_ylabel())
    return True


def say_of_points(artist: Artist, said: Iterable[str]) -> None:
    """Keep what a page says of each point that an artist draws, when a pointer is on it."""
    artist.set_gid(_SAID + "\n".join(said))


def said_of_points(figure: Figure) -> tuple[tuple[float, float, str], ...]:
    """Return where the points of which something is said lie in the image, as parts of its size."""
    width, height = figure.get_size_inches() * figure.dpi
    strip = 4.0 * _MM * figure.dpi if _has_strip(figure) else 0.0
    found = []
    for ax in figure.axes:
        drawn: list[tuple[str | None, Any]] = [(a.get_gid(), a.get_xydata()) for a in ax.lines]
        drawn += [(a.get_gid(), a.get_offsets()) for a in ax.collections]
        for gid, data in drawn:
            if gid and gid.startswith(_SAID):
                places = ax.transData.transform(np.asarray(data, dtype=np.float64))
                said = gid.removeprefix(_SAID).split("\n")
                for (x, y), text in zip(places, said, strict=True):
                    found.append((x / width, (height - y) / (height + strip), text))
    return tuple(found)


def caption(figure: str, **facts: Any) -> str:
    """Say what a figure shows, by the words of ``captions.j2``."""
    return words("captions.j2", "calib.report.figures", figure=figure, **facts)


def note(ax: Axes, text: str, *, x: float = 0.03, y: float = 0.97, **kwargs: Any) -> None:
    """Write a remark into a corner of a panel; its upper left by default."""
    kwargs |= {"va": "top" if y > 0.5 else "bottom", "ha": "left" if x < 0.5 else "right"}
    ax.text(x, y, text, transform=ax.transAxes, fontsize=SMALLEST_PT, **kwargs)


def png(plate: Plate) -> bytes:
    """Render a plate's figure; nothing where it has none."""
    return png_bytes(plate.figure) if plate.figure is not None else b""


def png_bytes(figure: Figure, *, points: bool = False) -> bytes:
    """Render a figure with a palette of 256 colours: a third of the size, no visible loss.

    What is said of its `points` may go into the file, for `points_in`.
    """
    full, small = io.BytesIO(_saved(figure, format="png", dpi=DPI)), io.BytesIO()
    few = Image.open(full).convert("RGB").quantize(256)
    # With its resolution, by which a text processor takes it over at its size in print.
    more = PngInfo()
    if points:
        more.add_itxt(_SAID, json.dumps(said_of_points(figure)))
    few.save(small, format="png", dpi=(DPI, DPI), pnginfo=more)
    return small.getvalue()


def points_in(image: bytes) -> tuple[tuple[float, float, str], ...]:
    """Return what is said of points in a PNG file, as of `said_of_points`."""
    said = Image.open(io.BytesIO(image)).info.get(_SAID, "[]")
    return tuple((float(x), float(y), str(text)) for x, y, text in json.loads(said))


def pdf_bytes(figure: Figure) -> bytes:
    """Render a figure as PDF: fonts inside as TrueType, no date, so that its hash repeats."""
    return _saved(figure, format="pdf", metadata={"CreationDate": None})


def _saved(figure: Figure, **form: Any) -> bytes:
    """Return a figure as a file of some form, drawn in the project's style."""
    content = io.BytesIO()
    if _has_strip(figure):
        # The mark of its data stands in a strip below it, where it meets no label.
        width, height = figure.get_size_inches()
        form |= {"bbox_inches": Bbox([[0.0, -4.0 * _MM], [width, height]]), "pad_inches": 0.0}
    with style():
        figure.savefig(content, **form)
    return content.getvalue()


def _has_strip(figure: Figure) -> bool:
    return any(text.get_position()[1] < 0.0 for text in figure.texts)


@dataclass(frozen=True, eq=False)
class Plate:
    """A figure to be shown; it is None if it could not be drawn, and the caption says why."""

    figure: Figure | None
    name: str  # stem of its file
    caption: str  # what it shows, in words and numbers
    heading: str = ""  # what it is, in a few words
    points: tuple[tuple[float, float, str], ...] = ()  # see `said_of_points`


def draw_all(drawings: Mapping[str, Callable[[], Plate | None]]) -> list[Plate]:
    """Draw figures by name, in order; one that fails has no figure and a caption saying why."""
    with style():
        drawn = [_attempt(name, draw) for name, draw in drawings.items()]
    return [plate for plate in drawn if plate is not None]


def mark(figure: Figure, label: str) -> None:
    """Write in a strip below a figure what its data are, if they have a label."""
    if label:
        below = -0.02 / figure.get_figheight()
        text = f"{label.capitalize()} data"
        figure.text(0.995, below, text, ha="right", va="top", fontsize=7, color="0.35")


def marked(plates: Sequence[Plate], label: str) -> Sequence[Plate]:
    """Return plates whose figures say what their data are."""
    for plate in plates:
        if plate.figure is not None:
            mark(plate.figure, label)
    return plates


def _attempt(name: str, draw: Callable[[], Plate | None]) -> Plate | None:
    try:
        return draw()
    except Exception as error:
        # Any failure: a page without one figure is worth more than no page.
        why = f"{type(error).__name__}: {error}"
        return Plate(None, name, f"This figure could not be drawn ({why}).")
