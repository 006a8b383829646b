"""The campaign verb: its exit codes and what it says."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from calib.models import example_csv
from tests.batch.campaign.sites import refuse_all, results
from tests.commands import Calib, Ran

# Tests that run in the background of a shell inherit that Ctrl-C is ignored.
FROM_A_TERMINAL = """
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)
from calib.cli import main
main()
"""
RANKS = '[[sbc]]\nname = "ranks"\nsimulations = 400\ndraw_seed = 3\nmodels = ["bekker"]\n'
RANKS = '[[sbc]]\nname = "r"\nsimulations = {}\ndraw_seed = 5\nmodels = ["bekker"]\n'
FIT = '[[fit]]\nname = "a"\ndata = ["*.csv"]\nmodels = ["bekker"]\nposteriors = false\n'


@pytest.fixture
def campaign(calib: Calib) -> Calib:
    """Run the verb on a plan, in a folder with a data file."""
    Path("rut.csv").write_text(example_csv("bekker"))

    def run(plan: str, *options: str) -> Ran:
        Path("plan.toml").write_text(plan)
        return calib("campaign", "plan.toml", "--out", "out", "--workers", 1, *options)

    return run


def test_it_works_and_goes_on_where_it_stopped(campaign: Calib) -> None:
    ran = campaign(FIT)
    assert (ran.code, ran.out) == (0, "1 of 1 tasks done, 0 failed\nout/summary.json\n")
    numbers = Path("out/results/a.rut.bekker.shipped.nothing/numbers.json")
    first = numbers.stat().st_mtime_ns
    ran = campaign(FIT + RANKS.format(1))
    assert (ran.code, ran.out.splitlines()[0]) == (0, "2 of 2 tasks done, 0 failed")
    assert numbers.stat().st_mtime_ns == first


def test_a_list_of_tasks_does_nothing(campaign: Calib) -> None:
    ran = campaign(FIT + RANKS.format(2), "--list")
    assert ran.code == 0
    assert ran.out == "a.rut.bekker.shipped.nothing\nr.bekker-0000\nr.bekker-0001\n"
    assert not Path("out").exists()


def test_failed_tasks_end_with_one(campaign: Calib) -> None:
    Path("bad.csv").write_text("average_ground_pressure_kpa\n1\n")
    ran = campaign(FIT)
    assert ran.code == 1
    assert "1 of 2 tasks done, 1 failed" in ran.out
    assert "a.bad.bekker.shipped.nothing failed: bad.csv" in ran.err
    assert "rut_depth" in ran.err
    state = json.loads(Path("out/summary.json").read_text())["tasks"]
    assert state["a.bad.bekker.shipped.nothing"]["state"] == "failed"


def test_posteriors_that_did_not_converge_end_with_three(
    campaign: Calib, monkeypatch: pytest.MonkeyPatch
) -> None:
    refuse_all(monkeypatch)
    ran = campaign(FIT + "max_steps = 100\n")
    assert ran.code == 3
    assert "NOT CONVERGED, not to be used: a.rut.bekker.shipped.nothing" in ran.out


def test_what_can_be_mended_ends_with_two(campaign: Calib) -> None:
    for plan, options, words in (
        (FIT.replace("bekker", "becker"), (), "plan.toml, [[fit]], models: "),
        (FIT, ("--scheduler", "nonsense"), "no Dask scheduler"),
    ):
        ran = campaign(plan, *options)
        assert (ran.code, words in ran.err) == (2, True), ran.err
    few = FIT + "max_steps = 100\n"
    campaign(few)
    ran = campaign("seed = 1\n" + few)
    assert (ran.code, "--overwrite" in ran.err) == (2, True)
    assert campaign("seed = 1\n" + few, "--overwrite").code == 0


@pytest.mark.slow
def test_control_c_says_what_is_kept_and_nothing_else(tmp_path):
    (tmp_path / "plan.toml").write_text(RANKS)
    process = subprocess.Popen(
        [sys.executable, "-c", FROM_A_TERMINAL, "campaign", "plan.toml", "--out", "out"],
        cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        start_new_session=True,
    )  # fmt: skip
    while not results(tmp_path / "out"):
        assert process.poll() is None, process.communicate()
        time.sleep(0.01)
    # As a terminal does: to the workers as well.
    os.killpg(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "of 400 results are kept in out/results, and the same command does the others" in err
    assert "Traceback" not in err
