"""Which: probabilities are probabilities, and large effects are named when they are there."""

from __future__ import annotations

import numpy as np
import pytest

from calib.gap.which import probabilities, rank
from gap.cases import CHOICE, LARGE, campaigns_of, ranking_of


@pytest.mark.parametrize("name", [None, *LARGE])
def test_probabilities_sum_to_one_over_all_hypotheses(name):
    ranking = ranking_of(name)
    assert sum(ranking.probability.values()) == pytest.approx(1.0, abs=1e-12)
    assert set(ranking.probability) == set(ranking.fits) == set(ranking.log_evidence)
    assert {"none", "unknown", "parameter_shift", *CHOICE} <= set(ranking.probability)
    assert min(ranking.probability.values()) >= 0.0
    p = [ranking.probability[n] for n in ranking.order]
    assert p == sorted(p, reverse=True)


def test_a_field_campaign_of_the_simulator_itself_has_no_gap():
    ranking = ranking_of(None)
    assert ranking.order[0] == "none"
    assert ranking.probability["none"] > 0.8


@pytest.mark.parametrize("name", LARGE)
def test_a_large_effect_comes_first(name):
    # Simulated by its own formula, at a size of four noise sds: not naming it would be a defect.
    ranking = ranking_of(name)
    assert ranking.order[0] == name
    assert ranking.probability[name] > 0.5
    assert ranking.probability["none"] < 0.01


def test_pairs_are_named_in_alphabetical_order_and_contain_good_singles():
    ranking = ranking_of("lug_thrust")
    pairs = [n for n in ranking.fits if "+" in n]
    assert pairs
    for n in pairs:
        parts = n.split("+")
        assert parts == sorted(parts)
        assert set(parts) <= set(CHOICE)


def test_the_same_seed_gives_the_same_numbers():
    data = campaigns_of("sensor_drift", "pull")
    few = {n: CHOICE[n] for n in ("force_offset", "sensor_drift")}
    a, b = (rank(data, 3, effects=few) for _ in range(2))
    assert a.probability == b.probability
    assert a.log_evidence == b.log_evidence


def test_untestable_effects_are_listed_and_not_fitted():
    from calib.gap.effects import EFFECTS

    data = campaigns_of("sensor_drift", "pull")
    few = {n: EFFECTS[n] for n in ("force_offset", "rut_rebound", "moisture_softening")}
    ranking = rank(data, 1, effects=few)
    assert set(ranking.not_testable) == {"rut_rebound", "moisture_softening"}
    assert not any("rut_rebound" in n for n in ranking.fits)


def test_probabilities_from_evidence():
    even = {"none": 0.0, "unknown": 0.0, "parameter_shift": 0.0, "a": 0.0, "b": 0.0, "a+b": 0.0}
    p = probabilities(even, 2)
    assert sum(p.values()) == pytest.approx(1.0)
    assert p["a"] == pytest.approx(p["b"])
    assert p["a+b"] < p["a"] < p["none"]
    better = probabilities(even | {"a": np.log(10.0)}, 2)
    # Ten times the evidence is ten times the odds.
    assert better["a"] / better["b"] == pytest.approx(10.0)
