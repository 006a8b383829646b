"""Figures of a posterior, what data taught, whether ensembles agree, and of point estimates."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from corner import corner, overplot_lines
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, MaxNLocator, NullLocator
from scipy.stats import gaussian_kde

from calib.inference.calibration import Calibration
from calib.inference.diagnostics import N_BINS, distances, rank_histograms, rank_scatter
from calib.inference.estimators import PointEstimate, method_name
from calib.inference.priors import Prior, Priors
from calib.models.base import Array
from calib.models.magic_formula import coefficients_at
from calib.report.constants import WIDE
from calib.report.figures.plate import Plate
from calib.report.figures.style import (
    BLACK,
    BLUE,
    CYCLE,
    DASHES,
    DOUBLE_MM,
    EMBER,
    GREY,
    MARKERS,
    MIDDLE_MM,
    ORANGE,
    SINGLE_MM,
    SMALLEST_PT,
    SYMBOL_PT,
    caption,
    legend_below,
    panels,
)
from calib.report.labels import NO_UNIT, joined, parameter_label, plain, short, symbol
from calib.report.numbers import TIMES
from calib.report.reference import NOTHING, Reference
from calib.report.study import OutputResult
from calib.validation.constants import FAR_SDS
from calib.validation.scores import MOVED, PRIOR, ROLES, role


def corner_plate(result: OutputResult, *, reference: Reference = NOTHING) -> Plate:
    """Draw every pair of sampled parameters, and mark published ones."""
    draws, priors, wide = _sampled(result.calibration)
    printed = reference.sampled(result.calibration.problem.bound)
    ends, d = np.quantile(draws, [0.001, 0.999], axis=0).T, len(priors)
    size = SINGLE_MM if d <= 2 else MIDDLE_MM if d <= 5 else DOUBLE_MM
    figure = Figure(figsize=(size / 25.4, size / 25.4))
    corner(
        draws, fig=figure, range=ends, bins=24, levels=(0.5, 0.9), smooth=1.0, color=BLUE,
        plot_datapoints=False, plot_density=False, fill_contours=True, no_fill_contours=True,
        contour_kwargs={"linewidths": 0.6}, max_n_ticks=2 if d > 7 else 3,
        labels=[
            parameter_label(p.name, p.unit, log=w).replace(" (", "\n(", 1)
            for p, w in zip(priors, wide, strict=True)
        ],
    )  # fmt: skip
    marks = [
        printed.get(p.name, np.nan) if not w else np.log10(printed.get(p.name, np.nan))
        for p, w in zip(priors, wide, strict=True)
    ]
    marks = [m if low <= m <= high else None for m, (low, high) in zip(marks, ends, strict=True)]
    overplot_lines(figure, marks, color=ORANGE, lw=0.9, ls=DASHES[1])
    # Room for labels to the left and below, and their distance from the panels, in millimetres.
    room, away = 19.0 / size, 14.0 * 1.07 * d / (size - 21.0)
    figure.subplots_adjust(
        left=room, bottom=room, right=1 - 2 / size, top=1 - 2 / size, wspace=0.07, hspace=0.07
    )
    for ax in figure.axes:
        ax.tick_params(axis="x", labelrotation=90)
        ax.tick_params(axis="y", labelrotation=0)
        ax.xaxis.set_label_coords(0.5, -away)
        ax.yaxis.set_label_coords(-away, 0.5)
        for axis, (low, high) in ((ax.xaxis, ax.get_xlim()), (ax.yaxis, ax.get_ylim())):
            axis.label.set_fontsize(SYMBOL_PT)
            axis.label.set_verticalalignment("center")
            # A label at the end of its panel would meet the next panel's.
            room_at_ends = 0.1 * (high - low)
            ticks = [v for v in axis.get_majorticklocs()
                     if low + room_at_ends <= v <= high - room_at_ends]  # fmt: skip
            if ticks:
                axis.set_major_locator(FixedLocator(ticks))
    note = "contours hold 50 % and 90 %" + ("\ndashed: published" if printed else "")
    figure.text(0.98, 0.97, note, va="top", ha="right", fontsize=SMALLEST_PT)
    # Of a pair once, or rounding decides which of the two is named first.
    correlation = np.tril(np.corrcoef(draws, rowvar=False), -1)
    i, j = np.unravel_index(np.abs(correlation).argmax(), correlation.shape)
    said = caption(
        "corner", pair=(priors[j].name, priors[i].name), correlation=float(correlation[i, j]),
        strong=int((np.abs(correlation) > 0.8).sum()), pairs=d * (d - 1) // 2,
        marked=bool(printed),
    )  # fmt: skip
    return Plate(figure, "corner", said, "Posterior, in pairs")


def _sampled(calibration: Calibration) -> tuple[Array, list[Prior], list[bool]]:
    """Thinned draws of the first free parameters, by their decimal logarithm where wide."""
    entries = calibration.problem.priors.entries
    free = [i for i, p in enumerate(entries) if not p.fixed][:11]
    natural = calibration.problem.theta(calibration.subset(4000))[:, free]
    low, high = np.quantile(natural, [0.02, 0.98], axis=0)
    wide = [bool(entries[i].log and high[j] > WIDE * low[j]) for j, i in enumerate(free)]
    natural[:, wide] = np.log10(natural[:, wide])
    return natural, [entries[i] for i in free], wide


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
    t = calibration.subset(3000)
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
    legend_below(fig, handles, 3)
    roles = {what: [plain(p.name) for p in free if role(calibration, p.name) == what]
             for what in ROLES}  # fmt: skip
    ratios = {p.name: calibration.summary[p.name].sd_ratio for p in free}
    sharpest = min(ratios, key=lambda name: ratios[name])
    said = caption(
        "learned", roles={what: names for what, names in roles.items() if names},
        sharpest=sharpest, ratio=ratios[sharpest],
    )  # fmt: skip
    return Plate(fig, "learned", said, "What the data taught")


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
        if len(found) <= 4:
            return found
    return found[:: -(-len(found) // 4)]


def _range(prior: Prior, t: Array) -> tuple[float, float]:
    span = 2.8 * prior.scale if np.isfinite(prior.scale) else 0.5 * (prior.upper - prior.lower)
    low, high = min(prior.loc - span, t.min()), max(prior.loc + span, t.max())
    pad = 0.02 * (high - low)
    return max(low, prior.lower - pad), min(high, prior.upper + pad)


def ensembles_plate(result: OutputResult) -> Plate:
    """Draw traces of the ensemble means and rank histograms, side by side."""
    calibration = result.calibration
    draws, free = calibration.draws, calibration.problem.priors.free
    per_row = 2 if len(free) <= 6 else 3
    fig, axes = panels(
        -(-len(free) // per_row), 2 * per_row, height=24.0 if per_row == 2 else 21.0, left=18.0,
        bottom=21.0, top=5.5, gap_x=17.0 if per_row == 2 else 15.0, gap_y=5.5,
        ratios=(2.0, 1.0) * per_row,
    )  # fmt: skip
    pairs = axes.reshape(-1, 2)
    ess = dict(zip(draws.report.names, draws.report.ess_bulk, strict=True))
    handles: dict[str, Any] = {}
    for j, (prior, (trace, ranks)) in enumerate(zip(free, pairs, strict=False)):
        t = draws.t[..., j]
        natural = np.exp(t) if prior.log else t
        low, high = np.quantile(natural, [0.02, 0.98])
        # Of a parameter that spans decades, the mean would show its largest draws alone.
        wide = bool(prior.log and high > WIDE * low)
        handles |= _trace(trace, np.log10(natural) if wide else natural)
        trace.set_ylabel(parameter_label(prior.name, prior.unit, log=wide))
        _ranks(ranks, natural.reshape(natural.shape[0], -1), ess[prior.name] / natural.shape[0])
        last = j >= len(free) - per_row
        for ax, what in ((trace, "Step"), (ranks, "Rank")):
            ax.set_xlabel(f"{what} ({NO_UNIT})" if last else "")
            ax.tick_params(labelbottom=last)
    for ax in pairs[len(free) :].flat:
        ax.set_visible(False)
    handles["rank count over expected count, 95 % range"] = pairs[0][1].collections[0]
    legend_below(fig, handles, 3)
    r = draws.report
    worst, poorest = int(np.nanargmax(r.rhat)), int(np.nanargmin(r.ess_bulk))
    said = caption(
        "ensembles", r=r, ensembles=draws.t.shape[0], walkers=draws.walkers, rhat=r.rhat[worst],
        worst=r.names[worst], ess=r.ess_bulk[poorest], poorest=r.names[poorest],
        taus=float((r.steps / r.tau).min()),
    )  # fmt: skip
    return Plate(fig, "ensembles", said, "Convergence of the ensembles")


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


# Point estimates

_LOOKS = dict(zip(
    ("geometric", "genetic", "differential_evolution", "least_squares", "published_regression"),
    zip(MARKERS, CYCLE, strict=True), strict=False,
))  # fmt: skip
# Estimates farther off than this many posterior sds are drawn at the edge.
_EDGE = 5.0


def estimates_plate(result: OutputResult, *, reference: Reference = NOTHING) -> Plate:
    """Draw every method's estimate of every published parameter, in posterior sds."""
    calibration = result.calibration
    reported = [k for k, v in calibration.reported.items() if np.ptp(v) > 0.0]
    model = calibration.problem.bound.model
    printed = reference.parameters(model.name)
    fig, axes = panels(
        1, 1, height=max(34.0, 8.0 * len(reported)), width=MIDDLE_MM, left=18.0, bottom=22.0,
        top=3.0,
    )  # fmt: skip
    ax: Axes = axes[0, 0]
    handles: dict[str, Any] = {}
    names, reach = [], 2.5
    for i, name in enumerate(reported):
        values = [e.reported[name] for e in result.estimates]
        values.append(printed[name].value if name in printed else np.nan)
        distance, interval, log = _distances(result, name, values)
        reach = max(reach, *np.abs(interval), np.nanmax(np.abs(distance), initial=0.0))
        (handles["posterior, 95 % HDI"],) = ax.plot(
            interval, [i, i], color="#c4c4c4", lw=4.0, solid_capstyle="butt"
        )
        (handles["posterior mean"],) = ax.plot(0.0, i, "|", color=BLACK, ms=9.0, mew=1.3, zorder=3)
        handles |= _estimates_row(ax, i, distance, result.estimates, reference.source(model.name))
        names.append(f"ln {symbol(name)}" if log else symbol(name))
    reach = 1.08 * min(_EDGE, reach)
    ax.set_xlim(-reach, reach)
    ax.set_yticks(range(len(names)), names, fontsize=SYMBOL_PT)
    ax.set_ylim(len(names) - 0.4, -0.6)
    ax.axvline(0.0, color=GREY, lw=0.5, zorder=0)
    ax.set_xlabel("Distance from the posterior mean (posterior sds)")
    ax.set_ylabel(f"Parameter ({NO_UNIT})")
    legend_below(fig, handles, 3)
    said = caption("estimates", **_estimates_facts(result, reported, reference))
    return Plate(fig, "estimates", said, "Point estimates")


