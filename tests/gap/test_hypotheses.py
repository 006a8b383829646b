"""The hypotheses themselves: what may be unlisted, and what another soil changes."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from calib.data import table_from_arrays
from calib.gap.campaigns import campaigns
from calib.gap.case import Case
from calib.gap.constants import COVERED, SHIFTS
from calib.gap.describe import unlisted
from calib.gap.diagnose import diagnose, diagnose_once
from calib.gap.effects import EFFECTS, Effect
from calib.gap.forward import Forward
from calib.gap.hypotheses import (
    Hypothesis,
    covered,
    dependences,
    effect_priors,
    inseparable,
    joined,
    prior_share,
    readings,
    resized,
    shifts,
    singles,
    split_testable,
    unknowns,
    wider,
    with_case_effects,
    with_residual_discrepancy,
)
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
    beside = with_residual_discrepancy(data, single)
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


def test_no_drift_of_one_output_is_unlisted(data):
    alone = [(h.onset_over, h.smooth_outputs) for h in unknowns(data) if h.onset_over]
    assert ("order", ("drawbar_pull",)) not in alone
    assert ("order", ("rut_depth",)) not in alone
    assert ("order", ("drawbar_pull", "rut_depth")) in alone
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
    lead = unlisted(found)
    assert (lead.over, lead.column) == ("water", "gravimetric_water_content")
    assert 0.09 < lead.threshold[0] < 0.11


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


@pytest.mark.parametrize("field", [[2.0], [1.0, 2.0, 3.0]])
def test_any_effect_may_rest_on_a_condition_that_differs_between_the_campaigns_only(data, field):
    """Whoever wrote the effect: what counts is the condition that it must see vary."""

    class Speed(Effect):
        name, outputs, covariates = "speed", ("pull",), ("speed",)

    class Gauge(Speed):
        varies = False

    speed = np.resize(field, data.view.slip().size)
    seen = replace(data, view=replace(data.view, conditions={
        **data.view.conditions, "speed_m_s": speed}))  # fmt: skip
    for effect in (Speed(), EFFECTS["rate_effect"], dependences(seen)["depends_on_speed"]):
        assert inseparable(seen, effect) == (len(field) == 1)
    assert not inseparable(seen, Gauge())
    assert not inseparable(seen, EFFECTS["force_offset"])


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


PULL, RUT = ("drawbar_pull",), ("rut_depth",)
_SIZES = ("drift", "jump")
BOTH = PULL + RUT


def weighed(hypotheses: list[Hypothesis]) -> dict[tuple, float]:
    """What each may vary with or set in over, of which outputs and size, and its share."""
    found = Counter()
    for h in hypotheses:
        assert h.name == "unknown"
        found[h.onset_over or h.smooth_over, h.onset_over is not None, h.smooth_outputs,
              h.smooth] += h.share  # fmt: skip
    assert len(found) == len(hypotheses)
    return dict(found)


def test_what_may_be_unlisted_is_all_that_a_wheel_shows_and_its_shares_are_as_stated(data):
    """Half of it smooth in either size, the rest setting in, 0.06 of all below a pressure.

    One output that sets in beyond a slip, as listed effects do, is so a fifth as often.
    """
    each, all_three = (PULL, RUT), (PULL, RUT, BOTH)
    smooth = [("level", t) for t in each]
    smooth += [("sinkage", t) for t in (PULL, BOTH)]  # of ruts alone it would be their level
    for over in ("slip", "order", "ripple", "before", "all", "pressure", "speed", "passes"):
        smooth += [(over, t) for t in all_three]
    onsets = [("level", PULL), ("level", RUT), ("sinkage", PULL), ("sinkage", BOTH)]
    onsets += [("slip", BOTH), ("order", BOTH)]  # of one over the runs a drift or a step is listed
    expected = {
        **{(over, False, t, size): 0.25 / len(smooth) for over, t in smooth for size in (1.5, 5.0)},
        **{(over, True, t, 4.0): 0.44 / (len(onsets) + 0.4) for over, t in onsets},
        **{("slip", True, t, 4.0): 0.2 * 0.44 / (len(onsets) + 0.4) for t in each},
        **{("low_pressure", True, t, 4.0): 0.06 / 3 for t in all_three},
    }
    assert weighed(unknowns(data)) == pytest.approx(expected)


def test_of_a_density_its_probes_are_what_it_may_change_with():
    t = ("bulk_density",)
    expected = {
        **{(over, False, t, size): 0.125 for over in ("level", "all") for size in (1.5, 5.0)},
        **{(over, True, t, 4.0): 0.5 / 3 for over in ("level", "water", "cone")},
    }
    assert weighed(unknowns(campaigns(density_campaigns()))) == pytest.approx(expected)


def test_beside_a_cause_there_is_little_of_every_shape(data):
    (offset,) = singles(data, {"force_offset": EFFECTS["force_offset"]})
    beside = with_residual_discrepancy(data, replace(offset, share=0.5))
    shapes = [(h.smooth_over, h.smooth, h.smooth_outputs, h.share) for h in beside]
    assert sorted(shapes) == [
        ("all", 1.5, BOTH, 0.1), ("all", 5.0, BOTH, 0.1), ("level", 1.5, BOTH, 0.1),
        ("slip", 1.5, BOTH, 0.1), ("slip", 5.0, BOTH, 0.1),
    ]  # fmt: skip
    assert {h.effects for h in beside} == {offset.effects}
    probed = with_residual_discrepancy(campaigns(density_campaigns()), replace(offset, share=0.3))
    assert [(h.smooth_over, h.smooth) for h in probed] == [
        ("level", 1.5), ("all", 1.5), ("all", 5.0),
    ]  # fmt: skip
    assert [h.share for h in probed] == pytest.approx([0.1] * 3)


def test_a_wide_prior_is_four_times_as_wide_or_by_twice_the_logarithm(data):
    few = singles(data, {n: EFFECTS[n] for n in ("force_offset", "lug_thrust")})
    logs = set()
    for single in few:
        wide = wider(single)
        assert wide.name == single.name
        for a, b in zip(single.effect_priors[0].free, wide.effect_priors[0].free, strict=True):
            assert b.scale == pytest.approx((2.0 if a.log else 4.0) * a.scale)
            logs.add(a.log)
    assert logs == {True, False}


def test_a_set_has_the_product_of_its_causes_shares(data):
    a, b = singles(data, {n: EFFECTS[n] for n in ("force_offset", "lug_thrust")})
    both = joined(replace(a, share=0.02), replace(b, share=0.1))
    assert both.share == pytest.approx(0.002)
    assert both.effect_priors == a.effect_priors + b.effect_priors
    assert joined(b, a) == joined(a, b)


def test_forces_of_an_effect_go_with_the_load(data):
    heavy = replace(data, view=replace(data.view, load_kn=3.0 * data.view.load_kn))
    offset = EFFECTS["force_offset"]
    (usual,), (heavier,) = (effect_priors(d, offset).free for d in (data, heavy))
    assert heavier.scale == pytest.approx(3.0 * usual.scale)


def test_effects_are_split_by_whether_the_design_shows_them():
    case = make_case(None, models=PULL_ONLY)
    able, unable = split_testable(campaigns(case))
    assert set(able) | set(unable) == set(EFFECTS)
    assert not set(able) & set(unable)
    assert "force_offset" in able
    assert "rut_rebound" in unable
    assert all(isinstance(reason, str) and reason for reason in unable.values())


def test_a_dependence_is_about_half_the_range_of_both_campaigns_and_what_ignores_it():
    case = make_case(None)
    ramp = {"lab": (4.0, 5.0), "field": (5.0, 8.0)}
    tables = {
        name: table_from_arrays(
            {**getattr(case, name).columns,
             "normal_load_kn": np.linspace(*ends, len(getattr(case, name)))}
        )
        for name, ends in ramp.items()
    }  # fmt: skip
    found = dependences(campaigns(replace(case, **tables)))
    load = found["depends_on_normal_load"]
    assert load.half_range == pytest.approx(2.0)
    assert load.logs == {"pull": False, "sinkage": True}
    # The simulators know slip and pressures; the pull's knows no passes, ruts' neither.
    assert "depends_on_slip" not in found
    assert not any("pressure" in name and "pull" in e.outputs for name, e in found.items())
    # What is unknown somewhere in the field, or in the laboratory all along, is none.
    holed = np.array(tables["field"]["normal_load_kn"])
    holed[3] = np.nan
    lacking = replace(tables["field"], columns={**tables["field"].columns, "normal_load_kn": holed})
    data = campaigns(replace(case, **tables))
    without = replace(data, view=replace(data.view, conditions=dict(lacking.columns)))
    assert "depends_on_normal_load" not in dependences(without)
    bare = replace(case, lab=table_without(case.lab, "normal_load_kn"), field=tables["field"])
    assert "depends_on_normal_load" not in dependences(campaigns(bare))


def test_what_a_listed_effect_is_about_is_depended_on_in_another_way_seldom(data):
    found = dependences(data)
    passes = found["depends_on_pass_number"]
    assert covered(passes, {"multipass_compaction", "force_offset"})
    assert not covered(passes, {"rate_effect", "force_offset"})
    assert not covered(EFFECTS["multipass_compaction"], {"multipass_compaction"})
    assert pytest.approx(0.02) == COVERED


def test_declared_columns_may_change_every_output():
    """A number by half its range; a category against its most frequent value in the laboratory."""
    case = make_case(None)
    rng = np.random.default_rng(2)
    tables = {}
    for name in ("lab", "field"):
        table, last = getattr(case, name), 5.0 if name == "lab" else 9.0
        n = len(table)
        columns = {
            **table.columns, "temperature": np.linspace(1.0, last, n),
            "crew": rng.permutation(np.resize([0.0, 2.0, 2.0, 1.0], n)), "flat": np.full(n, 3.0),
        }  # fmt: skip
        tables[name] = replace(table, columns=columns)
    declared = {"temperature": (), "crew": ("a", "b", "c"), "flat": ()}
    data = campaigns(replace(case, **tables, covariates=declared))
    found = {e.covariates[0]: e for e in dependences(data).values()}
    logs = {"pull": False, "sinkage": True}
    assert found["temperature"].half_range == pytest.approx(4.0)
    assert found["temperature"].logs == found["crew"].logs == logs
    assert found["crew"].usual == 2
    assert 0.0 < found["flat"].half_range < 1e-9
    assert inseparable(data, found["flat"])
    assert not inseparable(data, found["temperature"])
    assert not inseparable(data, found["crew"])
    narrow = np.linspace(20.0, 20.5, 27)
    little = replace(data, view=replace(data.view, conditions={
        **data.view.conditions, "temperature": narrow}))  # fmt: skip
    assert not inseparable(little, found["temperature"])


def test_shifts_are_a_part_of_what_all_soils_span(data):
    sizes = sorted({h.shift for h in shifts(data)})
    assert sizes == [0.1, 0.25, 0.6]
    assert [h.share for h in shifts(data) if h.shift_as == "soil"] == pytest.approx([2 / 9] * 3)
    assert {h.name for h in shifts(data)} == {"parameter_shift"}


def test_every_reading_but_the_drawbar_cells_may_drift_or_jump_in_its_own_unit(data):
    """Of ruts, whose logarithms are compared, by a factor; else by parts of a typical reading."""
    found = readings(data)
    assert set(found) == {"rut_depth_drift", "rut_depth_step"}
    assert [effect.outputs for effect in found.values()] == [("sinkage",)] * 2
    sizes = {name: [p.scale for p in effect_priors(data, e).free if p.name in _SIZES]
             for name, e in found.items()}  # fmt: skip
    assert sizes == {"rut_depth_drift": [0.25], "rut_depth_step": [0.25]}
    dense = campaigns(density_campaigns())
    assert not readings(dense)  # nothing is known of the order of its runs
    (o,) = dense.outputs
    order = {"run_order": np.arange(len(dense.case.field), dtype=float)}
    timed = campaigns(
        replace(dense.case, field=table_from_arrays({**dense.case.field.columns, **order}))
    )
    found = readings(timed)
    assert set(found) == {"bulk_density_drift", "bulk_density_step"}
    drift = effect_priors(timed, found["bulk_density_drift"]).free[0]
    assert (drift.unit, drift.scale) == (
        "g/cm**3", pytest.approx(0.25 * np.median(o.problem.response)),
    )  # fmt: skip


def test_over_the_runs_a_reading_changes_in_the_shapes_of_the_drawbar_cells(data):
    for name, effect in readings(data).items():
        cell = EFFECTS["sensor_" + name.removeprefix("rut_depth_")]
        of_cell = {p.name: p for p in effect_priors(data, cell).free if p.name not in _SIZES}
        for prior in effect_priors(data, effect).free:
            if prior.name not in _SIZES:
                mine, theirs = ((p.log, p.loc, p.scale, p.lower, p.upper)
                                for p in (prior, of_cell[prior.name]))  # fmt: skip
                assert mine == theirs


def test_what_a_case_brings_with_it_gives_way_to_an_effect_of_its_name(data):
    mine = EFFECTS["rut_rebound"]
    found = with_case_effects(data, {"rut_depth_step": mine})
    assert found["rut_depth_step"] is mine
    assert {"rut_depth_drift", *dependences(data)} <= set(found)


def test_what_is_tried_beside_listed_effects_is_less_probable_than_they(data):
    everything = with_case_effects(data, EFFECTS)
    shares = {name: prior_share(effect, EFFECTS) for name, effect in everything.items()}
    assert {shares[name] for name in EFFECTS} == {None}
    assert shares["rut_depth_drift"] == shares["rut_depth_step"] == 0.2
    assert shares["depends_on_speed"] == 0.02
