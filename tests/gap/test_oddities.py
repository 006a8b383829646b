"""What looks odd about a pair of campaigns is said, and nothing else is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.data import table_from_arrays
from calib.data.quantities import OUTPUTS
from calib.errors import CalibError
from calib.gap.campaigns import campaigns
from calib.gap.diagnose import screened_ranking
from calib.gap.effects import EFFECTS
from calib.gap.noise import noise_conditions
from calib.gap.plausibility import identical_rows, oddities
from tests.gap.cases import MODELS, PULL_ONLY, make_case, table_without

PULL, RUT = OUTPUTS["drawbar_pull"], OUTPUTS["rut_depth"]
NAMES = {
    "ruts in cm": (RUT, 0.1, "mm and cm"),
    "psi as kPa": ("inflation_pressure_psi", 1.0 / 6.895, "psi and kPa"),
    "ratios as percent": ("slip_ratio", 0.01, "a fraction and percent"),
}


def changed(case, **columns):
    field = {name: np.array(v) for name, v in case.field.columns.items()}
    return replace(case, field=table_from_arrays({**field, **columns}))


def said(case) -> str:
    return "\n".join(oddities(case.lab, case.field, case.models))


def test_a_fair_pair_has_nothing_odd():
    assert said(make_case(None)) == ""
    assert said(make_case("sensor_drift")) == ""


def test_a_misspelt_column_is_asked_after():
    case = make_case(None)
    found = said(changed(case, tyre_widht_m=np.ones(len(case.field))))
    assert found.endswith("a column is not used: 'tyre_widht_m': did you mean tyre_width_m?")


def test_outputs_that_are_not_there_are_told_by_others():
    case = make_case(None)
    without = table_without(case.field, PULL)
    assert "have no" not in "\n".join(oddities(case.lab, without, case.models))
    holed = np.array(case.field[RUT])
    holed[[2, 5]] = np.nan
    field = replace(case.field, columns={**case.field.columns, RUT: holed})
    assert "2 of 27 field rows have no rut_depth" in said(replace(case, field=field))
    ruts = np.array(case.lab[RUT])
    ruts[4] = np.nan
    lab = replace(case.lab, columns={**case.lab.columns, RUT: ruts})
    assert f"1 of {len(lab)} calibration rows have no rut_depth" in said(replace(case, lab=lab))


@pytest.mark.parametrize("what", sorted(NAMES))
def test_another_unit_is_named_with_its_factor(what):
    column, factor, units = NAMES[what]
    case = make_case(None)
    found = said(changed(case, **{column: factor * case.field[column]}))
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
    assert said(changed(case, run_order=order)) == ""
    order[[4, 7]] = order[2]
    twice = changed(case, run_order=order)
    lines = ", ".join(str(twice.field.lines[i]) for i in (2, 4, 7))
    assert f"lines {lines}: the same run_order as another row" in said(twice)
    # Of a copy of a whole row it is said that it is one.
    rows = np.append(np.arange(len(order)), 5)
    copied = said(
        replace(twice, field=changed(case, run_order=np.arange(len(order))).field.take(rows))
    )
    assert "copies of another" in copied
    assert "the same run_order" not in copied


@pytest.mark.parametrize("spread", [0.4, 4.0])
def test_a_state_that_varies_in_the_calibration_alone_is_asked_after(spread):
    """Whatever its unit makes of its size: a speed from 0.8 m/s to 1.2 m/s varies as well."""
    case = make_case(None)

    def with_speeds(lab, field):
        tables = (
            table_from_arrays({**t.columns, "speed_m_s": 1.0 + spread * part * ramp(t)})
            for t, part in ((case.lab, lab), (case.field, field))
        )
        return replace(case, **dict(zip(("lab", "field"), tables, strict=True)))

    def ramp(table):
        return np.linspace(-0.2, 0.2, len(table))

    assert "were the two swapped" in said(with_speeds(1.0, 0.0))
    for lab, field in ((1.0, 1.0), (0.0, 1.0), (0.0, 0.0)):
        assert "were the two swapped" not in said(with_speeds(lab, field))


def test_columns_that_were_swapped_pull_more_than_the_wheel_carries():
    case = make_case(None)
    found = said(changed(case, **{PULL: case.field[RUT], RUT: case.field[PULL]}))
    assert "times the normal load" in found
    assert found.count("means nothing") == 2


@pytest.mark.parametrize(("share", "odd"), [(0.9, False), (1.2, True)])
def test_a_pull_above_the_load_is_named(share, odd):
    case = make_case(None)
    load = case.field["normal_load_kn"]
    assert ("times the normal load" in said(changed(case, **{PULL: share * load}))) is odd


def test_new_conditions_without_a_needed_one_are_refused_by_file():
    case = make_case(None)
    fresh = table_without(case.field, "slip_ratio")
    with pytest.raises(CalibError, match="slip_ratio") as error:
        campaigns(replace(case, new_conditions=fresh))
    assert error.value.where == f"{fresh.source}, column 'slip_ratio'"


def test_readings_left_far_off_are_named_by_line():
    case = make_case(None, models={"drawbar_pull": MODELS["drawbar_pull"]}, n_field=36)
    pull = np.array(case.field[PULL])
    few = {"force_offset": EFFECTS["force_offset"]}
    data, ranking, _ = screened_ranking(case, 1, few)
    none = ranking.best("none")
    row = int(np.argmax(none.field_residuals["drawbar_pull"]))
    pull[row] += 6.0 * none.noise["drawbar_pull"].sd(noise_conditions(data.view))[row]
    data, _, told = screened_ranking(changed(case, **{PULL: pull}), 1, few)
    warnings = "\n".join(told)
    assert f"line {data.case.field.lines[row]} (+" in warnings


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


PSI = "inflation_pressure_psi"


def test_a_covariate_that_is_far_off_throughout_is_met_in_another_unit():
    """Inches that were typed as mm, at other wear in the field than in the calibration."""
    case, n = make_case(None), 27
    name = "tyre_deflection_mm"
    lab = {name: np.full(len(case.lab), 38.0)}
    told = said(with_columns(case, lab=lab, field={name: np.linspace(0.5, 1.5, n)}))
    assert f"{name}: typically 1 against 38, 38 times less" in told
    assert "would not be if the readings are in inch; check the unit" in told
    # As far off, but met in no unit; less far off; and in the right unit.
    for low, high in ((3.0, 3.5), (0.5, 4.5), (12.7, 38.1)):
        fair = with_columns(case, lab=lab, field={name: np.linspace(low, high, n)})
        assert "readings are in" not in said(fair)


def test_a_condition_that_the_calibration_held_constant_is_named():
    """Of those that the simulators have, and where the field varied it."""
    case = make_case(None)
    told = f"{PSI}: held constant in the calibration and varied in the field"
    flat = {PSI: np.full(len(case.lab), 30.0)}
    assert told in said(with_columns(case, lab=flat))
    both = with_columns(case, lab=flat, field={PSI: np.full(len(case.field), 30.0)})
    assert "held constant" not in said(both)
    # Speed is constant in the calibration of every such case; no simulator has it.
    assert "held constant" not in said(case)
    for which in ("lab", "field"):
        tables = {"lab": case.lab, "field": case.field}
        tables[which] = table_without(tables[which], PSI)
        assert "held constant" not in "\n".join(oddities(**tables, models=case.models))


def test_a_state_that_one_table_lacks_was_not_swapped():
    case = make_case(None)
    speeds = np.linspace(0.5, 1.5, len(case.lab))
    varied = with_columns(case, lab={"speed_m_s": speeds})
    without = replace(varied, field=table_without(case.field, "speed_m_s"))
    assert "swapped" not in said(without)
    bare = replace(case, lab=table_without(case.lab, "speed_m_s"))
    assert "swapped" not in said(bare)
    assert "the calibration has no speed_m_s: what depends on it shows in how field" in said(bare)
    assert "the calibration has no" not in said(without)


def test_where_the_passes_of_the_calibration_are_not_recorded_it_is_said_what_is_assumed():
    case = make_case(None)
    told = said(replace(case, lab=table_without(case.lab, "pass_number")))
    assert "the calibration has no pass_number: fresh soil, pass 1, is assumed" in told
    assert "what depends on it" not in told


def test_an_output_that_the_calibration_lacks_is_no_condition():
    case = make_case(None)
    lab = table_without(case.lab, RUT)
    told = "\n".join(oddities(lab, case.field, {"drawbar_pull": MODELS["drawbar_pull"]}))
    assert "the calibration has no" not in told


def test_rows_that_are_the_calibrations_are_counted_in_the_columns_of_both():
    case = make_case(None, models=PULL_ONLY)
    assert identical_rows(case.lab, case.field) == 0
    columns = {n: np.array(v) for n, v in case.field.columns.items()}
    for name in columns:
        columns[name][[2, 7, 8]] = case.lab[name][[4, 0, 0]]
    field = table_from_arrays({**columns, "tyre_width_m": np.linspace(0.2, 0.3, 27)})
    assert identical_rows(case.lab, field) == 3
    told = said(replace(case, field=field))
    assert "3 of 27 field rows are rows of the calibration" in told
    # The third differs from the second by its width.
    assert "copies of another" not in told
    same = said(replace(case, field=table_from_arrays(columns)))
    assert "1 of 27 field rows are copies of another" in same


def test_of_two_rows_with_one_place_both_are_named_and_one_is_enough():
    case = make_case(None)
    order = np.arange(1.0, len(case.field) + 1.0)
    order[9] = order[3]
    twice = changed(case, run_order=order)
    lines = ", ".join(str(twice.field.lines[i]) for i in (3, 9))
    assert f"lines {lines}: the same run_order" in said(twice)


def test_conditions_beyond_the_calibrations_are_said_to_be_so_if_those_varied():
    case = make_case(None)
    beyond = f"{PSI}: no field value lies within the calibration's range"
    for factor in (3.0, 0.2):
        told = said(with_columns(case, field={PSI: factor * case.field[PSI]}))
        assert beyond in told
    # They touch: at one end both have been.
    touching = case.field[PSI] + np.ptp(case.lab[PSI])
    assert beyond not in said(with_columns(case, field={PSI: touching}))
    assert beyond not in said(with_columns(case, field={PSI: case.field[PSI] * (18.0 / 42.0)}))
    flat = {PSI: np.full(len(case.lab), 30.0)}
    told = said(with_columns(case, lab=flat, field={PSI: case.field[PSI] + 31.0}))
    assert "no field value lies within" not in told
