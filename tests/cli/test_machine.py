"""What programs read, what helps people, and what an interruption leaves."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest
import typer

import calib as package
from calib.cli.app import app
from calib.models import example_csv
from tests.commands import Calib

FEW = ("--max-steps", 200)


def test_a_fit_prints_its_run_and_what_was_held_out(calib: Calib) -> None:
    Path("my.csv").write_text(example_csv("modified_bekker"))
    ran = calib("fit", "my.csv", "--model", "modified_bekker", "--json", *FEW,
                "--hold-out", "average_ground_pressure_kpa=141")  # fmt: skip
    found = json.loads(ran.out)
    assert found["exit_code"] == ran.code
    assert found["folder"] == "calib-run"
    assert found["held_out"]["rows"] > 0
    written = json.loads(Path("calib-run/run.json").read_text())
    assert found["gate"] == written["gate"]
    assert set(found["posterior"]) >= {"z_ref", "sigma"}
    assert found["posterior"]["sigma"]["mean"] > 0.0


def test_a_prediction_prints_columns_of_numbers(calib: Calib, run: Path) -> None:
    Path("at.csv").write_text("slip_ratio,average_ground_pressure_kpa\n0.05,140\n0.10,999\n")
    ran = calib("predict", run, "--at", "at.csv", "--json")
    found = json.loads(ran.out)
    assert (found["exit_code"], found["outside"]) == (ran.code, 1)
    assert found["columns"]["slip_ratio"] == [0.05, 0.1]
    assert all(isinstance(v, float) for v in found["columns"]["rut_depth_mm_median"])
    assert "1 row lies outside" in ran.err
    printed = calib("predict", run, "--at", "at.csv")
    assert printed.out.splitlines()[0].split(",") == list(found["columns"])


def test_a_comparison_and_sbc_print_the_files_they_write(calib: Calib) -> None:
    Path("plates.csv").write_text(example_csv("reece"))
    ran = calib("compare", "reece", "bekker_plate", "plates.csv", "--json", "--workers", 1, *FEW)
    found = json.loads(ran.out)
    assert set(found["models"]) == {"reece", "bekker_plate"}
    assert (found.pop("exit_code"), found.pop("folder")) == (ran.code, "calib-comparison")
    assert found == json.loads(Path("calib-comparison/comparison.json").read_text())


def test_an_error_leaves_the_output_empty(calib: Calib) -> None:
    ran = calib("predict", "absent", "--at", "at.csv", "--json")
    assert (ran.code, ran.out) == (2, "")
    assert "there is no such folder" in ran.err


def test_what_is_not_finite_is_null(capsys: pytest.CaptureFixture[str]) -> None:
    from contextlib import redirect_stdout
    from sys import stdout

    from calib.cli.options import _Aside, finish

    with redirect_stdout(_Aside(stdout)):
        print("for people")
        with pytest.raises(typer.Exit):
            finish(3, {"a": [float("nan"), {"b": (float("inf"), 1.0)}]})
    assert json.loads(capsys.readouterr().out) == {"exit_code": 3, "a": [None, {"b": [None, 1.0]}]}


def verbs() -> dict[str, typer.core.TyperCommand]:
    group = typer.main.get_command(app)
    found = {}
    for name, command in group.commands.items():
        found |= (
            {f"{name} {n}": c for n, c in command.commands.items()}
            if hasattr(command, "commands")
            else {name: command}
        )
    return found


@pytest.mark.parametrize("verb", verbs())
def test_every_help_has_an_example_that_is_understood(verb: str) -> None:
    command = verbs()[verb]
    typed = command.epilog.removeprefix("Example: ").partition(" > ")[0]
    assert typed.startswith(f"calib {verb} ")
    with command.make_context(verb, typed.removeprefix(f"calib {verb} ").split()):
        pass


def test_no_help_shows_the_type_of_a_flag(calib: Calib) -> None:
    for words in ((), ("report",), ("challenge",), ("challenge", "well-specified")):
        told = calib(*words, "--help").out
        assert "--help" in told
        assert "bool" not in told.lower()


def test_the_version(calib: Calib) -> None:
    assert calib("--version").out == f"calib {version('terracalib')}\n"
    assert package.__version__ == version("terracalib")


def test_more_is_said_when_asked_for(calib: Calib, run: Path) -> None:
    Path("at.csv").write_text("slip_ratio,average_ground_pressure_kpa\n0.05,140\n")
    quiet, more = calib("predict", run, "--at", "at.csv"), calib("-v", "predict", run, "--at", "at.csv")  # fmt: skip  # noqa: E501
    assert more.out == quiet.out
    assert f"numpy {version('numpy')}" in more.err
    assert "at.csv: 1 rows of slip_ratio, average_ground_pressure_kpa" in more.err
    failed = calib("-v", "predict", "absent", "--at", "at.csv")
    assert failed.code == 2
    assert "Traceback" in failed.err
    assert "at.csv" not in calib("predict", run, "--at", "at.csv").err


def test_an_interruption_says_how_to_go_on(calib: Calib, monkeypatch: pytest.MonkeyPatch) -> None:
    def stopped(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("calib.inference.calibration.calibrate", stopped)
    Path("my.csv").write_text(example_csv("bekker"))
    ran = calib("fit", "my.csv", "--model", "bekker")
    assert ran.code == 130
    assert "nothing was written. Start the same command again" in ran.err
    assert not Path("calib-run").exists()


ENDING = """
import sys
import calib.cli, calib.cli.app
def app(**_):
    print("x" * 10)
    sys.exit(3)
