"""Whatever surrounds it: terminals, disks, servers, encodings, and code of a user's own."""

from __future__ import annotations

import errno
import os
import resource
import shutil
import signal
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

import calib
from calib.batch import folders as unfinished
from calib.batch.folders import claimed, fresh_folder
from calib.batch.pool import pool
from calib.batch.user_code import call, run_file
from calib.cli.app import app
from calib.data.files import decoded, read_json
from calib.data.quantities import QUANTITIES
from calib.errors import CalibError
from calib.inference.prior_files import default_priors, read_priors
from calib.models import MODELS, example_csv
from calib.models.simulators.declaration import SIMULATED
from calib.models.simulators.files import read_simulator, register_file
from calib.models.simulators.process import run_program
from calib.models.simulators.runner import (
    CallableRunner,
    CommandRunner,
    output_of_text,
)
from calib.models.simulators.simulator import Failure, Output, RunKeeper, Simulator
from tests.abuse.test_writing import mounted
from tests.gap.cases import PULL_ONLY, make_case, write_case
from tests.models.simulators.examples import PRIORS, lab, write_program
from tests.registered import forgotten

PROGRAM = [sys.executable, "-c", "from calib.cli import main; main()"]
FIT = ["fit", "ruts.csv", "--model", "bekker", "--max-steps", "400", "--out", "run"]
THETA = np.array([0.6, 0.08])
X = {"slip_ratio": np.array([0.1, 0.2]), "normal_load_kn": np.array([4.0, 5.0])}


@pytest.fixture(autouse=True)
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", sys.path[:])
    monkeypatch.setattr("calib.batch.user_code._loaded", {})
    Path("ruts.csv").write_text(example_csv("bekker"), encoding="utf-8")
    Path("slip.csv").write_text(example_csv("modified_bekker"), encoding="utf-8")
    modules = set(sys.modules)
    with forgotten(MODELS, SIMULATED, QUANTITIES):
        yield tmp_path
    for name in set(sys.modules) - modules:
        if name.startswith(("calib_user_", "soil", "helper")):
            sys.modules.pop(name)


def run(*words: str) -> Result:
    return CliRunner().invoke(app, words)


def shell(command: str, **environment: str) -> subprocess.CompletedProcess[str]:
    path = os.pathsep.join(p for p in sys.path if p)
    words = command.replace("calib", f"{sys.executable} -c '{PROGRAM[2]}'", 1)
    return subprocess.run(
        ["bash", "-o", "pipefail", "-c", words], capture_output=True, text=True, check=False,
        env=os.environ | {"PYTHONPATH": path} | environment, errors="replace", timeout=120,
    )  # fmt: skip


# Terminals


@pytest.mark.slow
def test_a_limited_terminal_and_a_name_in_no_encoding_cost_nothing() -> None:
    """Files are in UTF-8 all the same."""
    name = os.fsdecode(b"r\xff.csv")
    shutil.copy("ruts.csv", name)
    done = shell(
        f"calib report {name} --model bekker --max-steps 100 --workers 1 --out rep",
        LC_ALL="C", PYTHONUTF8="0", PYTHONCOERCECLOCALE="0", PYTHONIOENCODING="ascii",
    )  # fmt: skip
    assert done.returncode in (0, 3), done.stderr
    assert "Traceback" not in done.stderr
    assert "?" not in done.stdout  # readable, if in other letters
    page = Path("rep/index.html").read_text(encoding="utf-8")
    assert "²" in page
    assert "r\\udcff.csv" in page


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no full device")
@pytest.mark.slow
def test_where_printing_fails_files_are_written_and_the_exit_code_says_it() -> None:
    done = shell(f"calib {' '.join(FIT)} >/dev/full")
    assert (done.returncode, "Traceback" in done.stderr) == (2, False)
    assert calib.load_calibration(Path("run")).problem.bound.model.name == "bekker"
    assert "what was printed is lost (No space left on device); files are written" in done.stderr


# What is finished before its command is


def interrupt(*_: object, **__: object) -> Any:
    raise KeyboardInterrupt


