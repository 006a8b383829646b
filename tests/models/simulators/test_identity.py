"""What makes one simulator another: its files, what they import beside them, and its state."""

from __future__ import annotations

import functools
import json
import logging
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import calib
from calib.data.quantities import QUANTITIES
from calib.errors import CalibError
from calib.models import MODELS
from calib.models.simulators.declaration import SIMULATED
from calib.models.simulators.files import read_simulator
from calib.models.simulators.runner import CallableRunner
from calib.models.simulators.simulator import Failure, RunKeeper, Simulator
from tests.models.simulators.examples import PRIORS, THETA, X, simulator, write_program
from tests.registered import forgotten


@pytest.fixture(autouse=True)
def as_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Forget what a test registers and imports."""
    monkeypatch.setattr(sys, "path", sys.path[:])
    with forgotten(MODELS, SIMULATED, QUANTITIES):
        yield
    for name, module in list(sys.modules.items()):
        if str(getattr(module, "__file__", "")).startswith(str(tmp_path)):
            del sys.modules[name]


def closure(scale: object) -> Callable:
    return lambda t, x: {"pull": t[:, :1] * np.asarray(scale).sum() * x["w"]}


def default(scale: object) -> Callable:
    def f(t: np.ndarray, x: dict, scale: object = scale) -> np.ndarray:
        return t[:, :1] * np.asarray(scale).sum() * x["w"]

    return f


class Wheel:
    """Its state is what it is made with."""

    def __init__(self, scale: object) -> None:
        self.scale = scale
        self.soils = {"sand", "loam", "clay"}

    def __call__(self, t: np.ndarray, x: dict) -> np.ndarray:
        return t[:, :1] * np.asarray(self.scale).sum() * x["w"]

    def run(self, t: np.ndarray, x: dict) -> np.ndarray:
        return self(t, x)


class Rated(Wheel):
    """Its state is that of its class."""

    def __init__(self) -> None:
        pass


def rated(scale: object) -> Rated:
    Rated.scale = scale  # type: ignore[misc]
    return Rated()


def in_a_cell(scale: object) -> Callable:
    """Return a function that is in no file, of a name that the same notebook has."""
    cell = (
        "def helper(t):\n    return t * SCALE['sum']\ndef f(t, x):\n    return helper(t) * x['w']\n"
    )
    names: dict[str, object] = {"SCALE": {"sum": np.asarray(scale).sum()}, "__name__": "__main__"}
    exec(compile(cell, "<cell>", "exec"), names)
    return names["f"]  # type: ignore[return-value]


MAKERS = {
    "closure": closure,
    "default": default,
    "instance": Wheel,
    "class": rated,
    "method": lambda scale: Wheel(scale).run,
    "partial": lambda scale: functools.partial(Wheel.__call__, Wheel(scale)),
    "keyword": lambda scale: functools.partial(default(0.0), scale=scale),
    "wrapped": lambda scale: functools.lru_cache(closure(scale)),
    "held": lambda scale: closure_over(closure(scale)),
    "cell": in_a_cell,
}


def closure_over(f: Callable) -> Callable:
    return lambda t, x: f(t, x)


def made(f: Callable, folder: Path) -> tuple[float, int]:
    """Return a pull from runs that are kept in a folder, and how many runs were made for it."""
    keeper = RunKeeper(simulator(CallableRunner(f, ("pull",))), folder)
    (run,) = keeper.runs(THETA[None], X)
    return float(run.outputs["drawbar_pull_kn"][0]), keeper.made


@pytest.mark.parametrize("maker", MAKERS)
def test_functions_of_one_source_and_other_values_share_no_runs(tmp_path: Path, maker: str) -> None:
    exact = 0.6 * 4.0 / 1000.0
    if maker == "wrapped":
        one, other, again = (simulator(CallableRunner(MAKERS[maker](s), ("pull",))).digest
                             for s in (1.0, 2.0, 1.0))  # fmt: skip
        assert one == again != other
        return
    for scale, count in ((1.0, 1), (np.array([1.5, 1.5]), 1), (1.0, 0)):
        found, new = made(MAKERS[maker](scale), tmp_path)
        assert found == pytest.approx(exact * np.sum(scale))
        assert new == count


def test_what_a_function_is_does_not_depend_on_the_process(tmp_path: Path) -> None:
    text = (
        "import sys\nfrom calib.models.simulators.runner import CallableRunner\n"
        "from tests.models.simulators.test_identity import MAKERS\n"
        "for maker in MAKERS.values():\n"
        "    print(CallableRunner(maker(2.0), ('pull',)).identity)\n"
    )
    told = {
        subprocess.run(
            [sys.executable, "-c", text], check=True, capture_output=True, text=True,
            env={"PYTHONHASHSEED": seed, "PYTHONPATH": str(Path(__file__).parents[3])},
        ).stdout
        for seed in ("1", "2")
    }  # fmt: skip
    assert len(told) == 1
    assert len(set(told.pop().splitlines())) == len(MAKERS)


def test_what_others_change_of_an_object_makes_another_of_it(tmp_path: Path) -> None:
    """Not what it counts itself."""
    wheel, calls = Wheel(1.0), []

    def counting(t: np.ndarray, x: dict) -> np.ndarray:
        calls.append(1)
        return wheel(t, x)

    keeper = RunKeeper(simulator(CallableRunner(counting, ("pull",))), tmp_path)
    for scale, made in ((1.0, 1), (1.0, 1), (2.0, 2)):
        wheel.scale = scale
        (run,) = keeper.runs(THETA[None], X)
        assert keeper.made == made
        np.testing.assert_allclose(
            run.outputs["drawbar_pull_kn"], scale * 0.6 * X["normal_load_kn"] / 1e3
        )


def test_runs_of_what_cannot_be_told_are_not_shared_and_it_is_said(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    lock = threading.Lock()

    def locked(t: np.ndarray, x: dict) -> np.ndarray:
        with lock:
            return t[:, :1] * x["w"]

    with caplog.at_level(logging.WARNING):
        assert [made(locked, tmp_path)[1] for _ in range(2)] == [1, 1]
    assert "simulator wheel: " in caplog.text
    assert "cannot pickle '_thread.lock' object" in caplog.text


OWN = {
    "own.py": "import soils\nfrom inner.more import less\nSCALE = 2.0\n"
    "def helper(t):\n    return t * SCALE\n"
    "def pull(t, x):\n    return helper(t[:, :1]) * soils.FACTOR * less() * x['w']\n",
    "soils.py": "import deep\nFACTOR = 2.0 * deep.DEPTH\n",
    "deep.py": "DEPTH = 2.0\n",
    "inner/__init__.py": "",
    "inner/more.py": "from .less import less\n",
    "inner/less.py": "def less():\n    return 2.0\n",
}


def write_own(folder: Path) -> None:
    (folder / "inner").mkdir()
    for name, text in OWN.items():
        (folder / name).write_text(text)


def pull_of(one: Simulator) -> float:
    found = one.run(np.array([1.0, 0.1]), {"slip_ratio": np.ones(1), "normal_load_kn": np.ones(1)})
    assert not isinstance(found, Failure), found
    return float(found["drawbar_pull_kn"][0])


@pytest.mark.parametrize(
    ("name", "limit"), [("own.py", ""), ("soils.py", ""), ("deep.py", "60"), ("inner/less.py", "")]
)
def test_a_constant_or_helper_that_changes_makes_another_function(
    tmp_path: Path, name: str, limit: str
) -> None:
    """In the process too in which the one before was loaded."""
    write_own(tmp_path)
    file = write_program(tmp_path, run="", python='"own.py:pull"', limit=limit)
    before = read_simulator(file).simulator
    assert read_simulator(file).simulator.digest == before.digest
    assert pull_of(before) == pytest.approx(0.016)
    changed = OWN[name].replace("2.0", "3.0")
    assert changed != OWN[name]
    (tmp_path / name).write_text(changed)
    after = read_simulator(file).simulator
    assert after.digest != before.digest
    assert pull_of(after) == pytest.approx(0.024)
    (tmp_path / name).write_text(OWN[name])
    assert read_simulator(file).simulator.digest == before.digest


def test_modules_beside_a_script_are_of_the_program(tmp_path: Path) -> None:
    write_own(tmp_path)
    file = write_program(tmp_path, extra="import own")
    digests = [read_simulator(file).simulator.digest]
    for name in ("soils.py", "deep.py", "inner/less.py"):
        (tmp_path / name).write_text(OWN[name].replace("2.0", "3.0"))
        digests.append(read_simulator(file).simulator.digest)
    assert len(set(digests)) == 4
    (tmp_path / "not_imported.py").write_text("x = 1\n")
    assert read_simulator(file).simulator.digest == digests[-1]


@pytest.mark.parametrize(
    "text",
    [
        '#!/bin/sh\nexec python "$CALIB_SIMULATOR/inner/solve.py" "$1"\n',
        "#!/usr/bin/env python3\nimport subprocess\nsubprocess.run(['./solver', '-q'])\n",
    ],
)
def test_programs_that_a_script_names_are_of_it(tmp_path: Path, text: str) -> None:
    (tmp_path / "inner").mkdir()
    for name in ("solver", "inner/solve.py", "start"):
        (tmp_path / name).write_text(text if name == "start" else "1\n")
        (tmp_path / name).chmod(0o755)
    file = write_program(tmp_path, run='"./start {input} {output}"')
    before = read_simulator(file).simulator.digest
    for name in ("solver", "inner/solve.py"):
        (tmp_path / name).write_text("2\n")
    after = read_simulator(file).simulator.digest
    assert after != before
    # What it leaves beside itself is not it.
    (tmp_path / "out.csv").write_text("pull\n1\n")
    assert read_simulator(file).simulator.digest == after


def test_a_run_on_disk_says_what_it_is_of(tmp_path: Path) -> None:
    made(closure(1.0), tmp_path)
    (path,) = tmp_path.rglob("*-0.json")
    kept = json.loads(path.read_text())
    assert kept["simulator"] == "wheel"
    assert kept["parameters"] == {"mu": 0.6, "s0": 0.08}
    assert kept["conditions"] == {"slip_ratio": [0.1, 0.3], "normal_load_kn": [4.0, 5.0]}
    np.testing.assert_allclose(kept["outputs"]["drawbar_pull_kn"], [0.0024, 0.003])


def cell(text: str, **names: object) -> None:
    exec(compile(text, "<cell>", "exec"), {"calib": calib, "__name__": "__main__"} | names)


SIMULATOR = """
def wheel(t, x):
    return 1.0 * t[:, :1] * x["normal_load_kn"]
