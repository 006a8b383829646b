"""What the data taught: the posterior of every parameter against its prior."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator, NullLocator
from scipy.stats import gaussian_kde

from calib.inference.calibration import Calibration
from calib.inference.priors import Prior
from calib.models.base import Array
from calib.report.figures.plate import Plate
from calib.report.figures.style import (
    BLACK,
    BLUE,
    DASHES,
    EMBER,
    ORANGE,
    SMALLEST_PT,
    legend_below,
    panels,
)
from calib.report.labels import joined, parameter_label, plain, short
from calib.report.numbers import TIMES
from calib.report.reference import NOTHING, Reference
from calib.report.study import OutputResult
from calib.validation.roles import MOVED, PRIOR, ROLES, role

__all__ = ["learned_plate"]

_KDE_DRAWS = 3000


def learned_plate(result: OutputResult, *, reference: Reference = NOTHING) -> Plate:
    """Draw prior and posterior densities of every sampled parameter.

    Parameters
    ----------
    result : OutputResult
    reference : Reference, optional
        Whose figures are marked.
    """
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


def _log_ticks(low: float, high: float, most: int = 4) -> list[float]:
    """Return up to `most` round values: 1, 2, 5 times powers of ten, or powers alone."""
    powers = range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1)
    for steps in ((1, 2, 5), (1, 3), (1,)):
        found = [s * 10.0**k for k in powers for s in steps if low <= s * 10.0**k <= high]
        if len(found) <= most:
            return found
    return found[:: -(-len(found) // most)]


def _range(prior: Prior, t: Array) -> tuple[float, float]:
    span = 2.8 * prior.scale if np.isfinite(prior.scale) else 0.5 * (prior.upper - prior.lower)
    low, high = min(prior.loc - span, t.min()), max(prior.loc + span, t.max())
    pad = 0.02 * (high - low)
    return max(low, prior.lower - pad), min(high, prior.upper + pad)


def _prior_density(prior: Prior, x: Array) -> Array:
    inside = (x >= prior.lower) & (x <= prior.upper)
    if prior.gamma is not None:
        shape, rate = prior.gamma
        return np.where(inside, np.exp(shape * (x - prior.loc) - rate * np.exp(x)), 0.0)
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
