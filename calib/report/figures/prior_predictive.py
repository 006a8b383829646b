"""What the priors alone expect, with the data on top."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from calib.report.figures.bands import FILLS, scatter_points
from calib.report.figures.plate import Plate
from calib.report.figures.style import DOUBLE_MM, GREY, MIDDLE_MM, legend_below, panels
from calib.report.labels import axis_of, short
from calib.report.rows import Group, data_word, grid, groups, smooth_bands, x_column
from calib.report.study import OutputResult
from calib.validation.joint import hits

__all__ = ["prior_predictive_plate"]

# A heavy prior tail would flatten the data: the axis ends at this multiple of their range.
_ZOOM = 4.0


def prior_predictive_plate(result: OutputResult) -> Plate:
    """Draw bands of prior predictive measurements at the calibration conditions.

    Parameters
    ----------
    result : OutputResult
    """
    problem = result.calibration.problem
    x_axis, y_axis = axis_of(x_column(result)), axis_of(problem.bound.model.output)
    shown = [g for g in groups(result) if g.fitted.any()]
    cols = min(3, len(shown))
    rows = -(-len(shown) // cols)
    fig, axes = panels(
        rows, cols, height=44.0, width=DOUBLE_MM if cols > 1 else MIDDLE_MM, bottom=16.0, top=6.0,
        gap_x=3.0, gap_y=8.0, sharex=True, sharey=True,
    )  # fmt: skip
    handles: dict[str, Any] = {}
    for ax, group in zip(axes.flat, shown, strict=False):
        handles |= _panel(ax, result, group)
        ax.set_title(group.title)
    for ax in axes.flat[len(shown) :]:
        ax.set_visible(False)
    for ax in axes[-1]:
        ax.set_xlabel(x_axis.label)
    for ax in axes[:, 0]:
        ax.set_ylabel(y_axis.label)
    y = problem.observed
    reach = _ZOOM * max(float(np.ptp(y)), 0.1 * float(np.abs(y).max()))
    low, high = axes[0, 0].get_ylim()
    floor = 0.0 if y.min() >= 0.0 and problem.bound.model.response == "log" else y.min() - reach
    axes[0, 0].set_ylim(max(low, floor), min(high, y.max() + reach))
    legend_below(fig, list(handles.values()), list(handles), 5)
    return Plate(fig, "prior_predictive", _caption(result), "What the priors alone expect")


def _panel(ax: Axes, result: OutputResult, group: Group) -> dict[str, Any]:
    problem = result.calibration.problem
    x, scale = x_column(result), axis_of(x_column(result)).scale
    conditions = grid(result, group)
    _, expected = smooth_bands(result.calibration, conditions, prior=True)
    along = scale(conditions[x])
    handles: dict[str, Any] = {
        f"prior, {100 * level:g} %": ax.fill_between(
            along, expected.lower[level], expected.upper[level], color=grey, lw=0.0
        )
        for level, grey in zip(FILLS, ("#ececec", "#d9d9d9", "#bdbdbd"), strict=True)
    }
    (handles["prior median"],) = ax.plot(along, expected.median, color=GREY, lw=1.3)
    handles[data_word(result)] = scatter_points(
        ax, scale(problem.table[x][group.fitted]), problem.observed[group.fitted], held=False
    )
    return handles


def _caption(result: OutputResult) -> str:
    observed = result.calibration.problem.observed
    low, high = np.nanquantile(result.prior_predictive, [0.025, 0.975], axis=0)
    after = np.nanquantile(result.posterior_predictive, [0.025, 0.975], axis=0)
    inside = hits(result.prior_predictive, observed, 0.95)
    ratio = float(np.median(high - low) / np.median(after[1] - after[0]))
    return (
        f"Before any datum, the priors' 95 % band holds {inside} of {observed.size} calibration "
        f"points and is {short(ratio)} times as wide as the posterior's."
    )
