"""Conditions that cannot be right: a typing error is set aside, another unit refused."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest

from calib.data import table_from_arrays
from calib.errors import CalibError
from calib.gap.case import Case, read_case
from calib.gap.diagnose import screened_ranking
from calib.gap.effects import EFFECTS
from calib.gap.plausibility import oddities
from calib.gap.screening import check_units, without_far_conditions
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
    with pytest.raises(CalibError, match="average ground pressure is typically") as caught:
        check_units(case)
    assert "check the units" in str(caught.value)
    assert "column 'average_ground_pressure_kpa'" in str(caught.value)
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


PSI = 6.894757


def case_of(lab, field, column: str) -> Case:
    """Return a case whose campaigns differ in one column, and an output in every row."""
    tables = []
    for values in (lab, field):
        n = len(values)
        made = table_from_arrays({"slip_ratio": np.full(n, 0.2), "drawbar_pull_kn": np.ones(n)})
        tables.append(replace(made, columns={**made.columns, column: np.array(values, float)}))
    return Case("made", *tables, PULL_ONLY)


def set_aside(lab, field=(), column: str = "tyre_temperature_c") -> list[float]:
    """Return the values of the rows that are set aside, the laboratory's first."""
    case = case_of(lab, field, column)
    found, said = without_far_conditions(case)
    off = [np.isnan(table["drawbar_pull_kn"]) for table in (found.lab, found.field)]
    for was, now, rows in zip((case.lab, case.field), (found.lab, found.field), off, strict=True):
        np.testing.assert_array_equal(was[column][~rows], now[column][~rows])
        if rows.any():
            np.testing.assert_array_equal(now[column][rows], np.median(was[column][~rows]))
    assert len(said) == sum(rows.any() for rows in off)
    return [*np.array(lab)[off[0]], *np.array(field)[off[1]]]


def spread(low: float, high: float, n: int = 8) -> list[float]:
    """Values of which the second least and the second greatest are the ends."""
    return np.r_[low, np.linspace(low, high, n), high].tolist()


@pytest.mark.parametrize(
    ("values", "other", "far"),
    [
        # Of positive quantities eight times as much, or an eighth ...
        ([0.3] * 10, 0.3 * 7.99, False),
        ([0.3] * 10, 0.3 * 8.01, True),
        ([0.3] * 10, 0.3 / 7.99, False),
        ([0.3] * 10, 0.3 / 8.01, True),
        # ... or one and a half times their range beyond, by factors: 4 e^(1.5 ln 16) = 256.
        (spread(0.25, 4.0), 255.0, False),
        (spread(0.25, 4.0), 257.0, True),
        (spread(0.25, 4.0), 1.0 / 255.0, False),
        (spread(0.25, 4.0), 1.0 / 257.0, True),
        # Of others one and a half times their range by differences, not just reached, ...
        (spread(-1.0, 1.0), 4.0, False),
        (spread(-1.0, 1.0), 4.01, True),
        (spread(-1.0, 1.0), -4.0, False),
        (spread(-1.0, 1.0), -4.01, True),
        # ... or half their size, ...
        ([-2.0] * 10, -1.01, False),
        ([-2.0] * 10, -0.99, True),
        (spread(0.0, 4.0), 10.0, False),
        (spread(-2.0, -1.9), -0.95, False),
        (spread(-2.0, -1.9), -0.85, True),
        ([2.0] * 10, -0.01, True),
        # ... or a tenth.
        ([0.0] * 10, 0.1, False),
        ([0.0] * 10, 0.11, True),
        ([0.0] * 10, -0.11, True),
    ],
)  # fmt: skip
def test_how_far_a_value_may_be_from_all_others(values, other, far):
    for lab, field in (([*values, other], values), (values, [other, *values])):
        assert set_aside(lab, field) == ([other] if far else [])


@pytest.mark.parametrize(("n", "most"), [(10, 1), (15, 1), (20, 2), (29, 2), (30, 3), (40, 4)])
def test_more_than_one_in_twenty_is_the_campaigns_own_way(n, most):
    """Of twice so many rows; of few it is one."""
    for k in (most, most + 1):
        far = [100.0] * k
        assert set_aside([1.0] * n, [*far, *[1.0] * (n - k)]) == (far if k == most else [])
        assert set_aside([-1.0] * n, [*far, *[-1.0] * (n - k)]) == (far if k == most else [])


def test_of_three_values_nobody_knows_which_is_the_odd_one():
    assert set_aside([1.0, 1.0], [100.0]) == []
    assert set_aside([1.0, 1.0], [1.0, 100.0]) == [100.0]


@pytest.mark.parametrize(("n", "most"), [(10, 1), (20, 2), (40, 4)])
def test_a_few_pressures_may_be_in_another_unit(n, most):
    values = np.resize([18.0, 30.0], n)
    for k in (most, most + 1):
        other = values * np.where(np.arange(n) < k, PSI, 1.0)
        found = set_aside(values, other, "inflation_pressure_psi")
        assert found == (other[:k].tolist() if k == most else [])


@pytest.mark.parametrize("column", ["run_order", "drawbar_pull_kn"])
def test_neither_the_order_of_runs_nor_an_output_is_a_condition(column):
    case = case_of([1.0] * 9, [*[1.0] * 8, 1e4], column)
    assert without_far_conditions(case) == (case, [])


def test_a_condition_of_the_field_alone_is_left_alone():
    case = case_of([1.0] * 9, [*[1.0] * 8, 1e4], "tyre_temperature_c")
    alone = replace(case, lab=case_of([1.0] * 9, [1.0] * 9, "slip_ratio").lab)
    assert without_far_conditions(alone) == (alone, [])


def test_a_category_has_no_distances():
    case = case_of([0.0] * 9, [*[0.0] * 8, 7.0], "operator")
    named = replace(case, covariates={"operator": tuple("abcdefgh")})
    assert without_far_conditions(named) == (named, [])
    assert len(without_far_conditions(case)[1]) == 1


@pytest.mark.parametrize(
    ("lab", "field", "refused"),
    [
        (1.0, 99.0, False), (1.0, 100.0, True), (1.0, 0.0101, False), (1.0, 0.01, True),
        (3.0, 300.0, True), (100.0, 1.0, True), (0.0, 1.0, False), (1.0, 0.0, False),
        (-1.0, 300.0, False),
    ],
)  # fmt: skip
def test_conditions_a_hundred_times_apart_are_in_another_unit(lab, field, refused):
    """Of two that may be zero or negative nothing is known by their ratio."""
    case = case_of([lab] * 5, [field] * 5, "slip_ratio")
    with pytest.raises(CalibError, match="slip is typically") if refused else nullcontext():
        check_units(case)


@pytest.mark.parametrize("campaign", ["lab", "field"])
def test_a_condition_that_is_lacking_has_no_unit(campaign):
    case = case_of([1.0] * 5, [1e3] * 5, "slip_ratio")
    table = getattr(case, campaign)
    without = {"drawbar_pull_kn": table["drawbar_pull_kn"]}
    check_units(replace(case, **{campaign: replace(table, columns=without)}))
