"""What effects take for conditions that the calibration does not record."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.gap.campaigns import campaigns
from calib.gap.diagnose import assumed
from calib.gap.effects import EFFECTS
from calib.gap.hypotheses import Hypothesis, joined, singles
from tests.gap.cases import make_case, table_without
from tests.gap.fits import fit_at


def data_without(*columns):
    case = make_case("rate_effect")
    lab = case.lab
    for column in columns:
        lab = table_without(lab, column)
    return campaigns(replace(case, lab=lab))


@pytest.mark.parametrize(
    ("lacking", "effects", "value"),
    [
        (("pass_number",), ("multipass_compaction",), {"pass_number": 1.0}),
        (("speed_m_s",), ("rate_effect",), {"speed_m_s": "median"}),
        (("pass_number", "speed_m_s"), ("multipass_compaction", "rate_effect"),
         {"pass_number": 1.0, "speed_m_s": "median"}),
        (("pass_number",), ("rate_effect",), {}),
        ((), ("multipass_compaction",), {}),
    ],
)  # fmt: skip
def test_only_what_the_hypothesis_rests_on_is_named(lacking, effects, value):
    data = data_without(*lacking)
    chosen = singles(data, {name: EFFECTS[name] for name in effects})
    hypothesis = chosen[0] if len(chosen) == 1 else joined(*chosen)
    median = float(np.median(data.case.field["speed_m_s"]))
    assert assumed(fit_at(data, hypothesis)) == {
        column: median if v == "median" else v for column, v in value.items()
    }


def test_without_effects_nothing_is_assumed():
    assert assumed(fit_at(data_without("pass_number"), Hypothesis("none"))) == {}
