"""Tables: their columns, parts of them, and whether they can calibrate anything."""

from __future__ import annotations

import pickle

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calib.data import Table, check_enough, check_varies, hold_out, read_table, table_from_arrays
from calib.data.files import plain_number
from calib.errors import CalibError


def pressures() -> Table:
    return table_from_arrays(
        {"inflation_pressure_kpa": [124.106, 206.843, 289.58, 206.9], "slip_ratio": [0.1] * 4},
        source="lab.csv",
    )


@settings(max_examples=10)
@given(st.permutations(range(6)))
def test_the_order_of_the_rows_only_permutes(order: list[int]) -> None:
    slips = np.linspace(0.0, 0.5, 6)
    labels = np.array(["b", "a", "c", "a", "b", "c"])
    table = table_from_arrays({"slip_ratio": slips, "repeat": labels})
    shuffled = table_from_arrays({"slip_ratio": slips[order], "repeat": labels[order]})
    for name in table:
        assert np.array_equal(shuffled[name], table[name][order])
        assert np.array_equal(table.take(order)[name], shuffled[name])


def test_a_table_cannot_be_changed_shares_no_memory_and_pickles() -> None:
    slips = np.array([0.1, 0.2])
    table = table_from_arrays({"slip_ratio": slips})
    slips[0] = 0.9
    assert table["slip_ratio"][0] == 0.1
    with pytest.raises(ValueError, match="read-only"):
        table["slip_ratio"][0] = 0.5
    with pytest.raises(TypeError):
        table.columns["slip_ratio"] = slips  # type: ignore[index]
    copy = pickle.loads(pickle.dumps(table))
    assert np.array_equal(copy["slip_ratio"], table["slip_ratio"])
    assert (copy.sha256, copy.header) == (table.sha256, table.header)
    assert not copy["slip_ratio"].flags.writeable


def test_take_keeps_lines_and_text_in_step() -> None:
    for rows in ([2, 0], np.array([2, 0])):
        part = pressures().take(rows)
        assert part.lines.tolist() == [2, 0]
        assert part.text[0][0] == "289.58"
    assert len(pressures().take(np.array([True, False, False, True]))) == 2
    assert len(pressures().take([])) == 0


def test_an_absent_column_lists_the_present_ones() -> None:
    assert "speed_m_s" not in pressures()
    with pytest.raises(CalibError, match="no column 'speed_m_s'") as caught:
        pressures()["speed_m_s"]
    assert "expected: inflation_pressure_psi, slip_ratio" in str(caught.value)
    assert "add the column" in str(caught.value)


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("slip_percent", "use 'slip_ratio': a table keeps every quantity in one unit"),
        ("slip_foot", "did you mean slip_ratio?"),
        ("slip", "did you mean slip_ratio?"),
    ],
)
def test_of_another_name_of_a_column_its_own_is_said(name: str, hint: str) -> None:
    with pytest.raises(CalibError) as caught:
        pressures()[name]
    assert caught.value.hint == hint


@pytest.mark.parametrize("convert", [np.asarray, pd.DataFrame])
def test_a_table_is_not_taken_for_the_names_of_its_columns(convert: type) -> None:
    with pytest.raises(CalibError, match="not an array") as caught:
        convert(pressures())
    assert "table.to_dataframe() has all" in str(caught.value)


@pytest.mark.parametrize(
    ("header", "value"),
    [
        ("inflation_pressure_psi", 30),
        ("inflation_pressure_kpa", 207),
        ("inflation_pressure_bar", 2.068),
    ],
)
def test_hold_out_in_any_unit(header: str, value: float) -> None:
    rest, held = hold_out(pressures(), header, value)
    assert held.lines.tolist() == [1, 3]
    assert rest.lines.tolist() == [0, 2]
    zero = table_from_arrays({"slip_ratio": [0.0, 0.1, 0.2]})
    assert len(hold_out(zero, "slip_percent", 0)[1]) == 1
    for several in ([0, 20], (0.0, 20.0), np.array([0.0, 20.0])):
        assert hold_out(zero, "slip_percent", several)[0]["slip_ratio"].tolist() == [0.1]


