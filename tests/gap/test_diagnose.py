"""The steps of a diagnosis, each by itself: what follows what, and what is said."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.data import table_from_arrays
from calib.gap.diagnose import (
    diagnose_once,
    verdict,
)
from calib.gap.effects import EFFECTS
from tests.gap.cases import make_case


@pytest.mark.parametrize(
    ("probability", "expected"),
    [
        ({"none": 0.5, "a": 0.5}, "none"),
        ({"none": 0.49, "a": 0.5}, "effect"),
        ({"unknown": 0.5, "a": 0.5}, "unknown"),
        ({"a": 0.3, "a+unknown": 0.2, "unknown": 0.49}, "effect"),
        ({"a": 0.3, "a+unknown": 0.199, "unknown": 0.49}, "ambiguous"),
        # Something unlisted beside causes that are none probable by themselves names nothing.
        ({"a+unknown": 0.4, "b+unknown": 0.4}, "ambiguous"),
        ({}, "ambiguous"),
    ],
)
def test_a_verdict_needs_a_probability_of_one_half(probability, expected):
    assert verdict(probability) == expected


FEW = {
    "rate_effect": EFFECTS["rate_effect"],
    "multipass_compaction": EFFECTS["multipass_compaction"],
}


def test_conditions_to_predict_that_lack_what_the_field_has_are_named() -> None:
    """And one that the field lacks explains nothing there."""
    case = make_case("rate_effect", n_fresh=9)
    fresh = case.new_conditions
    assert fresh is not None
    columns = {n: v for n, v in fresh.columns.items() if n != "speed_m_s"}
    found = diagnose_once(replace(case, new_conditions=table_from_arrays(columns)), 1, FEW)
    assert any("lacks speed_m_s, which the field campaign has" in w for w in found.warnings)
    whole = diagnose_once(case, 1, FEW)
    assert not any("lacks" in w for w in whole.warnings)
    field = {n: v for n, v in case.field.columns.items() if n != "pass_number"}
    without = diagnose_once(replace(case, field=table_from_arrays(field)), 1, FEW)
    assert np.isfinite(without.shrink["drawbar_pull"].rmse_after)
