"""Functional mock-up units: against the same formula in Python, and what is wrong with them."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import calib
from calib.data.quantities import QUANTITIES, Quantity
from calib.errors import CalibError
from calib.models import MODELS
from calib.models.simulators.declaration import SIMULATED, Simulated
from calib.models.simulators.files import read_simulator
from calib.models.simulators.simulator import Failure
from tests.models.simulators.examples import PRIORS, lab, pull
from tests.registered import forgotten

fmpy = pytest.importorskip("fmpy", reason="needs FMPy: pip install 'terracalib[fmu]'")
if shutil.which("gcc") is None:
    pytest.skip("needs gcc, to compile an FMU", allow_module_level=True)

FILE = """
name = "wheel"
fmu = "wheel.fmu"
retries = 0
{more}
[variables]
s0 = "tyre.s0"
[conditions]
slip = "slip_ratio"
load = "normal_load_kn"
[outputs]
pull = "drawbar_pull_n"
"""
RUT = """
name = "rut"
fmu = "wheel.fmu"
along = "time"
[conditions]
load = "normal_load_kn"
time = "time_s"
[outputs]
rut = {column = "rut_depth_mm", response = "identity"}
[experiment]
output_interval = 0.01
[parameters]
z0 = {dist = "half_normal", sd = 9.0, unit = "mm", reason = "soils", source = "ours"}
tau = {dist = "half_normal", sd = 9.0, unit = "s", reason = "soils", source = "ours"}
sigma = {dist = "half_normal", sd = 2.0, unit = "mm", reason = "soils", source = "ours"}
"""


@pytest.fixture(autouse=True)
def as_before() -> Iterator[None]:
    with forgotten(MODELS, SIMULATED, QUANTITIES):
        yield


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from tests.models.simulators.wheel_fmu import build

    return build(tmp_path_factory.mktemp("fmu"))


def declared(built: Path, folder: Path, text: str = FILE + PRIORS, more: str = "") -> Simulated:
    shutil.copy(built, folder / "wheel.fmu")
    (folder / "wheel.toml").write_text(text.replace("{more}", more))
    return read_simulator(folder / "wheel.toml")


@pytest.mark.slow
def test_the_posterior_is_that_of_the_formula(built: Path, tmp_path: Path) -> None:
    data = calib.table_from_arrays(lab(np.random.default_rng(1)))
    calib.register(declared(built, tmp_path))
    emulation = calib.emulated(calib.build_problem("wheel", data), seed=1)
    assert emulation.passed, emulation.reasons
    calib.register(
        calib.from_callable(
            pull, name="formula", parameters=PRIORS, output="drawbar_pull_kn",
            conditions=["slip_ratio", "normal_load_kn"],
        )
    )  # fmt: skip
    exact = calib.calibrate(calib.build_problem("formula", data), seed=1)
    found = calib.calibrate(emulation.problem, seed=1)
    assert found.converged
    assert exact.converged
    for name, s in exact.summary.items():
        e = found.summary[name]
        # The emulator's error, which is a tenth of the noise, and Monte Carlo errors.
        assert abs(e.mean - s.mean) < 0.05 * s.sd + 3.0 * np.hypot(e.mcse_mean, s.mcse_mean), name
        assert abs(e.sd / s.sd - 1.0) < 0.1, name


def test_more_rows_than_an_instance_bears(built: Path, tmp_path: Path) -> None:
    n = 1200  # it fails after a thousand instances in one process
    x = {"slip_ratio": np.linspace(0.05, 0.5, n), "normal_load_kn": np.linspace(3.0, 6.0, n)}
    theta = np.array([0.6, 0.08])
    found = declared(built, tmp_path).simulator.run(theta, x)
    assert not isinstance(found, Failure), found
    np.testing.assert_allclose(found["drawbar_pull_kn"], pull(theta[None], x)[0], rtol=1e-12)


@pytest.mark.parametrize(("mu", "kind"), [(7.0, "time"), (8.0, "error")])
def test_a_run_without_value(built: Path, tmp_path: Path, mu: float, kind: str) -> None:
    simulator = declared(built, tmp_path, more="limit = 4").simulator
    x = {"slip_ratio": np.array([0.1]), "normal_load_kn": np.array([4.0])}
    found = simulator.run(np.array([mu, 0.08]), x)
    assert isinstance(found, Failure)
    assert found.kind == kind
    assert {"time": "4 s", "error": "ended at the time 0, before 2"}[kind] in found.reason


@pytest.mark.parametrize("step", [0.01, 0.5])  # asked for, and by default the FMU's
def test_series_at_steps_of_its_own(built: Path, tmp_path: Path, step: float) -> None:
    calib.register(
        Quantity("time", "time_s", "time", "s", "condition", "since the start",
                 suffixes={"s": "s"})
    )  # fmt: skip
    text = RUT if step < 0.5 else RUT.replace("[experiment]\noutput_interval = 0.01\n", "")
    simulator = declared(built, tmp_path, text).simulator
    time, load = np.tile([0.333, 1.0, 3.777], 2), np.repeat([3.0, 5.0], 3)
    found = simulator.run(np.array([4.0, 2.5]), {"normal_load_kn": load, "time_s": time})
    assert not isinstance(found, Failure), found
    steps = np.arange(0.0, 4.001, step)
    exact = 4.0 * load * np.interp(time, steps, 1.0 - np.exp(-steps / 2.5))
    np.testing.assert_allclose(found["rut_depth_mm"], exact, rtol=1e-9)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("mu]", "mue]", ["mue is no real number", "mu, tyre.s0"]),
        ('"tyre.s0"', '"tyre.s1"', ["s0 is no real number"]),
        ('s0 = "t', 's1 = "t', ["s0 is no real number"]),
        ("slip = ", "skid = ", ["skid is no real number"]),
        ("pull = ", "pull_ = ", ["pull_ is no real number"]),
        ("drawbar_pull_n", "drawbar_pull_kn", ["pull is in N, not in kN"]),
        ('"normal_load_kn"', '"normal_load_n"', ["load is in kN, not in N"]),
        ('fmu = "wheel.fmu"', 'fmu = "wheel.toml"', ["the FMU cannot be read", "not a zip file"]),
        ('fmu = "wheel.fmu"', 'fmu = "other.fmu"', ["the FMU cannot be read"]),
        ("[conditions]", "[experiment]\nstop = 3\n[conditions]", ["experiment.stop"]),
    ],
)
def test_what_is_wrong_is_named(
    built: Path, tmp_path: Path, old: str, new: str, words: list[str]
) -> None:
    with pytest.raises(CalibError) as error:
        declared(built, tmp_path, (FILE + PRIORS).replace(old, new))
    for word in ("wheel.toml", *words):
        assert word in str(error.value)


def test_an_fmu_without_an_end_is_asked_for_one(tmp_path: Path) -> None:
    from tests.models.simulators.wheel_fmu import build

    (tmp_path / "made").mkdir()
    endless = build(tmp_path / "made", ends=False)
    with pytest.raises(CalibError, match="does not say when it ends"):
        declared(endless, tmp_path)
    declared(endless, tmp_path, more="[experiment]\nstop_time = 3")


def test_an_fmu_for_another_system(
    built: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fmpy, "platform", "win64")
    with pytest.raises(CalibError, match=r"it is for .*linux"):
        declared(built, tmp_path)


def test_without_the_package(built: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "fmpy", None)
    with pytest.raises(CalibError, match=r"terracalib\[fmu\]"):
        declared(built, tmp_path)


def test_runs_are_kept_by_what_the_fmu_is_and_how_it_is_simulated(
    built: Path, tmp_path: Path
) -> None:
    first = declared(built, tmp_path).simulator.digest
    assert declared(built, tmp_path, more="limit = 9").simulator.digest == first
    finer = declared(built, tmp_path, more="[experiment]\nstop_time = 3").simulator.digest
    assert finer != first
