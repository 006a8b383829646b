"""Figures of predictions: bands with data, density over cone index and water content."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from calib.data.quantities import role_of
from calib.data.table import Table
from calib.errors import CalibError
from calib.models.base import Array, Model
from calib.report.figures import style
from calib.report.figures.style import BLACK, BLUE, DASHES, DOTS, GREY, VERMILION, Plate, caption
from calib.report.labels import Axis, axis_of, short
from calib.report.reference import NOTHING, Reference
from calib.report.rows import (
    Fitted,
    Group,
    data_word,
    grid,
    group_column,
    groups,
    held_table,
    x_column,
)
from calib.report.study import OutputResult
from calib.validation.prediction import Bands, hits, median_change, smooth_bands

# Lighter outwards, also in greyscale.
FILLS = {0.95: "#dfebf5", 0.9: "#bcd6ea", 0.5: "#86b5d9"}

type _Result = OutputResult | Fitted
type _Draw = Callable[[Axes, Any, Group], dict[str, Any]]


def _scaled(axis: Axis, found: Bands) -> Bands:
    """Convert bands from the canonical unit to that of an axis."""
    ends = found.lower, found.upper
    lower, upper = ({level: axis.scale(v) for level, v in end.items()} for end in ends)
    return Bands(axis.scale(found.median), lower, upper)


def _points(ax: Axes, x: Array, y: Array, *, held: bool = False) -> Any:
    """Draw measured points: filled where fitted, ringed where held out."""
    if held:
        return ax.plot(x, y, "o", ms=5.0, mfc="white", mec=VERMILION, mew=1.3, zorder=5)[0]
    return ax.plot(x, y, "o", ms=3.6, color=BLACK, zorder=4, **DOTS)[0]


def _by_group(result: _Result, shown: list[Group], draw: _Draw, **layout: Any) -> Figure:
    """Draw a panel for each group, a legend below all."""
    cols = min(3, len(shown))
    width = style.DOUBLE_MM if cols > 1 else style.MIDDLE_MM
    figure, axes = style.panels(
        -(-len(shown) // cols), cols, width=width, gap_x=3.0, gap_y=8.0, sharex=True, sharey=True,
        **layout,
    )  # fmt: skip
    handles: dict[str, Any] = {}
    for ax, group in zip(axes.flat, shown, strict=False):
        handles |= draw(ax, result, group)
        weight, colour = ("bold", style.EMBER) if group.held else ("normal", BLACK)
        ax.set_title(group.title, color=colour, weight=weight)
    style.hide_rest(axes, len(shown))
    output = result.calibration.problem.bound.model.output
    style.label_outer(axes, axis_of(x_column(result)).label, axis_of(output).label)
    style.legend_below(figure, handles, 5 if len(handles) == 5 else 4 if cols > 1 else 3)
    return figure


def bands_plate(result: OutputResult, reference: Reference = NOTHING) -> Plate:
    """Draw the predictive bands of an output along slip or pressure, beside a published fit."""
    said = _bands_caption(result, len(groups(result)))
    return Plate(bands_figure(result, reference), "bands", said, "Prediction and data")


def bands_figure(result: _Result, reference: Reference = NOTHING) -> Figure:
    """Draw predictive bands and data along slip or pressure, or along cone index of a density."""
    columns, shown = cone_and_water(result.calibration.problem.bound.model), groups(result)
    if columns is not None:
        figure, axes = style.panels(
            1, 1, height=64.0, width=style.MIDDLE_MM, bottom=22.0, right=24.0
        )
        style.legend_below(figure, _against_cone_index(axes[0, 0], figure, result, *columns), 2)
        return figure

    def draw(ax: Axes, result: _Result, group: Group) -> dict[str, Any]:
        handles = _panel(ax, result, group, reference)
        ax.margins(x=0.02)
        return handles

    height = 52.0 if len(shown) > 1 else 60.0
    return _by_group(result, shown, draw, height=height, bottom=20.0, top=7.0)


def _panel(ax: Axes, result: _Result, group: Group, reference: Reference) -> dict[str, Any]:
    problem, held = result.calibration.problem, held_table(result)
    x, y = x_column(result), problem.bound.model.output
    conditions = grid(result, group)
    scale, y_axis = axis_of(x).scale, axis_of(y)
    along = scale(conditions[x])
    mean, measured = (_scaled(y_axis, b) for b in smooth_bands(result.calibration, conditions))
    handles: dict[str, Any] = {
        f"{100 * level:g} % predictive": ax.fill_between(
            along, measured.lower[level], measured.upper[level], color=colour, lw=0.0
        )
        for level, colour in FILLS.items()
    }
    (handles["median"],) = ax.plot(along, mean.median, color=BLUE, lw=1.4)
    for edge in (mean.lower[0.9], mean.upper[0.9]):
        (line,) = ax.plot(along, edge, color=BLUE, lw=0.8, ls=DASHES[1])
        handles["90 %, parameters only"] = line
    curve = reference.curve(problem.bound.model.name, conditions)
    if curve is not None:
        dashes = {"lw": 1.4, "ls": DASHES[3], "zorder": 3}
        (line,) = ax.plot(along, y_axis.scale(curve[0]), color=style.ORANGE, **dashes)
        handles[f"published fit ({curve[1]})"] = line
    word, unseen = data_word(result), None if result.validation is None else result.validation.draws
    for table, rows, draws, name, is_held in (
        (problem.table, group.fitted, result.posterior_predictive, "calibrated", False),
        (held, group.held_out, unseen, "held out", True),
    ):
        if table is None or not rows.any():
            continue
        away = rows & _elsewhere(table, conditions, x)
        if away.any() and draws is not None:
            low, high = y_axis.scale(np.nanquantile(draws[:, away], [0.05, 0.95], axis=0))
            handles["90 % at the row's own conditions"] = ax.vlines(
                scale(table[x][away]), low, high, color=GREY, lw=3.0, alpha=0.5, zorder=3.5
            )
        at, values = scale(table[x][rows]), y_axis.scale(table[y][rows])
        dots = handles[f"{word}, {name}"] = _points(ax, at, values, held=is_held)
        if draws is not None:
            expected = y_axis.scale(np.nanquantile(draws[:, rows], [0.05, 0.5, 0.95], axis=0))
            style.say_of_points(dots, said_of_rows(axis_of(x), y_axis, at, values, expected, name))
    return handles


def said_of_rows(
    x: Axis, y: Axis, at: Array, values: Array, expected: Array, name: str
) -> Iterator[str]:
    """Say of measured points where they are, and what was expected there (3, n)."""
    for place, value, (low, middle, high) in zip(at, values, expected.T, strict=True):
        yield (
            f"{x.name} {short(place, 3)} {x.unit}, {name}: measured {short(value, 3)} {y.unit}; "
            f"expected {short(middle, 3)} ({short(low, 3)} to {short(high, 3)}, 90 % band)"
        )


def _elsewhere(table: Table, drawn: Mapping[str, Array], x: str) -> NDArray[np.bool_]:
    """Which rows (n,) are at other conditions, beside x, than a curve is drawn at."""
    apart = np.zeros(len(table), dtype=np.bool_)
    for name in drawn.keys() - {x}:
        apart |= ~np.isclose(table[name], drawn[name][0], rtol=1e-6, atol=1e-12)
    return apart


def _covered(result: OutputResult) -> dict[str, Any]:
    """Return what the bands covered of the fitted rows and of those not fitted."""
    observed = result.calibration.problem.observed
    return {
        "inside": hits(result.posterior_predictive, observed, 0.9),
        "fitted": observed.size,
        "unseen": result.validation.scores.coverage[0.9],
        "held": held_table(result) is not None,
        "axis": axis_of(result.calibration.problem.bound.model.output),
    }


def _bands_caption(result: OutputResult, shown: int) -> str:
    facts, held = _covered(result), held_table(result)
    worst = pooled = None
    if held is not None:
        miss = facts["axis"].scale(result.validation.scores.median - result.validation.observed)
        i, where = int(np.nanargmax(np.abs(miss))), axis_of(x_column(result))
        worst = {"axis": where, "at": where.factor * held[x_column(result)][i], "miss": miss[i]}
    column = group_column(result)
    total = 0 if column is None else np.unique(result.task.table[column]).size
    if column is not None and 0 < shown < total:
        titles, name = [g.title for g in groups(result)], axis_of(column).name.lower()
        pooled = {"total": total, "name": name, "titles": titles}
    drawn_at = _drawn_at(result)
    return caption("bands", **facts, worst=worst, pooled=pooled, drawn_at=drawn_at)


def _drawn_at(result: OutputResult) -> list[str]:
    """Say at what the curves are drawn, of conditions that vary within a panel."""
    table, said = result.calibration.problem.table, []
    for name in result.calibration.problem.bound.model.conditions:
        inside = [table[name][g.fitted] for g in groups(result) if g.fitted.any()]
        if name == x_column(result) or all(np.ptp(v) <= 1e-6 * np.abs(v).max() for v in inside):
            continue
        axis = axis_of(name)
        middles, rows = [float(np.median(v)) for v in inside], np.concatenate(inside)
        at, whole = (
            " to ".join(dict.fromkeys(map(axis.value_text, (min(v), max(v)))))
            for v in (middles, rows)
        )
        said.append(f"{axis.name.lower()} {at} {axis.unit} (rows at {whole} {axis.unit})")
    return said


def prior_predictive_plate(result: OutputResult, reference: Reference = NOTHING) -> Plate:
    """Draw bands of prior predictive measurements at the calibration conditions."""
    problem = result.calibration.problem
    y_axis = axis_of(problem.bound.model.output)
    shown = [g for g in groups(result) if g.fitted.any()]
    figure = _by_group(result, shown, _prior_panel, height=44.0, bottom=16.0, top=6.0)
    y, ax = y_axis.scale(problem.observed), figure.axes[0]
    # A heavy prior tail would flatten the data: the axis ends at four times their range.
    reach = 4.0 * max(float(np.ptp(y)), 0.1 * float(np.abs(y).max()))
    low, high = ax.get_ylim()
    floor = 0.0 if y.min() >= 0.0 and problem.bound.model.response == "log" else y.min() - reach
    ax.set_ylim(max(low, floor), min(high, y.max() + reach))
    before, after = (
        np.diff(np.nanquantile(draws, [0.025, 0.975], axis=0), axis=0)
        for draws in (result.prior_predictive, result.posterior_predictive)
    )
    inside = hits(result.prior_predictive, problem.observed, 0.95)
    ratio = float(np.median(before) / np.median(after))
    said = caption("prior_predictive", inside=inside, fitted=y.size, ratio=ratio)
    return Plate(figure, "prior_predictive", said, "What the priors alone expect")


def _prior_panel(ax: Axes, result: OutputResult, group: Group) -> dict[str, Any]:
    problem = result.calibration.problem
    x, scale = x_column(result), axis_of(x_column(result)).scale
    y_axis = axis_of(problem.bound.model.output)
    conditions = grid(result, group)
    expected = _scaled(y_axis, smooth_bands(result.calibration, conditions, prior=True)[1])
    along = scale(conditions[x])
    handles: dict[str, Any] = {
        f"prior, {100 * level:g} %": ax.fill_between(
            along, expected.lower[level], expected.upper[level], color=grey, lw=0.0
        )
        for level, grey in zip(FILLS, ("#ececec", "#d9d9d9", "#bdbdbd"), strict=True)
    }
    (handles["prior median"],) = ax.plot(along, expected.median, color=GREY, lw=1.3)
    at, values = scale(problem.table[x][group.fitted]), problem.observed[group.fitted]
    handles[data_word(result)] = _points(ax, at, y_axis.scale(values))
    return handles


# Yellow would vanish on white.
_WATER = ListedColormap(mpl.colormaps["YlGnBu"](np.linspace(0.35, 1.0, 128)))


def density_plate(result: OutputResult, reference: Reference = NOTHING) -> Plate:
    """Draw density against cone index, coloured by water content, and predicted against observed.

    A CalibError says that the model is not of density by cone index and water content.
    """
    columns = cone_and_water(result.calibration.problem.bound.model)
    if columns is None:
        raise CalibError(
            "the figure is of density models of cone index and water content",
            hint="draw `bands_plate` of other models",
        )
    fig, axes = style.panels(1, 2, height=64.0, bottom=22.0, gap_x=30.0, top=4.0)
    handles = _against_cone_index(axes[0, 0], fig, result, *columns)
    handles |= draw_predicted_observed(axes[0, 1], result)
    style.legend_below(fig, handles, 3)
    facts = _covered(result)
    change = [facts["axis"].factor * median_change(result.calibration, name) for name in columns]
    miss = result.validation.scores.max_relative_error
    said = caption("density", **facts, effect=change, miss=miss)
    return Plate(fig, "bands", said, "Prediction and data")


def cone_and_water(model: Model) -> tuple[str, str] | None:
    """Return the columns of a density model of cone index and water content; None for another."""
    roles = {role_of(name): name for name in model.conditions}
    water = roles.get("water", roles.get("water_by_volume"))
    if role_of(model.output) != "density" or len(roles) != 2 or "cone" not in roles or not water:
        return None
    return roles["cone"], water


def _against_cone_index(
    ax: Axes, fig: Figure, result: _Result, cone: str, water: str
) -> dict[str, Any]:
    problem = result.calibration.problem
    ci, w = problem.table[cone], axis_of(water).scale(problem.table[water])
    of_cone, of_density = axis_of(cone), axis_of(problem.bound.model.output)
    look: Any = {"cmap": _WATER, "s": 17, "edgecolor": BLACK, "linewidth": 0.4, "zorder": 4}
    points = ax.scatter(of_cone.scale(ci), of_density.scale(problem.observed), c=w, **look)
    if result.validation is not None and result.validation.method == "leave_one_out":
        expected = np.nanquantile(result.validation.draws, [0.05, 0.5, 0.95], axis=0)
        values = of_density.scale(problem.observed), of_density.scale(expected)
        said = said_of_rows(of_cone, of_density, of_cone.scale(ci), *values, "left out")
        style.say_of_points(points, said)
    x = np.linspace(ci.min(), ci.max(), 60)
    handles: dict[str, Any] = {}
    for quantile, dashes in zip((0.1, 0.5, 0.9), DASHES, strict=False):
        at = float(np.quantile(problem.table[water], quantile))
        found = smooth_bands(result.calibration, {cone: x, water: np.full_like(x, at)})
        mean, measured = (_scaled(of_density, b) for b in found)
        shown = axis_of(water).factor * at
        where = f"water {short(shown)} {axis_of(water).unit}"
        colour = points.to_rgba(np.array([shown]))[0]
        (line,) = ax.plot(of_cone.scale(x), mean.median, ls=dashes, lw=1.4, color=colour)
        handles[f"median, {where}"] = line
        if quantile == 0.5:
            ends = measured.lower[0.9], measured.upper[0.9]
            band = ax.fill_between(of_cone.scale(x), *ends, color=style.BAND, lw=0.0, zorder=0)
            handles[f"90 % predictive, {where}"] = band
    ax.set(xlabel=of_cone.label, ylabel=of_density.label)
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
    which = "each left out" if held_table(result) is None else "held out"
    handles: dict[str, Any] = {}
    for part, colour, line, shape, name in (
        (inside, BLACK, GREY, "o", f"{data_word(result)}, {which}, 90 % band"),
        (~inside, VERMILION, VERMILION, "s", "outside its 90 % band"),
    ):
        if part.any():
            bars = [(median - low)[part], (high - median)[part]]
            look: Any = {
                "fmt": shape,
                "ms": 3.6,
                "color": colour,
                "ecolor": line,
                "elinewidth": 0.7,
            }
            handles[name] = ax.errorbar(observed[part], median[part], yerr=bars, **look, **DOTS)
    everything = np.append(observed, median)
    ends = [everything.min(), everything.max()]
    (handles["observed = predicted"],) = ax.plot(ends, ends, color=GREY, lw=0.9, ls=DASHES[2])
    ax.xaxis.set_major_locator(MaxNLocator(5))
    ax.set(xlabel=axis.titled("Observed"), ylabel=axis.titled("Predicted"))
    return handles
