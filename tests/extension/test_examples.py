"""The example files are simulator files, and say what they say they do."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import numpy as np

from calib.models.simulators.base import Failure
from calib.models.simulators.files import read_simulator

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "chrono_scm"
# Stands for a program around Chrono: it reads the soil in the order of SetSoilParameters.
PROGRAM = """#!{python}
import sys
lines = [line.split() for line in open(sys.argv[1]) if not line.startswith("#")]
values = {{name: [float(v) for v in rest] for name, *rest in lines}}
assert [line[0] for line in lines][:6] == [
    "Bekker_Kphi", "Bekker_Kc", "Bekker_n", "Mohr_cohesion", "Mohr_friction", "Janosi_shear"
]
for slip, load in zip(values["slip"], values["load"]):
    print(f"Fx = {{load * slip * values['Mohr_friction'][0] / 30:.6f}} N")
"""


def test_chronos_parameters_have_its_order_and_units(tmp_path: Path) -> None:
    shutil.copytree(EXAMPLE, tmp_path / "scm")
    program = tmp_path / "scm" / "chrono_wheel"
    program.write_text(PROGRAM.format(python=sys.executable))
    program.chmod(0o755)
    simulator = read_simulator(tmp_path / "scm" / "scm.toml").simulator
    assert simulator.parameters == ("Kphi", "Kc", "n", "cohesion", "friction", "janosi")
    theta = np.array([2e6, 0.0, 1.1, 100.0, 30.0, 0.01])
    x = {"slip_ratio": np.array([0.1, 0.2]), "normal_load_kn": np.array([4.0, 5.0])}
    found = simulator.run(theta, x)
    assert not isinstance(found, Failure), found
    np.testing.assert_allclose(found["drawbar_pull_kn"], [0.4, 1.0])
