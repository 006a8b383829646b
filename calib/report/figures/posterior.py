"""Figures of a posterior, what data taught, whether ensembles agree, and of point estimates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from corner import corner, overplot_lines
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, MaxNLocator, NullLocator
from scipy.stats import gaussian_kde

from calib.inference.calibration import Calibration
from calib.inference.diagnostics import N_BINS, distances, rank_histograms, rank_scatter
from calib.inference.estimators import method_name
from calib.inference.priors import Prior, Priors
from calib.models.base import Array
from calib.models.magic_formula import coefficients_at
from calib.report.constants import EDGE, WIDE
from calib.report.figures import style
from calib.report.figures.style import (
    BLACK,
    BLUE,
    CYCLE,
    DASHES,
    DOTS,
    GREY,
    ORANGE,
    SMALLEST_PT,
    SYMBOL_PT,
    Plate,
    caption,
)
from calib.report.labels import NO_UNIT, joined, parameter_label, plain, short, symbol
from calib.report.numbers import TIMES
from calib.report.reference import NOTHING, Reference
from calib.report.study import OutputResult
from calib.validation.constants import FAR_SDS


def corner_plate(result: OutputResult, reference: Reference = NOTHING) -> Plate:
    """Draw every pair of sampled parameters, and mark published ones."""
    draws, priors, wide = _sampled(result.calibration)
    printed = reference.sampled(result.calibration.problem.bound)
    ends, d = np.quantile(draws, [0.001, 0.999], axis=0).T, len(priors)
    size = style.SINGLE_MM if d <= 2 else style.MIDDLE_MM if d <= 5 else style.DOUBLE_MM
    figure = Figure(figsize=(size / 25.4, size / 25.4))
    names = [parameter_label(p.name, p.unit, log=w) for p, w in zip(priors, wide, strict=True)]
    corner(
        draws,
        fig=figure,
        range=ends,
        bins=24,
        levels=(0.5, 0.9),
        smooth=1.0,
        color=BLUE,
        plot_datapoints=False,
        plot_density=False,
        fill_contours=True,
        no_fill_contours=True,
        contour_kwargs={"linewidths": 0.6},
        max_n_ticks=2 if d > 7 else 3,
        labels=[name.replace(" (", "\n(", 1) for name in names],
    )
    marks = np.array([printed.get(p.name, np.nan) for p in priors])
    marks[wide] = np.log10(marks[wide])
    inside = (marks >= ends[:, 0]) & (marks <= ends[:, 1])
    shown = [m if seen else None for m, seen in zip(marks, inside, strict=True)]
    overplot_lines(figure, shown, color=ORANGE, lw=0.9, ls=DASHES[1])
    # Room for labels to the left and below, and their distance from the panels, in millimetres.
    room, away = 19.0 / size, 14.0 * 1.07 * d / (size - 21.0)
    edge = 1 - 2 / size
    figure.subplots_adjust(room, room, edge, edge, wspace=0.07, hspace=0.07)
    for ax in figure.axes:
        ax.xaxis.set_label_coords(0.5, -away)
        ax.yaxis.set_label_coords(-away, 0.5)
        for axis, turned in ((ax.xaxis, 90), (ax.yaxis, 0)):
            axis.set_tick_params(labelrotation=turned)
            axis.label.set(fontsize=SYMBOL_PT, verticalalignment="center")
            # A label at the end of its panel would meet the next panel's.
            low, high = axis.get_view_interval()
            room = 0.1 * (high - low)
            ticks = [v for v in axis.get_majorticklocs() if low + room <= v <= high - room]
            if ticks:
                axis.set_major_locator(FixedLocator(ticks))
    said = "contours hold 50 % and 90 %" + ("\ndashed: published" if printed else "")
    figure.text(0.98, 0.97, said, va="top", ha="right", fontsize=SMALLEST_PT)
    # Of a pair once, or rounding decides which of the two is named first.
    correlation = np.tril(np.corrcoef(draws, rowvar=False), -1)
    i, j = np.unravel_index(np.abs(correlation).argmax(), correlation.shape)
    said = caption(
        "corner",
        pair=(priors[j].name, priors[i].name),
        correlation=float(correlation[i, j]),
        strong=int((np.abs(correlation) > 0.8).sum()),
        pairs=d * (d - 1) // 2,
        marked=bool(printed),
    )
    return Plate(figure, "corner", said, "Posterior, in pairs")


def _sampled(calibration: Calibration) -> tuple[Array, list[Prior], list[bool]]:
    """Thinned draws of the first free parameters, by their decimal logarithm where wide."""
    entries = calibration.problem.priors.entries
    free = [i for i, p in enumerate(entries) if not p.fixed][:11]
    natural = calibration.problem.theta(calibration.subset(4000))[:, free]
    low, high = np.quantile(natural, [0.02, 0.98], axis=0)
    wide = [_is_wide(entries[i], low[j], high[j]) for j, i in enumerate(free)]
    natural[:, wide] = np.log10(natural[:, wide])
    return natural, [entries[i] for i in free], wide


def _is_wide(prior: Prior, low: float, high: float) -> bool:
    """Whether a parameter is drawn by its logarithm, by the 2 and 98 % points of its draws."""
    return bool(prior.log and high > WIDE * low)


def learned_plate(result: OutputResult, reference: Reference = NOTHING) -> Plate:
    """Draw prior and posterior of every sampled parameter, and mark published ones."""
    calibration = result.calibration
    free = calibration.problem.priors.free
    marks = reference.sampled(calibration.problem.bound)
    known = {p.name: result.sensitivity[p.name] for p in free}
    ratios = {p.name: calibration.summary[p.name].sd_ratio for p in free}
    cols = min(4, len(free)) if len(free) != 5 else 3
    rows = -(-len(free) // cols)
    margins = {"left": 6.0, "right": 4.0, "top": 8.0, "bottom": 18.0}
    fig, axes = style.panels(rows, cols, height=28.0, gap_x=6.0, gap_y=17.0, **margins)
    t = calibration.subset(3000)
    handles: dict[str, Any] = {}
    for j, (ax, prior) in enumerate(zip(axes.flat, free, strict=False)):
        handles |= _prior_posterior(ax, prior, t[:, j], marks.get(prior.name))
        found = known[prior.name]
        colour, weight = (BLACK, "normal") if found.identified else (style.EMBER, "bold")
        title = f"{found.reading}, sd ratio {short(ratios[prior.name])}"
        ax.set_title(title, fontsize=SMALLEST_PT, color=colour, weight=weight)
    style.hide_rest(axes, len(free))
    style.legend_below(fig, handles, 3)
    sharpest = min(ratios, key=lambda name: ratios[name])
    said = caption(
        "learned",
        unknown=[plain(name) for name, found in known.items() if not found.identified],
        sharpest=sharpest,
        ratio=ratios[sharpest],
    )
    return Plate(fig, "learned", said, "What the data taught")


def _prior_posterior(ax: Axes, prior: Prior, t: Array, mark: float | None) -> dict[str, Any]:
    """One parameter in internal coordinates, on a log axis where those are logarithms."""
    x = np.linspace(*_range(prior, t), 300)
    narrow = np.linspace(t.min(), t.max(), 120)
    drawn, at = (np.exp(v) if prior.log else v for v in (x, narrow))
    density = np.exp(Priors((prior,)).log_prob(x[:, None]))
    posterior = gaussian_kde(t)(narrow)
    filled = ax.fill_between(drawn, density / density.max(), color="#dddddd", lw=0.0)
    (line,) = ax.plot(at, posterior / posterior.max(), color=BLUE, lw=1.3)
    handles = {"prior": filled, "posterior (both scaled to their peaks)": line}
    if mark is not None:
        handles["published"] = ax.axvline(mark, color=ORANGE, lw=1.1, ls=DASHES[1])
    if prior.log:
        ax.set_xscale("log")
        ticks = _log_ticks(drawn[0], drawn[-1])
        ax.set_xticks(ticks, [short(v, 1).removeprefix(f"1{TIMES}") for v in ticks])
        ax.xaxis.set_minor_locator(NullLocator())
    else:
        ax.xaxis.set_major_locator(MaxNLocator(4))
    ax.yaxis.set_major_locator(NullLocator())
    ax.spines["left"].set_visible(False)
    ax.set(xlabel=parameter_label(prior.name, prior.unit), xlim=drawn[[0, -1]], ylim=(0.0, 1.08))
    return handles


def _log_ticks(low: float, high: float) -> list[float]:
    """Return a few round values: 1, 2, 5 times powers of ten, or powers alone."""
    powers = range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1)
    for steps in ((1, 2, 5), (1, 3), (1,)):
        found = [s * 10.0**k for k in powers for s in steps if low <= s * 10.0**k <= high]
        if len(found) <= 4:
            return found
    return found[:: -(-len(found) // 4)]


def _range(prior: Prior, t: Array) -> tuple[float, float]:
    span = 2.8 * prior.scale if np.isfinite(prior.scale) else 0.5 * (prior.upper - prior.lower)
    low, high = min(prior.loc - span, t.min()), max(prior.loc + span, t.max())
    pad = 0.02 * (high - low)
    return max(low, prior.lower - pad), min(high, prior.upper + pad)


def ensembles_plate(result: OutputResult, reference: Reference = NOTHING) -> Plate:
    """Draw traces of the ensemble means and rank histograms, side by side."""
    draws, free = result.calibration.draws, result.calibration.problem.priors.free
    per_row, height, gap_x = (2, 24.0, 17.0) if len(free) <= 6 else (3, 21.0, 15.0)
    layout = {"left": 18.0, "right": 0.0, "bottom": 21.0, "top": 5.5, "gap_x": gap_x, "gap_y": 5.5}
    rows, ratios = -(-len(free) // per_row), (2.0, 1.0) * per_row
    fig, axes = style.panels(rows, 2 * per_row, height=height, width_ratios=ratios, **layout)
    pairs = axes.reshape(-1, 2)
    ess = dict(zip(draws.report.names, draws.report.ess_bulk, strict=True))
    handles: dict[str, Any] = {}
    for j, (prior, (trace, ranks)) in enumerate(zip(free, pairs, strict=False)):
        # The tick labels of the next trace need more room than those of the ranks.
        ranks.set_position(ranks.get_position().translated(-5.0 / style.DOUBLE_MM, 0.0))
        t = draws.t[..., j]
        natural = np.exp(t) if prior.log else t
        # Of a parameter that spans decades, the mean would show its largest draws alone.
        wide = _is_wide(prior, *np.quantile(natural, [0.02, 0.98]))
        handles |= _trace(trace, np.log10(natural) if wide else natural)
        trace.set_ylabel(parameter_label(prior.name, prior.unit, log=wide))
        _ranks(ranks, natural.reshape(natural.shape[0], -1), ess[prior.name] / natural.shape[0])
        last = j >= len(free) - per_row
        for ax, what in ((trace, "Step"), (ranks, "Rank")):
            ax.set_xlabel(f"{what} ({NO_UNIT})" if last else "")
            ax.tick_params(labelbottom=last)
    style.hide_rest(pairs, 2 * len(free))
    handles["rank count over expected count, 95 % range"] = pairs[0][1].collections[0]
    style.legend_below(fig, handles, 3)
    r = draws.report
    worst, poorest = int(np.nanargmax(r.rhat)), int(np.nanargmin(r.ess_bulk))
    said = caption("ensembles", draws=draws, r=r, worst=worst, poorest=poorest)
    return Plate(fig, "ensembles", said, "Convergence of the ensembles")


def _look(e: int) -> dict[str, Any]:
    """Return colour and dashes of an ensemble."""
    return {"color": CYCLE[e % len(CYCLE)], "ls": DASHES[e % len(DASHES)]}


def _trace(ax: Axes, natural: Array) -> dict[str, Any]:
    """Mean over walkers, step by step, in every ensemble's colour."""
    handles: dict[str, Any] = {}
    for e, walkers in enumerate(natural):
        (handles[f"ensemble {e + 1}"],) = ax.plot(walkers.mean(axis=0), lw=0.7, **_look(e))
    ax.set_xlim(0, max(1, natural.shape[2] - 1))
    ax.xaxis.set_major_locator(MaxNLocator(2))
    ax.yaxis.set_major_locator(MaxNLocator(3))
    ax.yaxis.get_offset_text().set_fontsize(SYMBOL_PT)
    return handles


