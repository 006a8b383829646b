"""Figures of a posterior: pairs of parameters, what data taught, whether ensembles agree."""

from __future__ import annotations

from typing import Any

import numpy as np
from corner import hist2d
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
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
    MIDDLE_MM,
    ORANGE,
    SINGLE_MM,
    SMALLEST_PT,
    SYMBOL_PT,
    WIDE,
    legend_below,
    panels,
)
from calib.report.labels import MINUS, NO_UNIT, joined, parameter_label, plain, short
from calib.report.numbers import TIMES
from calib.report.reference import NOTHING, Reference
from calib.report.study import OutputResult
from calib.validation.scores import MOVED, PRIOR, ROLES, role

MAX_PARAMETERS = 11
_N_DRAWS = 4000
# Tick labels this near to an end of their panel, as a part of it, would meet the next panel's.
_CLEAR = 0.1
# For tick labels and labels to the left and below, and to the right and above.
_MARGIN_MM, _REST_MM = 19.0, 2.0
# Part of a cell that its panel takes.
_FILL = 0.93


class _Cells:
    """Panels as cells of one pair of axes: creating axes is what takes the time of a corner plot.

    Panel (i, j) is column j of row i from the top; a parameter's range maps onto its cell.
    """

    def __init__(self, draws: Array) -> None:
        self.d = draws.shape[1]
        self.low, self.high = np.quantile(draws, [0.001, 0.999], axis=0)

    def part(self, j: int, value: Array | float) -> Array:
        """Map a parameter's values onto 0 to `_FILL`."""
        return np.asarray(_FILL * (value - self.low[j]) / (self.high[j] - self.low[j]))

    def x(self, j: int, value: Array | float) -> Array:
        """Abscissa of values of parameter j."""
        return np.asarray(j + self.part(j, value))

    def bottom(self, i: int) -> float:
        """Ordinate of the foot of row i."""
        return float(self.d - 1 - i)

    def ticks(self, j: int, most: int) -> Array:
        """A few round values inside the range."""
        clear = _CLEAR * (self.high[j] - self.low[j])
        low, high = self.low[j] + clear, self.high[j] - clear
        for n in range(most, most + 3):
            values = np.asarray(MaxNLocator(n).tick_values(low, high))
            found = values[(values >= low) & (values <= high)]
            if found.size >= 2:
                break
        return np.asarray(found[:: -(-found.size // most)])


def corner_plate(result: OutputResult, *, reference: Reference = NOTHING) -> Plate:
    """Draw every pair of sampled parameters, and mark published ones."""
    draws, priors, wide = _sampled(result.calibration)
    marks = reference.sampled(result.calibration.problem.bound)
    at = [
        np.log10(marks[p.name]) if w and p.name in marks else marks.get(p.name)
        for p, w in zip(priors, wide, strict=True)
    ]
    labels = [
        parameter_label(p.name, p.unit, log=w).replace(" (", "\n(", 1)
        for p, w in zip(priors, wide, strict=True)
    ]
    cells = _Cells(draws)
    fig, ax = _frame(cells)
    for i in range(cells.d):
        _marginal(ax, cells, i, draws[:, i])
        for j in range(i):
            _pair(ax, cells, i, j, draws)
    _marks(ax, cells, at)
    _ticks(ax, cells, labels)
    note = "contours hold 50 % and 90 %" + ("\ndashed: published" if marks else "")
    ax.text(1.1, cells.d - 0.1, note, va="top", fontsize=SMALLEST_PT)
    ax.set_xlim(0.0, cells.d)
    ax.set_ylim(0.0, cells.d)
    caption = _caption(draws, [p.name for p in priors], bool(marks))
    return Plate(fig, "corner", caption, "Posterior, in pairs")


def _sampled(calibration: Calibration) -> tuple[Array, list[Prior], list[bool]]:
    """Thinned draws of the first free parameters, by their decimal logarithm where wide."""
    entries = calibration.problem.priors.entries
    free = [i for i, p in enumerate(entries) if not p.fixed][:MAX_PARAMETERS]
    natural = calibration.problem.theta(calibration.subset(_N_DRAWS))[:, free]
    low, high = np.quantile(natural, [0.02, 0.98], axis=0)
    wide = [bool(entries[i].log and high[j] > WIDE * low[j]) for j, i in enumerate(free)]
    natural[:, wide] = np.log10(natural[:, wide])
    return natural, [entries[i] for i in free], wide


def _width(d: int) -> float:
    """Width in millimetres of a figure of so many parameters."""
    return SINGLE_MM if d <= 2 else MIDDLE_MM if d <= 5 else DOUBLE_MM


def _frame(cells: _Cells) -> tuple[Figure, Axes]:
    """One pair of axes without spines; every panel gets a left and a lower edge."""
    total = _width(cells.d)
    margin, edge = _MARGIN_MM, total - _MARGIN_MM - _REST_MM
    fig = Figure(figsize=(total / 25.4, total / 25.4))
    ax = fig.add_axes((margin / total, margin / total, edge / total, edge / total))
    ax.set_axis_off()
    edges = []
    for i in range(cells.d):
        for j in range(i + 1):
            y = cells.bottom(i)
            edges.append([(j, y), (j + _FILL, y)])
            if i != j:
                edges.append([(j, y), (j, y + _FILL)])
    ax.add_collection(LineCollection(edges, colors=BLACK, linewidths=0.6, clip_on=False))
    return fig, ax


def _marginal(ax: Axes, cells: _Cells, i: int, draws: Array) -> None:
    counts, edges = np.histogram(draws, 30, (cells.low[i], cells.high[i]))
    height = cells.bottom(i) + 0.85 * counts / counts.max()
    ax.stairs(height, cells.x(i, edges), baseline=cells.bottom(i), color=BLUE, lw=1.0)


def _pair(ax: Axes, cells: _Cells, i: int, j: int, draws: Array) -> None:
    y = cells.bottom(i)
    before = len(ax.collections)
    hist2d(
        cells.x(j, draws[:, j]), y + cells.part(i, draws[:, i]), bins=24, ax=ax,
        levels=(0.5, 0.9), smooth=1.0, range=[(j, j + _FILL), (y, y + _FILL)],
        plot_datapoints=False, plot_density=False, fill_contours=True, no_fill_contours=True,
        color=BLUE,
        contour_kwargs={"linewidths": 0.6},
    )  # fmt: skip
    # Smoothed contours reach a little beyond the range.
    for contour in ax.collections[before:]:
        contour.set_clip_path(Rectangle((j, y), _FILL, _FILL, transform=ax.transData))


def _marks(ax: Axes, cells: _Cells, at: list[float | None]) -> None:
    """Published values as dashed lines across their row and column, where they lie inside."""
    lines = []
    for k, value in enumerate(at):
        if value is not None and cells.low[k] <= value <= cells.high[k]:
            part = float(cells.part(k, value))
            y = cells.bottom(k)
            lines += [
                [(k + part, cells.bottom(i)), (k + part, cells.bottom(i) + _FILL)]
                for i in range(k, cells.d)
            ]
            lines += [[(j, y + part), (j + _FILL, y + part)] for j in range(k)]
    ax.add_collection(LineCollection(lines, colors=ORANGE, linewidths=0.9, linestyles=[DASHES[1]]))


def _ticks(ax: Axes, cells: _Cells, labels: list[str]) -> None:
    many = cells.d > 7
    most, tick = (2, 0.05) if many else (3, 0.03)
    style: dict[str, Any] = {"fontsize": SMALLEST_PT, "clip_on": False}
    # Distances from the panels are in cells, so they grow with the number of panels.
    away = 14.0 * cells.d / (_width(cells.d) - _MARGIN_MM - _REST_MM)
    lines = []
    for k, label in enumerate(labels):
        y = cells.bottom(k)
        ticks = cells.ticks(k, most)
        for value, text in zip(ticks, _tick_texts(ticks), strict=True):
            part = float(cells.part(k, value))
            lines.append([(k + part, 0.0), (k + part, -tick)])
            ax.text(k + part, -1.6 * tick, text, ha="center", va="top",
                    rotation=90, **style)  # fmt: skip
            if k > 0:
                lines.append([(0.0, y + part), (-tick, y + part)])
                ax.text(-1.6 * tick, y + part, text, ha="right", va="center", **style)
        ax.text(k + 0.5 * _FILL, -away, label, ha="center", va="center", fontsize=SYMBOL_PT)
        if k > 0:
            ax.text(-away, y + 0.5 * _FILL, label, rotation=90, ha="center", va="center",
                    fontsize=SYMBOL_PT)  # fmt: skip
    ax.add_collection(LineCollection(lines, colors=BLACK, linewidths=0.6, clip_on=False))


def _tick_texts(values: Array) -> list[str]:
    """Write the values of ticks, with the decimals that the finest of them needs."""
    texts = [f"{value:.6g}" for value in values]
    decimals = max((len(text.partition(".")[2]) for text in texts if "e" not in text), default=0)
    return [
        (text if "e" in text else f"{value:.{decimals}f}").replace("-", MINUS)
        for text, value in zip(texts, values, strict=True)
    ]


def _caption(draws: Array, names: list[str], marked: bool) -> str:
    # Of a pair once, or rounding decides which of the two is named first.
    correlation = np.tril(np.corrcoef(draws, rowvar=False), -1)
    i, j = np.unravel_index(np.abs(correlation).argmax(), correlation.shape)
    strong = int((np.abs(correlation) > 0.8).sum())
    pairs = len(names) * (len(names) - 1) // 2
    marks = " Dashed: what the published figures amount to." if marked else ""
    verb = "exceeds" if strong in (0, 1) else "exceed"
    few = f"{strong} of {pairs} pairs" if strong else f"none of the {pairs} pairs"
    return (
        f"{plain(names[j])} and {plain(names[i])} are tied most closely (correlation "
        f"{short(float(correlation[i, j]))}); {few} {verb} 0.8.{marks}"
    )


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
