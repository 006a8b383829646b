"""Next measurement: where hypotheses that are in play differ most."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np

from calib.gap.hypotheses import singles
from calib.gap.identifiability import _candidates, _gain, _moments, next_measurements
from tests.gap.cases import CHOICE, campaigns_of, ranking_of
from tests.gap.fits import SIGMA, fit_at


def tied(case: str | None, *names: str):
    """Return a ranking in which only some hypotheses are probable."""
    ranking = ranking_of(case)
    p = dict.fromkeys(ranking.probability, 0.0) | {n: 1.0 / len(names) for n in names}
    return replace(ranking, probability=p)


def test_one_hypothesis_in_play_needs_no_measurement():
    ranking = tied("sensor_drift", "sensor_drift")
    assert next_measurements(campaigns_of("sensor_drift"), ranking.in_play, 1) == ()


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


def test_the_same_seed_gives_the_same_conditions():
    data, ranking = campaigns_of("sensor_drift"), tied("sensor_drift", "sensor_drift", "none")
    assert next_measurements(data, ranking.in_play, 2) == next_measurements(
        data, ranking.in_play, 2
    )


def test_the_gain_is_half_the_symmetric_divergence_of_two_normals():
    rng = np.random.default_rng(4)
    mean, other = rng.standard_normal((2, 2, 400))
    var, another = rng.uniform(0.2, 3.0, (2, 2, 400))

    def divergence(m, v, n, w):
        return 0.5 * (v / w + (n - m) ** 2 / w - 1.0 + np.log(w / v))

    a, b = (
        {name: (m[i], v[i]) for i, name in enumerate(("drawbar_pull", "rut_depth"))}
        for m, v in ((mean, var), (other, another))
    )
    both = divergence(mean, var, other, another) + divergence(other, another, mean, var)
    np.testing.assert_allclose(_gain(a, b), 0.5 * both.sum(axis=0))
    np.testing.assert_allclose(_gain(a, a), 0.0, atol=1e-12)


def test_candidates_are_after_the_campaign_at_slips_of_any_size_and_pressures_that_go_together():
    data = campaigns_of(None)
    found = _candidates(data, np.random.default_rng(1))
    field, lab = data.view.conditions, data.case.lab.columns
    outputs = {"drawbar_pull_kn", "rut_depth_mm"}
    assert set(found) == set(field) - outputs
    assert {v.shape for v in found.values()} == {(400,)}
    np.testing.assert_array_equal(found["run_order"], data.view.order_range[1])
    slip = found["slip_ratio"]
    both = np.append(field["slip_ratio"], lab["slip_ratio"])
    assert np.unique(slip).size == 400
    # Evenly: the ends of 400 draws are within a twentieth of those of the range.
    assert both.min() <= slip.min() < both.min() + 0.05 * np.ptp(both)
    assert both.max() - 0.05 * np.ptp(both) < slip.max() <= both.max()
    assert set(found["speed_m_s"]) == {*field["speed_m_s"], *lab["speed_m_s"]}
    names = ("inflation_pressure_psi", "average_ground_pressure_kpa")
    rows = set(zip(*(field[n] for n in names), strict=True))
    assert set(zip(*(found[n] for n in names), strict=True)) == rows


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


def test_moments_are_of_the_posterior_and_the_noise():
    data = campaigns_of(None)
    found = offset_of(data, 0.3, 0.05)
    moments = _moments(data, found, data.view, 1)
    middle = found.forward.field(found.psi[None], data.view)
    mean, variance = moments["drawbar_pull"]
    # Of 200 draws: means within 4/sqrt 200 sds, variances within 4 sqrt(2/200) of them.
    np.testing.assert_allclose(mean, middle["drawbar_pull"][0], atol=4.0 * 0.05 / np.sqrt(200.0))
    np.testing.assert_allclose(
        variance - SIGMA["drawbar_pull"] ** 2, 0.05**2, rtol=4.0 * np.sqrt(2.0 / 200.0)
    )
    np.testing.assert_allclose(moments["rut_depth"][1], SIGMA["rut_depth"] ** 2)


def test_two_in_play_are_told_apart_where_their_gain_is_largest():
    """Offsets of known sizes: the same gain everywhere, that of two normals."""
    data = campaigns_of(None)
    fits = {"one": offset_of(data, 0.0), "other": offset_of(data, 0.3)}
    (found,) = next_measurements(data, fits, 1)
    assert found.separates == ("one", "other")
    assert np.isclose(found.gain_nats, 0.5 * (0.3 / SIGMA["drawbar_pull"]) ** 2)
