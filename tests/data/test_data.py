import hashlib
import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calib.data import (
    Table,
    check_enough,
    check_varies,
    hold_out,
    read_table,
    table_from_arrays,
    write_table,
)
from calib.errors import CalibError

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
CASES = Path(__file__).resolve().parents[3] / "shared" / "cases"
GOOD = (
    "slip_percent,inflation_pressure_kpa,drawbar_pull_n,operator\n10,124.1,900,A\n20,206.8,950,B\n"
)

type Write = Callable[[str | bytes], Path]


@pytest.fixture
def my_csv(tmp_path: Path) -> Write:
    def write(content: str | bytes) -> Path:
        path = tmp_path / "my.csv"
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return path

    return write


def refusal(path: Path | str, **options: object) -> str:
    """Return the message that reading a file ends with."""
    with pytest.raises(CalibError) as caught:
        read_table(path, **options)  # type: ignore[arg-type]
    message = str(caught.value)
    assert str(path) in message
    assert "hint:" in message
    return message


# What is read


def test_a_file_becomes_columns_in_canonical_units(my_csv: Write) -> None:
    path = my_csv(GOOD)
    table = read_table(path, required=["slip_ratio", "drawbar_pull_kn"], label="made up")
    assert len(table) == 2
    assert list(table) == ["slip_ratio", "inflation_pressure_psi", "drawbar_pull_kn"]
    assert table["slip_ratio"].tolist() == [0.1, 0.2]
    assert table["drawbar_pull_kn"].tolist() == [0.9, 0.95]
    assert table["inflation_pressure_psi"] == pytest.approx([17.9992, 29.9938], abs=1e-4)
    assert table.lines.tolist() == [2, 3]
    assert table.header[3] == "operator"
    assert table.text[1] == ("20", "206.8", "950", "B")
    assert table.ignored == ("operator",)
    assert (table.source, table.label) == (str(path), "made up")
    assert table.sha256 == hashlib.sha256(GOOD.encode()).hexdigest()


@pytest.mark.parametrize(
    "content",
    [
        "\ufeff" + GOOD,
        GOOD.replace("\n", "\r\n"),
        GOOD.replace("\n", "\r"),
        GOOD.rstrip("\n"),
        GOOD + "\n\n,,,\n  \n",
        GOOD.replace(",", ";"),
        GOOD.replace(",", ";").replace(".", ","),
        GOOD.replace(",", "\t"),
        GOOD.replace("slip_percent", '" Slip [%] "'),
    ],
    ids=["BOM", "CRLF", "CR", "no end", "blank", "semicolons", "comma", "tabs", "quotes"],
)
def test_dialects_make_no_difference(my_csv: Write, content: str) -> None:
    plain, table = read_table(my_csv(GOOD)), read_table(my_csv(content))
    assert list(table) == list(plain)
    for name in plain:
        assert np.array_equal(table[name], plain[name])


def test_line_numbers_count_blank_lines(my_csv: Write) -> None:
    assert read_table(my_csv("slip_ratio\n0.1\n\n0.2\n")).lines.tolist() == [2, 4]


@given(st.permutations(range(6)))
def test_the_order_of_the_rows_only_permutes(order: list[int]) -> None:
    slips = np.linspace(0.0, 0.5, 6)
    labels = np.array(["b", "a", "c", "a", "b", "c"])
    table = table_from_arrays({"slip_ratio": slips, "repeat": labels})
    shuffled = table_from_arrays({"slip_ratio": slips[order], "repeat": labels[order]})
    for name in table:
        assert np.array_equal(shuffled[name], table[name][order])
        assert np.array_equal(table.take(order)[name], shuffled[name])


@pytest.mark.parametrize(
    ("labels", "codes"),
    [("B A B", [1, 0, 1]), ("3 7 3", [3, 7, 3]), ("1 x 1", [0, 1, 0]), ("2.0 10.0", [2, 10])],
)
def test_labels_become_codes(my_csv: Write, labels: str, codes: list[int]) -> None:
    rows = "".join(f"{label},0.{i}\n" for i, label in enumerate(labels.split()))
    assert read_table(my_csv(f"repeat,slip_ratio\n{rows}"))["repeat"].tolist() == codes


def test_a_minus_sign_from_a_word_processor_is_read(my_csv: Write) -> None:
    content = "drawbar_pull_kn\n\N{MINUS SIGN}0.5\n0.1\n"
    assert read_table(my_csv(content))["drawbar_pull_kn"].tolist() == [-0.5, 0.1]


