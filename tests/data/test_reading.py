"""CSV files and arrays: what is read, in which unit, and what is refused with which words."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from syrupy.assertion import SnapshotAssertion

from calib.data import hold_out, read_table, table_from_arrays, write_table
from calib.data.table import parse_header
from calib.errors import CalibError

SHARED = Path(__file__).resolve().parents[3] / "shared"

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


def refusal(path: Path, **options: object) -> str:
    """Return the message that reading a file ends with, without its folder."""
    with pytest.raises(CalibError) as caught:
        read_table(path, **options)  # type: ignore[arg-type]
    message = str(caught.value)
    assert str(path) in message
    assert "hint:" in message
    return message.replace(f"{path.parent}/", "")


def refusals(my_csv: Write, contents: Iterable[str | bytes], **options: object) -> str:
    said = [f"{content!r}\n{refusal(my_csv(content), **options)}" for content in contents]
    return "\n\n".join(said)


def test_a_file_becomes_columns_in_canonical_units(my_csv: Write) -> None:
    path = my_csv(GOOD)
    table = read_table(path, required=["slip_ratio", "drawbar_pull_kn"], label="made up")
    assert list(table) == ["slip_ratio", "inflation_pressure_psi", "drawbar_pull_kn"]
    assert table["slip_ratio"].tolist() == [0.1, 0.2]
    assert table["drawbar_pull_kn"].tolist() == [0.9, 0.95]
    assert table["inflation_pressure_psi"] == pytest.approx([17.9992, 29.9938], abs=1e-4)
    assert table.lines.tolist() == [2, 3]
    assert table.text[1] == ("20", "206.8", "950", "B")
    assert (table.ignored, table.extra) == (("operator",), {"operator": ("A", "B")})
    assert (table.source, table.label) == (str(path), "made up")
    assert table.sha256 == hashlib.sha256(GOOD.encode()).hexdigest()


@pytest.mark.parametrize("header", ["slip_kappa_percent", "Slip κ [%]", "slip_kappa_ratio"])
def test_a_slip_may_be_kappa(my_csv: Write, header: str) -> None:
    unit = 1.0 if header.endswith("ratio") else 100.0
    kappa = np.array([-0.5, -0.2, 0.0, 0.25, 9.0])
    rows = "".join(f"{unit * k!r},{i}\n" for i, k in enumerate(kappa.tolist()))
    table = read_table(my_csv(f"{header},drawbar_pull_kn\n{rows}"))
    np.testing.assert_allclose(table["slip_ratio"], [-1.0, -0.25, 0.0, 0.2, 0.9], atol=1e-15)
    np.testing.assert_allclose(
        table.column("slip_ratio").written(table["slip_ratio"]), unit * kappa
    )
    written = table.as_in_file({"slip_ratio": table["slip_ratio"]})
    assert written[header] == pytest.approx(unit * kappa)
    kept, held = hold_out(table, header, unit * 0.25)
    assert (len(kept), held["slip_ratio"].tolist()) == (4, [0.2])
    with pytest.raises(CalibError, match=f"the values present: {-0.5 * unit:g}"):
        hold_out(table, header, unit * 0.3)


@given(st.floats(-0.5, 1e6))
def test_kappa_comes_back(kappa: float) -> None:
    column = parse_header("slip_kappa_ratio")
    assert column is not None
    slip = float(column.to_canonical(kappa))
    assert -1.0 <= slip < 1.0
    # 1 + kappa is 1/(1 - s): of a spinning wheel s is near 1, where digits are few.
    assert float(column.written(slip)) == pytest.approx(kappa, rel=1e-15 * (3.0 + abs(kappa)))


@pytest.mark.parametrize(
    ("header", "cell", "words"),
    [
        ("slip_kappa", "0.1", ["does not say the unit", "for example slip_kappa_ratio"]),
        ("slip_kappa_prcent", "10", ["did you mean slip_kappa_percent?"]),
        ("slip_kappa_percent", "-80", ["-50", "is κ = -0.5: leave the row out"]),
        ("slip_kappa_ratio", "-1", ["of at least -0.5", "leave the row out"]),
        ("slip_ratio", "1.7", ["κ = ωr/v - 1, rename the column slip_kappa_ratio"]),
    ],
)
def test_slips_that_are_none_are_refused(
    my_csv: Write, header: str, cell: str, words: list[str]
) -> None:
    message = refusal(my_csv(f"{header},drawbar_pull_kn\n{cell},1\n"))
    for word in words:
        assert word in message


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


@pytest.mark.parametrize("cells", ["1,234;0,1", "12,5;0,1", "0,250;0,100"])
def test_commas_that_are_decimal_signs_are_read(my_csv: Write, cells: str) -> None:
    table = read_table(my_csv(f"normal_load_kn;slip_ratio\n{cells}\n"))
    assert table["normal_load_kn"][0] == float(cells.split(";")[0].replace(",", "."))
    # What is written with predictions has the sign of these.
    assert table.text[0][0] == cells.split(";")[0].replace(",", ".")


# The words of refusals stand in the snapshot: file, line, column, what was found, what is expected
# and how to correct it.


def test_unreadable_files(my_csv: Write, snapshot: SnapshotAssertion) -> None:
    contents = [
        b"", b"\xef\xbb\xbf\n \n", b"slip_ratio,speed_m_s\n", b"0.1,0.2\n0.3,0.4\n",
        GOOD.encode("utf-16-le"), b"PK\x03\x04rest of a workbook",
        "slip_ratio,Prüfer\n0.1,ä\n".encode("latin-1"), b'slip_ratio\n0.1\n"0.2\n',
        b"slip_ratio,speed_m_s\n0.1,1\n0.2\n", b"slip_ratio,speed_m_s\n0,1,1\n",
    ]  # fmt: skip
    assert refusals(my_csv, contents) == snapshot
    assert "is not UTF-16" in refusal(my_csv(GOOD.encode("utf-16")[:-1]))


def test_paths_that_are_no_file(my_csv: Write, tmp_path: Path) -> None:
    my_csv(GOOD)
    assert "its folder holds my.csv" in refusal(tmp_path / "mine.csv")
    assert "no such file" in refusal(tmp_path / "nowhere" / "mine.csv")
    assert "this is a folder" in refusal(tmp_path)
    with pytest.raises(CalibError, match="cannot be read"):
        read_table("my\0.csv")


def test_wrong_columns(my_csv: Write, snapshot: SnapshotAssertion) -> None:
    headers = [
        "slip_ratio,slip_percent", "slip_ratio,slip_ratio", "slip_ratio,cone_index_stone",
        "slip_ratio,cone_index_kn", "slip,cone_index_kpa", "slip_ratio,cone_indx_kpa",
        "slip_ratio,depth", "slip,Drawbar pull,rut_depth_kn,note",
        "slip_ratio,cone_index_sd_kpa", "Slipp [%],Pull (lbf),kN",
        "slip_ratio,cone_index_n_m2", "slip_ratio,Cone index [MN/m²]",
    ]  # fmt: skip
    contents = [f"{header}\n0.1,2\n" for header in headers]
    assert refusals(my_csv, contents, required=["slip_ratio", "cone_index_kpa"]) == snapshot


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
    assert "a column 'repeat'" in message


def test_lines_above_the_column_names_may_be_deleted(my_csv: Write) -> None:
    table = "Slip [%];Drawbar pull [N]\n10;5\n20;7\n"
    path = my_csv(f"Testbed: NPTM\nLoad cell: 5 kN\n\n{table}")
    assert "delete what stands above line 4" in refusal(path, required=["slip_ratio"])
    np.testing.assert_allclose(read_table(my_csv(table))["slip_ratio"], [0.1, 0.2])


def test_bad_cells(my_csv: Write, snapshot: SnapshotAssertion) -> None:
    cells = {
        "slip_ratio": ["", "NaN", "12.5", "-250"], "slip_percent": ["101"],
        "drawbar_pull_kn": ["inf", "1e999", "-1e300", "about 2", "2 kN", "1_000"],
        "drawbar_pull_n": ['"1,234"'], "normal_load_kn": ["1e300", "-5"],
        "nominal_slip_ratio": ["2"], "inflation_pressure_psi": ["-30"],
        "inflation_pressure_kpa": ["0"], "average_ground_pressure_kpa": ["-1"],
        "cone_index_mpa": ["0"], "speed_m_s": ["-1"], "pass_number": ["0", "1.5"],
        "run_order": ["first"], "repeat": [" "], "bulk_density_g_cm3": ["1650"],
        "gravimetric_water_content": ["8.8"], "volumetric_water_content": ["-0.1"],
        "rut_depth_mm": ["0", "-999"], "rut_depth_cm": ["-2"],
    }  # fmt: skip
    contents = [f"operator,{h}\nA,1\nB,{cell}\n" for h, every in cells.items() for cell in every]
    assert refusals(my_csv, contents) == snapshot
    assert "from 300 to 3500 kg/m3" in refusal(my_csv("bulk_density_kg_m3\n1650\n1.65\n"))


def test_several_problems_come_in_one_message(my_csv: Write, snapshot: SnapshotAssertion) -> None:
    contents = [
        "slip_ratio,speed_m_s\n0.1,fast\n3,1\n0.2,-1\n0.3\n",
        "slip_ratio;cone_index_kpa\n0.5;900\n0.6;1,234\n",
        "cone_index_kpa;a\n1.234,5;b\n",
        "normal_load_n;slip_percent\n1,234;10\n2,500;20\n",
        "slip_ratio,drawbar_pull_kn\n0,1\n0.2,1\n0.99,1\n3,1\n8.9,1\n",
        "slip_ratio,drawbar_pull_kn\n0.5,1\n5,2\n20,3\n60,4\n",
        "gravimetric_water_content\n0.1\n0.12\n0.15\n12.0\n",
    ]
    assert refusals(my_csv, contents) == snapshot


@pytest.mark.parametrize("cell", ["x", "-1"])
def test_many_bad_cells_are_counted(my_csv: Write, cell: str) -> None:
    lines = refusal(my_csv("speed_m_s\n" + f"{cell}\n" * 5000)).splitlines()
    assert lines[0].endswith("5000 problems in the data")
    assert [line.split(",")[0].strip() for line in lines[1:6]] == [f"line {i}" for i in range(2, 7)]
    assert lines[6].strip() == "and 4995 more"


@pytest.mark.parametrize("code", ["-999", "-9999", "9999", "-999.25", "-99.9", "99999", "-32768"])
@pytest.mark.parametrize("header", ["drawbar_pull_kn", "Drawbar pull [lbf]"])
def test_a_code_for_a_missing_value_is_no_reading(my_csv: Write, code: str, header: str) -> None:
    rows = [f"10,{value}" for value in ("0.5", "1.2", code, "1.4", code)]
    path = my_csv("\n".join([f"slip_percent,{header}", *rows]) + "\n")
    said = refusal(path)
    for line in (4, 6):
        assert f"line {line}, column {header!r}: {code} looks like a code for a missing" in said
    assert "where the others are 0.5 to 1.4" in said
    assert "leave the cell empty" in refusal(path, allow_missing=["drawbar_pull_kn"])
    # Where the column is not used it does not matter.
    assert len(read_table(path, required=["slip_ratio"])) == 5
    # A reading it may be.
    sure = my_csv(path.read_text().replace(header, f"{header} (Checked)"))
    assert read_table(sure).header[1] == f"{header} (Checked)"


@pytest.mark.parametrize(
    ("header", "values"),
    [
        ("drawbar_pull_n", [-1500.0, -999.0, 200.0, 1800.0]),  # towed and driven
        ("cone_index_kpa", [400.0, 999.0, 1300.0]),
        ("average_ground_pressure_kpa", [99.0, 150.0]),
        ("run_order", [1.0, 2.0, 9999.0]),
    ],
)
def test_readings_among_others_are_no_codes(header: str, values: list[float]) -> None:
    assert len(table_from_arrays({header: np.array(values)})) == len(values)


def test_arrays_are_checked_as_files_are() -> None:
    table = table_from_arrays({"slip_percent": [10, 20], "Rut depth (cm)": [1.5, 2.0], "x": [1, 2]})
    assert table["slip_ratio"].tolist() == [0.1, 0.2]
    assert table["rut_depth_mm"].tolist() == [15.0, 20.0]
    assert table.text == (("10", "1.5", "1"), ("20", "2.0", "2"))
    assert (table.ignored, table.source, table.lines.tolist()) == (("x",), "arrays", [0, 1])
    same = table_from_arrays({"rut_depth_mm": [15.0, 20.0], "slip_ratio": [0.1, 0.2]})
    assert same.sha256 == table.sha256
    with pytest.raises(CalibError, match="2 problems in the data"):
        table_from_arrays({"drawbar_pull_kn": np.array([-999.0, -999.0])})


@pytest.mark.parametrize(
    ("columns", "word"),
    [
        ({"slip_ratio": [0.1, 12.0]}, "arrays, row 1, column 'slip_ratio'"),
        ({"slip_ratio": [0.1, np.nan]}, "row 1, .*'nan' is not a finite number"),
        ({"slip_ratio": ["a", "b"]}, "not numbers"),
        ({"slip_ratio": [0.1], "speed_m_s": [1, 2]}, "one shape"),
        ({"slip_ratio": [[0.1]]}, "flatten"),
        ({"slip_ratio": []}, "at least one row"),
        ({}, "n of at least 1"),
        ({"slip": [0.1]}, "arrays, column 'slip': .*does not say the unit"),
    ],
)
def test_bad_arrays(columns: dict[str, object], word: str) -> None:
    with pytest.raises(CalibError, match=word):
        table_from_arrays(columns)  # type: ignore[arg-type]


def test_a_large_file_is_read_without_its_text(tmp_path: Path) -> None:
    path, n = tmp_path / "large.csv", 20_000
    slips = np.random.default_rng(2).uniform(-1.0, 1.0, n)
    write_table(path, {"slip_ratio": slips, "repeat": np.arange(n) % 3})
    table = read_table(path)
    assert np.array_equal(table["slip_ratio"], slips)
    assert np.array_equal(table["repeat"], np.arange(n) % 3)
    assert (table.text, table.lines[-1]) == ((), n + 1)


@pytest.mark.skipif(not SHARED.exists(), reason="the measured data are not in the repository")
def test_measured_data_are_read() -> None:
    needed = ["cone_index_kpa", "gravimetric_water_content", "bulk_density_g_cm3"]
    table = read_table(SHARED / "data" / "soil_skp1994.csv", required=needed)
    assert table["cone_index_kpa"][0] == 230.0
    assert table.ignored == ("matric_suction_cm",)
    for path in sorted((SHARED / "cases").glob("*/*.csv")):
        assert read_table(path).ignored == ()


def test_a_table_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "out.csv"
    write_table(path, {"slip_ratio": [-0.0001, np.nan], "pass_number": [1, 2], "a": ["a,b", "c"]})
    assert path.read_text() == 'slip_ratio,pass_number,a\n-0.0001,1,"a,b"\n,2,c\n'
    with pytest.raises(CalibError, match="differ in length"):
        write_table(path, {"a": [1.0], "b": [1.0, 2.0]})
    assert path.read_text().startswith("slip_ratio")
    folder = tmp_path / "folder"
    folder.mkdir()
    for target in (tmp_path / "nowhere" / "out.csv", path / "out.csv", folder):
        with pytest.raises(CalibError, match="cannot be written"):
            write_table(target, {"a": [1.0]})
    assert sorted(p.name for p in tmp_path.iterdir()) == ["folder", "out.csv"]


def test_columns_are_written_in_the_units_of_their_file(my_csv: Write, tmp_path: Path) -> None:
    text = "Slip (%),Drawbar pull [lbf],rut_depth_mm\n0.7,2851.464474674471,12.5\n5.3,12.0,\n"
    table = read_table(my_csv(text), allow_missing=("rut_depth_mm",))
    write_table(tmp_path / "again.csv", table.as_in_file(table.columns))
    assert (tmp_path / "again.csv").read_text() == text