def _distances(
    result: OutputResult, name: str, values: Sequence[float]
) -> tuple[Array, Array, bool]:
    s = result.calibration.summary[name]
    draws = result.calibration.reported[name].ravel()
    return distances(draws, np.array(values), (s.hdi_lower, s.hdi_upper))


def _estimates_row(
    ax: Axes, i: int, distance: Array, estimates: tuple[PointEstimate, ...], source: str
) -> dict[str, Any]:
    handles: dict[str, Any] = {}
    spread = np.linspace(-0.33, 0.33, max(2, len(estimates)))
    for k, (estimate, d) in enumerate(zip(estimates, distance[:-1], strict=True)):
        if np.isfinite(d):
            name = method_name(estimate.method)
            marker, colour = _LOOKS.get(estimate.method, ("P", GREY))
            handles[name] = _dot(ax, float(d), i + float(spread[k]), marker, colour)
    if np.isfinite(distance[-1]):
        handles[f"published ({source})"] = _dot(ax, float(distance[-1]), i, "D", ORANGE, ring=True)
    return handles


def _dot(ax: Axes, d: float, y: float, marker: str, colour: str, *, ring: bool = False) -> Any:
    """A dot; at the edge, with its distance written, where it is far off."""
    x = float(np.clip(d, -_EDGE, _EDGE))
    face = "none" if ring else colour
    edge, width, size = (colour, 1.3, 7.0) if ring else ("white", 0.4, 4.6)
    (dot,) = ax.plot(x, y, marker, mfc=face, mec=edge, mew=width, ms=size, zorder=4 + ring)
    if abs(d) > _EDGE:
        ax.annotate(
            f"{short(d)} ►" if d > 0 else f"◄ {short(d)}", (x, y),
            (-6.0 if d > 0 else 6.0, 0.0), textcoords="offset points", fontsize=SMALLEST_PT,
            va="center", ha="right" if d > 0 else "left",
        )  # fmt: skip
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
    printed = {n: f.value for n, f in reference.parameters(model).items() if n in names}
    outside = [n for n, v in printed.items() if not s[n].hdi_lower <= v <= s[n].hdi_upper]
    return {
        "best": best, "method": method_name(best.method), "far": far, "distance": off[far],
        "limit": FAR_SDS, "outside": [plain(n) for n in names if n in outside],
        "source": reference.source(model) if reference.parameters(model) else "",
    }  # fmt: skip


