"""The figure of density over cone index and water content, and predicted against observed."""

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
from calib.report.figures.bands import observed_words, scaled
from calib.report.figures.plate import Plate
from calib.report.figures.style import BLACK, DASHES, GREY, VERMILION, legend_below, panels
from calib.report.labels import axis_of, percent, short
from calib.report.rows import data_word, held_table
from calib.report.study import OutputResult
from calib.validation.prediction import median_change, smooth_bands

_WATER_QUANTILES = (0.1, 0.5, 0.9)
# Yellow would vanish on white.
_COLOURS = ListedColormap(mpl.colormaps["YlGnBu"](np.linspace(0.35, 1.0, 128)))


def density_plate(result: OutputResult) -> Plate:
    """Draw density against cone index, coloured by water content, and predicted against observed.

    A CalibError says that the model is not of density by cone index and water content.
    """
    fig, axes = panels(
        1, 2, height=64.0, bottom=22.0, left=14.0, gap_x=30.0, right=3.0, top=4.0
    )  # fmt: skip
    handles = _against_cone_index(axes[0, 0], fig, result)
    handles |= draw_predicted_observed(axes[0, 1], result)
    legend_below(fig, list(handles.values()), list(handles), 3)
    return Plate(fig, "bands", _density_caption(result), "Prediction and data")


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
    of_cone, of_density = axis_of(cone), axis_of(problem.bound.model.output)
    handles: dict[str, Any] = {}
    points = ax.scatter(
        of_cone.scale(ci), of_density.scale(problem.observed), c=w, cmap=_COLOURS, s=17,
        edgecolor=BLACK, linewidth=0.4, zorder=4,
    )  # fmt: skip
    x = np.linspace(ci.min(), ci.max(), 60)
    for quantile, dashes in zip(_WATER_QUANTILES, DASHES, strict=False):
        at = float(np.quantile(problem.table[water], quantile))
        mean, measured = (
            scaled(of_density, b)
            for b in smooth_bands(result.calibration, {cone: x, water: np.full_like(x, at)})
        )
        shown = axis_of(water).factor * at
        colour = points.to_rgba(np.array([shown]))[0]
        (line,) = ax.plot(of_cone.scale(x), mean.median, ls=dashes, lw=1.4, color=colour)
        handles[f"median, water {short(shown)} {axis_of(water).unit}"] = line
        if quantile == 0.5:
            handles[f"90 % predictive, water {short(shown)} {axis_of(water).unit}"] = (
                ax.fill_between(
                    of_cone.scale(x),
                    measured.lower[0.9],
                    measured.upper[0.9],
                    color="#e4e4e4",
                    lw=0.0,
                    zorder=0,
                )
            )
    ax.set_xlabel(of_cone.label)
    ax.set_ylabel(of_density.label)
    bar = fig.colorbar(points, ax=ax, cax=ax.inset_axes((1.03, 0.0, 0.035, 1.0)))
    bar.set_label(axis_of(water).label)
    bar.outline.set_linewidth(0.4)
    return handles


def draw_predicted_observed(ax: Axes, result: OutputResult) -> dict[str, Any]:
    """Draw what was predicted for rows that were not fitted against what was observed there."""
    v = result.validation
    axis = axis_of(result.calibration.problem.bound.model.output)
    observed = axis.scale(v.observed)
    low, high = axis.scale(np.nanquantile(v.draws, [0.05, 0.95], axis=0))
    median = axis.scale(np.nanmedian(v.draws, axis=0))
    inside = (observed >= low) & (observed <= high)
    held = held_table(result) is not None
    word = data_word(result)
    handles: dict[str, Any] = {}
    for part, colour, shape, name in (
        (inside, BLACK, "o", f"{word}, {'held out' if held else 'each left out'}, 90 % band"),
        (~inside, VERMILION, "s", "outside its 90 % band"),
    ):
        if part.any():
            handles[name] = ax.errorbar(
                observed[part], median[part],
                yerr=[(median - low)[part], (high - median)[part]],
                fmt=shape, ms=3.6, color=colour, ecolor=colour if shape == "s" else GREY,
                elinewidth=0.7, mec="white", mew=0.4,
            )  # fmt: skip
    ends = _ends(observed, median)
    (handles["observed = predicted"],) = ax.plot(ends, ends, color=GREY, lw=0.9, ls=DASHES[2])
    ax.xaxis.set_major_locator(MaxNLocator(5))
    ax.set_xlabel(f"Observed {axis.name.lower()} ({axis.unit})")
    ax.set_ylabel(f"Predicted {axis.name.lower()} ({axis.unit})")
    return handles


def _ends(*values: Array) -> Array:
    everything = np.concatenate(values)
    return np.array([everything.min(), everything.max()])


def _density_caption(result: OutputResult) -> str:
    cone, water = _columns(result)
    axis = axis_of(result.calibration.problem.bound.model.output)
    effect = [axis.factor * median_change(result.calibration, name) for name in (cone, water)]
    words = observed_words(result)
    return (
        f"{words[0].upper()}{words[1:]}. Between the 10 % and 90 % points of the data, cone index "
        f"moves the density by {short(effect[0])} {axis.unit}, water content by "
        f"{short(effect[1])} {axis.unit}; the largest miss of a row left out is "
        f"{percent(result.validation.scores.max_relative_error)}."
    )
