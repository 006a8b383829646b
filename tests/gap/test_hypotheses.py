"""The hypotheses themselves: what may be unlisted, and what another soil changes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.data import table_from_arrays
from calib.gap.case import Case, campaigns
from calib.gap.diagnose import diagnose, diagnose_once
from calib.gap.effects import EFFECTS
from calib.gap.forward import Forward
from calib.gap.hypotheses import (
    SHIFTS,
    dependences,
    inseparable,
    joined,
    resized,
    shifts,
    singles,
    unknowns,
    wider,
    with_remainder,
)
from calib.gap.hypothesis import Hypothesis
from calib.report.gap_sizes import size_sentences
from tests.gap.cases import MODELS, NOISE, PULL_ONLY, campaigns_of, make_case, table_without

SIGMA = {o: NOISE[o] for o in MODELS}


@pytest.fixture(scope="module")
def data():
    return campaigns_of(None)


def lab_mode(data) -> dict[str, np.ndarray]:
    return {o.name: np.array([p.loc for p in o.priors.free]) for o in data.outputs}


def of_low_pressure(data) -> list[Hypothesis]:
    return [h for h in unknowns(data) if h.onset_over == "low_pressure"]


def test_shares_of_a_name_sum_to_one(data):
    assert sum(h.share for h in unknowns(data)) == pytest.approx(1.0)
    (single,) = singles(data, {"force_offset": EFFECTS["force_offset"]})
    beside = with_remainder(data, single)
    assert sum(h.share for h in beside) == pytest.approx(1.0)
    assert {h.name for h in beside} == {"force_offset+unknown"}


@pytest.mark.parametrize("outputs", ["both", "pull"])
def test_nothing_unlisted_is_counted_twice(outputs):
    found = unknowns(campaigns_of(None, outputs))
    kinds = [
        (h.smooth, h.smooth_over, h.smooth_decay, h.onset_over, h.smooth_outputs) for h in found
    ]
    assert len(set(kinds)) == len(kinds)
    touched = {h.smooth_outputs for h in found}
    pull, rut = ("drawbar_pull",), ("rut_depth",)
    assert touched == ({pull} if outputs == "pull" else {pull, rut, pull + rut})


def test_a_wider_prior_has_the_same_middle(data):
    (single,) = singles(data, {"force_offset": EFFECTS["force_offset"]})
    wide = wider(single)
    for a, b in zip(single.effect_priors[0].free, wide.effect_priors[0].free, strict=True):
        assert (b.loc, b.lower, b.upper) == (a.loc, a.lower, a.upper)
        assert b.scale > a.scale
    assert wide.share == pytest.approx(0.1 * single.share)


def test_of_a_set_some_may_be_large_and_none_again(data):
    few = singles(data, {n: EFFECTS[n] for n in ("force_offset", "lug_thrust")})
    pair, usual = joined(*few), {h.name: h.effect_priors[0] for h in few}
    large = resized(pair, usual, ["lug_thrust"])
    assert large.effect_priors == (usual["force_offset"], wider(few[1]).effect_priors[0])
    assert large.share == pytest.approx(0.1 * pair.share)
    assert resized(large, usual, ["force_offset", "lug_thrust"]).share == pytest.approx(0.01)
    again = resized(large, usual, [])
    assert again.effect_priors == pair.effect_priors
    assert again.share == pytest.approx(pair.share)


def test_effects_are_joined_in_alphabetical_order(data):
    few = singles(data, {n: EFFECTS[n] for n in ("sensor_drift", "force_offset", "lug_thrust")})
    assert joined(*few).name == joined(*few[::-1]).name == "force_offset+lug_thrust+sensor_drift"
    assert [e.name for e in joined(*few).effects] == joined(*few).name.split("+")


def test_no_onset_of_one_output_over_slip_or_drift_is_unlisted(data):
    alone = [(h.onset_over, h.smooth_outputs) for h in unknowns(data) if h.onset_over]
    assert ("slip", ("drawbar_pull",)) not in alone
    assert ("slip", ("rut_depth",)) not in alone
    assert ("order", ("drawbar_pull",)) not in alone
    assert ("slip", ("drawbar_pull", "rut_depth")) in alone


def test_something_may_set_in_below_a_pressure_of_each_output_and_of_both(data):
    touched = {h.smooth_outputs for h in of_low_pressure(data)}
    assert touched == {("drawbar_pull",), ("rut_depth",), ("drawbar_pull", "rut_depth")}


def test_nothing_sets_in_below_a_pressure_that_is_constant_or_not_recorded():
    case = make_case(None, models=PULL_ONLY)
    without = replace(
        case, lab=table_without(case.lab, "inflation_pressure_psi"),
        field=table_without(case.field, "inflation_pressure_psi"),
    )  # fmt: skip
    assert not of_low_pressure(campaigns(without))
    columns = {**case.field.columns, "inflation_pressure_psi": np.full(27, 30.0)}
    constant = replace(case, field=replace(case.field, columns=columns))
    assert not of_low_pressure(campaigns(constant))


def test_below_a_pressure_the_output_is_off_by_a_constant_and_by_part_of_its_level(data):
    h = next(h for h in of_low_pressure(data) if h.smooth_outputs == ("drawbar_pull",))
    mode = lab_mode(data)
    forward = Forward(data, h, SIGMA, mode)
    psi = np.array([[p.loc for p in forward.priors.free]] * 2)
    for name, part in forward.theta_slices.items():
        psi[:, part] = mode[name]
    # Pressures 18, 30 and 42 psi are at 1, 0 and -1: only the lowest lies beyond a half.
    psi[:, forward.threshold] = 0.5
    part = forward.smooth_slices["drawbar_pull"]
    psi[0, part], psi[1, part] = (0.1, 0.0), (0.0, 0.1)
    full, plain = forward.field(psi, data.view), forward.simulator(psi, data.view)
    gap = full["drawbar_pull"] - plain["drawbar_pull"]
    np.testing.assert_array_equal(full["rut_depth"], plain["rut_depth"])
    low = data.view.conditions["inflation_pressure_psi"] < 20.0
    assert 0 < low.sum() < low.size
    np.testing.assert_allclose(gap[:, ~low], 0.0, atol=1e-4)
    np.testing.assert_allclose(gap[0, low], 0.1, rtol=1e-3)
    # The second grows in proportion to the predicted pull, from -1 to 1 over the field's range.
    level = np.interp(
        plain["drawbar_pull"][1],
        [plain["drawbar_pull"][1].min(), plain["drawbar_pull"][1].max()], [-1.0, 1.0],
    )  # fmt: skip
    np.testing.assert_allclose(gap[1, low], 0.1 * level[low], rtol=1e-3, atol=1e-5)


def test_parameters_shift_by_themselves_or_as_with_another_soil_in_every_size(data):
    found = {(h.shift, h.shift_as): h.share for h in shifts(data)}
    assert set(found) == {(size, kind) for size in SHIFTS for kind in ("alone", "soil")}
    assert sum(found.values()) == pytest.approx(1.0)
    assert found[SHIFTS[0], "soil"] == pytest.approx(2.0 * found[SHIFTS[0], "alone"])


def density_campaigns(water: str = "gravimetric_water_content", step: float = 0.0):
    """Campaigns of bulk density; beyond a water content of 0.1 the field is off by a step."""
    rng = np.random.default_rng(3)
    tables = []
    for n, off in ((30, 0.0), (36, step)):
        wet, cone = rng.uniform(0.05, 0.2, n), rng.uniform(300.0, 2000.0, n)
        density = 1.2 + 0.05 * np.log(cone / 300.0) + 0.005 * rng.standard_normal(n)
        density += off * (wet > 0.1)
        columns = {water: wet, "cone_index_kpa": cone, "bulk_density_g_cm3": density}
        tables.append(table_from_arrays(columns))
    model = "ayers_perumpral" if water.startswith("grav") else "ayers_perumpral_volumetric"
    return Case("density", tables[0], tables[1], {"bulk_density": model})


def test_densities_know_no_soil_that_moves_wheels():
    data = campaigns(density_campaigns())
    assert [h.shift_as for h in shifts(data)] == ["alone"] * len(SHIFTS)
    assert sum(h.share for h in shifts(data)) == pytest.approx(1.0)


def test_what_water_does_to_a_soil_differs_less_than_its_density():
    data = campaigns(density_campaigns())
    forward = Forward(data, shifts(data)[0], {"bulk_density": 0.02})
    part = forward.priors.free[forward.shift_slice]
    sds = dict(zip(data.outputs[0].priors.names, (p.scale for p in part), strict=True))
    assert sds == pytest.approx({"gamma_ref": 0.1, "C2": 0.02, "C3": 0.02, "C4": 0.1}, rel=1e-12)


@pytest.mark.parametrize("water", ["gravimetric_water_content", "volumetric_water_content"])
def test_density_may_change_beyond_a_water_content_or_a_cone_index(water):
    data = campaigns(density_campaigns(water))
    onsets = [(h.onset_over, h.smooth_outputs) for h in unknowns(data) if h.onset_over]
    assert ("water", ("bulk_density",)) in onsets
    assert ("cone", ("bulk_density",)) in onsets


def test_what_a_density_model_is_bent_by_has_no_mean_over_the_laboratory():
    """Products of conditions from -1 to 1, a square without its mean; of a cone index its log."""
    data = campaigns(density_campaigns())
    (o,), simulated = data.outputs, data.simulated["bulk_density"]
    assert simulated.n_bends == 3
    wet, cone = (o.problem.conditions[n] for n in ("gravimetric_water_content", "cone_index_kpa"))
    u = (np.arange(200) + 0.5) / 200
    at = {
        "gravimetric_water_content": np.repeat(wet.min() + u * np.ptp(wet), 200),
        "cone_index_kpa": np.tile(cone.min() * (cone.max() / cone.min()) ** u, 200),
    }
    t = np.tile([p.loc for p in o.priors.free], (4, 1))
    found = simulated.predict(t, np.vstack([np.zeros(3), np.eye(3)]), at)
    bends = found[1:] - found[0]
    np.testing.assert_allclose(bends.mean(axis=1), 0.0, atol=1e-4)
    # 1 - 1/3 at the ends of a square, 1 at those of a product.
    np.testing.assert_allclose(sorted(np.abs(bends).max(axis=1)), [2 / 3, 2 / 3, 1.0], rtol=0.02)


def test_wheels_know_no_onset_over_probes(data):
    assert not {h.onset_over for h in unknowns(data)} & {"water", "cone"}


def test_nothing_sets_in_over_a_probe_that_stays_the_same():
    case = density_campaigns()
    n = case.field.columns["cone_index_kpa"].size
    columns = {**case.field.columns, "cone_index_kpa": np.full(n, 700.0)}
    data = campaigns(replace(case, field=table_from_arrays(columns)))
    onsets = {h.onset_over for h in unknowns(data)}
    assert "water" in onsets
    assert "cone" not in onsets


def test_a_soil_that_sets_hard_is_unlisted_and_said_to_change_with_its_water():
    found = diagnose(density_campaigns(step=0.06), 1)
    assert found.verdict == "unknown"
    lead = size_sentences(found, "unknown")[0]
    assert lead.startswith("what is missing sets in beyond a water content of")
    assert 9.0 < float(lead.split(" of ")[1].split()[0]) < 11.0
    assert lead.endswith("% of dry mass")


def with_load(lab_kn: np.ndarray, field_kn: np.ndarray, exponent: float, seed: int = 3) -> Case:
    """A pull that goes with the normal load, which the simulator ignores."""
    case = make_case(None, models=PULL_ONLY)
    rng = np.random.default_rng(seed)
    parts = []
    for table, load in ((case.lab, lab_kn), (case.field, field_kn)):
        kn = rng.choice(load, len(table))
        pull = table["drawbar_pull_kn"] * (kn / np.median(lab_kn)) ** exponent
        parts.append(replace(table, columns={
            **table.columns, "normal_load_kn": kn, "drawbar_pull_kn": pull,
        }))  # fmt: skip
    return replace(case, lab=parts[0], field=parts[1])


def test_a_condition_that_the_simulator_ignores_is_named_as_the_cause():
    found = diagnose_once(with_load(np.array([5.0]), np.array([4.0, 6.0, 8.0]), 0.9), 1)
    assert found.verdict == "effect"
    load = found.inclusion.causes["depends_on_normal_load"]
    assert load.probability > 0.9
    assert load.share > 0.6
    assert not inseparable(found.data, dependences(found.data)["depends_on_normal_load"])


def test_a_condition_that_differs_between_the_campaigns_only_is_said_to_be_inseparable():
    found = diagnose_once(with_load(np.array([5.0]), np.array([8.0]), 1.0), 1)
    assert inseparable(found.data, dependences(found.data)["depends_on_normal_load"])
    assert any("cannot be separated" in w for w in found.warnings)


def test_a_condition_of_a_small_range_may_be_depended_on(data):
    """Of a water content the whole range is a tenth; of one that is constant there is none."""
    for spread, there in ((0.1, True), (0.0, False)):
        case = data.case
        lab, field = (
            table_from_arrays(
                {**t.columns, "gravimetric_water_content": 0.1 + spread * np.linspace(0, 1, len(t))}
            )
            for t in (case.lab, case.field)
        )
        found = dependences(campaigns(replace(case, lab=lab, field=field)))
        assert any("water" in name for name in found) == there


def test_a_condition_that_a_simulator_knows_is_no_dependence(data):
    assert "depends_on_inflation_pressure" not in {
        name for name, e in dependences(data).items() if "pull" in e.outputs
    }
