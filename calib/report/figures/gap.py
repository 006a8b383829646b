"""Figures of a diagnosis, from its document: what the design shows, where, which, how far."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from scipy.cluster.hierarchy import leaves_list, linkage
from scipy.spatial.distance import squareform

from calib.data.quantities import role_of
from calib.gap.constants import ALIKE
from calib.gap.document import Design, GapDocument
from calib.gap.mixture import Region
from calib.models.base import Array
from calib.report.constants import TIE
from calib.report.figures import style
from calib.report.figures.style import (
    BLACK,
    BLUE,
    DOTS,
    GREY,
    ORANGE,
    SKY,
    SMALLEST_PT,
    VERMILION,
    Plate,
    panels,
)
from calib.report.gap_words import Words, chance, short_name
from calib.report.labels import MINUS, NO_UNIT, Axis, axis_of, percent_range, short, units_of
from calib.report.rows import OutputRows, Z, abscissa, column_of, output_rows, panel_groups

# White to dark: how probable it is that a gap exceeds the noise. It survives greyscale.
_PROBABLE = LinearSegmentedColormap.from_list("probable", ["#ffffff", "#f6c9a5", "#D55E00"])
_NORM = Normalize(0.0, 1.0)
_SPECIAL = ("none", "unknown", "parameter_shift")


# The one figure


def corrected_plate(d: GapDocument, say: Words) -> Plate | None:
    """Draw the field's readings beside the calibrated and the corrected curve."""
    if not d.curves:
        return None
    fig, axes = panels(1, len(d.curves), height=62.0, left=16.0, bottom=21.0, gap_x=18.0)
    handles: dict[str, Any] = {}
    for ax, curve in zip(axes.flat, d.curves, strict=True):
        x, y = say.n.axis(curve.column), say.n.axis(curve.output)
        at = x.scale(np.array(curve.at))
        before, after, low, high = (
            y.scale(np.array(v)) for v in (curve.before, curve.after, curve.lower, curve.upper)
        )
        band = ax.fill_between(at, low, high, color=BLUE, alpha=0.2, lw=0.0)
        (old,) = ax.plot(at, before, color=VERMILION, lw=1.4, ls=(0, (4, 2)))
        (new,) = ax.plot(at, after, color=BLUE, lw=1.6)
        where = x.scale(np.array(curve.readings_at)), y.scale(np.array(curve.readings))
        (dots,) = ax.plot(*where, "o", ms=3.6, color=BLACK, zorder=4, **DOTS)
        style.say_of_points(
            dots,
            (
                f"{x.name} {short(place, 3)} {x.unit}: {short(value, 3)} {y.unit}, adjusted"
                for place, value in zip(*where, strict=True)
            ),
        )
        ax.set(xlabel=x.label, ylabel=y.label)
        handles = {
            "field readings, adjusted to these conditions": dots,
            "calibrated in the laboratory": old,
            "corrected": new,
            "90 % band of the corrected": band,
        }
    style.legend_below(fig, handles, 4)
    return Plate(fig, "corrected", say("caption_corrected"), "The field, before and after")


# Where


def where_plate(d: GapDocument, say: Words) -> Plate:
    """Draw the gap over slip, a panel for each inflation pressure."""
    outputs = output_rows(d)
    columns = max(len(panel_groups(d, o.rows)) for o in outputs)
    margins = {"left": 16.0, "right": 4.0, "bottom": 25.0, "gap_x": 5.0, "gap_y": 7.0}
    fig, axes = panels(len(outputs), columns, height=44.0, sharex=True, sharey="row", **margins)
    name, slip = abscissa(d), column_of(d, "slip") or ""
    x_axis = axis_of(name)
    x = x_axis.scale(np.array(d.conditions[name]))
    for row, own in zip(axes, outputs, strict=True):
        limits = _limits(own)
        marked = [r for r in d.regions if r.output == own.name and slip in r.conditions][:1]
        for ax, (title, mask) in zip(row, panel_groups(d, own.rows), strict=True):
            _noise_band(ax, x[own.rows][mask], own.noise[mask])
            for region in marked:
                _span(ax, region, x_axis, np.array(d.conditions[slip]))
            _points(ax, x[own.rows][mask], own, mask)
            ax.set_ylim(*limits)
            if limits[1] > 0.01:
                ax.ticklabel_format(axis="y", style="plain")
            if ax in axes[0]:
                ax.set_title(title, loc="left", fontweight="bold")
        row[0].set_ylabel(f"Gap in {say.n.output(own.name)} ({own.axis.unit})")
    for ax in axes[-1]:
        ax.set_xlabel(x_axis.label)
    _key(fig, regions=any(slip in r.conditions for r in d.regions))
    return Plate(fig, "where", say("caption_where", outputs), "Where: the gap over slip")


