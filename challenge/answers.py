"""One case's diagnosis held against its key: what was said, and how right it was."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import compress, product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr
from scipy.stats import rankdata

from challenge.files import OUTPUT_COLUMNS
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
class CauseAnswer:
    """One cause of one case.

    Attributes
    ----------
    name : str
        Of a listed effect or another cause that was considered; ``unknown`` for what is unlisted.
    probability : float
        That it acts, as stated.
    contribution : float
        To the true gap, in noise sds; 0 where it does not act.
    share : float
        Its true part of the gap.
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
        return self.contribution > 0.0 if not 0.0 < self.contribution < ASKED_FOR else None

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
        Every cause that was considered or acts; empty where the key or the diagnosis does not say.
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
        """What counts as the truth: it may leave out causes that add too little to be asked for."""
        causes = self.truth.split("+")
        weak = {c.name for c in self.causes if c.contribution > 0.0 and c.acts is None}
        kept = [[True, False] if name in weak else [True] for name in causes]
        sets = ("+".join(compress(causes, chosen)) for chosen in product(*kept))
        return frozenset(name for name in sets if name)

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


def _true_gap(entry: dict[str, Any], output: str) -> Array:
    truth, without = (np.array(entry[name][output]) for name in ("field_truth", "field_without"))
    return np.asarray(truth - without, dtype=np.float64)


def _localisation(entry: dict[str, Any], diagnosis: dict[str, Any]) -> float | None:
    """Return the AUC over all rows and outputs; rows that were left out count as probability 0."""
    said = {
        (str(item["output"]), int(item["row"])): float(item["probability"])
        for item in diagnosis.get("where", [])
    }
    scores, positives = [], []
    for output, sd in entry["noise_sd"].items():
        beyond = np.abs(_true_gap(entry, output)) > np.array(sd)
        positives.append(beyond)
        scores.append(np.array([said.get((output, row), 0.0) for row in range(beyond.size)]))
    return auc(np.concatenate(scores), np.concatenate(positives))


def _predictions(path: Path) -> dict[str, Array]:
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    wanted = [f"{c}_{when}" for c in OUTPUT_COLUMNS.values() for when in ("before", "after")]
    return {
        name: np.array([float(row[name]) for row in rows])
        for name in wanted
        if rows and name in rows[0]
    }


def _actual_shrink(predictions: dict[str, Array], output: str, truth: Array) -> float:
    column = OUTPUT_COLUMNS[output]
    before, after = (predictions.get(f"{column}_{when}") for when in ("before", "after"))
    if before is None or after is None or not before.size == after.size == truth.size:
        return 0.0
    miss_before, miss_after = (float(np.sqrt(np.mean((p - truth) ** 2))) for p in (before, after))
    if not np.isfinite(miss_after) or miss_before <= 0.0:
        return 0.0
    return 1.0 - miss_after / miss_before


def _interval(diagnosis: dict[str, Any], output: str) -> tuple[float, float] | None:
    stated = diagnosis.get("shrink", {}).get(output, {}).get("interval")
    return None if stated is None else (float(stated[0]), float(stated[1]))


def _shrinks(
    entry: dict[str, Any], diagnosis: dict[str, Any], predictions: dict[str, Array]
) -> tuple[ShrinkAnswer, ...]:
    answers = []
    for output, sd in entry["noise_sd"].items():
        gap = _true_gap(entry, output) / np.array(sd)
        if np.sqrt(np.mean(gap**2)) < GAP_ON_OUTPUT:
            continue
        actual = _actual_shrink(predictions, output, np.array(entry["fresh_truth"][output]))
        answers.append(ShrinkAnswer(output, actual, _interval(diagnosis, output)))
    return tuple(answers)


def _listed(name: str) -> str:
    """The listed causes of an explanation: those with something unlisted besides are the same."""
    causes = sorted(cause for cause in name.split("+") if cause != UNKNOWN)
    return "+".join(causes) or UNKNOWN


def _ranked(diagnosis: dict[str, Any]) -> tuple[tuple[str, float], ...]:
    said = [(_listed(str(e["name"])), float(e["probability"])) for e in diagnosis["effects"]]
    if not said or not all(np.isfinite(p) and 0.0 <= p <= 1.0 + 1e-9 for _, p in said):
        raise ValueError("probabilities are missing or outside [0, 1]")
    total: dict[str, float] = {}
    for name, p in said:
        total[name] = min(total.get(name, 0.0) + p, 1.0)
    return tuple(sorted(total.items(), key=lambda item: -item[1]))


def read_answer(name: str, entry: dict[str, Any], folder: Path) -> CaseAnswer:
    """Return one case's answer; what cannot be read is a failure, never a gap in the count.

    Parameters
    ----------
    name : str
        The case.
    entry : dict
        Its entry in the key.
    folder : Path
        Where its diagnosis was written.
    """
    outputs = tuple(entry["noise_sd"])
    try:
        diagnosis = json.loads((folder / "diagnosis.json").read_bytes())
        ranked, verdict = _ranked(diagnosis), str(diagnosis["verdict"])
        located = _localisation(entry, diagnosis)
        path = folder / "fresh_prediction.csv"
        predictions = _predictions(path) if path.exists() else {}
        shrinks = _shrinks(entry, diagnosis, predictions)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, IndexError) as problem:
        verdict, ranked, diagnosis = FAILED, (), {}
        # A failed case locates nothing: no better than chance, on cases where there is a gap.
        located = None if _localisation(entry, {}) is None else 0.5
        shrinks = _shrinks(entry, {}, {})
        text = f"{type(problem).__name__}: {problem}"
        if isinstance(problem, FileNotFoundError):
            text = "not diagnosed; go on with `calib challenge run`"
        return CaseAnswer(
            name, entry["tier"], entry["truth"], verdict, ranked, located, shrinks, outputs, text,
            _told_apart(entry),
        )  # fmt: skip
    located = None if entry["truth"] == NONE else located
    return CaseAnswer(
        name, entry["tier"], entry["truth"], verdict, ranked, located, shrinks, outputs,
        told_apart=_told_apart(entry), causes=_causes(entry, diagnosis),
    )  # fmt: skip


def _causes(entry: Mapping[str, Any], diagnosis: Mapping[str, Any]) -> tuple[CauseAnswer, ...]:
    """Hold inclusion probabilities and shares against what truly acts."""
    if "contributions" not in entry or "inclusion" not in diagnosis:
        return ()
    true = dict(entry["contributions"])
    if entry["truth"] in (UNKNOWN, SHIFT):
        true = {entry["truth"]: float(entry["gap_over_noise"])}
    said = {**diagnosis["inclusion"], UNKNOWN: diagnosis["remainder"]}
    total = sum(true.values())
    return tuple(
        CauseAnswer(
            name,
            float(said.get(name, {}).get("probability", 0.0)),
            true.get(name, 0.0),
            true.get(name, 0.0) / total if total else 0.0,
            tuple(said.get(name, {}).get("share_interval", (0.0, 0.0))),
        )
        for name in dict.fromkeys([*said, *true])
    )


def _told_apart(entry: Mapping[str, Any]) -> float | None:
    """Two laws whose means lie d noise sds apart are told apart with probability Phi(d / 2)."""
    if entry["truth"] in (NONE, entry.get("rival")) or "rival_nats" not in entry:
        return None
    nats = entry["rival_nats"]  # half the square of d; none without a rival
    return 1.0 if nats is None else float(ndtr(np.sqrt(0.5 * nats)))
