"""Which causes act, whatever acts besides: sums over explanations, and shares that sum to one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.gap.diagnose import verdict
from calib.gap.inclusion import _shares, _where, inclusion_probability
from tests.gap.cases import CHOICE, LARGE, diagnosis_of


def test_inclusion_is_the_sum_over_explanations():
    p = {"none": 0.1, "unknown": 0.1, "a": 0.3, "a+b": 0.2, "a+unknown": 0.2, "b+c+unknown": 0.1}
    assert inclusion_probability(p) == pytest.approx({"a": 0.7, "b": 0.3, "c": 0.1, "unknown": 0.4})


@pytest.mark.parametrize(
    ("probability", "expected"),
    [
        ({"none": 0.6, "a": 0.4}, "none"),
        ({"unknown": 0.6, "a": 0.4}, "unknown"),
        # A listed effect with something unlisted besides is that effect.
        ({"unknown": 0.3, "a+unknown": 0.4, "a": 0.2, "none": 0.1}, "effect"),
        ({"a+b": 0.3, "a+c": 0.3, "none": 0.4}, "effect"),
        ({"a": 0.4, "b": 0.4, "none": 0.2}, "ambiguous"),
    ],
)
def test_the_verdict_is_of_what_acts(probability, expected):
    assert verdict(probability) == expected


@pytest.mark.parametrize("name", [None, *LARGE])
def test_shares_sum_to_one_and_probabilities_are_those_of_the_ranking(name):
    found = diagnosis_of(name)
    parts = [*found.inclusion.causes.values(), found.inclusion.remainder]
    # Without any gap there is nothing to share out.
    total = sum(p.share for p in parts)
    assert total == pytest.approx(1.0) or (name is None and total == 0.0)
    sums = inclusion_probability(found.ranking.probability)
    for cause in CHOICE:
        assert found.inclusion.causes[cause].probability == pytest.approx(sums[cause])
    if name is not None:
        assert found.inclusion.acting == [name]
        assert found.inclusion.causes[name].share > 0.5


def test_a_draw_weighs_what_its_explanation_does():
    """However many draws an explanation has, they weigh together what it is probable."""
    found = diagnosis_of("force_offset")
    names = ["force_offset", "lug_thrust", "sensor_drift"]
    fits = tuple(found.ranking.best(name) for name in names)
    mixed = replace(found.corrected.mixture, fits=fits, probability=(0.7, 0.25, 0.05))
    shares, weight = _shares(mixed, names)
    for i, probability in enumerate(mixed.probability):
        its = shares[:, i] == 1.0
        assert its.sum() >= 50
        assert weight[its].sum() == pytest.approx(probability)


def test_sets_do_not_depend_on_the_order_of_the_effects():
    from calib.gap.which import rank
    from tests.gap.cases import campaigns_of

    data = campaigns_of("sensor_drift", "pull")
    names = ["force_offset", "sensor_drift", "lug_thrust"]
    one, other = (
        rank(data, 3, effects={n: CHOICE[n] for n in order if n in CHOICE})
        for order in (names, names[::-1])
    )
    assert set(one.probability) == set(other.probability)
    for name, p in one.probability.items():
        assert other.probability[name] == pytest.approx(p, abs=0.02)
    assert np.isfinite(list(one.log_evidence.values())).any()


def test_where_the_unlisted_lies_is_asked_of_the_explanations_that_have_it():
    """A listed cause beside it, however probable, has no say; without any there is nowhere."""
    found = diagnosis_of("lug_thrust")
    unknown, listed = (found.ranking.best(name) for name in ("unknown", "lug_thrust"))
    mixed = replace(found.corrected.mixture, fits=(unknown,), probability=(1.0,))
    alone = _where(found.data, mixed)
    assert alone
    both = replace(mixed, fits=(unknown, listed), probability=(0.3, 0.7))
    assert _where(found.data, both) == alone
    assert _where(found.data, replace(mixed, fits=(listed,))) == ()
