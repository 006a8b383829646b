"""Figures of residuals, and of how predictions of rows that were not fitted fared."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from calib.models.base import Array
from calib.report.figures.bands import cone_and_water, draw_predicted_observed
from calib.report.figures.plate import Plate
from calib.report.figures.style import (
    BLACK,
    BLUE,
    CYCLE,
    DASHES,
    GREY,
    MARKERS,
    ORANGE,
    VERMILION,
    caption,
    legend_below,
    note,
    panels,
)
from calib.report.labels import MINUS, NO_UNIT, axis_of, percent, unit_plain
from calib.report.numbers import centre_text
from calib.report.reference import NOTHING, Reference
from calib.report.rows import (
    Group,
    data_word,
    groups,
    held_table,
    signs_along,
    x_column,
)
from calib.report.study import OutputResult
from calib.validation.constants import PARETO_K_MAX
from calib.validation.prediction import effective_rows, ks_distance, pit_half_width
from calib.validation.scores import Standardised, normal_order, standardise


def residuals_plate(result: OutputResult) -> Plate:
    """Draw residuals against prediction and condition, their quantiles, and replicated data."""
    fig, axes = panels(2, 2, height=46.0, left=14.0, bottom=22.0, gap_x=17.0, gap_y=15.0)
    problem, other = result.calibration.problem, held_table(result)
    fitted = standardise(result.calibration, problem)
    held = None if other is None else standardise(result.calibration, problem.with_table(other))
    x = x_column(result)
    y_axis, x_axis = axis_of(problem.bound.model.output), axis_of(x)
    residuals = (fitted.residual, None if held is None else held.residual)
    handles = _scatter(
        axes[0, 0], result, residuals, y_axis.scale(fitted.predicted),
        None if held is None else y_axis.scale(held.predicted),
    )  # fmt: skip
    _scatter(
        axes[0, 1], result, residuals, x_axis.scale(problem.table[x]),
        None if other is None else x_axis.scale(other[x]),
    )  # fmt: skip
    axes[0, 0].set_xlabel(f"Predicted {y_axis.name.lower()} ({y_axis.unit})")
    axes[0, 1].set_xlabel(x_axis.label)
    for ax in axes[0]:
        ax.set_ylabel("Residual (noise sd)")
    _quantiles(axes[1, 0], fitted.residual)
    handles |= _replicated(axes[1, 1], result)
    for ax, title in zip(
        axes.flat,
        ("Residuals against prediction", f"Residuals against {x_axis.name.lower()}",
         "Are they normal?", "Data against replicated data"),
        strict=True,
    ):  # fmt: skip
        ax.set_title(title, loc="left")
    legend_below(fig, handles, 4)
    return Plate(fig, "residuals", _residuals_caption(result, fitted, held), "Residuals")


def _scatter(
    ax: Axes, result: OutputResult, residuals: tuple[Array, Array | None], fitted: Array,
    held: Array | None,
) -> dict[str, Any]:  # fmt: skip
    """Draw residuals of fitted (filled) and held-out (open) rows at their abscissas."""
    mine, theirs = residuals
    handles: dict[str, Any] = {}
    ax.axhspan(-2.0, 2.0, color="#eeeeee", lw=0.0)
    ax.axhline(0.0, color=GREY, lw=0.6)
    for k, group in enumerate(_groups(result)):
        colour, marker = CYCLE[k % len(CYCLE)], MARKERS[k % len(MARKERS)]
        name = group.title or data_word(result)
        if group.fitted.any():
            (handles[name],) = ax.plot(
                fitted[group.fitted], mine[group.fitted], marker, color=colour, ms=4.2,
                mec="white", mew=0.4,
            )  # fmt: skip
        if theirs is not None and held is not None and group.held_out.any():
            (handles[name if group.held else f"{name}, held out"],) = ax.plot(
                held[group.held_out], theirs[group.held_out], marker, mfc="white",
                mec=colour, mew=1.1, ms=4.2,
            )  # fmt: skip
    largest = max(float(np.abs(r).max()) for r in residuals if r is not None)
    top = max(2.6, 1.08 * largest)
    ax.set_ylim(-top, top)
    return handles


def _groups(result: OutputResult) -> list[Group]:
    """Every row in a group; in one, where there are more groups than looks."""
    found = groups(result, most=False)
    if len(found) <= len(CYCLE):
        return found
    fitted, held = (np.any([getattr(g, a) for g in found], axis=0) for a in ("fitted", "held_out"))
    return [Group("", False, None, float("nan"), fitted, held)]


def _quantiles(ax: Axes, residual: Array) -> None:
    theory, low, high = normal_order(residual.size)
    ax.fill_between(theory, low, high, color="#e4e4e4", lw=0.0)
    ax.plot(theory, theory, color=GREY, lw=0.9, ls=DASHES[2])
    ax.plot(theory, np.sort(residual), "o", color=BLUE, ms=3.8, mec="white", mew=0.4)
    ax.set_xlabel("Normal quantile (sd)")
    ax.set_ylabel("Residual (noise sd)")


def _replicated(ax: Axes, result: OutputResult) -> dict[str, Any]:
    axis = axis_of(result.calibration.problem.bound.model.output)
    observed = np.sort(axis.scale(result.calibration.problem.observed))
    replicated = np.sort(axis.scale(result.posterior_predictive[:400]), axis=1)
    complete = replicated[np.isfinite(replicated).all(axis=1)]
    level = np.arange(1, observed.size + 1) / observed.size
    low, high = np.quantile(complete, [0.025, 0.975], axis=0)
    handles: dict[str, Any] = {
        "95 % expected": ax.fill_betweenx(level, low, high, color="#e4e4e4", lw=0.0, step="post")
    }
    (handles[f"{data_word(result)}, calibrated"],) = ax.step(
        observed, level, where="post", color=BLACK, lw=1.2
    )
    ax.set_xlabel(axis.label)
    ax.set_ylabel(f"Part of the data below ({NO_UNIT})")
    ax.set_ylim(0.0, 1.02)
    return handles


def _residuals_caption(
    result: OutputResult, fitted: Standardised, held: Standardised | None
) -> str:
    noise = result.calibration.problem.noise
    runs, pairs = signs_along(result, fitted.residual)
    sigma = result.calibration.summary.get("sigma")
    unit = "" if sigma is None or sigma.unit == "1" else f" {unit_plain(sigma.unit)}"
    return caption(
        "residuals", noise=noise, n=fitted.residual.size, runs=runs, pairs=pairs,
        large=int((np.abs(fitted.residual) > 2.0).sum()),
        along=axis_of(x_column(result)).name.lower(),
        sigma=None if sigma is None else f"{centre_text(sigma)}{unit}",
        noise_axis=axis_of(noise.column) if noise.column else None,
        log=result.calibration.problem.bound.model.response == "log",
        held=None if held is None else float(held.residual.mean()),
    )  # fmt: skip


def validation_plate(result: OutputResult, *, reference: Reference = NOTHING) -> Plate:
    """Draw how predictions of unseen rows fared, in four panels, beside a source's errors."""
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
    legend_below(fig, handles, 3)
    v = result.validation
    said = caption(
        "validation", s=v.scores, held=held_table(result) is not None,
        label=result.task.table.label,
        axis=axis_of(result.calibration.problem.bound.model.output),
        missing=int(np.isnan(v.scores.relative_error).sum()),
        outside=bool(ks_distance(v.scores.pit) > pit_half_width(v.draws)),
        effective=effective_rows(v.draws),
        refitted=None if v.pareto_k is None else len(v.refitted),
    )  # fmt: skip
    return Plate(fig, "validation", said, "Validation on rows that were not fitted")


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