@pytest.mark.parametrize(
    ("header", "value", "words"),
    [
        ("inflation_pressure_kpa", 30, ["no row is at 30", "124.106, 206.843, 206.9, 289.58"]),
        ("slip_percent", 10, ["every row is at 10", "nothing would be left to fit"]),
        ("slip_percent", 20, ["no row is at 20", "values present: 10"]),
        ("inflation_pressure_psi", [18, 31, 33], ["no row is at 31 or 33", "30, 30.0"]),
        ("speed_m_s", 1, ["no column to hold 'speed_m_s' out", "inflation_pressure_psi"]),
        ("inflaton_presure_psi", 18, ["no column", "did you mean inflation_pressure_psi?"]),
    ],
)
def test_impossible_hold_outs(header: str, value: float | list[float], words: list[str]) -> None:
    with pytest.raises(CalibError) as caught:
        hold_out(pressures(), header, value)
    for word in ["lab.csv", *words]:
        assert word in str(caught.value)


def test_too_few_rows_and_constant_columns_calibrate_nothing() -> None:
    with pytest.raises(CalibError, match="1 row cannot calibrate bekker, which has 2") as caught:
        check_enough(pressures().take([0]), 2, model="bekker")
    assert "at least 3 rows" in str(caught.value)
    check_enough(pressures(), 3)
    with pytest.raises(CalibError, match=r"all 4 values are 0\.1") as caught:
        check_varies(pressures(), "slip_ratio")
    assert "lab.csv, column 'slip_ratio'" in str(caught.value)
    check_varies(pressures(), "inflation_pressure_psi")
    empty = table_from_arrays({"slip_ratio": [np.nan]}, allow_missing=["slip_ratio"])
    with pytest.raises(CalibError, match="there is no value"):
        check_varies(empty, "slip_ratio")


def test_a_table_knows_its_columns_as_the_file_has_them(tmp_path) -> None:
    (tmp_path / "my.csv").write_text("Slip (%),Rut depth [cm] (checked),note\n10,2.5,x\n20,3.0,y\n")
    table = read_table(tmp_path / "my.csv")
    assert table.header_of("slip_ratio") == "Slip (%)"
    assert table.header_of("speed_m_s") == "speed_m_s"
    assert table.column("rut_depth_mm").written(table["rut_depth_mm"]).tolist() == [2.5, 3.0]
    assert list(table.to_write(table.columns)) == ["slip_ratio", "rut_depth_mm (checked)"]
    said = r"column 'Rut depth \[cm\] \(checked\)': all 1 values are 2.5"
    with pytest.raises(CalibError, match=said):
        check_varies(table.take([0]), "rut_depth_mm")


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [
        (1316.4, 3, "1320"),
        (-12345.0, 4, "-12340"),
        (99_960.0, 3, "1e+05"),
        (0.00123, 2, "0.0012"),
        (2.0e-6, 3, "2e-06"),
        (5.0, 3, "5"),
        (float("nan"), 3, "nan"),
    ],
)
def test_a_number_in_a_sentence(value: float, digits: int, text: str) -> None:
    assert plain_number(value, digits) == text


@settings(max_examples=20)
@given(st.floats(1e-3, 99_000.0), st.integers(2, 5))
def test_no_exponent_where_digits_are_read_faster(value: float, digits: int) -> None:
    text = plain_number(value, digits)
    assert "e" not in text
    assert float(text) == pytest.approx(value, rel=0.51 * 10.0 ** (1 - digits))


def test_rows_nearly_at_a_value_are_not_left_to_be_fitted() -> None:
    """A gauge scatters: to hold out 206 of a test at about 206 is to fit its neighbours."""
    pressure = [124.0, 124.1, 205.9, 206.0, 206.3, 289.0]
    data = {"inflation_pressure_kpa": pressure, "drawbar_pull_kn": [1.0, 1.1, 0.8, 0.9, 0.7, 0.5]}
    with pytest.raises(CalibError, match=r"such as 206\.3, would be fitted: 1, beside 2 held out"):
        hold_out(table_from_arrays(data), "inflation_pressure_kpa", 206.0)
    rest, held = hold_out(table_from_arrays(data), "inflation_pressure_kpa", 289.0)
    assert (len(rest), len(held)) == (5, 1)
