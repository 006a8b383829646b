"""What is said of a change over the order of the runs, from the explanations of one diagnosis."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.gap.diagnose import Diagnosis
from calib.gap.effects import EFFECTS
from calib.gap.hypotheses import Hypothesis
from calib.report.gap_facts import NEITHER
from calib.report.gap_verdict import over_runs
from tests.gap.cases import diagnosis_of, pull_diagnosis


def with_probabilities(found: Diagnosis, **p: float) -> Diagnosis:
    """The same diagnosis with explanations as probable as is said, all others impossible."""
    zero = dict.fromkeys(found.ranking.probability, 0.0)
    return replace(found, ranking=replace(found.ranking, probability=zero | p))


class OfHypothesis:
    """A forward model of which only the hypothesis is looked at."""

    def __init__(self, hypothesis: Hypothesis) -> None:
        self.hypothesis = hypothesis


def unlisted(outputs: tuple[str, ...], **over: str) -> Hypothesis:
    return Hypothesis("unknown", smooth=1.5, smooth_outputs=outputs, **over)


@pytest.fixture(scope="module")
def found() -> Diagnosis:
    """Pull and ruts, with every kind of explanation over the runs among those that were fitted."""
    base = diagnosis_of("sensor_drift")
    (drift, *_) = base.ranking.fits["sensor_drift"]
    pull, rut = ("drawbar_pull",), ("rut_depth",)
    weighed = {
        unlisted(pull, smooth_over="order"): 0.5, unlisted(pull, smooth_over="slip"): 0.2,
        unlisted(pull + rut, onset_over="order"): 0.3,
    }  # fmt: skip
    step = Hypothesis("sensor_step", (EFFECTS["sensor_step"],))
    fits = dict(base.ranking.fits) | {
        "sensor_step": (replace(drift, forward=OfHypothesis(step)),),
        "unknown": tuple(replace(drift, forward=OfHypothesis(h)) for h in weighed),
    }
    scores = dict(base.ranking.scores) | {"unknown": tuple(np.log([*weighed.values()]) + 7.0)}
    return replace(base, ranking=replace(base.ranking, fits=fits, scores=scores))


def test_all_explanations_with_it_are_added_up_each_once(found):
    fact = over_runs(with_probabilities(
        found, none=0.05, sensor_drift=0.3, sensor_step=0.2, unknown=0.2,
        **{"force_offset+sensor_drift": 0.1, "sensor_drift+sensor_step": 0.15},
    ))  # fmt: skip
    assert fact is not None
    assert (fact.outputs, fact.together, fact.only) == ("drawbar pull", False, False)
    assert dict(fact.forms) == pytest.approx({
        "a drift": 0.4, "a step": 0.2, "a drift and a step at once": 0.15, NEITHER: 0.1,
    })  # fmt: skip
    assert fact.probability == pytest.approx(0.85)
    assert fact.forms[0][0] == "a drift"
    assert fact.surest == pytest.approx(0.55)


def test_of_several_outputs_only_what_is_unlisted_changes_them_together(found):
    fact = over_runs(with_probabilities(found, sensor_drift=0.2, unknown=0.8))
    assert fact is not None
    assert fact.together is False  # 0.2 and half of 0.8 beside 0.24
    scores = dict(found.ranking.scores) | {"unknown": (0.0, 0.0, 4.0)}
    other = replace(found, ranking=replace(found.ranking, scores=scores))
    fact = over_runs(with_probabilities(other, sensor_drift=0.2, unknown=0.8))
    assert fact is not None
    assert (fact.outputs, fact.together) == ("drawbar pull and rut depth", True)
    assert fact.probability == pytest.approx(0.8 * np.exp(4.0) / (2.0 + np.exp(4.0)))
    assert fact.forms == [(NEITHER, fact.probability)]


def test_where_nothing_follows_the_runs_nothing_is_said(found):
    assert over_runs(with_probabilities(found, none=0.97, sensor_drift=0.03)) is None


def test_where_one_output_is_measured_it_is_said():
    fact = over_runs(pull_diagnosis("sensor_drift"))
    assert fact is not None
    assert fact.only
    assert fact.forms[0][0] == "a drift"
    assert fact.probability > 0.9
