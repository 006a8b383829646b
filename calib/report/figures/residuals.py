"""Is the noise what the likelihood says: standardised residuals, normality, replicated data."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from scipy.stats import beta, levene, norm, shapiro

from calib.data.quantities import role_of
from calib.models.base import Array
from calib.report.figures.plate import Plate
from calib.report.figures.style import (
    BLACK,
    BLUE,
    CYCLE,
    DASHES,
    GREY,
    MARKERS,
    legend_below,
    panels,
)
from calib.report.labels import NO_UNIT, axis_of, joined, plain, short, unit_plain
from calib.report.posterior_text import centre_text
from calib.report.rows import (
    Group,
    data_word,
    group_column,
    groups,
    held_table,
    signs_along,
    x_column,
)
from calib.report.study import OutputResult
from calib.validation.residuals import Standardised, standardise

__all__ = ["residuals_plate"]

# Rows of a group whose spread is compared, at least.
_FEWEST = 5
_SIGNIFICANT = 0.05


def residuals_plate(result: OutputResult) -> Plate:
    """Draw residuals against prediction and condition, their quantiles, and replicated data.

    Parameters
    ----------
    result : OutputResult
    """
    fig, axes = panels(2, 2, height=46.0, left=14.0, bottom=22.0, gap_x=17.0, gap_y=15.0)
    problem, other = result.calibration.problem, held_table(result)
    fitted = standardise(result.calibration, problem)
    held = None if other is None else standardise(result.calibration, problem.with_table(other))
    x = x_column(result)
    y_axis, x_axis = axis_of(problem.bound.model.output), axis_of(x)
    residuals = (fitted.residual, None if held is None else held.residual)
    handles = _scatter(
        axes[0, 0], result, residuals, fitted.predicted, None if held is None else held.predicted
    )
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
    legend_below(fig, list(handles.values()), list(handles), 4)
    return Plate(fig, "residuals", _caption(result, fitted, held), "Residuals")


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
    n = residual.size
    i = np.arange(1, n + 1)
    theory = norm.ppf((i - 0.375) / (n + 0.25))
    low, high = (norm.ppf(beta.ppf(p, i, n + 1 - i)) for p in (0.025, 0.975))
    ax.fill_between(theory, low, high, color="#e4e4e4", lw=0.0)
    ax.plot(theory, theory, color=GREY, lw=0.9, ls=DASHES[2])
    ax.plot(theory, np.sort(residual), "o", color=BLUE, ms=3.8, mec="white", mew=0.4)
    ax.set_xlabel("Normal quantile (sd)")
    ax.set_ylabel("Residual (noise sd)")


def _replicated(ax: Axes, result: OutputResult) -> dict[str, Any]:
    observed = np.sort(result.calibration.problem.observed)
    replicated = np.sort(result.posterior_predictive[:400], axis=1)
    complete = replicated[np.isfinite(replicated).all(axis=1)]
    level = np.arange(1, observed.size + 1) / observed.size
    low, high = np.quantile(complete, [0.025, 0.975], axis=0)
    handles: dict[str, Any] = {
        "95 % expected": ax.fill_betweenx(level, low, high, color="#e4e4e4", lw=0.0, step="post")
    }
    (handles[f"{data_word(result)}, calibrated"],) = ax.step(
        observed, level, where="post", color=BLACK, lw=1.2
    )
    axis = axis_of(result.calibration.problem.bound.model.output)
    ax.set_xlabel(axis.label)
    ax.set_ylabel(f"Part of the data below ({NO_UNIT})")
    ax.set_ylim(0.0, 1.02)
    return handles


def _caption(result: OutputResult, fitted: Standardised, held: Standardised | None) -> str:
    n, large = fitted.residual.size, int((np.abs(fitted.residual) > 2.0).sum())
    p = float(shapiro(fitted.residual).pvalue) if n >= 3 else float("nan")
    runs, pairs = signs_along(result, fitted.residual)
    beyond = "As normal scores, b" if result.calibration.problem.noise.student else "B"
    text = (
        f"{beyond}eyond 2 noise sds lie {large} of {n} residuals ({short(0.046 * n)} expected); "
        "they "
        f"{'are compatible with' if p > 0.05 else 'depart from'} a normal law (Shapiro-Wilk p = "
        f"{short(p)}) and change sign {runs} times along {axis_of(x_column(result)).name.lower()} "
        f"where independent ones would do so about {0.5 * pairs:.0f} times."
    )
    sigma = result.calibration.summary.get("sigma")
    if sigma is not None:
        unit = "" if sigma.unit == "1" else f" {unit_plain(sigma.unit)}"
        scale = " of ln output" if result.calibration.problem.bound.model.response == "log" else ""
        noise = result.calibration.problem.noise
        what = "The noise scale" if noise.student else "One noise sd"
        where = f" at the mean {axis_of(noise.column).name.lower()}" if noise.column else ""
        text += f" {what} {plain('sigma')}{where} is {centre_text(sigma)}{unit}{scale}."
    text += _spread_words(result, fitted)
    if held is not None:
        mean = float(held.residual.mean())
        side = "above" if mean > 0.0 else "below"
        text += f" Held-out rows (open) lie {short(abs(mean))} noise sds {side} their prediction."
    return text


def _spread_words(result: OutputResult, fitted: Standardised) -> str:
    """Say whether the noise differs between pressures; empty where too few rows would tell."""
    problem = result.calibration.problem
    if role_of(group_column(result) or "") != "pressure" or problem.noise.column:
        return ""
    log = problem.bound.model.response == "log"
    raw = problem.response - problem.bound.to_response(fitted.predicted)
    found = [(g.title, raw[g.fitted]) for g in groups(result, most=False)]
    found = [(title, r) for title, r in found if r.size >= _FEWEST]
    if len(found) < 2:
        return ""
    p = float(levene(*(r for _, r in found)).pvalue)
    if not p < _SIGNIFICANT:
        return f" Their spread does not tell the pressures apart (Levene p = {short(p)})."
    unit = "of ln output" if log else axis_of(problem.bound.model.output).unit
    sds = sorted(((float(r.std(ddof=1)), title) for title, r in found), reverse=True)
    listed = joined([f"{short(sd)} {unit} at {title}" for sd, title in sds])
    return (
        f" Their sd differs between pressures: {listed} (Levene p = {short(p)}); one "
        f"{plain('sigma')} for all makes the bands too narrow at {sds[0][1]} and too wide at "
        f"{sds[-1][1]}."
    )
