"""Emulated posteriors against those of the simulator itself."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import calib
from calib.errors import CalibError
from calib.inference.calibration import Calibration
from calib.inference.emulation import foreseen
from calib.inference.emulation.prepared import prepare, write_failed
from calib.inference.emulation.state import State
from calib.inference.sampler import SamplerSettings
from calib.models import MODELS
from calib.models.simulators.declaration import SIMULATED, EmulationSettings, Simulated
from calib.models.simulators.simulator import Run, RunKeeper
from tests.models.simulators.examples import PRIORS, lab, pull
from tests.registered import forgotten

CONDITIONS = ("slip_ratio", "normal_load_kn")


@pytest.fixture(autouse=True)
def as_before(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    # Empty as if it were not there; what a test sets goes with it.
    monkeypatch.setattr("calib.batch.user_code._loaded", {})
    with forgotten(MODELS, SIMULATED):
        yield


def declared(f: Callable, name: str, **changes: object) -> Simulated:
    given = {"parameters": PRIORS} | changes
    found = calib.from_callable(
        f, conditions=CONDITIONS, output="drawbar_pull_kn", name=name,
        **given,  # type: ignore[arg-type]
    )  # fmt: skip
    calib.register(found)
    return found


def table(seed: int = 1, noise: float = 0.03) -> calib.Table:
    return calib.table_from_arrays(lab(np.random.default_rng(seed), noise))


def exact(data: calib.Table, **changes: object) -> Calibration:
    declared(pull, "direct", **changes)
    return calib.calibrate(calib.build_problem("direct", data), seed=1)


@cache
def directly() -> Calibration:
    """The posterior of the usual table, by the simulator itself."""
    return exact(table())


def agree(found: Calibration, truth: Calibration, mean: float = 0.05, sd: float = 0.1) -> None:
    for name, s in truth.summary.items():
        e = found.summary[name]
        assert abs(e.mean - s.mean) < mean * s.sd + 3.0 * (e.mcse_mean + s.mcse_mean), name
        assert abs(e.sd / s.sd - 1.0) < sd, name


@pytest.mark.slow
def test_few_runs_give_the_posterior_of_three_hundred_thousand() -> None:
    data = table()
    declared(pull, "slow", emulate=True)
    emulation = calib.emulated(calib.build_problem("slow", data), seed=1)
    assert emulation.passed, emulation.reasons
    assert len(emulation.runs) <= 100
    assert emulation.own_noise == 0.0
    assert emulation.held_out is not None
    assert emulation.held_out.rmse < 0.1
    found = calib.calibrate(emulation.problem, seed=1)
    assert found.converged
    agree(found, directly())


@pytest.mark.slow
def test_a_budget_that_is_too_small_is_told() -> None:
    declared(lambda t, x: pull(t, x) * np.cos(25.0 * t[:, :1]), "wild", emulate=True, runs=30)
    emulation = calib.emulated(calib.build_problem("wild", table()), seed=1)
    assert not emulation.passed
    assert "give it more runs" in emulation.reasons[0]
    assert len(emulation.runs) <= 30


@pytest.mark.slow
def test_a_region_where_it_crashes_is_outside_the_posterior(tmp_path: Path) -> None:
    def crashing(theta: np.ndarray, x: dict[str, np.ndarray]) -> np.ndarray:
        if theta[0, 0] > 0.6:
            raise RuntimeError("the mesh folds")
        return pull(theta, x)

    simulated = declared(crashing, "crashing", emulate=True, runs=40, checks=4)
    emulation = calib.emulated(calib.build_problem("crashing", table()), seed=1)
    assert emulation.failed
    assert all(run.theta[0] > 0.6 for run in emulation.failed)
    short = SamplerSettings(max_steps=192)
    found = calib.calibrate(emulation.problem, seed=1, settings=short)
    # The data are of mu = 0.6. The edge lies somewhere between runs, so that it is known to the
    # distance between these only, here some sds: what lies beyond a run that failed is out.
    whole = directly().parameters["mu"]
    kept = whole[whole < 0.6]
    nearest = min(run.theta[0] for run in emulation.failed)
    # At another s0 the edge is a little farther than the nearest that failed.
    assert found.parameters["mu"].max() < nearest + 0.3 * whole.std() < whole.max()
    assert abs(found.summary["mu"].mean - kept.mean()) < kept.std()
    write_failed(emulation.failed, simulated.simulator.parameters, tmp_path / "failed.csv")
    lines = (tmp_path / "failed.csv").read_text().splitlines()
    assert lines[0] == "mu,s0,kind,reason,printed"
    assert len(lines) == 1 + len(emulation.failed)
    assert "the mesh folds" in lines[1]


CRASHES: dict[str, Callable[[float, float], bool]] = {
    "at the posterior's edge": lambda mu, s0: mu > 0.6,
    "on the posterior and beyond": lambda mu, s0: mu > 0.52,
    "in half of the prior": lambda mu, s0: s0 < 0.085,
    "on the posterior alone": lambda mu, s0: (
        abs(np.log(mu / 0.6)) < 0.1 and abs(np.log(s0 / 0.08)) < 0.15
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("where", CRASHES)
@pytest.mark.parametrize("seed", range(2))
def test_whatever_fails_the_end_is_a_fit_or_what_to_do(where: str, seed: int) -> None:
    def crashing(theta: np.ndarray, x: dict[str, np.ndarray]) -> np.ndarray:
        if CRASHES[where](*theta[0]):
            raise RuntimeError("the mesh folds")
        return pull(theta, x)

    declared(crashing, "crashing", emulate=True)
    told = ""
    try:
        emulation = calib.emulated(calib.build_problem("crashing", table()), seed=seed)
    except CalibError as error:
        told = str(error)
    if told:
        for words in ("runs have a value", "the mesh folds", ", at mu ", "priors that do not"):
            assert words in told
        return
    found = calib.calibrate(emulation.problem, seed=seed)
    assert found.converged
    theta = found.natural.reshape(-1, 3)[::50]
    # To the distance between runs, draws keep to where there are values.
    assert np.mean([CRASHES[where](*t[:2]) for t in theta]) < 0.5


def test_where_runs_fail_and_what_to_do_is_told_if_nothing_is_left(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def crashing(theta: np.ndarray, x: dict[str, np.ndarray]) -> np.ndarray:
        if theta[0, 0] > 0.7:
            print("folded")
            raise RuntimeError("the mesh folds")
        return pull(theta, x)

    def nothing(*_: object, **__: object) -> None:
        raise CalibError("no parameter values of positive probability were found")

    monkeypatch.setattr("calib.inference.emulation.state.sample_posterior", nothing)
    declared(crashing, "crashing", emulate=True)
    with pytest.raises(CalibError) as caught:
        calib.emulated(calib.build_problem("crashing", table()), seed=1)
    text = str(caught.value)
    for words in (
        "no parameters are left for the data", "of the 24 runs have a value",
        "RuntimeError: the mesh folds", ", at mu 0.7", "those with a value are at mu 0.",
        "simulator crashing", "priors that do not reach there",
    ):  # fmt: skip
        assert words in text


def test_a_simulator_that_never_runs_is_refused_after_its_first_runs(tmp_path: Path) -> None:
    calls = []

    def broken(theta: np.ndarray, x: dict[str, np.ndarray]) -> np.ndarray:
        calls.append(theta)
        raise OSError("no soil.dat")

    # The middle of the prior and five, each tried twice; what has failed is not made again.
    declared(broken, "broken", emulate=True, folder=tmp_path / "broken.runs")
    for _ in range(2):
        with pytest.raises(CalibError, match="fails from the start") as caught:
            calib.emulated(calib.build_problem("broken", table()), seed=1)
        assert len(calls) == 12
    text = str(caught.value)
    for words in (
        "none of the 6 runs has a value",
        "OSError: no soil.dat",
        ", at mu 0.",
        "broken.runs",
    ):
        assert words in text


def test_first_runs_that_fail_in_several_ways_are_no_reason_to_stop() -> None:
    made = []

    def fickle(theta: np.ndarray, x: dict[str, np.ndarray]) -> np.ndarray:
        made.append(theta[0, 0])
        count = len(set(made))  # the first is the middle of the prior
        if count == 4:
            raise RuntimeError("no licence")
        return np.nan * pull(theta, x) if count < 7 else pull(theta, x)

    # With 16, one seed in seven has a posterior that lies among the runs that failed.
    declared(fickle, "fickle", emulate=True, runs=24)
    emulation = calib.emulated(calib.build_problem("fickle", table()), seed=1)
    assert len(emulation.failed) == 6


@pytest.mark.parametrize("deterministic", [True, False])
def test_the_budget_is_of_all_runs_that_are_made(deterministic: bool) -> None:
    """Probes, repeats and checks among them."""
    made = []

    def counted(theta: np.ndarray, x: dict[str, np.ndarray]) -> np.ndarray:
        made.append(theta)
        return pull(theta, x)

    declared(counted, "counted", emulate=True, runs=10, deterministic=deterministic)
    emulation = calib.emulated(calib.build_problem("counted", table()), seed=1)
    assert len(made) == len(emulation.runs) == 10
    assert emulation.document()["runs"] == 10


def below_zero(emulation: calib.Emulation) -> bool:
    return bool(emulation.emulator.training.nodes["slip_ratio"].min() < 0.0)


@pytest.mark.slow
def test_what_grows_beyond_bounds_across_zero_does_not_matter_to_a_fit() -> None:
    """At slips below zero exp(-slip/s0) is 1e200 for some s0 of this prior, and its posterior."""
    vague = PRIORS.replace("sd_log = 0.8", "sd_log = 3.2")
    # Full thrust at the least slip: s0 may be a tenth of it or a thousandth.
    columns = lab(np.random.default_rng(1))
    y = pull(np.array([[0.6, 0.002]]), columns)[0]
    y += 0.03 * np.random.default_rng(2).standard_normal(y.size)
    data = calib.table_from_arrays(columns | {"drawbar_pull_kn": y})
    largest = 0.0

    def grows(theta: np.ndarray, x: dict[str, np.ndarray]) -> np.ndarray:
        nonlocal largest
        with np.errstate(over="ignore"):
            found = pull(theta, x)
        largest = max(largest, float(np.abs(found).max()))
        return found

    declared(grows, "slow", emulate=True, parameters=vague)
    emulation = calib.emulated(calib.build_problem("slow", data), seed=1)
    assert largest > 1e155
    assert not below_zero(emulation)
    assert emulation.passed, emulation.reasons
    assert not any(run.failure for run in emulation.runs[-20:])
    agree(calib.calibrate(emulation.problem, seed=1), exact(data, parameters=vague))


def test_runs_that_fail_across_zero_alone_are_made_without() -> None:
    made, edge = [], 0.08

    def stops(theta: np.ndarray, x: dict[str, np.ndarray]) -> np.ndarray:
        made.append(theta)
        if x["slip_ratio"].min() < 0.0 and theta[0, 1] < edge:
            raise RuntimeError("the wheel is braked")
        return pull(theta, x)

    declared(stops, "stops", emulate=True, runs=30, checks=4)
    emulation = calib.emulated(calib.build_problem("stops", table()), seed=1)
    assert not below_zero(emulation)
    # Each that failed was tried twice.
    assert len(emulation.runs) == len(made) - len(emulation.failed) <= 30
    assert any("below zero" in r.failure.reason for r in emulation.failed if r.failure)
    theta = emulation.emulator.training.theta
    assert (theta[:, 1] < edge).any()
    assert emulation.emulator.training.ok.all()


def test_far_from_all_runs_there_is_no_value() -> None:
    """Else a posterior that a crash leaves no room flees there."""
    declared(pull, "slow", emulate=True, runs=20, checks=0)
    emulator = calib.emulated(calib.build_problem("slow", table()), seed=1).emulator
    z = emulator.axes.of(emulator.training.theta)
    far = np.stack([z.max(axis=0) + 0.9, z.max(axis=0) + 1.1, z.min(axis=0) - 1.1])
    assert emulator.holds(far).tolist() == [True, False, False]
    assert np.isnan(emulator.coefficients(emulator.axes.natural(far))[1:]).all()


@pytest.mark.slow
def test_its_own_noise_is_found_and_smoothed_over() -> None:
    rng = np.random.default_rng(3)
    own = 0.003  # a tenth of the readings' noise

    def noisy(theta: np.ndarray, x: dict[str, np.ndarray]) -> np.ndarray:
        exact = pull(theta, x)
        return exact + own * rng.standard_normal(exact.shape)

    declared(noisy, "noisy", emulate=True, deterministic=False, runs=120)
    data = table()
    emulation = calib.emulated(calib.build_problem("noisy", data), seed=1)
    # The noise of the runs that it is checked on is no error of the emulator.
    assert emulation.passed, emulation.reasons
    assert emulation.held_out is not None
    assert 0.75 < emulation.held_out.covered < 0.99
    assert 0.7 * own < emulation.own_noise < 1.4 * own
    agree(calib.calibrate(emulation.problem, seed=1), directly(), mean=0.3, sd=0.2)


def test_one_that_scatters_too_much_is_to_be_declared_so_before_more_runs_are_made() -> None:
    rng = np.random.default_rng(3)
    declared(
        lambda t, x: pull(t, x) + 0.05 * rng.standard_normal(18), "coy", emulate=True, runs=20,
        nodes=18,
    )  # fmt: skip
    emulation = calib.emulated(calib.build_problem("coy", table()), seed=1)
    assert emulation.own_noise > 0.0
    assert "write deterministic = false in the simulator file" in emulation.reasons[0]
    assert "more runs" not in emulation.reasons[0]
    assert emulation.reasons[0].count("kN (rms)") == 1


def test_a_simulator_that_no_parameter_changes_is_refused() -> None:
    declared(lambda t, x: pull(0.0 * t + [0.6, 0.08], x), "still", emulate=True)
    with pytest.raises(CalibError, match="no parameter changes the output") as told:
        calib.emulated(calib.build_problem("still", table()), seed=1)
    assert "simulator still" in str(told.value)


def test_a_parameter_that_changes_nothing_is_named(caplog: pytest.LogCaptureFixture) -> None:
    def off(theta: np.ndarray, x: dict[str, np.ndarray]) -> np.ndarray:
        return pull(np.stack([theta[:, 0], 0.0 * theta[:, 1] + 0.08], axis=1), x)

    declared(off, "idle", emulate=True)
    calib.emulated(calib.build_problem("idle", table()), seed=1)
    assert "s0 changes no output" in caplog.text
    assert "mu changes" not in caplog.text


@pytest.mark.parametrize(("made", "words"), [(150, "some 160 runs"), (181, "cannot be foreseen")])
def test_no_fewer_runs_are_foreseen_than_were_made(made: int, words: str) -> None:
    problem = calib.build_problem(declared(pull, "slow", emulate=True).name, table())
    keeper = RunKeeper(SIMULATED["slow"].simulator)
    state = State([problem], keeper, problem.conditions, 1, most=200)
    state.runs = [Run(np.zeros(2), {})] * made
    errors = [(75, 0.213), (150, 0.107)]
    said = foreseen(state, np.zeros((9, 2)), EmulationSettings(), errors)
    assert words in said
    assert said.count("runs") == ("some" in said)
    # What a field's emulator is worth before any run of its own says nothing of its runs.
    assert foreseen(state, np.zeros((9, 2)), EmulationSettings(), [(0, 0.4), *errors]) == said
    assert "cannot" in foreseen(state, np.zeros((9, 2)), EmulationSettings(), [(0, 0.4)])


def test_slow_simulators_are_not_called_by_the_sampler() -> None:
    declared(pull, "slow", emulate=True)
    problem = calib.build_problem("slow", table())
    with pytest.raises(CalibError, match="emulate it first"):
        problem.log_prob(problem.priors.to_internal(np.array([[0.5, 0.1, 0.1]])))


def test_a_prepared_model_is_the_emulator_here_and_elsewhere(tmp_path: Path) -> None:
    declared(pull, "slow", emulate=True, folder=tmp_path, runs=16)
    emulation = prepare("slow", table(), 1)
    assert emulation is not None
    problem = calib.build_problem("slow", table())
    t = problem.priors.to_internal(np.array([[0.59, 0.081, 0.04]]))
    np.testing.assert_allclose(problem.log_prob(t), emulation.problem.log_prob(t), rtol=1e-6)
