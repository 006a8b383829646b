"""The score as text: every figure with its interval, its count and the level asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from calib.challenge.answers import CaseAnswer
from calib.challenge.levels import LEVELS, Level
from calib.challenge.limit import Limit, rms_error
from calib.challenge.mechanism import DENSITY, NONE, SHIFT, UNKNOWN
from calib.challenge.score import Average, Proportion, Score, TierScore

_EXTRA = (
    ("top_1_all", "right hypothesis first, nulls included"),
    ("truth_probability_all", "mean probability of the truth, nulls included"),
    ("told_apart", "truth told from its nearest rival alone"),
    ("no_shrink_interval", "outputs with a gap without a shrink interval"),
    ("brier", "Brier score (0 best, 2 worst)"),
)


def _figure(tier: TierScore, name: str) -> Proportion | Average:
    figure: Proportion | Average = getattr(tier, name)
    return figure


def asked(level: Level, tier: str) -> str:
    """Return a level in words."""
    low, high = level.limits(tier)
    if level.direction == 0:
        return f"{low:.2f}-{high:.2f}"
    return f">= {low:.2f}" if level.direction > 0 else f"<= {high:.2f}"


def _span(figure: Proportion | Average) -> str:
    low, high = figure.interval
    return f"[{low:.2f}, {high:.2f}]"


def _line(label: str, figure: Proportion | Average, asked_for: str, limit: str, mark: str) -> str:
    count = f"{figure.successes}/{figure.n}" if isinstance(figure, Proportion) else f"n={figure.n}"
    value, span = (f"{figure.value:6.3f}", _span(figure)) if figure.n else ("-", "")
    mark = mark if figure.n else ""
    return f"  {label:<47} {value:>6} {span:>14} {count:>8}  {asked_for:>10} {limit} {mark}"


def _of_limit(limit: TierScore | None, name: str) -> str:
    """Return the oracle's figure; empty where it has none, or there is no oracle."""
    if limit is None:
        return ""
    figure = _figure(limit, name)
    return f"{figure.value:6.3f} {_span(figure):>14}" if figure.n else f"{'-':>6} {'':>14}"


def tier_table(tier: TierScore, limit: TierScore | None = None) -> str:
    """Return one tier's table.

    Parameters
    ----------
    tier : TierScore
        What was reached.
    limit : TierScore, optional
        What the oracle reached on the same cases.
    """
    lines = [f"{tier.tier}: {tier.n_cases} cases, {tier.n_failed} failed"]
    head = f"  {'':<47} {'value':>6} {'95 % interval':>14} {'count':>8}  {'asked':>10}"
    lines.append(head + (f" {'limit':>6} {'95 % interval':>14}" if limit else ""))
    for level in LEVELS:
        figure = _figure(tier, level.name)
        mark = level.mark(tier.tier, figure)
        beside = _of_limit(limit, level.name)
        lines.append(_line(level.label, figure, asked(level, tier.tier), beside, mark))
    for name, label in _EXTRA:
        lines.append(_line(label, _figure(tier, name), "", _of_limit(limit, name), ""))
    return "\n".join(line.rstrip() for line in lines)


def _kind(answer: CaseAnswer) -> str:
    if answer.truth in (NONE, SHIFT, UNKNOWN):
        return {NONE: "no gap", SHIFT: "parameter shift", UNKNOWN: "unlisted"}[answer.truth]
    return "two listed effects" if "+" in answer.truth else "one listed effect"


_KINDS = ("no gap", "one listed effect", "parameter shift", "unlisted", "two listed effects")


def _row(label: str, reached: list[CaseAnswer], limit: list[CaseAnswer]) -> str:
    cells = []
    for answers in (reached, limit):
        first = sum(a.among_first(1) for a in answers)
        mean = sum(a.truth_probability for a in answers) / len(answers)
        cells.append(f"{first / len(answers):7.2f} {first:>4}/{len(answers):<4} {mean:6.2f}")
    return f"  {label:<32} " + "   ".join(cells)