def test_missing_cells_are_kept_where_allowed(my_csv: Write) -> None:
    content = "slip_ratio,rut_depth_mm\n0.1,\n0.2,NaN\n0.3,n/a\n0.4,12\n"
    table = read_table(my_csv(content), allow_missing={"rut_depth_mm"})
    assert np.isnan(table["rut_depth_mm"]).tolist() == [True, True, True, False]
    assert "an empty cell" in refusal(my_csv(content))


def test_a_rut_depth_that_is_not_used_may_be_zero(my_csv: Write) -> None:
    path = my_csv("slip_ratio,rut_depth_mm\n0.1,0\n0.2,10\n")
    assert read_table(path, required=["slip_ratio"])["rut_depth_mm"][0] == 0.0
    assert "logarithm of the rut depth" in refusal(path, required=["rut_depth_mm"])


# What is refused: files


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", ["the file is empty", "calib template"]),
        (b"\xef\xbb\xbf\n \n", ["the file is empty"]),
        (b"slip_ratio,speed_m_s\n", ["column names but no rows", "at least one row"]),
        (b"0.1,0.2\n0.3,0.4\n", ["line 1", "numbers, not column names"]),
        (GOOD.encode("utf-16")[:-1], ["is not UTF-16", "CSV in UTF-8"]),
        (GOOD.encode("utf-16-le"), ["binary file", "CSV in UTF-8"]),
        (b"PK\x03\x04rest of a workbook", ["binary file, such as a workbook"]),
        ("slip_ratio,Prüfer\n0.1,ä\n".encode("latin-1"), ["line 1", "0xfc is not UTF-8"]),
        (b"slip_ratio\n0.1\n\"0.2\n", ["line 3", "quotation mark"]),
        (b"slip_ratio,speed_m_s\n0.1,1\n0.2\n", ["line 3", "1 cells", "names 2", "complete"]),
        (b"slip_ratio,speed_m_s\n0,1,1\n", ["line 2", "3 cells", "decimal comma"]),
    ],
)  # fmt: skip
def test_unreadable_files(my_csv: Write, content: bytes, words: list[str]) -> None:
    message = refusal(my_csv(content))
    for word in ["expected:", *words]:
        assert word in message


def test_a_missing_file_lists_its_neighbours(my_csv: Write, tmp_path: Path) -> None:
    my_csv(GOOD)
    assert "its folder holds my.csv" in refusal(tmp_path / "mine.csv")
    assert "no such file" in refusal(tmp_path / "nowhere" / "mine.csv")


def test_a_folder_is_not_a_file(tmp_path: Path) -> None:
    assert "this is a folder" in refusal(tmp_path)


def test_an_impossible_path_is_refused() -> None:
    with pytest.raises(CalibError, match="cannot be read"):
        read_table("my\0.csv")


# What is refused: columns


@pytest.mark.parametrize(
    ("header", "words"),
    [
        ("slip_ratio,slip_percent", ["columns 1 ('slip_ratio') and 2", "one column per quantity"]),
        ("slip_ratio,slip_ratio", ["both give slip", "delete or rename"]),
        ("slip_ratio,cone_index_stone", ["'stone' is not a known unit", "cone_index_kpa"]),
        ("slip_ratio,cone_index_kn", ["unit of force, but cone_index is a pressure"]),
        ("slip,cone_index_kpa", ["does not say the unit", "slip_ratio"]),
        ("slip_ratio,cone_indx_kpa", ["'cone_indx_kpa': did you mean cone_index_kpa?"]),
        ("slip_ratio,depth", ["there is no column for cone_index", "add the column"]),
    ],
)
def test_wrong_columns(my_csv: Write, header: str, words: list[str]) -> None:
    message = refusal(my_csv(f"{header}\n0.1,2\n"), required=["slip_ratio", "cone_index_kpa"])
    for word in ["line 1, column", "expected:", *words]:
        assert word in message


