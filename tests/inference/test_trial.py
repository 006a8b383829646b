"""A simulator that fails from the start is not asked a thousand times by a sampler."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

import calib
from calib.errors import CalibError
from calib.inference.design import try_simulator
from calib.inference.random import generator
from calib.models import MODELS
from calib.models.simulators.declaration import SIMULATED
from tests.models.simulators.examples import PRIORS, lab, pull, serving, write_program
from tests.registered import forgotten

# At the middle of the prior and at five points spread over it, each tried again once.
MADE = 6 * 2
QUICK = {"emulate": "false"}


@pytest.fixture(autouse=True)
def as_before() -> Iterator[None]:
    with forgotten(MODELS, SIMULATED):
        yield


def problem_of(file: Path) -> calib.Problem:
    calib.register(calib.read_simulator(file))
    return calib.build_problem("wheel", calib.table_from_arrays(lab(np.random.default_rng(1))))


def estimated(problem: calib.Problem) -> None:
    calib.estimate(problem, "least_squares", generator(1))


def sampled(problem: calib.Problem) -> None:
    calib.calibrate(problem, seed=1)


def refused(
    problem: calib.Problem, *words: str, asking: tuple[Callable, ...] = (estimated, sampled)
) -> None:
    """Whoever asks first: the estimator or the sampler."""
    for ask in asking:
        with pytest.raises(CalibError, match="fails from the start") as caught:
            ask(problem)
        for word in ("none of the 6 runs has a value", "hint: ", *words):
            assert word in str(caught.value)


@pytest.mark.parametrize(
    ("extra", "key", "words"),
    [
        ("print('meshed'); json.dump({'Pull': [1.0]}, open(sys.argv[2], 'w')); sys.exit(0)",
         "outputs", ["there is no output 'pull'; it gave Pull", "it printed: meshed"]),
        ("print('no licence'); sys.exit(3)", "run", ["exit code 3", "it printed: no licence"]),
        ("print('meshed'); p['mu'] = float('nan')", "run", ["not finite", "meshed"]),
    ],
)  # fmt: skip
def test_a_command_says_file_and_key_and_what_it_printed(
    tmp_path: Path, extra: str, key: str, words: list[str]
) -> None:
    counted = f"open({str(tmp_path / 'made')!r}, 'a').write('x'); {extra}"
    problem = problem_of(write_program(tmp_path, extra=counted, **QUICK))
    refused(problem, f"wheel.toml, {key}: ", *words, asking=(sampled,))
    assert len((tmp_path / "made").read_text()) == MADE


@pytest.mark.parametrize(
    ("mood", "key", "words"),
    [
        ("error", "url", ["the server reports an error", "no soil"]),
        ("more", "outputs", ["2 output vectors for pull"]),
    ],
)
def test_a_server_says_file_and_key(tmp_path: Path, mood: str, key: str, words: list[str]) -> None:
    with serving() as url:
        file = write_program(
            tmp_path, run="", url=f'"{url}"', model=f'"{mood}"', rows='"each"', limit="20", **QUICK
        )
        problem = problem_of(file)
        refused(problem, f"wheel.toml, {key}: ", *words)
    said = r"wheel.toml, url: the run could not be made: the server at .* is not there"
    with pytest.raises(CalibError, match=said):
        calib.calibrate(problem, seed=1)


def of_function(f: Callable, **changes: object) -> calib.Problem:
    calib.register(
        calib.from_callable(
            f, conditions=["slip_ratio", "normal_load_kn"], output="drawbar_pull_kn", name="own",
            **({"parameters": PRIORS, "batched": False} | changes),  # type: ignore[arg-type]
        )
    )  # fmt: skip
    return calib.build_problem("own", calib.table_from_arrays(lab(np.random.default_rng(1))))


def test_a_function_that_always_raises_is_called_a_few_times() -> None:
    calls = []

    def broken(theta: np.ndarray, x: dict[str, np.ndarray]) -> np.ndarray:
        calls.append(theta)
        raise OSError("no soil.dat")

    problem = of_function(broken)
    refused(problem, "simulator own: ", "OSError: no soil.dat", ", at mu 0.")
    assert len(calls) == 2 * MADE


def test_one_that_fails_now_and_then_or_in_several_ways_is_not_refused() -> None:
    """Where it fails a sampler finds no value, and goes on elsewhere."""
    calls = []

    def half(theta: np.ndarray, x: dict[str, np.ndarray]) -> np.ndarray:
        calls.append(theta)
        if theta[0] > 0.5 * 0.999:  # the middle, too
            raise RuntimeError("the mesh folds")
        return pull(theta[None], x)[0]

    problem = of_function(half)
    try_simulator(problem)
    made = len(calls)
    assert made > 2
    try_simulator(problem)
    assert len(calls) == made

    def several(theta: np.ndarray, x: dict[str, np.ndarray]) -> np.ndarray:
        if theta[0] > 0.5 * 0.999:
            raise RuntimeError("the mesh folds")
        return np.nan * pull(theta[None], x)[0]

    MODELS.discard("own")
    SIMULATED.discard("own")
    try_simulator(of_function(several))


def scattered(theta: np.ndarray, x: dict[str, np.ndarray]) -> np.ndarray:
    return pull(theta[None], x)[0] * (1.0 + 0.01 * np.random.default_rng().standard_normal())


def scattered_at_once(theta: np.ndarray, x: dict[str, np.ndarray]) -> np.ndarray:
    return pull(theta, x) * (1.0 + 0.01 * np.random.default_rng().standard_normal((len(theta), 1)))


@pytest.mark.parametrize(("f", "batched"), [(scattered, False), (scattered_at_once, True)])
def test_one_that_gives_other_values_the_second_time_is_refused(f: Callable, batched: bool) -> None:
    problem = of_function(f, batched=batched)
    with pytest.raises(CalibError, match="called twice with equal parameters") as caught:
        calib.calibrate(problem, seed=1)
    for word in ("simulator own: ", "% of the largest", "fix the seed", "deterministic = false"):
        assert word in str(caught.value)


def test_a_model_of_ones_own_that_gives_other_values_the_second_time_is_refused() -> None:
    calib.register(
        calib.Model(
            name="scattered", title="Scattered", output="drawbar_pull_kn",
            conditions=("slip_ratio", "normal_load_kn"), parameters=("mu", "s0"),
            predict=scattered_at_once, priors=f'model = "scattered"\n{PRIORS}',
        )
    )  # fmt: skip
    data = calib.table_from_arrays(lab(np.random.default_rng(1)))
    with pytest.raises(CalibError, match="model scattered: called twice with equal") as caught:
        calib.calibrate(calib.build_problem("scattered", data), seed=1)
    assert "fix the seed" in str(caught.value)


def test_sums_in_another_order_are_equal_values() -> None:
    calls = iter(range(100))

    def rounded(theta: np.ndarray, x: dict[str, np.ndarray]) -> np.ndarray:
        return pull(theta[None], x)[0] * (1.0 + 1e-12 * (next(calls) % 2))

    try_simulator(of_function(rounded))


def test_a_simulator_that_hangs_is_spoken_of(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    spoken = threading.Event()

    def warn(text: str, *of: object) -> None:
        said.append(text % of)
        spoken.set()

    monkeypatch.setattr("calib.inference.design.PATIENCE", 0.0)
    monkeypatch.setattr("calib.inference.design._log.warning", warn)

    def hanging(theta: np.ndarray, x: dict[str, np.ndarray]) -> np.ndarray:
        assert spoken.wait(60.0)
        return pull(theta[None], x)[0]

    try_simulator(of_function(hanging))
    assert len(said) == 1
    assert "still trying the simulator own" in said[0]
    assert "emulated" in said[0]


too_small_at: list[np.ndarray] = []


def too_small(theta: np.ndarray, x: dict[str, np.ndarray]) -> np.ndarray:
    too_small_at.append(theta)
    return 0.001 * pull(theta[None], x)[0]


@pytest.mark.parametrize("emulate", [True, False])
def test_an_output_in_another_unit_is_named(emulate: bool) -> None:
    """By the factor of kN and N, wherever in the prior."""
    too_small_at.clear()
    problem = of_function(too_small, emulate=emulate)
    with pytest.raises(CalibError, match="times the largest that was measured") as caught:
        (calib.emulated if emulate else calib.calibrate)(problem, seed=1)
    for word in ("simulator own: ", "in the unit of drawbar_pull_kn", "hint: name the column"):
        assert word in str(caught.value)
    # Before sixty runs of a slow one are paid for.
    assert len(too_small_at) <= 7
