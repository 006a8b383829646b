"""One figure for each of the source's gaps: what is missed before and after, and which cause."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from calib.data.quantities import OUTPUTS
from calib.he2019.gaps.find import FoundGap
from calib.models.base import Array
from calib.report.figures.gap import probability_text
from calib.report.figures.plate import Plate
from calib.report.figures.style import (
    BLUE,
    CYCLE,
    DOUBLE_MM,
    GREY,
    MARKERS,
    SKY,
    SMALLEST_PT,
    legend_below,
    panels,
    style,
)
from calib.report.gap_facts import OutputRows, output_rows, output_word, short_name
from calib.report.labels import NO_UNIT, axis_of, short

_BAND = "#e6e6e6"
_Z_90 = 1.645
_MOST = 5
_PRESSURES = (18.0, 30.0, 42.0)


def gap_plate(result: FoundGap) -> Plate:
    """Draw errors over slip before and after the correction, and the probabilities."""
    with style():
        return _plate(result)


def _plate(result: FoundGap) -> Plate:
    own = output_rows(result.found)[0]
    rows = 2 if result.gap.unfitted is not None else 1
    fig, axes = panels(1, 3, height=46.0, top=6.0, bottom=12.0 + 4.0 * rows)
    # The names of the hypotheses need the room beside the last panel.
    for ax, left, width in zip(axes[0], (15.0, 70.0, 145.0), (52.0, 39.0, 32.0), strict=True):
        box = ax.get_position()
        ax.set_position((left / DOUBLE_MM, box.y0, width / DOUBLE_MM, box.height))
    before, after, which = axes[0]
    slip, pressure = (
        result.found.data.view.conditions[name][own.rows]
        for name in ("slip_ratio", "inflation_pressure_psi")
    )
    x_axis = axis_of("slip_ratio")
    x = x_axis.scale(slip)
    for ax in (before, after):
        _noise_band(ax, x, own)
        ax.set_xlabel(x_axis.label)
    _left_open(before, x, pressure, result.open_sd)
    _points(before, x, pressure, own.measured - own.before, filled=False)
    _points(after, x, pressure, own.measured - own.after, filled=True)
    kept_out = _kept_out(before, after, result)
    _same_height(before, after)
    after.tick_params(labelleft=False)
    before.set_ylabel(f"Measured minus predicted ({own.axis.unit})")
    before.set_title(f"Before: {output_word(own.name)}", loc="left")
    after.set_title("After: corrected model", loc="left")
    _which(which, result)
    handles, labels = _key(pressure, kept_out=kept_out)
    legend_below(fig, handles, labels, 3)
    return Plate(fig, result.gap.name, _caption(own, kept_out=kept_out), result.gap.title)


def _noise_band(ax: Axes, x: Array, own: OutputRows) -> None:
    """Shade 90 % of the noise about zero; a straight line through the rows' own, as it may grow."""
    ends = np.array([x.min(), x.max()])
    level = _Z_90 * np.polyval(np.polyfit(x, own.noise, 1), ends)
    ax.fill_between(ends, -level, level, color=_BAND, lw=0.0, zorder=0)
    ax.axhline(0.0, color=GREY, lw=0.6, zorder=1)


def _left_open(ax: Axes, x: Array, pressure: Array, sd: Array) -> None:
    """Draw how far the calibrated simulator itself may be off, at each pressure."""
    for psi in np.unique(pressure):
        at = pressure == psi
        order = np.argsort(x[at])
        for sign in (-1.0, 1.0):
            ax.plot(
                x[at][order], sign * _Z_90 * sd[at][order], color=_colour(psi), lw=0.8,
                ls=(0, (4, 2)), zorder=1,
            )  # fmt: skip


def _points(ax: Axes, x: Array, pressure: Array, error: Array, *, filled: bool) -> None:
    for psi in np.unique(pressure):
        at = pressure == psi
        ax.plot(
            x[at], error[at], _marker(psi), mfc=_colour(psi) if filled else "none",
            mec="white" if filled else _colour(psi), mew=0.4 if filled else 0.9,
            ms=4.6 if filled else 4.0, zorder=3,
        )  # fmt: skip