def test_all_columns_whose_unit_cannot_be_read_are_named_at_once(my_csv: Write) -> None:
    message = refusal(my_csv("slip,Drawbar pull,rut_depth_kn,note\n0.1,2,3,wet\n"))
    found, allowed, hint = message.splitlines()
    assert "line 1, columns 'slip', 'Drawbar pull', 'rut_depth_kn': " in found
    assert "the column name 'slip' does not say the unit; the column name 'Drawbar pull'" in found
    assert "'kn' is a unit of force, but rut_depth is a length" in found
    for header, word in (("slip", "slip_ratio"), ("Drawbar pull", "drawbar_pull_kn")):
        assert word in allowed
        assert f"{header!r}: rename the column, for example {word}" in hint


# What is refused: cells


@pytest.mark.parametrize(
    ("header", "cell", "words"),
    [
        ("slip_ratio", "", ["an empty cell", "from -1 to 1", "delete the row"]),
        ("slip_ratio", "NaN", ["'NaN' is not a finite number"]),
        ("drawbar_pull_kn", "inf", ["'inf' is not a finite number", "a number in kN"]),
        ("drawbar_pull_kn", "1e999", ["'1e999' is not a finite number"]),
        ("drawbar_pull_kn", "-1e300", ["'-1e300' is too large for a reading", "correct the value"]),
        ("normal_load_kn", "1e300", ["'1e300' is too large for a reading", "correct the value"]),
        ("drawbar_pull_kn", "about 2", ["'about 2' is not a number", "one plain number"]),
        ("drawbar_pull_kn", "2 kN", ["'2 kN' is not a number", "unit belongs in the column"]),
        ("drawbar_pull_kn", "1_000", ["'1_000' is not a number"]),
        ("drawbar_pull_n", '"1,234"', ["'1,234' has a comma inside", "no thousands separators"]),
        ("slip_ratio", "12.5", ["'12.5' is outside", "did you mean slip_percent?"]),
        ("slip_ratio", "-250", ["'-250' is outside the range of slip", "correct the value"]),
        ("slip_percent", "101", ["from -100 to 100 percent", "outside the range of slip"]),
        ("nominal_slip_ratio", "2", ["nominal_slip_percent?"]),
        ("inflation_pressure_psi", "-30", ["'-30' is outside", "a number above 0 psi"]),
        ("inflation_pressure_kpa", "0", ["a number above 0 kPa", "inflation_pressure"]),
        ("average_ground_pressure_kpa", "-1", ["above 0 kPa"]),
        ("cone_index_mpa", "0", ["above 0 MPa"]),
        ("normal_load_kn", "-5", ["above 0 kN"]),
        ("speed_m_s", "-1", ["a number of at least 0 m/s"]),
        ("pass_number", "0", ["a whole number of at least 1"]),
        ("pass_number", "1.5", ["a whole number of at least 1"]),
        ("run_order", "first", ["'first' is not a number"]),
        ("repeat", " ", ["an empty cell", "any label"]),
        ("bulk_density_g_cm3", "1650", ["from 0.3 to 3.5 g/cm3", "its unit in the column name"]),
        ("bulk_density_kg_m3", "1.65", ["from 300 to 3500 kg/m3"]),
        ("gravimetric_water_content", "8.8", ["did you mean gravimetric_water_content_percent?"]),
        ("volumetric_water_content", "-0.1", ["from 0 to 1"]),
        ("rut_depth_mm", "0", ["above 0 mm", "logarithm of the rut depth"]),
        ("rut_depth_cm", "-2", ["above 0 cm", "logarithm of the rut depth"]),
    ],
)  # fmt: skip
def test_a_bad_cell(my_csv: Write, header: str, cell: str, words: list[str]) -> None:
    good = "1650" if header == "bulk_density_kg_m3" else "1"
    path = my_csv(f"operator,{header}\nA,{good}\nB,{cell}\n")
    message = refusal(path)
    for word in [f"{path}, line 3, column {header!r}", "expected:", *words]:
        assert word in message


def test_several_bad_cells_come_in_one_message(my_csv: Write) -> None:
    message = refusal(my_csv("slip_ratio,speed_m_s\n0.1,fast\n3,1\n0.2,-1\n0.3\n"))
    lines = message.splitlines()
    assert lines[0].endswith("4 problems in the data")
    assert lines[1] == (
        "  line 2, column 'speed_m_s': 'fast' is not a number; expected: a number of at least 0 m/s"
    )
    assert lines[2].startswith("  line 3, column 'slip_ratio': '3' is outside the range of slip")
    assert lines[3].startswith("  line 4, column 'speed_m_s': '-1' is outside the range of speed")
    assert lines[4].startswith("  line 5: the row has 1 cells")
    assert lines[5].strip() == "hint:"
    assert lines[6].startswith("    - write one plain number")
    assert lines[7].startswith("    - slip is s = 1 - v/(ωr) here")


