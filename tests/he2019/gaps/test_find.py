"""The four diagnoses, and what they are compared with."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from scipy.stats import f as f_distribution

from calib.batch.pool import HERE
from calib.gap.diagnose import verdict
from calib.he2019.gaps import (
    Check,
    begin_gaps,
    checks,
    probability_of,
    simulator_sd,
    summarise_gaps,
    unfitted_errors,
)
from calib.inference.calibration import calibrate
from calib.models.bekker import rut_depth as eq_21
from calib.models.magic_formula import magic_formula

NAMES = ("plain_bekker", "nominal_slip", "held_out_pull", "post_peak_18_psi")


def values(result, name) -> dict[str, float]:
    found: dict[str, Check] = {check.name: check for check in checks(result)}
    return dict(found[name].values)


@pytest.mark.parametrize("name", NAMES)
def test_every_diagnosis_runs_and_its_probabilities_sum_to_one(found_gaps, name):
    result = found_gaps[name]
    for found in (result.found, *result.variants.values()):
        p = found.ranking.probability
        assert math.isclose(sum(p.values()), 1.0, abs_tol=1e-9)
        assert found.verdict == verdict(p)
        assert {"none", "unknown", "parameter_shift"} <= set(p)
        assert any("reconstructed" in warning for warning in found.warnings)
    withheld = result.gap.withheld
    assert withheld is None or withheld in result.found.ranking.probability


@pytest.mark.parametrize("name", ["plain_bekker", "nominal_slip"])
def test_a_withheld_effect_is_the_most_probable_and_shrinks_the_error_of_rows_not_fitted(
    found_gaps, name
):
    result = found_gaps[name]
    assert result.found.ranking.order[0] == result.gap.withheld
    # Named: more probable than all others together. Fourteen rows leave room for the unlisted.
    assert probability_of(result.found, result.gap.withheld) > 0.5
    errors = unfitted_errors(result.found, result.gap)
    assert errors.n == 7
    assert errors.rmse_after < 0.5 * errors.rmse_before
    # Of seven, fewer than five are within a true 90 % band in 2.6 % of campaigns.
    assert errors.covered >= 5


def test_the_deepening_agrees_with_table_6(found_gaps):
    v = values(found_gaps["plain_bekker"], "deepening_at_20_percent_slip")
    assert v["lower_90"] < v["eq_21_with_table_6"] < v["upper_90"]
    # By hand: pressures of 18 and 42 psi, slips of 20 and 1.25 %.
    case = found_gaps["plain_bekker"].gap.case.field
    pressures = np.unique(case["average_ground_pressure_kpa"])
    k, n0, n1 = 3.306e5, 1.996, 1.266
    ratio = eq_21(pressures, 0.2, k, n0, n1) / eq_21(pressures, 0.0125, k, n0, n1)
    assert v["eq_21_with_table_6"] == pytest.approx(ratio.mean(), rel=1e-12)


def test_the_shift_is_found_with_its_sign_and_to_within_half_its_size(found_gaps):
    result = found_gaps["nominal_slip"]
    v = values(result, "shift_at_zero_slip")
    assert v["withheld_percent"] == 2.0
    for name in ("shift_at_zero_slip", "halves_swapped"):
        assert abs(values(result, name)["mean_percent"] - 2.0) < 1.0
    # Given back, there is nothing to find.
    assert result.variants["slips given back"].verdict == "none"
    assert values(result, "slips_given_back")["probability_none"] > 0.9
    probability = result.variants["slips given back"].ranking.probability
    rival = max((n for n in probability if n != "none"), key=lambda n: probability[n])
    assert rival == "unknown"


def test_table_4_alone_says_that_18_psi_is_fitted_worse(found_gaps):
    v = values(found_gaps["post_peak_18_psi"], "costs_in_table_4")
    ratio = (0.0485 / 10) / ((0.0091 + 0.0083) / 20)
    assert v["variance_ratio"] == pytest.approx(ratio)
    assert v["p_value"] == pytest.approx(1.0 - f_distribution.cdf(ratio, 10, 20), rel=1e-6)


def test_the_variance_ratio_is_f_distributed_where_the_formula_is_right():
    """The p-value counts the formula's four parameters; checked by fits to simulated pulls."""
    from scipy.optimize import least_squares

    slip = np.array([2, 4.5, 7, 9.5, 12, 14.5, 17, 19.5, 22, 32, 42, 52, 62, 72.0])
    theta = {18: (0.0794, 1.5619, 1.648, -0.1026), 30: (0.0713, 1.5685, 1.0071, -6.0844),
             42: (0.1265, 1.4802, 0.5954, -8.1747)}  # fmt: skip
    rng = np.random.default_rng(4)
    ratios = []
    for _ in range(60):
        cost = {}
        for psi, start in theta.items():
            pull = magic_formula(slip, *start) + 0.01 * rng.standard_normal(slip.size)
            fitted = least_squares(
                lambda t, pull=pull: magic_formula(slip, *t) - pull, start, x_scale=np.abs(start)
            )
            cost[psi] = 2.0 * fitted.cost
        ratios.append(2.0 * cost[18] / (cost[30] + cost[42]))
    share = np.mean(f_distribution.cdf(ratios, 10, 20))
    assert abs(share - 0.5) < 3.0 / np.sqrt(12.0 * len(ratios))


