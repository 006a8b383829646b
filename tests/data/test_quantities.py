import numpy as np
import pytest

from calib.data.quantities import QUANTITIES, UNITS, Quantity, Range
from calib.data.reader import table_from_arrays
from calib.data.table import accepted_headers, columns_meant, match_headers, parse_header
from calib.errors import CalibError
from calib.models import MODELS


def test_every_column_a_model_uses_is_in_the_dictionary() -> None:
    for model in MODELS.values():
        assert {*model.conditions, model.output} <= set(QUANTITIES)
        assert QUANTITIES[model.output].role == "output"


@pytest.mark.parametrize("quantity", QUANTITIES.values(), ids=lambda q: q.stem)
def test_every_accepted_header_is_read_as_its_quantity(quantity) -> None:
    assert accepted_headers(quantity)[0] == quantity.canonical
    for header in accepted_headers(quantity):
        for spelling in (header, header.upper(), f" {header.title()} "):
            column = parse_header(spelling)
            assert column is not None
            assert column.quantity is quantity
    canonical = parse_header(quantity.canonical)
    assert canonical is not None
    assert np.array_equal(canonical.to_canonical([0.25, 1.0]), [0.25, 1.0])


@pytest.mark.parametrize(
    ("header", "canonical", "unit"),
    [
        ("slip_percent", "slip_ratio", "percent"),
        ("Slip [%]", "slip_ratio", "percent"),
        ("slip%", "slip_ratio", "percent"),
        ("nominal_slip_percent", "nominal_slip_ratio", "percent"),
        ("Drawbar pull (kN)", "drawbar_pull_kn", "kN"),
        ("DRAWBAR_PULL_LBF", "drawbar_pull_kn", "lbf"),
        ("rut_depth_in", "rut_depth_mm", "inch"),
        ("sinkage_m", "rut_depth_mm", "m"),
        ("penetration_resistance_MPa", "cone_index_kpa", "MPa"),
        ("water_content_grav_g_g", "gravimetric_water_content", "dimensionless"),
        ("gravimetric_water_content_percent", "gravimetric_water_content", "percent"),
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
        "", "matric_suction_cm", "operator", "slip_angle_deg", "drawbar_pull_sd_kn",
        "drawbar_pull_kn_lower", "wheel_speed_rpm", "pass_number_note", "slippery_ratio",
    ],
)  # fmt: skip
def test_other_columns_name_no_quantity(header: str) -> None:
    assert parse_header(header) is None


@pytest.mark.parametrize(
    ("header", "words"),
    [
        ("slip", ["does not say the unit", "slip_ratio, slip_fraction, slip_percent"]),
        ("drawbar_pull", ["does not say the unit", "drawbar_pull_lbf"]),
        ("drawbar_pull_stone", ["'stone' is not a known unit of drawbar_pull", "kgf"]),
        ("drawbar_pull_mm", ["'mm' is a unit of length", "drawbar_pull is a force"]),
        ("volumetric_water_content_g_g", ["unit of mass ratio", "is a volume ratio"]),
        ("rut_depth_mmm", ["not a known unit", "did you mean rut_depth_mm?"]),
        ("slip_rati", ["did you mean slip_ratio?"]),
    ],
)
def test_a_wrong_unit_is_named_with_the_allowed_ones(header: str, words: list[str]) -> None:
    with pytest.raises(CalibError) as caught:
        parse_header(header, where="my.csv, line 1")
    for word in [f"my.csv, line 1, column {header!r}", "expected:", "hint:", *words]:
        assert word in str(caught.value)


def test_a_misspelt_required_column_gets_a_suggestion() -> None:
    with pytest.raises(CalibError) as caught:
        match_headers(
            ["slip_ratio", "drawber_pul_n"], where="my.csv, line 1", required=["drawbar_pull_kn"]
        )
    assert "'drawber_pul_n': did you mean drawbar_pull_n? Rename it" in str(caught.value)
    assert "found 'slip_ratio', 'drawber_pul_n'" in str(caught.value)


def test_a_table_that_lacks_a_column_suggests_the_misspelt_one() -> None:
    table = table_from_arrays({"slip_ratio": [0.1], "drawber_pul_n": [5.0]}, source="my.csv")
    table.must_have("slip_ratio")
    with pytest.raises(CalibError, match=r"my\.csv.*no column for drawbar_pull") as caught:
        table.must_have("slip_ratio", "drawbar_pull_kn")
    assert "did you mean drawbar_pull_n?" in str(caught.value)


def test_of_several_quantities_the_nearest_is_suggested() -> None:
    assert columns_meant(["operator", "inflaton_presure_bar"], QUANTITIES) == [
        "'inflaton_presure_bar': did you mean inflation_pressure_bar?"
    ]


def test_a_suggestion_does_not_make_up_a_unit() -> None:
    with pytest.raises(CalibError, match="did you mean drawbar_pull, with its unit"):
        match_headers(["drawbarpull"], where="my.csv, line 1", required=["drawbar_pull_kn"])


def test_a_missing_required_column_says_what_to_add() -> None:
    with pytest.raises(CalibError) as caught:
        match_headers(["operator"], where="my.csv, line 1", required=["cone_index_kpa"])
    message = str(caught.value)
    assert "there is no column for cone_index; found 'operator'" in message
    assert "cone_index_mpa" in message
    assert "add the column cone_index_kpa (penetration resistance of a cone)" in message


def test_all_missing_columns_are_told_at_once_each_with_its_guess() -> None:
    with pytest.raises(CalibError) as caught:
        match_headers(
            ["Slipp [%]", "Pull (lbf)", "kN", "note"], where="my.csv, line 1",
            required=["slip_ratio", "inflation_pressure_psi", "drawbar_pull_kn"],
        )  # fmt: skip
    message = str(caught.value)
    assert "no column for slip, inflation_pressure, drawbar_pull; found" in message
    assert "'Slipp [%]': did you mean slip_percent?" in message
    assert "'Pull (lbf)': did you mean drawbar_pull_lbf?" in message
    assert "'kN': did" not in message
    assert "'note': did" not in message
    assert "add the columns slip_ratio (" in message
    assert "inflation_pressure_bar" in message


def test_the_last_words_of_a_name_are_no_misspelling() -> None:
    assert columns_meant(["Pull (lbf)"], ["drawbar_pull_kn"], 0.8) == []


@pytest.mark.parametrize("second", ["slip_ratio", "Slip_Percent"])
def test_a_quantity_given_twice_is_refused(second: str) -> None:
    with pytest.raises(CalibError, match=r"columns 1 \('slip_ratio'\) and 2 .* both give slip"):
        match_headers(["slip_ratio", second], where="my.csv, line 1")


def test_unknown_columns_are_set_aside_in_their_order() -> None:
    columns, ignored = match_headers(["b", "slip_ratio", "a", "a"], where="my.csv, line 1")
    assert [c.position for c in columns] == [1]
    assert ignored == ("b", "a", "a")


def test_units_have_one_reading_per_kind() -> None:
    for quantity in QUANTITIES.values():
        assert quantity.kind in UNITS
        assert all(suffix == suffix.lower() for suffix in quantity.units)


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
def test_units_that_are_no_factor_of_its_own_are_refused_where_they_are_declared(unit):
    def temperature(**suffixes):
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