def _ranks(ax: Axes, values: Array, effective: float) -> None:
    """Rank histograms with the scatter that the effective sample size allows."""
    heights, half = rank_histograms(values), rank_scatter(effective)
    ax.fill_between([0.0, 1.0], max(0.0, 1.0 - half), 1.0 + half, color=style.BAND, lw=0.0)
    for e, row in enumerate(heights):
        ax.stairs(row, np.linspace(0.0, 1.0, N_BINS + 1), lw=0.8, baseline=None, **_look(e))
    ax.set(xlim=(0.0, 1.0), ylim=(0.0, max(2.0, 1.05 * heights.max())))
    ax.set_xticks([0.0, 0.5, 1.0], ["0", "½", "1"])
    ax.set_yticks([0.0, 1.0, 2.0], ["0", "1", "2"])
    ax.set_ylabel(f"Ratio ({NO_UNIT})", fontsize=SMALLEST_PT, labelpad=1.0)


# Point estimates

_METHODS = "geometric", "genetic", "differential_evolution", "least_squares", "published_regression"


def _method_look(method: str) -> dict[str, Any]:
    """Return marker and colour of a method."""
    i = _METHODS.index(method) if method in _METHODS else -1
    marker, colour = (style.MARKERS[i], CYCLE[i]) if i >= 0 else ("P", GREY)
    return {"marker": marker, "color": colour, "ms": 4.6, **DOTS}


