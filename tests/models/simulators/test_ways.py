"""The ways a simulator is carried out: one contract, whatever goes wrong."""

from __future__ import annotations

import socket
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from calib.errors import CalibError
from calib.models.simulators.base import Failure, Output, Simulator, Way
from calib.models.simulators.files import read_simulator
from calib.models.simulators.registered import models_of
from calib.models.simulators.ways import CallableWay, CommandWay, UmbridgeWay
from tests.models.simulators.examples import pull, serving, write_program

X = {"slip_ratio": np.array([0.1, 0.3]), "normal_load_kn": np.array([4.0, 5.0])}
THETA = np.array([0.6, 0.08])
EXACT = pull(THETA[None], X)[0]


def simulator(way: Way, **changes: object) -> Simulator:
    given = {
        "name": "wheel", "way": way, "parameters": ("mu", "s0"), "priors": "",
        "conditions": {"s": "slip_percent", "w": "normal_load_kn"},
        "outputs": (Output("drawbar_pull_n", "pull", ""),), "retries": 0,
    } | changes  # fmt: skip
    return Simulator(**given)  # type: ignore[arg-type]


def in_percent(theta: np.ndarray, x: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    own = {"slip_ratio": x["s"] / 100.0, "normal_load_kn": x["w"]}
    return {"pull": 1000.0 * pull(theta, own)}


def failure(found: object) -> Failure:
    assert isinstance(found, Failure)
    return found


def test_a_callable_gives_canonical_units() -> None:
    found = simulator(CallableWay(in_percent, ("pull",))).run(THETA, X)
    assert not isinstance(found, Failure)
    np.testing.assert_allclose(found["drawbar_pull_kn"], EXACT)


def test_a_callable_of_one_vector() -> None:
    def one(theta: np.ndarray, x: dict[str, np.ndarray]) -> np.ndarray:
        return in_percent(theta[None], x)["pull"][0]

    found = simulator(CallableWay(one, ("pull",), batched=False)).run(THETA, X)
    assert not isinstance(found, Failure)
    np.testing.assert_allclose(found["drawbar_pull_kn"], EXACT)


@pytest.mark.parametrize(
    ("gives", "kind", "word"),
    [
        (lambda t, x: 1 / 0, "error", "ZeroDivisionError"),
        (lambda t, x: sys.exit(0), "error", "SystemExit: 0"),
        (lambda t, x: np.array([1.0, np.nan]), "nan", "1 of 2 rows, first in row 2"),
        (lambda t, x: np.array([1.0]), "short", "1 values for 2 rows"),
    ],
)
def test_a_run_without_value_says_why(gives: object, kind: str, word: str) -> None:
    found = failure(simulator(CallableWay(gives, ("pull",))).run(THETA, X))  # type: ignore[arg-type]
    assert found.kind == kind
    assert word in found.reason


@pytest.mark.parametrize("batched", [True, False])
def test_a_function_without_a_declared_output_is_named_at_once(batched: bool) -> None:
    def f(theta: np.ndarray, x: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        return {"pul": np.ones((len(theta), 2) if batched else 2)}

    one = simulator(CallableWay(f, ("pull",), batched=batched), emulate=False)
    (model,) = models_of(one)
    assert model.predict is not None
    for asked in (lambda: model.predict(THETA[None], X), lambda: one.run(THETA, X)):
        with pytest.raises(CalibError, match=r"no output 'pull'; it gave pul\n") as refused:
            asked()
        assert "test_ways.py, function" in str(refused.value.where)


def test_a_callable_with_a_limit_gives_the_same_from_a_process_of_its_own() -> None:
    found = simulator(CallableWay(in_percent, ("pull",), limit=60.0)).run(THETA, X)
    assert not isinstance(found, Failure)
    np.testing.assert_allclose(found["drawbar_pull_kn"], EXACT)


def hangs(theta: np.ndarray, x: dict[str, np.ndarray]) -> np.ndarray:
    import subprocess

    subprocess.run([sys.executable, "-c", "import time; time.sleep(60)"], check=True)
    return in_percent(theta, x)["pull"]


def raises(theta: np.ndarray, x: dict[str, np.ndarray]) -> np.ndarray:
    print("meshing")
    raise RuntimeError("the mesh folds")


def ends(theta: np.ndarray, x: dict[str, np.ndarray]) -> np.ndarray:
    import os

    os._exit(7)


@pytest.mark.parametrize(
    ("gives", "limit", "kind", "reason", "printed"),
    [
        (hangs, 1.0, "time", "it took longer than 1 s", ""),
        (raises, 60.0, "error", "RuntimeError: the mesh folds", "meshing"),
        (ends, 60.0, "exit", "exit code 7", ""),
    ],
)
def test_a_callable_that_hangs_or_dies_is_a_failed_run(
    gives: Callable, limit: float, kind: str, reason: str, printed: str
) -> None:
    found = failure(simulator(CallableWay(gives, ("pull",), limit=limit)).run(THETA, X))
    assert found.kind == kind
    assert reason in found.reason
    assert printed in found.printed


def test_what_cannot_be_handed_over_is_told() -> None:
    lock = threading.Lock()

    def locked(theta: np.ndarray, x: dict[str, np.ndarray]) -> np.ndarray:
        with lock:
            return in_percent(theta, x)["pull"]

    with pytest.raises(CalibError, match="cannot be handed to a process of its own"):
        simulator(CallableWay(locked, ("pull",), limit=60.0)).run(THETA, X)


def test_a_function_of_a_file_has_the_limit_that_the_file_gives(tmp_path: Path) -> None:
    """The module of the file has no name that another process could import."""
    (tmp_path / "own.py").write_text(
        "import numpy as np\nSCALE = 1000.0\ndef pull(theta, x):\n"
        "    return SCALE * x['w'] * theta[:, :1] * (1 - np.exp(-x['s'] / 100 / theta[:, 1:2]))\n"
    )
    file = write_program(tmp_path, run="", python='"own.py:pull"', limit="60")
    way = read_simulator(file).simulator.way
    assert isinstance(way, CallableWay)
    assert way.limit == 60.0
    found = simulator(way).run(THETA, X)
    assert not isinstance(found, Failure)
    np.testing.assert_allclose(found["drawbar_pull_kn"], EXACT)
    file = write_program(tmp_path, run="", python='"own.py:pull"')
    way = read_simulator(file).simulator.way
    assert isinstance(way, CallableWay)
    assert way.limit is None


def test_a_failed_run_is_tried_again() -> None:
    calls = []

    def now_and_then(theta: np.ndarray, x: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        calls.append(1)
        return in_percent(theta, x) if len(calls) > 2 else {"pull": np.full(2, np.nan)}

    way = CallableWay(now_and_then, ("pull",))
    assert isinstance(simulator(way, retries=1).run(THETA, X), Failure)
    assert not isinstance(simulator(way, retries=1).run(THETA, X), Failure)


def test_a_command_gives_what_the_function_gives(tmp_path: Path) -> None:
    found = read_simulator(write_program(tmp_path)).simulator.run(THETA, X)
    assert not isinstance(found, Failure)
    np.testing.assert_allclose(found["drawbar_pull_kn"], EXACT)
    # Its scratch folder was not the simulator's.
    assert {p.name for p in tmp_path.iterdir()} == {"wheel.py", "wheel.toml"}


@pytest.mark.parametrize(
    ("extra", "kind", "word"),
    [
        ("print('cannot mesh'); sys.exit(3)", "exit", "cannot mesh"),
        ("time.sleep(30)", "time", ""),
        ("sys.exit(0)", "unreadable", ""),
        ("x['s'].pop()", "short", ""),
        ("p['mu'] = float('nan')", "nan", ""),
    ],
)
def test_a_command_that_fails(tmp_path: Path, extra: str, kind: str, word: str) -> None:
    file = write_program(tmp_path, extra=extra, limit="1" if kind == "time" else "20", retries="0")
    found = failure(read_simulator(file).simulator.run(THETA, X))
    assert found.kind == kind
    assert word in found.printed


def test_a_command_without_a_declared_output_says_what_it_gave(tmp_path: Path) -> None:
    found = failure(
        simulator(
            read_simulator(write_program(tmp_path, extra="print('meshed')")).simulator.way,
            outputs=(Output("drawbar_pull_n", "Pull", ""),),
        ).run(THETA, X)
    )
    assert found == Failure("unreadable", "there is no output 'Pull'; it gave pull", "meshed\n")


def test_a_template_a_pattern_and_a_row_at_a_time(tmp_path: Path) -> None:
    (tmp_path / "own.inp").write_text("mu @mu@\ns0 @s0@\nslip @s@\nload @w@\n")
    (tmp_path / "own.py").write_text(
        "import math, sys\n"
        "v = {k: float(x) for k, x in (line.split() for line in open(sys.argv[1]))}\n"
        "f = 1000 * v['load'] * v['mu'] * (1 - math.exp(-v['slip'] / 100 / v['s0']))\n"
        "print(f'result: Fx={f!r} N')\n"
    )
    file = write_program(
        tmp_path, run=f'"{sys.executable} own.py {{input}}"', template='"own.inp"',
        output='"pattern"', rows='"each"',
    )  # fmt: skip
    file.write_text(file.read_text().replace(
        "[conditions]", "[patterns]\npull = 'Fx=(\\S+)'\n[conditions]"
    ))  # fmt: skip
    found = read_simulator(file).simulator.run(THETA, X)
    assert not isinstance(found, Failure)
    np.testing.assert_allclose(found["drawbar_pull_kn"], EXACT)


def test_what_a_command_is_made_of_is_its_identity(tmp_path: Path) -> None:
    file = write_program(tmp_path)
    before = read_simulator(file).simulator.digest
    assert read_simulator(file).simulator.digest == before
    program = tmp_path / "wheel.py"
    program.write_text(program.read_text() + "\n# another version\n")
    assert read_simulator(file).simulator.digest != before


def test_files_that_a_program_calls_are_of_its_identity_if_they_are_named(tmp_path: Path) -> None:
    file = write_program(tmp_path, files='["soil.csv"]')
    with pytest.raises(CalibError, match=r"file 'soil.csv' cannot be read"):
        read_simulator(file)
    soil = tmp_path / "soil.csv"
    soil.write_text("cohesion\n3.0\n")
    before = read_simulator(file).simulator.digest
    assert read_simulator(file).simulator.digest == before
    soil.write_text("cohesion\n4.0\n")
    assert read_simulator(file).simulator.digest != before


@pytest.fixture
def url() -> Iterator[str]:
    with serving() as found:
        yield found


@pytest.mark.parametrize(
    ("mood", "kind"), [("slow", "time"), ("nan", "nan"), ("error", "error"), ("broken", "error")]
)
def test_a_server_that_fails(url: str, mood: str, kind: str) -> None:
    way = UmbridgeWay(url, mood, ("pull",), limit=0.5)
    assert failure(simulator(way).run(THETA, X)).kind == kind


def test_a_server_that_is_not_there(url: str) -> None:
    way = UmbridgeWay("http://127.0.0.1:9", "forward", ("pull",), limit=2.0)
    with pytest.raises(CalibError, match="is not there"):
        simulator(way).run(THETA, X)
    well = simulator(UmbridgeWay(url, "forward", ("pull",))).run(THETA, X)
    assert not isinstance(well, Failure)
    np.testing.assert_allclose(well["drawbar_pull_kn"], [0.001, 0.001])


@pytest.mark.parametrize("reply", [b"", b"HTTP/1.0 200 OK\r\nContent-Length: 99\r\n\r\n{"])
def test_a_server_that_dies_on_the_way_has_no_run_that_failed(reply: bytes) -> None:
    """With no retry that would find it gone: a failed run would be kept, and not made again."""
    server = socket.create_server(("127.0.0.1", 0))
    port = server.getsockname()[1]

    def once() -> None:
        connection, _ = server.accept()
        server.close()
        connection.recv(65536)
        connection.sendall(reply)
        connection.close()

    thread = threading.Thread(target=once, daemon=True)
    thread.start()
    way = UmbridgeWay(f"http://127.0.0.1:{port}", "forward", ("pull",), limit=5.0)
    with pytest.raises(CalibError, match=f"127.0.0.1:{port} is not there"):
        simulator(way).run(THETA, X)
    thread.join()


@pytest.mark.parametrize(
    ("mood", "words"),
    [
        ("more", ("2 output vectors for pull", "'output': [[1.0], [1.0]]")),
        ("number", ("not of output vectors of numbers", "'output': [1.0]")),
    ],
)
def test_a_reply_that_will_not_do_is_shown(url: str, mood: str, words: tuple[str, str]) -> None:
    found = failure(simulator(UmbridgeWay(url, mood, ("pull",))).run(THETA, X))
    assert found.kind == "unreadable"
    assert words[0] in found.reason
    assert words[1] in found.printed


def test_a_program_beside_the_file_is_found(tmp_path: Path) -> None:
    (tmp_path / "wheel").write_text("#!/bin/sh\n")
    assert CommandWay(("./wheel",), tmp_path).program == str((tmp_path / "wheel").resolve())
    assert CommandWay(("./no-wheel",), tmp_path).program is None
