"""Bulk density: predicted against observed, and against cone index at three water contents."""

from __future__ import annotations

from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from calib.data.quantities import role_of
from calib.errors import CalibError
from calib.models.base import Array, Model
from calib.report.figures.bands import observed_words
from calib.report.figures.plate import Plate
from calib.report.figures.style import BLACK, DASHES, GREY, VERMILION, legend_below, panels
from calib.report.labels import axis_of, percent, short
from calib.report.rows import data_word, held_table, smooth_bands
from calib.report.study import OutputResult

__all__ = ["cone_and_water", "density_plate", "draw_predicted_observed"]

_WATER_QUANTILES = (0.1, 0.5, 0.9)
# Yellow would vanish on white.
_COLOURS = ListedColormap(mpl.colormaps["YlGnBu"](np.linspace(0.35, 1.0, 128)))


def density_plate(result: OutputResult) -> Plate:
    """Draw density against cone index, coloured by water content, and predicted against observed.

    Parameters
    ----------
    result : OutputResult
        Of one of the two density models.
    """
    fig, axes = panels(
        1, 2, height=64.0, bottom=22.0, left=14.0, gap_x=30.0, right=3.0, top=4.0
    )  # fmt: skip
    handles = _against_cone_index(axes[0, 0], fig, result)
    handles |= draw_predicted_observed(axes[0, 1], result)
    legend_below(fig, list(handles.values()), list(handles), 3)
    return Plate(fig, "bands", _caption(result), "Prediction and data")


def cone_and_water(model: Model) -> tuple[str, str] | None:
    """Return the columns of a density model of cone index and water content; None for another."""
    roles = {role_of(name): name for name in model.conditions}
    water = roles.get("water", roles.get("water_by_volume"))
    if role_of(model.output) != "density" or len(roles) != 2 or "cone" not in roles or not water:
        return None
    return roles["cone"], water


def _columns(result: OutputResult) -> tuple[str, str]:
    found = cone_and_water(result.calibration.problem.bound.model)
    if found is None:
        raise CalibError(
            "the figure is of density models of cone index and water content",
            mend="draw `bands_plate` of other models",
        )
    return found


def _against_cone_index(ax: Axes, fig: Figure, result: OutputResult) -> dict[str, Any]:
    problem, (cone, water) = result.calibration.problem, _columns(result)
    ci, w = problem.table[cone], axis_of(water).scale(problem.table[water])
    handles: dict[str, Any] = {}
    points = ax.scatter(
        ci, problem.observed, c=w, cmap=_COLOURS, s=17, edgecolor=BLACK, linewidth=0.4, zorder=4
    )
    x = np.linspace(ci.min(), ci.max(), 60)
    for quantile, dashes in zip(_WATER_QUANTILES, DASHES, strict=False):
        at = float(np.quantile(problem.table[water], quantile))
        mean, measured = smooth_bands(result.calibration, {cone: x, water: np.full_like(x, at)})
        scaled = axis_of(water).factor * at
        colour = points.to_rgba(np.array([scaled]))[0]
        (line,) = ax.plot(x, mean.median, ls=dashes, lw=1.4, color=colour)
        handles[f"median, water {short(scaled)} {axis_of(water).unit}"] = line
        if quantile == 0.5:
            handles[f"90 % predictive, water {short(scaled)} {axis_of(water).unit}"] = (
                ax.fill_between(
                    x, measured.lower[0.9], measured.upper[0.9], color="#e4e4e4", lw=0.0, zorder=0
                )
            )
    ax.set_xlabel(axis_of(cone).label)
    ax.set_ylabel(axis_of(problem.bound.model.output).label)
    bar = fig.colorbar(points, ax=ax, cax=ax.inset_axes((1.03, 0.0, 0.035, 1.0)))
    bar.set_label(axis_of(water).label)
    bar.outline.set_linewidth(0.4)
    return handles


def draw_predicted_observed(ax: Axes, result: OutputResult) -> dict[str, Any]:
    """Draw what was predicted for rows that were not fitted against what was observed there."""
    v = result.validation
    axis = axis_of(result.calibration.problem.bound.model.output)
    low, high = np.nanquantile(v.draws, [0.05, 0.95], axis=0)
    median = np.nanmedian(v.draws, axis=0)
    inside = (v.observed >= low) & (v.observed <= high)
    held = held_table(result) is not None
    word = data_word(result)
    handles: dict[str, Any] = {}
    for part, colour, shape, name in (
        (inside, BLACK, "o", f"{word}, {'held out' if held else 'each left out'}, 90 % band"),
        (~inside, VERMILION, "s", "outside its 90 % band"),
    ):
        if part.any():
            handles[name] = ax.errorbar(
                v.observed[part], median[part],
                yerr=[(median - low)[part], (high - median)[part]],
                fmt=shape, ms=3.6, color=colour, ecolor=colour if shape == "s" else GREY,
                elinewidth=0.7, mec="white", mew=0.4,
            )  # fmt: skip
    ends = _ends(v.observed, median)
    (handles["observed = predicted"],) = ax.plot(ends, ends, color=GREY, lw=0.9, ls=DASHES[2])
    ax.xaxis.set_major_locator(MaxNLocator(5))
    ax.set_xlabel(f"Observed {axis.name.lower()} ({axis.unit})")
    ax.set_ylabel(f"Predicted {axis.name.lower()} ({axis.unit})")
    return handles


def _ends(*values: Array) -> Array:
    everything = np.concatenate(values)
    return np.array([everything.min(), everything.max()])


def _caption(result: OutputResult) -> str:
    problem, (cone, water) = result.calibration.problem, _columns(result)
    axis = axis_of(problem.bound.model.output)
    conditions = {
        name: np.median(problem.table[name]) * np.ones(2) for name in problem.bound.model.conditions
    }
    ci = np.quantile(problem.table[cone], [0.1, 0.9])
    wet = np.quantile(problem.table[water], [0.1, 0.9])
    effect = [
        np.diff(smooth_bands(result.calibration, {**conditions, name: ends})[0].median)[0]
        for name, ends in ((cone, ci), (water, wet))
    ]
    words = observed_words(result)
    return (
        f"{words[0].upper()}{words[1:]}. Between the 10 % and 90 % points of the data, cone index "
        f"moves the density by {short(effect[0])} {axis.unit}, water content by "
        f"{short(effect[1])} {axis.unit}; the largest miss of a row left out is "
        f"{percent(result.validation.scores.max_relative_error)}."
    )
