"""The posterior: pairwise (corner), and against the prior, parameter by parameter."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator, NullLocator
from scipy.stats import gaussian_kde

from calib.calibrate import Calibration
from calib.figures.labels import joined, parameter_label, plain, short
from calib.figures.plate import Plate
from calib.figures.reference import published_sampled
from calib.figures.roles import MOVED, PRIOR, ROLES, role
from calib.figures.style import BLACK, BLUE, DASHES, ORANGE, VERMILION, legend_below, panels
from calib.models.base import Array
from calib.priors import Prior
from calib.study import OutputResult

__all__ = ["corner_plate", "learned_plate"]

MAX_CORNER = 11
_CORNER_DRAWS = 4000
_KDE_DRAWS = 3000
# A positive parameter this wide (98 % over 2 % point) is drawn by its logarithm.
_WIDE = 4.0


def _sampled(calibration: Calibration) -> tuple[Array, list[Prior], list[bool]]:
    """Thinned draws of the first free parameters, by their decimal logarithm where those are wide."""
    entries = calibration.problem.priors.entries
    free = [i for i, p in enumerate(entries) if not p.fixed][:MAX_CORNER]
    natural = calibration.problem.theta(calibration.subset(_CORNER_DRAWS))[:, free]
    low, high = np.quantile(natural, [0.02, 0.98], axis=0)
    wide = [
        bool(entries[i].log and high[j] > _WIDE * low[j]) for j, i in enumerate(free)
    ]
    natural[:, wide] = np.log10(natural[:, wide])
    return natural, [entries[i] for i in free], wide


def corner_plate(result: OutputResult, *, published: bool) -> Plate:
    """Draw every pair of sampled parameters.

    Parameters
    ----------
    result : OutputResult
    published : bool
        Whether to mark what the published figures amount to.
    """
    from corner import hist2d

    draws, priors, wide = _sampled(result.calibration)
    marks = published_sampled(result.calibration.problem.bound) if published else {}
    at = [
        np.log10(marks[p.name]) if w and p.name in marks else marks.get(p.name)
        for p, w in zip(priors, wide, strict=True)
    ]
    labels = [parameter_label(p.name, p.unit, log=w) for p, w in zip(priors, wide, strict=True)]
    d = len(priors)
    edge = 150.0 / d if d > 7 else min(30.0, 130.0 / d)
    fig, lower = _triangle(d, edge)
    low, high = np.quantile(draws, [0.002, 0.998], axis=0)
    for (i, j), ax in lower.items():
        ax.set_xlim(low[j], high[j])
        if i == j:
            counts, edges = np.histogram(draws[:, j], 30, (low[j], high[j]))
            ax.stairs(counts / counts.max(), edges, color=BLUE, lw=1.0, fill=False)
            ax.set_ylim(0.0, 1.15)
            ax.spines["left"].set_visible(False)
        else:
            hist2d(
                draws[:, j], draws[:, i], bins=24, ax=ax, levels=(0.5, 0.9), smooth=1.0,
                range=[(low[j], high[j]), (low[i], high[i])], plot_datapoints=False,
                plot_density=False, fill_contours=True, color=BLUE,
                contour_kwargs={"linewidths": 0.6},
            )  # fmt: skip
            ax.set_ylim(low[i], high[i])
        _mark(ax, at[j], at[i] if i != j else None)
        _label(ax, (i, j, d), edge, labels)
    lower[0, 0].annotate(
        "contours hold 50 % and 90 %" + ("\ndashed: published" if marks else ""), (1.0, 1.0),
        (8.0, 0.0), xycoords="axes fraction", textcoords="offset points", va="top", fontsize=7.0,
    )  # fmt: skip
    caption = _corner_caption(draws, [p.name for p in priors], bool(marks))
    return Plate(fig, "corner", caption, "Posterior, in pairs")


def _triangle(d: int, edge: float) -> tuple[Any, dict[tuple[int, int], Axes]]:
    """Axes on and below the diagonal only: half of them, and axes are what takes the time."""
    from matplotlib.figure import Figure

    left, bottom, gap, rest = 17.0, 17.0, 1.2, 3.0
    total = left + d * edge + (d - 1) * gap + rest
    fig = Figure(figsize=(total / 25.4, total / 25.4))
    found = {}
    for i in range(d):
        for j in range(i + 1):
            x, y = left + j * (edge + gap), bottom + (d - 1 - i) * (edge + gap)
            found[i, j] = fig.add_axes((x / total, y / total, edge / total, edge / total))
    return fig, found


def _mark(ax: Axes, x: float | None, y: float | None) -> None:
    if x is not None:
        ax.axvline(x, color=ORANGE, lw=0.9, ls=DASHES[1])
    if y is not None:
        ax.axhline(y, color=ORANGE, lw=0.9, ls=DASHES[1])


def _label(ax: Axes, place: tuple[int, int, int], edge: float, labels: list[str]) -> None:
    i, j, d = place
    many = d > 7
    size = 6.5 if many else 8.0
    ax.tick_params(labelsize=size - 0.5)
    if i == d - 1:
        ax.xaxis.set_major_locator(MaxNLocator(2 if many else 3))
        ax.tick_params(axis="x", labelrotation=90 if many else 45)
        ax.set_xlabel(labels[j], fontsize=size)
        ax.xaxis.set_label_coords(0.5, -(11.0 if many else 10.0) / edge)
    else:
        ax.xaxis.set_major_locator(NullLocator())
    if j == 0 and i > 0:
        ax.yaxis.set_major_locator(MaxNLocator(2 if many else 3))
        ax.set_ylabel(labels[i], fontsize=size)
        ax.yaxis.set_label_coords(-11.0 / edge, 0.5)
    else:
        ax.yaxis.set_major_locator(NullLocator())


def _corner_caption(draws: Array, names: list[str], marked: bool) -> str:
    correlation = np.corrcoef(draws, rowvar=False) - np.eye(len(names))
    i, j = np.unravel_index(np.abs(correlation).argmax(), correlation.shape)
    strong = int((np.abs(np.tril(correlation)) > 0.8).sum())
    pairs = len(names) * (len(names) - 1) // 2
    marks = " Dashed: what the published figures amount to." if marked else ""
    few = f"{strong} of {pairs} pairs" if strong else f"none of the {pairs} pairs"
    return (
        f"{plain(names[j])} and {plain(names[i])} are tied most closely (correlation "
        f"{short(float(correlation[i, j]))}); {few} {'exceeds' if strong in (0, 1) else 'exceed'} 0.8.{marks}"
    )


def learned_plate(result: OutputResult, *, published: bool) -> Plate:
    """Draw prior and posterior densities of every sampled parameter.

    Parameters
    ----------
    result : OutputResult
    published : bool
        Whether to mark what the published figures amount to.
    """
    calibration = result.calibration
    free = calibration.problem.priors.free
    marks = published_sampled(calibration.problem.bound) if published else {}
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
            f"{what}, sd ratio {short(ratio)}", fontsize=6.5, color=VERMILION if strong else BLACK,
            weight="bold" if strong else "normal",
        )  # fmt: skip
    for ax in axes.flat[len(free) :]:
        ax.set_visible(False)
    legend_below(fig, list(handles.values()), list(handles), 3)
    return Plate(fig, "learned", _learned_caption(calibration), "What the data taught")


def _prior_posterior(
    ax: Axes, prior: Prior, t: Array, mark: float | None
) -> dict[str, Any]:
    """One parameter in internal coordinates, on a log axis where those are logarithms."""
    low, high = _range(prior, t)
    x = np.linspace(low, high, 300)
    drawn = np.exp(x) if prior.log else x
    density = _prior_density(prior, x)
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
    ax.set_xlim(drawn[0], drawn[-1])
    ax.set_ylim(0.0, 1.08)
    ax.yaxis.set_major_locator(NullLocator())
    ax.spines["left"].set_visible(False)
    ax.set_xlabel(parameter_label(prior.name, prior.unit))
    return handles


def _range(prior: Prior, t: Array) -> tuple[float, float]:
    span = 2.8 * prior.scale if np.isfinite(prior.scale) else 0.5 * (prior.upper - prior.lower)
    low, high = min(prior.loc - span, t.min()), max(prior.loc + span, t.max())
    pad = 0.02 * (high - low)
    return max(low, prior.lower - pad), min(high, prior.upper + pad)


def _prior_density(prior: Prior, x: Array) -> Array:
    inside = (x >= prior.lower) & (x <= prior.upper)
    z = (x - prior.loc) / prior.scale if np.isfinite(prior.scale) else np.zeros_like(x)
    return np.where(inside, np.exp(-0.5 * z * z), 0.0)


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
