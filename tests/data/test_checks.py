"""Columns as in another unit: refused where a model is fitted to them, unless they were checked."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calib.data import read_for_model, read_table, table_from_arrays, write_table
from calib.data.checks import beyond_notes, check_conditions, check_units, column_notes, unit_notes
from calib.errors import CalibError
from calib.models import MODELS, example_csv

SLIP = np.linspace(0.0, 0.6, 13)
PULL = 1.5 * np.sin(8.0 * SLIP) + 0.5


@pytest.mark.parametrize(("header", "values", "unit"), [
    ("drawbar_pull_kn", 1e3 * PULL, "1000 times too large"),  # N typed as kN
    ("Drawbar pull [N]", PULL, "1000 times too small"),    # kN typed as N
    ("average_ground_pressure_pa", np.linspace(60.0, 200.0, 9), "kPa"),
    ("average_ground_pressure_mpa", np.linspace(60.0, 200.0, 9), "kPa"),
    ("cone_index_kpa", np.linspace(0.3, 1.2, 9), "MPa"),
    ("normal_load_kn", np.full(9, 5000.0), "N"),
    ("slip_percent", SLIP, "fractions"),
    ("rut_depth_mm", np.linspace(0.01, 0.06, 9), "m"),
    ("inflation_pressure_psi", np.linspace(1.2, 2.6, 9), "bar"),
    ("inflation_pressure_kpa", np.array([12.0, 18.0, 20.0]), "psi"),
    ("inflation_pressure_pa", np.array([124.0, 207.0]), "kPa"),
])  # fmt: skip
def test_a_whole_column_in_another_unit_is_refused(
    header: str, values: np.ndarray, unit: str
) -> None:
    table = table_from_arrays({header: values}, source="my.csv")
    (name,) = table.columns
    with pytest.raises(CalibError) as caught:
        check_units(table, [name])
    said = str(caught.value)
    assert f"my.csv, column {header!r}: " in said
    assert unit in said
    assert f"'{header} (checked)'" in said
    # A column that is not used is only warned of.
    check_units(table, [])
    sure = table_from_arrays({f"{header} (checked)": values}, source="my.csv")
    np.testing.assert_array_equal(sure[name], table[name])
    check_units(sure, [name])
    assert not list(column_notes(sure))


@pytest.mark.parametrize(("header", "values"), [
    ("drawbar_pull_kn", PULL),
    ("drawbar_pull_kn", np.append(PULL, 1e3 * PULL[4:7])),  # some in N: named, not refused
    ("drawbar_pull_kn", np.zeros(5)),
    ("inflation_pressure_psi", np.array([3.5, 5.0, 7.0])),  # all-terrain vehicles
    ("inflation_pressure_psi", np.array([124.0, 207.0, 290.0])),  # lorries, or kPa
    ("slip_percent", np.array([0.0, 0.5, 40.0])),
    ("cone_index_kpa", np.array([20.0, 460.0])),
    ("speed_m_s", np.array([1e-3])),
])  # fmt: skip
def test_values_that_can_be_right_are_not_refused(header: str, values: np.ndarray) -> None:
    table = table_from_arrays({header: values}, source="my.csv")
    check_units(table, table.columns)


def test_every_example_is_usual(tmp_path: Path) -> None:
    for name, model in MODELS.items():
        path = tmp_path / f"{name}.csv"
        path.write_text(example_csv(name), encoding="utf-8")
        table = read_for_model(path, (*model.conditions, model.output))
        check_units(table, table.columns)


@pytest.mark.parametrize(("header", "values", "refused"), [
    ("inflation_pressure_mpa", [18.0, 42.0], "psi"),
    ("inflation_pressure_psi", [18_000.0], ""),            # in no unit among them
    ("inflation_pressure_psi", [124.0, 290.0], ""),        # lorries, or kPa: a warning
    ("inflation_pressure_pa", [124.0, 207.0], "kPa"),
    ("inflation_pressure_psi", [30.0, 18_000.0], ""),
])  # fmt: skip
def test_conditions_far_from_the_calibrated_ones_in_another_unit_are_refused(
    header: str, values: list[float], refused: str
) -> None:
    known = {"inflation_pressure_psi": np.array([17.9, 30.0, 42.1])}
    table = table_from_arrays({header: np.array(values)}, source="at.csv")
    if not refused:
        check_conditions(table, known)
        return
    with pytest.raises(CalibError, match=f"readings are in {refused}"):
        check_conditions(table, known)
    sure = table_from_arrays({f"{header} (checked)": np.array(values)}, source="at.csv")
    check_conditions(sure, known)


def test_slips_may_be_as_near_to_zero_as_one_likes() -> None:
    known = {"slip_ratio": np.array([0.05, 0.6])}
    for header, values in {
        "slip_ratio": [0.001, 0.003],
        "slip_percent (checked)": [0.1, 0.3],
    }.items():
        check_conditions(table_from_arrays({header: np.array(values)}), known)
    small = {"slip_ratio": np.array([0.001, 0.01])}
    with pytest.raises(CalibError, match="readings are in percent"):
        check_conditions(table_from_arrays({"slip_ratio": np.array([0.3])}), small)


def test_conditions_of_an_unusual_size_are_refused_as_a_fit_refuses_them() -> None:
    """They lie within the calibrated range as they are, so that nothing else would be said."""
    table = table_from_arrays({"slip_percent": SLIP}, source="at.csv")
    with pytest.raises(CalibError, match="readings are in fractions"):
        check_conditions(table, {"slip_ratio": SLIP})
    # The calibration's own slips were as small, and checked.
    check_conditions(table, {"slip_ratio": 0.01 * SLIP})


def test_messages_are_in_the_words_and_units_of_the_file() -> None:
    """Of a header `Drawbar pull [lbf]` neither kN nor drawbar_pull_kn is spoken of."""
    columns = {"Drawbar pull [lbf]": 250_000.0 * PULL, "Inflation [x]": SLIP}
    table = table_from_arrays(columns, source="my.csv")
    (said,) = column_notes(table)
    assert said.startswith("my.csv, Drawbar pull [lbf]: the largest drawbar pull is 4.9")
    assert "lbf, and 33.72 to 26980 lbf is usual" in said
    pressure = table_from_arrays({"Inflation pressure [kPa]": np.array([20.0, 200.0])}, source="p")
    (said,) = unit_notes(
        pressure, pressure.column("inflation_pressure_psi").quantity,
        pressure["inflation_pressure_psi"],
    )  # fmt: skip
    assert "p, line 0: inflation pressure ('Inflation pressure [kPa]') is outside 41.37 to" in said
    assert "1034 kPa" in said
    known = {"inflation_pressure_psi": np.array([18.0, 42.0])}
    far = table_from_arrays({"Inflation pressure [kPa]": np.array([18.0, 42.0])}, source="p")
    (said,) = beyond_notes(far, known)
    assert said == (
        "p, lines 0, 1: Inflation pressure [kPa] as far off as 18, calibrated from 124.1 to "
        "289.6 kPa; inside if the readings are in psi; check the unit in the column name"
    )


def test_what_was_checked_is_so_for_whoever_reads_the_file_that_is_written(tmp_path: Path) -> None:
    table = table_from_arrays({"Drawbar pull [N] (checked)": PULL, "slip_ratio": SLIP})
    write_table(tmp_path / "data.csv", table.to_write(table.columns))
    again = read_table(tmp_path / "data.csv")
    assert again.header == ("drawbar_pull_kn (checked)", "slip_ratio")
    np.testing.assert_array_equal(again["drawbar_pull_kn"], table["drawbar_pull_kn"])
    check_units(again, again.columns)
