"""What is derived, what is suggested, and mappings that are refused."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calib.data.quantities import QUANTITIES
from calib.errors import CalibError
from calib.imports import read_log, suggest_mapping
from calib.imports.mapping import kappa, pressure, shear_stress, slip, slip_of_kappa
from calib.imports.tables import _NAMES
from tests.imports.files import TTC, write


@given(speed=st.floats(0.01, 30.0), wheel_speed=st.floats(0.1, 100.0), radius=st.floats(0.05, 2.0))
def test_both_slips_say_the_same(speed: float, wheel_speed: float, radius: float) -> None:
    of = (np.array([speed]), np.array([wheel_speed]), np.array([radius]))
    np.testing.assert_allclose(slip_of_kappa(kappa(*of)), slip(*of), rtol=1e-9, atol=1e-9)


def test_slip_has_the_values_of_its_definition() -> None:
    still, pure, twice = np.array([0.0]), np.array([2.0]), np.array([1.0])
    assert [slip(v, np.array([4.0]), np.array([0.5]))[0] for v in (still, pure, twice)] == [
        1,
        0,
        0.5,
    ]
    assert kappa(twice, np.array([4.0]), np.array([0.5]))[0] == 1.0


def test_stress_of_a_ring_is_that_of_its_area_at_its_radius() -> None:
    # T = τ A r for a thin ring of area A at radius r.
    thin = shear_stress(np.array([1.0]), np.array([0.1001]), np.array([0.0999]))[0]
    area = np.pi * (0.1001**2 - 0.0999**2)
    assert thin == pytest.approx(1.0 / (area * 0.1), rel=1e-5)
    disc = shear_stress(np.array([1.0]), np.array([0.1]))[0]
    assert disc == pytest.approx(3.0 / (2.0 * np.pi * 0.1**3))
    assert pressure(np.array([300.0]), np.array([0.015]))[0] == pytest.approx(20e3)


def test_derived_quantities_convert_the_units_of_their_inputs(tmp_path: Path) -> None:
    path = write(tmp_path / "a.csv", "F,M,rpm,v,K\n300,10,60,3.6,25\n")
    force, area = {"from": "F", "unit": "N"}, {"value": 150, "unit": "cm2"}
    torque = {"from": "M", "unit": "Nm"}
    ring = {"torque": torque, "radius": {"value": 10, "unit": "cm"}}
    speeds = {
        "speed": {"from": "v", "unit": "km/h"},
        "wheel_speed": {"from": "rpm", "unit": "1/min"},
        "radius": {"value": 0.25, "unit": "m"},
    }
    columns = {
        "average_ground_pressure_kpa": {
            "derive": "pressure", "inputs": {"force": force, "area": area}
        },
        "shear_stress_kpa": {"derive": "shear_stress", "inputs": ring},
        "slip_percent": {"derive": "slip", "inputs": speeds},
        "kappa": {"derive": "kappa", "inputs": speeds},
        "nominal_slip_ratio": {
            "derive": "slip_of_kappa", "inputs": {"kappa": {"from": "K", "unit": "%"}}
        },
    }  # fmt: skip
    found = read_log(path, {"columns": columns}).columns
    circle = 2.0 * np.pi * 0.25
    expected = [20.0, 10e-3 * 3.0 / (2.0 * np.pi * 0.1**3), 100.0 * (1.0 - 1.0 / circle)]
    expected += [circle - 1.0, 0.2]
    assert [float(v[0]) for v in found.values()] == pytest.approx(expected)


def test_the_channels_of_the_tyre_test_consortium_are_known(tmp_path: Path) -> None:
    text = suggest_mapping(write(tmp_path / "run7.dat", TTC))
    columns = tomllib.loads(text)["columns"]
    assert columns == {
        "speed_kph": {"from": "V", "unit": "kph"},
        "drawbar_pull_n": {"from": "FX", "unit": "N"},
        "normal_load_n": {"from": "FZ", "unit": "N", "factor": -1},
        "slip_ratio": {
            "derive": "slip_of_kappa",
            "inputs": {"kappa": {"from": "SR", "unit": "none"}},
        },
        "camber_angle_deg": {"from": "IA", "unit": "deg"},
        "inflation_pressure_kpa": {"from": "P", "unit": "kPa"},
        "tyre_temperature_c": {"from": "TSTC", "unit": "deg C"},
    }
    assert "# not used: ET" in text
    assert "or average_ground_pressure_kpa" in text
    log = read_log(tmp_path / "run7.dat", {"columns": columns})
    np.testing.assert_allclose(log.table["slip_ratio"], [0.05 / 1.05, 0.2])
    np.testing.assert_allclose(log.table["normal_load_kn"], [3.0, 3.01])


@pytest.mark.parametrize(
    ("head", "columns"),
    [
        ("slip_percent,drawbar_pull_n (checked)", {"slip_percent", "drawbar_pull_n (checked)"}),
        ("speed_m_s,Cone index [MPa]", {"speed_m_s", "cone_index_mpa"}),
        ("Longitudinal slip [%],DP [kN]", {"slip_percent", "drawbar_pull_kn"}),
        ("P [kW],T [s]", set()),  # power and time, not pressure and torque
        ("Fx_kN,Load cell Z / kN", {"drawbar_pull_kn", "normal_load_kn"}),
        ("z [mm],p [kPa]", {"rut_depth_mm", "inflation_pressure_kpa"}),
        ("Pull 1 [N],Pull 2 [N]", {"drawbar_pull_n"}),
    ],
)
def test_names_count_where_their_units_fit(tmp_path: Path, head: str, columns: set[str]) -> None:
    path = write(tmp_path / "a.csv", f"{head}\n0.5,1.5\n0.6,2.5\n")
    if columns:
        assert set(tomllib.loads(suggest_mapping(path))["columns"]) == columns
        return
    with pytest.raises(CalibError, match="no column is known by its name"):
        suggest_mapping(path)


def test_slip_is_suggested_from_speeds(tmp_path: Path) -> None:
    path = write(tmp_path / "a.csv", "v [m/s],n [rpm],re [cm]\n1,60,25\n")
    columns = tomllib.loads(suggest_mapping(path))["columns"]
    assert columns["slip_ratio"]["inputs"]["radius"] == {"from": "re [cm]", "unit": "cm"}
    without = write(tmp_path / "b.csv", "v [m/s],n [rpm]\n1,60\n")
    assert "write it, or delete this line" in suggest_mapping(without)


def test_what_the_file_does_not_say_is_not_made_up(tmp_path: Path) -> None:
    path = write(tmp_path / "a.csv", "slip,Fx\n0.1,1\n")
    text = suggest_mapping(path)
    assert "the file gives no unit: fill it in" in text
    with pytest.raises(CalibError, match="neither the mapping nor the file says the unit"):
        read_log(path, tomllib.loads(text))


def test_the_usual_names_are_of_quantities() -> None:
    for entry in _NAMES["columns"]:
        assert entry["column"] in QUANTITIES
        assert entry["source"]
        assert all(name == " ".join(name.lower().split()) for name in entry["names"])


@pytest.mark.parametrize(
    ("mapping", "words"),
    [
        ("[columns]\n", ["columns is empty"]),
        ("[columns]\na = {frm = 'x'}\n", ["unknown key frm", "did you mean from?"]),
        ("[columns]\na = {}\n", ["one of from, value and derive"]),
        ("[columns]\na = {from = 'x', value = 1}\n", ["one of from, value and derive"]),
        ("[columns]\na = {derive = 'pressure'}\n", ["takes the inputs force, area"]),
        ("[columns]\na = {derive = 'work'}\n", ["'pressure'"]),
        ("[columns]\na = {from = 'FX'}\n[bins]\nb = {width = 1}\n", ["bins are along b"]),
        ("[columns]\na = {from = 'FX'}\n[bins]\na = {}\n", ["one of width and count"]),
        ("[columns]\na = {from = 'FX'}\n[thin]\nevery = 0\n", ["every"]),
        ("[columns]\na = {from = 'FX'}\n[crop]\na = [1]\n", ["crop"]),
        ("[columns]\na = {from = 'FY'}\n", ["no column 'FY'", "ET, V, FX"]),
        ("[columns]\ndrawbar_pull = {from = 'FX'}\n", ["does not say the unit"]),
        ("[columns]\ndrawbar_pull_n = {from = 'FX', unit = 'kPa'}\n", ["cannot convert", "kn, n"]),
        ("[columns]\na = {from = ['FX', 'FZ', 'V']}\nb = {from = ['P', 'IA']}\n", ["side by side"]),
        ("[columns]\na = {from = 'FX'}\n[crop]\nET = [5, 6]\n", ["no row is left of 2"]),
        ("[columns]\nrut_depth_mm = {from = 'FZ', unit = 'mm'}\n", ["line 4", "[crop]"]),
        ("[columns\n", ["not valid TOML"]),
    ],
)
def test_a_mapping_is_refused_with_its_place(
    tmp_path: Path, mapping: str, words: list[str]
) -> None:
    path, rules = write(tmp_path / "run7.dat", TTC), write(tmp_path / "m.toml", mapping)
    with pytest.raises(CalibError) as caught:
        read_log(path, rules)
    assert "hint:" in str(caught.value)
    assert str(tmp_path) in str(caught.value)
    for word in words:
        assert word in str(caught.value)


def test_a_cell_that_is_no_number_is_found(tmp_path: Path) -> None:
    path = write(tmp_path / "a.csv", "Slip,FX [N]\n5,1\n6,2\n7,broken\n")
    with pytest.raises(CalibError) as caught:
        read_log(path, {"columns": {"drawbar_pull_n": {"from": "FX [N]"}}})
    assert "a.csv, line 4, column 'FX [N]': 'broken' is not a number" in str(caught.value)
