"""A case made ready: what is wrong is named, and rows without an output are left out."""

from __future__ import annotations

import re
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest

from calib.data import table_from_arrays
from calib.errors import CalibError
from calib.gap.campaigns import campaigns
from calib.gap.case import Case
from calib.gap.plausibility import oddities
from calib.inference.prior_files import DeclaredPriors, default_priors
from tests.gap.cases import PULL_ONLY, make_case, table_without


@pytest.mark.parametrize("campaign", ["lab", "field"])
def test_a_missing_output_is_named(campaign):
    case = make_case()
    table = table_without(getattr(case, campaign), "rut_depth_mm")
    with pytest.raises(CalibError, match="no values of rut_depth_mm"):
        campaigns(replace(case, **{campaign: table}))


def test_a_model_of_another_output_is_refused():
    case = replace(make_case(None), models={"rut_depth": "magic_formula"})
    with pytest.raises(CalibError, match="magic_formula does not predict rut_depth") as refused:
        campaigns(case)
    assert "bekker, modified_bekker" in str(refused.value)


def test_an_unknown_model_is_named():
    with pytest.raises(CalibError, match="no model 'spring'"):
        campaigns(replace(make_case(), models={"drawbar_pull": "spring"}))


def test_a_condition_that_the_model_needs_is_named():
    case = make_case(models=PULL_ONLY)
    with pytest.raises(CalibError, match="slip_ratio"):
        campaigns(replace(case, field=table_without(case.field, "slip_ratio")))


def test_rows_without_an_output_are_left_out_of_that_output_alone():
    case = make_case()
    columns = {k: v.copy() for k, v in case.field.columns.items()}
    columns["drawbar_pull_kn"][[2, 5]] = np.nan
    holed = table_from_arrays(columns, allow_missing=("drawbar_pull_kn",))
    data = campaigns(replace(case, field=holed))
    pull, rut = data.outputs
    assert set(range(27)) - set(pull.rows.tolist()) == {2, 5}
    assert rut.rows.size == 27
    assert np.isfinite(pull.field).all()
    np.testing.assert_allclose(rut.field, np.log(case.field["rut_depth_mm"]))


def test_references_come_from_the_laboratory():
    case = make_case()
    view = campaigns(case).view
    assert view.lab["speed_m_s"] == 0.3
    assert view.load_kn == 5.0
    assert view.order_range == (0.0, 26.0)


def test_ground_pressure_follows_inflation_pressure_as_in_the_data():
    # The cases have ground pressure 30 p^0.5.
    assert campaigns(make_case()).view.ground_exponent == pytest.approx(0.5, abs=1e-9)
    case = make_case()
    columns = dict(case.lab.columns)
    columns["average_ground_pressure_kpa"] = 5.0 * columns["inflation_pressure_psi"] ** 0.8
    steeper = Case(case.name, table_from_arrays(columns), case.field, case.models)
    assert campaigns(steeper).view.ground_exponent == pytest.approx(0.8, abs=1e-9)


def test_without_pressures_the_exponent_is_a_half():
    case = make_case(models=PULL_ONLY)
    bare = [
        table_without(t, "inflation_pressure_psi", "average_ground_pressure_kpa")
        for t in (case.lab, case.field)
    ]
    assert campaigns(Case("bare", *bare, PULL_ONLY)).view.ground_exponent == 0.5


@pytest.mark.parametrize(("power", "exponent"), [(1.4, 1.4), (2.0, 1.5), (-0.3, 0.0)])
@pytest.mark.parametrize("known", ["both", "field"])
def test_the_exponent_is_that_of_a_tyre_on_soft_ground(known, power, exponent):
    """Of the laboratory, else of the field: none below zero, where it would stand on its rim."""
    case = make_case(models=PULL_ONLY)
    tables = []
    for table, other in ((case.lab, power), (case.field, power if known == "field" else 0.7)):
        psi = table["inflation_pressure_psi"]
        columns = {**table.columns, "average_ground_pressure_kpa": 5.0 * psi**other}
        tables.append(table_from_arrays(columns))
    if known == "field":
        alike = np.full(30, 30.0)
        tables[0] = replace(
            tables[0], columns={**tables[0].columns, "inflation_pressure_psi": alike}
        )
    found = campaigns(Case("pressed", *tables, PULL_ONLY)).view.ground_exponent
    assert found == pytest.approx(exponent, abs=1e-9)


def test_a_ground_pressure_by_itself_has_no_exponent():
    case = make_case(models=PULL_ONLY)
    tables = [table_without(t, "inflation_pressure_psi") for t in (case.lab, case.field)]
    assert campaigns(Case("bare", *tables, PULL_ONLY)).view.ground_exponent == 0.5