@pytest.mark.parametrize("cell", ["x", "-1"])
def test_many_bad_cells_are_counted(my_csv: Write, cell: str) -> None:
    lines = refusal(my_csv("speed_m_s\n" + f"{cell}\n" * 5000)).splitlines()
    assert lines[0].endswith("5000 problems in the data")
    assert [line.split(",")[0].strip() for line in lines[1:6]] == [f"line {i}" for i in range(2, 7)]
    assert lines[6].strip() == "and 4995 more"


def test_decimal_commas_and_points_do_not_mix(my_csv: Write) -> None:
    path = my_csv("slip_ratio;cone_index_kpa\n0.5;900\n0.6;1,234\n")
    message = refusal(path)
    assert f"{path}, line 3, column 'cone_index_kpa': '1,234' has a decimal comma" in message
    assert "'0.5' in line 2, column 'slip_ratio' has a decimal point" in message
    assert "one decimal sign in the whole file" in message


def test_a_comma_and_a_point_in_one_number(my_csv: Write) -> None:
    assert "'1.234,5' has a comma inside" in refusal(my_csv("cone_index_kpa;a\n1.234,5;b\n"))


# Arrays


def test_arrays_are_checked_as_files_are() -> None:
    table = table_from_arrays({"slip_percent": [10, 20], "Rut depth (cm)": [1.5, 2.0], "x": [1, 2]})
    assert table["slip_ratio"].tolist() == [0.1, 0.2]
    assert table["rut_depth_mm"].tolist() == [15.0, 20.0]
    assert table.text == (("10", "1.5", "1"), ("20", "2.0", "2"))
    assert (table.ignored, table.source, table.lines.tolist()) == (("x",), "arrays", [0, 1])
    same = table_from_arrays({"rut_depth_mm": [15.0, 20.0], "slip_ratio": [0.1, 0.2]})
    assert same.sha256 == table.sha256


@pytest.mark.parametrize(
    ("columns", "words"),
    [
        ({"slip_ratio": [0.1, 12.0]}, ["arrays, row 1, column 'slip_ratio'", "slip_percent"]),
        ({"slip_ratio": [0.1, np.nan]}, ["row 1", "'nan' is not a finite number"]),
        ({"slip_ratio": ["a", "b"]}, ["not numbers", "array of numbers"]),
        ({"slip_ratio": [0.1], "speed_m_s": [1, 2]}, ["shapes", "one shape (n,)"]),
        ({"slip_ratio": [[0.1]]}, ["(1, 1)", "flatten"]),
        ({"slip_ratio": []}, ["n of at least 1"]),
        ({}, ["n of at least 1"]),
        ({"slip": [0.1]}, ["arrays, column 'slip'", "does not say the unit"]),
    ],
)
def test_bad_arrays(columns: dict[str, object], words: list[str]) -> None:
    with pytest.raises(CalibError) as caught:
        table_from_arrays(columns)  # type: ignore[arg-type]
    for word in words:
        assert word in str(caught.value)


# Tables


def pressures() -> Table:
    return table_from_arrays(
        {"inflation_pressure_kpa": [124.106, 206.843, 289.58, 206.9], "slip_ratio": [0.1] * 4},
        source="lab.csv",
    )


def test_a_table_cannot_be_changed_and_does_not_share_memory() -> None:
    slips = np.array([0.1, 0.2])
    table = table_from_arrays({"slip_ratio": slips})
    slips[0] = 0.9
    assert table["slip_ratio"][0] == 0.1
    with pytest.raises(ValueError, match="read-only"):
        table["slip_ratio"][0] = 0.5
    with pytest.raises(TypeError):
        table.columns["slip_ratio"] = slips  # type: ignore[index]


def test_a_table_pickles() -> None:
    copy = pickle.loads(pickle.dumps(pressures()))
    assert np.array_equal(copy["slip_ratio"], pressures()["slip_ratio"])
    assert (copy.sha256, copy.header) == (pressures().sha256, pressures().header)
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


