"""Rows that are set aside and warnings about pairs of campaigns."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest

from calib.data import table_from_arrays
from calib.data.quantities import OUTPUTS
from calib.errors import CalibError
from calib.gap.campaigns import campaigns
from calib.gap.case import Case, read_case
from calib.gap.constants import FIELD_OUTLIER, LAB_OUTLIER
from calib.gap.diagnose import diagnose, screened_ranking
from calib.gap.effects import EFFECTS
from calib.gap.files import document
from calib.gap.plausibility import oddities, units_in_doubt
from calib.gap.screening import _possible, check_units, without_far_conditions
from calib.report.gap_words import Tone, gap_verdict
from tests.gap.cases import PULL_ONLY, make_case, table_without, write_case

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


def changed(case: Case, campaign: str, column: str, rows, factor: float) -> Case:
    table = getattr(case, campaign)
    columns = {name: np.array(v) for name, v in table.columns.items()}
    columns[column][rows] *= factor
    return replace(case, **{campaign: replace(table, columns=columns)})


def oddities_of(case):
    units = units_in_doubt(case.lab, case.field, case.models)
    return [*(remark.text for remark in units), *oddities(case.lab, case.field, case.models)]


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
    with pytest.raises(CalibError, match="as where the readings are in bar or MPa") as caught:
        check_units(case)
    assert "correct the unit in the column name" in str(caught.value)
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


@pytest.mark.parametrize(
    ("lab", "field", "refused"),
    [
        (1.0, 0.5, False), (1.0, 100.0, True), (1.0, 0.0101, False), (1.0, 0.01, True),
        (3.0, 300.0, True), (100.0, 1.0, True), (0.0, 1.0, False), (1.0, 0.0, False),
        (-1.0, 300.0, True),
    ],
)  # fmt: skip
def test_conditions_a_hundred_times_apart_are_in_another_unit(lab, field, refused):
    """Of two that may be zero nothing is known by their ratio."""
    case = case_of([lab] * 5, [field] * 5, "slip_ratio")
    with (
        pytest.raises(CalibError, match=r"typically|is usual|in percent")
        if refused
        else nullcontext()
    ):
        check_units(case)


PULL, RUT = OUTPUTS["drawbar_pull"], OUTPUTS["rut_depth"]
NAMES = {
    "ruts in cm": (RUT, 0.1, "mm and cm"),
    "psi as kPa": ("inflation_pressure_psi", 1.0 / 6.895, "psi and kPa"),
    "ratios as percent": ("slip_ratio", 0.01, "a fraction and percent"),
}


def altered(case, **columns):
    field = {name: np.array(v) for name, v in case.field.columns.items()}
    return replace(case, field=table_from_arrays({**field, **columns}))


def said(case) -> str:
    units = units_in_doubt(case.lab, case.field, case.models)
    texts = (*(r.text for r in units), *oddities(case.lab, case.field, case.models))
    return "\n".join(texts)


def test_a_fair_pair_has_nothing_odd():
    assert said(make_case(None)) == ""
    assert said(make_case("sensor_drift")) == ""


def test_a_misspelt_column_is_asked_after():
    case = make_case(None)
    found = said(altered(case, tyre_widht_m=np.ones(len(case.field))))
    assert found.endswith("a column is not used: 'tyre_widht_m': did you mean tyre_width_m?")


def test_outputs_that_are_not_there_are_told_by_others():
    case = make_case(None)
    without = table_without(case.field, PULL)
    assert "have no" not in "\n".join(oddities(case.lab, without, case.models))
    holed = np.array(case.field[RUT])
    holed[[2, 5]] = np.nan
    field = replace(case.field, columns={**case.field.columns, RUT: holed})
    assert "no reading of rut_depth in 2 of 27 field rows" in said(replace(case, field=field))
    ruts = np.array(case.lab[RUT])
    ruts[4] = np.nan
    lab = replace(case.lab, columns={**case.lab.columns, RUT: ruts})
    assert f"no reading of rut_depth in 1 of {len(lab)} calibration rows" in said(
        replace(case, lab=lab)
    )


@pytest.mark.parametrize("what", sorted(NAMES))
def test_another_unit_is_named_with_its_factor(what):
    column, factor, units = NAMES[what]
    case = make_case(None)
    found = said(altered(case, **{column: factor * case.field[column]}))
    assert column in found
    assert units in found


@pytest.mark.parametrize(("header", "factor", "units"), [
    ("normal_load_lbf", 1e3, "are in N;"),
    ("normal_load_n", 224.809, "are in lbf;"),
    ("normal_load_kn", 2.5, ""),
    ("gravimetric_water_content_percent", 1.0, "are in fractions;"),
    ("volumetric_water_content_percent", 1.0, "a fraction and percent"),
    ("speed_m_s", 40.0, ""),  # campaigns may differ in their speed by any factor
])  # fmt: skip
def test_a_covariate_that_no_model_uses_in_another_unit(header, factor, units):
    case = make_case(None)
    (column,) = table_from_arrays({header: np.ones(1)})
    level = {"normal_load_kn": 5.0, "speed_m_s": 0.06}.get(column, 0.1)
    # All but one were held in the calibration.
    spread = 0.5 if column == "volumetric_water_content" else 0.0
    at = level * (1.0 + spread * np.linspace(-1.0, 1.0, len(case.lab)))
    lab = {**case.lab.columns, column: at}
    field = {k: v for k, v in case.field.columns.items() if k != column}
    field[header] = np.full(len(case.field), factor * level)
    found = said(replace(case, lab=table_from_arrays(lab), field=table_from_arrays(field)))
    # By the name that the file has.
    assert (header in found) == bool(units)
    assert units in found


def test_rows_of_one_place_in_the_run_order_are_named_by_line():
    case = make_case(None)
    order = np.arange(1.0, len(case.field) + 1.0)
    assert said(altered(case, run_order=order)) == ""
    order[[4, 7]] = order[2]
    twice = altered(case, run_order=order)
    lines = ", ".join(str(twice.field.lines[i]) for i in (2, 4, 7))
    assert f"lines {lines}: the same run_order as another row" in said(twice)
    # Of a copy of a whole row it is said that it is one.
    rows = np.append(np.arange(len(order)), 5)
    copied = said(
        replace(twice, field=altered(case, run_order=np.arange(len(order))).field.take(rows))
    )
    assert "copies of another" in copied
    assert "the same run_order" not in copied


def test_columns_that_were_swapped_pull_more_than_the_wheel_carries():
    case = make_case(None)
    found = said(altered(case, **{PULL: case.field[RUT], RUT: case.field[PULL]}))
    assert "times the normal load" in found
    assert found.count("means nothing") == 2


def test_new_conditions_without_a_needed_one_are_refused_by_file():
    case = make_case(None)
    fresh = table_without(case.field, "slip_ratio")
    with pytest.raises(CalibError, match="slip_ratio") as error:
        campaigns(replace(case, new_conditions=fresh))
    assert error.value.where == f"{fresh.source}, column 'slip_ratio'"


def with_columns(case, *, lab=None, field=None):
    parts = {"lab": lab or {}, "field": field or {}}
    return replace(case, **{
        name: replace(getattr(case, name), columns={**getattr(case, name).columns, **columns})
        for name, columns in parts.items()
    })  # fmt: skip


@pytest.mark.parametrize(("factor", "odd"), [(3.9, False), (4.1, True)])
@pytest.mark.parametrize("way", ["more", "less"])
def test_outputs_are_odd_from_four_times_on_whatever_their_size(factor, odd, way):
    case = make_case(None, models=PULL_ONLY)
    for unit in (1e-5, 1e-2):
        lab = unit * np.linspace(1.0, 3.0, len(case.lab))
        field = 2.0 * unit * (factor if way == "more" else 1.0 / factor)
        found = said(with_columns(
            case, lab={PULL: lab}, field={PULL: np.full(len(case.field), field)}
        ))  # fmt: skip
        assert (f"{PULL}: typically" in found) == odd
        assert (f"{factor:.3g} times {way}" in found) == odd


@pytest.mark.parametrize(("factor", "odd"), [(9.8, False), (10.2, True)])
@pytest.mark.parametrize("way", ["more", "less"])
def test_conditions_of_overlapping_ranges_are_odd_from_ten_times_on(factor, odd, way):
    case = make_case(None)
    psi = "inflation_pressure_psi"
    lab, field = (np.full(len(t), 2.0) for t in (case.lab, case.field))
    field *= factor if way == "more" else 1.0 / factor
    # One row each of the other's, so that neither lies beyond the other.
    lab[0], field[0] = field[1], lab[1]
    found = said(with_columns(case, lab={psi: lab}, field={psi: field}))
    assert (f"{factor:.3g} times {way}" in found) == odd
    assert ("in another unit" in found) == odd


PULL_doubts = OUTPUTS["drawbar_pull"]


def two_operators(apart: float, *, recorded: bool = True) -> Case:
    """A field of two operators, whose readings are more and less than true by a part of them."""
    case = make_case(models=PULL_ONLY, n_field=56, noise=0.5)
    who = np.arange(len(case.field)) % 2
    pull = case.field[PULL_doubts] * (1.0 + apart * np.where(who == 1, 1.0, -1.0))
    extra = {"operator": tuple(map(str, who))} if recorded else {}
    field = replace(case.field, columns={**case.field.columns, PULL_doubts: pull}, extra=extra)
    return replace(case, field=field)


def test_a_field_far_noisier_than_the_laboratory_is_amber_and_its_column_named():
    found = diagnose(two_operators(0.2), effects=FEW)
    judged = gap_verdict(found)
    assert judged.tone is not Tone.FINE
    assert "times as much as the laboratory's (sd 0.2" in judged.headline
    assert "kN against 0.01" in judged.headline
    assert "differs with 'operator'" in judged.headline
    noisier, column = document(found)["warnings"][:2]
    assert "scatters" in noisier
    assert "'operator', a column that is not used" in column
    assert "[covariates]" in column


def test_without_the_column_the_noise_is_still_said():
    found = diagnose(two_operators(0.2, recorded=False), effects=FEW)
    assert len(found.doubts) == 1
    assert "scatters" in gap_verdict(found).headline


def test_a_field_as_noisy_as_the_laboratory_stays_green_whatever_its_columns():
    found = diagnose(two_operators(0.0), effects=FEW)
    assert found.verdict == "none"
    assert found.doubts == ()
    assert gap_verdict(found).tone is Tone.FINE


def test_an_effect_that_most_of_its_prior_leaves_without_trace_is_weighed():
    case = make_case(None, models=PULL_ONLY)
    small = {
        name: replace(table, columns=dict(table.columns) | {"slip_ratio": table["slip_ratio"] / 14})
        for name, table in (("lab", case.lab), ("field", case.field))
    }
    some = {"post_peak_softening": EFFECTS["post_peak_softening"]}
    _, ranking, _ = screened_ranking(replace(case, **small), 1, some)
    assert "post_peak_softening" not in ranking.not_testable
    assert 0.0 < ranking.probability["post_peak_softening"] < 0.5
