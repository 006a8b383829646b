"""Score a blind test: diagnoses against the sealed key, per tier, with intervals."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.stats import beta

from calib.batch.tasks import read_seconds
from calib.errors import CalibError
from challenge.answers import FAILED, CaseAnswer, auc, read_answer
from challenge.design import TIERS
from challenge.mechanism import NONE, UNKNOWN
from challenge.results import check_results
from challenge.seal import open_answers

type Array = NDArray[np.float64]

_BINS = 10


@dataclass(frozen=True)
class Proportion:
    """A share with its Jeffreys 95 % interval.

    Attributes
    ----------
    successes, n : int
        How many of how many.
    """

    successes: int
    n: int

    @property
    def value(self) -> float:
        """The share; NaN of nothing."""
        return self.successes / self.n if self.n else float("nan")

    @property
    def interval(self) -> tuple[float, float]:
        """Jeffreys 95 % interval, closed at the ends where all or none succeed [1]_.

        References
        ----------
        .. [1] L. D. Brown, T. T. Cai, A. DasGupta, Statistical Science 16 (2001) 101-133,
           doi 10.1214/ss/1009213286.
        """
        if not self.n:
            return 0.0, 1.0
        a, b = self.successes + 0.5, self.n - self.successes + 0.5
        low = 0.0 if self.successes == 0 else float(beta.ppf(0.025, a, b))
        high = 1.0 if self.successes == self.n else float(beta.ppf(0.975, a, b))
        return low, high


@dataclass(frozen=True)
class Average:
    """A mean or a median with the spread of its sampling.

    Attributes
    ----------
    value : float
        NaN of nothing.
    interval : tuple of float
        95 % bootstrap interval.
    n : int
        Number of values.
    """

    value: float
    interval: tuple[float, float]
    n: int


@dataclass(frozen=True)
class ReliabilityBin:
    """Cases whose first hypothesis has a probability in one range.

    Attributes
    ----------
    low, high : float
        The range.
    confidence : float
        Mean probability of the first hypothesis; NaN of nothing.
    correct : Proportion
        How many were right.
    """

    low: float
    high: float
    confidence: float
    correct: Proportion


@dataclass(frozen=True)
class TierScore:
    """Figures of merit of one tier.

    ``top_1``, ``top_2`` and ``truth_probability`` are over the cases with a gap; the
    ``*_all`` figures have the nulls in them as well.

    Attributes
    ----------
    tier : str
        Name.
    n_cases, n_failed : int
        Cases, and those without a readable diagnosis (they count as wrong everywhere).
    top_1, top_2, top_1_all, top_2_all : Proportion
        Truth first, or among the first two.
    truth_probability, truth_probability_all : Average
        Mean probability of the truth.
    false_alarm : Proportion
        Nulls with a verdict other than none.
    unlisted_recognised : Proportion
        Unlisted effects with the verdict unknown or ambiguous.
    listed_called_unknown : Proportion
        Named effects and parameter shifts with the verdict unknown.
    confidently_wrong : Proportion
        Cases with a wrong hypothesis at 0.9 or more.
    localisation_auc : Average
        Median over cases with a gap in some rows and none in others.
    shrink_coverage : Proportion
        Outputs with a gap and a stated interval whose actual shrink lies within.
    no_shrink_interval : Proportion
        Outputs with a gap for which no interval was stated.
    actual_shrink : Average
        Median over outputs with a gap.
    told_apart : Average
        Over cases with a gap, the probability to choose the truth rather than its nearest rival
        for one who knows what both do on the design: how often the truth could be first if its
        nearest rival were all there is.
    brier : Average
        Mean multi-class Brier score, 0 (best) to 2.
    reliability : tuple of ReliabilityBin
        Ten ranges of confidence.
    included, wrongly_included : Proportion
        Causes that act by 1.25 noise sds or more, and those that do not act at all, with a
        probability to act of 0.5 or more. The remainder is none of either.
    inclusion_auc, inclusion_brier, inclusion_error : Average
        Of those probabilities: area under the ROC curve, mean squared miss, and expected
        calibration error in ten bins.
    share_coverage : Proportion
        Of the acting, those whose 90 % interval of the share holds the true one.
    by_itself : dict of str to float
        What ``top_1``, ``confidently_wrong``, ``included`` and ``wrongly_included`` would be, on
        average, if every stated probability were exactly right. Figures like these with a level
        that is missed say that the cases do not tell more than what is believed beforehand allows;
        worse figures say that the diagnosis is too sure of itself.
    """

    tier: str
    n_cases: int
    n_failed: int
    top_1: Proportion
    top_2: Proportion
    top_1_all: Proportion
    top_2_all: Proportion
    truth_probability: Average
    truth_probability_all: Average
    false_alarm: Proportion
    unlisted_recognised: Proportion
    listed_called_unknown: Proportion
    confidently_wrong: Proportion
    localisation_auc: Average
    shrink_coverage: Proportion
    no_shrink_interval: Proportion
    actual_shrink: Average
    told_apart: Average
    brier: Average
    reliability: tuple[ReliabilityBin, ...]
    included: Proportion
    wrongly_included: Proportion
    inclusion_auc: Average
    inclusion_brier: Average
    inclusion_error: Average
    share_coverage: Proportion
    by_itself: dict[str, float]


@dataclass(frozen=True)
class Score:
    """A scored blind test.

    Attributes
    ----------
    tiers : dict
        Tier to its figures.
    answers : tuple of CaseAnswer
        Every case of the key, failed ones included.
    warnings : tuple of str
        What could not be made sure of.
    seconds : mapping of str to float
        How long each case took, where that was recorded.
    """

    tiers: dict[str, TierScore]
    answers: tuple[CaseAnswer, ...]
    warnings: tuple[str, ...] = ()
    seconds: Mapping[str, float] = field(default_factory=dict)


def share_of[T](answers: Iterable[T], hit: Callable[[T], bool]) -> Proportion:
    """Return how many of some answers are hits."""
    hits = [hit(answer) for answer in answers]
    return Proportion(sum(hits), len(hits))


def average(values: list[float], statistic: Callable[..., np.ndarray]) -> Average:
    """Return a statistic with a bootstrap interval, the same for the same values."""
    if not values:
        return Average(float("nan"), (float("nan"), float("nan")), 0)
    data, rng = np.array(values), np.random.default_rng(0)
    again = statistic(data[rng.integers(0, data.size, (2000, data.size))], axis=1)
    low, high = (float(q) for q in np.quantile(again, [0.025, 0.975]))
    return Average(float(statistic(data)), (low, high), len(values))


def over(stated: Array, statistic: Callable[[Array], float]) -> Average:
    """Return a statistic of columns (probability, outcome) with a bootstrap interval."""
    n = stated.shape[1]
    if not n:
        return average([], np.mean)
    rng = np.random.default_rng(0)
    again = [statistic(stated[:, rng.integers(0, n, n)]) for _ in range(400)]
    again = [value for value in again if value == value] or [float("nan")]
    low, high = (float(q) for q in np.quantile(again, [0.025, 0.975]))
    return Average(statistic(stated), (low, high), n)


def _auc(stated: Array) -> float:
    found = auc(stated[0], stated[1] > 0.5)
    return float("nan") if found is None else found


def calibration_error(stated: Array) -> float:
    """Mean distance of stated probability and frequency over ten bins, weighted by their counts."""
    place = np.minimum((stated[0] * _BINS).astype(int), _BINS - 1)
    sums = [np.bincount(place, weights=s, minlength=_BINS) for s in stated]
    return float(np.abs(sums[0] - sums[1]).sum() / stated.shape[1])


def _reliability(answers: list[CaseAnswer]) -> tuple[ReliabilityBin, ...]:
    edges = np.linspace(0.0, 1.0, _BINS + 1)
    bins = []
    for i in range(_BINS):
        inside = [a for a in answers if min(int(a.confidence * _BINS), _BINS - 1) == i]
        mean = float(np.mean([a.confidence for a in inside])) if inside else float("nan")
        correct = share_of(inside, lambda a: a.called in a.right)
        bins.append(ReliabilityBin(float(edges[i]), float(edges[i + 1]), mean, correct))
    return tuple(bins)


def _by_itself(answers: list[CaseAnswer], stated: Array) -> dict[str, float]:
    """Work out what figures would be if stated probabilities were right; NaN of nothing."""

    def share(part: Array, whole: Array) -> float:
        return float(part.sum() / whole.sum()) if whole.sum() > 0.0 else float("nan")

    first = np.array([a.confidence for a in answers if a.ranked])
    gaps = [a for a in answers if a.truth != NONE and a.ranked]
    some = np.array([1.0 - dict(a.ranked).get(NONE, 0.0) for a in gaps])
    best = np.array([0.0 if a.called == NONE else a.confidence for a in gaps])
    p, in_it = stated[0], stated[0] >= 0.5
    return {
        "top_1": share(best[some > 0.0] / some[some > 0.0], np.ones(len(gaps))),
        "confidently_wrong": share((1.0 - first)[first >= 0.9], np.ones(first.size)),
        "included": share(p[in_it], p),
        "wrongly_included": share(1.0 - p[in_it], 1.0 - p),
    }


def score_tier(tier: str, answers: list[CaseAnswer]) -> TierScore:
    """Return the figures of merit of one tier.

    Parameters
    ----------
    tier : str
        Name.
    answers : list of CaseAnswer
        All its cases.
    """
    nulls = [a for a in answers if a.truth == NONE]
    gaps = [a for a in answers if a.truth != NONE]
    unlisted = [a for a in gaps if a.truth == UNKNOWN]
    listed = [a for a in gaps if a.truth != UNKNOWN]
    shrinks = [s for a in gaps for s in a.shrinks]
    stated = [s for s in shrinks if s.interval is not None]
    causes = [c for a in answers for c in a.causes if c.name != UNKNOWN and c.acts is not None]
    acting, absent = ([c for c in causes if c.acts is acts] for acts in (True, False))
    stating = np.array([[c.probability for c in causes], [bool(c.acts) for c in causes]])
    return TierScore(
        tier=tier,
        n_cases=len(answers),
        n_failed=sum(a.verdict == FAILED for a in answers),
        top_1=share_of(gaps, lambda a: a.among_first(1)),
        top_2=share_of(gaps, lambda a: a.among_first(2)),
        top_1_all=share_of(answers, lambda a: a.among_first(1)),
        top_2_all=share_of(answers, lambda a: a.among_first(2)),
        truth_probability=average([a.truth_probability for a in gaps], np.mean),
        truth_probability_all=average([a.truth_probability for a in answers], np.mean),
        false_alarm=share_of(nulls, lambda a: a.verdict != NONE),
        unlisted_recognised=share_of(unlisted, lambda a: a.verdict in (UNKNOWN, "ambiguous")),
        listed_called_unknown=share_of(listed, lambda a: a.verdict in (UNKNOWN, FAILED)),
        confidently_wrong=share_of(answers, lambda a: a.confidently_wrong()),
        localisation_auc=average([a.auc for a in gaps if a.auc is not None], np.median),
        shrink_coverage=Proportion(sum(s.covered for s in stated), len(stated)),
        no_shrink_interval=Proportion(len(shrinks) - len(stated), len(shrinks)),
        actual_shrink=average([s.actual for s in shrinks], np.median),
        told_apart=average([a.told_apart for a in gaps if a.told_apart is not None], np.mean),
        brier=average([a.brier for a in answers], np.mean),
        reliability=_reliability([a for a in answers if a.ranked]),
        included=Proportion(sum(c.probability >= 0.5 for c in acting), len(acting)),
        wrongly_included=Proportion(sum(c.probability >= 0.5 for c in absent), len(absent)),
        inclusion_auc=over(stating, _auc),
        inclusion_brier=over(stating, lambda s: float(np.mean((s[0] - s[1]) ** 2))),
        inclusion_error=over(stating, calibration_error),
        share_coverage=share_of([c for c in acting if c.share == c.share], lambda c: c.covered),
        by_itself=_by_itself(answers, stating),
    )


def score(
    cases_dir: Path, results_dir: Path, answers_dir: Path, outputs: Collection[str] = ()
) -> Score:
    """Score the diagnoses of a blind test.

    Parameters
    ----------
    cases_dir : Path
        Folder with a folder for each case.
    results_dir : Path
        Folder with ``<case>/diagnosis.json`` and ``<case>/fresh_prediction.csv``.
    answers_dir : Path
        Folder with ``<case>/answer.json``.
    outputs : collection of str
        Score the cases that measure these and no others; all cases by default.

    Raises
    ------
    CalibError
        If no case measures these outputs, an answer does not match the hash in its case, there is
        no diagnosis, or diagnoses are of other cases.
    """
    known = open_answers(cases_dir, answers_dir)
    warnings = check_results(cases_dir, results_dir, sorted(known))
    answers = [read_answer(name, known[name], results_dir / name) for name in sorted(known)]
    if rest := {path.parent.name for path in cases_dir.glob("*/case.toml")} - {*known}:
        warnings += (f"{len(rest)} cases have no answer and are not scored, one is {min(rest)}",)
    if outputs:
        there = sorted({",".join(sorted(a.outputs)) for a in answers})
        answers = [a for a in answers if set(a.outputs) == set(outputs)]
        if not answers:
            raise CalibError(
                f"no case measures {' and '.join(outputs)} alone", where=str(cases_dir),
                expected="; ".join(there), hint="name the outputs of some cases, or leave them out",
            )  # fmt: skip
    tiers = {tier: [a for a in answers if a.tier == tier]
             for tier in dict.fromkeys([*TIERS, *(a.tier for a in answers)])}  # fmt: skip
    return Score(
        tiers={tier: score_tier(tier, part) for tier, part in tiers.items() if part},
        answers=tuple(answers),
        warnings=warnings,
        seconds=read_seconds(results_dir),
    )
