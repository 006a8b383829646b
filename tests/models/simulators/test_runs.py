"""Every run is kept, and none is made twice."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib.errors import CalibError
from calib.models.simulators.runner import CallableRunner
from calib.models.simulators.simulator import Output, RunKeeper, Simulator

X = {"slip_ratio": np.array([0.1, 0.3])}
THETAS = np.array([[0.6], [0.7], [-1.0]])
CALLS: list[float] = []


def recorded(theta: np.ndarray, x: dict[str, np.ndarray]) -> np.ndarray:
    CALLS.append(float(theta[0, 0]))
    if theta[0, 0] < 0.0:
        raise ValueError("negative friction")
    return theta[:, :1] * x["slip_ratio"]


def simulator(f: object = recorded) -> Simulator:
    return Simulator(
        "line", CallableRunner(f, ("pull",)), ("mu",), "",  # type: ignore[arg-type]
        {"slip_ratio": "slip_ratio"}, (Output("drawbar_pull_kn", "pull", ""),), retries=0,
    )  # fmt: skip


@pytest.mark.parametrize("on_disk", [True, False])
def test_runs_are_made_once(tmp_path: Path, on_disk: bool) -> None:
    CALLS.clear()
    keeper = RunKeeper(simulator(), tmp_path / "runs" if on_disk else None)
    first = keeper.runs(THETAS, X)
    again = keeper.runs(THETAS[::-1], X)
    assert CALLS == [0.6, 0.7, -1.0]
    assert (keeper.made, keeper.kept) == (3, 3)
    for run, same in zip(first, again[::-1], strict=True):
        assert run.ok == same.ok
        if run.ok:
            np.testing.assert_array_equal(
                run.outputs["drawbar_pull_kn"], same.outputs["drawbar_pull_kn"]
            )
    assert first[2].failure is not None
    assert "negative friction" in first[2].failure.reason


def test_a_simulator_may_take_kappa() -> None:
    own = replace(simulator(), conditions={"k": "slip_kappa_percent"})
    assert own.takes == ("slip_ratio",)
    np.testing.assert_allclose(own.asked({"slip_ratio": np.array([-1.0, 0.2])})["k"], [-50.0, 25.0])


def test_other_conditions_replicates_and_simulators_are_other_runs(tmp_path: Path) -> None:
    CALLS.clear()
    keeper = RunKeeper(simulator(), tmp_path)
    keeper.runs(THETAS[:1], X)
    keeper.runs(THETAS[:1], {"slip_ratio": np.array([0.1, 0.30001])})
    keeper.runs(THETAS[:1], X, 1)
    RunKeeper(simulator(lambda t, x: recorded(t, x)), tmp_path).runs(THETAS[:1], X)
    assert CALLS == [0.6] * 4


def test_a_kill_loses_no_run_that_was_made(tmp_path: Path) -> None:
    CALLS.clear()

    def stop(done: int, planned: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        RunKeeper(simulator(), tmp_path, progress=stop).runs(THETAS, X)
    RunKeeper(simulator(), tmp_path).runs(THETAS, X)
    assert CALLS == [0.6, 0.7, -1.0]


def test_a_failed_run_is_made_again_only_with_more_time_or_tries(tmp_path: Path) -> None:
    CALLS.clear()
    for limit, calls in ((10.0, 1), (10.0, 1), (5.0, 1), (20.0, 2)):
        RunKeeper(replace(simulator(), limit=limit), tmp_path).runs(THETAS[2:], X)
        assert len(CALLS) == calls


def test_what_is_no_fault_of_the_parameters_is_not_kept(tmp_path: Path) -> None:
    def unplugged(theta: np.ndarray, x: dict[str, np.ndarray]) -> np.ndarray:
        raise CalibError("the server is not there")

    class Runner(CallableRunner):
        def run(self, parameters: object, conditions: object) -> object:  # type: ignore[override]
            raise CalibError("the server is not there")

    broken = replace(simulator(), runner=Runner(unplugged, ("pull",)))
    with pytest.raises(CalibError, match=r"^3 of 3 runs could not be made: simulator line: the"):
        RunKeeper(broken, tmp_path).runs(THETAS, X)
    assert not list(tmp_path.rglob("*-0.json"))


def test_a_folder_that_cannot_be_one_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CalibError, match="cannot be written"):
        RunKeeper(simulator(), tmp_path / ("A" * 300)).runs(THETAS, X)
