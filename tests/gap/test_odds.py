"""Probabilities before the data, which sum to one, and after them."""

from __future__ import annotations

from itertools import combinations
from types import SimpleNamespace

import numpy as np
import pytest

from calib.gap.case import Context
from calib.gap.odds import Odds, probabilities, with_prior

NAMES = [f"cause_{i}" for i in range(5)]


def prior(odds: Odds, name: str) -> float:
    return float(np.exp(odds.ln_prior(name)))


def test_none_one_cause_and_nothing_listed_share_all_the_probability():
    """With and without something unlisted beside a cause; several causes come on top."""
    odds = Odds(5, {})
    causes = ["parameter_shift", *NAMES]
    alone = [prior(odds, n) for n in causes]
    beside = [prior(odds, f"{n}+unknown") for n in causes]
    assert prior(odds, "none") + prior(odds, "unknown") + sum(alone + beside) == pytest.approx(1.0)
    assert prior(odds, "none") == pytest.approx(0.40)
    assert prior(odds, "unknown") == pytest.approx(0.12)
    assert alone[0] + beside[0] == pytest.approx(0.12)
    assert alone[1] + beside[1] == pytest.approx(0.36 / 5)
    # Something unlisted comes on top of a cause in 15 of 100 campaigns.
    assert beside == pytest.approx([0.15 / 0.85 * p for p in alone])


def test_each_cause_more_is_a_twenty_fifth_as_probable():
    odds = Odds(5, {})
    single = prior(odds, "cause_0")
    for n in (2, 3, 4):
        for some in combinations(NAMES, n):
            assert prior(odds, "+".join(some)) == pytest.approx(single / 25.0 ** (n - 1))
            beside = prior(odds, "+".join((*some, "unknown")))
            assert beside == pytest.approx(single / 25.0 ** (n - 1) * 0.15 / 0.85)


def test_without_any_effect_a_single_one_has_all_of_its_share():
    assert Odds(0, {}).ln_prior("cause") == Odds(1, {}).ln_prior("cause")


@pytest.mark.parametrize("p", [0.01, 0.3, 0.9])
@pytest.mark.parametrize(("name", "usual"), [("cause_0", 0.36 / 5), ("parameter_shift", 0.12)])
def test_a_suspicion_multiplies_the_odds_wherever_the_cause_is_a_part(name, usual, p):
    """By the ratio of the odds that it acts to what they are without a suspicion."""
    plain = Odds(5, {})
    suspecting = Odds.of(5, Context(suspected={name: p}))
    ratio = (p / (1.0 - p)) / (usual / (1.0 - usual))
    assert suspecting.n_single == 5
    for joint in (name, f"{name}+unknown"):
        assert prior(suspecting, joint) == pytest.approx(ratio * prior(plain, joint))
    both = f"cause_0+{NAMES[1]}"
    if name == "cause_0":
        assert prior(suspecting, both) == pytest.approx(ratio * prior(plain, both))
    for other in ("none", "unknown", NAMES[1], f"{NAMES[1]}+unknown"):
        assert suspecting.ln_prior(other) == plain.ln_prior(other)


def test_two_suspicions_are_two_factors():
    """Where one effect alone is tested its usual probability is 0.36."""
    both = Odds.of(1, Context(suspected={"a": 0.5, "b": 0.8}))
    assert both.suspicion["a"] == pytest.approx(-np.log(0.36 / 0.64))
    assert both.suspicion["b"] == pytest.approx(np.log(4.0) - np.log(0.36 / 0.64))
    gained = both.ln_prior("a+b") - Odds(1, {}).ln_prior("a+b")
    assert gained == pytest.approx(sum(both.suspicion.values()))


def test_probabilities_are_evidence_times_prior_over_their_sum():
    odds = Odds(2, {"a": 1.5})
    evidence = {"none": -1203.0, "unknown": -1200.0, "a": -1204.0, "b+unknown": -1199.0}
    weight = {n: np.exp(v + 1200.0) * prior(odds, n) for n, v in evidence.items()}
    expected = {n: w / sum(weight.values()) for n, w in weight.items()}
    assert probabilities(evidence, odds) == pytest.approx(expected)


def test_a_variant_has_its_share_of_its_names_prior():
    hypothesis = SimpleNamespace(name="cause_0", share=0.2)
    found = SimpleNamespace(forward=SimpleNamespace(hypothesis=hypothesis), log_evidence=-7.0)
    odds = Odds(5, {})
    assert with_prior(found, odds) == pytest.approx(-7.0 + np.log(0.2 * prior(odds, "cause_0")))