def conditions_plate(d: GapDocument, say: Words) -> Plate | None:
    """Draw the gap in noise sds over every condition that varies, with regions marked."""
    order = list(d.conditions)
    names = [n for n in order if np.ptp(d.conditions[n]) > 0.0]
    if {"pressure", "ground_pressure"} <= {role_of(n) for n in names}:
        names = [n for n in names if role_of(n) != "ground_pressure"]
    # A condition with a region in it must not be left out.
    marked = {key for r in d.regions for key in r.conditions}
    names = sorted(names, key=lambda n: n not in marked)[:6]
    names.sort(key=order.index)
    if not names:
        return None
    outputs = output_rows(d)
    margins = {"left": 19.0, "right": 4.0, "top": 4.0, "bottom": 28.0, "gap_x": 3.0, "gap_y": 5.0}
    shared: Any = {"sharex": "col", "sharey": "row"}
    fig, axes = panels(len(outputs), len(names), height=34.0, **margins, **shared)
    for row, own in zip(axes, outputs, strict=True):
        ones = np.ones_like(own.noise)
        scaled = replace(own, noise=ones, gap=own.gap / own.noise, sd=own.sd / own.noise)
        for ax, name in zip(row, names, strict=True):
            axis, values = axis_of(name), np.array(d.conditions[name])
            ax.axhspan(-1.0, 1.0, color=style.BAND, lw=0.0, zorder=0)
            for region in d.regions:
                if region.output == own.name and name in region.conditions:
                    _span(ax, region, axis, values)
            _points(ax, axis.scale(values[own.rows]), scaled, ones > 0.0)
            ax.set_ylim(*_limits(scaled))
        row[0].set_ylabel(f"Gap in {say.n.output(own.name)}\n(noise sd)")
    for ax, name in zip(axes[-1], names, strict=True):
        axis, levels = axis_of(name), d.covariates.get(name)
        if levels:
            ax.set_xlabel(axis.name)
            ax.set_xticks(range(len(levels)), levels, rotation=90)
        else:
            ax.set_xlabel(f"{axis.name}\n({axis.unit})")
            ax.xaxis.set_major_locator(MaxNLocator(3))
            ax.ticklabel_format(axis="x", style="plain", useOffset=False)
    _key(fig, regions=bool(d.regions))
    caption = say("caption_where_conditions")
    return Plate(fig, "where_conditions", caption, "Where: the gap over conditions")


def _limits(own: OutputRows) -> tuple[float, float]:
    """Room for all bars, and for two noise sds to either side."""
    least = 2.0 * float(own.noise.mean())
    low = min(float((own.gap - Z * own.sd).min()), -least)
    high = max(float((own.gap + Z * own.sd).max()), least)
    return low - 0.06 * (high - low), high + 0.08 * (high - low)


def _noise_band(ax: Axes, x: Array, noise: Array, width: float = 1.0) -> None:
    """Shade the noise about zero; a straight line through the rows' own, as noise may grow."""
    if not x.size:
        return
    ends = np.array([x.min(), x.max()])
    level = np.full(2, width * noise.mean())
    if np.ptp(x) > 0.0 and x.size > 2:
        level = width * np.polyval(np.polyfit(x, noise, 1), ends)
    ax.fill_between(ends, -level, level, color=style.BAND, lw=0.0, zorder=0)
    ax.axhline(0.0, color=GREY, lw=0.6, zorder=1)


