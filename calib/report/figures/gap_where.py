"""Figures of a diagnosis on the field rows: where the gap is, and how far it shrinks."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from calib.data.quantities import role_of
from calib.gap.diagnose import Diagnosis
from calib.gap.mixture import Region, conditions_to_search
from calib.models.base import Array
from calib.report.figures.plate import Plate
from calib.report.figures.style import (
    BLACK,
    BLUE,
    GREY,
    ORANGE,
    SMALLEST_PT,
    VERMILION,
    legend_below,
    panels,
)
from calib.report.gap_evidence import scaled_shrink
from calib.report.gap_facts import (
    OutputRows,
    output_axis,
    output_rows,
    output_word,
    panel_groups,
    region_text,
    shrink_place,
)
from calib.report.labels import MINUS, NO_UNIT, Axis, axis_of, percent, percent_range, short

_BAND = "#e6e6e6"
_MOST_CONDITIONS = 6
_NORM = Normalize(0.0, 1.0)
# White to dark: how probable it is that a gap exceeds the noise. It survives greyscale.
_PROBABLE = LinearSegmentedColormap.from_list("probable", ["#ffffff", "#f6c9a5", "#D55E00"])
# Gaps that do not reach this part of the noise are none.
_TINY = 0.02


def where_plate(found: Diagnosis) -> Plate:
    """Draw the gap over slip, a panel for each inflation pressure."""
    outputs = output_rows(found)
    columns = max(len(panel_groups(found, o.rows)) for o in outputs)
    fig, axes = panels(
        len(outputs), columns, height=44.0, left=16.0, right=4.0, top=6.0, bottom=25.0, gap_x=5.0,
        gap_y=7.0, sharex=True, sharey="row",
    )  # fmt: skip
    x, x_axis = _abscissa(found)
    slip = found.data.view.column("slip") or ""
    for i, (row, own) in enumerate(zip(axes, outputs, strict=True)):
        limits = _limits(own)
        for j, (ax, (title, mask)) in enumerate(
            zip(row, panel_groups(found, own.rows), strict=True)
        ):
            _noise_band(ax, x[own.rows][mask], own.noise[mask])
            for region in found.regions:
                if region.output == own.name and slip in region.conditions:
                    _span(ax, region, x_axis, found.data.view.conditions[slip])
                    break
            _points(ax, x[own.rows][mask], own, mask)
            ax.set_ylim(*limits)
            if limits[1] > 0.01:
                ax.ticklabel_format(axis="y", style="plain")
            if i == 0:
                ax.set_title(title, loc="left", fontweight="bold")
            if i == len(outputs) - 1:
                ax.set_xlabel(x_axis.label)
            if j == 0:
                ax.set_ylabel(f"Gap in {output_word(own.name)} ({own.axis.unit})")
    _key(fig, regions=any(slip in r.conditions for r in found.regions))
    return Plate(fig, "where", _where_caption(outputs), "Where: the gap over slip")


def conditions_plate(found: Diagnosis) -> Plate | None:
    """Draw the gap in noise sds over every condition that varies, with regions marked."""
    conditions = found.data.view.conditions
    order = conditions_to_search(found.data)
    names = [n for n in order if np.ptp(conditions[n]) > 0.0]
    if {"pressure", "ground_pressure"} <= {role_of(n) for n in names}:
        names = [n for n in names if role_of(n) != "ground_pressure"]
    # A condition with a region in it must not be left out.
    marked = {key for r in found.regions for key in r.conditions}
    names = sorted(names, key=lambda n: n not in marked)[:_MOST_CONDITIONS]
    names.sort(key=order.index)
    if not names:
        return None
    outputs = output_rows(found)
    fig, axes = panels(
        len(outputs), len(names), height=34.0, left=19.0, right=4.0, top=4.0, bottom=28.0,
        gap_x=3.0, gap_y=5.0, sharex="col", sharey="row",
    )  # fmt: skip
    for i, (row, own) in enumerate(zip(axes, outputs, strict=True)):
        scaled = _in_noise(own)
        for ax, name in zip(row, names, strict=True):
            axis = axis_of(name)
            ax.axhspan(-1.0, 1.0, color=_BAND, lw=0.0, zorder=0)
            for region in found.regions:
                if region.output == own.name and name in region.conditions:
                    _span(ax, region, axis, conditions[name])
            _points(ax, axis.scale(conditions[name][own.rows]), scaled, np.ones(own.rows.size, "?"))
            ax.set_ylim(*_limits(scaled))
            if i == len(outputs) - 1:
                levels = found.data.case.covariates.get(name)
                ax.set_xlabel(axis.name if levels else f"{axis.name}\n({axis.unit})")
                if levels:
                    ax.set_xticks(range(len(levels)), levels, rotation=90)
                    continue
                ax.xaxis.set_major_locator(MaxNLocator(3))
                ax.ticklabel_format(axis="x", style="plain", useOffset=False)
        row[0].set_ylabel(f"Gap in {output_word(own.name)}\n(noise sd)")
    _key(fig, regions=bool(found.regions))
    return Plate(fig, "where_conditions", _region_caption(found), "Where: the gap over conditions")


def _abscissa(found: Diagnosis) -> tuple[Array, Any]:
    conditions = found.data.view.conditions
    known = (found.data.view.column(role) for role in ("slip", "order"))
    name = next((n for n in known if n), next(iter(conditions)))
    axis = axis_of(name)
    return axis.scale(conditions[name]), axis


def _in_noise(own: OutputRows) -> OutputRows:
    noise = own.noise
    return replace(own, noise=np.ones_like(noise), gap=own.gap / noise, sd=own.sd / noise)


def _limits(own: OutputRows) -> tuple[float, float]:
    """Room for all bars, and for two noise sds to either side."""
    least = 2.0 * float(own.noise.mean())
    low = min(float((own.gap - 1.64 * own.sd).min()), -least)
    high = max(float((own.gap + 1.64 * own.sd).max()), least)
    return low - 0.06 * (high - low), high + 0.08 * (high - low)


def _noise_band(ax: Axes, x: Array, noise: Array) -> None:
    """Shade one noise sd about zero; a straight line through the rows' own, as noise may grow."""
    if not x.size:
        return
    ends = np.array([x.min(), x.max()])
    level = np.full(2, noise.mean())
    if np.ptp(x) > 0.0 and x.size > 2:
        level = np.polyval(np.polyfit(x, noise, 1), ends)
    ax.fill_between(ends, -level, level, color=_BAND, lw=0.0, zorder=0)
    ax.axhline(0.0, color=GREY, lw=0.6, zorder=1)