def fail(*_: object, **__: object) -> Any:
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize(
    ("words", "stage", "kept"),
    [
        (
            "fit ruts.csv --model bekker", "calib.validation.comparison.noise_preference",
            "run-unfinished/run",
        ),
        (
            "report ruts.csv --model bekker --workers 1", "calib.report.study.prior_sensitivity",
            "run-unfinished/rut_depth",
        ),
        (
            "compare bekker modified_bekker slip.csv --workers 1",
            "calib.validation.comparison.leave_one_out", "run-unfinished/bekker",
        ),
    ],
)  # fmt: skip
def test_an_interruption_loses_no_posterior(words: str, stage: str, kept: str) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stage, interrupt)
        done = run(*words.split(), "--max-steps", "100", "--out", "run")
    assert done.exit_code == 130, done.output
    assert not Path("run").exists()
    assert "calib: what was finished is in run-unfinished" in done.stderr
    found = calib.load_calibration(Path(kept))
    assert run("predict", kept, "--at", "ruts.csv").exit_code in (0, 3)
    assert np.isfinite(found.draws.t).all()


@pytest.mark.slow
def test_an_interrupted_diagnosis_that_was_made_is_there(monkeypatch: pytest.MonkeyPatch) -> None:
    write_case(make_case("force_offset", models=PULL_ONLY, n_lab=15, n_field=12), Path("case"))
    monkeypatch.setattr("calib.report.page.diagnosis.write_page", interrupt)
    done = run("diagnose", "case", "--workers", "1", "--out", "found")
    assert (done.exit_code, "what was finished is in found-unfinished" in done.stderr) == (
        130,
        True,
    )
    assert read_json(Path("found-unfinished/diagnosis/diagnosis.json"))["verdict"]


def test_a_disk_that_is_full_at_the_end_loses_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    usual, asked = calib.inference.io.save_posterior, list[Path]()

    def once(calibration: calib.Calibration, path: Path) -> None:
        asked.append(path)
        if len(asked) == 1:
            fail()
        usual(calibration, path)

    monkeypatch.setattr("calib.inference.io.save_posterior", once)
    done = run(*FIT)
    assert done.exit_code == 2
    assert "cannot be written (No space left on device)" in done.stderr
    assert "calib: what was finished is in run-unfinished" in done.stderr
    assert calib.load_calibration(Path("run-unfinished/run")).seed == 2019


def test_another_process_leaves_what_it_finished(tmp_path: Path) -> None:
    with suppress(KeyboardInterrupt), claimed(tmp_path / "out"), pool(2) as side:
        assert side.submit(keeps, "there").result() == "kept"
        unfinished.keep("here", write_here)
        raise KeyboardInterrupt
    found = {p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("word")}
    assert found == {"out-unfinished/there/word", "out-unfinished/here/word"}
    assert not list(tmp_path.glob(".out-*"))


def write_here(folder: Path) -> None:
    (folder / "word").write_text("kept")


def keeps(name: str) -> str:
    unfinished.keep(name, write_here)
    return "kept"


@pytest.mark.parametrize("fails", [False, True])
def test_a_result_is_written_where_it_was_claimed(fails: bool, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    with suppress(KeyboardInterrupt), claimed(Path("out")):
        unfinished.keep("part", write_here)
        os.chdir("elsewhere")
        if fails:
            raise KeyboardInterrupt
        with fresh_folder(Path("out")) as folder:
            write_here(folder)
    assert Path.cwd() == tmp_path
    (found,) = tmp_path.rglob("word")
    assert found.relative_to(tmp_path).parts[0] == ("out-unfinished" if fails else "out")
    assert fails or not list(tmp_path.glob("*unfinished*")) + list(tmp_path.glob(".out-*"))


def test_where_no_place_is_left_beside_it_is_among_temporary_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = tmp_path / "tmp"
    other.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(other))
    with mounted(tmp_path / "stick", "size=20m") as stick:

        def large(folder: Path) -> None:
            (folder / "posterior").write_bytes(bytes(30_000_000))

        with suppress(KeyboardInterrupt), claimed(stick / "out"):
            unfinished.keep("run", large)
            raise KeyboardInterrupt
        assert list(stick.iterdir()) == []
    assert (other / "out-unfinished" / "run" / "posterior").stat().st_size == 30_000_000


