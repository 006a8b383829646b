"""Physics engines that users have, built outside the repository.

`CALIB_CHRONO_WHEEL` is the path of the rig that `examples/chrono_scm/README.md` builds, and
`CALIB_MPM_SIMULATOR` the folder of chhsiao93/mpm_simulator. `CALIB_TAICHI_PYTHON` is a Python that
has taichi, by default the one that runs the tests. Where they are not there the tests are skipped.
"""

from __future__ import annotations

import importlib.util
import os
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import arviz as az
import numpy as np
import pytest

from tests.commands import Calib

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
WHEEL = os.environ.get("CALIB_CHRONO_WHEEL", "")
SAND = os.environ.get("CALIB_MPM_SIMULATOR", "")
TAICHI = os.environ.get("CALIB_TAICHI_PYTHON", "")
needs_wheel = pytest.mark.skipif(
    not WHEEL, reason="CALIB_CHRONO_WHEEL does not name the rig of examples/chrono_scm"
)
needs_sand = pytest.mark.skipif(
    not SAND or not (TAICHI or importlib.util.find_spec("taichi")),
    reason="CALIB_MPM_SIMULATOR does not name the solver, or there is no taichi",
)


@pytest.mark.slow
@needs_wheel
def test_chronos_wheel_has_the_forces_of_its_soil(tmp_path: Path) -> None:
    (tmp_path / "rows.csv").write_text(
        "Kphi,Kc,n,cohesion,friction,janosi,slip,load,mesh_mm\n"
        "9e5,0,0.9,1500,30,0.012,0.3,900,20\n"
        "9e5,0,0.9,1500,30,0.012,0.3,900,40\n"
        "9e5,0,0.9,1500,30,0.012,0.3,1500,20\n"
    )

    def rig(*settings: str) -> np.ndarray:
        said = subprocess.run(
            [WHEEL, "rows.csv", "time_step_ms=4", "travel=0.3", *settings],
            cwd=tmp_path, check=True, capture_output=True, text=True,
        ).stdout  # fmt: skip
        return np.array([row.split(",") for row in said.split()[1:]], float)

    (pull, torque, sinkage), coarse, heavy = rig()
    assert 0 < pull < torque / 0.25  # the rest of the thrust overcomes the soil's resistance
    assert heavy[0] > pull
    assert heavy[2] > sinkage
    np.testing.assert_allclose(coarse[2], sinkage, rtol=0.06)
    assert coarse[2] > sinkage
    np.testing.assert_allclose(rig("domain=0"), rig(), rtol=1e-9)  # Chrono's default covers it
    assert rig("domain=0.4")[2, 0] < 0.95 * heavy[0]  # one that ends within the contact does not


@pytest.mark.slow
@needs_wheel
def test_the_soil_of_chronos_wheel_is_found(tmp_path: Path, calib: Calib) -> None:
    """Some four minutes: 120 runs of the rig, 36 rows each."""
    shutil.copy(EXAMPLES / "chrono_scm" / "scm.toml", tmp_path)
    (tmp_path / "chrono_wheel").symlink_to(WHEEL)
    cases = runpy.run_path(str(EXAMPLES / "chrono_scm" / "cases.py"))
    cases["main"](tmp_path / "cases", WHEEL, ("null",))
    models = ("chrono_scm_drawbar_pull", "chrono_scm_rut_depth")
    both = [word for model in models for word in ("--model", model)]
    lab = "cases/null/lab.csv"
    ran = calib("joint", lab, *both, "--simulator", "scm.toml", "--out", "joint", "--seed", 1)
    assert ran.code == 0, ran
    draws = az.from_netcdf(tmp_path / "joint" / "posterior.nc").posterior
    for name, true in cases["SOIL"].items():
        if name != "Kc":  # fixed
            values = draws[name].to_numpy()
            assert abs(values.mean() - true) < 4 * values.std(), name


@pytest.mark.slow
@needs_sand
def test_sand_gives_way_to_a_faster_block_and_scatters(tmp_path: Path) -> None:
    (tmp_path / "rows.csv").write_text(
        "friction,E,speed,load\n38,1e6,1,100\n38,1e6,3,100\n38,1e6,3,200\n25,1e6,3,200\n"
    )

    def sand(*settings: str) -> np.ndarray:
        program = str(EXAMPLES / "mpm_sand" / "sand.py")
        subprocess.run(
            [TAICHI or sys.executable, program, "rows.csv", "out.csv", *settings],
            cwd=tmp_path, check=True, env={**os.environ, "MPM_SIMULATOR": SAND},
        )  # fmt: skip
        return np.array((tmp_path / "out.csv").read_text().split()[1:], float)

    once = sand("seed=1")
    assert (np.diff(once) > 0).all()
    np.testing.assert_allclose(sand("seed=1"), once, rtol=0.02)
    other = sand("seed=2")
    assert (other != once).all()
    np.testing.assert_allclose(other, once, rtol=0.4)