calib.register(calib.from_callable(
    wheel, parameters=PRIORS, output="drawbar_pull_kn", conditions=["slip_ratio", "normal_load_kn"],
))
"""
MODEL = """
calib.register(calib.Quantity(
    "hub_torque", "hub_torque_knm", "torque", "kN*m", "output", "torque of the hub",
))
def wheel(t, x):
    return 1.0 * t[:, :1] * x["normal_load_kn"]
calib.register(calib.Model(
    name="wheel", title="", output="hub_torque_knm", conditions=("normal_load_kn",),
    parameters=("mu", "s0"), predict=wheel, priors=PRIORS.replace('"kN"', '"kN*m"'),
))
"""


@pytest.mark.parametrize("text", [SIMULATOR, MODEL])
def test_a_cell_of_a_notebook_may_be_run_again_and_changed(
    monkeypatch: pytest.MonkeyPatch, text: str
) -> None:
    monkeypatch.delattr(sys.modules["__main__"], "__file__", raising=False)
    cell(text, PRIORS=PRIORS)
    first = MODELS["wheel"]
    theta, x = np.ones((1, 2)), {"slip_ratio": np.ones(1), "normal_load_kn": np.ones(1)}
    cell(text, PRIORS=PRIORS)
    assert first.predict is not None
    for changed, value in ((text.replace("1.0", "3.0"), 3.0), (text, 1.0)):
        cell(changed, PRIORS=PRIORS)
        assert MODELS["wheel"].predict(theta, x) == value  # type: ignore[misc]
    cell(text, PRIORS=PRIORS.replace("median = 0.5", "median = 0.7"))
    assert "0.7" in MODELS["wheel"].priors
    with pytest.raises(CalibError, match="there is a model 'bekker' already"):
        calib.register(replace(first, name="bekker"))


def test_in_a_script_the_same_is_registered_twice_and_another_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sys.modules["__main__"], "__file__", __file__, raising=False)

    def register(scale: float) -> None:
        calib.register(calib.from_callable(
            default(scale), parameters=PRIORS, output="drawbar_pull_kn", name="wheel",
            conditions={"w": "normal_load_kn"},
        ))  # fmt: skip

    register(1.0)
    first = MODELS["wheel"]
    register(1.0)
    assert MODELS["wheel"] is first
    with pytest.raises(CalibError, match=r"'wheel' already(.|\n)*start Python again"):
        register(2.0)
    assert MODELS["wheel"] is first
