"""The figure of what a design of experiments can tell apart, before any field data."""

from __future__ import annotations

import textwrap

import numpy as np
from matplotlib.axes import Axes
from scipy.cluster.hierarchy import leaves_list, linkage
from scipy.spatial.distance import squareform

from calib.gap.diagnose import Diagnosis
from calib.gap.isolate import ALIKE, Isolability
from calib.report.figures.plate import Plate
from calib.report.figures.style import BLACK, BLUE, ORANGE, SMALLEST_PT, VERMILION, panels
from calib.report.gap_rows import short_name
from calib.report.labels import NO_UNIT, joined, short

# Letters of a name in one line, and their mean width.
_LINE = 27
_MM_PER_LETTER = 1.45


def isolability_plate(found: Diagnosis) -> Plate | None:
    """Draw the likeness of effects, what parameters absorb, and detectable sizes."""
    design = found.ranking.isolability
    if not design.absorbed:
        return None
    names = _ordered(design)
    n = len(names)
    side = max(5.0 * n, 30.0)
    words = [textwrap.fill(short_name(name), _LINE) for name in names]
    # Names stand to the left of the matrix and, turned, below it.
    margin = 5.0 + _MM_PER_LETTER * max(len(line) for w in words for line in w.splitlines())
    bottom = max(margin, 14.0)
    fig, axes = panels(
        1, 3, height=side, left=margin, right=4.0, top=6.0, bottom=bottom, gap_x=6.0, sharey=False
    )
    total = fig.get_figwidth() * 25.4
    height = fig.get_figheight() * 25.4
    # The matrix is square; the two strips share its rows.
    width = min(side, 86.0)
    strip = 0.5 * (total - margin - 4.0 - 16.0 - width)
    left = margin
    for ax, w in zip(axes[0], (width, strip, strip), strict=True):
        ax.set_position((left / total, bottom / height, w / total, side / height))
        left += w + 8.0
    _matrix(axes[0, 0], design, names, words)
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


def _matrix(ax: Axes, design: Isolability, names: list[str], words: list[str]) -> None:
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
    ax.set_yticks(np.arange(n), words, linespacing=0.95)
    shown = max(n - 1, 1)
    ax.set_xticks(np.arange(shown), words[:shown], rotation=90, linespacing=0.95)
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
        rest = len(alike) - 4
        more = f", and {rest} more pair{'s' * (rest > 1)}" if rest > 0 else ""
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