def estimates_plate(result: OutputResult, reference: Reference = NOTHING) -> Plate:
    """Draw every method's estimate of every published parameter, in posterior sds."""
    calibration = result.calibration
    reported = [k for k, v in calibration.reported.items() if np.ptp(v) > 0.0]
    model = calibration.problem.bound.model
    printed, source = reference.parameters(model.name), reference.source(model.name)
    height, margins = max(34.0, 8.0 * len(reported)), {"left": 18.0, "bottom": 22.0, "top": 3.0}
    fig, axes = style.panels(1, 1, height=height, width=style.MIDDLE_MM, **margins)
    ax: Axes = axes[0, 0]
    ring = {"marker": "D", "color": ORANGE, "mfc": "none", "mew": 1.3, "ms": 7.0, "ls": "none"}
    spread = np.linspace(-0.33, 0.33, max(2, len(result.estimates)))
    handles: dict[str, Any] = {}
    names, reach = [], 2.5
    for i, name in enumerate(reported):
        values = [e.reported[name] for e in result.estimates]
        values.append(printed[name].value if name in printed else np.nan)
        distance, interval, log = _distances(result, name, values)
        reach = max(reach, *np.abs(interval), np.nanmax(np.abs(distance), initial=0.0))
        bar: Any = {"color": "#c4c4c4", "lw": 4.0, "solid_capstyle": "butt"}
        (handles["posterior, 95 % HDI"],) = ax.plot(interval, [i, i], **bar)
        (handles["posterior mean"],) = ax.plot(0.0, i, "|", color=BLACK, ms=9.0, mew=1.3, zorder=3)
        for e, d, y in zip(result.estimates, distance[:-1], spread, strict=False):
            if np.isfinite(d):
                dot = _dot(ax, float(d), i + float(y), 4.0, _method_look(e.method))
                handles[method_name(e.method)] = dot
        if np.isfinite(distance[-1]):
            handles[f"published ({source})"] = _dot(ax, float(distance[-1]), i, 5.0, ring)
        names.append(f"ln {symbol(name)}" if log else symbol(name))
    reach = 1.08 * min(EDGE, reach)
    ax.set_yticks(range(len(names)), names, fontsize=SYMBOL_PT)
    ax.axvline(0.0, color=GREY, lw=0.5, zorder=0)
    ax.set(xlabel="Distance from the posterior mean (posterior sds)", xlim=(-reach, reach))
    ax.set(ylabel=f"Parameter ({NO_UNIT})", ylim=(len(names) - 0.4, -0.6))
    style.legend_below(fig, handles, 3)
    said = caption("estimates", **_estimates_facts(result, reported, reference))
    return Plate(fig, "estimates", said, "Point estimates")


