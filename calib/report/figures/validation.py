"""Validation on rows that were not fitted: errors, calibration of the bands, coverage."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from calib.report.figures.density import cone_and_water, draw_predicted_observed
from calib.report.figures.plate import Plate
from calib.report.figures.style import (
    BLACK,
    BLUE,
    DASHES,
    GREY,
    ORANGE,
    VERMILION,
    legend_below,
    note,
    panels,
)
from calib.report.labels import MINUS, NO_UNIT, axis_of, percent, short
from calib.report.reference import NOTHING, Reference
from calib.report.rows import data_word, held_table, x_column
from calib.report.study import OutputResult
from calib.validation.joint import effective_rows, ks_distance, pit_half_width
from calib.validation.validate import PARETO_K_MAX

__all__ = ["validation_plate"]


def validation_plate(result: OutputResult, *, reference: Reference = NOTHING) -> Plate:
    """Draw how predictions of unseen rows fared, in four panels.

    Parameters
    ----------
    result : OutputResult
    reference : Reference, optional
        Whose errors and stated limits are added.
    """
    fig, axes = panels(2, 2, height=52.0, left=15.0, bottom=22.0, gap_x=17.0, gap_y=15.0, top=10.0)
    if (
        cone_and_water(result.calibration.problem.bound.model)
        and result.validation.pareto_k is not None
    ):
        # The density figure before this one has predicted against observed already.
        first, handles = "Can rows be left out by reweighting?", _pareto(axes[0, 0], result)
    else:
        first, handles = "Predicted against observed", draw_predicted_observed(axes[0, 0], result)
    handles |= _relative_errors(axes[0, 1], result, reference)
    _pit(axes[1, 0], result)
    handles |= _coverage(axes[1, 1], result)
    for ax, title in zip(
        axes.flat,
        (first, f"(Predicted {MINUS} observed)/observed",
         "Are the bands calibrated? (PIT)", "Coverage of the bands"),
        strict=True,
    ):  # fmt: skip
        ax.set_title(title, loc="left")
    legend_below(fig, list(handles.values()), list(handles), 3)
    return Plate(fig, "validation", _caption(result), "Validation on rows that were not fitted")


def _pareto(ax: Axes, result: OutputResult) -> dict[str, Any]:
    v, axis = result.validation, axis_of(x_column(result))
    k = np.zeros(0) if v.pareto_k is None else v.pareto_k
    x = axis.scale(v.table[x_column(result)])
    (points,) = ax.plot(x, k, "o", color=BLACK, ms=3.8, mec="white", mew=0.4)
    line = ax.axhline(PARETO_K_MAX, color=VERMILION, lw=1.0, ls=DASHES[1])
    ax.set_ylim(min(0.0, 1.1 * float(k.min())), max(0.8, 1.1 * float(k.max())))
    ax.set_xlabel(axis.label)
    ax.set_ylabel(f"Pareto k ({NO_UNIT})")
    return {f"Pareto k ({data_word(result)})": points, "above: fitted again": line}


def _relative_errors(ax: Axes, result: OutputResult, reference: Reference) -> dict[str, Any]:
    v, x = result.validation, x_column(result)
    axis = axis_of(x)
    handles: dict[str, Any] = {}
    ax.axhline(0.0, color=GREY, lw=0.6)
    handles["error of the median"] = ax.plot(
        axis.scale(v.table[x]), 100.0 * v.scores.relative_error, "o", ms=4.2, color=BLUE,
        mec="white", mew=0.4, zorder=3,
    )[0]  # fmt: skip
    model = result.calibration.problem.bound.model
    curve = reference.curve(model.name, model.select(v.table.columns))
    if curve is not None:
        judged = np.isfinite(v.scores.relative_error)
        error = np.where(judged, 100.0 * (curve[0] - v.observed) / v.observed, np.nan)
        handles[f"error of the published fit ({curve[1]})"] = ax.plot(
            axis.scale(v.table[x]), error, "x", ms=4.5, mew=1.1, color=ORANGE, zorder=2
        )[0]
    for (value, name), dashes in zip(reference.limits(model.name), DASHES[1:], strict=False):
        for sign in (-1.0, 1.0):
            line = ax.axhline(sign * 100.0 * value, color=GREY, lw=0.9, ls=dashes)
        handles[f"largest error, {name}: {percent(value)}"] = line
    ax.set_xlabel(axis.label)
    ax.set_ylabel("Relative error (%)")
    ax.margins(y=0.1)
    return handles


def _pit(ax: Axes, result: OutputResult) -> None:
    pit = np.sort(result.validation.scores.pit)
    n = pit.size
    half = pit_half_width(result.validation.draws)
    u = np.linspace(0.0, 1.0, 200)
    ax.fill_between(u, np.clip(u - half, 0, 1), np.clip(u + half, 0, 1), color="#e4e4e4", lw=0)
    ax.plot(u, u, color=GREY, lw=0.9, ls=DASHES[2])
    ax.step(np.concatenate([[0.0], pit, [1.0]]), np.arange(n + 2).clip(0, n) / n, where="post",
            color=BLUE, lw=1.4)  # fmt: skip
    note(ax, "grey: where 95 % of such\nrows stay if the bands are right", x=0.98, y=0.04)
    ax.set_xlim(0.0, 1.0)
    ax.set_ylim(0.0, 1.02)
    ax.set_xlabel(f"Predictive probability below the observation ({NO_UNIT})")
    ax.set_ylabel(f"Part of the rows ({NO_UNIT})")


def _coverage(ax: Axes, result: OutputResult) -> dict[str, Any]:
    found = list(result.validation.scores.coverage.values())
    handles: dict[str, Any] = {}
    for i, c in enumerate(found):
        (handles["95 % interval of the coverage"],) = ax.plot(
            [100 * c.lower, 100 * c.upper], [i, i], color="#a9c9e2", lw=5.0,
            solid_capstyle="butt",
        )  # fmt: skip
        (handles["observed coverage"],) = ax.plot(100 * c.proportion, i, "D", ms=5.0, color=BLUE)
        (handles["nominal coverage"],) = ax.plot(
            [100 * c.level] * 2, [i - 0.25, i + 0.25], color=BLACK, lw=1.6
        )
        ax.text(2, i, f"{c.hits} of {c.n}", fontsize=7, va="center")
    ax.set_yticks(range(len(found)), [f"{100 * c.level:g}" for c in found])
    ax.set_ylim(-0.6, len(found) - 0.4)
    ax.set_xlim(0.0, 102.0)
    ax.set_xlabel("Rows covered (%)")
    ax.set_ylabel("Band (nominal %)")
    return handles


def _caption(result: OutputResult) -> str:
    v, s = result.validation, result.validation.scores
    axis = axis_of(result.calibration.problem.bound.model.output)
    held = held_table(result) is not None
    outside = bool(ks_distance(s.pit) > pit_half_width(v.draws))
    missing = int(np.isnan(s.relative_error).sum())
    label = f" ({data_word(result)})" if result.task.table.label else ""
    who = f"{s.n} held-out rows" if held else f"{s.n} rows, each predicted without itself,"
    left = f" ({missing} rows near zero are not judged)" if missing else ""
    cover = "; ".join(f"{100 * c.level:g} % band {c.hits} of {c.n}" for c in s.coverage.values())
    above = int((np.abs(s.relative_error) > 0.06).sum())
    many = "no row" if above == 0 else "1 row" if above == 1 else f"{above} rows"
    text = (
        f"Over {who}{label} the median is wrong by {short(s.rmse)} {axis.unit} rms and by "
        f"{percent(s.max_relative_error)} at most{left}, {many} by more than 6 %. "
        f"Covered: {cover}. The PIT {'leaves' if outside else 'stays inside'} its 95 % band."
    )
    effective = effective_rows(v.draws)
    if effective < 0.5 * s.n:
        text += (
            f" These rows share one curve: they say as much as {short(effective)} independent"
            f" {'row' if effective < 1.05 else 'rows'}."
        )
    if v.pareto_k is not None:
        text += f" {len(v.refitted)} of {s.n} rows needed a refit (Pareto k above 0.7)."
    return text