def _kept_out(before: Axes, after: Axes, result: FoundGap) -> bool:
    """Draw the errors at rows that stood in neither campaign."""
    rows = result.gap.unfitted
    if rows is None:
        return False
    predicted = result.found.new_predictions[result.output]
    x = axis_of("slip_ratio").scale(rows["slip_ratio"])
    measured = rows[OUTPUTS[result.output]]
    psi = float(rows["inflation_pressure_psi"][0])
    factor = axis_of(OUTPUTS[result.output]).factor
    for ax, values in ((before, predicted.before), (after, predicted.after)):
        ax.plot(
            x, factor * (measured - values), _marker(psi), color=_colour(psi), mfc="white",
            mew=0.9, ms=4.4, zorder=2,
        )  # fmt: skip
    return True


def _same_height(a: Axes, b: Axes) -> None:
    ends = np.array([a.get_ylim(), b.get_ylim()])
    low, high = float(ends.min()), float(ends.max())
    for ax in (a, b):
        ax.set_ylim(low, high)
        ax.ticklabel_format(axis="y", style="plain")


def _which(ax: Axes, result: FoundGap) -> None:
    p, order = result.found.ranking.probability, result.found.ranking.order
    names = order[:_MOST]
    y = np.arange(len(names))[::-1]
    for i, (yi, name) in enumerate(zip(y, names, strict=True)):
        ax.barh(yi, p[name], color=BLUE if i == 0 else SKY, height=0.62)
        ax.text(p[name] + 0.03, yi, probability_text(p[name]), va="center", fontsize=SMALLEST_PT)
    ax.set_yticks(y, [short_name(name).replace(" + ", "\n+ ") for name in names])
    ax.tick_params(axis="y", length=0.0, labelsize=SMALLEST_PT)
    ax.set_ylim(-0.6, len(names) - 0.4)
    ax.set_xlim(0.0, 1.0)
    ax.set_xticks([0.0, 0.5, 1.0], ["0", "0.5", "1"])
    ax.set_xlabel(f"Probability ({NO_UNIT})")
    ax.set_title("Which", loc="left")


def _key(pressure: Array, *, kept_out: bool) -> tuple[list[Any], list[str]]:
    """Return handles and labels; a key beside every colour."""
    handles: list[Any] = []
    labels: list[str] = []
    for psi in np.unique(pressure):
        handles.append(Line2D([], [], ls="", marker=_marker(psi), color=_colour(psi)))
        labels.append(f"{psi:g} psi")
    if kept_out:
        psi = 30.0
        handles.append(
            Line2D([], [], ls="", marker=_marker(psi), color=_colour(psi), mfc="white", mew=0.9)
        )
        labels.append(f"{psi:g} psi, in neither campaign")
    handles += [Patch(color=_BAND), Line2D([], [], color=GREY, lw=0.8, ls=(0, (4, 2)))]
    labels += ["90 % of the noise", "90 % of what the calibration left open"]
    return handles, labels


def _colour(psi: float) -> str:
    return CYCLE[_PRESSURES.index(float(psi))]


def _marker(psi: float) -> str:
    return MARKERS[_PRESSURES.index(float(psi))]


def _caption(own: OutputRows, *, kept_out: bool) -> str:
    before, after = (
        short(float(np.sqrt(np.mean((own.measured - v) ** 2)))) for v in (own.before, own.after)
    )
    unit = own.axis.unit
    text = (
        f"Left, measured {output_word(own.name)} minus the calibrated simulator at the "
        f"{own.rows.size} field rows, {before} {unit} rms; a miss inside the dashed lines is no "
        f"more than the calibration left open. Middle, minus the corrected model, {after} {unit} "
        f"rms; the noise is {short(float(np.median(own.noise)))} {unit}."
    )
    if kept_out:
        text += " White markers are rows that neither campaign had."
    return f"{text} Right, the most probable hypotheses."