@pytest.mark.parametrize(
    ("header", "value", "words"),
    [
        ("inflation_pressure_kpa", 30, ["no row is at 30", "124.106, 206.843, 206.9, 289.58"]),
        ("slip_percent", 10, ["every row is at 10", "nothing would be left to fit"]),
        ("slip_percent", 20, ["no row is at 20", "values present: 10"]),
        ("speed_m_s", 1, ["no column to hold 'speed_m_s' out", "inflation_pressure_psi"]),
        ("colour", 1, ["no column to hold 'colour' out"]),
        ("inflaton_presure_psi", 18, ["no column", "did you mean inflation_pressure_psi?"]),
    ],
)
def test_impossible_hold_outs(header: str, value: float, words: list[str]) -> None:
    with pytest.raises(CalibError) as caught:
        hold_out(pressures(), header, value)
    for word in ["lab.csv", *words]:
        assert word in str(caught.value)


def test_hold_out_at_zero() -> None:
    table = table_from_arrays({"slip_ratio": [0.0, 0.1, 0.2]})
    assert len(hold_out(table, "slip_percent", 0)[1]) == 1


def test_too_few_rows() -> None:
    one = pressures().take([0])
    with pytest.raises(CalibError, match="1 row cannot calibrate bekker, which has 2") as caught:
        check_enough(one, 2, model="bekker")
    assert "at least 3 rows" in str(caught.value)
    check_enough(pressures(), 3)


def test_a_constant_column() -> None:
    with pytest.raises(CalibError, match=r"all 4 values are 0\.1") as caught:
        check_varies(pressures(), "slip_ratio")
    assert "lab.csv, column 'slip_ratio'" in str(caught.value)
    check_varies(pressures(), "inflation_pressure_psi")
    empty = table_from_arrays({"slip_ratio": [np.nan]}, allow_missing=["slip_ratio"])
    with pytest.raises(CalibError, match="there is no value"):
        check_varies(empty, "slip_ratio")


# Writing


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    path = tmp_path / "out.csv"
    slips = np.random.default_rng(1).uniform(-1.0, 1.0, 50)
    write_table(path, {"slip_ratio": slips, "pass_number": np.arange(1, 51), "note": ["a,b"] * 50})
    table = read_table(path)
    assert np.array_equal(table["slip_ratio"], slips)
    assert table.text[0][1:] == ("1", "a,b")
    assert list(tmp_path.iterdir()) == [path]


def test_a_missing_value_is_written_as_an_empty_cell(tmp_path: Path) -> None:
    path = tmp_path / "out.csv"
    write_table(path, {"a": [-0.0001, np.nan], "b": [1.0, 2.55]})
    assert path.read_text() == "a,b\n-0.0001,1.0\n,2.55\n"


def test_a_table_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "out.csv"
    path.write_text("before")
    with pytest.raises(CalibError, match="differ in length"):
        write_table(path, {"a": [1.0], "b": [1.0, 2.0]})
    assert path.read_text() == "before"
    with pytest.raises(CalibError, match="cannot be written") as caught:
        write_table(tmp_path / "nowhere" / "out.csv", {"a": [1.0]})
    assert "existing folder" in str(caught.value)
    with pytest.raises(CalibError, match="cannot be written"):
        write_table(path / "out.csv", {"a": [1.0]})
    folder = tmp_path / "folder"
    folder.mkdir()
    with pytest.raises(CalibError, match="cannot be written"):
        write_table(folder, {"a": [1.0]})
    assert sorted(p.name for p in tmp_path.iterdir()) == ["folder", "out.csv"]


# Codes for missing values, and columns in another unit that are right


@pytest.mark.parametrize("code", ["-999", "-9999", "9999", "-999.25", "-99.9", "99999", "-32768"])
@pytest.mark.parametrize("header", ["drawbar_pull_kn", "Drawbar pull [lbf]"])
def test_a_code_for_a_missing_value_is_no_reading(my_csv: Write, code: str, header: str) -> None:
    rows = [f"10,{value}" for value in ("0.5", "1.2", code, "1.4", code)]
    path = my_csv("\n".join([f"slip_percent,{header}", *rows]) + "\n")
    said = refusal(path)
    for line in (4, 6):
        assert f"line {line}, column {header!r}: {code} looks like a code for a missing" in said
    assert "where the others are 0.5 to 1.4" in said
    assert "delete the row" in said
    assert "leave the cell empty" in refusal(path, allow_missing=["drawbar_pull_kn"])
    # Where the column is not used nobody minds.
    assert len(read_table(path, required=["slip_ratio"])) == 5
    # A reading it may be.
    sure = my_csv(path.read_text().replace(header, f"{header} (Checked)"))
    assert read_table(sure).header[1] == f"{header} (Checked)"