def _span(ax: Axes, region: Region, axis: Axis, values: Array) -> None:
    low, high = (float(v) for v in axis.scale(np.array(next(iter(region.conditions.values())))))
    # A region at a single value still needs a width.
    short_by = max(0.0, 0.03 * float(np.ptp(axis.scale(values))) - (high - low))
    low, high = low - 0.5 * short_by, high + 0.5 * short_by
    ax.axvspan(low, high, facecolor=ORANGE, alpha=0.13, lw=0.0, zorder=0)
    edge: Any = {"color": VERMILION, "lw": 2.2, "solid_capstyle": "butt", "clip_on": False}
    ax.plot([low, high], [0.985, 0.985], transform=ax.get_xaxis_transform(), **edge)


def _points(ax: Axes, x: Array, own: OutputRows, mask: NDArray[np.bool_]) -> None:
    ax.axhline(0.0, color=GREY, lw=0.6, zorder=1)
    gap, half = own.gap[mask], Z * own.sd[mask]
    ax.errorbar(x, gap, half, fmt="none", ecolor=BLACK, elinewidth=0.6, zorder=2)
    look: Any = {"s": 20.0, "edgecolors": BLACK, "linewidths": 0.6, "zorder": 3}
    ax.scatter(x, gap, c=own.probability[mask], cmap=_PROBABLE, norm=_NORM, **look)


def _key(fig: Figure, *, regions: bool) -> None:
    """Put the colour scale and the meaning of the shades at the foot, below the axis labels."""
    height = fig.get_figheight() * 25.4
    bar = fig.add_axes((0.56, 7.0 / height, 0.28, 2.4 / height))
    scale = fig.colorbar(ScalarMappable(_NORM, _PROBABLE), cax=bar, orientation="horizontal")
    scale.set_ticks([0.0, 0.5, 1.0])
    scale.outline.set_linewidth(0.5)
    bar.set_title(f"Probability that the gap exceeds the noise ({NO_UNIT})", fontsize=7.0, pad=2.5)
    handles = {"±1 noise sd of a single reading": Patch(color=style.BAND)}
    if regions:
        region = Patch(facecolor="#fdf3dc", edgecolor=VERMILION, lw=0.8)
        handles["region with a probable gap"] = region
    corner: Any = {
        "loc": "lower left",
        "bbox_to_anchor": (0.09, 2.5 / height),
        "borderaxespad": 0.0,
    }
    fig.legend(list(handles.values()), list(handles), labelspacing=0.4, **corner)


# Which


def which_plate(d: GapDocument, say: Words) -> Plate:
    """Draw the probabilities of the hypotheses."""
    # Few enough to be read, none so improbable that its bar has no length.
    first = [e for e in d.explanations[:8] if e is d.best or e.probability >= 0.01]
    special = [e for e in d.explanations[8:] if e.name in _SPECIAL and e.probability >= 0.01]
    shown = [*first, *special]
    others = [e for e in d.explanations if e not in shown]
    tied = [e for e in first if e.probability >= TIE * d.best.probability]
    # As wide as the margin: longer names, of several causes at once, take two lines or three.
    labels = [textwrap.fill(short_name(e.name), 38) for e in shown]
    rows = np.maximum(1.0, [0.66 * (1 + label.count("\n")) for label in labels])
    total = float(rows.sum())
    margins = {"left": 66.0, "right": 16.0, "top": 3.0}
    fig, axes = panels(1, 1, height=5.2 * total + 3.0, **margins)
    ax = axes[0, 0]
    y = total - np.cumsum(rows) + 0.5 * rows
    for yi, e in zip(y, shown, strict=True):
        leading, p = e in tied, e.probability
        edge, weight = (BLACK, "bold") if leading else ("none", "normal")
        colour = BLUE if e is d.best else SKY if leading else "#c9c9c9"
        hatch = "///" if leading and len(tied) > 1 else None
        ax.barh(yi, p, height=0.66, color=colour, edgecolor=edge, lw=0.5, hatch=hatch)
        ax.text(p + 0.01, yi, chance(p), va="center", fontsize=7.0, fontweight=weight)
    ax.set_yticks(y, labels, linespacing=0.95)
    ax.set(xlabel=f"Probability ({NO_UNIT})", xlim=(0.0, 1.0), ylim=(-0.1, total + 0.1))
    ax.axvline(0.5, color=GREY, lw=0.7, ls=(0, (4, 2)), zorder=0)
    ax.tick_params(axis="y", length=0.0)
    if len(tied) > 1:
        read = "read them as a tie" if d.best.probability < 0.5 else "any of them may be right"
        style.note(ax, f"hatched: not far apart,\n{read}", x=0.98, y=0.05, color=BLACK)
    rest = sum(e.probability for e in others)
    caption = say("caption_which", tied, len(others), rest)
    return Plate(fig, "which", caption, "Which: the hypotheses")