def _span(ax: Axes, region: Region, axis: Axis, values: Array) -> None:
    low, high = (float(v) for v in axis.scale(np.array(next(iter(region.conditions.values())))))
    # A region at a single value still needs a width.
    least = 0.03 * float(np.ptp(axis.scale(values)))
    if high - low < least:
        low, high = low - 0.5 * least, high + 0.5 * least
    ax.axvspan(low, high, facecolor=ORANGE, alpha=0.13, lw=0.0, zorder=0)
    ax.plot(
        [low, high], [0.985, 0.985], transform=ax.get_xaxis_transform(), color=VERMILION, lw=2.2,
        solid_capstyle="butt", clip_on=False,
    )  # fmt: skip


def _points(ax: Axes, x: Array, own: OutputRows, mask: np.ndarray) -> None:
    ax.axhline(0.0, color=GREY, lw=0.6, zorder=1)
    ax.errorbar(
        x, own.gap[mask], 1.64 * own.sd[mask], fmt="none", ecolor=BLACK, elinewidth=0.6,
        capsize=0.0, zorder=2,
    )  # fmt: skip
    ax.scatter(
        x, own.gap[mask], c=own.probability[mask], cmap=_PROBABLE, norm=_NORM, s=20.0,
        edgecolors=BLACK, linewidths=0.6, zorder=3,
    )  # fmt: skip


def _key(fig: Figure, *, regions: bool) -> None:
    """Put the colour scale and the meaning of the shades at the foot, below the axis labels."""
    height = fig.get_figheight() * 25.4
    bar = fig.add_axes((0.56, 7.0 / height, 0.28, 2.4 / height))
    scale = fig.colorbar(ScalarMappable(_NORM, _PROBABLE), cax=bar, orientation="horizontal")
    scale.set_ticks([0.0, 0.5, 1.0])
    scale.outline.set_linewidth(0.5)
    bar.set_title(f"Probability that the gap exceeds the noise ({NO_UNIT})", fontsize=7.0, pad=2.5)
    bar.set_xlabel("")
    handles: list[Any] = [Patch(color=_BAND)]
    labels = ["±1 noise sd of a single reading"]
    if regions:
        handles.append(Patch(facecolor="#fdf3dc", edgecolor=VERMILION, lw=0.8))
        labels.append("region with a probable gap")
    fig.legend(
        handles, labels, loc="lower left", ncols=1, bbox_to_anchor=(0.09, 2.5 / height),
        borderaxespad=0.0, labelspacing=0.4,
    )  # fmt: skip


