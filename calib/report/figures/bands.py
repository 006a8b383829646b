"""Predictive bands with the data in them, one panel for each pressure."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from calib.models.base import Array
from calib.report.figures.plate import Plate
from calib.report.figures.style import (
    BLACK,
    BLUE,
    DASHES,
    DOUBLE_MM,
    EMBER,
    MIDDLE_MM,
    ORANGE,
    VERMILION,
    legend_below,
    panels,
)
from calib.report.labels import axis_of, joined, short
from calib.report.reference import NOTHING, Reference
from calib.report.rows import (
    Group,
    data_word,
    grid,
    group_column,
    groups,
    held_table,
    smooth_bands,
    x_column,
)
from calib.report.study import OutputResult
from calib.validation.prediction import Bands

__all__ = ["FILLS", "bands_plate", "fill_bands", "observed_words", "scatter_points"]

# Lighter outwards, also in greyscale.
FILLS = {0.95: "#dfebf5", 0.9: "#bcd6ea", 0.5: "#86b5d9"}


def fill_bands(ax: Axes, x: Array, mean: Bands, measured: Bands) -> dict[str, Any]:
    """Draw median, predictive bands and the parameters' own 90 % band; return legend handles."""
    handles: dict[str, Any] = {}
    for level, colour in FILLS.items():
        handles[f"{100 * level:g} % predictive"] = ax.fill_between(
            x, measured.lower[level], measured.upper[level], color=colour, lw=0.0
        )
    (handles["median"],) = ax.plot(x, mean.median, color=BLUE, lw=1.4)
    for edge in (mean.lower[0.9], mean.upper[0.9]):
        (handles["90 %, parameters only"],) = ax.plot(x, edge, color=BLUE, lw=0.8, ls=DASHES[1])
    return handles


def scatter_points(ax: Axes, x: Array, y: Array, *, held: bool) -> Any:
    """Draw measured points: filled where fitted, ringed where held out."""
    if held:
        return ax.plot(
            x, y, "o", ms=5.0, mfc="white", mec=VERMILION, mew=1.3, ls="none", zorder=5
        )[0]  # fmt: skip
    return ax.plot(x, y, "o", ms=3.6, color=BLACK, mec="white", mew=0.4, ls="none", zorder=4)[0]


def bands_plate(result: OutputResult, *, reference: Reference = NOTHING) -> Plate:
    """Draw the predictive bands of an output along slip or pressure.

    Parameters
    ----------
    result : OutputResult
    reference : Reference, optional
        Whose fit is added.
    """
    problem = result.calibration.problem
    x_axis, y_axis = axis_of(x_column(result)), axis_of(problem.bound.model.output)
    shown = groups(result)
    cols = min(3, len(shown))
    rows = -(-len(shown) // cols)
    width = DOUBLE_MM if cols > 1 else MIDDLE_MM
    fig, axes = panels(
        rows, cols, height=52.0 if cols > 1 else 60.0, width=width, bottom=20.0, top=7.0,
        gap_x=3.0, gap_y=8.0, sharex=True, sharey=True,
    )  # fmt: skip
    handles: dict[str, Any] = {}
    for ax, group in zip(axes.flat, shown, strict=False):
        handles |= _panel(ax, result, group, reference)
        ax.set_title(group.title, color=EMBER if group.held else BLACK,
                     weight="bold" if group.held else "normal")  # fmt: skip
        ax.set_xlabel(x_axis.label)
        ax.margins(x=0.02)
    for ax in axes.flat[len(shown) :]:
        ax.set_visible(False)
    for ax in axes[:, 0]:
        ax.set_ylabel(y_axis.label)
    for ax in axes[:-1].flat:
        ax.set_xlabel("")
    legend_below(fig, list(handles.values()), list(handles), 4 if cols > 1 else 3)
    return Plate(fig, "bands", _caption(result, len(shown)), "Prediction and data")


def _panel(ax: Axes, result: OutputResult, group: Group, reference: Reference) -> dict[str, Any]:
    problem, held = result.calibration.problem, held_table(result)
    x, y = x_column(result), problem.bound.model.output
    conditions = grid(result, group)
    scale = axis_of(x).scale
    handles = fill_bands(ax, scale(conditions[x]), *smooth_bands(result.calibration, conditions))
    curve = reference.curve(problem.bound.model.name, conditions)
    if curve is not None:
        (handles[f"published fit ({curve[1]})"],) = ax.plot(
            scale(conditions[x]), curve[0], color=ORANGE, lw=1.4, ls=DASHES[3], zorder=3
        )
    word = data_word(result)
    if group.fitted.any():
        handles[f"{word}, calibrated"] = scatter_points(
            ax, scale(problem.table[x][group.fitted]), problem.table[y][group.fitted], held=False
        )
    if held is not None and group.held_out.any():
        handles[f"{word}, held out"] = scatter_points(
            ax, scale(held[x][group.held_out]), held[y][group.held_out], held=True
        )
    return handles


def observed_words(result: OutputResult) -> str:
    """Say what the bands covered of the fitted rows and of those not fitted."""
    low, high = np.nanquantile(result.posterior_predictive, [0.05, 0.95], axis=0)
    observed = result.calibration.problem.observed
    inside = int(((observed >= low) & (observed <= high)).sum())
    c = result.validation.scores.coverage[0.9]
    other = "held-out points" if held_table(result) is not None else "points when each is left out"
    return (
        f"the 90 % band covers {inside} of {observed.size} calibrated points"
        f" and {c.hits} of {c.n} {other}"
    )


def _caption(result: OutputResult, shown: int) -> str:
    validation = result.validation
    axis = axis_of(result.calibration.problem.bound.model.output)
    words = observed_words(result)
    text = words[0].upper() + words[1:]
    held = held_table(result)
    if held is not None:
        miss = validation.scores.median - validation.observed
        i = int(np.nanargmax(np.abs(miss)))
        where = axis_of(x_column(result))
        side = "above" if miss[i] > 0 else "below"
        text += (
            f"; the median is farthest off at {where.name.lower()}"
            f" {short(where.factor * held[x_column(result)][i], 3)} {where.unit}, "
            f"{short(abs(miss[i]))} {axis.unit} {side} the held-out point"
        )
    column = group_column(result)
    total = 0 if column is None else np.unique(result.task.table[column]).size
    if column is not None and 0 < shown < total:
        names = joined([g.title for g in groups(result)])
        text += f". {total} values of {axis_of(column).name.lower()} are shown as {names}"
    return text + "."