def test_what_the_calibration_left_open_is_what_a_sampled_posterior_says(
    found_gaps, pull_calibration
):
    """Two pressures leave 30 psi open: importance sampling against emcee."""
    result = found_gaps["held_out_pull"]
    problem = pull_calibration.problem
    assert sorted(problem.table["drawbar_pull_kn"]) == sorted(
        result.gap.case.lab["drawbar_pull_kn"]
    )
    theta = problem.theta(pull_calibration.subset(2000))[:, :-1]
    conditions = problem.bound.model.select(result.gap.case.field.columns)
    sd = problem.bound.predict(theta, conditions).std(axis=0)
    rms = [float(np.sqrt(np.mean(x**2))) for x in (result.open_sd, sd)]
    assert rms[0] == pytest.approx(rms[1], rel=0.1)


def test_what_a_calibration_of_six_rows_left_open(found_gaps):
    """The noise is hardly known, and a normal about the mode would be far too narrow."""
    result = found_gaps["plain_bekker"]
    problem = result.found.data.outputs[0].problem
    sampled = calibrate(problem, 3)
    assert sampled.converged
    theta = problem.theta(sampled.subset(3000))[:, :-1]
    conditions = problem.bound.model.select(result.gap.case.field.columns)
    sd = problem.bound.predict(theta, conditions).std(axis=0)
    np.testing.assert_allclose(result.open_sd, sd, rtol=0.1)


def test_the_summary_is_json_and_holds_every_gap(found_gaps):
    summary = json.loads(json.dumps(summarise_gaps(list(found_gaps.values())), allow_nan=False))
    assert tuple(summary) == NAMES
    for name, one in summary.items():
        found = found_gaps[name].found
        assert one["best"] == found.ranking.order[0]
        assert one["probability"] == dict(found.ranking.probability)
        assert set(one["variants"]) == set(found_gaps[name].variants)
        assert set(one["checks"]) == {check.name for check in checks(found_gaps[name])}
        for output, shrink in found.shrink.items():
            assert one["shrink"][output]["interval"] == list(shrink.interval)


def test_same_seed_same_numbers(found_gaps):
    first = found_gaps["plain_bekker"]
    said = []
    (again,) = begin_gaps(first.found.seed, [first.gap], HERE)(lambda *a: said.append(a[1:]))
    assert summarise_gaps([again]) == summarise_gaps([first])
    np.testing.assert_array_equal(simulator_sd(again.found), first.open_sd)
    assert said == [(1, 1)]