def test_a_disk_that_others_fill_meanwhile_has_room_reserved(tmp_path: Path) -> None:
    with mounted(tmp_path / "stick", "size=20m") as stick:
        with claimed(stick / "out"):
            with pytest.raises(OSError, match="No space"), (stick / "photos").open("wb") as file:
                file.write(bytes(20_000_000))
            with fresh_folder(stick / "out") as folder:
                (folder / "posterior.nc").write_bytes(bytes(10_000_000))
        assert (stick / "out" / "posterior.nc").stat().st_size == 10_000_000


def test_a_limit_of_file_sizes_is_found_before_the_work() -> None:
    done = subprocess.run(
        [*PROGRAM, *FIT], capture_output=True, text=True, check=False,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(p for p in sys.path if p)},
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000)),
    )  # fmt: skip
    assert done.returncode == 2
    assert "the output cannot be written (File too large)" in done.stderr
    assert "sampling" not in done.stderr


# What surroundings do to a run


def out_of_memory(theta: np.ndarray, x: dict[str, np.ndarray]) -> np.ndarray:
    raise MemoryError("no memory")


def in_python(function: Callable[..., Any], limit: float | None = None, **more: Any) -> Simulator:
    return Simulator(
        "wheel", CallableRunner(function, ("pull",), limit=limit), ("mu", "s0"), PRIORS,
        {"s": "slip_percent", "w": "normal_load_kn"}, (Output("drawbar_pull_n", "pull", ""),),
        **more,
    )  # fmt: skip


def test_a_lack_of_memory_is_no_failed_run(tmp_path: Path) -> None:
    keeper = RunKeeper(in_python(out_of_memory, 60.0), tmp_path / "runs")
    with pytest.raises(CalibError, match=r"could not be made: .*MemoryError: no memory"):
        keeper.runs(THETA[None], X)
    assert kept(tmp_path / "runs") == []


def test_surroundings_that_stay_away_are_not_tried_for_ever(tmp_path: Path) -> None:
    tried: list[float] = []

    def refused(theta: np.ndarray, x: dict[str, np.ndarray]) -> np.ndarray:
        tried.append(theta[0, 0])
        if len(tried) == 3:
            return np.ones((1, x["w"].size))
        raise ConnectionRefusedError

    keeper = RunKeeper(in_python(refused), tmp_path / "runs")
    with pytest.raises(CalibError, match="7 of 50 runs could not be made"):
        keeper.runs(np.linspace(THETA, 2.0 * THETA, 50), X)
    # Two, one that was made, and five in a row.
    assert (len(tried), len(kept(tmp_path / "runs"))) == (8, 1)


def kept(folder: Path) -> list[str]:
    return [p.name for p in folder.glob("*/*.json") if p.name != "failed.json"]


@pytest.mark.parametrize(
    ("code", "word"),
    [
        ("import os, signal; os.kill(os.getpid(), signal.SIGKILL)", "SIGKILL: something else"),
        ("import os, signal; os.kill(os.getpid(), signal.SIGTERM)", "SIGTERM: something else"),
        ("raise SystemExit(137)", "exit code 137: something else"),
        ("raise SystemExit(127)", "CALIB_SIMULATOR"),
    ],
)
def test_what_ends_a_program_from_outside_is_no_failed_run(
    code: str, word: str, tmp_path: Path
) -> None:
    with pytest.raises(CalibError, match="could not be made") as caught:
        run_program([sys.executable, "-c", code], tmp_path, 20.0)
    assert word in str(caught.value)


def test_a_disk_without_room_is_no_failed_run(tmp_path: Path) -> None:
    with (
        mounted(tmp_path / "stick", "size=1m") as stick,
        pytest.raises(CalibError, match="MB are left on its disk"),
    ):
        run_program([sys.executable, "-c", "raise SystemExit(1)"], stick, 20.0)


# Code of a user's own


