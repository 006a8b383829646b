"""What the design could show, before its outcomes, and what the best hypothesis leaves."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from scipy.cluster.hierarchy import leaves_list, linkage
from scipy.spatial.distance import squareform

from calib.gap.diagnose import Diagnosis
from calib.gap.isolate import ALIKE, Isolability
from calib.report.figures.plate import Plate
from calib.report.figures.style import (
    BLACK,
    BLUE,
    CYCLE,
    GREY,
    MARKERS,
    ORANGE,
    SMALLEST_PT,
    VERMILION,
    legend_below,
    panels,
)
from calib.report.gap_rows import best_fit, best_of, output_word, short_name
from calib.report.labels import NO_UNIT, axis_of, joined, percent, short

__all__ = ["isolability_plate", "left_over_plate"]


def isolability_plate(found: Diagnosis) -> Plate | None:
    """Draw the likeness of effects, what parameters absorb, and detectable sizes."""
    design = found.ranking.isolability
    if not design.absorbed:
        return None
    names = _ordered(design)
    n = len(names)
    side = max(5.0 * n, 30.0)
    fig, axes = panels(
        1, 3, height=side, left=40.0, right=4.0, top=6.0, bottom=32.0, gap_x=6.0, sharey=False
    )
    total = fig.get_figwidth() * 25.4
    height = fig.get_figheight() * 25.4
    # The matrix is square; the two strips share its rows.
    strip = 0.5 * (total - 40.0 - 4.0 - 16.0 - min(side, 86.0))
    width = min(side, 86.0)
    left = 40.0
    for ax, w in zip(axes[0], (width, strip, strip), strict=True):
        ax.set_position((left / total, 32.0 / height, w / total, side / height))
        left += w + 8.0
    _matrix(axes[0, 0], design, names)
    y = np.arange(n)
    absorbed = np.array([design.absorbed[name] for name in names])
    axes[0, 1].barh(y, absorbed, color=ORANGE, height=0.6)
    axes[0, 1].set_xlim(0.0, 1.0)
    axes[0, 1].set_xlabel(f"Absorbed by the\nparameters ({NO_UNIT})")
    size = np.array([design.detectable[name] for name in names])
    shown = np.minimum(size, 4.0)
    axes[0, 2].hlines(y, 0.0, shown, color="#c9c9c9", lw=1.0)
    axes[0, 2].plot(shown, y, "o", color=BLUE, ms=4.5)
    for yi, value in zip(y, size, strict=True):
        axes[0, 2].text(
            min(value, 4.0) + 0.12, yi, short(float(value)) if value < 100.0 else "none",
            va="center", fontsize=SMALLEST_PT,
        )  # fmt: skip
    axes[0, 2].set_xlim(0.0, max(1.25 * float(shown.max()), 1.5))
    axes[0, 2].set_xlabel("Smallest size that\nshows (noise sd)")
    for ax in axes[0, 1:]:
        ax.set_ylim(n - 0.5, -0.5)
        ax.set_yticks([])
        ax.spines["left"].set_visible(False)
        ax.hlines(y + 0.5, *ax.get_xlim(), color="#eeeeee", lw=0.5, zorder=0)
    axes[0, 0].set_title("Likeness (cosine)", loc="left")
    return Plate(fig, "isolability", _design_caption(design), "What this design can tell apart")


def _matrix(ax: Axes, design: Isolability, names: list[str]) -> None:
    n = len(names)
    cosine = np.full((n, n), np.nan)
    for i, a in enumerate(names):
        for j, b in enumerate(names[:i]):
            cosine[i, j] = design.likeness.get(_key(a, b), np.nan)
    ax.imshow(cosine, vmin=0.0, vmax=1.0, cmap="Blues", aspect="auto")
    for i in range(n):
        for j in range(i):
            value = cosine[i, j]
            if not np.isfinite(value):
                continue
            alike = value >= ALIKE
            ax.text(
                j, i, f"{100.0 * value:.0f}", ha="center", va="center", fontsize=SMALLEST_PT,
                color="white" if value > 0.6 else BLACK, fontweight="bold" if alike else "normal",
            )  # fmt: skip
            if alike:
                ax.plot(
                    [j - 0.5, j + 0.5, j + 0.5, j - 0.5, j - 0.5],
                    [i - 0.5, i - 0.5, i + 0.5, i + 0.5, i - 0.5], color=VERMILION, lw=1.1,
                    clip_on=False, zorder=4,
                )  # fmt: skip
    words = [short_name(name) for name in names]
    ax.set_yticks(np.arange(n), words)
    ax.set_xticks(np.arange(max(n - 1, 1)), words[: max(n - 1, 1)], rotation=90)
    ax.set_xlim(-0.5, max(n - 1.5, 0.5))
    ax.tick_params(length=0.0)
    for spine in ax.spines.values():
        spine.set_visible(False)


def _key(a: str, b: str) -> tuple[str, str]:
    return (a, b) if a < b else (b, a)


def _ordered(design: Isolability) -> list[str]:
    """Names with those that look alike beside each other."""
    names = sorted(design.absorbed)
    if len(names) < 3:
        return names
    distance = np.zeros((len(names), len(names)))
    for i, a in enumerate(names):
        for j, b in enumerate(names[:i]):
            cosine = design.likeness.get((b, a), 0.0)
            distance[i, j] = distance[j, i] = np.clip(1.0 - cosine, 0.0, 2.0)
    tree = linkage(squareform(distance, checks=False), "average", optimal_ordering=True)
    return [names[i] for i in leaves_list(tree)]


def _design_caption(design: Isolability) -> str:
    alike = sorted(design.alike, key=lambda pair: -design.likeness[pair])
    if alike:
        listed = joined([f"{short_name(a)} with {short_name(b)}" for a, b in alike[:4]])
        more = f", and {len(alike) - 4} pairs more" if len(alike) > 4 else ""
        text = f"On these conditions some effects look the same (framed): {listed}{more}."
    else:
        text = f"No two effects look alike here (no cosine of {ALIKE:g} or more)."
    hard = [n for n, share in design.absorbed.items() if share > 0.8]
    if hard:
        text += (
            f" The simulator's own parameters could take up more than 80 % of "
            f"{joined([short_name(n) for n in hard])}."
        )
    sizes = [size for size in design.detectable.values() if np.isfinite(size)]
    shows = f"{short(min(sizes))} to {short(max(sizes))} noise sd" if sizes else "no size"
    return (
        f"{text} What is told from noise in 80 % of campaigns like this one, by whatever name, are "
        f"effects of at least {shows} (rms over the rows of the output where it is largest; "
        "the noise is the laboratory's alone here). Only conditions and laboratory data were used "
        "for this figure; likeness is in hundredths."
    )


def left_over_plate(found: Diagnosis) -> Plate:
    """Draw standardised residuals of the best hypothesis over slip and run order."""
    name = best_of(found)
    fit = best_fit(found, name)
    conditions = found.data.view.conditions
    known = (found.data.view.column(role) for role in ("slip", "order"))
    columns = [c for c in known if c]
    columns = columns or [next(iter(conditions))]
    fig, axes = panels(
        1, len(columns), height=44.0, left=13.0, right=4.0, top=6.0, bottom=16.0, gap_x=6.0,
        sharey=True,
    )  # fmt: skip
    handles = {}
    beyond = total = 0
    top = 2.6
    for ax, column in zip(axes[0], columns, strict=True):
        axis = axis_of(column)
        ax.axhspan(-2.0, 2.0, color="#eeeeee", lw=0.0, zorder=0)
        ax.axhline(0.0, color=GREY, lw=0.6)
        for k, o in enumerate(found.data.outputs):
            residual = fit.field_residuals[o.name]
            (handles[output_word(o.name)],) = ax.plot(
                axis.scale(conditions[column][o.rows]), residual, MARKERS[k], color=CYCLE[k],
                mec="white", mew=0.4, ms=4.6,
            )  # fmt: skip
            top = max(top, 1.1 * float(np.nanmax(np.abs(residual))))
        ax.set_xlabel(axis.label)
        ax.set_title(f"Along {axis.name.lower()}", loc="left")
    for residual in fit.field_residuals.values():
        beyond, total = beyond + int((np.abs(residual) > 2.0).sum()), total + residual.size
    axes[0, 0].set_ylim(-top, top)
    axes[0, 0].set_ylabel("Residual (noise sd)")
    legend_below(fig, list(handles.values()), list(handles), 3)
    share = percent(beyond / max(total, 1)) if beyond else "none"
    caption = (
        f"Residuals of the field rows after {short_name(name)}, the most probable hypothesis: "
        f"{beyond} of {total} lie beyond 2 sds of the noise of both campaigns ({share}; 4.6 % "
        "are expected). A pattern left here would be a second effect, or the wrong first one."
    )
    return Plate(fig, "left_over", caption, "What is left after the best hypothesis")
