"""A plate: a figure, the name of its file, and one sentence on what it shows."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class Plate:
    """A figure to be shown.

    Parameters
    ----------
    figure : Figure or None
        None if it could not be drawn; the caption then says why.
    name : str
        Stem of its file.
    caption : str
        What it shows, in words and numbers.
    heading : str
        What it is, in a few words.
    """

    figure: Figure | None
    name: str
    caption: str
    heading: str = ""


def draw_all(drawings: Mapping[str, Callable[[], Plate | None]]) -> list[Plate]:
    """Draw figures by name, in order; one that fails has no figure and a caption saying why."""
    # What drawing takes is not imported where a plate is only shown.
    from calib.report.figures.style import style

    with style():
        drawn = [_attempt(name, draw) for name, draw in drawings.items()]
    return [plate for plate in drawn if plate is not None]


def mark(figure: Figure, label: str) -> None:
    """Write in a strip below a figure what its data are, if they have a label."""
    if label:
        below = -0.02 / figure.get_figheight()
        text = f"{label.capitalize()} data"
        figure.text(0.995, below, text, ha="right", va="top", fontsize=7, color="0.35")


def marked(plates: Sequence[Plate], label: str) -> list[Plate]:
    """Return plates that say what their data are, in the figure and below it."""
    for plate in plates:
        if plate.figure is not None:
            mark(plate.figure, label)
    said = f" {label.capitalize()} data." if label else ""
    return [replace(plate, caption=f"{plate.caption}{said}") for plate in plates]


def _attempt(name: str, draw: Callable[[], Plate | None]) -> Plate | None:
    try:
        return draw()
    except Exception as error:
        # Any failure: a page without one figure is worth more than no page.
        why = f"{type(error).__name__}: {error}"
        return Plate(None, name, f"This figure could not be drawn ({why}).")
