"""Figures as vector graphics for print, the same bytes every time."""

from __future__ import annotations

import io

from matplotlib.figure import Figure

from calib.figures.style import style

__all__ = ["pdf_bytes"]


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
