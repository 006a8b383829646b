"""Figures of a diagnosis: what a design can tell apart, which cause it is, and what each leaves."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from matplotlib.axes import Axes
from scipy.cluster.hierarchy import leaves_list, linkage
from scipy.spatial.distance import squareform

from calib.gap.constants import ALIKE, NAMED
from calib.gap.diagnose import Diagnosis, Placebo, placebos
from calib.gap.identifiability import Identifiability
from calib.report.figures.gap_where import conditions_plate, how_far_plate, where_plate
from calib.report.figures.plate import Plate, draw_all, marked
from calib.report.figures.style import (
    BLACK,
    BLUE,
    CYCLE,
    EMBER,
    GREY,
    MARKERS,
    ORANGE,
    SKY,
    SMALLEST_PT,
    VERMILION,
    legend_below,
    note,
    panels,
)
from calib.report.gap_facts import TIE, output_word, short_name
from calib.report.labels import MINUS, NO_UNIT, axis_of, joined, percent, short


def left_over_plate(found: Diagnosis) -> Plate:
    """Draw standardised residuals of the best hypothesis over slip and run order."""
    name = found.ranking.order[0]
    fit = found.ranking.best(name)
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
    legend_below(fig, handles, 3)
    share = percent(beyond / max(total, 1)) if beyond else "none"
    caption = (
        f"Residuals of the field rows after {short_name(name)}, the most probable hypothesis: "
        f"{beyond} of {total} lie beyond 2 sds of the noise of both campaigns ({share}; 4.6 % "
        "are expected). A pattern left here would be a second effect, or the wrong first one."
    )
    return Plate(fig, "left_over", caption, "What is left after the best hypothesis")


_MOST = 8
_SPECIAL = ("none", "unknown", "parameter_shift")


def in_play(found: Diagnosis) -> list[str]:
    """Return hypotheses whose probability is not far below the best one's, best first."""
    p, order = found.ranking.probability, found.ranking.order
    return [name for name in order if p[name] >= TIE * p[order[0]]][:_MOST]


def probability_text(p: float) -> str:
    """Write a probability as a percentage without claiming certainty."""
    if p > 0.995:
        return "> 99 %"
    return "< 1 %" if p < 0.01 else f"{100.0 * p:.0f} %"


def which_plate(found: Diagnosis) -> Plate:
    """Draw probabilities beside the misfit that each hypothesis leaves."""
    p = found.ranking.probability
    order = found.ranking.order
    names = order[:_MOST]
    names += [n for n in _SPECIAL if n in p and n not in names]
    tied = in_play(found)
    # As wide as the margin: longer names, of several causes at once, take two lines or three.
    labels = [textwrap.fill(short_name(n), 38) for n in names]
    rows = np.maximum(1.0, [0.66 * (1 + label.count("\n")) for label in labels])
    total = float(rows.sum())
    fig, axes = panels(1, 1, height=5.2 * total + 3.0, left=66.0, right=16.0, top=3.0, bottom=10.0)
    ax = axes[0, 0]
    y = total - np.cumsum(rows) + 0.5 * rows
    for yi, name in zip(y, names, strict=True):
        leading = name in tied
        colour = (BLUE if name == order[0] else SKY) if leading else "#c9c9c9"
        ax.barh(
            yi, p[name], color=colour, height=0.66, edgecolor=BLACK if leading else "none", lw=0.5,
            hatch="///" if leading and len(tied) > 1 else None,
        )  # fmt: skip
        ax.text(
            p[name] + 0.01, yi, probability_text(p[name]), va="center", fontsize=7.0,
            fontweight="bold" if leading else "normal",
        )  # fmt: skip
    ax.set_yticks(y, labels, linespacing=0.95)
    ax.set_ylim(-0.1, total + 0.1)
    ax.set_xlim(0.0, 1.0)
    ax.axvline(0.5, color=GREY, lw=0.7, ls=(0, (4, 2)), zorder=0)
    ax.tick_params(axis="y", length=0.0)
    ax.set_xlabel(f"Probability ({NO_UNIT})")
    if len(tied) > 1:
        read = "read them as a tie" if p[order[0]] < NAMED else "any of them may be right"
        note(ax, f"hatched: not far apart,\n{read}", x=0.98, y=0.05, color=BLACK)
    return Plate(fig, "which", _which_caption(found, tied), "Which: the hypotheses")


def _which_caption(found: Diagnosis, tied: list[str]) -> str:
    p, order = found.ranking.probability, found.ranking.order
    listed = joined([f"{short_name(n)} ({probability_text(p[n])})" for n in tied])
    text = (
        f"Most probable: {listed}."
        if len(tied) == 1
        else f"No data here separate {listed} by more than a factor of {1.0 / TIE:.0f}."
    )
    rest = sum(p[n] for n in order[_MOST:] if n not in _SPECIAL)
    others = len(order) - min(len(order), _MOST)
    if others:
        text += f" {others} more hypotheses share {probability_text(rest)}."
    return (
        f"{text} Beyond the dashed line a hypothesis is more probable than all others together; "
        "how probable each cause is to act, in whichever of them, is a table of its own."
    )