def test_outputs_are_known_by_name_and_by_role():
    data = campaigns(make_case())
    assert data.names == ("drawbar_pull", "rut_depth")
    assert data.roles == ("pull", "sinkage")
    assert data.with_role("sinkage") == ("rut_depth",)
    assert data.with_role("density") == ()


def test_the_simulators_parameters_are_the_models_without_the_noise():
    pull, rut = campaigns(make_case()).outputs
    assert pull.priors.names == (
        "K_lo", "K_hi", "K_bend", "D_lo", "D_hi", "D_bend", "G_lo", "G_hi", "G_bend", "C",
    )  # fmt: skip
    assert rut.priors.names == ("z_ref", "n0", "n1")
    assert rut.problem.priors.names == (*rut.priors.names, "sigma")


def holed(rows_of_lab, rows_of_field) -> Case:
    """Return a case that lacks the pull of some rows."""
    case = make_case()
    tables = []
    for table, rows in ((case.lab, rows_of_lab), (case.field, rows_of_field)):
        columns = {k: v.copy() for k, v in table.columns.items()}
        columns["drawbar_pull_kn"][rows] = np.nan
        tables.append(table_from_arrays(columns, allow_missing=("drawbar_pull_kn",)))
    return replace(case, lab=tables[0], field=tables[1])


def test_what_was_observed_is_of_the_rows_that_have_it():
    """One output after the other: the laboratory's rows, then the field's, on their scales."""
    case = holed([0, 7], [2, 5, 26])
    data = campaigns(case)
    lab, field = (np.isfinite(t["drawbar_pull_kn"]) for t in (case.lab, case.field))
    expected = [
        case.lab["drawbar_pull_kn"][lab], case.field["drawbar_pull_kn"][field],
        np.log(case.lab["rut_depth_mm"]), np.log(case.field["rut_depth_mm"]),
    ]  # fmt: skip
    np.testing.assert_allclose(data.observed, np.concatenate(expected), rtol=1e-12)
    for name, parts in {"drawbar_pull": (lab, field), "rut_depth": (slice(None),) * 2}.items():
        at = data.at_rows[name]
        slip, psi = (
            np.concatenate([t[c][rows] for t, rows in zip((case.lab, case.field), parts,
                                                          strict=True)])
            for c in ("slip_ratio", "inflation_pressure_psi")
        )  # fmt: skip
        np.testing.assert_array_equal(at.slip, slip)
        np.testing.assert_allclose(at.softness, -np.log(psi / 30.0), atol=1e-12)


def test_other_conditions_are_filled_up_with_what_is_usual():
    """A covariate that they lack is the laboratory's median, or the field's; no output is."""
    case = make_case()
    lab = table_without(case.lab, "pass_number")
    data = campaigns(replace(case, lab=lab))
    slip = np.array([0.1, 0.3, 0.5])
    for view in (
        data.at_conditions({"slip_ratio": slip}), data.at(table_from_arrays({"slip_ratio": slip})),
    ):  # fmt: skip
        expected = {
            "slip_ratio": slip, "run_order": 14.5, "inflation_pressure_psi": 30.0,
            "average_ground_pressure_kpa": 30.0 * 30.0**0.5, "normal_load_kn": 5.0,
            "speed_m_s": 0.3, "pass_number": np.median(case.field["pass_number"]),
        }  # fmt: skip
        assert set(view.conditions) == set(expected)
        for name, values in expected.items():
            np.testing.assert_allclose(view.conditions[name], np.resize(values, 3))
        assert replace(view, conditions=data.view.conditions) == data.view


def test_the_range_of_pressures_is_that_of_both_campaigns():
    case = make_case(models=PULL_ONLY)
    tables = []
    for table, low, high in ((case.lab, 20.0, 41.0), (case.field, 19.0, 40.0)):
        psi = np.clip(table["inflation_pressure_psi"], low, high)
        tables.append(replace(table, columns={**table.columns, "inflation_pressure_psi": psi}))
    data = campaigns(Case("pressed", *tables, PULL_ONLY))
    assert data.simulated["drawbar_pull"]._pressures == (19.0, 41.0)


