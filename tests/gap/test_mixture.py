"""The truth under all hypotheses: where a gap lies, which causes act."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from calib.gap.constants import FALSE_REGIONS
from calib.gap.diagnose import verdict
from calib.gap.hypotheses import Hypothesis, joined, singles
from calib.gap.mixture import (
    Mixture,
    Truth,
    _sizes,
    conditions_to_search,
    false_discovery_rate,
    inclusion_probability,
    regions,
    row_gaps,
)
from calib.gap.noise import Noise
from tests.gap.cases import CHOICE, LARGE, campaigns_of, diagnosis_of
from tests.gap.fits import SIGMA, fit_at, moved


@pytest.fixture(scope="module")
def data():
    return campaigns_of(None)


def offset_fit(data, offset: float):
    (single,) = singles(data, {"force_offset": CHOICE["force_offset"]})
    found = fit_at(data, single)
    psi = found.psi.copy()
    psi[found.forward.phi_slices[0]] = offset
    return moved(found, psi)


def test_readings_have_noise_in_their_own_unit_and_relative_noise_of_ruts(data):
    found = fit_at(data, Hypothesis("none"))
    found = replace(found, noise={**found.noise, "drawbar_pull": Noise(0.03, 2.5)})
    truth = Mixture(data, (found,), (1.0,), 1).at(data.view)
    sds = 0.03 * (1.0 + 2.5 * data.view.slip()), SIGMA["rut_depth"]
    pull, rut = (truth.truth[name] for name in data.names)
    np.testing.assert_allclose(truth.noise["drawbar_pull"], np.tile(sds[0], (1200, 1)))
    np.testing.assert_allclose(truth.noise["rut_depth"], sds[1] * rut)
    for z in (
        (truth.measured["drawbar_pull"] - pull) / sds[0],
        np.log(truth.measured["rut_depth"] / rut) / sds[1],
    ):
        # 1200 x 27 standard normals.
        assert abs(z.mean()) < 5.0 / np.sqrt(z.size)
        assert z.var() == pytest.approx(1.0, abs=5.0 * np.sqrt(2.0 / z.size))


def test_a_cause_may_be_taken_out_of_the_truth_or_put_into_the_simulator(data):
    mixed = Mixture(data, (offset_fit(data, 0.3),), (1.0,), 1)
    usual, without, left_out = (
        mixed.at(data.view, **options)
        for options in ({}, {"without": "force_offset"}, {"left_out": ["force_offset"]})
    )
    name = "drawbar_pull"
    np.testing.assert_allclose(without.truth[name] - without.simulator[name], 0.3)
    np.testing.assert_allclose(left_out.truth[name], usual.simulator[name])
    np.testing.assert_allclose(usual.truth[name] - left_out.truth[name], 0.3)


def test_a_draw_without_a_value_of_one_output_counts_for_none(data):
    found = fit_at(data, Hypothesis("none"))
    sample = np.tile(found.psi, (2, 1))
    sample[1, found.forward.theta_slices["rut_depth"]] = np.nan
    truth = Mixture(data, (replace(found, sample=sample), found), (0.5, 0.5), 1).at(data.view)
    assert 200 < truth.weight.size - 600 < 400
    assert np.isfinite(truth.truth["drawbar_pull"]).all()
    assert truth.weight[-600:].sum() == pytest.approx(0.5)


def test_a_quantile_is_the_first_value_that_so_much_weight_does_not_exceed():
    truth = Truth({}, {}, {}, {}, np.array([0.25, 0.25, 0.3, 0.2]))
    values = np.array([[3.0, 1.0], [1.0, 2.0], [2.0, 3.0], [4.0, 4.0]])
    assert truth.quantile(values, 0.25).tolist() == [1.0, 1.0]
    assert truth.quantile(values, 0.26).tolist() == [2.0, 2.0]
    assert truth.quantile(values, 0.5).tolist() == [2.0, 2.0]
    assert truth.quantile(values, 0.55).tolist() == [2.0, 3.0]
    assert truth.quantile(values, 0.56).tolist() == [3.0, 3.0]
    assert truth.quantile(values, 1.0).tolist() == [4.0, 4.0]


NOISE = 0.05


@pytest.fixture(scope="module")
def data_where():
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


def test_gap_sd_and_probability_of_rows(data_where):
    gap = np.linspace(-0.2, 0.2, 27)
    (found,) = row_gaps(data_where, truth_with(gap, 0.03))
    # 500 draws of one shift: the sd of their mean is 0.0013, of their sd 3 %.
    np.testing.assert_allclose(found.gap, gap, atol=0.005)
    np.testing.assert_allclose(found.sd, 0.03, rtol=0.12)
    assert found.probability[0] > 0.99
    assert found.probability[13] < 0.2  # no gap: beyond 1.67 sd at 10 %
    assert found.rows.tolist() == list(range(27))


def test_a_certain_gap_at_high_slip_is_a_region_there(data_where):
    slip = data_where.view.slip()
    truth = truth_with(np.where(slip > 0.4, -0.15, 0.0))
    found = regions(data_where, truth, row_gaps(data_where, truth))
    (region,) = [r for r in found if "slip_ratio" in r.conditions]
    low, high = region.conditions["slip_ratio"]
    # Slips come in eight groups: an end is known to one group.
    assert 0.3 < low < 0.5
    assert high == slip.max()
    assert region.probability > 0.99
    assert region.gap == pytest.approx(-0.15, abs=0.05)


def test_a_gap_at_the_middle_pressure_is_a_region_there(data_where):
    # Beside it most rows of the lowest have a gap the other way that their mean does not show.
    pressure = data_where.view.conditions["inflation_pressure_psi"]
    middle, lowest = pressure == np.median(pressure), pressure == pressure.min()
    odd = np.arange(27) % 4 > 0
    truth = truth_with(np.where(middle, -0.15, np.where(lowest & odd, 0.06, 0.0)))
    found = regions(data_where, truth, row_gaps(data_where, truth))
    ends = float(np.median(pressure)), float(np.median(pressure))
    assert found[0].conditions == {"inflation_pressure_psi": ends}
    assert found[0].gap == pytest.approx(-0.15)


def test_the_mean_gap_of_a_region_has_its_interval(data_where):
    truth = truth_with(np.full(27, -0.15), 0.02)
    (region, *_) = regions(data_where, truth, row_gaps(data_where, truth))
    # Quantiles of 500 draws: 0.002.
    assert region.interval == pytest.approx((-0.15 - 0.0329, -0.15 + 0.0329), abs=0.006)


def test_no_gap_no_region(data_where):
    truth = truth_with(np.zeros(27), 0.02)
    assert regions(data_where, truth, row_gaps(data_where, truth)) == ()


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


def test_a_gap_of_a_field_at_one_condition_is_at_all_its_rows(data_where):
    first = {name: np.full_like(v, v[0]) for name, v in data_where.view.conditions.items()}
    one = replace(data_where, view=replace(data_where.view, conditions=first))
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
        data_where = of_slips(slip, surface=(wet, levels))
        assert conditions_to_search(data_where) == ["slip_ratio", "surface"]
        (found,) = regions(data_where, truth, row_gaps(data_where, truth))
        assert found.conditions == {"surface": (1.0, 1.0)}
    # Without the surface, what is left of the slips has fewer than two such rows.
    bare = of_slips(slip)
    (found,) = regions(bare, truth, row_gaps(bare, truth))
    assert found.conditions == {"slip_ratio": (0.6, 0.8)}


def test_inclusion_is_the_sum_over_explanations():
    p = {"none": 0.1, "unknown": 0.1, "a": 0.3, "a+b": 0.2, "a+unknown": 0.2, "b+c+unknown": 0.1}
    assert inclusion_probability(p) == pytest.approx({"a": 0.7, "b": 0.3, "c": 0.1, "unknown": 0.4})


@pytest.mark.parametrize(
    ("probability", "expected"),
    [
        ({"none": 0.6, "a": 0.4}, "none"),
        ({"unknown": 0.6, "a": 0.4}, "unknown"),
        # A listed effect with something unlisted besides is that effect.
        ({"unknown": 0.3, "a+unknown": 0.4, "a": 0.2, "none": 0.1}, "effect"),
        ({"a+b": 0.3, "a+c": 0.3, "none": 0.4}, "effect"),
        ({"a": 0.4, "b": 0.4, "none": 0.2}, "ambiguous"),
    ],
)
def test_the_verdict_is_of_what_acts(probability, expected):
    assert verdict(probability) == expected


@pytest.mark.parametrize("name", [None, *LARGE])
def test_shares_sum_to_one_and_probabilities_are_those_of_the_ranking(name):
    found = diagnosis_of(name)
    parts = [*found.inclusion.causes.values(), found.inclusion.residual_discrepancy]
    # Without any gap there is nothing to share out.
    total = sum(p.share for p in parts)
    assert total == pytest.approx(1.0) or (name is None and total == 0.0)
    sums = inclusion_probability(found.ranking.probability)
    for cause in CHOICE:
        assert found.inclusion.causes[cause].probability == pytest.approx(sums[cause])
    if name is not None:
        assert found.inclusion.acting == [name]
        assert found.inclusion.causes[name].share > 0.5


def test_sets_do_not_depend_on_the_order_of_the_effects():
    from calib.gap.ranking import rank
    from tests.gap.cases import campaigns_of

    data = campaigns_of("sensor_drift", "pull")
    names = ["force_offset", "sensor_drift", "lug_thrust"]
    one, other = (
        rank(data, 3, effects={n: CHOICE[n] for n in order if n in CHOICE})
        for order in (names, names[::-1])
    )
    assert set(one.probability) == set(other.probability)
    for name, p in one.probability.items():
        assert other.probability[name] == pytest.approx(p, abs=0.02)
    assert np.isfinite(list(one.log_evidence.values())).any()


def pair_of(offset: float, drift: float):
    """An offset and a drift of known sizes, in ruts of which neither does anything."""
    data = campaigns_of(None)
    few = singles(data, {n: CHOICE[n] for n in ("force_offset", "sensor_drift")})
    found = fit_at(data, joined(*few))
    one, other = found.forward.phi_slices
    psi = found.psi.copy()
    psi[one], psi[other.start] = offset, drift
    for each in found.forward.form_slices.values():
        for part in each:
            psi[part] = 0.0
    return data, moved(found, psi)


def test_the_size_of_a_cause_is_what_goes_with_it_over_all_field_rows():
    data, found = pair_of(0.06, 0.2)
    field = found.forward.field(found.psi[None], data.view)["drawbar_pull"][0]
    alone = found.psi.copy()
    alone[found.forward.phi_slices[0]] = 0.0
    only_drift = found.forward.field(alone[None], data.view)["drawbar_pull"][0]
    plain = found.forward.simulator(found.psi[None], data.view)["drawbar_pull"][0]
    sizes = _sizes(data, found, np.stack([found.psi, alone]))
    assert sizes.shape == (2, 2)
    n = 54  # of both outputs
    offset = np.sqrt(np.square((field - only_drift) / SIGMA["drawbar_pull"]).sum() / n)
    drift = np.sqrt(np.square((only_drift - plain) / SIGMA["drawbar_pull"]).sum() / n)
    np.testing.assert_allclose(sizes, [[offset, drift], [0.0, drift]], rtol=1e-6, atol=1e-9)
    assert offset == pytest.approx(2.0 * np.sqrt(0.5))


def test_regions_are_listed_as_long_as_few_of_them_are_expected_to_be_none(data_where):
    slip = data_where.view.slip()
    sure, open_ = slip > 0.5, slip < 0.15
    # In nine draws of ten both lie beyond the noise, in the tenth the first alone does.
    for share, listed, rate in ((0.9, 2, 0.05), (0.7, 1, 0.0)):
        truth = truth_with(np.where(sure, -0.15, 0.0))
        acts = np.arange(500) < 500 * share
        truth.truth["drawbar_pull"][:] += 0.1 * np.outer(acts, open_)
        found = regions(data_where, truth, row_gaps(data_where, truth))
        assert len(found) == listed
        assert [r.gap < 0.0 for r in found] == [True, False][:listed]
        assert false_discovery_rate(found) == pytest.approx(rate)
    assert false_discovery_rate(()) == 0.0


@pytest.mark.parametrize(("rate", "least", "most"), [(1.0, 40, 200), (FALSE_REGIONS, 0, 10)])
def test_of_null_fields_few_list_any_region(data_where, monkeypatch, rate, least, most):
    """Noise alone, judged as if each row had a gap by itself, of three noise sds beforehand.

    So the posterior is nearly the reading's own. Without a limit many stretches are taken for gaps.
    """
    monkeypatch.setattr("calib.gap.mixture.FALSE_REGIONS", rate)
    rng, name, draws, shrunk = np.random.default_rng(1), "drawbar_pull", 400, 0.9
    plain, sd = np.ones((draws, 27)), np.full((draws, 27), NOISE)
    listed = 0
    for _ in range(200):
        gap = shrunk * rng.standard_normal(27) + shrunk**0.5 * rng.standard_normal((draws, 27))
        true = {name: plain + NOISE * gap}
        truth = Truth({name: plain}, true, {name: sd}, true, np.full(draws, 1.0 / draws))
        listed += bool(regions(data_where, truth, row_gaps(data_where, truth)))
    assert least <= listed <= most