def meddles(folder: Path) -> Callable[..., Any]:
    def pull(theta: np.ndarray, x: dict[str, np.ndarray]) -> np.ndarray:
        os.chdir(folder)
        os.environ["TMPDIR"] = "/nowhere"
        os.environ.pop("HOME", None)
        sys.path.insert(0, "/nowhere")
        np.seterr(all="raise")
        warnings.simplefilter("error")
        print("1,2,3")
        return 1000.0 * theta[:, :1] * x["w"] * (1.0 - np.exp(-x["s"] / 100.0 / theta[:, 1:2]))

    return pull


def test_what_code_of_ones_own_changes_is_put_back(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "elsewhere").mkdir()
    before = Path.cwd(), os.environ.copy(), sys.path[:], np.geterr(), warnings.filters[:]
    simulator = in_python(meddles(tmp_path / "elsewhere"))
    first, second = (simulator.run(THETA, X) for _ in range(2))
    assert not isinstance(first, Failure)
    assert not isinstance(second, Failure)
    np.testing.assert_array_equal(first["drawbar_pull_kn"], second["drawbar_pull_kn"])
    now = Path.cwd(), os.environ.copy(), sys.path[:-1], np.geterr(), warnings.filters[:]
    assert now == before
    assert sys.path[-1] == "/nowhere"
    # The output may be a file's content.
    said = capsys.readouterr()
    assert (said.out, said.err) == ("", "1,2,3\n1,2,3\n")


OWN = """
import os, warnings
import numpy as np
os.chdir(os.path.dirname(__file__))
os.environ["OWN_LICENCE"] = "kept"
np.seterr(all="raise")
warnings.simplefilter("error")
def read(name):
    # Underflows, overflows and divides by zero, none of which the result depends on.
    np.exp(-800.0 * np.ones(1)), np.exp(800.0 * np.ones(1)), np.ones(1) / np.zeros(1)
    return open(name).read()
"""


def test_a_file_of_ones_own_moves_nothing_and_finds_what_it_looked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("OWN_LICENCE", raising=False)
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "table.txt").write_text("7")
    (tmp_path / "a" / "own.py").write_text(OWN)
    before = Path.cwd(), np.geterr(), warnings.filters[:]
    module = run_file(tmp_path / "a" / "own.py")
    assert call(module.read, "table.txt") == "7"
    assert (Path.cwd(), np.geterr(), warnings.filters[:]) == before
    assert os.environ["OWN_LICENCE"] == "kept"
    # Another file of that name is another module.
    (tmp_path / "own.py").write_text("VALUE = 2\n")
    assert run_file(tmp_path / "own.py").VALUE == 2
    assert sys.modules[module.__name__] is module


def numbers() -> dict[str, Any]:
    """Return what the main steps find."""
    table = calib.read_table("ruts.csv")
    problem = calib.build_problem("bekker", table)
    settings = calib.SamplerSettings(max_steps=400)
    found = calib.calibrate(problem, 1, settings=settings)
    ahead = calib.predict(found, table)
    which = calib.diagnose("case", 1)
    return {
        "mean": found.summary["n"].mean, "ahead": ahead.predictive.median.tolist(),
        "loo": calib.leave_one_out(found).elpd,
        "probability": dict(which.ranking.probability),
        "estimate": [
            calib.estimate(problem, m, np.random.default_rng(1)).cost
            for m in ("least_squares", "genetic", "differential_evolution")
        ],
    }  # fmt: skip


@pytest.mark.slow
def test_errors_that_a_caller_asks_numpy_for_change_nothing() -> None:
    write_case(make_case("force_offset", models=PULL_ONLY, n_lab=15, n_field=12), Path("case"))
    usual = numbers()
    with np.errstate(all="raise"), warnings.catch_warnings():
        warnings.simplefilter("error")
        assert numbers() == usual
        words = ["report", "ruts.csv", "--model", "bekker", "--max-steps", "400", "--workers", "1"]
        done = run(*words)
        assert done.exit_code == 0, (done.output, done.exception)


HELPER = "def factor():\n    return {}\n"
WITH_HELPER = """
import helper_soil
def pull(theta, x):
    import helper_later
    return helper_soil.factor() * helper_later.factor() * theta[:, :1] * x["w"]
"""