def left_over_plate(d: GapDocument, say: Words) -> Plate:
    """Draw standardised residuals of the best hypothesis over slip and run order."""
    columns = [c for role in ("slip", "order") if (c := column_of(d, role))] or [abscissa(d)]
    margins = {"left": 13.0, "right": 4.0, "bottom": 16.0, "gap_x": 6.0}
    fig, axes = panels(1, len(columns), height=44.0, sharey=True, **margins)
    handles = {}
    for ax, column in zip(axes[0], columns, strict=True):
        axis, values = axis_of(column), np.array(d.conditions[column])
        ax.axhspan(-2.0, 2.0, color="#eeeeee", lw=0.0, zorder=0)
        ax.axhline(0.0, color=GREY, lw=0.6)
        for o, marker, colour in zip(d.outputs, style.MARKERS, style.CYCLE, strict=False):
            x, look = axis.scale(values[list(o.rows)]), {"color": colour, "ms": 4.6, **DOTS}
            (handles[say.n.output(o.name)],) = ax.plot(x, o.residual, marker, **look)
        ax.set_xlabel(axis.label)
        ax.set_title(f"Along {axis.name.lower()}", loc="left")
    sizes = np.abs(np.concatenate([o.residual for o in d.outputs]))
    top = max(2.6, 1.1 * float(np.nanmax(sizes)))
    axes[0, 0].set(ylabel="Residual (noise sd)", ylim=(-top, top))
    style.legend_below(fig, handles, 3)
    caption = say("caption_left_over", int((sizes > 2.0).sum()), sizes.size)
    return Plate(fig, "left_over", caption, "What is left after the best hypothesis")


