"""A plate: a figure, the name of its file, and one sentence on what it shows."""

from __future__ import annotations

from dataclasses import dataclass

from matplotlib.figure import Figure

__all__ = ["Plate"]


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
