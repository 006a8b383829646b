"""Figures of residuals, and of how predictions of rows that were not fitted fared."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from calib.data.table import Table
from calib.models.base import Array
from calib.report.figures import style
from calib.report.figures.bands import cone_and_water, draw_predicted_observed
from calib.report.figures.style import BAND, BLACK, BLUE, CYCLE, DASHES, DOTS, GREY, Plate, caption
from calib.report.labels import MINUS, NO_UNIT, axis_of, percent, unit_plain
from calib.report.numbers import centre_text
from calib.report.reference import NOTHING, Reference
from calib.report.rows import Group, data_word, groups, held_table, signs_along, x_column
from calib.report.study import OutputResult
from calib.validation.constants import PARETO_K_MAX
from calib.validation.prediction import effective_rows, ks_distance, pit_half_width
from calib.validation.scores import Standardised, normal_order, standardise


def residuals_plate(result: OutputResult, reference: Reference = NOTHING) -> Plate:
    """Draw residuals against prediction and condition, their quantiles, and replicated data."""
    fig, axes = style.panels(2, 2, height=46.0, bottom=22.0, gap_x=17.0, gap_y=15.0)
    problem, other = result.calibration.problem, held_table(result)
    x_axis, y_axis = axis_of(x_column(result)), axis_of(problem.bound.model.output)
    found: list[tuple[Table, Standardised]] = [
        (table, standardise(result.calibration, problem.with_table(table)))
        for table in (problem.table, other)
        if table is not None
    ]
    handles: dict[str, Any] = {}
    for ax, by_condition in zip(axes[0], (False, True), strict=True):
        rows = [
            (x_axis.scale(table[x_column(result)]) if by_condition else y_axis.scale(s.predicted),
             s.residual)
            for table, s in found
        ]  # fmt: skip
        handles |= _scatter(ax, result, rows)
        ax.set_ylabel("Residual (noise sd)")
    axes[0, 0].set_xlabel(y_axis.titled("Predicted"))
    axes[0, 1].set_xlabel(x_axis.label)
    _quantiles(axes[1, 0], found[0][1].residual)
    handles |= _replicated(axes[1, 1], result)
    along = f"Residuals against {x_axis.name.lower()}"
    titles = (
        "Residuals against prediction",
        along,
        "Are they normal?",
        "Data against replicated data",
    )
    style.set_titles(axes, titles)
    style.legend_below(fig, handles, 4)
    said = _residuals_caption(result, *[s.residual for _, s in found])
    return Plate(fig, "residuals", said, "Residuals")


def _scatter(ax: Axes, result: OutputResult, rows: list[tuple[Array, Array]]) -> dict[str, Any]:
    """Draw abscissas and residuals of fitted (filled) and held-out (open) rows."""
    handles: dict[str, Any] = {}
    ax.axhspan(-2.0, 2.0, color="#eeeeee", lw=0.0)
    ax.axhline(0.0, color=GREY, lw=0.6)
    for k, group in enumerate(_groups(result)):
        colour, marker = CYCLE[k % len(CYCLE)], style.MARKERS[k % len(style.MARKERS)]
        name = group.title or data_word(result)
        filled, open_ = {"color": colour, **DOTS}, {"mfc": "white", "mec": colour, "mew": 1.1}
        looks = (
            (name, group.fitted, filled),
            (name if group.held else f"{name}, held out", group.held_out, open_),
        )
        for (x, residual), (label, mine, look) in zip(rows, looks, strict=False):
            if mine.any():
                (line,) = ax.plot(x[mine], residual[mine], marker, ms=4.2, **{"ls": "none"} | look)
                handles[label] = line
    top = max(2.6, 1.08 * max(float(np.abs(residual).max()) for _, residual in rows))
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
    ax.fill_between(theory, low, high, color=BAND, lw=0.0)
    ax.plot(theory, theory, color=GREY, lw=0.9, ls=DASHES[2])
    ax.plot(theory, np.sort(residual), "o", color=BLUE, ms=3.8, **DOTS)
    ax.set(xlabel="Normal quantile (sd)", ylabel="Residual (noise sd)")


def _replicated(ax: Axes, result: OutputResult) -> dict[str, Any]:
    axis = axis_of(result.calibration.problem.bound.model.output)
    observed = np.sort(axis.scale(result.calibration.problem.observed))
    replicated = np.sort(axis.scale(result.posterior_predictive[:400]), axis=1)
    complete = replicated[np.isfinite(replicated).all(axis=1)]
    level = np.arange(1, observed.size + 1) / observed.size
    low, high = np.quantile(complete, [0.025, 0.975], axis=0)
    band = ax.fill_betweenx(level, low, high, color=BAND, lw=0.0, step="post")
    (line,) = ax.step(observed, level, where="post", color=BLACK, lw=1.2)
    ax.set(xlabel=axis.label, ylabel=f"Part of the data below ({NO_UNIT})", ylim=(0.0, 1.02))
    return {"95 % expected": band, f"{data_word(result)}, calibrated": line}


def _residuals_caption(result: OutputResult, fitted: Array, held: Array | None = None) -> str:
    problem, sigma = result.calibration.problem, result.calibration.summary.get("sigma")
    noise = problem.noise
    runs, pairs = signs_along(result, fitted)
    unit = "" if sigma is None or sigma.unit == "1" else f" {unit_plain(sigma.unit)}"
    return caption(
        "residuals",
        noise=noise,
        n=fitted.size,
        runs=runs,
        pairs=pairs,
        large=int((np.abs(fitted) > 2.0).sum()),
        along=axis_of(x_column(result)).name.lower(),
        sigma=None if sigma is None else f"{centre_text(sigma)}{unit}",
        noise_axis=axis_of(noise.column) if noise.column else None,
        log=problem.bound.model.response == "log",
        held=None if held is None else float(held.mean()),
    )


def validation_plate(result: OutputResult, reference: Reference = NOTHING) -> Plate:
    """Draw how predictions of unseen rows fared, in four panels, beside a source's errors."""
    v, model = result.validation, result.calibration.problem.bound.model
    fig, axes = style.panels(
        2, 2, height=52.0, left=15.0, bottom=22.0, gap_x=17.0, gap_y=15.0, top=10.0
    )
    # The density figure before this one has predicted against observed already.
    by_weights = cone_and_water(model) and v.pareto_k is not None
    handles = (_pareto if by_weights else draw_predicted_observed)(axes[0, 0], result)
    handles |= _relative_errors(axes[0, 1], result, reference)
    _pit(axes[1, 0], result)
    handles |= _coverage(axes[1, 1], result)
    first = "Can rows be left out by reweighting?" if by_weights else "Predicted against observed"
    error = f"(Predicted {MINUS} observed)/observed"
    calibrated = "Are the bands calibrated? (PIT)"
    style.set_titles(axes, (first, error, calibrated, "Coverage of the bands"))
    style.legend_below(fig, handles, 3)
    said = caption(
        "validation",
        s=v.scores,
        held=held_table(result) is not None,
        label=result.task.table.label,
        axis=axis_of(model.output),
        missing=int(np.isnan(v.scores.relative_error).sum()),
        outside=bool(ks_distance(v.scores.pit) > pit_half_width(v.draws)),
        effective=effective_rows(v.draws),
        refitted=None if v.pareto_k is None else len(v.refitted),
    )
    return Plate(fig, "validation", said, "Validation on rows that were not fitted")


