"""A field that no explanation holds is not called fine: more noise, a column that nobody takes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib.data.quantities import OUTPUTS
from calib.gap.case import Case
from calib.gap.diagnose import diagnose
from calib.gap.effects import EFFECTS
from calib.gap.files import document
from calib.report.gap_verdict import Tone
from calib.report.gap_words import gap_verdict
from tests.gap.cases import PULL_ONLY, make_case

FEW = {n: EFFECTS[n] for n in ("force_offset", "sensor_drift", "lug_thrust")}
PULL = OUTPUTS["drawbar_pull"]


def two_operators(apart: float, *, recorded: bool = True) -> Case:
    """A field of two operators, whose readings are more and less than true by a part of them."""
    case = make_case(models=PULL_ONLY, n_field=56, noise=0.5)
    who = np.arange(len(case.field)) % 2
    pull = case.field[PULL] * (1.0 + apart * np.where(who == 1, 1.0, -1.0))
    extra = {"operator": tuple(map(str, who))} if recorded else {}
    field = replace(case.field, columns={**case.field.columns, PULL: pull}, extra=extra)
    return replace(case, field=field)


def test_a_field_far_noisier_than_the_laboratory_is_amber_and_its_column_named():
    found = diagnose(two_operators(0.2), effects=FEW)
    judged = gap_verdict(found)
    assert judged.tone is not Tone.FINE
    assert "times as much as the laboratory's (sd 0.2" in judged.headline
    assert "kN against 0.01" in judged.headline
    assert "differs with 'operator'" in judged.headline
    noisier, column = document(found)["warnings"][:2]
    assert "scatters" in noisier
    assert "'operator', a column that is not used" in column
    assert "[covariates]" in column


def test_without_the_column_the_noise_is_still_said():
    found = diagnose(two_operators(0.2, recorded=False), effects=FEW)
    assert len(found.doubts) == 1
    assert "scatters" in gap_verdict(found).headline


def test_a_field_as_noisy_as_the_laboratory_stays_green_whatever_its_columns():
    found = diagnose(two_operators(0.0), effects=FEW)
    assert found.verdict == "none"
    assert found.doubts == ()
    assert gap_verdict(found).tone is Tone.FINE
