"""Many realities at once must be what each is alone, and banks what the mechanics say."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.stats import kstest

from calib.challenge.contact import settle
from calib.challenge.effects import LISTED, UNLISTED
from calib.challenge.oracle.bank import add_nodes, gaps_at, open_bank
from calib.challenge.oracle.causes import causes_of
from calib.challenge.oracle.lab import after_lab
from calib.challenge.oracle.proposal import Proposal
from calib.challenge.oracle.site import Site
from calib.challenge.record import read_stage, stage_record
from calib.challenge.shift import draw_shift, shifted
from tests.challenge.oracle.stages import noisy, stage_with

WHEEL = ("drawbar_pull", "rut_depth")


def test_a_recorded_stage_is_the_stage() -> None:
    """What a key holds gives the same design, readings and noise."""
    stage = stage_with(WHEEL)
    again = read_stage(json.loads(json.dumps(stage_record(stage), sort_keys=True)))
    assert again.design == stage.design
    assert again.design.outputs == stage.design.outputs
    for name in WHEEL:
        assert again.field_without[name] == pytest.approx(stage.field_without[name], rel=1e-8)
        assert again.lab_sd[name] == pytest.approx(stage.lab_sd[name], rel=1e-8)
        assert again.simulator.theta[name] == pytest.approx(stage.simulator.theta[name])


def test_settling_from_near_by_ends_at_the_same_place() -> None:
    """A first guess changes the number of steps and nothing else."""
    stage, field = stage_with(WHEEL), stage_with(WHEEL).field
    soil = stage.reality.soil.scaled(support=1.7)
    at = soil, stage.reality.tyre, field.slip, field.inflation_kpa, field.load_kn
    for near in (0.004, 0.02, 0.09):
        got = settle(*at, near_m=np.full(field.size, near)).sinkage_m
        assert got == pytest.approx(settle(*at).sinkage_m, rel=1e-8)


def test_gaps_of_many_realities_are_those_of_each() -> None:
    """Every mechanism, alone, in pairs and as a shift: as `Stage.in_field` has it."""
    stage, rng = stage_with(WHEEL), np.random.default_rng(0)
    families = [kind.draw(rng) for kind in (*LISTED.values(), *UNLISTED)]
    mechanisms = [f.at(float(np.sqrt(f.low * f.high))) for f in families]
    realities = [stage.reality.with_mechanisms(m) for m in mechanisms]
    realities += [
        stage.reality.with_mechanisms(*pair)
        for pair in zip(mechanisms, mechanisms[3:], strict=False)
    ]
    realities += [shifted(stage.reality, draw_shift(rng)[0], 0.4) for _ in range(5)]
    got = Site(stage).gaps(realities)
    for row, reality in zip(got, realities, strict=True):
        assert row == pytest.approx(stage.gap(stage.in_field(reality)), abs=2e-6)


@pytest.mark.parametrize(
    "state", ["rate_effect", "rut_rebound", "sensor_drift", "unknown:clipping"]
)
def test_between_knots_gaps_are_as_simulated(state: str) -> None:
    """Interpolated along the strength, a gap misses the exact one by a tenth of a noise sd."""
    stage, rng = stage_with(WHEEL), np.random.default_rng(1)
    site = Site(stage)
    bank = open_bank(site, causes_of(state)[0], float(np.log(1.3)), rng)
    for node in range(0, len(bank.weight), max(1, len(bank.weight) // 4)):
        low, high = bank.size[node, 0], min(bank.size[node, -1], np.log(6.0))
        if high < low + 0.2:
            continue
        for size in rng.uniform(low, high, 3):
            knots = bank.between(np.full((len(bank.weight), 1), size))[node, 0]
            strength = np.array([knots @ bank.strength[node]])
            exact = gaps_at(site, bank.cause, bank.dials[[node]], strength)[0]
            rms = np.sqrt(np.mean(exact**2))
            again = bank.between(np.full((len(bank.weight), 1), np.log(rms)))[node, 0]
            miss = rms * (again @ bank.shape[node]) - exact
            assert np.sqrt(np.mean(miss**2)) < 0.1


def test_added_nodes_leave_the_prior_what_it_was() -> None:
    """Weights of a refined bank still average the dials' moments to those of their prior."""
    stage, rng = stage_with(WHEEL), np.random.default_rng(2)
    site = Site(stage)
    cause = next(c for c in causes_of("rate_effect") if c.sign > 0.0)
    bank = open_bank(site, cause, float(np.log(2.1)), rng)
    d = bank.dials.shape[1]
    where = Proposal(np.ones(1), np.full((1, d), 0.7), 0.25 * np.eye(d)[None])
    for _ in range(3):
        bank = add_nodes(site, bank, where, 64, float(np.log(2.1)), rng)
    assert bank.weight.sum() == pytest.approx(1.0, abs=0.15)
    assert bank.weight @ bank.dials / bank.weight.sum() == pytest.approx(np.full(d, 0.5), abs=0.08)


def test_draws_that_all_miss_the_dials_range_add_no_node() -> None:
    """They count in the mixture, where they have next to no density, and change nothing else."""
    stage, rng = stage_with(WHEEL), np.random.default_rng(2)
    site = Site(stage)
    cause = next(c for c in causes_of("rate_effect") if c.sign > 0.0)
    bank = open_bank(site, cause, float(np.log(2.1)), rng)
    d = bank.dials.shape[1]
    nowhere = Proposal(np.ones(1), np.full((1, d), 1e6), 1e-3 * np.eye(d)[None])
    after = add_nodes(site, bank, nowhere, 8, float(np.log(2.1)), rng)
    assert np.array_equal(after.dials, bank.dials)
    assert after.weight == pytest.approx(bank.weight)
    assert after.drawn == (*bank.drawn, (8, nowhere))


@pytest.mark.parametrize("labs", [2, pytest.param(8, marks=pytest.mark.slow)])
def test_after_the_lab_the_field_is_standard_normal(labs: int) -> None:
    """Whitened residuals of undisturbed fields are normal: chi-squared, over many stages."""
    rng, shares = np.random.default_rng(4), []
    for seed in range(8):
        stage = stage_with(WHEEL if seed % 2 else ("drawbar_pull",), "hard", seed)
        for _ in range(labs):
            lab = noisy(rng, stage.lab_readings, stage.lab_sd)
            residual = rng.standard_normal(len(stage.design.outputs) * stage.field.size)
            view = after_lab(stage, lab, residual)
            shares.append((view.residual @ view.residual - residual.size) / residual.size**0.5)
            assert np.linalg.eigvalsh(view.whitener @ view.whitener.T).max() <= 1.0 + 1e-9
    assert kstest(np.array(shares) / np.sqrt(2.0), "norm").pvalue > 1e-3
