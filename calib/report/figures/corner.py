"""The posterior in pairs: every two sampled parameters against each other."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator

from calib.inference.calibration import Calibration
from calib.inference.light import part_of
from calib.inference.priors import Prior
from calib.models.base import Array
from calib.report.figures.plate import Plate
from calib.report.figures.style import (
    BLACK,
    BLUE,
    DASHES,
    DOUBLE_MM,
    MIDDLE_MM,
    ORANGE,
    SINGLE_MM,
    SMALLEST_PT,
    SYMBOL_PT,
    WIDE,
)
from calib.report.labels import MINUS, parameter_label, plain, short
from calib.report.reference import NOTHING, Reference
from calib.report.study import OutputResult

__all__ = ["corner_plate"]

hist2d = part_of("corner.core", "arviz").hist2d

MAX_PARAMETERS = 11
_N_DRAWS = 4000
# Tick labels this near to an end of their panel, as a part of it, would meet the next panel's.
_CLEAR = 0.1
# For tick labels and labels to the left and below, and to the right and above.
_MARGIN_MM, _REST_MM = 19.0, 2.0
# Part of a cell that its panel takes.
_FILL = 0.93


class _Cells:
    """Panels as cells of one pair of axes: creating axes is what takes the time of a corner plot.

    Panel (i, j) is column j of row i from the top; a parameter's range maps onto its cell.
    """

    def __init__(self, draws: Array) -> None:
        self.d = draws.shape[1]
        self.low, self.high = np.quantile(draws, [0.001, 0.999], axis=0)

    def part(self, j: int, value: Array | float) -> Array:
        """Map a parameter's values onto 0 to `_FILL`."""
        return np.asarray(_FILL * (value - self.low[j]) / (self.high[j] - self.low[j]))

    def x(self, j: int, value: Array | float) -> Array:
        """Abscissa of values of parameter j."""
        return np.asarray(j + self.part(j, value))

    def bottom(self, i: int) -> float:
        """Ordinate of the foot of row i."""
        return float(self.d - 1 - i)

    def ticks(self, j: int, most: int) -> Array:
        """A few round values inside the range."""
        clear = _CLEAR * (self.high[j] - self.low[j])
        low, high = self.low[j] + clear, self.high[j] - clear
        for n in range(most, most + 3):
            values = np.asarray(MaxNLocator(n).tick_values(low, high))
            found = values[(values >= low) & (values <= high)]
            if found.size >= 2:
                break
        return np.asarray(found[:: -(-found.size // most)])


def corner_plate(result: OutputResult, *, reference: Reference = NOTHING) -> Plate:
    """Draw every pair of sampled parameters, and mark published ones."""
    draws, priors, wide = _sampled(result.calibration)
    marks = reference.sampled(result.calibration.problem.bound)
    at = [
        np.log10(marks[p.name]) if w and p.name in marks else marks.get(p.name)
        for p, w in zip(priors, wide, strict=True)
    ]
    labels = [
        parameter_label(p.name, p.unit, log=w).replace(" (", "\n(", 1)
        for p, w in zip(priors, wide, strict=True)
    ]
    cells = _Cells(draws)
    fig, ax = _frame(cells)
    for i in range(cells.d):
        _marginal(ax, cells, i, draws[:, i])
        for j in range(i):
            _pair(ax, cells, i, j, draws)
    _marks(ax, cells, at)
    _ticks(ax, cells, labels)
    note = "contours hold 50 % and 90 %" + ("\ndashed: published" if marks else "")
    ax.text(1.1, cells.d - 0.1, note, va="top", fontsize=SMALLEST_PT)
    ax.set_xlim(0.0, cells.d)
    ax.set_ylim(0.0, cells.d)
    caption = _caption(draws, [p.name for p in priors], bool(marks))
    return Plate(fig, "corner", caption, "Posterior, in pairs")


def _sampled(calibration: Calibration) -> tuple[Array, list[Prior], list[bool]]:
    """Thinned draws of the first free parameters, by their decimal logarithm where wide."""
    entries = calibration.problem.priors.entries
    free = [i for i, p in enumerate(entries) if not p.fixed][:MAX_PARAMETERS]
    natural = calibration.problem.theta(calibration.subset(_N_DRAWS))[:, free]
    low, high = np.quantile(natural, [0.02, 0.98], axis=0)
    wide = [bool(entries[i].log and high[j] > WIDE * low[j]) for j, i in enumerate(free)]
    natural[:, wide] = np.log10(natural[:, wide])
    return natural, [entries[i] for i in free], wide


def _width(d: int) -> float:
    """Width in millimetres of a figure of so many parameters."""
    return SINGLE_MM if d <= 2 else MIDDLE_MM if d <= 5 else DOUBLE_MM


def _frame(cells: _Cells) -> tuple[Figure, Axes]:
    """One pair of axes without spines; every panel gets a left and a lower edge."""
    total = _width(cells.d)
    margin, edge = _MARGIN_MM, total - _MARGIN_MM - _REST_MM
    fig = Figure(figsize=(total / 25.4, total / 25.4))
    ax = fig.add_axes((margin / total, margin / total, edge / total, edge / total))
    ax.set_axis_off()
    edges = []
    for i in range(cells.d):
        for j in range(i + 1):
            y = cells.bottom(i)
            edges.append([(j, y), (j + _FILL, y)])
            if i != j:
                edges.append([(j, y), (j, y + _FILL)])
    ax.add_collection(LineCollection(edges, colors=BLACK, linewidths=0.6, clip_on=False))
    return fig, ax


def _marginal(ax: Axes, cells: _Cells, i: int, draws: Array) -> None:
    counts, edges = np.histogram(draws, 30, (cells.low[i], cells.high[i]))
    height = cells.bottom(i) + 0.85 * counts / counts.max()
    ax.stairs(height, cells.x(i, edges), baseline=cells.bottom(i), color=BLUE, lw=1.0)


def _pair(ax: Axes, cells: _Cells, i: int, j: int, draws: Array) -> None:
    y = cells.bottom(i)
    before = len(ax.collections)
    hist2d(
        cells.x(j, draws[:, j]), y + cells.part(i, draws[:, i]), bins=24, ax=ax,
        levels=(0.5, 0.9), smooth=1.0, range=[(j, j + _FILL), (y, y + _FILL)],
        plot_datapoints=False, plot_density=False, fill_contours=True, no_fill_contours=True,
        color=BLUE,
        contour_kwargs={"linewidths": 0.6},
    )  # fmt: skip
    # Smoothed contours reach a little beyond the range.
    for contour in ax.collections[before:]:
        contour.set_clip_path(Rectangle((j, y), _FILL, _FILL, transform=ax.transData))


def _marks(ax: Axes, cells: _Cells, at: list[float | None]) -> None:
    """Published values as dashed lines across their row and column, where they lie inside."""
    lines = []
    for k, value in enumerate(at):
        if value is not None and cells.low[k] <= value <= cells.high[k]:
            part = float(cells.part(k, value))
            y = cells.bottom(k)
            lines += [
                [(k + part, cells.bottom(i)), (k + part, cells.bottom(i) + _FILL)]
                for i in range(k, cells.d)
            ]
            lines += [[(j, y + part), (j + _FILL, y + part)] for j in range(k)]
    ax.add_collection(LineCollection(lines, colors=ORANGE, linewidths=0.9, linestyles=[DASHES[1]]))


def _ticks(ax: Axes, cells: _Cells, labels: list[str]) -> None:
    many = cells.d > 7
    most, tick = (2, 0.05) if many else (3, 0.03)
    style: dict[str, Any] = {"fontsize": SMALLEST_PT, "clip_on": False}
    # Distances from the panels are in cells, so they grow with the number of panels.
    away = 14.0 * cells.d / (_width(cells.d) - _MARGIN_MM - _REST_MM)
    lines = []
    for k, label in enumerate(labels):
        y = cells.bottom(k)
        ticks = cells.ticks(k, most)
        for value, text in zip(ticks, _tick_texts(ticks), strict=True):
            part = float(cells.part(k, value))
            lines.append([(k + part, 0.0), (k + part, -tick)])
            ax.text(k + part, -1.6 * tick, text, ha="center", va="top",
                    rotation=90, **style)  # fmt: skip
            if k > 0:
                lines.append([(0.0, y + part), (-tick, y + part)])
                ax.text(-1.6 * tick, y + part, text, ha="right", va="center", **style)
        ax.text(k + 0.5 * _FILL, -away, label, ha="center", va="center", fontsize=SYMBOL_PT)
        if k > 0:
            ax.text(-away, y + 0.5 * _FILL, label, rotation=90, ha="center", va="center",
                    fontsize=SYMBOL_PT)  # fmt: skip
    ax.add_collection(LineCollection(lines, colors=BLACK, linewidths=0.6, clip_on=False))


def _tick_texts(values: Array) -> list[str]:
    """Write the values of ticks, with the decimals that the finest of them needs."""
    texts = [f"{value:.6g}" for value in values]
    decimals = max((len(text.partition(".")[2]) for text in texts if "e" not in text), default=0)
    return [
        (text if "e" in text else f"{value:.{decimals}f}").replace("-", MINUS)
        for text, value in zip(texts, values, strict=True)
    ]


def _caption(draws: Array, names: list[str], marked: bool) -> str:
    # Of a pair once, or rounding decides which of the two is named first.
    correlation = np.tril(np.corrcoef(draws, rowvar=False), -1)
    i, j = np.unravel_index(np.abs(correlation).argmax(), correlation.shape)
    strong = int((np.abs(correlation) > 0.8).sum())
    pairs = len(names) * (len(names) - 1) // 2
    marks = " Dashed: what the published figures amount to." if marked else ""
    verb = "exceeds" if strong in (0, 1) else "exceed"
    few = f"{strong} of {pairs} pairs" if strong else f"none of the {pairs} pairs"
    return (
        f"{plain(names[j])} and {plain(names[i])} are tied most closely (correlation "
        f"{short(float(correlation[i, j]))}); {few} {verb} 0.8.{marks}"
    )