calib.cli.app.app = app
calib.cli.main()
"""
BUFFERED = {k: v for k, v in os.environ.items() if k != "PYTHONUNBUFFERED"}


def test_what_code_of_ones_own_has_open_is_written(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text("LOG = open('log.txt', 'w')\nLOG.write('loaded')\n")
    program = [sys.executable, "-c", "from calib.cli import main; main()"]
    ran = subprocess.run(
        [*program, "models", "--models", "own.py"], cwd=tmp_path, capture_output=True, text=True,
        check=False, env=BUFFERED,
    )  # fmt: skip
    assert (ran.returncode, "bekker" in ran.stdout) == (0, True)
    assert (tmp_path / "log.txt").read_text() == "loaded"


@pytest.mark.skipif(sys.platform == "win32", reason="of a shell")
@pytest.mark.parametrize(("to", "code"), [(">&-", 3), ("2>&-", 3), (">/dev/full", 2)])
def test_without_a_place_to_write_to_the_exit_code_says_it(to: str, code: int) -> None:
    command = shlex.join([sys.executable, "-c", ENDING])
    ran = subprocess.run(
        f"{command} {to}", shell=True, capture_output=True, text=True, check=False, env=BUFFERED
    )
    assert ran.returncode == code
    assert "Traceback" not in ran.stderr


@pytest.mark.slow  # what it rests on is above
@pytest.mark.skipif(sys.platform == "win32", reason="of a shell")
def test_a_job_that_closed_its_output_is_told_the_same(tmp_path: Path) -> None:
    (tmp_path / "my.csv").write_text(example_csv("bekker"))
    program = [sys.executable, "-c", "from calib.cli import main; main()"]
    for words in (["fit", "my.csv", "--model", "bekker", "--out", "run", "--max-steps", "800"],
                  ["check", "run", "--quick"], ["predict", "run", "--at", "my.csv"]):  # fmt: skip
        ran = subprocess.run(
            f"{shlex.join([*program, *words])} >&-", shell=True, cwd=tmp_path, text=True,
            capture_output=True, check=False,
        )  # fmt: skip
        assert (ran.returncode, "Traceback" in ran.stderr) == (0, False), ran.stderr


def test_a_reader_that_has_gone_is_no_error() -> None:
    """As `calib models | head -1` has it: what is still to be written has nowhere to go."""
    with subprocess.Popen(
        [sys.executable, "-c", ENDING],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=BUFFERED,
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == ""


@pytest.mark.parametrize("module", ["calib.cli.app", "typer", "calib.inference.problem"])
def test_an_interruption_while_it_imports_says_how_to_go_on(module: str, tmp_path: Path) -> None:
    code = f"""
import os, signal, sys
class Interrupted:
    def find_spec(name, *_):
        if name == {module!r}:
            try:
                os.kill(os.getpid(), signal.SIGINT)
            except KeyboardInterrupt:
                if name == "typer":  # as an extension module may
                    raise ImportError(name) from None
                raise
sys.meta_path.insert(0, Interrupted)
signal.signal(signal.SIGINT, signal.default_int_handler)
from calib.cli import main
main()
"""
    (tmp_path / "my.csv").write_text(example_csv("bekker"))
    command = [sys.executable, "-c", code, "fit", "my.csv", "--model", "bekker"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == 130
    assert done.stderr.startswith("calib: interrupted; nothing was written. Start the same command")
    assert len(done.stderr.splitlines()) == 1
