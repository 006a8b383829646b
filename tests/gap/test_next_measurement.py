"""Next measurement: where hypotheses that are in play differ most."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib.gap.next_measurement import next_measurements
from tests.gap.cases import campaigns_of, ranking_of


def tied(case: str | None, *names: str):
    """Return a ranking in which only some hypotheses are probable."""
    ranking = ranking_of(case)
    p = dict.fromkeys(ranking.probability, 0.0) | {n: 1.0 / len(names) for n in names}
    return replace(ranking, probability=p)


def test_one_hypothesis_in_play_needs_no_measurement():
    ranking = tied("sensor_drift", "sensor_drift")
    assert next_measurements(campaigns_of("sensor_drift"), ranking, 1) == ()


def test_conditions_are_those_of_the_campaigns():
    data = campaigns_of("sensor_drift")
    (found,) = next_measurements(data, tied("sensor_drift", "sensor_drift", "force_offset"), 1)
    assert set(found.separates) == {"sensor_drift", "force_offset"}
    lab = data.case.lab.columns
    for name, value in found.conditions.items():
        both = np.concatenate([data.view.conditions[name], lab[name]])
        assert both.min() <= value <= both.max()
    assert "drawbar_pull_kn" not in found.conditions
    assert found.gain_nats > 0.0


def test_thrust_that_grows_with_slip_is_told_from_an_offset_at_an_end_of_the_slips():
    # The two were fitted to the same rows and cross in the middle of them.
    data = campaigns_of("lug_thrust")
    (found,) = next_measurements(data, tied("lug_thrust", "lug_thrust", "force_offset"), 1)
    slip = found.conditions["slip_ratio"]
    assert slip < 0.15 or slip > 0.5


def test_three_in_play_give_three_pairs():
    data = campaigns_of("sensor_drift")
    found = next_measurements(data, tied("sensor_drift", "sensor_drift", "force_offset", "none"), 1)
    assert len({m.separates for m in found}) == 3
    # The offset and no gap at all differ least where the offset is: it is what it is everywhere,
    # so that gain is the same at most conditions; all gains are positive.
    assert all(m.gain_nats > 0.0 for m in found)


def test_the_same_seed_gives_the_same_conditions():
    data, ranking = campaigns_of("sensor_drift"), tied("sensor_drift", "sensor_drift", "none")
    assert next_measurements(data, ranking, 2) == next_measurements(data, ranking, 2)