def _distances(
    result: OutputResult, name: str, values: Sequence[float]
) -> tuple[Array, Array, bool]:
    s = result.calibration.summary[name]
    draws = result.calibration.reported[name].ravel()
    return distances(draws, np.array(values), (s.hdi_lower, s.hdi_upper))


def _dot(ax: Axes, d: float, y: float, zorder: float, look: Mapping[str, Any]) -> Any:
    """A dot; at the edge, with its distance written, where it is far off."""
    x = float(np.clip(d, -EDGE, EDGE))
    (dot,) = ax.plot(x, y, zorder=zorder, **look)
    if abs(d) > EDGE:
        text, away, side = (
            (f"{short(d)} ►", -6.0, "right") if d > 0 else (f"◄ {short(d)}", 6.0, "left")
        )
        how: Any = {
            "textcoords": "offset points",
            "fontsize": SMALLEST_PT,
            "va": "center",
            "ha": side,
        }
        ax.annotate(text, (x, y), (away, 0.0), **how)
    return dot


def _estimates_facts(
    result: OutputResult, names: Sequence[str], reference: Reference
) -> dict[str, Any]:
    lowest = min((e.cost for e in result.estimates), default=0.0)
    # Of costs that are equal but for their rounding, that of the most exact method: it comes last.
    best = next((e for e in reversed(result.estimates) if e.cost <= lowest * (1.0 + 1e-9)), None)
    if best is None:
        return {"best": None}
    off = {n: abs(float(_distances(result, n, [best.reported[n]])[0][0])) for n in names}
    far = max(names, key=lambda n: off[n])
    model, s = result.calibration.problem.bound.model.name, result.calibration.summary
    printed = reference.parameters(model)
    outside = [
        plain(n)
        for n in names
        if n in printed and not s[n].hdi_lower <= printed[n].value <= s[n].hdi_upper
    ]
    return {
        "best": best,
        "method": method_name(best.method),
        "far": far,
        "distance": off[far],
        "limit": FAR_SDS,
        "outside": outside,
        "source": reference.source(model) if printed else "",
    }


