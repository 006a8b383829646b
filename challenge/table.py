"""The score as text: every figure with its interval, its count and the level asked for."""

from __future__ import annotations

from challenge.levels import LEVELS, Level
from challenge.score import Average, Proportion, Score, TierScore

_EXTRA = (
    ("top_1_all", "right hypothesis first, nulls included"),
    ("truth_probability_all", "mean probability of the truth, nulls included"),
    ("told_apart", "truth told from its nearest rival alone"),
    ("no_shrink_interval", "outputs with a gap without a shrink interval"),
    ("brier", "Brier score (0 best, 2 worst)"),
    ("inclusion_auc", "inclusion, area under the ROC curve"),
    ("inclusion_brier", "inclusion, mean squared miss"),
)


def _figure(tier: TierScore, name: str) -> Proportion | Average:
    figure: Proportion | Average = getattr(tier, name)
    return figure


def asked(level: Level, tier: str) -> str:
    """Return a level in words."""
    low, high = level.limits(tier)
    if low != low:
        return "-"
    if level.direction == 0:
        return f"{low:.2f}-{high:.2f}"
    return f">= {low:.2f}" if level.direction > 0 else f"<= {high:.2f}"


def _span(figure: Proportion | Average) -> str:
    low, high = figure.interval
    return f"[{low:.2f}, {high:.2f}]"


def _line(
    label: str, figure: Proportion | Average, asked_for: str = "", mark: str = "", own: str = ""
) -> str:
    count = f"{figure.successes}/{figure.n}" if isinstance(figure, Proportion) else f"n={figure.n}"
    value, span = (f"{figure.value:6.3f}", _span(figure)) if figure.n else ("-", "")
    mark = mark if figure.n else ""
    return f"  {label:<47} {value:>6} {span:>14} {count:>8} {own:>9}  {asked_for:>10}  {mark}"


def tier_table(tier: TierScore) -> str:
    """Return one tier's table.

    Parameters
    ----------
    tier : TierScore
    """
    lines = [
        f"{tier.tier}: {tier.n_cases} cases, {tier.n_failed} failed",
        f"  {'':<47} {'value':>6} {'95 % interval':>14} {'count':>8} {'by itself':>9}  "
        f"{'asked':>10}",
    ]
    for level in LEVELS:
        figure = _figure(tier, level.name)
        mark, own = level.mark(tier.tier, figure), tier.by_itself.get(level.name)
        lines.append(_line(level.label, figure, asked(level, tier.tier), mark,
                           "" if own is None or own != own else f"{own:.3f}"))  # fmt: skip
    lines += [_line(label, _figure(tier, name)) for name, label in _EXTRA]
    lines.append("  by itself: what it would be if every stated probability were exactly right")
    return "\n".join(line.rstrip() for line in lines)


def text_table(score: Score) -> str:
    """Return the table of all tiers, and the cases that failed.

    Parameters
    ----------
    score : Score
        From `challenge.score.score`.
    """
    parts = [tier_table(tier) for tier in score.tiers.values()]
    failed = [f"  {a.case}: {a.problem}" for a in score.answers if a.problem]
    if failed:
        parts.append("\n".join(["without a readable diagnosis, counted as wrong:", *failed]))
    return "\n\n".join(parts)