def write_helped(folder: Path, factor: float, **keys: str) -> Path:
    folder.mkdir()
    path = write_program(folder, **{"run": "", "python": '"sim.py:pull"'} | keys)
    (folder / "sim.py").write_text(WITH_HELPER)
    (folder / "helper_soil.py").write_text(HELPER.format(factor))
    (folder / "helper_later.py").write_text(HELPER.format(2.0))
    return path


def pulled(path: Path) -> float:
    found = read_simulator(path).simulator.run(THETA, X)
    assert not isinstance(found, Failure), found
    return float(found["drawbar_pull_kn"][0])


def test_a_simulator_imports_what_lies_beside_it(tmp_path: Path) -> None:
    path = write_helped(tmp_path / "a", 3.0, limit="60.0")
    assert pulled(path) == pytest.approx(3.0 * 2.0 * 0.6 * 4.0 / 1000.0)
    # In another process too.
    with pool(2, {path: register_file}) as side:
        assert side.submit(pulled, path).result() == pulled(path)


def test_helpers_with_the_name_of_another_or_of_a_library_are_refused(tmp_path: Path) -> None:
    pulled(write_helped(tmp_path / "a", 3.0))
    with pytest.raises(CalibError, match=r"imports helper_\w+, .* and elsewhere too"):
        pulled(write_helped(tmp_path / "b", 5.0))
    (tmp_path / "corner.py").write_text("x = 1\n")
    (tmp_path / "own.py").write_text("import corner\n")
    with pytest.raises(CalibError, match=r"imports corner, which is corner\.py beside it"):
        run_file(tmp_path / "own.py")


def test_files_may_be_named_in_any_order(tmp_path: Path) -> None:
    Path("quantity.py").write_text(
        "from calib import Quantity, register\n"
        "register(Quantity('paddle_depth', 'paddle_depth_mm', 'length', 'mm', 'condition', 'D'))\n"
    )
    text = write_program(tmp_path).read_text().replace("slip_percent", "paddle_depth_mm")
    Path("wheel.toml").write_text(text)
    files = [["--simulator", "wheel.toml"], ["--models", "quantity.py"]]
    for order in (files, files[::-1]):
        done = run("models", "wheel", *order[0], *order[1])
        assert done.exit_code == 0, done.output
        assert "paddle_depth_mm" in done.output


# Programs and their paths


def test_a_program_is_run_by_the_path_that_names_it(tmp_path: Path) -> None:
    """An environment's Python is a link to that without its packages."""
    (tmp_path / "real").write_text(
        "#!/bin/sh\necho '{\"pull\": [1, 2]}'; echo $0 > $CALIB_SIMULATOR/ran\n"
    )
    (tmp_path / "real").chmod(0o755)
    (tmp_path / "linked").symlink_to("real")
    way = CommandRunner(("./linked",), tmp_path)
    found = way.run({"mu": 1.0}, {"w": np.ones(2)})
    assert not isinstance(found, Failure), found
    assert (tmp_path / "ran").read_text().strip() == str(tmp_path / "linked")
    assert way.program == str(tmp_path / "linked")


@pytest.mark.parametrize(
    ("script", "arguments", "word"),
    [
        ("#!/bin/sh\r\necho 1\r\n", ["./run"], "end as on Windows (CR LF)"),
        ("#!/usr/bin/env sh\r\necho 1\r\n", ["./run"], "end as on Windows (CR LF)"),
        ("P=sh\r\nexec $P -c true\r\n", ["sh", "./run"], "end as on Windows (CR LF)"),
        ("#!/nowhere/python\nprint(1)\n", ["./run"], "names /nowhere/python, which is not there"),
    ],
)
def test_a_script_that_is_none_here_is_told_why(
    script: str, arguments: list[str], word: str, tmp_path: Path
) -> None:
    (tmp_path / "run").write_bytes(script.encode())
    (tmp_path / "run").chmod(0o755)
    with pytest.raises(CalibError) as caught:
        CommandRunner(tuple(arguments), tmp_path).run({"mu": 1.0}, {"w": np.ones(2)})
    assert word in str(caught.value)


