"""What a key says of its nearest rival, as the chance to choose the truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from scipy.stats import norm

from challenge.answers import _ranked, read_answer
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
