"""Next measurement: where hypotheses that are in play differ most."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np

from calib.gap.hypotheses import singles
from calib.gap.identifiability import next_measurements
from tests.gap.cases import CHOICE, campaigns_of, ranking_of
from tests.gap.fits import SIGMA, fit_at


def tied(case: str | None, *names: str):
    """Return a ranking in which only some hypotheses are probable."""
    ranking = ranking_of(case)
    p = dict.fromkeys(ranking.probability, 0.0) | {n: 1.0 / len(names) for n in names}
    return replace(ranking, probability=p)


def test_conditions_are_those_of_the_campaigns():
    data = campaigns_of("sensor_drift")
    (found,) = next_measurements(
        data, tied("sensor_drift", "sensor_drift", "force_offset").in_play, 1
    )
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
    (found,) = next_measurements(data, tied("lug_thrust", "lug_thrust", "force_offset").in_play, 1)
    slip = found.conditions["slip_ratio"]
    assert slip < 0.15 or slip > 0.5


def test_three_in_play_give_three_pairs():
    data = campaigns_of("sensor_drift")
    found = next_measurements(
        data, tied("sensor_drift", "sensor_drift", "force_offset", "none").in_play, 1
    )
    assert len({m.separates for m in found}) == 3
    # The offset and no gap at all differ least where the offset is: it is what it is everywhere,
    # so that gain is the same at most conditions; all gains are positive.
    assert all(m.gain_nats > 0.0 for m in found)


def test_at_most_three_in_play_are_told_apart_and_none_that_is_improbable():
    data = campaigns_of("sensor_drift")
    names = ["sensor_drift", "force_offset", "none", "lug_thrust"]
    ranking = ranking_of("sensor_drift")
    p = dict.fromkeys(ranking.probability, 0.0) | dict(
        zip(names, (0.5, 0.3, 0.15, 0.05), strict=True)
    )
    pairs = {
        m.separates for m in next_measurements(data, replace(ranking, probability=p).in_play, 1)
    }
    assert pairs == set(combinations(names[:3], 2))
    p |= {"force_offset": 0.03, "none": 0.029, "lug_thrust": 0.0}
    (one,) = next_measurements(data, replace(ranking, probability=p).in_play, 1)
    assert one.separates == ("sensor_drift", "force_offset")


def offset_of(data, offset: float, sd: float = 0.0):
    (single,) = singles(data, {"force_offset": CHOICE["force_offset"]})
    found = fit_at(data, single)
    part = found.forward.phi_slices[0]
    psi, covariance = found.psi.copy(), np.zeros_like(found.covariance)
    psi[part] = offset
    covariance[part, part] = sd**2
    return replace(found, psi=psi, covariance=covariance)


def test_two_in_play_are_told_apart_where_their_gain_is_largest():
    """Offsets of known sizes: the same gain everywhere, that of two normals."""
    data = campaigns_of(None)
    fits = {"one": offset_of(data, 0.0), "other": offset_of(data, 0.3)}
    (found,) = next_measurements(data, fits, 1)
    assert found.separates == ("one", "other")
    assert np.isclose(found.gain_nats, 0.5 * (0.3 / SIGMA["drawbar_pull"]) ** 2)