def _pareto(ax: Axes, result: OutputResult) -> dict[str, Any]:
    v, axis = result.validation, axis_of(x_column(result))
    k = np.zeros(0) if v.pareto_k is None else v.pareto_k
    (points,) = ax.plot(axis.scale(v.table[x_column(result)]), k, "o", color=BLACK, ms=3.8, **DOTS)
    line = ax.axhline(PARETO_K_MAX, color=style.VERMILION, lw=1.0, ls=DASHES[1])
    ends = min(0.0, 1.1 * float(k.min())), max(0.8, 1.1 * float(k.max()))
    ax.set(xlabel=axis.label, ylabel=f"Pareto k ({NO_UNIT})", ylim=ends)
    return {f"Pareto k ({data_word(result)})": points, "above: fitted again": line}


def _relative_errors(ax: Axes, result: OutputResult, reference: Reference) -> dict[str, Any]:
    v, axis = result.validation, axis_of(x_column(result))
    x, error = axis.scale(v.table[x_column(result)]), v.scores.relative_error
    ax.axhline(0.0, color=GREY, lw=0.6)
    (points,) = ax.plot(x, 100.0 * error, "o", ms=4.2, color=BLUE, zorder=3, **DOTS)
    handles: dict[str, Any] = {"error of the median": points}
    model = result.calibration.problem.bound.model
    curve = reference.curve(model.name, model.select(v.table.columns))
    if curve is not None:
        judged = np.isfinite(error)
        theirs = np.where(judged, 100.0 * (curve[0] - v.observed) / v.observed, np.nan)
        (line,) = ax.plot(x, theirs, "x", ms=4.5, mew=1.1, color=style.ORANGE, zorder=2)
        handles[f"error of the published fit ({curve[1]})"] = line
    for (value, name), dashes in zip(reference.limits(model.name), DASHES[1:], strict=False):
        for end in (-100.0 * value, 100.0 * value):
            line = ax.axhline(end, color=GREY, lw=0.9, ls=dashes)
        handles[f"largest error, {name}: {percent(value)}"] = line
    ax.set(xlabel=axis.label, ylabel="Relative error (%)")
    ax.margins(y=0.1)
    return handles


