"""Several outputs, series and derived parameters of one simulator, against the simulator itself."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import calib
from calib.data.quantities import QUANTITIES, Quantity
from calib.errors import CalibError
from calib.inference.emulation.prepared import emulated_jointly, prepare, prepare_field
from calib.inference.joint import JointProblem, build_joint, calibrate_joint
from calib.models import MODELS
from calib.models.simulators.declaration import SIMULATED
from tests.inference.emulation.test_emulate import CONDITIONS, table
from tests.inference.emulation.test_emulate import declared as declared_wheel
from tests.models.simulators.examples import pull
from tests.registered import forgotten

ENTRY = 'unit = "{unit}", reason = "this test", source = "this test"'
LOGNORMAL = '{name} = {{dist = "lognormal", median = {median}, sd_log = 0.5, ' + ENTRY + "}}\n"
NOISE = '{name} = {{dist = "half_normal", sd = {sd}, ' + ENTRY + "}}\n"


def priors(noise: dict[str, tuple[float, str]], **medians: float) -> str:
    own = "".join(LOGNORMAL.format(name=n, median=m, unit="1") for n, m in medians.items())
    return "[parameters]\n" + own + "".join(
        NOISE.format(name=n, sd=sd, unit=unit) for n, (sd, unit) in noise.items()
    )  # fmt: skip


@pytest.fixture(autouse=True)
def as_before(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr("calib.batch.user_code._loaded", {})
    with forgotten(MODELS, SIMULATED, QUANTITIES):
        yield


def both(theta: np.ndarray, x: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The pull tells a product of the parameters, the rut another combination."""
    a, b = theta.T[:, :, None]
    slip, load = x["slip_ratio"], x["normal_load_kn"]
    pull = load * 0.7 * a * b * (1.0 - np.exp(-slip * (0.5 + a * b) / 0.2))
    return {"pull": pull, "rut": 4.0 * load * (b / a + slip * (b / a) ** 2)}


TWO = priors({"sigma_pull": (0.2, "kN"), "sigma_rut": (0.3, "1")}, a=1.0, b=1.0)
OUTPUTS = ("drawbar_pull", "rut_depth")


def declared(name: str, f: object = both, **given: object) -> None:
    calib.register(
        calib.from_callable(
            f, name=name, parameters=TWO, conditions=["slip_ratio", "normal_load_kn"],
            output={"pull": "drawbar_pull_kn", "rut": "rut_depth_mm"},
            **given,  # type: ignore[arg-type]
        )
    )  # fmt: skip


def measured(seed: int = 1, n: int = 20, shift: float = 0.0) -> calib.Table:
    rng = np.random.default_rng(seed)
    slip, load = rng.uniform((0.02, 4.0), (0.5, 6.0), (n, 2)).T
    at = {"slip_ratio": slip, "normal_load_kn": load}
    true = {k: v[0] for k, v in both(np.array([[1.2, 0.8]]), at).items()}
    pull = true["pull"] + 0.03 * rng.standard_normal(n) + shift
    rut = true["rut"] * np.exp(0.05 * rng.standard_normal(n))
    return calib.table_from_arrays(at | {"drawbar_pull_kn": pull, "rut_depth_mm": rut})


def jointly(name: str, data: calib.Table) -> JointProblem:
    return build_joint({f"{name}_{output}": data for output in OUTPUTS})


