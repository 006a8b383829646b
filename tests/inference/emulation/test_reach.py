"""What an emulator has to reach: settings honoured, many parameters, what a poor one is for."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import calib
from calib.errors import CalibError
from calib.inference.sampler import SamplerSettings
from calib.models import MODELS
from calib.models.simulators.declaration import SIMULATED
from tests.inference.emulation.test_emulate import CONDITIONS, declared, table
from tests.models.simulators.examples import PRIORS, pull
from tests.registered import forgotten


@pytest.fixture(autouse=True)
def as_before(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr("calib.batch.user_code._loaded", {})
    with forgotten(MODELS, SIMULATED):
        yield


@pytest.mark.parametrize("nodes", [10, 30])
def test_the_rows_of_every_run_and_the_checks_are_as_many_as_asked_for(nodes: int) -> None:
    asked = set()

    def counted(theta: np.ndarray, x: dict[str, np.ndarray]) -> np.ndarray:
        asked.add(x["slip_ratio"].size)
        return pull(theta, x)

    declared(counted, "counted", emulate=True, runs=50, checks=8, nodes=nodes)
    emulation = calib.emulated(calib.build_problem("counted", table()), seed=1)  # of 18 rows
    assert asked == {nodes}
    assert emulation.held_out is not None
    assert emulation.held_out.runs == 8
    # Between ten nodes the data have rows of which the emulator knows too little: it says so.
    told = any("between its nodes" in reason for reason in emulation.reasons)
    assert told <= (nodes == 10)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"runs": 80, "checks": 17}, "checks = 17 is more than runs = 80"),
        ({"runs": 40, "first": 39}, "first = 39 is more than runs = 40"),
        ({"check": 5}, "emulator.check"),
        ({"tolerance": float("nan")}, "emulator.tolerance"),
        ({"nodes": 1}, "greater than or equal to 2"),
    ],
)
def test_a_setting_that_cannot_be_honoured_is_refused(given: dict, words: str) -> None:
    made = []

    def counted(theta: np.ndarray, x: dict[str, np.ndarray]) -> np.ndarray:
        made.append(theta)
        return pull(theta, x)

    def tried() -> None:
        declared(counted, "counted", emulate=True, **given)
        calib.emulated(calib.build_problem("counted", table()), seed=1)

    with pytest.raises(CalibError) as caught:
        tried()
    assert words in str(caught.value)
    assert not made


def runs_table(folder: Path, theta: np.ndarray, data: calib.Table, keys: str = "") -> list[str]:
    """Write runs in percent and newtons, their rows in any order; return the rows."""
    x = {name: data[name] for name in CONDITIONS}
    lines = []
    for t, values in zip(theta.tolist(), (1000.0 * pull(theta, x)).tolist(), strict=True):
        rows = zip(*(c.tolist() for c in x.values()), values, strict=True)
        lines += [f"{t[0]!r},{t[1]!r},{100 * s!r},{w!r},{v!r}" for s, w, v in rows]
    np.random.default_rng(6).shuffle(lines)
    (folder / "runs.csv").write_text("\n".join(["mu,s0,s,w,pull", *lines]) + "\n")
    text = f'name = "made"\ntable = "runs.csv"\n{keys}\n[conditions]\ns = "slip_percent"\n'
    text += 'w = "normal_load_kn"\n[outputs]\npull = "drawbar_pull_n"\n' + PRIORS
    (folder / "made.toml").write_text(text)
    return lines


def test_settings_of_runs_that_are_made_already_are_refused(tmp_path: Path) -> None:
    theta = np.random.default_rng(5).uniform((0.5, 0.06), (0.7, 0.1), (12, 2))
    runs_table(tmp_path, theta, table(), "emulator = {checks = 4, tolerance = 0.2}")
    with pytest.raises(CalibError, match="checks can do nothing for a table"):
        calib.read_simulator(tmp_path / "made.toml")
    runs_table(tmp_path, theta, table(), "emulator = {tolerance = 0.2}")
    assert calib.read_simulator(tmp_path / "made.toml").emulation.tolerance == 0.2


def test_a_table_is_judged_where_the_posterior_is(tmp_path: Path) -> None:
    """Twenty runs over a wide prior, sixty about the posterior."""
    data, rng = table(), np.random.default_rng(5)
    wide = np.exp(rng.normal(np.log((0.5, 0.1)), (0.4, 0.8), (20, 2)))
    near = rng.normal((0.6, 0.08), (0.01, 0.004), (60, 2))
    rows = runs_table(tmp_path, np.concatenate([wide, near]), data)
    calib.register(calib.read_simulator(tmp_path / "made.toml"))
    emulation = calib.emulated(calib.build_problem("made", data), seed=1)
    assert emulation.passed, emulation.reasons
    assert emulation.held_out is not None
    assert 10 <= emulation.held_out.runs <= 70
    # What leaving a run out says is what the emulator is off by at others of the posterior.
    at = rng.normal((0.6, 0.08), (0.005, 0.002), (200, 2))
    x = {name: data[name] for name in CONDITIONS}
    off = emulation.emulator.predict(at, x) - pull(at, x)
    assert np.sqrt(np.square(off).mean()) / 0.03 < 0.1
    (tmp_path / "runs.csv").write_text("\n".join(["mu,s0,s,w,pull", *rows[1:]]) + "\n")
    with pytest.raises(CalibError, match="not all at the same conditions"):
        calib.emulated(calib.build_problem("made", data), seed=1)


@pytest.mark.slow
def test_a_poor_emulator_says_what_it_is_good_for() -> None:
    declared(pull, "slow", emulate=True, runs=16, first=8, checks=3, tolerance=1e-3)
    emulation = calib.emulated(calib.build_problem("slow", table()), seed=1)
    assert not emulation.passed
    for words in ("Its error is in the likelihood", " % wider", "of their sds", "It is usable for"):
        assert words in emulation.reasons[0]
    # How much wider it says the posterior is, against that without the error.
    sure = replace(emulation.problem.bound.model, uncertain=None)
    alone = replace(emulation.problem, bound=replace(emulation.problem.bound, model=sure))
    short = SamplerSettings(max_steps=192)
    both = [calib.calibrate(p, 1, settings=short).summary for p in (emulation.problem, alone)]
    for name, ratio in emulation.wider.items():
        assert ratio == pytest.approx(both[0][name].sd / both[1][name].sd, rel=0.15)
    assert set(emulation.shifted) == {"mu", "s0"}
