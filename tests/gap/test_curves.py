"""The one figure of a diagnosis: readings beside curves, over the condition that matters."""

from __future__ import annotations

import numpy as np
import pytest

from calib.data.quantities import OUTPUTS
from calib.gap.curves import curves
from tests.gap.cases import diagnosis_of


@pytest.mark.parametrize(
    ("effect", "column"),
    [
        ("lug_thrust", "slip_ratio"),
        ("rate_effect", "speed_m_s"),
        ("sensor_drift", "run_order"),
        (None, "slip_ratio"),
    ],
)
def test_it_is_over_what_the_cause_depends_on(effect, column):
    drawn = {c.output: c for c in curves(diagnosis_of(effect))}
    assert set(drawn) == {"drawbar_pull", "rut_depth"}
    assert drawn["drawbar_pull"].column == column
    assert column not in drawn["drawbar_pull"].others


def test_readings_stay_as_far_from_the_corrected_curve_as_they_were_from_the_correction():
    found = diagnosis_of("lug_thrust")
    for o, curve in zip(found.data.outputs, curves(found), strict=True):
        after = found.truth.means[o.name][o.rows]
        measured = found.data.case.field[OUTPUTS[o.name]][o.rows]
        there = np.interp(curve.readings_at, curve.at, curve.after)
        if o.name == "rut_depth":  # whose noise is relative
            np.testing.assert_allclose(np.array(curve.readings) / there, measured / after)
        else:
            np.testing.assert_allclose(curve.readings - there, measured - after, atol=1e-12)
        assert np.all(np.array(curve.lower) <= np.array(curve.upper))


def test_curves_are_those_of_the_models_at_the_conditions_they_state():
    found = diagnosis_of("rate_effect")
    curve = curves(found)[0]
    field = found.data.view.conditions
    conditions = {
        name: np.full(len(curve.at), curve.others.get(name, np.median(field[name])))
        for name in field
    } | {curve.column: np.array(curve.at)}
    before = found.corrected.calibrated(conditions)[curve.output]
    truth = found.corrected.mixture.at(found.data.at_conditions(conditions))
    np.testing.assert_allclose(curve.before, before)
    np.testing.assert_allclose(curve.after, truth.means[curve.output])