def test_a_program_that_starts_another_is_told_where_it_runs(tmp_path: Path) -> None:
    (tmp_path / "run").write_text("#!/bin/sh\n./other\n")
    (tmp_path / "other").write_text("#!/bin/sh\necho '{\"pull\": [1, 2]}'\n")
    for name in ("run", "other"):
        (tmp_path / name).chmod(0o755)
    way = CommandRunner(("./run",), tmp_path)
    with pytest.raises(CalibError, match=r"runs in \S*calib-run-\w+, .* CALIB_SIMULATOR"):
        way.run({"mu": 1.0}, {"w": np.ones(2)})
    (tmp_path / "run").write_text("#!/bin/sh\n$CALIB_SIMULATOR/other\n")
    found = way.run({"mu": 1.0}, {"w": np.ones(2)})
    assert not isinstance(found, Failure)
    assert found["pull"].tolist() == [1.0, 2.0]


# Texts

WRITTEN: dict[str, Callable[[str], bytes]] = {
    "windows": lambda text: text.replace("\n", "\r\n").encode("utf-8-sig"),
    "utf-16 of another machine": lambda text: b"\xfe\xff" + text.encode("utf-16-be"),
    "utf-32": lambda text: text.encode("utf-32"),
}


@pytest.mark.parametrize("how", WRITTEN)
def test_texts_are_read_however_they_were_saved(how: str, tmp_path: Path) -> None:
    write = WRITTEN[how]
    assert decoded(write("θ\n")).replace("\r", "") == "θ\n"
    Path("r.csv").write_bytes(write(example_csv("bekker")))
    assert len(calib.read_table("r.csv")) == len(calib.read_table("ruts.csv"))
    Path("p.toml").write_bytes(write(default_priors("bekker").read_text(encoding="utf-8")))
    names = (*MODELS["bekker"].parameters, "sigma")
    assert read_priors(Path("p.toml"), "bekker", names, {}).names == names
    for text, kind in (('{"pull": [1, null]}', "json"), ("pull,note\n1,a\nnan,b\n", "csv")):
        found = output_of_text(decoded(write(text)), kind, {})
        assert not isinstance(found, Failure)
        np.testing.assert_array_equal(found["pull"], [1.0, np.nan])
    file = write_program(tmp_path, input='"template"', template='"in.txt"')
    file.write_bytes(write(file.read_text()))
    Path("in.txt").write_bytes(write("@mu@ @s0@ @s@ @w@\n"))
    way = read_simulator(file).simulator.runner
    assert isinstance(way, CommandRunner)
    assert way.template == "@mu@ @s0@ @s@ @w@\n"
    write_case(make_case("force_offset", models=PULL_ONLY, n_lab=15, n_field=12), Path("case"))
    for path in Path("case").glob("*.*"):
        path.write_bytes(write(path.read_text(encoding="utf-8")))
    assert len(calib.read_case(Path("case")).lab) == 15
    Path("plan.toml").write_bytes(
        write('[[fit]]\nname = "a"\ndata = ["ruts.csv"]\nmodels = ["bekker"]\n')
    )
    assert len(calib.read_plan(Path("plan.toml")).tasks) == 1


@pytest.mark.parametrize(("how", "printed"), [("windows", True), ("utf-32", False)])
def test_of_a_program_too(how: str, printed: bool, tmp_path: Path) -> None:
    content = WRITTEN[how]("pull,n\n1,1\n2,2\n")
    to = "sys.stdout.buffer" if printed else "open(sys.argv[1], 'wb')"
    arguments = [sys.executable, "-c", f"import sys; {to}.write({content!r})"]
    way = CommandRunner((*arguments, *([] if printed else ["{output}"])), tmp_path, gives="csv")
    found = way.run({"mu": 1.0}, {"w": np.ones(2)})
    assert not isinstance(found, Failure), found
    assert found["pull"].tolist() == [1.0, 2.0]


