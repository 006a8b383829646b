"""Bands of compared models side by side, each of rows that it had not seen."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from calib.models.base import Array
from calib.report.figures.style import BLACK, BLUE, legend_below, panels, style
from calib.report.labels import axis_of
from calib.validation.comparison import Candidate, Comparison

__all__ = ["comparison_figure"]

_LEVEL = 0.9
_MOST_COLUMNS = 3


def comparison_figure(comparison: Comparison) -> Figure:
    """Draw, for each model, measured rows and the 90 % interval it gives each without it.

    Parameters
    ----------
    comparison : Comparison
    """
    candidates = comparison.candidates
    column = _main_condition(comparison)
    x, y = axis_of(column), axis_of(candidates[0].calibration.problem.bound.model.output)
    cols = min(_MOST_COLUMNS, len(candidates))
    rows = -(-len(candidates) // cols)
    with style():
        figure, axes = panels(
            rows, cols, height=58.0, left=15.0, top=9.0, bottom=20.0, gap_x=4.0, gap_y=16.0,
            sharex=True, sharey=True,
        )  # fmt: skip
        for ax, candidate in zip(axes.flat, candidates, strict=False):
            table = candidate.loo.table
            place = _spread(x.factor * table[column])
            low, middle, high = (
                y.factor * np.quantile(candidate.loo.draws, q, axis=0)
                for q in (0.5 - _LEVEL / 2.0, 0.5, 0.5 + _LEVEL / 2.0)
            )
            bars = ax.vlines(place, low, high, color=BLUE, alpha=0.35, linewidth=1.6)
            dash = ax.plot(place, middle, "_", color=BLUE, markersize=4.0)[0]
            dots = ax.plot(place, y.factor * candidate.loo.observed, ".", color=BLACK,
                           markersize=3.0)[0]  # fmt: skip
            ax.set_title(_title(comparison, candidate))
            ax.set_xlabel(x.label)
        for ax in axes.flat[len(candidates) :]:
            ax.set_visible(False)
        for row in axes:
            row[0].set_ylabel(y.label)
        legend_below(
            figure, [dots, dash, bars],
            ["measured", "median without the row", "90 % interval without the row"], 3,
        )  # fmt: skip
    return figure


def _main_condition(comparison: Comparison) -> str:
    """Return the condition of all models that has most values."""
    models = [c.calibration.problem.bound.model for c in comparison.candidates]
    table = comparison.candidates[0].loo.table
    shared = [n for n in models[0].conditions if all(n in m.conditions for m in models)]
    return max(shared or models[0].conditions, key=lambda n: np.unique(table[n]).size)


def _spread(x: Array) -> Array:
    """Move rows that share a place apart, so that each bar is seen."""
    room = 0.012 * (np.ptp(x) or 1.0)
    moved = x.copy()
    for value in np.unique(x):
        same = np.flatnonzero(x == value)
        moved[same] += (
            room * (np.arange(same.size) - 0.5 * (same.size - 1)) / max(1, same.size**0.5)
        )
    return moved


def _title(comparison: Comparison, candidate: Candidate) -> str:
    return f"{candidate.model}, weight {comparison.weights[candidate.model]:.2f}"
