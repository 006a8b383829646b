"""Where: gaps of rows, and stretches of the conditions that have one."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from calib.gap.mixture import (
    Truth,
    conditions_to_search,
    mixture,
    regions,
    row_gaps,
)
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
    for each in (probability, few):
        ranked = replace(ranking, probability=each, scores=scores)
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


def of_slips(values, **covariates):
    """One output over slips, and whatever is declared."""
    conditions = {"slip_ratio": np.asarray(values, dtype=float)} | {
        name: column for name, (column, _) in covariates.items()
    }
    rows = np.arange(len(values))
    return SimpleNamespace(
        outputs=(SimpleNamespace(name="drawbar_pull", rows=rows),),
        view=SimpleNamespace(conditions=conditions),
        case=SimpleNamespace(covariates={name: levels for name, (_, levels) in covariates.items()}),
    )


def certain(gap, noise=0.1):
    """Draws that are all the same."""
    true = np.tile(np.asarray(gap, dtype=float), (4, 1))
    plain, sd = np.zeros_like(true), np.full_like(true, noise)
    name = "drawbar_pull"
    return Truth({name: plain}, {name: true}, {name: sd}, {name: true}, np.full(4, 0.25))


def test_gap_sd_and_probability_are_those_of_weighted_draws():
    """Of three draws the third counts half; where it does not go beyond the noise it is none."""
    true = np.array([[0.3, 0.1], [-0.3, 0.0], [0.2, 0.2]])
    sd = np.array([[0.2, 0.1], [0.2, 0.1], [0.2, 0.1]])
    weight = np.array([0.2, 0.3, 0.5])
    name = "drawbar_pull"
    truth = Truth({name: np.zeros((3, 2))}, {name: true}, {name: sd}, {name: true}, weight)
    (found,) = row_gaps(of_slips([0.1, 0.2]), truth)
    mean = weight @ true
    np.testing.assert_allclose(found.gap, mean)
    np.testing.assert_allclose(found.sd, np.sqrt(weight @ np.square(true - mean)))
    np.testing.assert_allclose(found.probability, [0.5, 0.5])


def test_of_two_conditions_that_show_the_same_gap_that_of_more_rows_is_told_and_only_it():
    """A surface that is another in four rows, three of them at the three largest slips."""
    slip = np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8])
    wet = np.array([0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0])
    truth = certain(-0.3 * wet)
    for levels in (("dry", "wet"), ()):
        data = of_slips(slip, surface=(wet, levels))
        assert conditions_to_search(data) == ["slip_ratio", "surface"]
        (found,) = regions(data, truth, row_gaps(data, truth))
        assert found.conditions == {"surface": (1.0, 1.0)}
    # Without the surface, what is left of the slips has fewer than two such rows.
    bare = of_slips(slip)
    (found,) = regions(bare, truth, row_gaps(bare, truth))
    assert found.conditions == {"slip_ratio": (0.6, 0.8)}