def placebo_plate(d: GapDocument, say: Words) -> Plate:
    """Draw what wrong hypotheses would have left of the gap."""
    left = {e.name: e.left for e in d.explanations if e.left is not None}
    order = sorted(left, key=lambda name: left[name])
    removed = {name: 1.0 - value / d.before for name, value in left.items()}
    margins = {"left": 62.0, "right": 16.0, "top": 7.0}
    fig, axes = panels(1, 1, height=4.2 * len(order) + 3.0, **margins)
    ax = axes[0, 0]
    y = np.arange(len(order))[::-1]
    for yi, name in zip(y, order, strict=True):
        marker, size, weight = ("D", 5.5, "bold") if name == d.best.name else ("o", 4.0, "normal")
        others = ORANGE if name in ("unknown", "parameter_shift") else GREY
        colour = BLUE if name == d.best.name else others
        ax.plot([left[name], d.before], [yi, yi], color="#d4d4d4", lw=1.0, zorder=1)
        ax.plot(left[name], yi, marker, color=colour, ms=size, zorder=3)
        text, beside = f"{100.0 * removed[name]:.0f} %".replace("-", MINUS), (1.015, yi)
        how = {"va": "center", "fontsize": 7.0, "fontweight": weight}
        ax.text(*beside, text, transform=ax.get_yaxis_transform(), **how)
    ax.axvline(1.0, color=BLACK, lw=0.8, ls=(0, (1, 1)), zorder=0)
    ax.axvline(d.before, color=VERMILION, lw=1.0, zorder=0)
    high, low = max(d.before, *left.values()), min(1.0, *left.values())
    pad = 0.06 * max(high - low, 0.3)
    top, above = len(order) - 0.3, {"ha": "center", "va": "bottom", "fontsize": 7.0}
    ax.text(1.0, top, "noise", **above)
    if d.before - 1.0 > 0.12 * (high - low + 2.0 * pad):
        ax.text(d.before, top, "simulator", color=style.EMBER, **above)
    ax.text(1.015, 1.0, "removed", transform=ax.transAxes, va="bottom", fontsize=7.0, color=GREY)
    ax.set_yticks(y, [textwrap.fill(short_name(name), 38) for name in order], linespacing=0.85)
    ax.set(xlim=(low - pad, high + pad), ylim=(-0.6, len(order) - 0.4))
    ax.set_xlabel("Residual on the field rows, rms over the noise (noise sd)")
    ax.tick_params(axis="y", length=0.0)
    runner = next((name for name in order if name not in (*_SPECIAL, d.best.name)), None)
    shown = {name: max(part, 0.0) for name, part in removed.items()}
    caption = say("caption_placebo", shown, runner)
    return Plate(fig, "placebo", caption, "Placebo: the wrong hypotheses")


# What the design shows


def isolability_plate(d: GapDocument, say: Words) -> Plate | None:
    """Draw the similarity of effects, what parameters absorb, and detectable sizes."""
    design = d.design
    if not design.absorbed:
        return None
    names = _ordered(design)
    n = len(names)
    side = max(5.0 * n, 30.0)
    words = [textwrap.fill(short_name(name), 27) for name in names]
    # Names stand to the left of the matrix and, turned, below it: 1.45 mm a letter.
    margin = 5.0 + 1.45 * max(len(line) for w in words for line in w.splitlines())
    # The matrix is square; the two strips share its rows.
    square = min(side, 86.0)
    strip = 0.5 * (style.DOUBLE_MM - margin - 20.0 - square)
    margins = {"left": margin, "right": 4.0, "bottom": max(margin, 14.0), "gap_x": 8.0}
    fig, axes = panels(1, 3, height=side, width_ratios=(square, strip, strip), **margins)
    matrix, absorbed, smallest = axes[0]
    _matrix(matrix, design, names, words)
    y = np.arange(n)
    absorbed.barh(y, [design.absorbed[name] for name in names], color=ORANGE, height=0.6)
    absorbed.set(xlabel=f"Absorbed by the\nparameters ({NO_UNIT})", xlim=(0.0, 1.0))
    size = np.array([design.detectable[name] for name in names])
    shown = np.minimum(size, 4.0)
    smallest.hlines(y, 0.0, shown, color="#c9c9c9", lw=1.0)
    smallest.plot(shown, y, "o", color=BLUE, ms=4.5)
    for yi, x, value in zip(y, shown, size, strict=True):
        text = short(float(value)) if value < 100.0 else "none"
        smallest.text(x + 0.12, yi, text, va="center", fontsize=SMALLEST_PT)
    smallest.set(xlabel="Smallest size that\nshows (noise sd)")
    smallest.set_xlim(0.0, max(1.25 * float(shown.max()), 1.5))
    for ax in (absorbed, smallest):
        ax.set(ylim=(n - 0.5, -0.5), yticks=[])
        ax.spines["left"].set_visible(False)
        ax.hlines(y + 0.5, *ax.get_xlim(), color="#eeeeee", lw=0.5, zorder=0)
    matrix.set_title("Similarity (cosine)", loc="left")
    hard = [name for name, share in design.absorbed.items() if share > 0.8]
    finite = [float(v) for v in size if np.isfinite(v)]
    cosine = {(a, b): value for a, b, value in design.likeness}
    alike = sorted(design.alike, key=lambda pair: -cosine[pair])
    caption = say("caption_isolability", hard, finite and (min(finite), max(finite)), alike)
    return Plate(fig, "isolability", caption, "What this design can distinguish")


