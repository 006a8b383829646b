"""Replicates: pure, and calibrated; a wrong posterior is found."""

from __future__ import annotations

import json
import pickle
from dataclasses import replace

import numpy as np
import pytest

from calib.inference.calibration import Calibration
from calib.inference.prior_files import DeclaredPriors, default_priors
from calib.models import MODELS
from calib.validation.replicate import Item, calibrated, design_of, measure, replicate, simulated
from calib.validation.sbc import SETTINGS, score, score_model

# One chance in ten thousand of a false alarm in all quantities together.
RARE = 1e-4
SEED, CHEAP, FEW, FEWEST = 40, "bekker", 24, 6


def narrowed(calibration: Calibration, factor: float) -> Calibration:
    """The posterior drawn towards its mean, as a sampler that is too sure of itself would."""
    t = calibration.draws.t
    mean = t.reshape(-1, t.shape[-1]).mean(axis=0)
    return replace(calibration, draws=replace(calibration.draws, t=mean + factor * (t - mean)))


def records(model: str, n: int, factors: tuple[float, ...]) -> dict[float, list[dict]]:
    """Records of right posteriors (factor one) and of narrowed ones, from the same campaigns."""
    found: dict[float, list[dict]] = {factor: [] for factor in factors}
    for i in range(n):
        item = Item(model, i, SEED, SETTINGS)
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
def few() -> dict[float, list[dict]]:
    return records(CHEAP, FEW, (1.0, 0.5))


@pytest.fixture(scope="module")
def fewest() -> list[dict]:
    """As many as are counted and left out, which takes no more."""
    return records(CHEAP, FEWEST, (1.0,))[1.0]


@pytest.mark.slow
def test_a_few_posteriors_of_the_cheapest_model_are_calibrated(few) -> None:
    found = score_model(few[1.0])
    assert found.unconverged == 0
    assert len(found.quantities) == 3 + 1 + len(("log_likelihood", "prediction", "measurement"))
    # Exact p values, so the level holds for few replicates as for any number.
    assert min(q.p for q in found.quantities) * len(found.quantities) > RARE
    for band in found.coverage:
        assert abs(band.proportion - band.level) < 4.5 * band.se


@pytest.mark.slow  # quick with exact draws (`test_power`)
def test_posteriors_half_as_wide_are_found(few) -> None:
    found = score_model(few[0.5])
    assert min(q.p for q in found.quantities) * len(found.quantities) < RARE


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


def test_a_replicate_is_a_pure_function_of_its_item() -> None:
    item = Item(CHEAP, 3, 7, SETTINGS)
    first, again = replicate(item), replicate(pickle.loads(pickle.dumps(item)))
    assert first == again
    assert json.loads(json.dumps(first, allow_nan=False)) == first
    other = replicate(Item(CHEAP, 4, 7, SETTINGS))
    assert other["ranks"] != first["ranks"]
    below, draws = np.array(list(first["ranks"].values())).T
    assert np.all((below >= 0) & (below <= draws))
    assert first["rows"] + first["no_band"] == 9
    assert set(first["covered"]) == {"50", "90", "95"}


def test_one_that_does_not_converge_is_counted_and_left_out(fewest) -> None:
    spoilt = [dict(r) for r in fewest]
    spoilt[5] = {**spoilt[5], "converged": False}
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