def test_one_set_of_runs_gives_the_posterior_of_all_outputs() -> None:
    made = []

    def counted(theta: np.ndarray, x: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        made.append(theta)
        return both(theta, x)

    declared("slow", counted, emulate=True, runs=60, checks=8)
    declared("direct")
    data = measured()
    joint, emulations = emulated_jointly(jointly("slow", data), seed=1)
    assert {*emulations} == {"slow_drawbar_pull", "slow_rut_depth"}
    # The budget is of both, and each was judged on the same unseen runs.
    assert len(made) <= 60
    for emulation in emulations.values():
        assert len(emulation.runs) == len(made)
        assert emulation.passed, emulation.reasons
        assert emulation.held_out is not None
        assert emulation.held_out.runs == 8
    exact = jointly("direct", data)
    natural = np.array([[1.2, 0.8, 0.03, 0.05]]) * np.exp(
        np.random.default_rng(2).normal(0.0, (0.004, 0.004, 0.1, 0.1), (40, 4))
    )
    t = exact.priors.to_internal(natural)
    off = joint.log_prob(t) - exact.log_prob(t)
    assert np.ptp(exact.log_prob(t)) > 5.0
    # Errors of a tenth of the noise, the tolerance, in forty readings.
    assert off.std() < 0.1 * np.sqrt(40)


@pytest.mark.slow
def test_what_either_output_leaves_to_its_prior_both_tell() -> None:
    declared("slow", emulate=True, runs=60)
    declared("direct")
    data = measured()
    joint, _ = emulated_jointly(jointly("slow", data), seed=1)
    found, truth = calibrate_joint(joint, 1), calibrate_joint(jointly("direct", data), 1)
    assert found.converged
    for name, s in truth.summary.items():
        e = found.summary[name]
        assert abs(e.mean - s.mean) < 0.05 * s.sd + 3.0 * (e.mcse_mean + s.mcse_mean), name
        assert abs(e.sd / s.sd - 1.0) < 0.1, name
    for output in OUTPUTS:
        alone = calib.calibrate(calib.build_problem(f"direct_{output}", data), seed=1)
        for name in ("a", "b"):
            assert alone.summary[name].sd_ratio > 0.5
            assert found.summary[name].sd_ratio < 0.05


def test_outputs_of_one_simulator_have_one_prior_each_parameter(tmp_path: Path) -> None:
    declared("slow", emulate=True)
    held = TWO.replace(
        'dist = "lognormal", median = 1.0, sd_log = 0.5', 'dist = "fixed", value = 1', 1
    )
    text = held.replace("sigma_rut", "sigma")
    kept = "\n".join(line for line in text.splitlines() if not line.startswith("sigma_pull"))
    (tmp_path / "own.toml").write_text(f'model = "slow_rut_depth"\n{kept}\n')
    data = measured()
    joint = build_joint(
        {f"slow_{output}": data for output in OUTPUTS},
        priors={"slow_rut_depth": tmp_path / "own.toml"},
    )
    with pytest.raises(CalibError, match="the priors of drawbar_pull, rut_depth differ"):
        emulated_jointly(joint, seed=1)


@pytest.mark.slow
def test_a_field_like_the_laboratory_needs_no_more_runs(tmp_path: Path) -> None:
    made = []

    def counted(theta: np.ndarray, x: dict[str, np.ndarray]) -> np.ndarray:
        made.append(theta)
        return pull(theta, x)

    lab, weaker = table(), table(seed=2)
    weaker = calib.table_from_arrays(
        {**{c: weaker[c] for c in CONDITIONS}, "drawbar_pull_kn": 0.8 * weaker["drawbar_pull_kn"]}
    )
    declared_wheel(counted, "slow", emulate=True, folder=tmp_path)
    first = prepare("slow", lab, 1, elsewhere=[weaker])
    assert first is not None
    assert first.passed, first.reasons
    before = len(made)
    found = prepare_field("slow", lab, 1)  # the laboratory's posterior
    assert found is not None
    assert found.passed
    assert len(made) == before
    # Elsewhere in parameter space it was not checked.
    assert prepare_field("slow", weaker, 1) is not None
    assert len(made) >= before + 20


def creep(theta: np.ndarray, x: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Sinkage over time at one load, less what the wheel has risen at the start."""
    z0, tau, half = theta.T[:, :, None]
    np.testing.assert_allclose(half, tau / 2.0)
    assert np.unique(x["load"]).size == 1
    return {"z": z0 * x["load"][0] * (1.0 - np.exp(-x["time"] / tau)) - 1.0}


def on_its_own_steps(theta: np.ndarray, x: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    time = np.linspace(0.0, 12.0, 1201)
    return {"time": time} | creep(theta, {"load": x["load"], "time": time})


SERIES = '[likelihood]\ncorrelated_along = "run_order"\n' + priors(
    {"sigma": (2.0, "mm")}, z0=5.0, tau=3.0
)


def series(name: str, f: object = creep, **given: object) -> None:
    if "time_s" not in QUANTITIES:
        calib.register(
            Quantity("time", "time_s", "time", "s", "condition", "since the start",
                     suffixes={"s": "s"})
        )  # fmt: skip
    calib.register(
        calib.from_callable(
            f, name=name, parameters=SERIES, along="time", derived={"half": "tau / 2"},
            conditions={"load": "normal_load_kn", "time": "time_s"},
            output={"z": {"column": "rut_depth_mm", "response": "identity"}},
            **given,  # type: ignore[arg-type]
        )
    )  # fmt: skip


def crept() -> calib.Table:
    rng, n = np.random.default_rng(1), 38
    time, load = np.tile(np.arange(0.5, 10.0, 0.25), 3), np.repeat([3.0, 4.0, 5.0], n)
    noise = rng.standard_normal((3, n))
    for i in range(1, n):
        noise[:, i] = 0.7 * noise[:, i - 1] + np.sqrt(0.51) * noise[:, i]
    z = 4.0 * load * (1.0 - np.exp(-time / 2.5)) - 1.0 + 0.3 * noise.ravel()
    rows = rng.permutation(3 * n)
    run, order = np.repeat([1.0, 2.0, 3.0], n), np.tile(np.arange(n) + 1.0, 3)
    columns = {"normal_load_kn": load, "time_s": time, "rut_depth_mm": z, "run": run,
               "run_order": order}  # fmt: skip
    return calib.table_from_arrays({name: v[rows] for name, v in columns.items()})


@pytest.mark.slow
def test_series_have_the_likelihood_of_the_simulator_and_its_correlated_noise() -> None:
    calls = []

    def counted(theta: np.ndarray, x: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        calls.append(x["time"].size)
        return creep(theta, x)

    series("slow", counted, emulate=True, nodes=4, runs=40, checks=8)
    series("direct")
    series("stepped", on_its_own_steps)
    data = crept()
    emulation = calib.emulated(calib.build_problem("slow", data), seed=1)
    assert emulation.passed, emulation.reasons
    # A run is a call for each of four loads, at all 38 times that were recorded.
    assert calls == [38] * (4 * len(emulation.runs))
    direct = calib.build_problem("direct", data)
    assert direct.names == ("z0", "tau", "rho", "sigma")
    natural = np.array([[4.0, 2.5, 0.6, 0.3]]) * np.exp(
        0.02 * np.random.default_rng(2).standard_normal((40, 4))
    )
    t = direct.priors.to_internal(natural)
    exact = direct.log_prob(t)
    assert np.ptp(exact) > 5.0
    assert np.ptp(emulation.problem.log_prob(t) - exact) < 0.1
    stepped = calib.build_problem("stepped", data).log_prob(t)
    np.testing.assert_allclose(stepped, exact, atol=0.01)
    # Of the noise's own covariance and the emulator's, it is the normal density of the rows.
    location, unknown, curves = emulation.problem.bound.model.uncertain(  # type: ignore[misc]
        natural[:1, :2], direct.conditions
    )
    gap = np.abs(data["run_order"][:, None] - data["run_order"])
    noise = np.where(data["run"][:, None] == data["run"], natural[0, 2] ** gap, 0.0)
    covariance = natural[0, 3] ** 2 * noise + unknown[0] * curves @ curves.T
    off = direct.response - location[0]
    value = -0.5 * (off @ np.linalg.solve(covariance, off))
    value -= 0.5 * (np.linalg.slogdet(covariance)[1] + off.size * np.log(2.0 * np.pi))
    found = emulation.problem.log_likelihood(t[:1])
    assert float(found[0]) == pytest.approx(value, abs=1e-6)
    assert emulation.problem.bound.report(natural[:, :2])["half"] == pytest.approx(
        natural[:, 1] / 2.0
    )


def test_an_output_below_zero_has_a_value_where_its_noise_is_additive() -> None:
    def rises(theta: np.ndarray, x: dict[str, np.ndarray]) -> np.ndarray:
        return theta[:, :1] * (x["slip_ratio"] - 0.2)

    signed = {"column": "rut_depth_mm", "response": "identity"}
    for name, output, unit in (("plain", "rut_depth_mm", "1"), ("signed", signed, "mm")):
        calib.register(
            calib.from_callable(
                rises, name=name, parameters=priors({"sigma": (1.0, unit)}, a=10.0),
                conditions=["slip_ratio"], output={"z": output},
            )
        )  # fmt: skip
    at, theta = {"slip_ratio": np.array([0.1, 0.3])}, np.array([[10.0]])
    found = {n: MODELS[n].bind(at).mean_response(theta, at)[0] for n in ("plain", "signed")}
    np.testing.assert_allclose(found["plain"], [np.nan, 0.0], atol=1e-12)
    np.testing.assert_allclose(found["signed"], [-1.0, 1.0])


@pytest.mark.parametrize(
    ("formula", "words"),
    [
        ("tau / 2 +", "cannot be read"),
        ("open('x')", "is not known"),
        ("tau.real", "is not known"),
        ("__import__('os')", "is not known"),
        ("b_front", "'b_front' is not known"),
    ],
)
def test_a_formula_is_arithmetic_only(formula: str, words: str) -> None:
    with pytest.raises(CalibError, match=r"derived\.half") as caught:
        calib.from_callable(
            creep, name="bad", parameters=SERIES, conditions=["normal_load_kn"],
            output="rut_depth_mm", derived={"half": formula},
        )  # fmt: skip
    assert words in str(caught.value)


def test_series_along_what_is_no_condition_are_refused() -> None:
    with pytest.raises(CalibError, match="'time' is no condition"):
        calib.from_callable(
            creep, name="bad", parameters=SERIES, conditions=["normal_load_kn"],
            output="rut_depth_mm", along="time",
        )  # fmt: skip
