"""The level that a diagnosis is asked to reach, per tier and figure of merit."""

from __future__ import annotations

from dataclasses import dataclass

from challenge.score import Average, Proportion

# Fewer cases than these tell nothing; or show no level met, or missed, if their interval is wider.
_ENOUGH, _ENOUGH_TO_MEET, _ENOUGH_TO_MISS = 5, 10, 30


@dataclass(frozen=True)
class Level:
    """One line of the table of levels.

    Attributes
    ----------
    name : str
        Attribute of `challenge.score.TierScore`.
    label : str
        What it is, for people.
    direction : int
        1 where more is better, -1 where less is, 0 for a band.
    easy, hard : tuple of float
        Lower and upper limit in each tier.
    """

    name: str
    label: str
    direction: int
    easy: tuple[float, float]
    hard: tuple[float, float]

    def limits(self, tier: str) -> tuple[float, float]:
        """Return the limits in a tier."""
        return self.easy if tier == "easy" else self.hard

    def met(self, tier: str, value: float) -> bool:
        """Whether a value reaches the level; a missing value (NaN) does not."""
        low, high = self.limits(tier)
        return low <= value <= high

    def mark(self, tier: str, figure: Proportion | Average) -> str:
        """Say whether the level is met, missed, or of too few cases to tell.

        A miss of fewer than 30 cases is none while its interval reaches the level; nor is a level
        met by fewer than 10 whose interval reaches beyond it. Fewer than 5 miss nothing.
        """
        lower, upper = self.limits(tier)
        low, high = figure.interval
        if self.met(tier, figure.value):
            sure = figure.n >= _ENOUGH_TO_MEET or (lower <= low and high <= upper)
            return "met" if sure else "too few to tell"
        few = figure.n < _ENOUGH_TO_MISS and low <= upper and high >= lower
        return "too few to tell" if few or figure.n < _ENOUGH else "MISSED"


def _at_least(name: str, label: str, easy: float, hard: float) -> Level:
    return Level(name, label, 1, (easy, 1.0), (hard, 1.0))


def _at_most(name: str, label: str, easy: float, hard: float) -> Level:
    return Level(name, label, -1, (0.0, easy), (0.0, hard))


LEVELS: tuple[Level, ...] = (
    _at_least("top_1", "right hypothesis first", 0.95, 0.75),
    _at_least("top_2", "right hypothesis among the first two", 0.98, 0.88),
    _at_least("truth_probability", "mean probability of the truth", 0.90, 0.65),
    _at_most("false_alarm", "verdict other than none on nulls", 0.02, 0.03),
    _at_least("unlisted_recognised", "unlisted effect called unknown or ambiguous", 0.90, 0.75),
    _at_most("listed_called_unknown", "listed effect called unknown", 0.02, 0.08),
    _at_most("confidently_wrong", "a wrong hypothesis at 0.9 or more", 0.01, 0.03),
    _at_least("localisation_auc", "localisation AUC, median", 0.95, 0.95),
    Level("shrink_coverage", "90 % shrink interval covers", 0, (0.83, 0.96), (0.83, 0.96)),
    _at_least("actual_shrink", "actual shrink on fresh conditions, median", 0.75, 0.70),
)
