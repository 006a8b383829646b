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
    easy, hard, large : tuple of float
        Lower and upper limit in each tier; NaN where none is asked for.
    """

    name: str
    label: str
    direction: int
    easy: tuple[float, float]
    hard: tuple[float, float]
    large: tuple[float, float] = (float("nan"), float("nan"))

    def limits(self, tier: str) -> tuple[float, float]:
        """Return the limits in a tier; NaN where nothing is asked for."""
        known = {"easy": self.easy, "hard": self.hard, "large": self.large}
        return known.get(tier, (float("nan"), float("nan")))

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
        if lower != lower:
            return ""
        low, high = figure.interval
        if self.met(tier, figure.value):
            sure = figure.n >= _ENOUGH_TO_MEET or (lower <= low and high <= upper)
            return "met" if sure else "too few to tell"
        few = figure.n < _ENOUGH_TO_MISS and low <= upper and high >= lower
        return "too few to tell" if few or figure.n < _ENOUGH else "MISSED"


def _at_least(name: str, label: str, *levels: float) -> Level:
    return Level(name, label, 1, *((level, 1.0) for level in levels))


def _at_most(name: str, label: str, *levels: float) -> Level:
    return Level(name, label, -1, *((0.0, level) for level in levels))


_BAND = (0.85, 0.95)
LEVELS: tuple[Level, ...] = (
    _at_least("top_1", "right hypothesis first", 0.97, 0.82, 0.95),
    _at_least("top_2", "right hypothesis among the first two", 0.98, 0.88),
    _at_least("truth_probability", "mean probability of the truth", 0.90, 0.65),
    _at_most("false_alarm", "verdict other than none on nulls", 0.02, 0.02),
    _at_least("unlisted_recognised", "unlisted effect called unknown or ambiguous", 0.90, 0.75),
    _at_most("listed_called_unknown", "listed effect called unknown", 0.02, 0.08),
    _at_most("confidently_wrong", "a wrong hypothesis at 0.9 or more", 0.005, 0.02, 0.01),
    _at_least("included", "an acting cause has inclusion of 0.5 or more", 0.98, 0.88, 0.97),
    _at_most("wrongly_included", "an absent cause has inclusion of 0.5 or more", 0.01, 0.03, 0.03),
    _at_most("inclusion_error", "calibration error of inclusion", 0.02, 0.03, 0.03),
    Level("share_coverage", "90 % interval of a share covers", 0, _BAND, _BAND, _BAND),
    _at_least("localisation_auc", "localisation AUC, median", 0.95, 0.95),
    Level("shrink_coverage", "90 % shrink interval covers", 0, _BAND, _BAND, _BAND),
    _at_least("actual_shrink", "actual shrink on test conditions, median", 0.75, 0.70),
)
