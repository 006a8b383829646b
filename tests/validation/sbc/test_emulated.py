"""Simulated campaigns of a slow simulator, each emulated as a measured one would be."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

import calib
from calib.errors import CalibError
from calib.validation.sbc import run_sbc
from tests.inference.emulation.test_emulate import as_before as as_before
from tests.models.simulators.examples import PRIORS, lab, pull

# The noise is known to a factor of two or so: of one that is nearly zero an emulator would have to
# be next to exact.
KNOWN_NOISE = PRIORS.replace('"half_normal"\nsd = 0.2', '"lognormal"\nmedian = 0.05\nsd_log = 0.4')


def data(folder: Path) -> Path:
    """A campaign's CSV, of which the conditions count."""
    columns = lab(np.random.default_rng(1))
    path = folder / "lab.csv"
    rows = np.stack(list(columns.values()), axis=1)
    np.savetxt(path, rows, delimiter=",", header=",".join(columns), comments="")
    return path


def declared(folder: Path | None, **budget: float) -> list[np.ndarray]:
    """Register the wheel as a slow simulator; return the parameters it was run at, as they come."""
    asked: list[np.ndarray] = []

    def wheel(theta: np.ndarray, x: dict[str, np.ndarray]) -> np.ndarray:
        asked.extend(theta)
        return pull(theta, x)

    calib.register(
        calib.from_callable(
            wheel, parameters=KNOWN_NOISE, conditions=("slip_ratio", "normal_load_kn"),
            output="drawbar_pull_kn", name="slow", emulate=True, folder=folder, **budget,
        )
    )  # fmt: skip
    return asked


@pytest.mark.slow
def test_emulated_posteriors_are_calibrated_and_share_their_first_runs(tmp_path: Path) -> None:
    asked = declared(tmp_path / "runs")
    said: list[str] = []
    score = run_sbc(
        tmp_path / "sbc", models=["slow"], simulations=100, seed=7, data=data(tmp_path),
        announce=said.append,
    )  # fmt: skip
    found = score.models[0]
    assert not found.failed
    assert found.unconverged <= 10
    assert {q.name for q in found.quantities} == {
        "mu", "s0", "sigma", "log_likelihood", "prediction", "measurement",
    }  # fmt: skip
    assert score.alarms == {}, score.adjusted
    assert min(score.adjusted.values()) > 0.01
    # 20 runs once; then those of each campaign, two of them its truth's.
    most = re.search(r"slow: 20 runs that all .* at most (\d+) runs of the simulator", said[0])
    assert most is not None
    assert int(most[1]) == 20 + 100 * 182
    assert len(asked) <= int(most[1])


@pytest.mark.slow
def test_a_few_campaigns_leave_their_records_and_make_no_run_twice(tmp_path: Path) -> None:
    asked = declared(tmp_path / "runs", runs=30, checks=4, tolerance=0.5)
    where, kept = data(tmp_path), tmp_path / "sbc"
    run_sbc(kept, models=["slow"], simulations=2, seed=7, data=where)
    made = len(asked)
    # A truth is run at two sets of conditions; the design over the prior is run once.
    rows, times = np.unique(np.stack(asked), axis=0, return_counts=True)
    assert sorted(times)[-2:] == [2, 2]
    assert (times > 1).sum() <= 3  # the middle of the prior tells which nodes there can be
    assert len(rows) < 2 * 30
    records = [json.loads(p.read_text()) for p in sorted((kept / "replicates").glob("slow*.json"))]
    assert [r["index"] for r in records] == [0, 1]
    for record in records:
        assert record["ranks"]["mu"][1] > 100
        assert record["rows"] == 17
        assert "lab.csv" in record["design"]
    run_sbc(kept, models=["slow"], simulations=2, seed=7, data=where)
    assert len(asked) == made


def test_an_emulator_that_is_not_good_enough_counts_as_not_converged(tmp_path: Path) -> None:
    declared(None, runs=12, first=10, checks=2, tolerance=1e-6)
    with pytest.raises(CalibError, match="0 of 1 posteriors"):
        run_sbc(tmp_path / "sbc", models=["slow"], simulations=1, seed=7, data=data(tmp_path))
    record = json.loads((tmp_path / "sbc" / "replicates" / "slow-0000.json").read_text())
    assert not record["converged"]
    assert any("the emulator is off by" in reason for reason in record["reasons"])


def test_a_table_of_runs_has_none_at_a_truth(tmp_path: Path) -> None:
    (tmp_path / "runs.csv").write_text("mu,s0,s,w,pull\n0.5,0.1,10,3,1000\n0.6,0.1,10,3,1200\n")
    text = 'name = "made"\ntable = "runs.csv"\n[conditions]\ns = "slip_percent"\n'
    text += 'w = "normal_load_kn"\n[outputs]\npull = "drawbar_pull_n"\n' + KNOWN_NOISE
    (tmp_path / "made.toml").write_text(text)
    calib.register(calib.read_simulator(tmp_path / "made.toml"))
    with pytest.raises(CalibError, match="a table of runs already made"):
        run_sbc(tmp_path / "sbc", models=["made"], simulations=10, seed=7, data=data(tmp_path))
    assert not (tmp_path / "sbc").exists()
