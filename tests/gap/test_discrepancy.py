"""Free discrepancies: their shapes, and where they set in."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.gap.case import Campaigns
from calib.gap.discrepancy import Discrepancy
from calib.gap.hypothesis import Hypothesis
from tests.gap.cases import campaigns_of

PULL = ("drawbar_pull",)


@pytest.fixture(scope="module")
def data() -> Campaigns:
    return campaigns_of(None)


def of(data: Campaigns, **kwargs) -> Discrepancy:
    lab_mode = {o.name: np.array([p.loc for p in o.priors.free]) for o in data.outputs}
    h = Hypothesis("unknown", smooth=1.0, smooth_outputs=PULL, **kwargs)
    return Discrepancy(data, h, lab_mode)


def test_over_slip_it_is_cosines_of_slip_and_a_trend_with_pressure(data):
    found = of(data, smooth_over="slip")
    sds = found.sds("drawbar_pull")
    size = sds.size
    assert sds[0] == 1.0
    slip = found.covariates.scaled(data.view, "slip_ratio")
    second = np.zeros((1, size))
    second[0, 2] = 1.0
    curve = found.at(second, np.empty(0), data.view, "drawbar_pull")[0]
    np.testing.assert_allclose(curve, np.sqrt(2.0) * np.cos(np.pi * (slip + 1.0)), atol=1e-12)


def test_over_one_condition_alone_it_is_added_or_a_part_of_the_pull(data):
    found = of(data, smooth_over="pressure")
    pressures = np.unique(data.view.conditions["inflation_pressure_psi"]).size
    sds = found.sds("drawbar_pull")
    # A constant and as many cosines as tell the pressures apart, by themselves and times the pull.
    assert sds.size == 2 * pressures
    at = data.view.conditions["inflation_pressure_psi"] == np.median(
        data.view.conditions["inflation_pressure_psi"]
    )
    level = found._level(data.view, "drawbar_pull")
    basis = found.at(np.eye(sds.size), np.empty(0), data.view, "drawbar_pull").T
    for wanted in (at * 1.0, at * level):
        np.testing.assert_allclose(basis @ np.linalg.lstsq(basis, wanted)[0], wanted, atol=1e-9)


def test_ripples_are_of_any_length_down_to_a_twelfth_of_the_slips(data):
    found = of(data, smooth_over="ripple")
    sds = found.sds("drawbar_pull")
    assert sds.size == 25
    np.testing.assert_allclose(sds[1:], sds[1])
    np.testing.assert_allclose(np.sum(sds[1:] ** 2), 1.0)
    slip = found.covariates.scaled(data.view, "slip_ratio")
    shortest = np.zeros((1, 25))
    shortest[0, 24] = 1.0
    curve = found.at(shortest, np.empty(0), data.view, "drawbar_pull")[0]
    np.testing.assert_allclose(curve, np.sqrt(2.0) * np.cos(12.0 * np.pi * (slip + 1.0)))


@pytest.mark.parametrize(
    "over",
    ["slip", "ripple", "level", "sinkage", "order", "pressure", "speed", "passes", "water", "all"],
)
def test_it_is_the_same_function_at_other_conditions(data, over):
    found = of(data, smooth_over=over)
    amplitudes = np.random.default_rng(1).standard_normal((3, found.sds("drawbar_pull").size))
    whole = found.at(amplitudes, np.empty(0), data.view, "drawbar_pull")
    rows = np.array([4, 0, 17])
    some = replace(data.view, conditions={k: v[rows] for k, v in data.view.conditions.items()})
    part = found.at(amplitudes, np.empty(0), some, "drawbar_pull")
    np.testing.assert_allclose(part, whole[:, rows], atol=1e-12)


def test_it_sets_in_at_a_threshold_as_a_step_and_a_bend(data):
    found = of(data, onset_over="slip")
    np.testing.assert_array_equal(found.sds("drawbar_pull"), [1.0, 2.0])
    u = found.onset_covariate(data.view, "drawbar_pull")
    step, bend = found.onset(data.view, "drawbar_pull", np.array([0.1]))
    far = abs(u - 0.1) > 0.6  # ten widths
    np.testing.assert_allclose(step[0, far], (u > 0.1)[far], atol=1e-4)
    np.testing.assert_allclose(bend[0, far], np.maximum(u - 0.1, 0.0)[far], atol=1e-4)
    both = found.at(np.array([[0.2, -0.3]]), np.array([0.1]), data.view, "drawbar_pull")
    np.testing.assert_allclose(both, 0.2 * step - 0.3 * bend)


def test_a_reading_that_keeps_part_of_the_run_before(data):
    found = of(data, smooth_over="before")
    o = next(o for o in data.outputs if o.name == "drawbar_pull")
    theta = o.priors.to_natural(found.lab_mode["drawbar_pull"][None])
    selected = o.problem.bound.model.select(data.view.conditions)
    pull = o.problem.bound.location(theta, selected)[0]
    as_they_are = found.at(np.array([[0.3]]), np.empty(0), data.view, "drawbar_pull")[0]
    np.testing.assert_allclose(np.sqrt(np.mean(as_they_are**2)), 0.3)
    # The order of the runs counts, not that of the rows.
    runs = np.random.default_rng(2).permutation(pull.size)
    order = np.empty(pull.size)
    order[runs] = np.arange(pull.size)
    shuffled = replace(data.view, conditions={**data.view.conditions, "run_order": order})
    gap = found.at(np.array([[0.3]]), np.empty(0), shuffled, "drawbar_pull")[0]
    kept = gap[runs[1:]] / (pull[runs[:-1]] - pull[runs[1:]])
    np.testing.assert_allclose(kept, kept[0])
    assert kept[0] > 0.0
    assert gap[runs[0]] == 0.0


def test_without_an_order_nothing_is_kept_of_the_run_before(data):
    found = of(data, smooth_over="before")
    n = data.view.slip().size
    unknown = replace(data.view, conditions={**data.view.conditions, "run_order": np.full(n, 7.0)})
    assert not found.at(np.ones((1, 1)), np.empty(0), unknown, "drawbar_pull").any()
