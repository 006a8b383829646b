"""Simulated campaigns and their posteriors: truths from the prior, pure, and calibrated."""

from __future__ import annotations

import json
import pickle
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

import calib
from calib.data import table_from_arrays
from calib.errors import CalibError
from calib.inference.calibration import Calibration
from calib.inference.prior_files import DeclaredPriors, default_priors
from calib.inference.problem import build_problem
from calib.inference.sampler import SamplerSettings
from calib.models import MODELS
from calib.validation.replicate import (
    Item,
    calibrated,
    design_of,
    measure,
    replicate,
    simulate,
    simulated,
)
from calib.validation.sbc import SETTINGS, run_sbc, score, score_model
from tests.inference.emulation.test_emulate import as_before as as_before
from tests.models.simulators.examples import PRIORS, lab, pull


@pytest.mark.parametrize("model", MODELS)
def test_a_design_is_the_embedded_one_and_is_held_out_inside_it(model: str) -> None:
    design = design_of(model)
    problem = build_problem(model, design.table)
    assert set(design.held) == set(problem.bound.model.conditions)
    assert len({v.size for v in design.held.values()}) == 1
    table_from_arrays(design.held)  # checked as a file is
    for name, values in problem.conditions.items():
        assert values.min() <= design.held[name].min()
        assert design.held[name].max() <= values.max()
    assert 0 <= design.watched < next(iter(design.held.values())).size
    fitted = np.column_stack([problem.conditions[n] for n in design.held])
    held = np.column_stack(list(design.held.values()))
    assert not (held[:, None] == fitted).all(axis=2).any()
    assert str(len(fitted)) in design.text
    assert str(len(held)) in design.text


@pytest.mark.parametrize("model", ["bekker", "ayers_perumpral"])
def test_truths_are_the_priors_and_noise_is_normal(model: str) -> None:
    design = design_of(model)
    template = build_problem(model, design.table)
    rng = np.random.default_rng(1)
    cases = [simulate(template, design, rng) for _ in range(400)]
    truths = np.array([c.truth for c in cases])
    for j in range(template.n_dim):
        grid = template.priors.ppf(np.tile(np.linspace(0, 1, 2002)[1:-1, None], template.n_dim))
        assert stats.ks_2samp(truths[:, j], grid[:, j]).pvalue > 1e-4, template.names[j]
    z = []
    for case in cases:
        natural = template.theta(case.truth[None])
        residual = case.problem.residuals(natural)[0]
        z.append(residual / natural[0, -1])
        back = template.bound.to_response
        held = back(case.measured) - back(case.location)
        z.append(held / natural[0, -1])
    flat = np.concatenate(z)
    assert stats.kstest(flat, "norm").pvalue > 1e-4
    # Neighbouring rows share nothing.
    assert abs(np.corrcoef(flat[:-1], flat[1:])[0, 1]) < 5.0 / np.sqrt(flat.size)


def test_parameters_without_a_value_are_drawn_again() -> None:
    """Negative exponents give no rut; the truths are the prior's where there is one."""
    design = design_of("modified_bekker")
    template = build_problem("modified_bekker", design.table)
    rng = np.random.default_rng(3)
    cases = [simulate(template, design, rng) for _ in range(300)]
    drawn = template.priors.sample(np.random.default_rng(4), 20_000)
    natural = template.theta(drawn)
    defined = np.isfinite(template.bound.mean_response(natural[:, :-1], template.conditions)).all(
        axis=1
    )
    attempts = np.array([c.attempts for c in cases])
    assert abs(1.0 / attempts.mean() - defined.mean()) < 0.02
    j = template.names.index("n1")
    truths = np.array([c.truth[j] for c in cases])
    assert stats.ks_2samp(truths, drawn[defined, j]).pvalue > 1e-4


def test_simulated_outputs_replace_the_embedded_ones() -> None:
    design = design_of("modified_bekker")
    template = build_problem("modified_bekker", design.table)
    case = simulate(template, design, np.random.default_rng(1))
    assert not (case.problem.observed == template.observed).any()
    assert case.problem.table.label == "simulated"
    assert case.problem.bound is template.bound
    for name, values in template.conditions.items():
        np.testing.assert_array_equal(case.problem.conditions[name], values)


# One chance in ten thousand of a false alarm in all quantities together.
RARE = 1e-4
SEED, CHEAP, FEWEST = 40, "bekker", 3


def narrowed(calibration: Calibration, factor: float) -> Calibration:
    """The posterior drawn towards its mean, as a sampler that is too sure of itself would."""
    t = calibration.draws.t
    mean = t.reshape(-1, t.shape[-1]).mean(axis=0)
    return replace(calibration, draws=replace(calibration.draws, t=mean + factor * (t - mean)))


