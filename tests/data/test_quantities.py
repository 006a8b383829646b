"""The vocabulary: headers, units, conversions, and declarations of a user's own."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pint
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calib.data import table_from_arrays
from calib.data.quantities import QUANTITIES, UNITS, Quantity, Range, convert
from calib.data.table import accepted_headers, columns_meant, match_headers, parse_header
from calib.errors import CalibError
from calib.models import MODELS

REGISTRY = pint.UnitRegistry()
PAIRS = [
    (unit, quantity.unit) for quantity in QUANTITIES.values() for unit in quantity.units.values()
]


@settings(max_examples=30)
@given(pair=st.sampled_from(PAIRS), value=st.floats(-1e6, 1e6))
def test_conversion_agrees_with_pint_and_comes_back(pair: tuple[str, str], value: float) -> None:
    there = float(convert(value, *pair))
    reference = REGISTRY.Quantity(value, pair[0]).m_as(pair[1])
    assert math.isclose(there, reference, rel_tol=1e-12, abs_tol=1e-300)
    back = float(convert(there, *reversed(pair)))
    assert math.isclose(back, value, rel_tol=1e-12, abs_tol=1e-300)


def test_known_values_and_percent_to_the_last_bit() -> None:
    assert float(convert(30.0, "psi", "kPa")) == pytest.approx(206.842719, rel=1e-8)
    assert float(convert(100.0, "lb/ft**3", "g/cm**3")) == pytest.approx(1.601846, rel=1e-6)
    for percent in range(-100, 101):
        assert float(convert(percent, "percent", "dimensionless")) == percent / 100


def test_conversion_copies_keeps_the_shape_and_nan() -> None:
    values = np.array([[1.0, np.nan]])
    assert convert(values, "kPa", "kPa") is not values
    np.testing.assert_array_equal(convert(values, "MPa", "kPa"), [[1000.0, np.nan]])


@pytest.mark.parametrize(
    ("units", "words"),
    [
        (("furlongz", "m"), ["unknown unit", "furlongz", "expected", "spelling"]),
        (("kPa'", "m"), ["unknown unit", "kPa'"]),
        (("(m", "m"), ["unknown unit", "(m"]),
        (("kPa", "kN"), ["cannot convert 'kPa' to 'kN'", "same dimension"]),
        (("degC", "kelvin"), ["their zeros differ", "absolute unit"]),
    ],
)
def test_impossible_conversions_say_so(units: tuple[str, str], words: list[str]) -> None:
    with pytest.raises(CalibError) as caught:
        convert(1.0, *units)
    for word in words:
        assert word in str(caught.value)


def test_every_column_a_model_uses_is_in_the_vocabulary() -> None:
    for model in MODELS.values():
        assert {*model.conditions, model.output} <= set(QUANTITIES)
        assert QUANTITIES[model.output].role == "output"
    for quantity in QUANTITIES.values():
        assert quantity.kind in UNITS
        assert all(suffix == suffix.lower() for suffix in quantity.units)


def test_every_accepted_header_is_read_as_its_quantity() -> None:
    for quantity in QUANTITIES.values():
        assert accepted_headers(quantity)[0] == quantity.canonical
        for header in accepted_headers(quantity):
            for spelling in (header, header.upper(), f" {header.title()} "):
                column = parse_header(spelling)
                assert column is not None
                assert column.quantity is quantity
        canonical = parse_header(quantity.canonical)
        assert canonical is not None
        assert canonical.unit == quantity.unit


@pytest.mark.parametrize(
    ("header", "canonical", "unit"),
    [
        ("Slip [%]", "slip_ratio", "percent"),
        ("slip%", "slip_ratio", "percent"),
        ("Drawbar pull (kN)", "drawbar_pull_kn", "kN"),
        ("rut_depth_in", "rut_depth_mm", "inch"),
        ("sinkage_m", "rut_depth_mm", "m"),
        ("penetration_resistance_MPa", "cone_index_kpa", "MPa"),
        ("water_content_grav_g_g", "gravimetric_water_content", "dimensionless"),
        ("water_content_vol_m3_m3", "volumetric_water_content", "dimensionless"),
        ("bulk density [g/cm³]", "bulk_density_g_cm3", "g/cm**3"),
        ("bulk_density_Mg_m3", "bulk_density_g_cm3", "Mg/m**3"),
        ("bulk density (g/cm^3)", "bulk_density_g_cm3", "g/cm**3"),
        ("speed (m/s)", "speed_m_s", "m/s"),
        ("replicate", "repeat", "dimensionless"),
    ],
)
def test_spellings(header: str, canonical: str, unit: str) -> None:
    column = parse_header(header)
    assert column is not None
    assert (column.quantity.canonical, column.unit) == (canonical, unit)


@pytest.mark.parametrize(
    "header",
    [
        "", "matric_suction_cm", "operator", "yaw_rate_deg_s", "drawbar_pull_sd_kn",
        "drawbar_pull_kn_lower", "wheel_speed_rpm", "pass_number_note", "slippery_ratio",
    ],
)  # fmt: skip
def test_other_columns_name_no_quantity(header: str) -> None:
    assert parse_header(header) is None


@pytest.mark.parametrize(
    ("header", "words"),
    [
        ("drawbar_pull", ["does not say the unit", "drawbar_pull_lbf"]),
        ("volumetric_water_content_g_g", ["unit of mass ratio", "is a volume ratio"]),
        ("rut_depth_mmm", ["not a known unit", "did you mean rut_depth_mm?"]),
        ("rut depth [µm]", ["multiply the readings by 0.001, and name the column rut_depth_mm"]),
    ],
)
def test_a_wrong_unit_is_named_with_the_allowed_ones(header: str, words: list[str]) -> None:
    with pytest.raises(CalibError) as caught:
        parse_header(header, where="my.csv, line 1")
    for word in [f"my.csv, line 1, column {header!r}", "expected:", "hint:", *words]:
        assert word in str(caught.value)


def test_missing_columns_are_told_at_once_each_with_its_guess() -> None:
    with pytest.raises(CalibError) as caught:
        match_headers(
            ["Slipp [%]", "Pull (lbf)", "kN", "note", "inflationpressure"],
            where="my.csv, line 1",
            required=["slip_ratio", "inflation_pressure_psi", "drawbar_pull_kn"],
        )
    message = str(caught.value)
    assert "no column for slip, inflation_pressure, drawbar_pull; found" in message
    assert "'Slipp [%]': did you mean slip_percent?" in message
    assert "'Pull (lbf)': did you mean drawbar_pull_lbf?" in message
    # A suggestion does not make up a unit.
    assert "'inflationpressure': did you mean inflation_pressure, with its unit" in message
    with pytest.raises(CalibError, match="'pull': did you mean drawbar_pull, with its unit"):
        match_headers(["slip_ratio", "pull"], where="my.csv", required=["drawbar_pull_kn"])
    assert "'kN': did" not in message
    assert "'note': did" not in message
    assert "add the columns slip_ratio (" in message
    # The last words of a name are no misspelling of what may be left out.
    assert columns_meant(["Pull (lbf)"], ["drawbar_pull_kn"], 0.8) == []


def test_a_table_that_lacks_a_column_suggests_the_misspelt_one() -> None:
    table = table_from_arrays({"slip_ratio": [0.1], "drawber_pul_n": [5.0]}, source="my.csv")
    table.must_have("slip_ratio")
    with pytest.raises(CalibError, match=r"my\.csv.*no column for drawbar_pull") as caught:
        table.must_have("slip_ratio", "drawbar_pull_kn")
    assert "did you mean drawbar_pull_n?" in str(caught.value)


def test_unknown_columns_are_set_aside_in_their_order() -> None:
    columns, ignored = match_headers(["b", "slip_ratio", "a", "a"], where="my.csv, line 1")
    assert [c.position for c in columns] == [1]
    assert ignored == ("b", "a", "a")


@pytest.mark.parametrize(
    ("limits", "text"),
    [
        (Range(-1.0, 1.0), "a number from -100 to 100 percent"),
        (Range(0.0, low_open=True), "a number above 0 percent"),
        (Range(0.0), "a number of at least 0 percent"),
        (Range(), "a number in percent"),
    ],
)
def test_ranges_are_told_in_the_unit_of_the_file(limits: Range, text: str) -> None:
    assert limits.describe("dimensionless", "percent") == text


def test_a_bound_reached_through_another_unit_is_inside() -> None:
    assert Range(-1.0, 1.0).holds(np.array([1.0 + 1e-12, -1.0 - 1e-12])).all()
    assert not Range(low=1.0, integer=True).holds(np.array([0.0, 1.5, np.nan])).any()


@pytest.mark.parametrize("unit", ["degF", "kN", "degrees"])
def test_units_that_are_no_factor_of_its_own_are_refused_where_they_are_declared(unit: str) -> None:
    def temperature(**suffixes: str) -> Quantity:
        return Quantity(
            "soil_warmth", "soil_warmth_c", "temperature", "degC", "condition", "of the soil",
            suffixes={"c": "degC", **suffixes},
        )  # fmt: skip

    with pytest.raises(CalibError, match="degC") as caught:
        temperature(f=unit).register()
    assert caught.value.where == "the quantity soil_warmth, suffix 'f'"
    assert "soil_warmth_c" not in QUANTITIES
    try:
        temperature().register()
        assert "soil_warmth_c" in QUANTITIES
    finally:
        QUANTITIES.discard("soil_warmth_c")


def test_declarations_stand_in_for_others_within_a_block() -> None:
    known = QUANTITIES["slip_ratio"]
    other, more = replace(known, description="mine"), replace(known, canonical="my_slip")
    with suppress(ZeroDivisionError), QUANTITIES.standing_in(other, more):
        assert (QUANTITIES["slip_ratio"], QUANTITIES["my_slip"]) == (other, more)
        raise ZeroDivisionError
    assert QUANTITIES["slip_ratio"] is known
    assert "my_slip" not in QUANTITIES
