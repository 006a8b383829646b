"""Runners: one contract, whatever goes wrong; right numbers, or a run without a value."""

from __future__ import annotations

import os
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pint
import pytest

import calib
from calib.errors import CalibError
from calib.inference.emulation.prepared import read_runs
from calib.models.base import BoundModel
from calib.models.simulators.declaration import from_callable, models_of
from calib.models.simulators.files import read_simulator
from calib.models.simulators.process import run_program
from calib.models.simulators.runner import (
    CallableRunner,
    UmbridgeRunner,
    check_template,
    output_of_text,
)
from calib.models.simulators.simulator import Failure, checked
from tests.models.simulators.examples import (
    EXACT,
    PRIORS,
    THETA,
    X,
    in_percent,
    pull,
    serving,
    simulator,
    write_program,
)

UNITS = pint.UnitRegistry()


def failure(found: object) -> Failure:
    assert isinstance(found, Failure), found
    return found


def is_exact(found: object) -> None:
    assert not isinstance(found, Failure), found
    np.testing.assert_allclose(found["drawbar_pull_kn"], EXACT)  # type: ignore[index]


def python(code: str) -> list[str]:
    return [sys.executable, "-c", code]


def test_no_shell_reads_its_arguments_and_what_it_prints_comes_back(tmp_path: Path) -> None:
    code = python("import sys; print(sys.argv[1])")
    found = run_program([*code, "$(touch made); `touch made` > made"], tmp_path, 20.0)
    assert found == "$(touch made); `touch made` > made\n"
    assert not (tmp_path / "made").exists()
    long = run_program(python("print('x' * 9_000_000, 'done')"), tmp_path, 20.0, whole=False)
    assert isinstance(long, str)
    assert long.endswith("x done\n")
    assert len(long) < 5000
    with pytest.raises(CalibError, match="no-such-wheel cannot be started"):
        run_program(["no-such-wheel"], tmp_path, 1.0)


@pytest.mark.parametrize(
    ("code", "reason", "printed"),
    [
        ("import sys; print('x' * 9000, 'no soil'); sys.exit(4)", "exit code 4", "no soil\n"),
        ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", "SIGSEGV", ""),
        # What would steer a terminal is left out.
        ("import sys; sys.stdout.buffer.write(b'\\x1b[31mred\\x00\\xff\\n'); sys.exit(1)",
         "exit code 1", "\ufffd[31mred\ufffd\ufffd\n"),
    ],
)  # fmt: skip
def test_a_failure_has_its_reason_and_the_end_of_what_it_printed(
    tmp_path: Path, code: str, reason: str, printed: str
) -> None:
    found = failure(run_program(python(code), tmp_path, 20.0))
    assert found.kind == "exit"
    assert reason in found.reason
    assert found.printed.endswith(printed)
    assert len(found.printed) < 700


CHILD = (
    "import subprocess, sys, time\n"
    "child = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(60)'])\n"
    "open('pid', 'w').write(str(child.pid))\n"
)
LEFT = (
    "import os, time\n"
    "if os.fork() == 0:\n"
    "    os.setsid()\n"
    "    open('pid.part', 'w').write(str(os.getpid()))\n"
    "    os.rename('pid.part', 'pid')\n"
    "    time.sleep(60)\n"
    "while not os.path.exists('pid'): time.sleep(0.01)\n"
)


@pytest.mark.skipif(sys.platform == "win32", reason="process groups are POSIX's")
@pytest.mark.parametrize("ending", ["time.sleep(60)", "pass"])
@pytest.mark.parametrize("started", [CHILD, LEFT])
def test_what_it_started_ends_with_it(tmp_path: Path, started: str, ending: str) -> None:
    found = run_program(python(started + ending), tmp_path, 20.0 if ending == "pass" else 1.0)
    assert isinstance(found, Failure) is (ending != "pass")
    assert _ends(int((tmp_path / "pid").read_text()))


def _ends(pid: int) -> bool:
    """Whether a process is gone, or dead and not yet collected, within some seconds."""
    for _ in range(100):
        try:
            os.kill(pid, 0)
            state = Path(f"/proc/{pid}/stat")
            if state.exists() and state.read_text().rpartition(")")[2].split()[0] == "Z":
                return True
        except ProcessLookupError:
            return True
        time.sleep(0.05)
    return False


