"""The regression of Eq 22 on the written ruts returns Table 6."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

type Array = NDArray[np.float64]
type Columns = dict[str, Array]

PRESSURES_PSI = (18, 30, 42)


def at(table: Columns, psi: int) -> Columns:
    rows = table["inflation_pressure_psi"] == psi
    return {name: column[rows] for name, column in table.items()}


def log_regression(table: Columns) -> tuple[Array, float, float]:
    rows = table["inflation_pressure_psi"] != 30
    ln_p = np.log(table["average_ground_pressure_kpa"][rows])
    ln_z = np.log(table["rut_depth_mm"][rows] / 1000.0)
    X = np.column_stack([ln_z, table["slip_ratio"][rows] * ln_z, np.ones(ln_z.size)])
    beta = np.linalg.lstsq(X, ln_p)[0]
    sse = float(np.sum((ln_p - X @ beta) ** 2))
    r_squared = 1.0 - sse / float(np.sum((ln_p - ln_p.mean()) ** 2))
    return beta, r_squared, float(np.sqrt(sse / (ln_p.size - 3)))


def test_rut_design(files: dict[str, Columns]) -> None:
    table = files["rut_depth"]
    for psi in PRESSURES_PSI:
        rows = at(table, psi)
        assert rows["slip_ratio"] == pytest.approx(np.arange(9) * 0.025)
        assert np.unique(rows["average_ground_pressure_kpa"]).size == 1
    low, mid, high = (at(table, p)["average_ground_pressure_kpa"][0] for p in PRESSURES_PSI)
    assert np.log(high / low) == pytest.approx(0.4772, abs=1e-4)
    assert np.sqrt(low * high) == pytest.approx(np.sqrt(106.577 * 178.192), rel=1e-4)
    assert low < mid < high
    assert 12.0 < table["rut_depth_mm"].min() < table["rut_depth_mm"].max() < 45.0


def test_table_6(files: dict[str, Columns]) -> None:
    (n0, n1, ln_k), r_squared, rmse = log_regression(files["rut_depth"])
    assert round(n0, 3) == 1.996
    assert round(n1, 3) == 1.266
    assert f"{np.exp(ln_k):.3e}" == "3.306e+05"
    assert np.exp(ln_k) == pytest.approx(3.306e5, abs=10.0)
    assert round(r_squared, 3) == 0.630
    assert round(rmse, 3) == 0.159


def test_rut_extremes(files: dict[str, Columns]) -> None:
    table = files["rut_depth"]
    (n0, n1, ln_k), _, _ = log_regression(table)
    ln_p = np.log(table["average_ground_pressure_kpa"])
    predicted = 1000.0 * np.exp((ln_p - ln_k) / (n0 + n1 * table["slip_ratio"]))
    error = np.abs(predicted / table["rut_depth_mm"] - 1.0)
    held_out = table["inflation_pressure_psi"] == 30
    assert f"{100.0 * error[~held_out].max():.0f}" == "13"
    assert np.mean(error[~held_out] < 0.10) > 0.5
    assert f"{100.0 * error[held_out].max():.1f}" == "9.7"
    assert np.sum(error[held_out] > 0.06) == 2


def test_rut_grows_with_slip_and_pressure(files: dict[str, Columns]) -> None:
    table = files["rut_depth"]
    ruts = [at(table, psi)["rut_depth_mm"] for psi in PRESSURES_PSI]
    assert ruts[0].mean() < ruts[1].mean() < ruts[2].mean()
    for rut_mm in ruts:
        assert np.polyfit(np.arange(9), rut_mm, 1)[0] > 0.0
