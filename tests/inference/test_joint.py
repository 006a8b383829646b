"""Several outputs or groups, one posterior: against closed forms, quadrature and separate fits."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import stats

import calib
from calib.errors import CalibError
from calib.inference.joint import JointCalibration, build_joint, calibrate_joint
from calib.inference.sampler import SamplerSettings
from calib.models import MODELS
from calib.models.base import Model
from tests.registered import forgotten

N_GROUPS, N_ROWS, SIGMA = 8, 5, 0.3
PRIOR = """
model = "{name}"
[parameters.a]
dist = "normal"
mean = 0.0
sd = 3.0
unit = "kN"
reason = "wide"
source = "this test"
[parameters.b]
dist = "normal"
mean = 0.0
sd = 2.0
unit = "kN"
reason = "wide"
source = "this test"
[parameters.sigma]
{sigma}
unit = "{unit}"
reason = "known"
source = "this test"
"""


def line(name: str, output: str, sigma: str, unit: str = "kN", sign: float = 1.0) -> Model:
    return Model(
        name, "a line", output, ("slip_ratio",), ("a", "b"),
        predict=lambda theta, x: theta[:, :1] + sign * theta[:, 1:] * x["slip_ratio"],
        meanings={"a": "level", "b": "slope"}, reported={"a": "kN", "b": "kN"},
        priors=PRIOR.format(name=name, sigma=sigma, unit=unit),
    )  # fmt: skip


@pytest.fixture(autouse=True, scope="module")
def lines() -> Iterator[None]:
    known = 'dist = "fixed"\nvalue = 0.3'
    free = 'dist = "lognormal"\nmedian = 0.3\nsd_log = 1.0'
    some = [
        line("known_line", "drawbar_pull_kn", known),
        line("pull_line", "drawbar_pull_kn", free),
        line("torque_line", "driving_torque_knm", free, unit="kN*m", sign=-1.0),
    ]
    with forgotten(MODELS):
        for model in some:
            model.register()
        yield


def rows(between: float, seed: int = 3) -> tuple[pd.DataFrame, np.ndarray]:
    """Levels that differ between groups, one slope; the data, and the levels."""
    rng = np.random.default_rng(seed)
    level = 1.0 + between * rng.standard_normal(N_GROUPS)
    group = np.repeat(np.arange(N_GROUPS), N_ROWS)
    slip = np.tile(np.linspace(0.0, 0.4, N_ROWS), N_GROUPS)
    pull = level[group] + 2.0 * slip + SIGMA * rng.standard_normal(group.size)
    bins = [f"bin {g}" for g in group]
    return pd.DataFrame({"slip_ratio": slip, "drawbar_pull_kn": pull, "bin": bins}), level


def exact(data: pd.DataFrame) -> dict[str, tuple[float, float]]:
    """Mean and sd of every parameter by quadrature over tau; the rest is linear and normal."""
    slip, pull = data["slip_ratio"].to_numpy(), data["drawbar_pull_kn"].to_numpy()
    member = (data["bin"].to_numpy()[:, None] == np.unique(data["bin"])).astype(float)
    # Coordinates: the mean, the slope, and each group's level.
    design = np.column_stack([np.zeros_like(slip), slip, member])
    grid = np.exp(np.linspace(np.log(1e-4), np.log(20.0), 1500))
    rate, logs, means, variances = -np.log(0.05) / 3.0, [], [], []
    for tau in grid:
        prior = np.zeros((design.shape[1],) * 2)
        prior[0, 0], prior[1, 1] = 9.0, 4.0
        prior[2:, 2:], prior[0, 2:], prior[2:, 0] = 9.0, 9.0, 9.0
        prior[2:, 2:] += tau**2 * np.eye(N_GROUPS)
        of_data = design @ prior @ design.T + SIGMA**2 * np.eye(slip.size)
        gain = np.linalg.solve(of_data, design @ prior).T
        means.append(gain @ pull)
        variances.append(np.diag(prior - gain @ design @ prior))
        logs.append(
            stats.multivariate_normal(np.zeros(slip.size), of_data).logpdf(pull)
            + stats.expon(scale=1.0 / rate).logpdf(tau) + np.log(tau)
        )  # fmt: skip
    weight = np.exp(np.array(logs) - max(logs))
    weight /= weight.sum()
    means, variances = np.array(means), np.array(variances)
    mean = weight @ means
    sd = np.sqrt(weight @ (variances + means**2) - mean**2)
    of_tau = weight @ grid
    names = ["a", "b", *(f"a[bin {g}]" for g in range(N_GROUPS))]
    found = dict(zip(names, zip(mean, sd, strict=True), strict=True))
    return {**found, "tau_a": (of_tau, np.sqrt(weight @ grid**2 - of_tau**2))}


@pytest.mark.slow
@pytest.mark.parametrize("between", [0.0, 0.1, 1.0])
def test_groups_are_pooled_as_quadrature_says(between: float) -> None:
    data, _ = rows(between)
    found = calibrate_joint(build_joint({"known_line": data}, group="bin", pooled=["a"]), seed=1)
    assert found.converged
    for name, (mean, sd) in exact(data).items():
        s = found.summary[name]
        assert s.mean == pytest.approx(mean, abs=0.08 * sd)
        assert s.sd == pytest.approx(sd, rel=0.08)


@pytest.fixture(scope="module")
def pooled() -> JointCalibration:
    data, _ = rows(1.0)
    return calibrate_joint(build_joint({"pull_line": data}, group="bin", pooled=["a"]), seed=1)


def test_a_known_group_is_predicted_better_than_a_new_one(pooled: JointCalibration) -> None:
    at = pd.DataFrame({"slip_ratio": [0.2]})
    known = calib.predict(pooled.calibration("drawbar_pull", "bin 2"), at).parameter
    new = calib.predict(pooled.calibration("drawbar_pull"), at).parameter
    width_known, width_new = (b.upper[0.9] - b.lower[0.9] for b in (known, new))
    assert width_new > 4.0 * width_known
    tau, mu = pooled.summary["tau_a"], pooled.summary["a"]
    # A new group lies about the mean by the sd between groups, and what is not known of both.
    drawn = pooled.calibration("drawbar_pull").parameters["a"]
    assert drawn.std() == pytest.approx(np.hypot(np.hypot(tau.mean, tau.sd), mu.sd), rel=0.1)


def test_a_group_is_saved_and_read_as_a_run(pooled: JointCalibration, tmp_path) -> None:
    group = pooled.calibration("drawbar_pull", "bin 2")
    calib.save_calibration(group, tmp_path / "run")
    again = calib.load_calibration(tmp_path / "run")
    at = pd.DataFrame({"slip_ratio": [0.2]})
    one, other = (calib.predict(c, at).predictive.median for c in (group, again))
    assert one == pytest.approx(other, rel=1e-9)
    # What was sampled together is not sampled again alone.
    found = calib.check(tmp_path / "run")
    assert {i.status.value for i in found.items} <= {"identical", "not judged"}
    assert any(
        "part of a joint posterior (drawbar_pull in 8 groups)" in i.note for i in found.items
    )


def two_outputs(seed: int = 5) -> pd.DataFrame:
    rng = np.random.default_rng(seed)
    slip = np.linspace(0.0, 0.4, 12)
    pull = 1.0 + 2.0 * slip + 0.3 * rng.standard_normal(12)
    torque = 1.0 - 2.0 * slip + 0.3 * rng.standard_normal(12)
    return pd.DataFrame({"slip_ratio": slip, "drawbar_pull_kn": pull, "driving_torque_knm": torque})


def test_outputs_that_share_parameters_are_worth_more_together() -> None:
    data = two_outputs()
    joint = build_joint({"pull_line": data, "torque_line": data})
    assert joint.shared == dict.fromkeys(("a", "b"), ("drawbar_pull", "driving_torque"))
    assert joint.names == ("a", "b", "sigma_drawbar_pull", "sigma_driving_torque")
    found = calibrate_joint(joint, seed=1)
    assert found.converged
    alone = calib.calibrate(calib.build_problem("pull_line", data), seed=1)
    # Level and slope are confounded in one output, and not in both.
    for name in ("a", "b"):
        assert found.summary[name].sd < 0.75 * alone.summary[name].sd
    # With noise of one scale: least squares of both outputs.
    design = np.column_stack([np.ones(24), np.tile(data["slip_ratio"], 2)])
    design[12:, 1] *= -1.0
    y = np.concatenate([data["drawbar_pull_kn"], data["driving_torque_knm"]])
    best = np.linalg.lstsq(design, y)[0]
    for name, value in zip(("a", "b"), best, strict=True):
        s = found.summary[name]
        assert abs(s.mean - value) < 0.5 * s.sd
    assert set(found.outputs) == {"drawbar_pull", "driving_torque"}


def test_rows_without_an_output_do_not_count_for_it() -> None:
    data = two_outputs()
    data.loc[8:, "driving_torque_knm"] = np.nan
    joint = build_joint({"pull_line": data, "torque_line": data})
    assert [len(p.problem.table) for p in joint.parts.values()] == [12, 8]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"pooled": ["a"]}, "belong together"),
        ({"group": "bin"}, "belong together"),
        ({"group": "bin", "pooled": ["z"]}, "no parameter that can differ between groups: z"),
        ({"group": "bin", "pooled": ["sigma"]}, "can differ between groups: sigma"),
        ({"group": "run", "pooled": ["a"]}, "there is no column 'run'"),
        ({"group": "two", "pooled": ["a"]}, "has 2 different values"),
    ],
)
def test_what_cannot_be_grouped_is_refused(change: dict[str, object], said: str) -> None:
    data, _ = rows(1.0)
    data["two"] = ["x", "y"] * (len(data) // 2)
    with pytest.raises(CalibError, match=said):
        build_joint({"pull_line": data}, **change)


def test_two_models_of_one_output_and_two_priors_of_one_parameter_are_refused(tmp_path) -> None:
    data = two_outputs()
    with pytest.raises(CalibError, match="two models predict the same readings of drawbar_pull"):
        build_joint({"pull_line": data, "known_line": data})
    mine = tmp_path / "mine.toml"
    mine.write_text('model = "pull_line"\n[parameters.a]\ndist = "normal"\nmean = 0.0\nsd = 1.0\n'
                    'unit = "kN"\nreason = "narrow"\nsource = "this test"\n')  # fmt: skip
    with pytest.raises(CalibError, match="a is one parameter and has two priors"):
        build_joint({"pull_line": data, "torque_line": data}, priors={"pull_line": mine})


@pytest.mark.slow
def test_simulation_based_calibration_of_groups() -> None:
    """Ranks of the truth among draws are uniform, over 200 simulations from the prior."""
    rng, ranks = np.random.default_rng(11), []
    rate = -np.log(0.05) / 3.0
    group, slip = np.repeat(np.arange(5), 4), np.tile(np.linspace(0.0, 0.4, 4), 5)
    for i in range(200):
        a, b, tau = rng.normal(0.0, 3.0), rng.normal(0.0, 2.0), rng.exponential(1.0 / rate)
        level = a + tau * rng.standard_normal(5)
        pull = level[group] + b * slip + SIGMA * rng.standard_normal(20)
        data = pd.DataFrame({"slip_ratio": slip, "drawbar_pull_kn": pull, "bin": group.astype(str)})
        joint = build_joint({"known_line": data}, group="bin", pooled=["a"])
        found = calibrate_joint(joint, seed=i, settings=SamplerSettings(walkers=64))
        truth = {"a": a, "b": b, "tau_a": tau, "a[0]": level[0]}
        ranks.append([np.mean(found.parameters[n] < v) for n, v in truth.items()])
    for column in np.array(ranks).T:
        assert stats.kstest(column, "uniform").pvalue > 0.01


@pytest.mark.slow
def test_wheel_and_plates_of_one_sand() -> None:
    """A rigid wheel and plates on the sand of Carnegie Mellon University, a third held out.

    Plates narrow the sinkage of the wheel; held-out readings are covered as by separate fits.
    """
    data = Path(__file__).parents[2] / "challenge" / "measured" / "data"
    wheel = pd.read_csv(data / "cmu_wheel.csv").query("series == 'smooth_0' and slip_ratio >= 0")
    wheel = wheel.drop(columns="series").sort_values("slip_ratio").reset_index(drop=True)
    plates = pd.read_csv(data / "cmu_plate.csv").query("series.str.startswith('large')")
    plates = plates.drop(columns="series")
    narrower, covered = [], np.zeros(2)
    for fold in range(3):
        held, rest = wheel[wheel.index % 3 == fold], wheel[wheel.index % 3 != fold]
        models = {"wong_reece_pull": rest, "wong_reece_sinkage": rest, "reece_plate": plates}
        found = calibrate_joint(build_joint(models), seed=1)
        for model, output in (
            ("wong_reece_pull", "drawbar_pull"), ("wong_reece_sinkage", "wong_reece_sinkage")
        ):  # fmt: skip
            alone = calib.calibrate(calib.build_problem(model, rest, others=len(rest)), seed=1)
            widths = []
            for i, one in enumerate((alone, found.calibration(output))):
                assert one.converged
                covered[i] += calib.validate_held_out(one, held).scores.coverage[0.9].hits
                bands = calib.predict(one, held).parameter
                widths.append(float(np.mean(bands.upper[0.9] - bands.lower[0.9])))
            narrower += [widths[1] / widths[0]] if model == "wong_reece_sinkage" else []
    assert max(narrower) < 1.0
    assert covered.min() >= 21  # of 24; at 90 %, 19 to 24 have a probability of 0.98
