"""One case's diagnosis held against its key: what was said, and how right it was."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr
from scipy.stats import rankdata

from calib.batch.tasks import failed_tasks
from calib.data.documents import read_numbers
from calib.data.quantities import OUTPUTS
from calib.errors import CalibError
from challenge.format import (
    Acting,
    Answer,
    Explanation,
    Scored,
    prediction_columns,
    read_document,
)
from challenge.mechanism import NONE, SHIFT, UNKNOWN

type Array = NDArray[np.float64]

FAILED = "failed"
# Below one noise sd there is no gap on an output whose shrink would mean anything.
GAP_ON_OUTPUT = 1.0
# A cause that adds less than so many noise sds (rms) need not be found.
ASKED_FOR = 1.25


@dataclass(frozen=True)
class ShrinkAnswer:
    """One output's shrink.

    Attributes
    ----------
    output : str
        Name of the output.
    actual : float
        1 - rmse(after) / rmse(before) against the truth on the test conditions; 0 without
        a readable prediction.
    interval : tuple of float, optional
        The stated 90 % interval; None where none was given.
    """

    output: str
    actual: float
    interval: tuple[float, float] | None

    @property
    def covered(self) -> bool:
        """Whether the stated interval holds the actual shrink."""
        return self.interval is not None and self.interval[0] <= self.actual <= self.interval[1]


@dataclass(frozen=True)
class Prediction:
    """One output at the rows that were left out.

    Attributes
    ----------
    output : str
        Name of the output.
    before, after : float
        Rms misses of the simulator and of the corrected one, in sds of the true values there.
        Without a prediction 1, what their mean would miss by, and NaN before.
    """

    output: str
    before: float = float("nan")
    after: float = 1.0


@dataclass(frozen=True)
class CauseAnswer:
    """One cause of one case.

    Attributes
    ----------
    name : str
        Of a listed effect or another cause that was considered; ``unknown`` for what is unlisted.
    probability : float
        That it acts, as stated.
    contribution : float
        To the true gap, in noise sds; 0 where it does not act, infinite where it acts by nobody
        knows how much, NaN where nobody knows whether it acts.
    share : float
        Its true part of the gap; NaN where nobody knows.
    interval : tuple of float
        The stated 90 % interval of that.
    """

    name: str
    probability: float
    contribution: float
    share: float
    interval: tuple[float, float]

    @property
    def acts(self) -> bool | None:
        """Whether it acts; None where what it does is too little to be asked for."""
        if np.isnan(self.contribution) or 0.0 < self.contribution < ASKED_FOR:
            return None
        return self.contribution > 0.0

    @property
    def covered(self) -> bool:
        """Whether the stated interval holds the true share."""
        return self.interval[0] <= self.share <= self.interval[1]


@dataclass(frozen=True)
class CaseAnswer:
    """What was said of one case and what was true.

    Attributes
    ----------
    case, tier, truth : str
        From the key.
    verdict : str
        As stated; ``failed`` without a readable diagnosis.
    ranked : tuple of (str, float)
        Hypotheses and probabilities, the most probable first.
    auc : float, optional
        Of the stated probabilities against true gaps beyond the noise; None where all rows
        or no rows have one.
    shrinks : tuple of ShrinkAnswer
        For each output with a true gap.
    outputs : tuple of str
        That were measured.
    problem : str
        Why the case failed, empty otherwise.
    told_apart : float, optional
        Probability that one who knows the truth and its nearest rival, both equally probable, and
        what each does on this design, chooses the truth (linearised); None where nobody worked
        that out.
    causes : tuple of CauseAnswer
        Every cause that was considered or acts.
    defensible : tuple of str
        Causes that are no wrong answer either.
    predictions : tuple of Prediction
        Of every output that is known, and varies, at rows that were left out.
    """

    case: str
    tier: str
    truth: str
    verdict: str
    ranked: tuple[tuple[str, float], ...]
    auc: float | None
    shrinks: tuple[ShrinkAnswer, ...]
    outputs: tuple[str, ...]
    problem: str = ""
    told_apart: float | None = None
    causes: tuple[CauseAnswer, ...] = ()
    defensible: tuple[str, ...] = ()
    predictions: tuple[Prediction, ...] = ()

    @property
    def called(self) -> str:
        """The most probable hypothesis."""
        return self.ranked[0][0] if self.ranked else FAILED

    @property
    def confidence(self) -> float:
        """Its probability."""
        return self.ranked[0][1] if self.ranked else 0.0

    @property
    def right(self) -> frozenset[str]:
        """What counts as the truth: without weak causes or with defensible ones, or only these."""
        weak = {c.name for c in self.causes if 0.0 < c.contribution < ASKED_FOR}
        causes = {*self.truth.split("+")} - {NONE}
        names = _unions(causes - weak, (weak & causes) | {*self.defensible})
        return (names | _unions(set(), self.defensible) | {self.truth}) - {""}

    @property
    def truth_probability(self) -> float:
        """Probability given to the truth."""
        return min(sum(p for name, p in self.ranked if name in self.right), 1.0)

    def among_first(self, count: int) -> bool:
        """Whether the truth is among the first hypotheses."""
        return any(name in self.right for name, _ in self.ranked[:count])

    @property
    def brier(self) -> float:
        """Sum over hypotheses of the squared miss of the probability; 1 for a failed case."""
        others = sum(p**2 for name, p in self.ranked if name not in self.right)
        return others + (1.0 - self.truth_probability) ** 2

    def confidently_wrong(self, at: float = 0.9) -> bool:
        """Whether a wrong hypothesis has at least this probability."""
        return any(p >= at for name, p in self.ranked if name not in self.right)


def _unions(whole: Collection[str], parts: Collection[str]) -> frozenset[str]:
    """Return the names of sets that have all of some causes, and any of others."""
    chosen = (combinations(parts, n) for n in range(len(parts) + 1))
    return frozenset("+".join(sorted({*whole, *some})) for each in chosen for some in each)


def auc(score: Array, positive: NDArray[np.bool_]) -> float | None:
    """Return the area under the ROC curve by ranks, ties shared; None with one class only.

    Parameters
    ----------
    score : array
        Shape ``(M,)``.
    positive : array of bool
        Shape ``(M,)``.
    """
    n_positive = int(positive.sum())
    n_negative = positive.size - n_positive
    if n_positive == 0 or n_negative == 0:
        return None
    ranks = np.asarray(rankdata(score), dtype=np.float64)
    excess = ranks[positive].sum() - n_positive * (n_positive + 1) / 2.0
    return float(excess / (n_positive * n_negative))


def _true_gap(answer: Answer, output: str) -> Array:
    truth, without = (np.array(v[output]) for v in (answer.field_truth, answer.field_without))
    return np.asarray(truth - without, dtype=np.float64)


def _localisation(answer: Answer, diagnosis: Scored | None) -> float | None:
    """Return the AUC over all rows and outputs; rows that were left out count as probability 0."""
    where = diagnosis.where if diagnosis else ()
    said = {(item.output, item.row): item.probability for item in where}
    scores, positives = [np.zeros(0)], [np.zeros(0, dtype=np.bool_)]
    for output, sd in answer.noise_sd.items():
        beyond = np.abs(_true_gap(answer, output)) > np.array(sd)
        positives.append(beyond)
        scores.append(np.array([said.get((output, row), 0.0) for row in range(beyond.size)]))
    return auc(np.concatenate(scores), np.concatenate(positives))


def _misses(answer: Answer, output: str, predicted: Mapping[str, Array]) -> tuple[float, float]:
    """Return the rms misses before and after at the rows that were left out; NaN without."""
    truth, column = np.array(answer.fresh_truth[output]), OUTPUTS[output]
    pair = (predicted.get(f"{column}_{when}") for when in ("before", "after"))
    before, after = (
        float("nan") if p is None else float(np.sqrt(np.mean((p - truth) ** 2))) for p in pair
    )
    return before, after


def _prediction(answer: Answer, output: str, predicted: Mapping[str, Array]) -> Prediction:
    before, after = _misses(answer, output, predicted)
    sd = float(np.std(answer.fresh_truth[output]))
    return Prediction(output) if np.isnan(after) else Prediction(output, before / sd, after / sd)


def _shrinks(
    answer: Answer, diagnosis: Scored | None, predicted: Mapping[str, Array]
) -> tuple[ShrinkAnswer, ...]:
    answers = []
    for output, sd in answer.noise_sd.items():
        gap = _true_gap(answer, output) / np.array(sd)
        if output not in answer.fresh_truth or np.sqrt(np.mean(gap**2)) < GAP_ON_OUTPUT:
            continue
        before, after = _misses(answer, output, predicted)
        said = diagnosis.shrink.get(output) if diagnosis else None
        interval = said.interval if said else None
        actual = 1.0 - after / before if before > 0.0 else 0.0
        answers.append(
            ShrinkAnswer(output, actual, None if interval is None else (interval[0], interval[1]))
        )
    return tuple(answers)


def _listed(name: str) -> str:
    """The listed causes of an explanation: those with something unlisted besides are the same."""
    causes = sorted(cause for cause in name.split("+") if cause != UNKNOWN)
    return "+".join(causes) or UNKNOWN


def _ranked(effects: list[Explanation]) -> tuple[tuple[str, float], ...]:
    total: dict[str, float] = {}
    for e in effects:
        name = _listed(e.name)
        total[name] = min(total.get(name, 0.0) + e.probability, 1.0)
    return tuple(sorted(total.items(), key=lambda item: -item[1]))


def read_answer(name: str, answer: Answer, folder: Path) -> CaseAnswer:
    """Return one case's answer; what cannot be read is a failure, never a gap in the count.

    Parameters
    ----------
    name : str
        The case.
    answer : Answer
        What is true of it.
    folder : Path
        Where its diagnosis was written.
    """
    path, diagnosis, predicted, problem = folder / "fresh_prediction.csv", None, {}, ""
    try:
        diagnosis, _ = read_document(folder / "diagnosis.json", Scored)
        if path.exists() and answer.fresh_truth:
            columns = prediction_columns(answer.fresh_truth)
            rows = len(next(iter(answer.fresh_truth.values())))
            predicted = read_numbers(path, columns, rows, missing_ok=True)
    except CalibError as error:
        diagnosis, problem = None, str(error)
        if not (folder / "diagnosis.json").exists():
            why = failed_tasks(folder.parent).get(name)
            problem = why or "not diagnosed; go on with `calib challenge run`"
    located = _localisation(answer, diagnosis)
    if diagnosis is None and located is not None:
        # A failed case locates nothing: no better than chance, on cases where there is a gap.
        located = 0.5
    return CaseAnswer(
        name, answer.tier, _listed(answer.truth), diagnosis.verdict if diagnosis else FAILED,
        _ranked(diagnosis.effects) if diagnosis else (), None if answer.truth == NONE else located,
        _shrinks(answer, diagnosis, predicted), tuple(answer.noise_sd or answer.fresh_truth),
        problem, _told_apart(answer), _causes(answer, diagnosis) if diagnosis else (),
        tuple(answer.defensible),
        tuple(_prediction(answer, output, predicted)
              for output, true in answer.fresh_truth.items() if np.ptp(true) > 0.0),
    )  # fmt: skip


def _said(diagnosis: Scored) -> dict[str, Acting]:
    """Return the probability of every cause to act: stated, or summed over explanations."""
    total: dict[str, float] = {}
    for e in diagnosis.effects:
        for name in {*e.name.split("+")} - {NONE}:
            total[name] = min(total.get(name, 0.0) + e.probability, 1.0)
    summed = {name: Acting(probability=p) for name, p in total.items()}
    if not diagnosis.inclusion:
        return summed
    rest = diagnosis.remainder or summed.get(UNKNOWN, Acting(probability=0.0))
    return {**diagnosis.inclusion, UNKNOWN: rest}


def _causes(answer: Answer, diagnosis: Scored) -> tuple[CauseAnswer, ...]:
    """Hold inclusion probabilities and shares against what truly acts."""
    told = "contributions" in answer.model_fields_set
    names = [] if answer.truth == NONE else answer.truth.split("+")
    true = answer.contributions if told else dict.fromkeys(names, float("inf"))
    if answer.truth in (UNKNOWN, SHIFT):
        true = {answer.truth: (answer.model_extra or {}).get("gap_over_noise", float("inf"))}
    true = dict.fromkeys(answer.defensible, float("nan")) | true
    said, total = _said(diagnosis), sum(true.values())
    nothing = Acting(probability=0.0)
    found = []
    for name in dict.fromkeys([*said, *true]):
        one, size = said.get(name, nothing), true.get(name, 0.0)
        low, high = one.share_interval or (0.0, 0.0)
        share = size / total if np.isfinite(total) and total else 0.0 * total
        found.append(CauseAnswer(name, one.probability, size, share, (low, high)))
    return tuple(found)


def _told_apart(answer: Answer) -> float | None:
    """Two laws whose means lie d noise sds apart are told apart with probability Phi(d / 2)."""
    more = answer.model_extra or {}
    if answer.truth in (NONE, more.get("rival")) or "rival_nats" not in more:
        return None
    nats = more["rival_nats"]  # half the square of d; none without a rival
    return 1.0 if nats is None else float(ndtr(np.sqrt(0.5 * nats)))