def test_what_the_kernel_cannot_end_is_not_waited_for_for_ever(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []
    stuck = SimpleNamespace(kill=lambda: asked.append(1))
    monkeypatch.setattr("calib.models.simulators.process._marked", lambda mark: [stuck])
    monkeypatch.setattr("calib.models.simulators.process.KILL_SECONDS", 0.2)
    assert run_program(python("print('done')"), tmp_path, 20.0) == "done\n"
    assert len(asked) > 1


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


def kilograms(t: np.ndarray, x: dict) -> object:
    return UNITS.Quantity(in_percent(t, x)["pull"] / 9.80665, "kgf")


def masked(t: np.ndarray, x: dict) -> object:
    return np.ma.array(in_percent(t, x)["pull"], mask=[[False, True]] * len(t))


def complex_(t: np.ndarray, x: dict) -> object:
    return in_percent(t, x)["pull"] + 1e-3j


def transposed(t: np.ndarray, x: dict) -> object:
    return in_percent(t, x)["pull"].T


def nothing(t: np.ndarray, x: dict) -> None:
    in_percent(t, x)


def table(t: np.ndarray, x: dict) -> object:
    import pandas

    return pandas.DataFrame({"pull": in_percent(t, x)["pull"][0], "step": [0, 1]})


@pytest.mark.parametrize(
    ("gives", "options"),
    [
        (in_percent, {}),
        (in_percent, {"limit": 60.0}),
        (lambda theta, x: in_percent(theta[None], x)["pull"][0], {"batched": False}),
        (kilograms, {"limit": 60.0}),
        (table, {}),
    ],
)
def test_a_function_gives_canonical_units(gives: Callable, options: dict) -> None:
    is_exact(simulator(CallableRunner(gives, ("pull",), **options)).run(THETA, X))


@pytest.mark.parametrize(
    ("gives", "limit", "kind", "word", "printed"),
    [
        (lambda t, x: 1 / 0, None, "error", "ZeroDivisionError", ""),
        (lambda t, x: sys.exit(0), None, "error", "SystemExit: 0", ""),
        (lambda t, x: np.array([1.0]), None, "short", "1 values for 2 rows", ""),
        (lambda t, x: np.ones((2, 2)), None, "short", "4 values for 2 rows", ""),
        (masked, None, "nan", "1 of 2 rows, first in row 2", ""),
        (complex_, None, "unreadable", "imaginary parts up to 0.001", ""),
        (hangs, 1.0, "time", "it took longer than 1 s", ""),
        (raises, 60.0, "error", "RuntimeError: the mesh folds", "meshing"),
        (ends, 60.0, "exit", "exit code 7", ""),
    ],
)
def test_a_run_without_value_says_why(
    gives: Callable, limit: float | None, kind: str, word: str, printed: str
) -> None:
    found = failure(simulator(CallableRunner(gives, ("pull",), limit=limit)).run(THETA, X))
    assert found.kind == kind
    assert word in found.reason
    assert printed in found.printed


def test_rows_in_the_shape_of_a_grid_are_in_no_known_order() -> None:
    x = {name: np.tile(values, 2) for name, values in X.items()}
    runner = CallableRunner(lambda t, c: in_percent(t, c)["pull"].reshape(2, 2), ("pull",))
    assert "shape (2, 2) for 4 rows" in failure(simulator(runner).run(THETA, x)).reason


@pytest.mark.parametrize("batched", [True, False])
def test_a_function_without_a_declared_output_is_named_at_once(batched: bool) -> None:
    def f(theta: np.ndarray, x: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        return {"pul": np.ones((len(theta), 2) if batched else 2)}

    one = simulator(CallableRunner(f, ("pull",), batched=batched), emulate=False)
    (model,) = models_of(one)
    assert model.predict is not None
    for asked in (lambda: model.predict(THETA[None], X), lambda: one.run(THETA, X)):
        with pytest.raises(CalibError, match=r"no output 'pull'; it gave pul\n") as refused:
            asked()
        assert "test_runner.py, function" in str(refused.value.where)


def test_what_cannot_be_handed_over_is_told() -> None:
    lock = threading.Lock()

    def locked(theta: np.ndarray, x: dict[str, np.ndarray]) -> np.ndarray:
        with lock:
            return in_percent(theta, x)["pull"]

    with pytest.raises(CalibError, match="cannot be handed to a process of its own"):
        simulator(CallableRunner(locked, ("pull",), limit=60.0)).run(THETA, X)


def test_a_function_of_a_file_has_the_limit_that_the_file_gives(tmp_path: Path) -> None:
    """The module of the file has no name that another process could import."""
    (tmp_path / "own.py").write_text(
        "import numpy as np\nSCALE = 1000.0\ndef pull(theta, x):\n"
        "    return SCALE * x['w'] * theta[:, :1] * (1 - np.exp(-x['s'] / 100 / theta[:, 1:2]))\n"
    )
    for given, limit in (("60", 60.0), ("", None)):
        file = write_program(tmp_path, run="", python='"own.py:pull"', limit=given)
        runner = read_simulator(file).simulator.runner
        assert isinstance(runner, CallableRunner)
        assert runner.limit == limit
        is_exact(simulator(runner).run(THETA, X))


# As many parameter vectors as rows: what is transposed has the right shape.
SOME = np.array([[0.6, 0.08], [0.5, 0.1], [0.7, 0.2]])


def quick(f: Callable) -> BoundModel:
    one = from_callable(
        f, parameters=PRIORS, conditions={"s": "slip_percent", "w": "normal_load_kn"},
        output={"pull": "drawbar_pull_n"}, name="quick",
    )  # fmt: skip
    return BoundModel(models_of(one.simulator)[0], {})


def plain(f: Callable) -> BoundModel:
    def own(t: np.ndarray, x: dict) -> object:
        x["slip_ratio"] *= 100.0
        found = f(t, {"s": x["slip_ratio"], "w": x["normal_load_kn"]})
        return found["pull"] / 1000.0 if isinstance(found, dict) else found

    return BoundModel(
        calib.Model(
            name="plain", title="", output="drawbar_pull_kn", parameters=("mu", "s0"),
            conditions=("slip_ratio", "normal_load_kn"), predict=own,
        ), {},
    )  # fmt: skip


@pytest.mark.parametrize("of", [quick, plain])
def test_a_model_that_is_asked_by_the_sampler_gives_the_same(of: Callable) -> None:
    np.testing.assert_allclose(of(kilograms).mean_response(SOME, X), pull(SOME, X))
    for unusable in (complex_, transposed, nothing):
        with pytest.raises(CalibError):
            of(unusable).mean_response(SOME, X)
    gaps = of(masked).mean_response(SOME, X)
    np.testing.assert_array_equal(np.isnan(gaps), [[False, True]] * 3)


CALLS: list[int] = []


def selfish(t: np.ndarray, x: dict) -> object:
    """Change what is handed over, and fail on every second call."""
    exact = in_percent(t, x)
    x["s"] *= 0.5
    x["w"] += 1.0
    t *= 2.0
    del x["s"]
    CALLS.append(1)
    return exact if len(CALLS) % 2 == 0 else {"pull": np.full(exact["pull"].shape, np.nan)}


@pytest.mark.parametrize("of", [quick, plain])
def test_a_function_that_changes_what_it_is_handed_changes_nothing_else(of: Callable) -> None:
    def f(t: np.ndarray, x: dict) -> object:
        CALLS[:] = [1]
        return selfish(t, x)

    theta, x = SOME.copy(), {name: values.copy() for name, values in X.items()}
    model = of(f)
    for _ in range(2):
        np.testing.assert_allclose(model.mean_response(theta, x), pull(SOME, X))
    own = {name: np.tile(values, (len(SOME), 1)) for name, values in x.items()}
    np.testing.assert_allclose(model.mean_response(theta, own), pull(SOME, X))
    np.testing.assert_array_equal(theta, SOME)
    for name, values in X.items():
        np.testing.assert_array_equal(x[name], values)
        np.testing.assert_array_equal(own[name], np.tile(values, (len(SOME), 1)))


def test_a_program_gives_what_the_function_gives_and_a_retry_finds_no_file_of_the_first(
    tmp_path: Path,
) -> None:
    extra = f"""
import os
if os.path.exists("half.txt"):
    p["mu"] = 99.0
open("half.txt", "w").close()
if not os.path.exists({str(tmp_path / "tried")!r}):
    open({str(tmp_path / "tried")!r}, "w").close(); sys.exit(3)
"""
    is_exact(read_simulator(write_program(tmp_path, extra=extra, retries="1")).simulator.run(
        THETA, X
    ))  # fmt: skip
    # Its scratch folder was not the simulator's.
    assert {p.name for p in tmp_path.iterdir()} == {"wheel.py", "wheel.toml", "tried"}


def printing(value: str) -> str:
    return f"json.dump({{{{'pull': {value}}}}}, open(sys.argv[2], 'w')); sys.exit()"


@pytest.mark.parametrize(
    ("extra", "kind", "word"),
    [
        ("print('cannot mesh'); sys.exit(3)", "exit", "cannot mesh"),
        ("time.sleep(30)", "time", "longer than 1 s"),
        ("sys.exit(0)", "unreadable", "left no readable output"),
        ("open(sys.argv[2], 'w').write('Segmentation fault'); sys.exit()", "unreadable", "json"),
        ("open(sys.argv[2], 'w').write('[1]'); sys.exit()", "unreadable", "not an object"),
        ("p['mu'] = float('nan')", "nan", "2 of 2 rows"),
        (printing("[True, False]"), "unreadable", "bool"),
        (printing("[[1.0], [2.0, 3.0]]"), "unreadable", "differ in length"),
        (printing("[1.0, None]"), "nan", "not finite in 1 of 2 rows, first in row 2"),
        (printing("[1.0, 2.0, 3.0]"), "short", "3 values for 2 rows"),
        (printing("{{'0': 1.0}}"), "unreadable", "no output 'pull'; it gave nothing"),
    ],
)
def test_a_program_that_fails(tmp_path: Path, extra: str, kind: str, word: str) -> None:
    extra = extra.replace("{{", "{").replace("}}", "}")
    limit = "1" if kind == "time" else "20"
    file = write_program(tmp_path, extra=extra, limit=limit, retries="0")
    found = failure(read_simulator(file).simulator.run(THETA, X))
    assert found.kind == kind
    assert word in found.reason + found.printed


@pytest.mark.parametrize(
    ("printed", "gives", "word"),
    [
        ("step,pull\n0,1500\n1,-2.5", "csv", None),
        ("step 1\nF=1500 N\nstep 2\nF=-2.5 N", "pattern", None),
        # A list without spaces is read number by number.
        ("F=1.5D3,F=-25e-1", "pattern", None),
        ("", "csv", "it is empty"),
        ('{"pull": [1, 2], "pull": [3, 4]}', "json", "'pull' is there twice"),
        ("pull,pull\n1,3\n2,4", "csv", "'pull' is there twice"),
        ("step,pull\n1,1,5\n2,2,5", "csv", "different numbers of cells"),
        ("pull\n1_5\n2.0", "csv", "'1_5' is no number"),
        ("F=1.5e+03 F=2.5e+03 ", "pattern", "the beginning of '1.5e+03'"),
        ("F=1,5 F=2,5 ", "pattern", "the beginning of '1,5'"),
    ],
)
def test_text_is_read_whole_or_refused(printed: str, gives: str, word: str | None) -> None:
    pattern = "F=([-0-9.]+)" if word else "F=([-0-9.De]+)"
    found = output_of_text(printed, gives, {"pull": pattern})
    values = found if isinstance(found, Failure) else checked(found, "pull", 2, "N")
    if word is not None:
        assert word in failure(values).reason
        return
    np.testing.assert_allclose(values, [1500.0, -2.5])


def test_a_row_that_gives_two_numbers_takes_no_others_place(tmp_path: Path) -> None:
    """Two rows with two and no numbers are two numbers, and of the wrong rows."""
    extra = (
        "json.dump({'pull': [1.0, 2.0] if x['s'][0] < 20 else []}, open(sys.argv[2], 'w'));"
        "sys.exit()"
    )
    file = write_program(tmp_path, rows='"each"', retries="0", extra=extra)
    assert "differ in length" in failure(read_simulator(file).simulator.run(THETA, X)).reason


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
    text = file.read_text()
    file.write_text(text.replace("[conditions]", "[patterns]\npull = 'Fx=(\\S+)'\n[conditions]"))
    is_exact(read_simulator(file).simulator.run(THETA, X))


def test_a_program_may_read_and_write_csv(tmp_path: Path) -> None:
    program = (
        "import csv, math, sys\n"
        "print('pull')\n"
        "for r in csv.DictReader(open(sys.argv[1])):\n"
        "    mu, s0, s, w = (float(r[name]) for name in ('mu', 's0', 's', 'w'))\n"
        "    print(1000 * w * mu * (1 - math.exp(-s / 100 / s0)))\n"
    )
    file = write_program(
        tmp_path, input='"csv"', output='"csv"', run=f'"{sys.executable} wheel.py {{input}}"'
    )
    (tmp_path / "wheel.py").write_text(program)
    is_exact(read_simulator(file).simulator.run(THETA, X))


@pytest.mark.parametrize(
    ("template", "word"),
    [("@mu@ @s@ @w@", "no place for n"), ("@mu@ @n@ @s@ @w@ @k@", "unknown @k@")],
)
def test_a_template_must_have_a_place_for_each(template: str, word: str) -> None:
    with pytest.raises(CalibError, match=rf"wheel.inp: .*{word}"):
        check_template(template, ("mu", "n", "s", "w"), "wheel.inp")


@pytest.fixture(scope="module")
def url() -> Iterator[str]:
    with serving() as found:
        yield found


@pytest.mark.parametrize(
    ("mood", "kind", "word"),
    [
        ("slow", "time", "longer than 0.5 s"),
        ("nan", "nan", "not finite"),
        ("error", "error", "no soil"),
        ("broken", "error", "answered 500"),
        ("more", "unreadable", "2 output vectors for pull"),
        ("number", "unreadable", "'output': [1.0]"),
        ("bool", "unreadable", "bool"),
        ("pair", "short", "4 values"),
    ],
)
def test_a_server_that_fails(url: str, mood: str, kind: str, word: str) -> None:
    limit = 0.5 if mood == "slow" else 20.0
    runner = UmbridgeRunner(url, mood, ("pull",), limit=limit)
    found = failure(simulator(runner).run(THETA, X))
    assert found.kind == kind
    assert word in found.reason + found.printed


def test_a_server_that_is_not_there(url: str) -> None:
    runner = UmbridgeRunner("http://127.0.0.1:9", "forward", ("pull",), limit=2.0)
    with pytest.raises(CalibError, match="is not there"):
        simulator(runner).run(THETA, X)
    well = simulator(UmbridgeRunner(url, "forward", ("pull",))).run(THETA, X)
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
    runner = UmbridgeRunner(f"http://127.0.0.1:{port}", "forward", ("pull",), limit=5.0)
    with pytest.raises(CalibError, match=f"127.0.0.1:{port} is not there"):
        simulator(runner).run(THETA, X)
    thread.join()


def table_of_runs(folder: Path, change: Callable[[str], str]) -> Path:
    """Write runs of ten parameter vectors at two rows, in a table as somebody changed it."""
    vectors = np.random.default_rng(1).uniform([0.3, 0.05], [0.9, 0.3], (10, 2))
    rows = [
        f"{t[0]!r},{t[1]!r},{100 * s!r},{w!r},{1000 * y!r}"
        for t in vectors.tolist()
        for s, w, y in zip(*map(np.ndarray.tolist, X.values()), pull(np.array([t]), X)[0].tolist(),
                           strict=True)
    ]  # fmt: skip
    (folder / "runs.csv").write_text(change("\n".join(["mu,s0,s,w,pull", *rows]) + "\n"))
    return write_program(folder, run="", table='"runs.csv"')


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (lambda t: t.replace("\n", ",7\n").replace("pull,7", "pull,pull"), "twice"),
        (lambda t: t.replace(",10.0,", ",1_0,", 1), "'1_0' is no number"),
        (lambda t: t.replace(",10.0,", ",,", 1), "there is no number"),
        (lambda t: t.replace(",10.0,", ",10,0,", 1), "different numbers of cells"),
    ],
)
def test_a_table_with_other_than_plain_numbers(tmp_path: Path, change: Callable, word: str) -> None:
    one = read_simulator(table_of_runs(tmp_path, change)).simulator
    problem = SimpleNamespace(bound=BoundModel(models_of(one)[0], {}))
    with pytest.raises(CalibError, match=word):
        read_runs(one, problem)  # type: ignore[arg-type]
    same = table_of_runs(tmp_path, lambda text: text)
    found = read_runs(read_simulator(same).simulator, problem)  # type: ignore[arg-type]
    np.testing.assert_allclose(found.values, pull(found.theta, X))
