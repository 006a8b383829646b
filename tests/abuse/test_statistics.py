"""Rows that are not as the likelihood has them: an honest width and a warning, or a refusal."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from calib.data import table_from_arrays
from calib.data.checks import column_notes
from calib.errors import CalibError
from calib.inference.calibration import Calibration, calibrate
from calib.inference.estimators import estimate
from calib.inference.prior_files import default_priors
from calib.inference.problem import build_problem
from calib.report.verdict import verdict
from calib.validation.assumptions import file_remarks

MODEL = "modified_bekker"
TRUTH = {"z_ref": 20.0, "n0": 1.0, "n1": 1.0}
N = 48


@dataclass(frozen=True)
class Rows:
    """Ruts of a wheel at two ground pressures, in the order of a file."""

    slip: np.ndarray
    pressure: np.ndarray
    rut: np.ndarray

    @classmethod
    def made(cls, noise: np.ndarray | None = None, seed: int = 1) -> Rows:
        """Those of the true parameters, with a noise on the logarithm."""
        slip = np.tile(np.linspace(0.02, 0.6, N // 2), 2)
        pressure = np.repeat([90.0, 150.0], N // 2)
        if noise is None:
            noise = 0.05 * np.random.default_rng(seed).standard_normal(N)
        problem = build_problem(MODEL, _table(slip, pressure, np.linspace(10.0, 20.0, N)))
        theta = np.array([[TRUTH[name] for name in problem.bound.model.parameters]])
        return cls(
            slip, pressure, problem.bound.predict(theta, problem.conditions)[0] * np.exp(noise)
        )

    def take(self, rows: np.ndarray) -> Rows:
        return Rows(self.slip[rows], self.pressure[rows], self.rut[rows])

    def calibrated(self, likelihood: str = "", folder: Path | None = None) -> Calibration:
        path = None
        if folder is not None:
            path = folder / "priors.toml"
            path.write_text(default_priors(MODEL).read_text(encoding="utf-8") + likelihood)
        problem = build_problem(MODEL, _table(self.slip, self.pressure, self.rut), path)
        point = estimate(problem, "least_squares", np.random.default_rng(2))
        return calibrate(problem, 2, estimates=(point,))


def _table(slip: np.ndarray, pressure: np.ndarray, rut: np.ndarray):
    columns = {
        "slip_ratio": slip, "average_ground_pressure_kpa": pressure, "rut_depth_mm": rut,
        "run_order": np.arange(rut.size),
    }  # fmt: skip
    return table_from_arrays(columns, source="ruts.csv")


def warned(calibration: Calibration) -> str:
    return " | ".join(verdict(calibration).warnings)


def holds(calibration: Calibration) -> bool:
    """Whether every true parameter is inside its interval of four sds."""
    return all(
        abs(calibration.summary[name].mean - value) < 4.0 * calibration.summary[name].sd
        for name, value in TRUTH.items()
    )


@pytest.fixture(scope="module")
def clean() -> Calibration:
    return Rows.made().calibrated()


def test_good_rows_are_not_warned_of(clean: Calibration) -> None:
    assert holds(clean)
    assert warned(clean) == ""


def test_a_row_off_by_a_hundred_times(clean: Calibration) -> None:
    rows = Rows.made()
    rows.rut[17] *= 100.0
    found = rows.calibrated()
    # It widens everything, and is named.
    assert holds(found)
    assert found.summary["sigma"].median > 5.0 * clean.summary["sigma"].median
    assert f"line {found.problem.table.lines[17]}" in warned(found)
    assert "check the reading" in warned(found)


def test_psi_typed_as_kpa_in_some_rows() -> None:
    rows = Rows.made()
    rows.pressure[30:34] /= 6.894757
    found = rows.calibrated()
    lines = ", ".join(str(found.problem.table.lines[i]) for i in range(30, 34))
    assert f"lines {lines}: average ground pressure is 6.895 times smaller" in warned(found)


@pytest.mark.parametrize(("load", "factor", "told"), [
    (5.0, 1.0, ()), (5.0, 1e3, ("pull",)), (5.0, 1e-3, ("pull",)), (5e3, 1e-3, ("load",)),
    (0.06, 1.0, ()), (0.06, 1e3, ("load",)), (5e3, 1.0, ("pull", "load")), (None, 1e-3, ("pull",)),
])  # fmt: skip
def test_forces_of_which_one_is_in_another_unit(
    load: float | None, factor: float, told: tuple[str, ...]
) -> None:
    """A pull is a part of its load, which tells a small wheel from N that are typed as kN."""
    pull = factor * np.array([0.1, 0.2, 0.3]) * (5.0 if load is None else load)
    columns = {"slip_ratio": np.array([0.1, 0.2, 0.3]), "drawbar_pull_kn": pull}
    if load is not None:
        columns["normal_load_kn"] = np.full(3, load)
    said = " | ".join(column_notes(table_from_arrays(columns, source="pull.csv")))
    for word in ("pull", "load"):
        assert (f"the largest {'drawbar' if word == 'pull' else 'normal'} {word}" in said) == (
            word in told
        )


def test_duplicated_rows(clean: Calibration) -> None:
    twice = Rows.made().take(np.tile(np.arange(N), 2))
    found = twice.calibrated()
    # Too narrow, by the square root of two: the warning says so.
    assert found.summary["z_ref"].sd < 0.85 * clean.summary["z_ref"].sd
    assert "these 48 rows repeat another one exactly" in warned(found)
    assert "narrows every width" in warned(found)


def test_a_condition_that_does_not_vary(clean: Calibration) -> None:
    rows = Rows.made()
    same = Rows(np.full(N, 0.2), rows.pressure, rows.rut)
    found = same.calibrated()
    assert "slip is the same in all rows" in warned(found)
    # What only slip could tell is as wide as the prior.
    ratio = max(found.summary["n0"].sd_ratio, found.summary["n1"].sd_ratio)
    assert ratio > 0.5 > clean.summary["n0"].sd_ratio


@pytest.mark.parametrize(("model", "columns"), [
    ("magic_formula", {"slip_percent": [20.0], "drawbar_pull_kn": [1.0, 1.1, 0.9]}),
    ("bekker", {"average_ground_pressure_kpa": [90.0], "rut_depth_mm": [20.0, 21.0, 19.0]}),
    ("magic_formula_pressure", {"slip_percent": [20.0], "inflation_pressure_kpa": [200.0],
                                "drawbar_pull_kn": [1.0, 1.1, 0.9]}),
])  # fmt: skip
def test_rows_at_one_setting_are_one_measurement_whatever_the_model(
    model: str, columns: dict[str, list[float]]
) -> None:
    repeated = {name: np.resize(values, 30) for name, values in columns.items()}
    with pytest.raises(CalibError, match="all rows are at one setting of the conditions"):
        build_problem(model, table_from_arrays(repeated, source="one.csv"))


def test_fewer_settings_than_parameters_are_told() -> None:
    slip = np.tile([0.05, 0.2, 0.5], 10)
    pull = 1.5 * np.sin(10.0 * slip) + 0.03 * np.random.default_rng(3).standard_normal(30)
    columns = {"Slip (%)": 100.0 * slip, "drawbar_pull_kn": pull}
    problem = build_problem("magic_formula", table_from_arrays(columns, source="few.csv"))
    said = " | ".join(remark.text for remark in file_remarks(problem, 0.03))
    assert "the rows are at 3 different settings of the conditions" in said
    assert "about 6 parameters" in said


@pytest.mark.slow  # as of lines in validation/test_residuals.py
def test_heavy_tails(tmp_path: Path) -> None:
    noise = 0.03 * np.random.default_rng(4).standard_t(1.2, N)
    rows = Rows.made(noise)
    normal = rows.calibrated()
    assert holds(normal)
    assert "heavier tails" in warned(normal)
    student = rows.calibrated('\n[likelihood]\nfamily = "student_t"\n', tmp_path)
    assert holds(student)
    assert student.summary["z_ref"].sd < normal.summary["z_ref"].sd
    assert "tails" not in warned(student)


@pytest.mark.slow
def test_uneven_noise(tmp_path: Path) -> None:
    slip = Rows.made().slip
    noise = 0.01 * np.exp(5.0 * slip) * np.random.default_rng(5).standard_normal(N)
    rows = Rows.made(noise)
    assert "scatter grows with slip" in warned(rows.calibrated())
    found = rows.calibrated('\n[likelihood]\nnoise_depends_on = "slip"\n', tmp_path)
    assert holds(found)
    assert "scatter" not in warned(found)
    # ln sigma grows by 5 for a slip of one.
    slope = found.summary["sigma_slope"]
    assert abs(slope.mean - 5.0 * slip.std()) < 4.0 * slope.sd
