"""What is said of an emulated simulator before a verb goes on."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from calib.cli.simulators import say
from calib.inference.emulation import Emulation
from calib.inference.emulation.settings import HeldOut
from calib.models.simulators.base import Failure
from calib.models.simulators.runs import Run


def emulation(**other: Any) -> Emulation:
    training = SimpleNamespace(theta=np.zeros((58, 2)))
    ok, crashed = Run(np.zeros(2), {}), Run(np.zeros(2), {}, Failure("exit", "exit code 3", ""))
    given: dict[str, Any] = {
        "problem": None, "emulator": SimpleNamespace(training=training), "expected": 0.0,
        "between": 0.0, "own_noise": 0.0, "passed": True, "reasons": (), "history": (),
        "runs": (ok, ok, crashed), "held_out": HeldOut(20, 0.0456, np.zeros(1), np.zeros(1), 0.95),
    }  # fmt: skip
    return Emulation(**{**given, **other})


def test_a_good_one_is_said_to_be_so_and_its_failed_runs_are_told(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert say("sim", emulation())
    told = capsys.readouterr()
    assert told.out == (
        "sim: emulated from 58 runs; on 20 runs not seen it is off by 0.046 noise sds (rms), "
        "95 % inside its 90 % intervals\n"
    )
    assert "1 of 3 runs failed, the first as exit code 3;" in told.err


def test_one_that_is_not_good_enough_stops_and_says_why(
    capsys: pytest.CaptureFixture[str],
) -> None:
    few = emulation(passed=False, reasons=("too few runs",), held_out=None, own_noise=0.25)
    assert not say("sim", few)
    said = capsys.readouterr().out.splitlines()
    assert said == [
        "sim: emulated from 58 runs",
        "sim: the simulator has a noise of its own, sd 0.25",
        "EMULATOR NOT GOOD ENOUGH: too few runs",
    ]


def test_of_a_model_that_needs_none_nothing_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    assert say("bekker", None)
    assert capsys.readouterr().out == ""