def test_a_column_of_codes_is_no_column_of_readings() -> None:
    with pytest.raises(CalibError, match="2 problems in the data"):
        table_from_arrays({"drawbar_pull_kn": np.array([-999.0, -999.0])})


@pytest.mark.parametrize(("header", "values"), [
    ("drawbar_pull_n", [-1500.0, -999.0, 200.0, 1800.0]),  # towed and driven
    ("cone_index_kpa", [400.0, 999.0, 1300.0]),
    ("average_ground_pressure_kpa", [99.0, 150.0]),
    ("run_order", [1.0, 2.0, 9999.0]),
])  # fmt: skip
def test_readings_among_others_are_no_codes(header: str, values: list[float]) -> None:
    assert len(table_from_arrays({header: np.array(values)})) == len(values)


def test_a_code_that_cannot_be_a_reading_is_called_one(my_csv: Write) -> None:
    said = refusal(my_csv("rut_depth_mm\n20\n-999\n"))
    assert "line 3, column 'rut_depth_mm': '-999' is outside the range of rut_depth" in said
    assert "if it stands for a missing value, delete the row or leave the cell empty" in said
    assert said.count("line 3") == 1


def test_a_table_knows_its_columns_as_the_file_has_them(my_csv: Write) -> None:
    table = read_table(my_csv("Slip (%),Rut depth [cm] (checked),note\n10,2.5,x\n20,3.0,y\n"))
    assert table.header_of("slip_ratio") == "Slip (%)"
    assert table.header_of("rut_depth_mm") == "Rut depth [cm] (checked)"
    assert table.header_of("speed_m_s") == "speed_m_s"
    assert table.column("rut_depth_mm").written(table["rut_depth_mm"]).tolist() == [2.5, 3.0]
    assert list(table.to_write(table.columns)) == ["slip_ratio", "rut_depth_mm (checked)"]
    with pytest.raises(
        CalibError, match=r"column 'Rut depth \[cm\] \(checked\)': all 1 values are 2.5"
    ):
        check_varies(table.take([0]), "rut_depth_mm")


# Size and real files


def test_a_large_file_is_read_in_batches(tmp_path: Path) -> None:
    path, n = tmp_path / "large.csv", 100_000
    slips = np.random.default_rng(2).uniform(-1.0, 1.0, n)
    write_table(path, {"slip_ratio": slips, "repeat": np.arange(n) % 3})
    table = read_table(path)
    assert np.array_equal(table["slip_ratio"], slips)
    assert np.array_equal(table["repeat"], np.arange(n) % 3)
    assert table.text == ()
    assert table.lines[-1] == n + 1


@pytest.mark.skipif(not DATA.exists(), reason="the measured data are not part of the repository")
def test_measured_soil_data() -> None:
    needed = ["cone_index_kpa", "gravimetric_water_content", "bulk_density_g_cm3"]
    table = read_table(DATA / "soil_skp1994.csv", required=needed)
    assert table["cone_index_kpa"][0] == 230.0
    assert table.ignored == ("matric_suction_cm",)


@pytest.mark.skipif(not CASES.exists(), reason="the cases are not part of the repository")
def test_every_case_is_read() -> None:
    for path in sorted(CASES.glob("*/*.csv")):
        table = read_table(path)
        assert table.ignored == ()
        assert len(table) > 0


def test_columns_are_written_in_the_units_of_their_file(my_csv: Write, tmp_path: Path) -> None:
    text = "Slip (%),Drawbar pull [lbf],rut_depth_mm\n0.7,2851.464474674471,12.5\n5.3,12,\n"
    table = read_table(my_csv(text), allow_missing=("rut_depth_mm",))
    write_table(tmp_path / "again.csv", table.as_in_file(table.columns))
    assert (tmp_path / "again.csv").read_text() == (
        "Slip (%),Drawbar pull [lbf],rut_depth_mm\n0.7,2851.464474674471,12.5\n5.3,12.0,\n"
    )


# Advice that does not mislead