def _matrix(ax: Axes, design: Design, names: list[str], words: list[str]) -> None:
    """Draw the similarity of each pair once, below the diagonal."""
    n = len(names)
    cosine = np.full((n, n), np.nan)
    for a, b, value in design.likeness:
        j, i = sorted((names.index(a), names.index(b)))
        cosine[i, j] = value
    ax.imshow(cosine, vmin=0.0, vmax=1.0, cmap="Blues", aspect="auto")
    frame: Any = {"fill": False, "ec": VERMILION, "lw": 1.1, "clip_on": False, "zorder": 4}
    for i, j in np.argwhere(np.isfinite(cosine)):
        value, alike = cosine[i, j], cosine[i, j] >= ALIKE
        how: Any = {
            "color": "white" if value > 0.6 else BLACK,
            "weight": "bold" if alike else "normal",
        }
        text = f"{100.0 * value:.0f}"
        ax.text(j, i, text, ha="center", va="center", fontsize=SMALLEST_PT, **how)
        if alike:
            ax.add_patch(Rectangle((j - 0.5, i - 0.5), 1.0, 1.0, **frame))
    shown = max(n - 1, 1)
    ax.set_yticks(np.arange(n), words, linespacing=0.95)
    ax.set_xticks(np.arange(shown), words[:shown], rotation=90, linespacing=0.95)
    ax.set_xlim(-0.5, max(n - 1.5, 0.5))
    ax.tick_params(length=0.0)
    ax.spines[:].set_visible(False)


def _ordered(design: Design) -> list[str]:
    """Names with those that look alike beside each other."""
    names = sorted(design.absorbed)
    if len(names) < 3:
        return names
    at = {name: i for i, name in enumerate(names)}
    distance = np.ones((len(names), len(names)))
    np.fill_diagonal(distance, 0.0)
    for a, b, value in design.likeness:
        distance[at[a], at[b]] = distance[at[b], at[a]] = np.clip(1.0 - value, 0.0, 2.0)
    tree = linkage(squareform(distance, checks=False), "average", optimal_ordering=True)
    return [names[i] for i in leaves_list(tree)]


# How far


def how_far_plate(d: GapDocument, say: Words) -> Plate:
    """Draw data against predictions, errors over slip, and errors at unfitted conditions."""
    outputs = output_rows(d)
    margins = {"left": 15.0, "right": 4.0, "bottom": 17.0, "gap_x": 16.0, "gap_y": 14.0}
    fig, axes = panels(len(outputs), 3, height=46.0, **margins)
    axis = axis_of(abscissa(d))
    x = axis.scale(np.array(d.conditions[abscissa(d)]))
    for row, own in zip(axes, outputs, strict=True):
        handles = _against(row[0], own, say.n.output(own.name))
        _errors(row[1], x[own.rows], own)
        row[1].set_xlabel(axis.label)
        _bars(row[2], d, own)
    where = "new conditions" if d.judged_on == "new conditions" else "field conditions"
    titles = "Data against prediction", "Error at the field rows", f"Expected at {where}"
    style.set_titles(axes[:1], titles)
    style.legend_below(fig, handles, 4)
    return Plate(fig, "how_far", say("caption_how_far"), "Error before and after the correction")


_BEFORE: Mapping[str, Any] = {"marker": "s", "ls": "none", "mfc": "none", "mec": VERMILION,
                              "mew": 0.9}  # fmt: skip
_AFTER: Mapping[str, Any] = {"marker": "o", "color": BLUE, **DOTS}