# Where it does not matter how well replicates converge.
QUICK = SamplerSettings(steps=100, max_steps=400)


def records(
    model: str, n: int, factors: tuple[float, ...], settings: SamplerSettings = SETTINGS
) -> dict[float, list[dict]]:
    """Records of right posteriors (factor one) and of narrowed ones, from the same campaigns."""
    found: dict[float, list[dict]] = {factor: [] for factor in factors}
    for i in range(n):
        item = Item(model, i, SEED, settings)
        case = simulated(item)
        calibration = calibrated(case, item)
        about = {
            "model": model, "index": i, "seed": SEED, "attempts": case.attempts, "steps": 0,
            "converged": calibration.converged, "extended": False,
        }  # fmt: skip
        for factor in factors:
            told = calibration if factor == 1.0 else narrowed(calibration, factor)
            found[factor].append({**about, **measure(case, told, design_of(model))})
    return found


@pytest.fixture(scope="module")
def fewest() -> list[dict]:
    """As many as are counted and left out, which takes no more."""
    return records(CHEAP, FEWEST, (1.0,), QUICK)[1.0]


@pytest.mark.slow
def test_posteriors_a_fifth_too_narrow_are_found() -> None:
    run = records(CHEAP, 300, (1.0, 0.8))
    right, wrong = (score(run[factor], SEED, 300) for factor in (1.0, 0.8))
    assert not right.alarms
    assert wrong.alarms
    assert min(wrong.adjusted.values()) < RARE


@pytest.mark.slow
@pytest.mark.parametrize("model", MODELS)
def test_three_hundred_posteriors_of_every_model_are_calibrated(model: str) -> None:
    found = score([replicate(Item(model, i, SEED, SETTINGS)) for i in range(300)], SEED, 300)
    (only,) = found.models
    assert only.unconverged <= 15
    # Six models: the family-wise level of the whole test is six times this.
    assert min(found.adjusted.values()) > 1e-3, found.alarms


@pytest.mark.slow
@pytest.mark.parametrize(
    "likelihood", ['family = "student_t"', 'noise_depends_on = "slip"'], ids=["student_t", "uneven"]
)
def test_two_hundred_posteriors_of_another_noise_are_calibrated(likelihood: str) -> None:
    model = "modified_bekker"
    text = default_priors(model).read_text(encoding="utf-8")
    priors = DeclaredPriors("mine.toml", f"{text}\n[likelihood]\n{likelihood}\n")
    done = [replicate(Item(model, i, SEED, SETTINGS, priors)) for i in range(200)]
    found = score(done, SEED, 200)
    (only,) = found.models
    assert only.unconverged <= 10
    assert {"nu", "sigma_slope"} & {q.name for q in only.quantities}
    assert min(found.adjusted.values()) > 1e-3, found.alarms


def test_a_replicate_is_a_pure_function_of_its_item(fewest) -> None:
    item = Item(CHEAP, 0, SEED, QUICK)
    found = replicate(pickle.loads(pickle.dumps(item)))
    assert {key: found[key] for key in fewest[0] if key != "steps"} == {
        key: value for key, value in fewest[0].items() if key != "steps"
    }
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert fewest[1]["ranks"] != found["ranks"]
    below, draws = np.array(list(found["ranks"].values())).T
    assert np.all((below >= 0) & (below <= draws))
    assert found["rows"] + found["no_band"] == 9
    assert set(found["covered"]) == {"50", "90", "95"}


def test_one_that_does_not_converge_is_counted_and_left_out(fewest) -> None:
    spoilt = [dict(r) for r in fewest]
    spoilt[2] = {**spoilt[2], "converged": False}
    whole, found = score_model(fewest), score_model(spoilt)
    assert found.replicates == FEWEST
    assert found.unconverged == 1
    for a, b in zip(whole.quantities, found.quantities, strict=True):
        assert b.pit.size == FEWEST - 1
        assert b.p_all == a.p


def test_a_truth_without_a_value_is_left_out_of_its_quantity_alone(fewest) -> None:
    lacking = [dict(r) for r in fewest]
    lacking[0] = {
        **lacking[0],
        "ranks": {k: v for k, v in lacking[0]["ranks"].items() if k != "prediction"},
        "rows": 0, "covered": {},
    }  # fmt: skip
    found = score_model(lacking)
    sizes = {q.name: q.pit.size for q in found.quantities}
    assert sizes.pop("prediction") == FEWEST - 1
    assert set(sizes.values()) == {FEWEST}
    assert found.coverage[0].replicates == FEWEST - 1


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
        run_sbc(
            tmp_path / "sbc", models=["slow"], simulations=1, seed=7, data=data(tmp_path),
            settings=QUICK,
        )  # fmt: skip
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
