"""Every kind of file becomes the same columns with the same units, or is refused with advice."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.io import savemat

from calib.data.table import normal
from calib.errors import CalibError
from calib.imports.tables import is_unit, read_raw
from tests.imports.files import TTC, write

ROWS = {"Slip": [2.5, 10.0], "Pull": [410.5, 930.0]}
PLAIN = "Slip [%],Pull (N)\n2.5,410.5\n10,930\n"


@pytest.mark.parametrize(
    ("text", "encoding"),
    [
        (PLAIN, "utf-8"),
        (PLAIN, "utf-16"),
        (PLAIN.replace("Pull", "Püll"), "cp1252"),
        (PLAIN.replace("\n", "\r\n"), "utf-8"),
        (PLAIN.replace(",", ";").replace(".", ","), "utf-8"),
        (PLAIN.replace(",", "\t").replace(".", ","), "utf-8"),
        (PLAIN.replace(",", " , "), "utf-8"),
        ("Rig: 7\nDate: 1.5.2026\n\n" + PLAIN, "utf-8"),
        ("# rig 7\n# rate,100\n" + PLAIN, "utf-8"),
        ("# " + PLAIN.replace("\n10", "\n# paused here\n10"), "utf-8"),
        ("Slip,Pull\n%,N\n2.5,410.5\n10,930\n", "utf-8"),
        ("rig 7\nSlip;Pull\n[%];[N]\n\n2,5;410,5\n10;930\n", "utf-8"),
        ("Slip_% Pull_N\n 2.5   410.5\n10 930\n", "utf-8"),
        ('"Slip [%]","Pull / N"\n"2.5","410.5"\n"10","930"\n', "utf-8"),
        ("Slip [%],Pull (N),\n2.5,410.5,\n10,930,\n,,\n\n", "utf-8"),
    ],
)
def test_dialects_make_no_difference(tmp_path: Path, text: str, encoding: str) -> None:
    raw = read_raw(write(tmp_path / "rig.txt", text, encoding))
    assert [normal(unit) for unit in raw.units.values()] == ["percent", "n"]
    np.testing.assert_array_equal(raw.frame.to_numpy(), np.column_stack([*ROWS.values()]))
    lines = text.replace("\r", "").split("\n")
    of_numbers = [i for i, line in enumerate(lines, 1) if "2.5" in line or "2,5" in line]
    assert raw.frame.index[0] == of_numbers[0]


def test_names_and_units_stand_in_lines_of_their_own(tmp_path: Path) -> None:
    raw = read_raw(write(tmp_path / "run7.dat", TTC))
    assert list(raw.frame) == ["ET", "V", "FX", "FZ", "SR", "IA", "P", "TSTC"]
    assert (raw.units["TSTC"], raw.units["SR"]) == ("deg C", "none")
    assert raw.frame["FZ"].tolist() == [-3000, -3010]
    assert raw.frame.index.tolist() == [4, 5]


CHANNELS = """\
Channels\t2
Samples\t3\t3
X_Dimension\tTime\tTime
X0\t0.0\t0.0
***End_of_Header***
Slip [%]\tPull [N]\tComment
2.5\t410.5\tok
10\t930
"""


def test_tables_of_channels_stand_above_the_names(tmp_path: Path) -> None:
    raw = read_raw(write(tmp_path / "a.lvm", CHANNELS.replace("930", "930\t")))
    assert raw.frame["Pull [N]"].tolist() == [410.5, 930]


def test_names_that_are_repeated_begin_no_new_table(tmp_path: Path) -> None:
    raw = read_raw(write(tmp_path / "a.csv", f"{PLAIN}pause,\n{PLAIN}"))
    assert len(raw.frame) == 6


def test_text_beside_numbers_is_kept(tmp_path: Path) -> None:
    raw = read_raw(write(tmp_path / "a.csv", "who,slip,who\nAnn,5,a\nBob,,b\n"))
    assert raw.frame["who"].tolist() == ["Ann", "Bob"]
    assert raw.frame["who (2)"].tolist() == ["a", "b"]
    assert np.isnan(raw.frame["slip"].iloc[1])


@pytest.mark.parametrize("engine", ["openpyxl"])
def test_a_workbook(tmp_path: Path, engine: str) -> None:
    pytest.importorskip("python_calamine")
    pytest.importorskip(engine)
    cells = [
        ["Rig 7", None],
        [None, None],
        ["Slip", "Pull"],
        ["%", "N"],
        *zip(*ROWS.values(), strict=True),
    ]
    path = tmp_path / "rig.xlsx"
    with pd.ExcelWriter(path, engine=engine) as book:
        pd.DataFrame(cells).to_excel(book, sheet_name="Data", header=False, index=False)
    raw = read_raw(path)
    np.testing.assert_array_equal(raw.frame.to_numpy(), np.column_stack([*ROWS.values()]))
    assert (raw.units, raw.sheet, raw.frame.index.tolist()) == (
        {"Slip": "%", "Pull": "N"},
        "",
        [5, 6],
    )
    with pd.ExcelWriter(path, engine=engine, mode="a") as book:
        pd.DataFrame({"a": [1]}).to_excel(book, sheet_name="Notes")
    with pytest.raises(CalibError, match="there are 2 sheets") as caught:
        read_raw(path)
    assert "'Data', 'Notes'" in str(caught.value)
    assert read_raw(path, "Data").frame.equals(raw.frame)


def test_matlab_files_of_the_tyre_test_consortium(tmp_path: Path) -> None:
    columns = {"SR": [0.05, 0.25], "FX": [410.5, 930.0]}
    channel = {"name": np.array([*columns], object), "units": np.array(["none", "N"], object)}
    arrays = {name: np.array(values)[:, None] for name, values in columns.items()}
    savemat(
        tmp_path / "run7.mat", {**arrays, "channel": channel, "testid": "drive", "k": [1, 2, 3]}
    )
    raw = read_raw(tmp_path / "run7.mat")
    assert {name: raw.frame[name].tolist() for name in raw.frame} == columns
    assert raw.units == {"SR": "none", "FX": "N"}
    assert raw.notes == ["of another length than most, not read: k"]


def test_structs_and_matrices_of_matlab(tmp_path: Path) -> None:
    savemat(tmp_path / "a.mat", {"run": {"FX": np.arange(3.0), "cells": np.ones((3, 2))}})
    assert list(read_raw(tmp_path / "a.mat").frame) == ["run.FX", "run.cells[1]", "run.cells[2]"]


def test_parquet(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    pd.DataFrame({"Slip [%]": [2.5], "Pull": [410.5]}).to_parquet(tmp_path / "a.parquet")
    raw = read_raw(tmp_path / "a.parquet")
    assert (raw.frame["Pull"].tolist(), raw.units) == ([410.5], {"Slip [%]": "%"})


numbers = st.lists(
    st.tuples(*[st.floats(-1e6, 1e6).map(lambda x: round(x, 6))] * 3), min_size=1, max_size=20
)


@given(
    rows=numbers,
    delimiter=st.sampled_from(";\t|"),
    sign=st.sampled_from(",."),
    above=st.integers(0, 3),
)
def test_what_is_written_is_read(
    tmp_path_factory: pytest.TempPathFactory, rows, delimiter: str, sign: str, above: int
) -> None:
    lines = ["made by hand"] * above + [delimiter.join(["FX [N]", "FZ [kN]", "Slip [%]"])]
    lines += [delimiter.join(f"{x:.6f}".replace(".", sign) for x in row) for row in rows]
    raw = read_raw(write(tmp_path_factory.mktemp("rig") / "a.txt", "\n".join(lines)))
    np.testing.assert_array_equal(raw.frame.to_numpy(), np.array(rows))
    assert [*raw.units.values()] == ["N", "kN", "%"]


@pytest.mark.parametrize(
    "unit", ["kN/m²", "[°C]", "1/min", "m/s^2", "N·m", "(N-m)", "g/cm³", "mV/V", "-"]
)
def test_units_as_rigs_write_them(unit: str) -> None:
    assert is_unit(unit)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.csv", b"1,2\n3,4\n", ["no line names the columns"]),
        ("a.csv", b"only words\nand more\n", ["no rows of numbers"]),
        ("a.csv", b"a;b;c\n1;2;3\n4;5\n", ["line 3", "2 cells", "a, b, c"]),
        ("a.csv", b"a,b\n1,2\n3,4\n1,2,3\n", ["line 4", "3 cells"]),
        ("a.csv", b"PK\x03\x04\x00\x00", ["binary"]),
        ("a.xlsx", b"not a workbook", ["damaged or not what its name says"]),
        ("a.mat", b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM", ["-v7"]),
        ("missing/a.csv", None, ["cannot be read"]),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_refused_with_advice(
    tmp_path: Path, name: str, content: bytes | None, words: list[str]
) -> None:
    if name.endswith(".xlsx"):
        pytest.importorskip("python_calamine")
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(CalibError) as caught:
        read_raw(tmp_path / name)
    assert "hint:" in str(caught.value)
    assert str(tmp_path / name) in str(caught.value)
    for word in words:
        assert word in str(caught.value)


def test_a_missing_package_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(*_: object, **__: object) -> None:
        raise ImportError("Missing optional dependency 'pyarrow'")

    monkeypatch.setattr("pandas.read_parquet", absent)
    (tmp_path / "a.parquet").touch()
    with pytest.raises(CalibError, match=r"pip install 'terracalib\[import\]'"):
        read_raw(tmp_path / "a.parquet")
