"""Where: gaps of rows, and stretches of the conditions that have one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.gap.mixture import Truth, mixture
from calib.gap.where import regions, row_gaps
from tests.gap.cases import campaigns_of, diagnosis_of, ranking_of

NOISE = 0.05


@pytest.fixture(scope="module")
def data():
    return campaigns_of(None, "pull")


def truth_with(gap: np.ndarray, spread: float = 0.0) -> Truth:
    """Return draws in which the field departs from the simulator by a gap, give or take."""
    rng = np.random.default_rng(0)
    draws = 500
    plain = np.ones((draws, gap.size))
    true = plain + gap + spread * rng.standard_normal((draws, 1))
    sd = np.full_like(plain, NOISE)
    return Truth(
        {"drawbar_pull": plain}, {"drawbar_pull": true}, {"drawbar_pull": sd},
        {"drawbar_pull": true}, np.full(draws, 1.0 / draws),
    )  # fmt: skip


def test_gap_sd_and_probability_of_rows(data):
    gap = np.linspace(-0.2, 0.2, 27)
    (found,) = row_gaps(data, truth_with(gap, 0.03))
    # 500 draws of one shift: the sd of their mean is 0.0013, of their sd 3 %.
    np.testing.assert_allclose(found.gap, gap, atol=0.005)
    np.testing.assert_allclose(found.sd, 0.03, rtol=0.12)
    assert found.probability[0] > 0.99
    assert found.probability[13] < 0.2  # no gap: beyond 1.67 sd at 10 %
    assert found.rows.tolist() == list(range(27))


def test_a_certain_gap_at_high_slip_is_a_region_there(data):
    slip = data.view.slip()
    truth = truth_with(np.where(slip > 0.4, -0.15, 0.0))
    found = regions(data, truth, row_gaps(data, truth))
    (region,) = [r for r in found if "slip_ratio" in r.conditions]
    low, high = region.conditions["slip_ratio"]
    # Slips come in eight groups: an end is known to one group.
    assert 0.3 < low < 0.5
    assert high == slip.max()
    assert region.probability > 0.99
    assert region.gap == pytest.approx(-0.15, abs=0.05)


def test_gaps_of_both_signs_are_not_one_region(data):
    slip = data.view.slip()
    truth = truth_with(np.where(slip > 0.35, 0.15, -0.15))
    found = regions(data, truth, row_gaps(data, truth))
    low, high = sorted(
        (r for r in found if "slip_ratio" in r.conditions), key=lambda r: r.conditions["slip_ratio"]
    )
    assert low.gap < 0.0 < high.gap
    assert low.conditions["slip_ratio"][1] < high.conditions["slip_ratio"][0]


def test_a_gap_at_the_middle_pressure_is_a_region_there(data):
    # Beside it most rows of the lowest have a gap the other way that their mean does not show.
    pressure = data.view.conditions["inflation_pressure_psi"]
    middle, lowest = pressure == np.median(pressure), pressure == pressure.min()
    odd = np.arange(27) % 4 > 0
    truth = truth_with(np.where(middle, -0.15, np.where(lowest & odd, 0.06, 0.0)))
    found = regions(data, truth, row_gaps(data, truth))
    ends = float(np.median(pressure)), float(np.median(pressure))
    assert found[0].conditions == {"inflation_pressure_psi": ends}
    assert found[0].gap == pytest.approx(-0.15)


def test_the_mean_gap_of_a_region_has_its_interval(data):
    truth = truth_with(np.full(27, -0.15), 0.02)
    (region, *_) = regions(data, truth, row_gaps(data, truth))
    # Quantiles of 500 draws: 0.002.
    assert region.interval == pytest.approx((-0.15 - 0.0329, -0.15 + 0.0329), abs=0.006)


def test_no_gap_no_region(data):
    truth = truth_with(np.zeros(27), 0.02)
    assert regions(data, truth, row_gaps(data, truth)) == ()


def test_weights_of_draws_count(data):
    truth = truth_with(np.full(27, 0.3))
    weight = np.zeros(500)
    weight[0] = 1.0
    none = Truth(
        truth.simulator,
        {"drawbar_pull": np.vstack([np.ones((1, 27)), truth.truth["drawbar_pull"][1:]])},
        truth.noise, truth.measured, weight,
    )  # fmt: skip
    (found,) = row_gaps(data, none)
    np.testing.assert_allclose(found.gap, 0.0)
    np.testing.assert_allclose(found.probability, 0.0)


def test_a_null_campaign_stays_quiet_over_all_rows():
    found = diagnosis_of(None)
    assert found.regions == ()
    assert max(float(g.probability.max()) for g in found.gaps) < 0.5


def test_a_drift_lies_at_the_end():
    found = diagnosis_of("sensor_drift")
    pull = found.gaps[0]
    order = found.data.view.conditions["run_order"]
    assert pull.probability[order > 20].mean() > 0.9
    assert pull.probability[order < 4].mean() < 0.5
    assert any(
        "run_order" in r.conditions and r.conditions["run_order"][1] == order.max()
        for r in found.regions
    )
    rut = found.gaps[1]
    assert rut.probability.max() < 0.1


def test_what_is_left_out_of_a_mixture_leaves_the_rest_their_odds():
    """Of 0.6, 0.2 and a remainder of the least probable, the first two are drawn as 3 to 1."""
    ranking = ranking_of("force_offset")
    first, second, *rest = sorted(ranking.fits)
    probability = {first: 0.6, second: 0.2} | dict.fromkeys(rest, 0.2 / len(rest) ** 2)
    scores = {name: (0.0, *[-50.0] * (len(fits) - 1)) for name, fits in ranking.fits.items()}
    few = {first: 0.6, second: 0.2} | dict.fromkeys(rest, 1e-3)
    for given in (probability, few):
        ranked = replace(ranking, probability=given, scores=scores)
        found = mixture(campaigns_of("force_offset"), ranked, 1)
        assert sum(found.probability) == pytest.approx(1.0)
        assert found.probability[0] == pytest.approx(3.0 * found.probability[1])
    assert len(found.fits) == 2


def test_no_region_is_along_a_condition_that_is_the_same_in_all_rows(data):
    load = data.view.conditions["normal_load_kn"]
    assert not np.ptp(load)
    truth = truth_with(np.full(load.size, -0.2))
    found = regions(data, truth, row_gaps(data, truth))
    assert found
    assert not any("normal_load_kn" in region.conditions for region in found)


def test_a_gap_of_a_field_at_one_condition_is_at_all_its_rows(data):
    first = {name: np.full_like(v, v[0]) for name, v in data.view.conditions.items()}
    one = replace(data, view=replace(data.view, conditions=first))
    truth = truth_with(np.full(27, -0.2))
    (region,) = regions(one, truth, row_gaps(one, truth))
    assert region.gap == pytest.approx(-0.2)
    ((low, high),) = region.conditions.values()
    assert low == high