def placebo_plate(found: Diagnosis) -> Plate:
    """Draw what wrong hypotheses would have left of the gap."""
    placebo = placebos(found)
    order = sorted(placebo.left, key=lambda n: placebo.left[n])
    named = found.ranking.order[0]
    fig, axes = panels(
        1, 1, height=4.2 * len(order) + 3.0, left=62.0, right=16.0, top=7.0, bottom=10.0
    )
    ax = axes[0, 0]
    y = np.arange(len(order))[::-1]
    for yi, name in zip(y, order, strict=True):
        best = name == named
        colour = BLUE if best else ORANGE if name in ("unknown", "parameter_shift") else GREY
        ax.plot([placebo.left[name], placebo.before], [yi, yi], color="#d4d4d4", lw=1.0, zorder=1)
        ax.plot(
            placebo.left[name], yi, "D" if best else "o", color=colour, ms=5.5 if best else 4.0,
            zorder=3,
        )  # fmt: skip
        ax.text(
            1.015, yi, f"{100.0 * placebo.shrink(name):.0f} %".replace("-", MINUS),
            transform=ax.get_yaxis_transform(), va="center", fontsize=7.0,
            fontweight="bold" if best else "normal",
        )  # fmt: skip
    ax.axvline(1.0, color=BLACK, lw=0.8, ls=(0, (1, 1)), zorder=0)
    ax.axvline(placebo.before, color=VERMILION, lw=1.0, zorder=0)
    high = max(placebo.before, *placebo.left.values())
    low = min(1.0, *placebo.left.values())
    pad = 0.06 * max(high - low, 0.3)
    ax.set_xlim(low - pad, high + pad)
    top = len(order) - 0.3
    ax.text(1.0, top, "noise", ha="center", va="bottom", fontsize=7.0)
    if placebo.before - 1.0 > 0.12 * (high - low + 2.0 * pad):
        ax.text(placebo.before, top, "simulator", ha="center", va="bottom", fontsize=7.0,
                color=EMBER)  # fmt: skip
    ax.text(1.015, 1.0, "removed", transform=ax.transAxes, va="bottom", fontsize=7.0, color=GREY)
    ax.set_yticks(y, [textwrap.fill(short_name(n), 38) for n in order], linespacing=0.85)
    ax.set_ylim(-0.6, len(order) - 0.4)
    ax.tick_params(axis="y", length=0.0)
    ax.set_xlabel("Residual on the field rows, rms over the noise (noise sd)")
    return Plate(fig, "placebo", _placebo_caption(placebo, named), "Placebo: the wrong hypotheses")


def _placebo_caption(placebo: Placebo, named: str) -> str:
    wrong = {
        n: v
        for n, v in placebo.left.items()
        if n not in ("none", "unknown", "parameter_shift", named)
    }
    text = (
        f"On the rows they were fitted to, {short_name(named)} removes "
        f"{percent(max(placebo.shrink(named), 0.0))} of the misfit"
    )
    if wrong:
        runner = min(wrong, key=lambda n: wrong[n])
        text += (
            f", and the best single effect besides, {short_name(runner)}, "
            f"{percent(max(placebo.shrink(runner), 0.0))}"
        )
    if "unknown" in placebo.left and named != "unknown":
        text += (
            ". Something unlisted, which is free to follow whatever is there, removes "
            f"{percent(max(placebo.shrink('unknown'), 0.0))}"
        )
    if "none" in placebo.left:
        text += (
            f". Without any effect, {short_name('none')}, "
            f'{percent(max(placebo.shrink("none"), 0.0))} go: the line "simulator" is the model '
            "as the laboratory alone calibrated it, and every hypothesis, that of no gap too, "
            "estimates the model's parameters anew from both campaigns, which lets those that the "
            "laboratory left uncertain follow the field. What an effect adds to that is its own"
        )
    return (
        f"{text}. Any hypothesis with free parameters removes something, a wrong one too, so the "
        "distance between the diamond and the rest is what counts, not the percentage. Where that "
        "is small, causes are told apart by what their sizes and numbers cost, not by the fit; "
        "noise alone would leave "
        f"{short(1.0)}."
    )


def isolability_plate(found: Diagnosis) -> Plate | None:
    """Draw the likeness of effects, what parameters absorb, and detectable sizes."""
    design = found.ranking.identifiability
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


def _matrix(ax: Axes, design: Identifiability, names: list[str], words: list[str]) -> None:
    n = len(names)
    cosine = np.full((n, n), np.nan)
    for i, a in enumerate(names):
        for j, b in enumerate(names[:i]):
            cosine[i, j] = design.cosine_similarity.get(_key(a, b), np.nan)
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


def _ordered(design: Identifiability) -> list[str]:
    """Names with those that look alike beside each other."""
    names = sorted(design.absorbed)
    if len(names) < 3:
        return names
    distance = np.zeros((len(names), len(names)))
    for i, a in enumerate(names):
        for j, b in enumerate(names[:i]):
            cosine = design.cosine_similarity.get((b, a), 0.0)
            distance[i, j] = distance[j, i] = np.clip(1.0 - cosine, 0.0, 2.0)
    tree = linkage(squareform(distance, checks=False), "average", optimal_ordering=True)
    return [names[i] for i in leaves_list(tree)]


def _design_caption(design: Identifiability) -> str:
    alike = sorted(design.alike, key=lambda pair: -design.cosine_similarity[pair])
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


type _Draw = Callable[[Diagnosis], Plate | None]

_DRAWINGS: dict[str, _Draw] = {
    "isolability": isolability_plate,
    "where": where_plate,
    "where_conditions": conditions_plate,
    "which": which_plate,
    "how_far": how_far_plate,
    "placebo": placebo_plate,
    "left_over": left_over_plate,
}


GAP_FIGURES = tuple(_DRAWINGS)


def gap_plates(found: Diagnosis, names: Sequence[str] = GAP_FIGURES) -> list[Plate]:
    """Draw the figures of a diagnosis.

    Parameters
    ----------
    names : sequence of str, optional
        Of those to draw; all by default.

    Returns
    -------
    list of Plate
        In reading order. A figure that failed has ``figure=None`` and a caption saying why.
    """
    plates = draw_all({name: partial(_DRAWINGS[name], found) for name in names})
    return marked(plates, found.data.case.label)


# Letters of a name in one line, and their mean width.
_LINE = 27
_MM_PER_LETTER = 1.45
