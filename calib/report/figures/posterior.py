"""What the data taught, and whether the ensembles agree, for every sampled parameter."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, NullLocator
from scipy.stats import gaussian_kde

from calib.inference.calibration import Calibration
from calib.inference.diagnostics import N_BINS, rank_histograms, rank_scatter
from calib.inference.priors import Prior, Priors
from calib.models.base import Array
from calib.report.figures.plate import Plate
from calib.report.figures.style import (
    BLACK,
    BLUE,
    CYCLE,
    DASHES,
    DOUBLE_MM,
    EMBER,
    ORANGE,
    SMALLEST_PT,
    SYMBOL_PT,
    WIDE,
    legend_below,
    panels,
)
from calib.report.labels import NO_UNIT, joined, parameter_label, plain, short
from calib.report.numbers import TIMES
from calib.report.reference import NOTHING, Reference
from calib.report.study import OutputResult
from calib.validation.roles import MOVED, PRIOR, ROLES, role

_KDE_DRAWS = 3000
_MOST_TICKS = 4


def learned_plate(result: OutputResult, *, reference: Reference = NOTHING) -> Plate:
    """Draw prior and posterior of every sampled parameter, and mark published ones."""
    calibration = result.calibration
    free = calibration.problem.priors.free
    marks = reference.sampled(calibration.problem.bound)
    cols = min(4, len(free)) if len(free) != 5 else 3
    rows = -(-len(free) // cols)
    fig, axes = panels(
        rows, cols, height=28.0, left=6.0, right=4.0, top=8.0, bottom=18.0, gap_x=6.0, gap_y=17.0
    )
    t = calibration.subset(_KDE_DRAWS)
    handles: dict[str, Any] = {}
    for j, (ax, prior) in enumerate(zip(axes.flat, free, strict=False)):
        handles |= _prior_posterior(ax, prior, t[:, j], marks.get(prior.name))
        ratio, what = calibration.summary[prior.name].sd_ratio, role(calibration, prior.name)
        strong = what in (PRIOR, MOVED)
        ax.set_title(
            f"{what}, sd ratio {short(ratio)}", fontsize=SMALLEST_PT,
            color=EMBER if strong else BLACK, weight="bold" if strong else "normal",
        )  # fmt: skip
    for ax in axes.flat[len(free) :]:
        ax.set_visible(False)
    legend_below(fig, list(handles.values()), list(handles), 3)
    return Plate(fig, "learned", _learned_caption(calibration), "What the data taught")


def _prior_posterior(ax: Axes, prior: Prior, t: Array, mark: float | None) -> dict[str, Any]:
    """One parameter in internal coordinates, on a log axis where those are logarithms."""
    low, high = _range(prior, t)
    x = np.linspace(low, high, 300)
    drawn = np.exp(x) if prior.log else x
    density = np.exp(Priors((prior,)).log_prob(x[:, None]))
    handles: dict[str, Any] = {
        "prior": ax.fill_between(drawn, density / density.max(), color="#dddddd", lw=0.0)
    }
    narrow = np.linspace(t.min(), t.max(), 120)
    posterior = gaussian_kde(t)(narrow)
    at = np.exp(narrow) if prior.log else narrow
    (handles["posterior (both scaled to their peaks)"],) = ax.plot(
        at, posterior / posterior.max(), color=BLUE, lw=1.3
    )
    if mark is not None:
        handles["published"] = ax.axvline(mark, color=ORANGE, lw=1.1, ls=DASHES[1])
    if prior.log:
        ax.set_xscale("log")
        ticks = _log_ticks(drawn[0], drawn[-1])
        ax.set_xticks(ticks, [short(v, 1).removeprefix(f"1{TIMES}") for v in ticks])
        ax.xaxis.set_minor_locator(NullLocator())
    else:
        ax.xaxis.set_major_locator(MaxNLocator(4))
    ax.set_xlim(drawn[0], drawn[-1])
    ax.set_ylim(0.0, 1.08)
    ax.yaxis.set_major_locator(NullLocator())
    ax.spines["left"].set_visible(False)
    ax.set_xlabel(parameter_label(prior.name, prior.unit))
    return handles


def _log_ticks(low: float, high: float) -> list[float]:
    """Return a few round values: 1, 2, 5 times powers of ten, or powers alone."""
    powers = range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1)
    for steps in ((1, 2, 5), (1, 3), (1,)):
        found = [s * 10.0**k for k in powers for s in steps if low <= s * 10.0**k <= high]
        if len(found) <= _MOST_TICKS:
            return found
    return found[:: -(-len(found) // _MOST_TICKS)]


def _range(prior: Prior, t: Array) -> tuple[float, float]:
    span = 2.8 * prior.scale if np.isfinite(prior.scale) else 0.5 * (prior.upper - prior.lower)
    low, high = min(prior.loc - span, t.min()), max(prior.loc + span, t.max())
    pad = 0.02 * (high - low)
    return max(low, prior.lower - pad), min(high, prior.upper + pad)


def _learned_caption(calibration: Calibration) -> str:
    found: dict[str, list[str]] = {}
    for prior in calibration.problem.priors.free:
        found.setdefault(role(calibration, prior.name), []).append(plain(prior.name))
    parts = []
    for what in (r for r in ROLES if r in found):
        verb = "is" if len(found[what]) == 1 else "are"
        said = "set " + what if what.startswith("partly") else what
        parts.append(f"{joined(found[what])} {verb} {said}")
    ratios = {p.name: calibration.summary[p.name].sd_ratio for p in calibration.problem.priors.free}
    sharpest = min(ratios, key=lambda name: ratios[name])
    return (
        f"{'; '.join(parts)}. The data taught most about {plain(sharpest)}, whose sd shrank to "
        f"{short(ratios[sharpest])} of the prior's (the sd ratio)."
    )


def ensembles_plate(result: OutputResult) -> Plate:
    """Draw traces of the ensemble means and rank histograms."""
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
    return Plate(fig, "ensembles", _ensembles_caption(result), "Convergence of the ensembles")


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
    half = rank_scatter(effective)
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


def _ensembles_caption(result: OutputResult) -> str:
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
