"""Gigantic outliers: set aside with a warning, in either campaign; they name no cause."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.errors import CalibError
from calib.gap.campaigns import campaigns
from calib.gap.constants import FIELD_OUTLIER, LAB_OUTLIER
from calib.gap.diagnose import screened_ranking
from calib.gap.effects import EFFECTS
from calib.gap.screening import (
    _possible,
)
from tests.gap.cases import PULL_ONLY, make_case

FEW = {n: EFFECTS[n] for n in ("force_offset", "sensor_drift", "lug_thrust")}


def spoiled(case, campaign: str, row: int, factor: float):
    table = getattr(case, campaign)
    columns = {name: np.array(v) for name, v in table.columns.items()}
    columns["drawbar_pull_kn"][row] *= factor
    return replace(case, **{campaign: replace(table, columns=columns)})


@pytest.mark.parametrize("campaign", ["lab", "field"])
@pytest.mark.parametrize("effect", [None, "force_offset"])
def test_a_gigantic_outlier_is_set_aside_and_changes_nothing_else(campaign, effect):
    case = make_case(effect, models=PULL_ONLY)
    bad = spoiled(case, campaign, 4, 20.0)
    table = getattr(bad, campaign)
    table = replace(table, source=f"{campaign}.csv", lines=table.lines + 2)
    _, ranking, told = screened_ranking(replace(bad, **{campaign: table}), 1, FEW)
    value = table["drawbar_pull_kn"][4]
    said = f"{campaign}.csv, line 6 (drawbar_pull_kn = {value:.4g}): more than"
    assert any(said in warning for warning in told)
    assert ranking.order[0] == (effect or "none")


@pytest.mark.parametrize(("campaign", "bar"), [("lab", LAB_OUTLIER), ("field", FIELD_OUTLIER)])
def test_an_outlier_that_could_be_a_reading_is_left_out_too(campaign, bar):
    case = make_case(None, models=PULL_ONLY)
    table = getattr(case, campaign)
    pull = table["drawbar_pull_kn"]
    row = int(np.argmax(pull))
    data, ranking, told = screened_ranking(spoiled(case, campaign, row, 3.0), 1, FEW)
    (said,) = told
    assert f"line {table.lines[row]} (drawbar_pull_kn = {3.0 * pull[row]:.4g})" in said
    assert f"more than {bar:g} noise sds off whatever the hypothesis" in said
    (o,) = data.outputs
    left = o.problem.response if campaign == "lab" else o.field
    assert left.tolist() == np.delete(pull, row).tolist()
    assert ranking.order[0] == "none"


def test_a_clean_case_is_left_as_it_is():
    case = make_case(None, models=PULL_ONLY)
    data, _, told = screened_ranking(case, 1, FEW)
    assert told == []
    assert len(data.outputs[0].rows) == len(campaigns(case).outputs[0].rows)


@pytest.mark.slow
def test_many_rows_that_lie_off_are_no_outliers():
    case = make_case(None, models=PULL_ONLY)
    for row in range(0, 27, 3):
        case = spoiled(case, "field", row, 3.0)
    data, ranking, _ = screened_ranking(case, 1, FEW)
    assert data.outputs[0].rows.size == 27
    assert ranking.probability["none"] < 0.5


def test_codes_for_missing_are_no_readings():
    case = make_case("force_offset", models=PULL_ONLY)
    coded = case
    for row in range(0, 27, 3):
        columns = {name: np.array(v) for name, v in coded.field.columns.items()}
        columns["drawbar_pull_kn"][row] = -9999.0 if row else 1e300
        coded = replace(coded, field=replace(coded.field, columns=columns))
    data, ranking, told = screened_ranking(coded, 1, FEW)
    assert data.outputs[0].rows.tolist() == [row for row in range(27) if row % 3]
    (said,) = told
    assert said.count("-9999") == 8
    assert "1e+300" in said
    assert ranking.order[0] == "force_offset"


@pytest.mark.parametrize("rows", [1, 3])
def test_few_rows_are_counted_before_any_is_set_aside(rows):
    case = make_case(None, models=PULL_ONLY)
    few = replace(case, field=case.field.take(np.arange(rows)))
    with pytest.raises(CalibError, match=f"{rows} field rows with drawbar_pull_kn"):
        screened_ranking(few, 1, FEW)


@pytest.mark.parametrize("unit", [1.0, 1e-3, 1e3])
def test_what_cannot_be_a_reading_is_so_in_any_unit(unit):
    """Beyond twenty times the range of the middle eighty hundredths of the calibration."""
    case = make_case(None, models=PULL_ONLY)
    lab = unit * case.lab["drawbar_pull_kn"]
    low, middle, high = np.quantile(lab, (0.1, 0.5, 0.9))
    field = unit * np.array(case.field["drawbar_pull_kn"])
    field[[3, 8]] = middle - 20.0 * (high - low) * np.array([1.01, 0.99])
    lab, field = (
        replace(t, columns={**t.columns, "drawbar_pull_kn": v})
        for t, v in ((case.lab, lab), (case.field, field))
    )
    found, (said,) = _possible(field, replace(case, lab=lab))
    assert np.flatnonzero(np.isnan(found["drawbar_pull_kn"])).tolist() == [3]
    assert "no reading at all" in said


@pytest.mark.parametrize(("share", "aside"), [(0.4, True), (0.6, False)])
def test_readings_most_of_which_are_impossible_are_in_another_unit(share, aside):
    case = make_case(None, models=PULL_ONLY)
    pull = np.array(case.field["drawbar_pull_kn"])
    pull[: round(share * 27)] *= 1000.0
    field = replace(case.field, columns={**case.field.columns, "drawbar_pull_kn": pull})
    found, told = _possible(field, case)
    assert bool(told) == aside
    assert np.isnan(found["drawbar_pull_kn"]).any() == aside
