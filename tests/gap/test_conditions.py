"""Conditions that cannot be right: a typing error is set aside, another unit refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.errors import CalibError
from calib.gap.case import Case, read_case
from calib.gap.conditions import check_units, without_far_conditions
from calib.gap.diagnose import screened_ranking
from calib.gap.effects import EFFECTS
from calib.gap.oddities import oddities
from tests.gap.cases import PULL_ONLY, make_case, write_case


def changed(case: Case, campaign: str, column: str, rows, factor: float) -> Case:
    table = getattr(case, campaign)
    columns = {name: np.array(v) for name, v in table.columns.items()}
    columns[column][rows] *= factor
    return replace(case, **{campaign: replace(table, columns=columns)})


def oddities_of(case):
    return oddities(case.lab, case.field, case.models)


@pytest.mark.parametrize("campaign", ["lab", "field"])
def test_a_mistyped_condition_is_set_aside_and_said_so(campaign):
    case = make_case(None)
    bad = changed(case, campaign, "average_ground_pressure_kpa", [5], 1000.0)
    found, (said,) = without_far_conditions(bad)
    table = getattr(found, campaign)
    assert np.isnan(table["drawbar_pull_kn"][5])
    assert np.isnan(table["rut_depth_mm"][5])
    assert np.isfinite(np.delete(table["rut_depth_mm"], 5)).all()
    assert table["average_ground_pressure_kpa"].max() < 300.0
    typed = getattr(bad, campaign)["average_ground_pressure_kpa"][5]
    assert f"(average_ground_pressure_kpa = {typed:.4g}): far from all other rows" in said


def test_one_pressure_in_the_other_unit_is_set_aside():
    case = make_case(None, models=PULL_ONLY)
    bad = changed(case, "field", "inflation_pressure_psi", [5], 6.894757)
    found, (said,) = without_far_conditions(bad)
    assert np.isnan(found.field["drawbar_pull_kn"][5])
    assert "or as in another unit" in said
    # Most rows of one campaign are no mistake of typing.
    whole = changed(case, "field", "inflation_pressure_psi", slice(None), 6.894757)
    assert without_far_conditions(whole) == (whole, [])


def test_a_mistyped_condition_names_no_cause():
    bad = changed(make_case(None), "field", "average_ground_pressure_kpa", [5], 1000.0)
    few = {n: EFFECTS[n] for n in ("force_offset", "sensor_drift")}
    _, ranking, told = screened_ranking(bad, 1, few)
    assert ranking.order[0] == "none"
    assert any("far from all other rows" in said for said in told)


def test_campaigns_as_they_are_measured_are_left_alone():
    case = make_case(None)
    assert without_far_conditions(case) == (case, [])
    # A speed that the laboratory did not have, on a few rows, is no mistake ...
    fast = changed(case, "field", "speed_m_s", slice(0, 4), 8.0)
    assert without_far_conditions(fast) == (fast, [])
    # ... nor is a condition that moves in steps, or one row a little beyond.
    beyond = changed(case, "field", "inflation_pressure_psi", [3], 1.6)
    assert without_far_conditions(beyond) == (beyond, [])


def test_a_column_in_another_unit_is_refused():
    case = changed(make_case(None), "field", "average_ground_pressure_kpa", slice(None), 1e-3)
    with pytest.raises(CalibError, match="average_ground_pressure_kpa is typically") as caught:
        check_units(case)
    assert "check the units" in str(caught.value)
    # What the models do not use may differ as it likes.
    check_units(replace(case, models=PULL_ONLY))


def test_copies_in_the_field_are_counted(tmp_path):
    case = make_case(None, models=PULL_ONLY)
    rows = np.r_[np.arange(27), 3, 4]
    columns = {name: np.array(v)[rows] for name, v in case.field.columns.items()}
    doubled = replace(case, field=replace(case.field, columns=columns, lines=np.arange(29)))
    warnings = oddities_of(read_case(write_case(doubled, tmp_path / "case")))
    assert any("2 of 29 field rows are copies of another" in said for said in warnings)


def test_a_condition_that_the_laboratory_held_constant_is_named(tmp_path):
    case = make_case(None)
    n = case.lab["average_ground_pressure_kpa"].size
    columns = {**case.lab.columns, "average_ground_pressure_kpa": np.full(n, 150.0)}
    written = write_case(replace(case, lab=replace(case.lab, columns=columns)), tmp_path / "case")
    warnings = oddities_of(read_case(written))
    assert any(said.startswith("average_ground_pressure_kpa: held constant") for said in warnings)
