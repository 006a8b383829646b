"""Gigantic outliers: set aside with a warning, in either campaign; they name no cause."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import norm

import calib.gap.screening as module
from calib.errors import CalibError
from calib.gap.campaigns import campaigns
from calib.gap.diagnose import screened_ranking
from calib.gap.effects import EFFECTS
from calib.gap.ranking import calibrate_lab
from calib.gap.screening import (
    LAB_OUTLIER,
    OUTLIER,
    _lab_residuals,
    _most,
    _possible,
    _without_lab_outliers,
    left_over,
    without_field_outliers,
    without_outputs,
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


@pytest.mark.parametrize(("campaign", "bar"), [("lab", LAB_OUTLIER), ("field", OUTLIER)])
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


@pytest.mark.parametrize(("rows", "most"), [(3, 1), (19, 1), (20, 2), (57, 5)])
def test_a_tenth_of_the_rows_may_be_outliers_and_one_always(rows, most):
    assert _most(rows) == most


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


def test_residuals_of_the_laboratory_are_in_sds_of_a_normal():
    """Whose middle half lies within 0.6745 of them, whatever the outliers."""
    case = spoiled(make_case(None, models=PULL_ONLY), "lab", 3, 9.0)
    data = campaigns(case)
    mode = calibrate_lab(data, 1)[0]["drawbar_pull"]
    z = _lab_residuals(data.outputs[0], mode)
    assert np.median(np.abs(z - np.median(z))) == pytest.approx(norm.ppf(0.75), rel=1e-4)


def ranked(**z):
    """A ranking whose best hypothesis leaves these residuals, and another that leaves others."""
    fits = {
        "best": SimpleNamespace(field_residuals=z),
        "other": SimpleNamespace(field_residuals={o: np.full(27, 9.0) for o in z}),
    }
    return SimpleNamespace(order=["best", "other"], best=fits.__getitem__)


def test_field_rows_beyond_five_sds_of_the_best_are_set_aside_and_beyond_three_and_a_half_named():
    case = make_case(None, models=PULL_ONLY)
    data = campaigns(case)
    z = np.zeros(27)
    z[[2, 4, 9, 11, 20]] = 3.5, -3.6, 5.0, -5.01, 5.3
    ranking = ranked(drawbar_pull=z)
    kept, (told,) = without_field_outliers(data, ranking)
    assert kept.outputs[0].rows.tolist() == [i for i in range(27) if i not in (11, 20)]
    lines = case.field.lines
    assert [told.find(f"line {lines[i]} ") > 0 for i in (9, 11, 20)] == [False, True, True]
    (said,) = left_over(data, ranking)
    at = [said.find(f"line {lines[i]} ({z[i]:+.1f} noise sds)") for i in (20, 11, 9, 4)]
    assert at == sorted(at)
    assert at[0] > 0
    assert f"line {lines[2]} " not in said
    # Conditions stay, for what happened there is known.
    np.testing.assert_array_equal(kept.view.slip(), data.view.slip())


def test_none_or_many_are_no_outliers():
    data = campaigns(make_case(None, models=PULL_ONLY))
    z = np.zeros(27)
    assert without_field_outliers(data, ranked(drawbar_pull=z)) == (data, [])
    assert without_field_outliers(data, ranked(drawbar_pull=z))[0] is data
    assert left_over(data, ranked(drawbar_pull=z)) == []
    z[:3] = 8.0  # a tenth of 27 is two
    assert without_field_outliers(data, ranked(drawbar_pull=z))[0] is data


def test_rows_are_counted_among_those_that_have_the_output():
    case = make_case(None, models=PULL_ONLY)
    part = campaigns(without_outputs(case, {"drawbar_pull": [0, 1]}))
    assert part.outputs[0].rows.tolist() == list(range(2, 27))
    z = np.zeros(25)
    z[3] = 7.0
    kept, _ = without_field_outliers(part, ranked(drawbar_pull=z))
    assert kept.outputs[0].rows.tolist() == [i for i in range(2, 27) if i != 5]
    # One row is a single one, however few.
    assert np.isfinite(case.field["drawbar_pull_kn"]).all()


@pytest.mark.parametrize(("share", "aside"), [(0.4, True), (0.6, False)])
def test_readings_most_of_which_are_impossible_are_in_another_unit(share, aside):
    case = make_case(None, models=PULL_ONLY)
    pull = np.array(case.field["drawbar_pull_kn"])
    pull[: round(share * 27)] *= 1000.0
    field = replace(case.field, columns={**case.field.columns, "drawbar_pull_kn": pull})
    found, told = _possible(field, case)
    assert bool(told) == aside
    assert np.isnan(found["drawbar_pull_kn"]).any() == aside


def test_beside_a_calibration_of_one_reading_nothing_is_impossible():
    case = make_case(None, models=PULL_ONLY)
    lab = replace(case.lab, columns={**case.lab.columns, "drawbar_pull_kn": np.ones(30)})
    found, told = _possible(case.field, replace(case, lab=lab))
    assert told == []
    assert found.columns["drawbar_pull_kn"].tolist() == case.field["drawbar_pull_kn"].tolist()


def test_of_the_laboratory_rows_beyond_eight_sds_are_set_aside_three_times_at_most(monkeypatch):
    """Each time one, by the place that it has among the rows that are left."""
    case = make_case(None, models=PULL_ONLY)
    calls = []

    def residuals(o, mode):
        calls.append(mode)
        z = np.full(o.problem.response.size, 8.0)
        z[5] = -8.01
        return z

    def calibrated(data, seed):
        return {"drawbar_pull": data.outputs[0].problem.response.size}, {}

    monkeypatch.setattr(module, "_lab_residuals", residuals)
    monkeypatch.setattr(module, "calibrate_lab", calibrated)
    data, lab, told = _without_lab_outliers(campaigns(case), 1)
    assert calls == [30, 29, 28]
    assert lab[0] == {"drawbar_pull": 27}
    left = np.delete(np.arange(30), [5, 6, 7])
    pull = case.lab["drawbar_pull_kn"]
    assert data.outputs[0].problem.response.tolist() == pull[left].tolist()
    assert [f"line {case.lab.lines[i]} " in t for i, t in zip((5, 6, 7), told, strict=True)] == [
        True, True, True,
    ]  # fmt: skip
