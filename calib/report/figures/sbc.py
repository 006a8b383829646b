"""Figures of a run: ECDF differences of every quantity with their bands, and coverage."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from calib.report.figures.style import (
    BLACK,
    BLUE,
    CYCLE,
    DASHES,
    GREY,
    MARKERS,
    SKY,
    VERMILION,
    legend_below,
    note,
    panels,
    style,
)
from calib.report.labels import MINUS, short, symbol
from calib.validation.sbc.score import LEVEL, ModelScore, Quantity, SbcScore
from calib.validation.sbc.uniformity import ecdf_band

__all__ = ["BAND", "coverage_figure", "ranks_figure", "title_of"]

# Of the simultaneous band drawn in each panel.
BAND = 0.95
_FOOT = 18.0  # mm below the panels
_TITLES: Mapping[str, str] = {
    "log_likelihood": "log likelihood",
    "prediction": "held-out mean",
    "measurement": "held-out reading",
}


def title_of(quantity: str) -> str:
    """Return what a quantity is called on a figure."""
    return _TITLES.get(quantity) or symbol(quantity)


def ranks_figure(model: ModelScore, adjusted: Mapping[tuple[str, str], float]) -> Figure:
    """Draw for each quantity the ECDF of its transforms less the uniform one, with its band.

    Parameters
    ----------
    model : ModelScore
    adjusted : mapping
        Adjusted p values of the run, by model and quantity.
    """
    n = len(model.quantities)
    cols = 6 if n > 12 else min(5, n)
    rows = -(-n // cols)
    with style():
        figure, axes = panels(
            rows, cols, height=22.0, left=17.0, right=4.0, top=6.0, bottom=_FOOT, gap_x=4.0,
            gap_y=10.0, sharex=True, sharey=True,
        )  # fmt: skip
        handles: dict[str, Any] = {}
        for ax, quantity in zip(axes.flat, model.quantities, strict=False):
            handles = _panel(ax, quantity, alarm=adjusted[model.model, quantity.name] < LEVEL)
        for ax in axes.flat[n:]:
            ax.set_visible(False)
        for row in axes:
            row[0].set_ylabel(f"ECDF {MINUS} PIT")
        height = figure.get_size_inches()[1] * 25.4
        figure.supxlabel(
            "probability integral transform (PIT) of the truth", fontsize=8, y=0.45 * _FOOT / height
        )
        legend_below(figure, list(handles.values()), list(handles), 3)
    return figure


def _panel(ax: Axes, quantity: Quantity, *, alarm: bool) -> dict[str, Any]:
    band = ecdf_band(quantity.pit, BAND)
    label = f"{100 * BAND:g} % simultaneous band if calibrated"
    colour = VERMILION if alarm else BLUE
    handles: dict[str, Any] = {
        label: ax.fill_between(
            band.x, band.lower - band.x, band.upper - band.x, step="post", color=SKY, alpha=0.3,
            lw=0.0,
        ),
    }  # fmt: skip
    (handles["observed"],) = ax.step(band.x, band.ecdf - band.x, where="post", color=colour, lw=1.0)
    ax.axhline(0.0, color=GREY, lw=0.5)
    ax.set_title(title_of(quantity.name), fontsize=7.0)
    half = 1.7 * float(max((band.upper - band.x).max(), abs(band.ecdf - band.x).max() / 1.4))
    ax.set_ylim(min(-half, ax.get_ylim()[0]), max(half, ax.get_ylim()[1]))
    words = f"p = {short(quantity.p)}" + (" !" if alarm else "")
    note(ax, words, color=VERMILION if alarm else BLACK)
    ax.set_xlim(0.0, 1.0)
    ax.set_xticks([0.0, 0.5, 1.0], ["0", "0.5", "1"])
    ax.xaxis.set_tick_params(labelbottom=True)
    return handles


def coverage_figure(score: SbcScore) -> Figure:
    """Draw how often predictive bands covered simulated held-out measurements, by model."""
    with style():
        figure, axes = panels(1, 1, height=62.0, width=120.0, left=14.0, bottom=20.0, top=4.0)
        ax = axes[0, 0]
        levels = [c.level for c in score.models[0].coverage]
        handles = {}
        for i, model in enumerate(score.models):
            shift = 0.13 * (i - 0.5 * (len(score.models) - 1))
            at = [j + shift for j in range(len(levels))]
            value = [100.0 * c.proportion for c in model.coverage]
            low = [100.0 * (c.proportion - c.interval[0]) for c in model.coverage]
            high = [100.0 * (c.interval[1] - c.proportion) for c in model.coverage]
            handles[model.model] = ax.errorbar(
                at, value, yerr=[low, high], fmt=MARKERS[i], color=CYCLE[i], ms=3.5,
                lw=1.0, mfc="white" if i % 2 else CYCLE[i],
            )  # fmt: skip
        for j, level in enumerate(levels):
            (line,) = ax.plot([j - 0.45, j + 0.45], [100.0 * level] * 2, color=BLACK, ls=DASHES[1],
                              lw=0.8)  # fmt: skip
            handles["claimed"] = line
        ax.set_xticks(range(len(levels)), [f"{100 * level:g} % band" for level in levels])
        ax.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:.0f}"))
        ax.set_ylabel("Covered (% of held-out measurements)")
        legend_below(figure, list(handles.values()), list(handles), 3)
    return figure
