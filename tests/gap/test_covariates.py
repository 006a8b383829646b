"""Covariates on a scale of -1..1 over both campaigns."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.gap.campaigns import ScaledConditions, campaigns, columns_over, other_conditions
from tests.gap.cases import PULL_ONLY, make_case, table_without


def test_both_campaigns_span_the_scale():
    data = campaigns(make_case(models=PULL_ONLY))
    slip = ScaledConditions(data).scaled(data.view, "slip_ratio")
    both = np.concatenate([data.case.lab["slip_ratio"], data.case.field["slip_ratio"]])
    expected = 2.0 * (data.case.field["slip_ratio"] - both.min()) / np.ptp(both) - 1.0
    np.testing.assert_allclose(slip, expected, atol=1e-12)


def test_speeds_are_even_in_ratios():
    data = campaigns(make_case(models=PULL_ONLY))
    both = np.concatenate([data.view.conditions["speed_m_s"], data.case.lab["speed_m_s"]])
    middle = np.full(27, np.sqrt(both.min() * both.max()))
    view = replace(data.view, conditions={**data.view.conditions, "speed_m_s": middle})
    scaled = ScaledConditions(data).over(view, "speed")
    np.testing.assert_allclose(scaled, 0.0, atol=1e-12)


def test_far_beyond_both_campaigns_it_ends():
    data = campaigns(make_case(models=PULL_ONLY))
    for slip, end in ((9.0, 1.5), (-9.0, -1.5)):
        beyond = {**data.view.conditions, "slip_ratio": np.full(27, slip)}
        view = replace(data.view, conditions=beyond)
        np.testing.assert_array_equal(ScaledConditions(data).scaled(view, "slip_ratio"), end)


@pytest.mark.parametrize("name", ["speed_m_s", "no_such_column"])
def test_what_is_lacking_or_constant_has_no_scale(name: str):
    data = campaigns(make_case(models=PULL_ONLY))
    columns = {**data.view.conditions, "speed_m_s": np.full(27, 1.0)}
    lab = replace(data.case.lab, columns={**data.case.lab.columns, "speed_m_s": np.full(30, 1.0)})
    view = replace(data.view, conditions=columns)
    alike = replace(data, view=view, case=replace(data.case, lab=lab))
    assert ScaledConditions(alike).scaled(view, name) is None


def test_pressure_on_the_ground_stands_for_that_in_the_tyre():
    case = make_case(models={"rut_depth": "modified_bekker"})
    without = replace(
        case, lab=table_without(case.lab, "inflation_pressure_psi"),
        field=table_without(case.field, "inflation_pressure_psi"),
    )  # fmt: skip
    data = campaigns(without)
    covariates = ScaledConditions(data)
    ground = covariates.scaled(data.view, "average_ground_pressure_kpa")
    assert ground is not None
    np.testing.assert_array_equal(covariates.over(data.view, "pressure"), ground)


def test_each_view_has_its_own_values_on_the_scale():
    """The field's are kept for the next who asks, those of other conditions are not."""
    data = campaigns(make_case(models=PULL_ONLY))
    covariates = ScaledConditions(data)
    slip = data.case.field["slip_ratio"]
    field = covariates.scaled(data.view, "slip_ratio")
    for shift in (0.01, 0.05):
        view = replace(data.view, conditions={**data.view.conditions, "slip_ratio": slip + shift})
        found = covariates.scaled(view, "slip_ratio")
        both = np.concatenate([data.case.lab["slip_ratio"], slip])
        np.testing.assert_allclose(found - field, 2.0 * shift / np.ptp(both), rtol=1e-9)
        np.testing.assert_array_equal(covariates.scaled(data.view, "slip_ratio"), field)


@pytest.mark.parametrize(
    ("values", "varies"),
    [
        # By a part in 10^9 of its size, ...
        ([1e6, 1e6 + 0.9e-3], False),
        ([1e6, 1e6 + 1.1e-3], True),
        ([-1e6, -1e6 - 0.9e-3], False),
        ([-1e6, -1e6 - 1.1e-3], True),
        # ... or by 10^-9 where it is less than one.
        ([0.0, 0.9e-9], False),
        ([0.0, 1e-9], True),
        ([0.5, 0.5 + 1.5e-9], True),
    ],
)
def test_what_differs_by_rounding_alone_is_constant(values, varies):
    data = campaigns(make_case(models=PULL_ONLY))
    columns = {**data.view.conditions, "tyre_temperature_c": np.resize(values, 27)}
    scaled = ScaledConditions(replace(data, view=replace(data.view, conditions=columns)))
    found = scaled.over(scaled.data.view, "tyre_temperature_c")
    if not varies:
        assert found is None
    else:
        up = np.sign(values[1] - values[0])
        # The values differ by so little that their own rounding shows.
        np.testing.assert_allclose(found, np.resize([-up, up], 27), rtol=1e-6)


def test_what_other_conditions_are_recorded():
    """Neither an output, nor how runs are counted, nor what a discrepancy knows by itself."""
    data = campaigns(make_case())
    assert other_conditions(data.view) == ()
    more = ("tyre_width_m", "contact_length_mm", "tyre_temperature_c", "cone_index_kpa",
            "volumetric_water_content", "repeat")  # fmt: skip
    view = replace(data.view, conditions=dict.fromkeys(more, np.ones(27)) | data.view.conditions)
    assert other_conditions(view) == ("tyre_width", "contact_length")


@pytest.mark.parametrize(
    ("what", "columns"),
    [
        ("water", ("gravimetric_water_content", "volumetric_water_content")),
        ("pressure", ("inflation_pressure_psi", "average_ground_pressure_kpa")),
        ("low_pressure", ("inflation_pressure_psi",)),
        ("slip", ("slip_ratio",)),
        ("tyre_temperature_c", ("tyre_temperature_c",)),
    ],
)
def test_what_something_may_vary_with_has_its_columns(what, columns):
    assert columns_over(what) == columns
