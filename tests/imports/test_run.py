"""Rows that are written: repeats, crop, bins and thinning, and how many they are worth."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import calib
from calib.errors import CalibError
from calib.imports import read_log, suggest_mapping
from calib.imports.independence import autocorrelation_time, rows_apart
from calib.imports.mapping import Mapped
from calib.imports.run import Imported, apply
from calib.imports.tables import RawTable
from tests.imports.files import SHARED, ar1, write

WIDE = "Slip [%];Pull 1 [N];Pull 2 [N];Load [N]\n5;1;2;24\n10;3;;24\n20;5;6;24\n"


def made(mapping: dict, **columns: object) -> Imported:
    frame = pd.DataFrame(columns)
    frame.index = pd.Index(frame.index + 2, name="line")
    return apply(RawTable(frame, {}, source="made"), Mapped.model_validate(mapping))


def columns(**units: str) -> dict:
    return {f"{name}": {"from": name, "unit": unit} for name, unit in units.items()}


def test_repeats_side_by_side_become_rows(tmp_path: Path) -> None:
    path = write(tmp_path / "a.csv", WIDE)
    log = read_log(path, tomllib.loads(suggest_mapping(path)))
    assert log.columns["slip_percent"].tolist() == [5, 5, 10, 20, 20]
    assert log.columns["drawbar_pull_n"].tolist() == [1, 2, 3, 5, 6]
    assert log.columns["repeat"].tolist() == ["1", "2", "1", "1", "2"]
    assert log.table.lines.tolist() == [2, 2, 3, 4, 4]
    assert (log.report.rows_read, log.report.rows_without_value) == (6, 1)


def test_rows_are_cropped_by_columns_of_the_file_and_of_the_mapping() -> None:
    mapping = {
        "columns": columns(drawbar_pull_kn="N"), "crop": {"t": [2, 8], "drawbar_pull_kn": [0, 0.6]}
    }  # fmt: skip
    log = made(mapping, t=np.arange(10.0), drawbar_pull_kn=100.0 * np.arange(10))
    assert log.columns["drawbar_pull_kn"].tolist() == pytest.approx([0.2, 0.3, 0.4, 0.5, 0.6])
    assert log.report.rows_cropped == 5
    assert log.kept.sum() == 5


def test_bins_are_means_of_the_rows_of_a_run() -> None:
    slip = np.array([0.01, 0.03, 0.11, 0.13, 0.01, 0.03])
    pull = np.array([1.0, 3.0, 5.0, 7.0, 10.0, 20.0])
    mapping = {
        "columns": columns(slip_ratio="1", drawbar_pull_kn="kN") | {"run": {"from": "test"}},
        "bins": {"slip_ratio": {"width": 0.1}},
    }
    log = made(mapping, slip_ratio=slip, drawbar_pull_kn=pull, test=["a"] * 4 + ["b"] * 2)
    assert log.columns["drawbar_pull_kn"].tolist() == [2.0, 6.0, 15.0]
    np.testing.assert_allclose(log.columns["slip_ratio"], [0.02, 0.12, 0.02])
    assert log.columns["run"].tolist() == ["a", "a", "b"]
    assert log.table.lines.tolist() == [2, 4, 6]
    assert (log.report.runs, log.report.every) == (2, 2)
    mapping["bins"] = {"slip_ratio": {"count": 1}}
    log = made(mapping, slip_ratio=slip, drawbar_pull_kn=pull, test=["a"] * 4 + ["b"] * 2)
    assert log.columns["drawbar_pull_kn"].tolist() == [4.0, 15.0]


@settings(max_examples=25)
@given(st.lists(st.floats(0.0, 1.0), min_size=2, max_size=40), st.integers(1, 9))
def test_bins_keep_the_mean_of_all_rows(slip: list[float], count: int) -> None:
    pull = np.arange(float(len(slip)))
    mapping = {"columns": columns(slip_ratio="1", drawbar_pull_kn="kN")}
    log = made(
        mapping | {"bins": {"slip_ratio": {"count": count}}},
        slip_ratio=slip, drawbar_pull_kn=pull,
    )  # fmt: skip
    assert log.report.rows_written <= count
    assert log.columns["slip_ratio"].min() >= min(slip) - 1e-12
    assert pull.min() <= log.columns["drawbar_pull_kn"].min()


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.8, 0.9])
def test_the_autocorrelation_time_is_that_of_the_noise_and_not_of_the_sweep(rho: float) -> None:
    n = 20_000
    slip = 0.3 + 0.3 * np.sin(2.0 * np.pi * np.arange(n) / 4000.0)
    load = np.where(np.arange(n) // 5000 % 2, 2.0, 1.0)
    pull = load * np.sin(1.5 * np.arctan(10.0 * slip)) + 0.05 * ar1(n, rho)
    time = autocorrelation_time(pull, [slip, load, np.ones(n)], np.zeros(n, dtype=np.int64))
    # Of 20,000 rows an autocorrelation time of 19 has a standard error of 7 %.
    assert time == pytest.approx((1.0 + rho) / (1.0 - rho), rel=0.2)


def test_a_run_is_thinned_to_independent_rows() -> None:
    n, rho = 40_000, 0.9
    half = np.repeat(["a", "b"], n // 2)
    mapping = {
        "columns": columns(drawbar_pull_kn="kN") | {"run": {"from": "run"}},
        "thin": {"every": "auto"},
    }
    log = made(mapping, drawbar_pull_kn=ar1(n, rho), run=half)
    assert log.report.every == pytest.approx(2 * 19 - 1, rel=0.2)
    assert log.report.worth == pytest.approx(n / 19, rel=0.2)
    left = log.columns["drawbar_pull_kn"]
    assert len(left) == 2 * -(-(n // 2) // log.report.every)
    assert abs(np.corrcoef(left[1:], left[:-1])[0, 1]) < 4.0 / np.sqrt(len(left))
    assert not log.report.warning
    again = made({**mapping, "thin": {"every": 2}}, drawbar_pull_kn=ar1(n, rho), run=half)
    assert "neighbouring rows are alike" in again.report.warning


def test_thinning_is_suggested_where_rows_are_alike(tmp_path: Path) -> None:
    rows = "\n".join(f"{x:.6f}" for x in ar1(3000, 0.8))
    path = write(tmp_path / "a.csv", f"FX [kN]\n{rows}\n")
    assert tomllib.loads(suggest_mapping(path))["thin"] == {"every": "auto"}
    rows = "\n".join(f"{x:.6f}" for x in ar1(3000, 0.0))
    assert "thin" not in tomllib.loads(suggest_mapping(write(path, f"FX [kN]\n{rows}\n")))


def test_few_rows_tell_no_autocorrelation() -> None:
    assert np.isnan(autocorrelation_time(np.arange(20.0), [], np.zeros(20, dtype=np.int64)))
    assert rows_apart({"a": float("nan")}) == 1
    assert [rows_apart({"a": t}) for t in (1.0, 1.2, 3.0, 19.0)] == [1, 1, 5, 37]


def test_an_import_goes_wherever_a_table_goes(tmp_path: Path) -> None:
    log = read_log(
        write(tmp_path / "a.csv", WIDE), tomllib.loads(suggest_mapping(tmp_path / "a.csv"))
    )
    assert list(log.to_dataframe()["drawbar_pull_n"]) == [1, 2, 3, 5, 6]
    assert len(log.plot().axes) >= 3
    assert calib.hold_out(log.table, "slip_percent", 5)[1]["drawbar_pull_kn"].tolist() == [
        0.001,
        0.002,
    ]


@pytest.mark.parametrize(
    ("name", "rows", "first"),
    [
        ("header_block", 27, -1.0),
        ("plates_negative_kc", 90, None),
        ("predict_decimal_comma", 2, 0.025),
        ("rover_no_load", 15, 0.0033),
        ("rover_no_load_unchecked", 15, 0.0033),
        ("rover_with_load", 15, 0.0033),
        ("sae_slip_above_1", 15, 0.0038 / 1.0038),
    ],
)
def test_files_of_the_field_are_read(name: str, rows: int, first: float | None) -> None:
    path = SHARED / f"{name}.csv"
    if not path.exists():
        pytest.skip("no shared files here")
    log = read_log(path, tomllib.loads(suggest_mapping(path)))
    assert log.report.rows_written == rows
    assert log.report.unused == ()
    if first is not None:
        assert log.table["slip_ratio"][0] == pytest.approx(first)


def test_a_file_whose_rows_differ_in_length_is_refused() -> None:
    if not (SHARED / "replicates_wide.csv").exists():
        pytest.skip("no shared files here")
    with pytest.raises(calib.CalibError, match="line 5: the row has 4 cells"):
        suggest_mapping(SHARED / "replicates_wide.csv")


def test_a_unit_that_the_file_contradicts_is_said(tmp_path: Path) -> None:
    text = "FX;P\nN;kPa\n410;180\n930;181\n"
    columns = {"drawbar_pull_n": {"from": "FX", "unit": "N"},
               "inflation_pressure_psi": {"from": "P", "unit": "psi"}}  # fmt: skip
    path = write(tmp_path / "rig.txt", text)
    report = read_log(path, {"columns": columns}).report
    assert report.warning == "P is read in psi, as the mapping says; the file says kPa"


def test_kappa_is_no_column_of_the_other_slip(tmp_path: Path) -> None:
    path = write(tmp_path / "rig.txt", "v;w;FX\n1.0;4.0;410\n0.9;4.0;930\n")
    speeds = {"speed": {"from": "v", "unit": "m/s"}, "wheel_speed": {"from": "w", "unit": "rad/s"},
              "radius": {"value": 0.3, "unit": "m"}}  # fmt: skip
    for name in ("slip_ratio", "slip_percent"):
        with pytest.raises(CalibError, match="kappa is the slip"):
            read_log(path, {"columns": {name: {"derive": "kappa", "inputs": speeds}}})
    columns = {
        "slip_kappa_ratio": {"derive": "kappa", "inputs": speeds},
        "drawbar_pull_n": {"from": "FX", "unit": "N"},
    }
    slip = read_log(path, {"columns": columns, "thin": {"every": 1}}).table
    np.testing.assert_allclose(slip["slip_ratio"], [1 - 1.0 / 1.2, 1 - 0.9 / 1.2])
    assert slip["run_order"].tolist() == [1.0, 2.0]