@pytest.mark.parametrize("unit", ["ratio", "percent"])
def test_slip_above_one_names_both_definitions(my_csv: Write, unit: str) -> None:
    factor = 1.0 if unit == "ratio" else 100.0
    rows = "".join(f"{factor * s},1\n" for s in (0.0, 0.2, 0.5, 0.99, 3.0, 8.9))
    message = refusal(my_csv(f"slip_{unit},drawbar_pull_kn\n{rows}"))
    assert "s = 1 - v/(ωr)" in message
    assert "κ = ωr/v - 1" in message
    assert "s = κ/(1 + κ)" in message
    assert "did you mean" not in message
    assert "delete" not in message


def test_slip_that_is_percent_on_the_whole_is_told_so(my_csv: Write) -> None:
    message = refusal(my_csv("slip_ratio,drawbar_pull_kn\n0.5,1\n5,2\n20,3\n60,4\n"))
    assert "did you mean slip_percent?" in message
    assert "s = κ/(1 + κ)" in message


def test_one_value_above_the_range_does_not_make_percent_of_the_others(my_csv: Write) -> None:
    cells = "0.1\n0.12\n0.15\n12.0\n"
    message = refusal(my_csv(f"gravimetric_water_content\n{cells}"))
    assert "if all values are percent" in message
    assert "did you mean" not in message


@pytest.mark.parametrize(
    "header",
    [
        "Slip [%],Drawbar pull 1 [N],Drawbar pull 2 [N],Drawbar pull 3 [N]",
        "slip_percent,drawbar_pull_n,drawbar_pull_n.1,drawbar_pull_n.2",
        "slip_percent,drawbar_pull_n_run1,drawbar_pull_n_run2,drawbar_pull_n (checked)",
        "Slip [%],Drawbar pull rep 1 [N],Drawbar pull rep 2 [N],Drawbar pull rep 3 [N] (checked)",
        "slip_percent,drawbar_pull_n,drawbar_pull_n,drawbar_pull_kn",
    ],
)
def test_repeats_side_by_side_belong_below_one_another(my_csv: Write, header: str) -> None:
    message = refusal(my_csv(f"{header}\n1,2,3,4\n"))
    assert "all give drawbar_pull" in message
    assert "a row of its own" in message
    assert "a column 'repeat'" in message


@pytest.mark.parametrize(
    "header", ["drawbar_pull_sd_kn", "drawbar_pull_kn_lower", "Drawbar pull max [kN]"]
)
def test_a_derived_column_is_not_taken_for_the_reading(my_csv: Write, header: str) -> None:
    message = refusal(my_csv(f"{header}\n1\n"), required=["drawbar_pull_kn"])
    assert "did you mean" not in message
    assert f"{header!r} is read as derived from the drawbar pull" in message


@pytest.mark.parametrize(
    ("header", "factor"),
    [("cone_index_n_m2", "0.001"), ("Cone index [MN/m²]", "1000"), ("rut depth [µm]", "0.001")],
)
def test_a_unit_that_headers_do_not_know_is_to_be_converted(
    my_csv: Write, header: str, factor: str
) -> None:
    message = refusal(my_csv(f"{header}\n1\n"))
    assert f"multiply the readings by {factor}, and name the column" in message
    assert "did you mean" not in message
    assert "must be converted first" in refusal(my_csv("cone_index_stone\n1\n"))


def test_lines_above_the_column_names_are_told_and_may_be_deleted(my_csv: Write) -> None:
    table = "Slip [%];Drawbar pull [N]\n10;5\n20;7\n"
    path = my_csv(f"Testbed: NPTM\nLoad cell: 5 kN\n\n{table}")
    message = refusal(path, required=["slip_ratio"])
    assert "delete what stands above line 4" in message
    np.testing.assert_allclose(read_table(my_csv(table))["slip_ratio"], [0.1, 0.2])


@pytest.mark.parametrize("cells", ["1,234;0,1", "12,5;0,1", "0,250;0,100"])
def test_commas_that_are_decimal_signs_are_read(my_csv: Write, cells: str) -> None:
    table = read_table(my_csv(f"normal_load_kn;slip_ratio\n{cells}\n"))
    expected = [float(c.replace(",", ".")) for c in cells.split(";")]
    assert table["normal_load_kn"][0] == expected[0]
    # What is written beside predictions has the sign of these.
    assert table.text[0][0] == cells.split(";")[0].replace(",", ".")


def test_commas_that_may_separate_thousands_are_refused(my_csv: Write) -> None:
    message = refusal(my_csv("normal_load_n;slip_percent\n1,234;10\n2,500;20\n"))
    assert "'1,234' may be 1234 or 1.234" in message