def kinds_table(answers: Iterable[CaseAnswer], limit: Limit) -> str:
    """Return, by what was true, how often it was named first, by the diagnosis and the oracle.

    Parameters
    ----------
    answers : iterable of CaseAnswer
        Of the diagnosis.
    limit : Limit
        Of the same cases.
    """
    every = list(answers)
    lines = [
        f"  {'':<32} {'reached':>7} {'':>9} {'mean p':>6}   {'limit':>7} {'':>9} {'mean p':>6}"
    ]

    def add(label: str, chosen: Callable[[CaseAnswer], bool]) -> None:
        part = [a for a in every if chosen(a)]
        if part:
            lines.append(_row(label, part, [limit.answers[a.case] for a in part]))

    for tier in sorted({a.tier for a in every}):
        for kind in _KINDS:
            for density in (False, True):
                label = f"{tier}, {kind}" + (", density" if density else "")
                add(
                    label,
                    lambda a, t=tier, k=kind, d=density: (  # type: ignore[misc]
                        (a.tier, _kind(a), DENSITY in a.outputs) == (t, k, d)
                    ),
                )
    return "\n".join(lines)


def outputs_table(answers: Iterable[CaseAnswer]) -> str:
    """Return how the truth fared where there is a gap, by the outputs that are measured.

    Parameters
    ----------
    answers : iterable of CaseAnswer
    """
    parts: dict[tuple[str, tuple[str, ...]], list[CaseAnswer]] = {}
    for answer in answers:
        if answer.truth != NONE:
            parts.setdefault((answer.tier, answer.outputs), []).append(answer)
    lines = [f"  {'':<47} {'first':>16} {'first two':>16} {'mean p':>7}"]
    for (tier, outputs), part in sorted(
        parts.items(), key=lambda item: (item[0][0], -len(item[1]))
    ):
        label = f"{tier}, {' and '.join(name.replace('_', ' ') for name in outputs)}"
        cells = []
        for count in (1, 2):
            right = sum(a.among_first(count) for a in part)
            cells.append(f"{right / len(part):8.3f} {f'{right}/{len(part)}':>7}")
        mean = sum(a.truth_probability for a in part) / len(part)
        lines.append(f"  {label:<47} {' '.join(cells)} {mean:7.3f}")
    return "\n".join(lines)


def _limit_notes(limit: Limit, tiers: Iterable[str]) -> list[str]:
    lines = [
        "limit: the oracle, Bayes' theorem by one who knows how the cases were made, the soil's",
        "numbers but by prior and lab. No method names the truth first more often in expectation.",
        f"Monte Carlo error of the truth's probability, rms over cases: {rms_error(limit):.4f}.",
    ]
    for tier in tiers:
        known = limit.tier_known_soil(tier)
        lines.append(
            f"{tier}: the oracle expects {limit.expected_first(tier):.3f} first by its own "
            f"probabilities; knowing the soil itself it names {known.top_1.value:.3f} first, mean "
            f"probability {known.truth_probability.value:.3f}."
        )
    return lines


def text_table(score: Score, limit: Limit | None = None) -> str:
    """Return the table of all tiers, and the cases that failed.

    Parameters
    ----------
    score : Score
        From `calib.challenge.score.score`.
    limit : Limit, optional
        Shown beside every figure, and by what was true.
    """
    parts = [
        tier_table(tier, limit.tier(name) if limit else None) for name, tier in score.tiers.items()
    ]
    if limit is not None:
        parts.append("\n".join(_limit_notes(limit, score.tiers)))
        parts.append("truth named first, by what was true:\n" + kinds_table(score.answers, limit))
    if len({a.outputs for a in score.answers if a.truth != NONE}) > 1:
        parts.append("cases with a gap, by what is measured:\n" + outputs_table(score.answers))
    failed = [f"  {a.case}: {a.problem}" for a in score.answers if a.problem]
    if failed:
        parts.append("\n".join(["without a readable diagnosis, counted as wrong:", *failed]))
    return "\n\n".join(parts)