def by_pressure_plate(result: OutputResult, reference: Reference = NOTHING) -> Plate | None:
    """Draw B, C, D and E of each pressure by method; None where pressures were not fitted alone."""
    pressures, problem = list(result.by_pressure), result.calibration.problem
    if not pressures:
        return None
    drawn = problem.of_model(problem.theta(result.calibration.subset(1000)))
    joint = coefficients_at(drawn, np.array(pressures), problem.bound.references)
    fig, axes = style.panels(1, 4, height=46.0, bottom=24.0, gap_x=15.0, top=4.0)
    handles: dict[str, Any] = {}
    units = {"B": "1/%", "C": "1", "D": "kN", "E": "1"}
    for ax, (name, unit) in zip(axes[0], units.items(), strict=True):
        handles |= _coefficient(ax, result, name, joint[name], reference)
        ax.set_xticks(range(len(pressures)), [f"{p:g}" for p in pressures])
        ax.tick_params(axis="x", labelsize=SMALLEST_PT)
        ax.set(xlabel="Pressure (psi)", xlim=(-0.65, len(pressures) - 0.35))
        ax.set_ylabel(parameter_label(name, unit))
    style.legend_below(fig, handles, 3)
    costs = [
        (psi, min(e.cost for e in estimates), reference.beside("genetic", psi))
        for psi, estimates in result.by_pressure.items()
    ]
    said = caption("by_pressure", costs=costs)
    return Plate(fig, "by_pressure", said, "Each pressure on its own")


def _coefficient(
    ax: Axes, result: OutputResult, name: str, joint: Array, reference: Reference
) -> dict[str, Any]:
    handles: dict[str, Any] = {}
    low, middle, high = np.nanquantile(joint, [0.05, 0.5, 0.95], axis=0)
    fitted = np.unique(result.calibration.problem.table["inflation_pressure_psi"])
    jointly = f"{joined([f'{p:g}' for p in fitted])} psi"
    if set(result.by_pressure) <= set(fitted.tolist()):
        jointly = "all pressures"
    elif fitted.size > 5:  # no room in the legend to list them
        jointly = f"{fitted.size} pressures"
    bars: Any = {"fmt": "_", "color": BLACK, "ms": 6.0, "elinewidth": 1.0}
    ring: Any = {"mfc": "none", "mec": ORANGE, "mew": 1.2, "ms": 8.0}
    for i, (psi, estimates) in enumerate(result.by_pressure.items()):
        ends = [[middle[i] - low[i]], [high[i] - middle[i]]]
        bar = ax.errorbar(i - 0.4, middle[i], yerr=ends, **bars)
        handles[f"{jointly} calibrated jointly, 90 %"] = bar
        for k, e in enumerate(estimates):
            (dot,) = ax.plot(i - 0.2 + 0.2 * k, e.reported[name], **_method_look(e.method))
            handles[method_name(e.method)] = dot
        for table, at, shape in zip(reference.alone.values(), (-0.2, 0.0), "os", strict=False):
            if psi in table:
                printed = table[round(psi)]
                (dot,) = ax.plot(i + at, printed.values[name], shape, **ring)
                handles[f"published ({printed.place})"] = dot
    spread = [e.reported[name] for group in result.by_pressure.values() for e in group]
    pad = 0.25 * max(float(np.ptp(spread)), 1e-9)
    everything = np.concatenate([low, high, spread])
    bottom = max(everything.min(), min(spread) - 4 * pad)
    top = min(everything.max(), max(spread) + 4 * pad)
    ax.set_ylim(bottom - 0.4 * pad, top + 0.4 * pad)
    return handles
