"""What was read of a rig's file: the outputs along slip, and every column along the file."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from calib.data.table import Column, parse_header
from calib.imports import Imported
from calib.report.figures import style

# Up to here rows that are written are drawn larger than those that were read: they stand apart.
FEW = 500


def imported_figure(found: Imported) -> Figure:
    """Draw what was read, what was cropped, and the rows that are written.

    Parameters
    ----------
    found : Imported

    Returns
    -------
    Figure
        Panels of the outputs along slip, or else the first condition; then, along the file, of
        every column that holds measured numbers.
    """
    parsed = {name: parse_header(name) for name in found.before}
    shown = {
        name: column
        for name, column in parsed.items()
        if column is not None and column.quantity.role != "bookkeeping"
    }
    conditions = [n for n, c in shown.items() if c.quantity.role == "condition"]
    along = sorted(conditions, key=lambda name: shown[name].quantity.physical != "slip")[:1]
    outputs = [n for n in shown if n not in conditions]
    pairs = [(output, x) for output in outputs for x in along] + [(name, "") for name in shown]
    rows = -(-len(pairs) // 2)
    with style.style():
        figure, axes = style.panels(rows, 2, height=30.0, bottom=18.0, gap_x=16.0, gap_y=18.0)
        style.hide_rest(axes, len(pairs))
        for ax, (name, x) in zip(axes.flat, pairs, strict=False):
            at = (found.before[x], found.columns[x]) if x else (found.lines, found.table.lines)
            # A bin is a place along slip, but none along the file.
            _points(ax, found, name, at, written=bool(x) or found.report.reduced_by != "bins")
            ax.set_title(_label(shown[name]), loc="left")
            ax.set_xlabel(_label(shown[x]) if x else "Line of the file")
        handles, names = axes[0, 0].get_legend_handles_labels()
        style.legend_below(figure, dict(zip(names, handles, strict=True)), 3)
    return figure


def _points(
    ax: Axes, found: Imported, name: str, at: Sequence[NDArray[Any]], *, written: bool
) -> None:
    """Draw a column over places in the file, or values of another, before and after."""
    (x, x_written), values, kept = at, found.before[name], found.kept
    dot: dict[str, Any] = {"ls": "none", "marker": "o", "ms": 1.6, "mew": 0.0}
    if not kept.all():
        ax.plot(x[~kept], values[~kept], color=style.ORANGE, label="cropped", **dot)
    if found.report.reduced_by:
        ax.plot(x[kept], values[kept], color="#b8b8b8", label="read", **dot)
    dot["ms"] = 2.6 if found.report.rows_written < FEW else 1.6
    if written:
        ax.plot(x_written, found.columns[name], color=style.BLUE, label="written", **dot)


def _label(column: Column) -> str:
    unit = column.unit_word.replace("percent", "%").replace("degree", "°").replace("degC", "°C")
    return f"{column.quantity.title} ({unit})" if unit else column.quantity.title