def by_pressure_plate(result: OutputResult, *, reference: Reference = NOTHING) -> Plate | None:
    """Draw B, C, D and E of each pressure by method; None where pressures were not fitted alone."""
    pressures = list(result.by_pressure)
    if not pressures:
        return None
    calibration = result.calibration
    joint = coefficients_at(
        calibration.problem.of_model(calibration.problem.theta(calibration.subset(1000))),
        np.array(pressures),
        calibration.problem.bound.references,
    )  # fmt: skip
    fig, axes = panels(1, 4, height=46.0, left=14.0, bottom=24.0, gap_x=15.0, top=4.0)
    handles: dict[str, Any] = {}
    units = {"B": "1/%", "C": "1", "D": "kN", "E": "1"}
    for ax, name in zip(axes[0], "BCDE", strict=True):
        handles |= _coefficient(ax, result, name, joint[name], reference)
        ax.set_xticks(range(len(pressures)), [f"{p:g}" for p in pressures])
        ax.tick_params(axis="x", labelsize=SMALLEST_PT)
        ax.set_xlim(-0.65, len(pressures) - 0.35)
        ax.set_xlabel("Pressure (psi)")
        ax.set_ylabel(parameter_label(name, units[name]))
    legend_below(fig, handles, 3)
    costs = [(psi, min(e.cost for e in estimates), reference.beside("genetic", psi))
             for psi, estimates in result.by_pressure.items()]  # fmt: skip
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
    for i, (psi, estimates) in enumerate(result.by_pressure.items()):
        handles[f"{jointly} calibrated jointly, 90 %"] = ax.errorbar(
            i - 0.4, middle[i], yerr=[[middle[i] - low[i]], [high[i] - middle[i]]], fmt="_",
            color=BLACK, ms=6.0, elinewidth=1.0,
        )  # fmt: skip
        for k, e in enumerate(estimates):
            marker, colour = _LOOKS.get(e.method, ("P", GREY))
            (handles[method_name(e.method)],) = ax.plot(
                i - 0.2 + 0.2 * k, e.reported[name], marker, color=colour, ms=4.6,
                mec="white", mew=0.4,
            )  # fmt: skip
        printed = zip(reference.alone.values(), (-0.2, 0.0), "os", strict=False)
        for table, at, shape in printed:
            if psi in table:
                label = f"published ({table[round(psi)].place})"
                (handles[label],) = ax.plot(
                    i + at, table[round(psi)].values[name], shape, mfc="none", mec=ORANGE,
                    mew=1.2, ms=8.0,
                )  # fmt: skip
    spread = [e.reported[name] for group in result.by_pressure.values() for e in group]
    pad = 0.25 * max(float(np.ptp(spread)), 1e-9)
    everything = np.concatenate([low, high, spread])
    bottom, top = (
        max(everything.min(), min(spread) - 4 * pad),
        min(everything.max(), max(spread) + 4 * pad),
    )
    ax.set_ylim(bottom - 0.4 * pad, top + 0.4 * pad)
    return handles
