"""Fixtures that the tests of figures and page share."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.data import Table, table_from_arrays
from calib.he2019.published import HE2019
from calib.inference.calibration import Calibration, calibrate
from calib.inference.problem import build_problem
from calib.report.figures.collect import plates
from calib.report.figures.style import Plate, style
from calib.report.reference import NOTHING
from calib.report.study import OutputResult
from tests.report.figures.results import build


@pytest.fixture(scope="session")
def drawbar(pull_calibration: Calibration, pull_tables: tuple[Table, Table]) -> OutputResult:
    return build(pull_calibration, pull_tables[1])


@pytest.fixture(scope="session")
def rut(rut_calibration: Calibration, rut_tables: tuple[Table, Table]) -> OutputResult:
    return build(rut_calibration, rut_tables[1])


@pytest.fixture(scope="session")
def density(density_calibration: Calibration) -> OutputResult:
    return build(density_calibration)


@pytest.fixture(scope="session")
def plate() -> OutputResult:
    """A user's own data: the Bekker model, no label, no held-out rows, no slip."""
    rng = np.random.default_rng(8)
    pressure = np.linspace(40.0, 250.0, 14)
    depth = 1000.0 * (pressure / 900.0) ** (1 / 1.1) * np.exp(0.08 * rng.standard_normal(14))
    table = table_from_arrays(
        {"average_ground_pressure_kpa": pressure, "rut_depth_mm": depth}, source="plate.csv"
    )
    return build(calibrate(build_problem("bekker", table), 1))


@pytest.fixture(scope="session")
def unconverged(rut: OutputResult) -> OutputResult:
    report = replace(
        rut.calibration.draws.report, passed=False, reasons=("R-hat of n0 is 1.3, 1.01 is needed",)
    )
    draws = replace(rut.calibration.draws, report=report)
    calibration = Calibration(rut.calibration.problem, draws, 1, "rut")
    return replace(rut, calibration=calibration)


@pytest.fixture(scope="session")
def all_plates(
    drawbar: OutputResult, density: OutputResult, rut: OutputResult, plate: OutputResult
) -> dict[str, list[Plate]]:
    """The figures of each output, laid out."""
    results = {"drawbar": drawbar, "density": density, "rut": rut, "plate": plate}
    found = {k: plates(r, NOTHING if k == "plate" else HE2019) for k, r in results.items()}
    with style():
        for p in (p for drawn in found.values() for p in drawn):
            assert p.figure is not None, p.caption
            p.figure.draw_without_rendering()
    return found