def test_load_and_order_are_the_recorded_ones_or_usual():
    case = make_case(models=PULL_ONLY)
    bare = [table_without(t, "normal_load_kn", "run_order") for t in (case.lab, case.field)]
    view = campaigns(Case("bare", *bare, PULL_ONLY)).view
    assert (view.load_kn, view.order_range) == (5.0, (0.0, 1.0))
    loaded = [
        replace(t, columns={**t.columns, "normal_load_kn": np.linspace(low, low + 2.0, len(t))})
        for t, low in zip((case.lab, case.field), (3.0, 7.0), strict=True)
    ]
    assert campaigns(Case("both", *loaded, PULL_ONLY)).view.load_kn == pytest.approx(4.0)
    of_field = Case("field", table_without(case.lab, "normal_load_kn"), loaded[1], PULL_ONLY)
    assert campaigns(of_field).view.load_kn == pytest.approx(8.0)


@pytest.mark.parametrize(("n", "refused"), [(4, True), (5, False)])
def test_four_rows_of_the_field_show_no_gap(n, refused):
    case = make_case(models=PULL_ONLY)
    few = replace(case, field=case.field.take(range(n)))
    with pytest.raises(CalibError, match="4 field rows") if refused else nullcontext():
        campaigns(few)


@pytest.mark.parametrize(
    ("lab", "field", "refused"),
    [
        (1.0, 100.0, True), (1.0, 99.0, False), (1.0, 0.01, True), (1.0, 0.0101, False),
        (-1.0, 99.0, False), (-1.0, -100.0, True), (0.0, 1.0, True),
    ],
)  # fmt: skip
def test_outputs_are_compared_by_their_typical_size(lab, field, refused):
    case = make_case(models=PULL_ONLY)
    tables = []
    for table, typical in ((case.lab, lab), (case.field, field)):
        pull = np.full(len(table), typical)
        pull[:2] = 3.0 * typical + 1.0
        tables.append(replace(table, columns={**table.columns, "drawbar_pull_kn": pull}))
    with pytest.raises(CalibError, match="typically") if refused else nullcontext():
        campaigns(Case("sized", *tables, PULL_ONLY))


@pytest.mark.parametrize(
    ("field", "refused"), [(1.0, False), (0.02, False), (0.005, True), (200.0, True)]
)
@pytest.mark.parametrize("unit", [1e-4, 1.0])
def test_outputs_a_hundred_times_apart_are_refused_however_small_they_are(unit, field, refused):
    case = make_case(models=PULL_ONLY)
    lab, there = (
        replace(
            t,
            columns={
                **t.columns,
                "drawbar_pull_kn": f * t["drawbar_pull_kn"],
                "normal_load_kn": unit * t["normal_load_kn"],
            },
        )
        for t, f in ((case.lab, unit), (case.field, unit * field))
    )
    scaled = replace(case, lab=lab, field=there)
    with pytest.raises(CalibError, match="a factor of 100") if refused else nullcontext():
        campaigns(scaled)


@pytest.mark.parametrize(("size", "refused"), [(1.0, False), (1e-3, True), (1e3, True)])
def test_a_load_that_is_assumed_for_effects_and_the_pull_contradicts_is_refused(size, refused):
    case = make_case(models=PULL_ONLY)
    own = default_priors(PULL_ONLY["drawbar_pull"]).read_text().replace("relative_to", "#")
    own = re.sub(
        r"(median|sd|mean) = ([\d.]+)(?=[^\[]*unit = \"kN)",
        lambda m: f"{m[1]} = {5.0 * size * float(m[2])}",
        own.replace("default_reference", "#"),
    )
    lab, there = (
        replace(
            t,
            columns={
                **{name: v for name, v in t.columns.items() if name != "normal_load_kn"},
                "drawbar_pull_kn": size * t["drawbar_pull_kn"],
            },
            header=("slip_ratio", "drawbar_pull_kn (checked)"),
        )
        for t in (case.lab, case.field)
    )
    priors = {"drawbar_pull": DeclaredPriors("own.toml", own)}
    with pytest.raises(CalibError) if refused else nullcontext() as caught:
        campaigns(replace(case, lab=lab, field=there, priors=priors))
    if refused:
        assert "add the column normal_load_kn" in str(caught.value)


def test_field_rows_that_are_the_calibrations_are_counted():
    case = make_case()
    columns = {
        name: np.concatenate([case.lab[name][:3], values[3:]])
        for name, values in case.field.columns.items()
    }
    copied = replace(case, field=table_from_arrays(columns))
    said = oddities(copied.lab, copied.field, copied.models)
    assert any("3 of 27 field rows are rows of the calibration" in w for w in said)
    said = oddities(case.lab, case.field, case.models)
    assert not any("rows of the calibration" in w for w in said)


def test_the_calibration_itself_is_no_field():
    case = make_case()
    with pytest.raises(CalibError, match="every field row is a row of the calibration"):
        campaigns(replace(case, field=case.lab))
