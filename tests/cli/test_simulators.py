"""What is said of an emulated simulator before a verb goes on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib.cli.options import say, say_failed
from calib.cli.prediction import prepare_case
from calib.data import table_from_arrays
from calib.errors import CalibError
from calib.gap.case import Case
from calib.inference.emulation import Emulation
from calib.inference.emulation.state import HeldOut
from calib.models import MODELS
from calib.models.simulators.declaration import SIMULATED
from calib.models.simulators.files import read_simulator
from calib.models.simulators.simulator import Failure, Run
from tests.models.simulators.examples import lab, write_program
from tests.registered import forgotten


def emulation(**other: Any) -> Emulation:
    ok, crashed = Run(np.zeros(2), {}), Run(np.zeros(2), {}, Failure("exit", "exit code 3", ""))
    given: dict[str, Any] = {
        "problem": None, "emulator": None, "expected": 0.0,
        "between": 0.0, "own_noise": 0.0, "passed": True, "reasons": (), "history": (),
        "runs": (ok, ok, crashed),
        "held_out": HeldOut(20, 0.0456, np.zeros(20), np.zeros(20), 0.95, np.zeros((20, 1))),
    }  # fmt: skip
    return Emulation(**{**given, **other})


def test_a_good_one_is_said_to_be_so_and_its_failed_runs_are_told(
    capsys: pytest.CaptureFixture[str],
) -> None:
    say("sim", emulation())
    told = capsys.readouterr()
    assert told.out == (
        "sim: emulated from 3 runs; on 20 runs not seen it is off by 0.046 noise sds (rms); of "
        "their values its 90 % intervals hold 95 % (95 % interval 79 to 99 %): as they should be\n"
    )
    assert "1 of 3 runs failed, the first as exit code 3;" in told.err


def test_one_that_is_not_good_enough_stops_and_says_why(
    capsys: pytest.CaptureFixture[str],
) -> None:
    few = emulation(passed=False, reasons=("too few runs",), held_out=None, own_noise=0.25)
    say("sim", few)
    said = capsys.readouterr().out.splitlines()
    assert said == [
        "sim: emulated from 3 runs",
        "sim: the simulator has a noise of its own, sd 0.25",
        "EMULATOR NOT GOOD ENOUGH: too few runs",
    ]


def test_runs_of_a_field_campaign_are_told_as_such(capsys: pytest.CaptureFixture[str]) -> None:
    say("sim, field", emulation(extended=True, held_out=None))
    assert capsys.readouterr().out == "sim, field: emulated with 3 more runs\n"


def test_a_case_that_cannot_be_diagnosed_is_refused_before_any_run(tmp_path: Path) -> None:
    found = read_simulator(write_program(tmp_path))
    with forgotten(MODELS, SIMULATED):
        found.register()
        rows = table_from_arrays(lab(np.random.default_rng(1)))
        reversed_rows = rows.take(np.arange(len(rows))[::-1])
        for field, words in (
            (reversed_rows, "every field row is a row of the calibration"),
            (rows.take([0, 1, 2]), "3 field rows .* cannot show a gap"),
        ):
            case = Case("same", rows, field, {"drawbar_pull": "wheel"})
            with pytest.raises(CalibError, match=words):
                prepare_case(case, None, 1, 1)
    assert not list((tmp_path / "wheel.runs").rglob("*.json"))


def test_runs_that_fail_under_the_sampler_are_listed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    extra = "print('meshing'); assert p['mu'] < 1, 'the mesh folds'"
    found = read_simulator(write_program(tmp_path, extra=extra, emulate="false", retries="0"))
    found.register()
    try:
        predict = MODELS["wheel"].predict
        assert predict is not None
        x = {"slip_ratio": np.array([0.1]), "normal_load_kn": np.array([4.0])}
        say_failed("wheel")
        assert capsys.readouterr().err == ""
        predict(np.array([[0.5, 0.1], [1.5, 0.1], [2.5, 0.1]]), x)
        say_failed("wheel")
        told = capsys.readouterr().err
    finally:
        MODELS.discard("wheel")
        SIMULATED.discard("wheel")
    assert "2 of 3 runs failed, the first as it ended with exit code 1; the first 2 are" in told
    assert "wheel-failed.csv" in told
    listed = (tmp_path / "wheel.runs" / "wheel-failed.csv").read_text()
    assert listed.startswith("mu,s0,kind,reason,printed\n1.5,0.1,exit,")
    assert "meshing" in listed
    assert "the mesh folds" in listed
