"""`calib doctor` says what is there, and what a check of a report finds."""

from __future__ import annotations

import json
from importlib.metadata import version
from pathlib import Path

import pytest

from calib.errors import CalibError
from calib.he2019 import embedded
from calib.models import MODELS
from tests.cli.test_cli import Calib, calib  # noqa: F401


@pytest.fixture
def run(calib: Calib) -> Path:  # noqa: F811
    embedded.write(Path("data"))
    made = calib("fit", "data/rut_depth.csv", "--model", "bekker", "--out", "run", "--seed", 4)
    assert made.code == 0, made.err
    return Path("run")


def test_what_is_installed_and_whether_a_report_checks(calib: Calib, run: Path) -> None:  # noqa: F811
    told = calib("doctor", "--report", run, "--quick")
    assert told.code == 0, told.err
    assert f"  numpy {version('numpy')}\n" in told.out
    assert f"  {len(MODELS)} models: " in told.out
    assert f"shipped report\n  {run}: NOTHING DIFFERENT" in told.out
    assert "--quick" not in told.err
    machine = json.loads(calib("doctor", "--report", run, "--quick", "--json").out)
    assert machine["report"]["exit_code"] == 0
    assert machine["machine"]["kernels"]
    assert "bekker" in machine["registered"]["models"]


def test_that_a_whole_check_follows_is_said_first(
    calib: Calib,  # noqa: F811
    run: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """With what leaves it out; what is installed is told before it is over."""

    def stopped(*_: object, **__: object) -> None:
        raise CalibError("stopped in the middle")

    monkeypatch.setattr("calib.cli.check._checked", stopped)
    told = calib("doctor", "--report", run)
    first, second = told.err.splitlines()
    assert first == (
        f"calib: computes {run} again below, some 20 s; --quick leaves the sampling out"
    )
    assert "stopped in the middle" in second
    assert told.out.endswith("shipped report\n")


def test_a_report_that_differs_is_told_by_the_exit_code(calib: Calib, run: Path) -> None:  # noqa: F811
    data = run / "data.csv"
    data.write_text(data.read_text() + "\n")
    told = calib("doctor", "--report", run, "--quick")
    assert told.code == 1
    assert "DIFFERENT" in told.out
