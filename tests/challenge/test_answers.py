"""What a key says of its nearest rival, as the chance to choose the truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from scipy.stats import norm

from challenge.answers import CaseAnswer, CauseAnswer, _ranked, read_answer
from tests.challenge.test_score import entry


def told_apart(tmp_path: Path, truth: str, **rival: Any) -> float | None:
    return read_answer("case-000", entry(truth, "easy") | rival, tmp_path).told_apart


def test_means_two_sds_apart_are_told_apart_in_five_of_six(tmp_path):
    # Half the square of the distance is the expected log likelihood ratio.
    found = told_apart(tmp_path, "rate_effect", rival="lug_thrust", rival_nats=2.0)
    assert found == pytest.approx(norm.cdf(1.0))
    assert told_apart(tmp_path, "rate_effect", rival="lug_thrust", rival_nats=0.0) == 0.5


def test_without_a_rival_the_truth_is_told(tmp_path):
    assert told_apart(tmp_path, "parameter_shift", rival="", rival_nats=None) == 1.0


def test_a_null_and_keys_that_do_not_say_are_left_out(tmp_path):
    assert told_apart(tmp_path, "none", rival="", rival_nats=0.0) is None
    assert told_apart(tmp_path, "rate_effect") is None
    # Keys of before named a shift as its own rival.
    own = {"rival": "parameter_shift", "rival_nats": 1.0}
    assert told_apart(tmp_path, "parameter_shift", **own) is None


def test_a_case_without_a_diagnosis_says_how_to_go_on(tmp_path):
    found = read_answer("case-000", entry("none", "easy"), tmp_path / "nowhere")
    assert found.problem == "not diagnosed; go on with `calib challenge run`"


def test_listed_causes_with_something_unlisted_besides_are_those_causes():
    said = {"lug_thrust+unknown": 0.4, "lug_thrust": 0.3, "b+a": 0.1, "unknown": 0.2}
    effects = [{"name": name, "probability": p} for name, p in said.items()]
    ranked = _ranked({"effects": effects})
    assert dict(ranked) == pytest.approx({"lug_thrust": 0.7, "unknown": 0.2, "a+b": 0.1})
    assert ranked[0][0] == "lug_thrust"


def mixed(weak: float, ranked: dict[str, float]) -> CaseAnswer:
    """Return the answer to a case of two causes, the second of which adds so many noise sds."""
    causes = tuple(
        CauseAnswer(name, 0.5, sds, 0.5, (0.0, 1.0))
        for name, sds in (("lug_thrust", 8.0), ("rut_rebound", weak), ("force_offset", 0.0))
    )
    said = tuple(sorted(ranked.items(), key=lambda item: -item[1]))
    return CaseAnswer(
        "case-000", "large", "lug_thrust+rut_rebound", "effect", said, None, (), (), causes=causes
    )


def test_a_cause_too_weak_to_be_asked_for_may_be_left_out():
    ranked = {"lug_thrust": 0.9, "lug_thrust+rut_rebound": 0.06, "rut_rebound": 0.04}
    found = mixed(1.2, ranked)
    assert found.right == {"lug_thrust", "lug_thrust+rut_rebound"}
    assert found.among_first(1)
    assert not found.confidently_wrong()
    assert found.truth_probability == pytest.approx(0.96)
    assert found.brier == pytest.approx(2 * 0.04**2)
    # One that adds more may not, nor may one be named that does not act.
    missed = mixed(1.3, ranked)
    assert not missed.among_first(1)
    assert missed.confidently_wrong()
    assert mixed(1.2, {"force_offset+lug_thrust": 0.95}).confidently_wrong()
