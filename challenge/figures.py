"""Figures of a scored blind test: reliability diagram, levels."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from challenge.levels import LEVELS
from challenge.score import ReliabilityBin, TierScore

# Okabe and Ito's colours, told apart with every common colour vision.
_BLUE, _ORANGE, _GREEN, _GREY = "#0072B2", "#D55E00", "#009E73", "#999999"


def reliability_figure(bins: Sequence[ReliabilityBin], title: str = "") -> Figure:
    """Draw how often the first hypothesis is right against the probability it was given.

    Parameters
    ----------
    bins : sequence of ReliabilityBin
        Ranges of confidence; empty ones are left out.
    title : str
        Title.
    """
    figure = Figure(figsize=(4.6, 4.6), layout="constrained")
    axes = figure.subplots()
    axes.plot([0, 1], [0, 1], "--", color=_GREY, label="means what it says")
    filled = [b for b in bins if b.correct.n]
    x, y = [b.confidence for b in filled], [b.correct.value for b in filled]
    # Jeffreys intervals hold the share, but rounding may leave an arm of -1e-17.
    arms = np.array(
        [
            [b.correct.value - b.correct.interval[0] for b in filled],
            [b.correct.interval[1] - b.correct.value for b in filled],
        ]
    )
    axes.errorbar(
        x,
        y,
        yerr=np.maximum(arms, 0.0),
        fmt="o",
        color=_BLUE,
        capsize=3,
        label="share right, 95 % interval",
    )
    for b in filled:
        axes.annotate(
            f"n={b.correct.n}",
            (b.confidence, b.correct.value),
            xytext=(-6, 5),
            textcoords="offset points",
            ha="right",
            fontsize=7,
        )
    axes.set(
        xlabel="probability of the first hypothesis",
        ylabel="share that is right",
        xlim=(0, 1.02),
        ylim=(-0.02, 1.05),
        title=title,
    )
    figure.legend(loc="outside lower center", ncols=2, fontsize=8)
    return figure


def levels_figure(tiers: Sequence[TierScore]) -> Figure:
    """Draw every figure of merit with its interval beside the level asked for.

    Parameters
    ----------
    tiers : sequence of TierScore
        One panel each.
    """
    figure = Figure(figsize=(5.6 * max(len(tiers), 1) + 1.6, 5.0), layout="constrained")
    panels = figure.subplots(1, max(len(tiers), 1), squeeze=False, sharey=True)[0]
    for axes, tier in zip(panels, tiers, strict=False):
        for i, level in enumerate(LEVELS):
            got = getattr(tier, level.name)
            low, high = level.limits(tier.tier)
            axes.barh(
                i,
                high - low,
                left=low,
                height=0.82,
                color=_GREEN,
                alpha=0.25,
                label="level asked for" if i == 0 else None,
            )
            if not got.n:
                continue
            missed = level.mark(tier.tier, got) == "MISSED"
            arms = np.abs(np.array(got.interval) - got.value)[:, None]
            axes.errorbar(
                got.value,
                i,
                xerr=arms,
                fmt="X" if missed else "o",
                capsize=3,
                color=_ORANGE if missed else _BLUE,
            )
        axes.set_yticks(range(len(LEVELS)), [level.label for level in LEVELS])
        axes.set(
            xlim=(-0.02, 1.02),
            xlabel="value with 95 % interval (X: level missed)",
            title=f"{tier.tier}, {tier.n_cases} cases",
        )
        axes.invert_yaxis() if axes is panels[0] else None
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2, fontsize=8)
    return figure