def test_names_are_allowed_in_any_script(tmp_path: Path) -> None:
    path = write_program(tmp_path)
    text = path.read_text()
    path.write_text(text.replace("parameters.mu", 'parameters."θ"'), encoding="utf-8")
    found = read_simulator(path)
    assert found.simulator.parameters == ("θ", "s0")
    found.register()
    assert calib.MODELS["wheel"].parameters == ("θ", "s0")
    path.write_text(text.replace("parameters.mu", 'parameters."mu b"'))
    with pytest.raises(CalibError, match="'mu b' is no name for a parameter") as caught:
        read_simulator(path)
    assert "letters of any script, digits and underscores" in str(caught.value)
    path.write_text(text.replace("parameters.mu", "parameters.θ"), encoding="utf-8")
    with pytest.raises(CalibError, match="stand in quotes"):
        read_simulator(path)


# Folders that went through version control


def to_windows(folder: Path) -> None:
    """As git's autocrlf does with what it takes for text."""
    for path in folder.rglob("*"):
        if path.is_file() and b"\0" not in (content := path.read_bytes()):
            path.write_bytes(content.replace(b"\r\n", b"\n").replace(b"\n", b"\r\n"))


def test_other_line_ends_are_no_difference_and_are_told() -> None:
    assert run(*FIT).exit_code == 0
    to_windows(Path("run"))
    done = run("check", "run", "--workers", "1")
    assert done.exit_code == 0, done.output
    assert "SAME but for line ends" in done.output
    assert "2 files have other line ends, as git's autocrlf makes them" in done.output
    assert run("predict", "run", "--at", "ruts.csv").exit_code == 0
    data = Path("run/data.csv")
    data.write_bytes(data.read_bytes().replace(b"60", b"61", 1))
    changed = run("check", "run", "--quick")
    assert (changed.exit_code, "data.csv" in changed.output) == (1, True)


def test_a_run_that_is_doubled_in_a_table_is_named(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    columns = lab(rng)
    rows = [
        (mu, s0, 100.0 * s, w, 1000.0 * mu * w * (1.0 - np.exp(-s / s0)))
        for mu, s0 in rng.uniform([0.3, 0.05], [0.8, 0.2], (10, 2))
        for s, w in zip(columns["slip_ratio"], columns["normal_load_kn"], strict=True)
    ]
    np.savetxt("lab.csv", np.stack(list(columns.values()), axis=1), delimiter=",",
               header=",".join(columns), comments="")  # fmt: skip
    doubled = [rows[40]], "line 182: the row of line 42 is there again (mu = "
    short = [(0.5, 0.1, *rows[0][2:])], "(that of 0.5, 0.1 has 1 rows)"
    for name, (extra, word) in {"doubled": doubled, "short": short}.items():
        np.savetxt("runs.csv", [*rows, *extra], delimiter=",", header="mu,s0,s,w,pull", comments="")
        path = write_program(tmp_path, run="", table='"runs.csv"', name=f'"{name}"')
        done = run("fit", "lab.csv", "--model", name, "--simulator", str(path))
        assert (done.exit_code, word in done.output) == (2, True), done.output


def test_an_interruption_says_what_is_there(monkeypatch: pytest.MonkeyPatch) -> None:
    """After the folder is written, while its numbers are printed."""
    monkeypatch.setattr("calib.cli.calibration.posterior_table", interrupt)
    done = run(*FIT)
    assert done.exit_code == 130
    assert "nothing was written" not in done.stderr
    assert "calib: what was finished is in run" in done.stderr
    calib.load_calibration(Path("run"))


@pytest.mark.parametrize(
    "number", [signal.SIGINT, pytest.param(signal.SIGHUP, marks=pytest.mark.slow)]
)
def test_of_an_interruption_another_error_may_be_made(number: int) -> None:
    """As extension modules do that are just being imported."""
    code = f"""
import os, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored by what runs in the background
class Interrupted:
    def find_spec(name, *_):
        if name == "calib.inference.problem":
            try:
                os.kill(os.getpid(), {int(number)})
            except KeyboardInterrupt:
                pass
            raise ImportError("initialization failed")
sys.meta_path.insert(0, Interrupted)
from calib.cli import main
main()
"""
    done = subprocess.run(
        [sys.executable, "-c", code, *FIT], capture_output=True, text=True, check=False,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(p for p in sys.path if p)},
    )  # fmt: skip
    assert done.returncode == 130
    assert done.stderr.startswith("calib: interrupted; nothing was written")