def _against(ax: Axes, own: OutputRows, word: str) -> dict[str, Any]:
    values = np.concatenate([own.measured, own.before, own.after])
    margin = 0.05 * np.ptp(values)
    ends = np.array([values.min() - margin, values.max() + margin])
    ax.plot(ends, ends, color=GREY, lw=0.8)
    (before,) = ax.plot(own.before, own.measured, ms=4.0, **_BEFORE)
    (after,) = ax.plot(own.after, own.measured, ms=4.4, **_AFTER)
    ax.set(xlabel=f"Predicted {word} ({own.axis.unit})", xlim=ends)
    ax.set(ylabel=f"Measured {word} ({own.axis.unit})", ylim=ends)
    return {"calibrated simulator (before)": before, "corrected (after)": after}


def _errors(ax: Axes, x: Array, own: OutputRows) -> None:
    before, after = own.measured - own.before, own.measured - own.after
    _noise_band(ax, x, own.noise, Z)
    ax.vlines(x, after, before, color="#bdbdbd", lw=0.8, zorder=1)
    ax.plot(x, before, ms=3.6, zorder=2, **_BEFORE)
    ax.plot(x, after, ms=4.2, zorder=3, **_AFTER)
    ax.set_ylabel(f"Measured minus predicted ({own.axis.unit})")


def _bars(ax: Axes, d: GapDocument, own: OutputRows) -> None:
    """Draw rms errors with the noise floor, or say that there is no gap to shrink."""
    s, factor = d.shrink.get(own.name), own.axis.factor
    if s is None:
        ax.axis("off")
        how: Any = {"ha": "center", "va": "center", "color": GREY, "transform": ax.transAxes}
        ax.text(0.5, 0.5, "no gap that\ncould shrink", **how)
        return
    before, after, floor = (factor * v for v in (s.rmse_before, s.rmse_after, s.noise_floor))
    ax.set_ylabel(f"Error of the prediction, rms ({own.axis.unit})")
    ax.bar([0.0], [before], width=0.62, color="white", edgecolor=VERMILION, lw=1.2)
    ax.bar([1.0], [after], width=0.62, color=BLUE)
    high, low = (before * (1.0 - f) for f in s.interval)
    bar = [[max(after - low, 0.0)], [max(high - after, 0.0)]]
    ax.errorbar([1.0], [after], bar, fmt="none", ecolor=BLACK, elinewidth=0.9, capsize=2.5)
    ax.axhline(floor, color=BLACK, lw=0.9, ls=(0, (1, 1)))
    top = 1.3 * max(before, floor, high)
    ax.set_ylim(0.0, top)
    if top > 0.01:
        ax.ticklabel_format(axis="y", style="plain")
    ax.text(1.47, floor + 0.012 * top, "noise", ha="right", va="bottom", fontsize=SMALLEST_PT)
    text = f"shrinks by {100.0 * s.fraction:.0f} %\n({percent_range(s.interval)})"
    ax.text(0.5, 0.985, text, ha="center", va="top", fontsize=7.0, transform=ax.transAxes)
    ax.set_xlim(-0.5, 1.5)
    ax.set_xticks([0.0, 1.0], ["before", "after"])
    ax.tick_params(axis="x", length=0.0)


# In reading order.
_DRAWINGS: dict[str, Callable[[GapDocument, Words], Plate | None]] = {
    "corrected": corrected_plate,
    "isolability": isolability_plate,
    "where": where_plate,
    "where_conditions": conditions_plate,
    "which": which_plate,
    "how_far": how_far_plate,
    "placebo": placebo_plate,
    "left_over": left_over_plate,
}


def gap_plates(d: GapDocument, names: Sequence[str] = ()) -> list[Plate]:
    """Draw the figures of a diagnosis, all or some by their names, in the units of its files.

    They are in reading order. A figure that failed has ``figure=None`` and a caption saying why.
    """
    with units_of(d.headers):
        say = Words(d)
        drawings = {name: partial(_DRAWINGS[name], d, say) for name in names or _DRAWINGS}
        plates = style.draw_all(drawings)
    return list(style.marked(plates, d.label))