def _where_caption(outputs: list[OutputRows]) -> str:
    parts = []
    for o in outputs:
        likely = int((o.probability > 0.5).sum())
        parts.append(
            f"{output_word(o.name)}: {likely} of {o.rows.size} rows have a gap that probably "
            f"exceeds the noise of {short(float(np.median(o.noise)))} {o.axis.unit} (median "
            f"over the rows, from both campaigns); {_largest(o)}"
        )
    text = ". ".join(p[0].upper() + p[1:] for p in parts)
    return (
        f"{text}. A point is the posterior mean of what truly happens minus what the calibrated "
        "simulator says, its bar 1.64 sd to either side (90 %); above zero the field gives more "
        "than the simulator."
    )


def _largest(o: OutputRows) -> str:
    """Say how large the largest gap is, with its 90 % interval."""
    row = int(np.abs(o.gap).argmax())
    gap, half = float(o.gap[row]), 1.64 * float(o.sd[row])
    if abs(gap) + half < _TINY * float(np.median(o.noise)):
        return "none of them shows any"
    interval = f"{short(gap)} (90 % {short(gap - half)} to {short(gap + half)})"
    return f"the largest is {interval} {o.axis.unit}".replace("-", MINUS)


def _region_caption(found: Diagnosis) -> str:
    if not found.regions:
        return "Over no stretch of any condition does the gap probably exceed the noise."
    parts = []
    for r in found.regions:
        axis = output_axis(found, r.output)
        p = percent(r.probability) if r.probability < 0.995 else "above 99 %"
        low, high = (short(axis.factor * end) for end in r.interval)
        gap = f"{short(r.gap * axis.factor)} (90 % {low} to {high}) {axis.unit}"
        gap = gap.replace("-", MINUS)
        parts.append(f"{output_word(r.output)} at {region_text(found, r)}: {gap} (probability {p})")
    return (
        "Each row once in every panel of its output, in units of the noise. Marked regions, with "
        f"their mean gap: {'; '.join(parts)}."
    )


def how_far_plate(found: Diagnosis) -> Plate:
    """Draw data against predictions, errors over slip, and errors at unfitted conditions."""
    outputs = output_rows(found)
    fig, axes = panels(
        len(outputs), 3, height=46.0, left=15.0, right=4.0, top=6.0, bottom=17.0, gap_x=16.0,
        gap_y=14.0,
    )  # fmt: skip
    conditions = found.data.view.conditions
    name = found.data.view.column("slip") or next(iter(conditions))
    x_axis = axis_of(name)
    handles: dict[str, Any] = {}
    for row, own in zip(axes, outputs, strict=True):
        handles |= _against(row[0], own)
        _errors(row[1], x_axis.scale(conditions[name][own.rows]), own)
        row[1].set_xlabel(x_axis.label)
        _bars(row[2], found, own)
    axes[0, 0].set_title("Data against prediction", loc="left")
    axes[0, 1].set_title("Error at the field rows", loc="left")
    where = "new conditions" if found.data.case.new_conditions is not None else "field conditions"
    axes[0, 2].set_title(f"Expected at {where}", loc="left")
    legend_below(fig, handles, 4)
    return Plate(fig, "how_far", _shrink_caption(found, outputs), "How far: before and after")


def _against(ax: Axes, own: OutputRows) -> dict[str, Any]:
    values = np.concatenate([own.measured, own.before, own.after])
    margin = 0.05 * np.ptp(values)
    ends = np.array([values.min() - margin, values.max() + margin])
    ax.plot(ends, ends, color=GREY, lw=0.8)
    handles: dict[str, Any] = {}
    (handles["calibrated simulator (before)"],) = ax.plot(
        own.before, own.measured, "s", mfc="none", mec=VERMILION, mew=0.9, ms=4.0
    )
    (handles["corrected (after)"],) = ax.plot(
        own.after, own.measured, "o", color=BLUE, mec="white", mew=0.4, ms=4.4
    )
    ax.set_xlim(*ends)
    ax.set_ylim(*ends)
    word = output_word(own.name)
    ax.set_xlabel(f"Predicted {word} ({own.axis.unit})")
    ax.set_ylabel(f"Measured {word} ({own.axis.unit})")
    return handles


