"""Convergence seen: the independently seeded ensembles side by side, for every parameter."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from scipy.stats import rankdata

from calib.models.base import Array
from calib.report.figures.plate import Plate
from calib.report.figures.style import (
    CYCLE,
    DASHES,
    DOUBLE_MM,
    SMALLEST_PT,
    SYMBOL_PT,
    WIDE,
    legend_below,
)
from calib.report.labels import NO_UNIT, parameter_label, plain, short
from calib.report.study import OutputResult

__all__ = ["ensembles_plate", "rank_histograms"]

N_BINS = 20


def rank_histograms(values: Array, bins: int = N_BINS) -> Array:
    """Histograms of the ranks of each ensemble's draws among all draws, relative to uniform.

    Parameters
    ----------
    values : ndarray, shape (ensembles, n)
    bins : int

    Returns
    -------
    ndarray, shape (ensembles, bins)
        All near 1 where the ensembles sample the same distribution.
    """
    rank = rankdata(values, method="ordinal").reshape(values.shape).astype(np.int64)
    which = ((rank - 1) * bins) // values.size
    counts = np.stack([np.bincount(row, minlength=bins) for row in which])
    return np.asarray(counts * bins / values.shape[1], dtype=np.float64)


def ensembles_plate(result: OutputResult) -> Plate:
    """Draw traces of the ensemble means and rank histograms.

    Parameters
    ----------
    result : OutputResult
    """
    calibration = result.calibration
    draws, free = calibration.draws, calibration.problem.priors.free
    per_row = 2 if len(free) <= 6 else 3
    rows = -(-len(free) // per_row)
    fig, pairs = _pairs(rows, per_row, len(free))
    ess = dict(zip(draws.report.names, draws.report.ess_bulk, strict=True))
    handles: dict[str, Any] = {}
    for j, prior in enumerate(free):
        t = draws.t[..., j]
        natural = np.exp(t) if prior.log else t
        low, high = np.quantile(natural, [0.02, 0.98])
        # Of a parameter that spans decades, the mean would show its largest draws alone.
        wide = bool(prior.log and high > WIDE * low)
        trace, ranks = pairs[j]
        handles |= _trace(trace, np.log10(natural) if wide else natural)
        trace.set_ylabel(parameter_label(prior.name, prior.unit, log=wide))
        _ranks(ranks, natural.reshape(natural.shape[0], -1), ess[prior.name] / natural.shape[0])
        if j >= len(free) - per_row:
            trace.set_xlabel(f"Step ({NO_UNIT})")
            ranks.set_xlabel(f"Rank ({NO_UNIT})")
        else:
            trace.tick_params(labelbottom=False)
            ranks.tick_params(labelbottom=False)
    handles["rank count over expected count, 95 % range"] = pairs[0][1].collections[0]
    legend_below(fig, list(handles.values()), list(handles), len(handles))
    return Plate(fig, "ensembles", _caption(result), "Convergence of the ensembles")


def _pairs(rows: int, per_row: int, n: int) -> tuple[Figure, list[tuple[Axes, Axes]]]:
    """Axes in pairs, trace wider than ranks, laid out in millimetres."""
    height, gap_y, top, bottom = (21.0 if per_row == 3 else 24.0), 5.5, 5.5, 17.0
    cell = DOUBLE_MM / per_row
    total = top + bottom + rows * height + (rows - 1) * gap_y
    fig = Figure(figsize=(DOUBLE_MM / 25.4, total / 25.4))
    # Two in a row leave room for longer tick labels.
    left, between, right = (17.0, 10.0, 2.5) if per_row == 3 else (20.0, 11.0, 3.0)
    span = cell - left - between - right
    found = []
    for k in range(n):
        row, col = divmod(k, per_row)
        y = (total - top - height - row * (height + gap_y)) / total
        x = col * cell + left
        trace = fig.add_axes((x / DOUBLE_MM, y, 0.6 * span / DOUBLE_MM, height / total))
        ranks = fig.add_axes(
            ((x + 0.6 * span + between) / DOUBLE_MM, y, 0.4 * span / DOUBLE_MM, height / total)
        )
        found.append((trace, ranks))
    return fig, found


def _trace(ax: Axes, natural: Array) -> dict[str, Any]:
    """Mean over walkers, step by step, in every ensemble's colour."""
    handles: dict[str, Any] = {}
    steps = np.arange(natural.shape[2])
    for e, walkers in enumerate(natural):
        (handles[f"ensemble {e + 1}"],) = ax.plot(
            steps, walkers.mean(axis=0), color=CYCLE[e % len(CYCLE)],
            ls=DASHES[e % len(DASHES)], lw=0.7,
        )  # fmt: skip
    ax.set_xlim(0, max(1, steps[-1]))
    ax.xaxis.set_major_locator(MaxNLocator(2))
    ax.yaxis.set_major_locator(MaxNLocator(3))
    ax.yaxis.get_offset_text().set_fontsize(SYMBOL_PT)
    return handles


def _ranks(ax: Axes, values: Array, effective: float) -> None:
    """Rank histograms with the scatter that the effective sample size allows."""
    heights = rank_histograms(values)
    half = 1.96 * np.sqrt(max(0.0, N_BINS - 1.0) / max(effective, 1.0))
    ax.fill_between([0.0, 1.0], max(0.0, 1.0 - half), 1.0 + half, color="#e4e4e4", lw=0.0)
    edges = np.linspace(0.0, 1.0, N_BINS + 1)
    for e, row in enumerate(heights):
        ax.stairs(row, edges, color=CYCLE[e % len(CYCLE)], ls=DASHES[e % len(DASHES)], lw=0.8,
                  baseline=None)  # fmt: skip
    ax.set_ylim(0.0, max(2.0, 1.05 * heights.max()))
    ax.set_xlim(0.0, 1.0)
    ax.set_xticks([0.0, 0.5, 1.0], ["0", "½", "1"])
    ax.set_yticks([0.0, 1.0, 2.0], ["0", "1", "2"])
    ax.set_ylabel(f"Ratio ({NO_UNIT})", fontsize=SMALLEST_PT, labelpad=1.0)


def _caption(result: OutputResult) -> str:
    r, draws = result.calibration.draws.report, result.calibration.draws
    worst, poorest = int(np.nanargmax(r.rhat)), int(np.nanargmin(r.ess_bulk))
    verdict = "agree" if r.passed else "do NOT pass the convergence gate"
    return (
        f"{draws.t.shape[0]} independently seeded ensembles {verdict}: the largest R-hat is "
        f"{r.rhat[worst]:.3f} ({plain(r.names[worst])}), the smallest bulk ESS "
        f"{r.ess_bulk[poorest]:.0f} ({plain(r.names[poorest])}), over {r.steps} steps of "
        f"{draws.walkers} walkers, {short(float((r.steps / r.tau).min()))} autocorrelation "
        f"times or more."
    )