def _pit(ax: Axes, result: OutputResult) -> None:
    pit = np.sort(result.validation.scores.pit)
    n = pit.size
    half = pit_half_width(result.validation.draws)
    u = np.linspace(0.0, 1.0, 200)
    ax.fill_between(u, np.clip(u - half, 0, 1), np.clip(u + half, 0, 1), color=BAND, lw=0)
    ax.plot(u, u, color=GREY, lw=0.9, ls=DASHES[2])
    below = np.arange(n + 2).clip(0, n) / n
    ax.step(np.concatenate([[0.0], pit, [1.0]]), below, where="post", color=BLUE, lw=1.4)
    style.note(ax, "grey: where 95 % of such\nrows stay if the bands are right", x=0.98, y=0.04)
    ax.set(xlabel=f"Predictive probability below the observation ({NO_UNIT})", xlim=(0.0, 1.0))
    ax.set(ylabel=f"Part of the rows ({NO_UNIT})", ylim=(0.0, 1.02))


def _coverage(ax: Axes, result: OutputResult) -> dict[str, Any]:
    found = list(result.validation.scores.coverage.values())
    handles: dict[str, Any] = {}
    for i, c in enumerate(found):
        ends = [100 * c.lower, 100 * c.upper]
        (interval,) = ax.plot(ends, [i, i], solid_capstyle="butt", color="#a9c9e2", lw=5.0)
        (observed,) = ax.plot(100 * c.proportion, i, "D", ms=5.0, color=BLUE)
        (nominal,) = ax.plot([100 * c.level] * 2, [i - 0.25, i + 0.25], color=BLACK, lw=1.6)
        handles = {
            "95 % interval of the coverage": interval,
            "observed coverage": observed,
            "nominal coverage": nominal,
        }
        ax.text(2, i, f"{c.hits} of {c.n}", fontsize=7, va="center")
    ax.set_yticks(range(len(found)), [f"{100 * c.level:g}" for c in found])
    ax.set(xlabel="Rows covered (%)", xlim=(0.0, 102.0))
    ax.set(ylabel="Band (nominal %)", ylim=(-0.6, len(found) - 0.4))
    return handles