def _errors(ax: Axes, x: Array, own: OutputRows) -> None:
    before, after = own.measured - own.before, own.measured - own.after
    order = np.argsort(x)
    level = np.polyval(np.polyfit(x, own.noise, 1), x) if np.ptp(x) > 0.0 else own.noise
    ax.fill_between(
        x[order], -1.64 * level[order], 1.64 * level[order], color="#e6e6e6", lw=0.0, zorder=0
    )
    ax.axhline(0.0, color=GREY, lw=0.6, zorder=1)
    ax.vlines(x, after, before, color="#bdbdbd", lw=0.8, zorder=1)
    ax.plot(x, before, "s", mfc="none", mec=VERMILION, mew=0.9, ms=3.6, zorder=2)
    ax.plot(x, after, "o", color=BLUE, mec="white", mew=0.4, ms=4.2, zorder=3)
    ax.set_ylabel(f"Measured minus predicted ({own.axis.unit})")


def _bars(ax: Axes, found: Diagnosis, own: OutputRows) -> None:
    """Draw rms errors with the noise floor, or say that there is no gap to shrink."""
    s = scaled_shrink(found, own)
    ax.set_ylabel(f"Error of the prediction, rms ({own.axis.unit})")
    if s is None:
        ax.set_ylabel("")
        ax.axis("off")
        ax.set_xticks([])
        ax.set_yticks([])
        ax.text(
            0.5, 0.5, "no gap that\ncould shrink", ha="center", va="center", color=GREY,
            transform=ax.transAxes,
        )  # fmt: skip
        return
    ax.bar([0.0], [s.rmse_before], width=0.62, color="white", edgecolor=VERMILION, lw=1.2)
    ax.bar([1.0], [s.rmse_after], width=0.62, color=BLUE)
    low, high = (s.rmse_before * (1.0 - f) for f in (s.interval[1], s.interval[0]))
    ax.errorbar(
        [1.0], [s.rmse_after], [[max(s.rmse_after - low, 0.0)], [max(high - s.rmse_after, 0.0)]],
        fmt="none", ecolor=BLACK, elinewidth=0.9, capsize=2.5,
    )  # fmt: skip
    ax.axhline(s.noise_floor, color=BLACK, lw=0.9, ls=(0, (1, 1)))
    top = 1.3 * max(s.rmse_before, s.noise_floor, high)
    ax.set_ylim(0.0, top)
    if top > 0.01:
        ax.ticklabel_format(axis="y", style="plain")
    ax.text(
        1.47, s.noise_floor + 0.012 * top, "noise", ha="right", va="bottom", fontsize=SMALLEST_PT
    )
    text = f"shrinks by {100.0 * s.fraction:.0f} %\n({percent_range(s.interval)})"
    ax.text(0.5, 0.985, text, ha="center", va="top", fontsize=7.0, transform=ax.transAxes)
    ax.set_xlim(-0.5, 1.5)
    ax.set_xticks([0.0, 1.0], ["before", "after"])
    ax.tick_params(axis="x", length=0.0)


def _shrink_caption(found: Diagnosis, outputs: list[OutputRows]) -> str:
    parts = []
    for o in outputs:
        s = scaled_shrink(found, o)
        if s is None:
            parts.append(f"{output_word(o.name)} has no gap that could shrink")
            continue
        parts.append(
            f"{output_word(o.name)} from {short(s.rmse_before)} to {short(s.rmse_after)} "
            f"{o.axis.unit} rms, noise {short(s.noise_floor)} {o.axis.unit}, a shrink of "
            f"{percent(s.fraction)} (90 % interval {percent_range(s.interval)})"
        )
    return (
        f"Expected error of the noise-free prediction {shrink_place(found)}: "
        f"{'; '.join(parts)}. Left and "
        "middle, the rows that were fitted; grey is 1.64 noise sd (90 %)."
    )
