"""How far the gap shrinks: field data against the simulator before and after its correction."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from calib.gap.diagnose import Diagnosis
from calib.models.base import Array
from calib.report.figures.plate import Plate
from calib.report.figures.style import (
    BLACK,
    BLUE,
    GREY,
    SMALLEST_PT,
    VERMILION,
    legend_below,
    panels,
)
from calib.report.gap_evidence import scaled_shrink
from calib.report.gap_rows import OutputRows, output_rows, output_word
from calib.report.labels import MINUS, axis_of, percent, short

__all__ = ["how_far_plate"]


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
    legend_below(fig, list(handles.values()), list(handles), 4)
    return Plate(fig, "how_far", _caption(found, outputs), "How far: before and after")


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
    text = f"shrinks by {100.0 * s.fraction:.0f} %\n({_interval(s.interval)})"
    ax.text(0.5, 0.985, text, ha="center", va="top", fontsize=7.0, transform=ax.transAxes)
    ax.set_xlim(-0.5, 1.5)
    ax.set_xticks([0.0, 1.0], ["before", "after"])
    ax.tick_params(axis="x", length=0.0)


def _interval(interval: tuple[float, float]) -> str:
    low, high = (f"{100.0 * v:.0f}".replace("-", MINUS) for v in interval)
    return f"{low} to {high} %"


def _caption(found: Diagnosis, outputs: list[OutputRows]) -> str:
    parts = []
    for o in outputs:
        s = scaled_shrink(found, o)
        if s is None:
            parts.append(f"{output_word(o.name)} has no gap that could shrink")
            continue
        parts.append(
            f"{output_word(o.name)} from {short(s.rmse_before)} to {short(s.rmse_after)} "
            f"{o.axis.unit} rms, noise {short(s.noise_floor)} {o.axis.unit}, a shrink of "
            f"{percent(s.fraction)} (90 % interval {_interval(s.interval)})"
        )
    place = (
        "at new conditions, which were not fitted"
        if found.data.case.new_conditions is not None
        else "at the field's own conditions, since no others were asked for"
    )
    return (
        f"Expected error of the noise-free prediction {place}: {'; '.join(parts)}. Left and "
        "middle, the rows that were fitted; grey is 1.64 noise sd (90 %)."
    )
