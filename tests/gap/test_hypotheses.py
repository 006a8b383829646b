"""The hypotheses themselves: what may be unlisted, and what another soil changes."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from calib.data import table_from_arrays
from calib.gap.campaigns import campaigns
from calib.gap.case import Case, Context
from calib.gap.constants import SELDOM, SHIFTS
from calib.gap.describe import unlisted
from calib.gap.diagnose import diagnose, diagnose_once
from calib.gap.effects import EFFECTS
from calib.gap.forward import Forward
from calib.gap.hypotheses import (
    Hypothesis,
    by_parameters,
    dependences,
    effect_priors,
    inseparable,
    prior_share,
    readings,
    shifts,
    singles,
    unknowns,
    with_residual_discrepancy,
)
from tests.gap.cases import MODELS, NOISE, PULL_ONLY, TRUTH, campaigns_of, make_case

SIGMA = {o: NOISE[o] for o in MODELS}


@pytest.fixture(scope="module")
def data():
    return campaigns_of(None)


def lab_mode(data) -> dict[str, np.ndarray]:
    return {o.name: np.array([p.loc for p in o.priors.free]) for o in data.outputs}


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


def test_no_drift_of_one_output_is_unlisted(data):
    alone = [(h.onset_over, h.smooth_outputs) for h in unknowns(data) if h.onset_over]
    assert ("order", ("drawbar_pull",)) not in alone
    assert ("order", ("rut_depth",)) not in alone
    assert ("order", ("drawbar_pull", "rut_depth")) in alone
    assert ("slip", ("drawbar_pull", "rut_depth")) in alone


def test_parameters_shift_by_themselves_or_as_with_another_soil_in_every_size(data):
    found = {(h.shift, h.shift_as): h.share for h in shifts(data)}
    assert set(found) == {(size, kind) for size in SHIFTS for kind in ("alone", "soil")}
    assert sum(found.values()) == pytest.approx(1.0)
    assert found[SHIFTS[0], "soil"] == pytest.approx(2.0 * found[SHIFTS[0], "alone"])


def test_the_same_soil_shifts_less_and_another_one_more_and_together(data):
    for same, sizes, kinds in ((True, {0.1, 0.25}, 2), (False, {0.25, 0.6, 1.4}, 1)):
        case = replace(data.case, context=Context(same_soil=same))
        found = shifts(replace(data, case=case))
        assert {h.shift for h in found} == sizes
        assert len(found) == kinds * len(sizes)
        assert sum(h.share for h in found) == pytest.approx(1.0)
        assert same or {h.shift_as for h in found} == {"soil"}


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


def test_a_dependence_is_as_often_one_of_the_parameters_in_every_size(data):
    ignored = dependences(campaigns(with_load(np.array([5.0]), np.array([4.0, 8.0]), 1.0)))
    name = "depends_on_normal_load"
    (single,) = singles(data, {name: ignored[name]})
    found = {(h.shift_over, h.shift): h.share for h in by_parameters(replace(single, share=0.2))}
    assert found == pytest.approx(
        {("", 0.0): 0.1} | {(name, size): 0.1 / len(SHIFTS) for size in SHIFTS}
    )
    (other,) = singles(data, {"force_offset": EFFECTS["force_offset"]})
    assert by_parameters(other) == [other]


def softer(exponent: float, everywhere: float) -> Case:
    """A slip stiffness that goes with the load, which the simulator ignores, or is another."""
    case = with_load(np.array([5.0]), np.array([3.0, 5.0, 8.0]), 0.0)
    load, slip = case.field["normal_load_kn"], case.field["slip_ratio"]
    truth, bound = TRUTH["magic_formula"], campaigns(case).outputs[0].problem.bound

    def pull(stiffness: np.ndarray) -> np.ndarray:
        theta = np.array([[*(truth | {"K": k}).values()] for k in stiffness])
        return np.diag(bound.mean_response(theta, {"slip_ratio": slip}))

    stiff = truth["K"] * everywhere * (load / 5.0) ** exponent
    change = pull(stiff) - pull(np.full(slip.size, truth["K"]))
    columns = {**case.field.columns, "drawbar_pull_kn": case.field["drawbar_pull_kn"] + change}
    return replace(case, field=replace(case.field, columns=columns))


@pytest.mark.parametrize(
    ("exponent", "everywhere", "cause"),
    [(0.8, 1.0, "depends_on_normal_load"), (0.0, 0.5, "parameter_shift")],
)
def test_a_condition_that_changes_the_shape_of_a_curve_is_named_and_another_curve_is_not(
    exponent, everywhere, cause
):
    found = diagnose_once(softer(exponent, everywhere), 1)
    acting = {name: c.probability for name, c in found.inclusion.causes.items()}
    assert acting.pop(cause) > 0.9
    assert max(acting.values()) < 0.1


def test_a_condition_that_differs_between_the_campaigns_only_is_said_to_be_inseparable():
    found = diagnose_once(with_load(np.array([5.0]), np.array([8.0]), 1.0), 1)
    assert inseparable(found.data, dependences(found.data)["depends_on_normal_load"])
    assert any("cannot be separated" in w for w in found.warnings)


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


def test_forces_of_an_effect_go_with_the_load(data):
    heavy = replace(data, view=replace(data.view, load_kn=3.0 * data.view.load_kn))
    offset = EFFECTS["force_offset"]
    (usual,), (heavier,) = (effect_priors(d, offset).free for d in (data, heavy))
    assert heavier.scale == pytest.approx(3.0 * usual.scale)


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


def test_every_reading_may_be_wrong_in_its_own_unit(data):
    """Over the runs ruts, whose logarithms are compared, by a factor; else by parts of a reading.

    What the drawbar cell's own effects are about is not counted twice.
    """
    found = readings(data)
    assert found.pop("drawbar_pull_gain").outputs == ("pull",)
    assert set(found) == {f"rut_depth_{kind}" for kind in ("drift", "step", "gain", "offset")}
    assert {effect.outputs for effect in found.values()} == {("sinkage",)}
    assert all(prior_share(effect, ()) == SELDOM for effect in found.values())
    offset = effect_priors(data, found["rut_depth_offset"]).free[0]
    typical = np.median(np.exp(data.outputs[1].problem.response))
    assert (offset.unit, offset.scale) == ("mm", pytest.approx(0.1 * typical))
    sizes = {name: [p.scale for p in effect_priors(data, e).free if p.name in _SIZES]
             for name, e in found.items()}  # fmt: skip
    assert sizes["rut_depth_drift"] == sizes["rut_depth_step"] == [0.25]
    dense = campaigns(density_campaigns())
    # Nothing is known of the order of its runs.
    assert set(readings(dense)) == {"bulk_density_gain", "bulk_density_offset"}
    (o,) = dense.outputs
    order = {"run_order": np.arange(len(dense.case.field), dtype=float)}
    timed = campaigns(
        replace(dense.case, field=table_from_arrays({**dense.case.field.columns, **order}))
    )
    found = readings(timed)
    assert {"bulk_density_drift", "bulk_density_step"} < set(found)
    drift = effect_priors(timed, found["bulk_density_drift"]).free[0]
    assert (drift.unit, drift.scale) == (
        "g/cm**3", pytest.approx(0.25 * np.median(o.problem.response)),
    )  # fmt: skip


def test_a_gain_of_five_percent_is_predicted_and_only_conditions_that_differ_may_be_wrong(data):
    """By the simulator, of pulls as of ruts in logarithms."""
    sigma = {o: NOISE[o] for o in data.names}
    for name, gained in (
        ("drawbar_pull", lambda y: 1.05 * y),
        ("rut_depth", lambda y: y + np.log(1.05)),
    ):
        effect = readings(data)[f"{name}_gain"]
        forward = Forward(data, Hypothesis(
            effect.name, (effect,), (effect_priors(data, effect),)), sigma)  # fmt: skip
        psi = forward.priors.sample(np.random.default_rng(1), 3)
        psi[:, forward.phi_slices[0]] = 0.05
        full, plain = forward.field_and_plain(psi, data.view)
        for o in data.names:
            expected = gained(plain[o]) if o == name else plain[o]
            np.testing.assert_allclose(full[o], expected, rtol=1e-12)


@pytest.mark.parametrize("varied", [True, False])
def test_a_condition_of_a_simulator_may_be_wrong_if_it_varies(varied):
    """Of those that no listed gauge is about; what is always the laboratory's is left alone."""
    case = with_load(
        np.full(24, 5.0), np.linspace(3.0, 7.0, 24) if varied else np.full(24, 5.0), 1.0
    )
    columns = ("tyre_width_m", "tyre_diameter_m")
    lab, field = (table_from_arrays({**t.columns, **{c: np.full(len(t), 0.5 + i) for i, c in
                  enumerate(columns)}, "cone_index_kpa": np.linspace(300.0, 500.0, len(t))})
                  for t in (case.lab, case.field))  # fmt: skip
    made = campaigns(replace(case, lab=lab, field=field, models={"drawbar_pull": "wismer_luth"}))
    found = {n: e for n, e in readings(made).items() if n.endswith("_bias")}
    assert set(found) == ({"normal_load_bias"} if varied else set())
    for effect in found.values():
        assert effect.outputs == ("pull",)
        gain, offset = effect_priors(made, effect).free
        assert (offset.unit, offset.scale, gain.scale) == ("kN", pytest.approx(0.25), 0.05)
