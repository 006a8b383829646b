"""The joint model: the simulator alone in the laboratory, effects in the field."""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import numpy as np
import pytest

from calib.data.quantities import role_of
from calib.gap.campaigns import campaigns
from calib.gap.discrepancy import shift_map
from calib.gap.effects import EFFECTS, Effect
from calib.gap.forward import FieldPrediction, Forward, fields_of_all
from calib.gap.hypotheses import (
    Hypothesis,
    effect_priors,
    joined,
    shifts,
    singles,
    split_testable,
    unknowns,
    with_residual_discrepancy,
)
from calib.inference.priors import Prior, Priors
from tests.gap.cases import NOISE, campaigns_of, make_case
from tests.gap.test_hypotheses import density_campaigns

SIGMA = {o: NOISE[o] for o in ("drawbar_pull", "rut_depth")}


@pytest.fixture(scope="module")
def data():
    return campaigns_of(None)


def single(data, name: str) -> Hypothesis:
    return Hypothesis(name, (EFFECTS[name],), (effect_priors(data, EFFECTS[name]),))


def centre(forward: Forward, k: int = 2) -> np.ndarray:
    """Return the middle of the priors, with the effect's own coordinates at zero size."""
    psi = np.array([p.loc for p in forward.priors.free])
    return np.tile(psi, (k, 1))


def test_shapes(data):
    for h in (Hypothesis("none"), single(data, "lug_thrust"), unknowns(data)[0]):
        forward = Forward(data, h, SIGMA)
        psi = centre(forward, 4)
        assert psi.shape[1] == forward.n_dim
        for o in data.outputs:
            assert forward.lab(psi)[o.name].shape == (4, 30)
            assert forward.field(psi, data.view)[o.name].shape == (4, 27)


def test_of_no_vectors_there_are_no_predictions(data):
    forward = Forward(data, single(data, "lug_thrust"), SIGMA)
    plain = {o.name: np.empty((0, 27)) for o in data.outputs}
    found = forward.departed(np.empty((0, forward.n_dim)), data.view, plain)
    assert {name: values.shape for name, values in found.items()} == {
        o.name: (0, 27) for o in data.outputs
    }


def test_none_is_the_simulator_in_both_campaigns(data):
    forward = Forward(data, Hypothesis("none"), SIGMA)
    psi = centre(forward)
    full, plain = forward.field(psi, data.view), forward.simulator(psi, data.view)
    for o in data.names:
        np.testing.assert_array_equal(full[o], plain[o])


@pytest.mark.parametrize("kind", ["parameter_shift", "unknown"])
def test_the_other_hypotheses_reduce_to_it(data, kind):
    h = (
        Hypothesis("parameter_shift", shift=0.25)
        if kind == "parameter_shift"
        else unknowns(data)[-1]
    )
    lab_mode = {o.name: np.array([p.loc for p in o.priors.free]) for o in data.outputs}
    forward = Forward(data, h, SIGMA, lab_mode)
    psi = centre(forward)  # shifts and coefficients are zero in the middle of their priors
    full, plain = forward.field(psi, data.view), forward.simulator(psi, data.view)
    for o in data.names:
        np.testing.assert_allclose(full[o], plain[o], rtol=1e-12)
    pull = forward.smooth_slices.get("drawbar_pull", forward.shift_slice)
    moved = psi.copy()
    moved[:, pull.start] += 0.1
    changed = forward.field(moved, data.view)
    assert np.abs(changed["drawbar_pull"] - plain["drawbar_pull"]).max() > 1e-3
    np.testing.assert_allclose(changed["rut_depth"], plain["rut_depth"], rtol=1e-12)


def test_an_effect_acts_in_the_field_only(data):
    forward = Forward(data, single(data, "force_offset"), SIGMA)
    psi = centre(forward)
    moved = psi.copy()
    moved[:, forward.phi_slices[0]] = 0.3
    for o in data.names:
        np.testing.assert_array_equal(forward.lab(moved)[o], forward.lab(psi)[o])
    gap = (
        forward.field(moved, data.view)["drawbar_pull"]
        - forward.simulator(moved, data.view)["drawbar_pull"]
    )
    np.testing.assert_allclose(gap, 0.3)


def test_a_pair_does_what_both_do(data):
    a, b = single(data, "force_offset"), single(data, "sensor_drift")
    both = joined(b, a)
    assert both.name == "force_offset+sensor_drift"
    sizes = ((0.1,), (0.2, 0.0, 0.5, 0.3))  # internal: logarithms but for the first and last

    def gap(h: Hypothesis, phis) -> np.ndarray:
        forward = Forward(data, h, SIGMA)
        psi = centre(forward, 1)
        for part, phi in zip(forward.phi_slices, phis, strict=True):
            psi[:, part] = phi
        return (forward.field(psi, data.view)["drawbar_pull"]
                - forward.simulator(psi, data.view)["drawbar_pull"])  # fmt: skip

    # Both are added to the reading, so their gaps add up.
    expected = gap(a, sizes[:1]) + gap(b, sizes[1:])
    np.testing.assert_allclose(gap(both, sizes), expected, atol=1e-12)


@pytest.mark.parametrize("name", ["force_offset", "sensor_drift"])
def test_an_instrument_adds_its_error_to_what_happens_whatever_that_is(data, name):
    """Softening does not soften the offset of a load cell, though it is later in the alphabet.

    So what goes when the fault is taken away is the same amount as of the fault alone.
    """
    fault, size = single(data, name), {"force_offset": 0.1, "sensor_drift": 0.2}[name]

    def fields(h: Hypothesis) -> tuple[np.ndarray, np.ndarray]:
        forward = Forward(data, h, SIGMA)
        psi = centre(forward, 1)
        for effect, part in zip(h.effects, forward.phi_slices, strict=True):
            psi[:, part.start] += size if effect.name == name else 0.2
        without = forward.without(psi, data.view, name)["drawbar_pull"]
        return forward.field(psi, data.view)["drawbar_pull"], without

    alone, simulator = fields(fault)
    tried = 0
    for happens, effect in split_testable(data)[0].items():
        if effect.instrument or "pull" not in effect.outputs:
            continue
        full, without = fields(joined(fault, single(data, happens)))
        if np.abs(without - simulator).max() < 1e-3:
            continue  # of one pass there is no compaction by passes
        np.testing.assert_allclose(full - without, alone - simulator, atol=1e-9, err_msg=happens)
        tried += 1
    assert tried > 4


def test_form_error_scales_the_effect_and_nothing_else(data):
    forward = Forward(data, single(data, "lug_thrust"), SIGMA)
    (part,) = forward.form_slices["drawbar_pull"]
    assert part.stop > part.start
    psi = centre(forward)
    psi[:, part] = 0.5
    full, plain = forward.field(psi, data.view), forward.simulator(psi, data.view)
    # At zero thrust and digging, the form error has nothing to scale.
    for s in forward.phi_slices:
        psi[:, s.start] = psi[:, s.stop - 1] = 0.0
    zero = forward.field(psi, data.view)
    np.testing.assert_allclose(zero["drawbar_pull"], plain["drawbar_pull"], rtol=1e-12)
    assert full["drawbar_pull"].shape == (2, 27)


def test_other_conditions_use_the_same_references(data):
    forward = Forward(data, single(data, "rate_effect"), SIGMA)
    psi = centre(forward)
    psi[:, forward.phi_slices[0].start] = 0.2
    rows = {k: v[:5] for k, v in data.view.conditions.items()}
    part = forward.field(psi, data.at_conditions(rows))
    whole = forward.field(psi, data.view)
    for o in data.names:
        np.testing.assert_allclose(part[o], whole[o][:, :5], rtol=1e-12)


def test_every_single_effect_has_a_prior_for_each_parameter(data):
    for h in singles(data, {n: EFFECTS[n] for n in ("lug_thrust", "rate_effect")}):
        forward = Forward(data, h, SIGMA)
        part = forward.phi_slices[0]
        assert part.stop - part.start == len(h.effects[0].parameters)


@pytest.mark.parametrize(
    ("effect", "sds"),
    [
        ("multipass_compaction", [0.15, 0.1, 0.13, 0.18]),  # tilt and bend over slip, psi, pass
        ("load_transfer", [0.15, 0.1]),
        ("slip_zero_shift", [0.13]),
        ("pressure_gauge_bias", [0.2]),
        ("force_offset", []),
    ],
)
def test_a_formula_is_trusted_less_along_some_directions(data, effect, sds):
    forward = Forward(data, single(data, effect), SIGMA)
    for o in data.outputs:
        (part,) = forward.form_slices[o.name]
        found = [p.scale for p in forward.priors.free[part]]
        # Where an effect does nothing there is nothing to depart from.
        assert found == pytest.approx(sds if o.role in EFFECTS[effect].outputs else [])


def test_each_of_two_effects_departs_from_its_own_formula(data):
    both = joined(single(data, "lug_thrust"), single(data, "sensor_drift"))
    forward = Forward(data, both, SIGMA)
    lugs, drift = forward.form_slices["drawbar_pull"]
    assert [p.scale for p in forward.priors.free[lugs]] == pytest.approx([0.15, 0.1, 0.13])
    psi = centre(forward)
    for part, effect in zip(forward.phi_slices, both.effects, strict=True):
        psi[:, part.start] = 0.1 if effect.name == "lug_thrust" else 0.2
    straight = forward.field(psi, data.view)["drawbar_pull"]
    without = {c: forward.without(psi, data.view, c)["drawbar_pull"] for c in forward.causes}
    departed = psi.copy()
    departed[:, lugs.start] = 0.5
    found = forward.field(departed, data.view)["drawbar_pull"]
    slip = forward.covariates.over(data.view, "slip")
    of_lugs = (straight - without["lug_thrust"]) * 0.5 * slip
    np.testing.assert_allclose(found - straight, of_lugs, atol=1e-12)
    # What it does beside the other is what goes with it, whatever the other's formula.
    assert np.abs(straight - without["sensor_drift"]).max() > 0.01
    np.testing.assert_allclose(
        found - forward.without(departed, data.view, "sensor_drift")["drawbar_pull"],
        straight - without["sensor_drift"], atol=1e-12,
    )  # fmt: skip
    assert drift.stop - drift.start == (0 if not EFFECTS["sensor_drift"].form else 1)


def test_an_effect_acts_on_the_outputs_it_names_alone(data):
    class Wind(Effect):
        name = "wind"
        parameters = ("force",)
        outputs = ("pull",)

        def on_conditions(self, phi, output, conditions, view):
            raised = {k: 1.01 * v for k, v in conditions.items()}
            return raised if phi.any() else conditions

        def on_output(self, phi, output, location, view):
            return location + phi[:, :1]

    priors = Priors((Prior("force", "kN", "", "", "", False, 0.0, 0.1),))
    forward = Forward(data, Hypothesis("wind", (Wind(),), (priors,)), SIGMA)
    psi = np.array([[p.loc for p in forward.priors.free]])
    psi[0, forward.phi_slices[0]] = 0.2
    full, plain = forward.field(psi, data.view), forward.simulator(psi, data.view)
    np.testing.assert_array_equal(full["rut_depth"], plain["rut_depth"])
    assert (full["drawbar_pull"] > plain["drawbar_pull"] + 0.1).all()


def test_beyond_the_pressures_of_both_campaigns_the_pull_goes_on_straight(data):
    forward = Forward(data, single(data, "pressure_gauge_bias"), NOISE)
    psi = np.array([[p.loc for p in forward.priors.free]])
    gain, offset, _, radius = range(forward.phi_slices[0].start, forward.phi_slices[0].stop)
    psi[:, [gain, offset, radius]] = 0.0
    recorded = data.view.conditions["inflation_pressure_psi"]
    high = recorded == recorded.max()

    def pull(shift: float, rows: np.ndarray) -> np.ndarray:
        moved = psi.copy()
        moved[:, offset] = shift
        return forward.field(moved, data.view)["drawbar_pull"][0, rows]

    # Within the range it is the simulator, the parabola and all, ...
    np.testing.assert_allclose(
        pull(0.0, high), forward.simulator(psi, data.view)["drawbar_pull"][0, high]
    )
    # ... and outside a line of the slope from one end of the range to the other.
    low = recorded.min() - recorded.max()
    slope = (pull(0.0, high) - pull(low, high)) / -low
    for beyond in (3.0, 9.0):
        np.testing.assert_allclose(pull(beyond, high), pull(0.0, high) + slope * beyond)
        np.testing.assert_allclose(pull(low - beyond, high), pull(low, high) - slope * beyond)


@pytest.mark.parametrize("beyond", [False, True])
@pytest.mark.parametrize(
    "effect", ["lug_thrust", "multipass_compaction", "slip_zero_shift", "pressure_gauge_bias"]
)
def test_a_form_error_is_of_the_functions_it_is_named_for(data, effect, beyond):
    """1 + c1 u + c2 (3 u^2 - 1)/2 + c3 v + c4 w over slip, pressure and its own covariate."""
    forward = Forward(data, single(data, effect), SIGMA)
    acting, view = EFFECTS[effect], data.view
    if beyond:
        wider = {c: v.mean() + 1.4 * (v - v.mean()) for c, v in view.conditions.items()}
        wider["pass_number"] = view.conditions["pass_number"] * 3.0
        view = replace(view, conditions=wider)
    slip, pressure = (forward.covariates.over(view, what) for what in ("slip", "pressure"))
    written = []
    if "slip" in acting.form:
        written += [slip, (3.0 * slip**2 - 1.0) / 2.0]
    if {"pressure", "extrapolation"} & set(acting.form):
        written += [pressure]
    if "shape" in acting.form:
        reference, own = (np.log(v.conditions["pass_number"]) for v in (data.view, view))
        middle = (reference.max() + reference.min()) / 2.0
        written += [np.clip((own - middle) / (np.ptp(reference) / 2.0), -1.5, 1.5)]
    (basis,) = forward.form(view)
    np.testing.assert_allclose(basis, np.stack(written, axis=1), atol=1e-12)


def test_without_a_cause_the_others_stay(data):
    """Of a shift with something besides: either alone, and neither is the simulator."""
    for h in with_residual_discrepancy(data, shifts(data)[0]):
        forward = Forward(data, h, SIGMA, {o.name: centre_of(o) for o in data.outputs})
        rng = np.random.default_rng(2)
        psi = centre(forward)
        free = [slice(forward.shift_slice.start, forward.shift_slice.stop),
                *forward.smooth_slices.values()]  # fmt: skip
        for part in free:
            psi[:, part] = 0.1 * rng.standard_normal((2, part.stop - part.start))
        assert forward.causes == ("parameter_shift", "unknown")
        unshifted, known = psi.copy(), psi.copy()
        unshifted[:, forward.shift_slice] = 0.0
        for part in forward.smooth_slices.values():
            known[:, part] = 0.0
        both, plain = forward.field(psi, data.view), forward.simulator(psi, data.view)
        for left_out, other in (("parameter_shift", unshifted), ("unknown", known)):
            found, expected = forward.without(psi, data.view, left_out), forward.field(
                other, data.view)  # fmt: skip
            for o in data.names:
                np.testing.assert_array_equal(found[o], expected[o])
            assert any(not np.allclose(found[o], both[o]) for o in data.names)
        neither = forward.without(psi, data.view, "parameter_shift", "unknown")
        for o in data.names:
            np.testing.assert_allclose(neither[o], plain[o], rtol=1e-12)


@pytest.mark.parametrize(
    "names", [("lug_thrust",), ("pressure_gauge_bias", "slip_zero_shift"),
              ("load_transfer", "multipass_compaction", "sensor_drift")],
)  # fmt: skip
def test_what_is_added_by_conditions_serves_for_any_form_errors(data, names):
    """Asked again with other form errors, as asked for the first time with them."""
    forward = Forward(data, joined(*(single(data, n) for n in names)), SIGMA)
    rng = np.random.default_rng(6)
    psi = forward.priors.sample(rng, 5)
    other = psi.copy()
    for part in (s for o in forward.form_slices.values() for s in o):
        other[:, part] = 0.3 * rng.standard_normal((5, part.stop - part.start))
    plain = forward.simulator(psi, data.view)
    departed = FieldPrediction([(forward, psi)], data.view, plain)
    for form in (psi, other):
        found, expected = departed.at([form]), forward.departed(form, data.view, plain)
        for o in data.names:
            np.testing.assert_array_equal(found[o], expected[o])
    # Without what an effect adds: as by a formula that misrepresents it by all of its size.
    last = len(names) - 1
    found = departed.at([other], last)
    expected = forward.without(other, data.view, names[last])
    for o in data.names:
        np.testing.assert_allclose(found[o], expected[o], rtol=1e-12, atol=1e-12)


def test_of_several_that_are_asked_each_leaves_its_own_out(data):
    one, other = single(data, "lug_thrust"), single(data, "force_offset")
    both, shifted = joined(one, other), shifts(data)[0]
    rng = np.random.default_rng(7)
    asked = []
    for h, n in ((both, 3), (one, 2), (shifted, 4), (both, 1)):
        forward = Forward(data, h, SIGMA)
        asked.append((forward, forward.priors.sample(rng, n)))
    plain = asked[0][0].simulator(
        np.concatenate([psi[:, : f.n_shared] for f, psi in asked]), data.view
    )
    kept = {o: v.copy() for o, v in plain.items()}
    found = fields_of_all(asked, data.view, plain, {0: [0], 3: [0, 1]})
    start = 0
    without = (("force_offset",), (), (), both.name.split("+"))
    for (f, psi), left_out in zip(asked, without, strict=True):
        expected = f.without(psi, data.view, *left_out)
        for o in data.names:
            np.testing.assert_allclose(
                found[o][start : start + len(psi)], expected[o], rtol=1e-12, atol=1e-12
            )
        start += len(psi)
    for o in data.names:  # what was given is as it was
        np.testing.assert_array_equal(plain[o], kept[o])


def test_a_vector_stacks_the_parts_of_a_hypothesis_in_their_order(data):
    """Simulators, effects, form errors by output, shifts, a free discrepancy, its threshold."""
    lugs = single(data, "lug_thrust")
    h = replace(
        lugs, shift=0.25, smooth=3.0, smooth_outputs=("drawbar_pull",), smooth_over="passes"
    )
    lab_mode = {o.name: centre_of(o) for o in data.outputs}
    forward = Forward(data, h, SIGMA, lab_mode)
    _, sds = shift_map(data.outputs, "alone")
    wanted = [(f"{o.name}.{p.name}", p.loc, p.scale) for o in data.outputs for p in o.priors.free]
    assert forward.n_shared == len(wanted) == 13
    wanted += [(f"lug_thrust.{p.name}", p.loc, p.scale) for p in lugs.effect_priors[0].free]
    forms = (0.15, 0.1, 0.13)
    wanted += [(f"{o}.lug_thrust.form", 0.0, sd) for o in data.names for sd in forms]
    wanted += [("field.shift", 0.0, 0.25 * sd) for sd in sds]
    # A constant, three cosines that tell four passes apart, and as many for a part of the pull.
    waves = [0.8 / (1.0 + (j / 4.0) ** 2) for j in (1, 2, 3)]
    sizes = [1.0, *waves, 0.5, *(0.6 * w for w in waves)]
    wanted += [("drawbar_pull.smooth", 0.0, 3.0 * 0.03 * w) for w in sizes]
    found = [(p.name, p.loc, p.scale) for p in forward.priors.entries]
    assert [name for name, *_ in found] == [name for name, *_ in wanted]
    for one, other in zip(found, wanted, strict=True):
        assert one[1:] == pytest.approx(other[1:], rel=1e-12)
    assert not any(p.log for p in forward.priors.entries if p.name.endswith(("form", "smooth")))
    assert forward.n_dim == len(wanted)
    parts = [
        *forward.theta_slices.values(), *forward.phi_slices,
        *(part for parts in forward.form_slices.values() for part in parts),
        forward.shift_slice, *forward.smooth_slices.values(),
    ]  # fmt: skip
    assert np.concatenate([np.arange(forward.n_dim)[part] for part in parts]).tolist() == list(
        range(forward.n_dim)
    )


def test_a_threshold_lies_within_the_campaign(data):
    """On a scale of -1..1, with some rows on both of its sides."""
    h = Hypothesis("unknown", smooth=4.0, smooth_outputs=("drawbar_pull",), onset_over="slip")
    forward = Forward(data, h, SIGMA)
    step, bend, before, threshold = forward.priors.entries[-4:]
    sds = (step.scale, bend.scale, before.scale)
    assert sds == pytest.approx((4.0 * 0.03, 4.0 * 0.03 * 2.0, 4.0 * 0.03 * 0.5))
    assert (threshold.lower, threshold.upper) == (-0.85, 0.9)
    assert threshold.loc == pytest.approx(0.025)
    assert not np.isfinite(threshold.scale)
    assert not threshold.log
    assert forward.threshold == forward.n_dim - 1
    psi = centre(forward, 3)
    psi[:, -4:] = [[0.1, -0.2, 0.0, -0.4], [0.0, 0.3, 0.1, 0.0], [0.2, 0.1, -0.1, 0.6]]
    gap = (forward.field(psi, data.view)["drawbar_pull"]
           - forward.simulator(psi, data.view)["drawbar_pull"])  # fmt: skip
    u = (forward.covariates.over(data.view, "slip") - psi[:, -1:]) / 0.06
    step, bend = 1.0 / (1.0 + np.exp(-u)), 0.06 * np.logaddexp(0.0, u)
    of_step, of_bend, before = psi[:, -4:-3], psi[:, -3:-2], psi[:, -2:-1]
    np.testing.assert_allclose(gap, of_step * step + of_bend * bend + before, atol=1e-12)


def test_of_density_a_simulator_is_inadequate_and_gauges_errors_have_forms():
    """Bends by the noise at the ends of the lab's range; sizes, cone index and water."""
    density = campaigns(density_campaigns())
    h = joined(single(density, "cone_index_bias"), single(density, "water_content_bias"))
    forward = Forward(density, h, {"bulk_density": 0.02})
    entries = {p.name: [] for p in forward.priors.entries}
    for p in forward.priors.entries:
        entries[p.name].append((p.loc, p.scale))
    assert entries["bulk_density.misfit"] == [(0.0, 0.02)] * 3
    assert forward.n_shared == len(density.outputs[0].priors.free) + 3
    for name in ("cone_index_bias", "water_content_bias"):
        forms = entries[f"bulk_density.{name}.form"]
        assert forms == [(0.0, 0.2), (0.0, 0.15), (0.0, 0.1)]
    # What the form errors multiply: one, cone index and water content on a scale of -1..1.
    over = [forward.covariates.over(density.view, what) for what in ("cone", "water")]
    for basis in forward.form(density.view):
        np.testing.assert_array_equal(basis, np.stack([np.ones(36), *over], axis=1))


def test_an_emulators_error_is_standard_normal(data):
    """Beside the inadequacy, of every simulator that has one."""
    simulated = {name: copy(s) for name, s in data.simulated.items()}
    simulated["rut_depth"].n_errors = 2
    emulated = replace(data)
    emulated.__dict__["simulated"] = simulated
    forward = Forward(emulated, Hypothesis("none"), SIGMA)
    found = [(p.name, p.loc, p.scale) for p in forward.priors.entries[forward.n_shared - 2 :]]
    assert found == [("rut_depth.emulator", 0.0, 1.0)] * 2


def test_lab_field_and_simulator_are_the_same_in_one_call_or_two(data):
    lab_mode = {o.name: centre_of(o) for o in data.outputs}
    for h in (
        Hypothesis("none"), single(data, "slip_zero_shift"), shifts(data)[0], unknowns(data)[0],
    ):  # fmt: skip
        forward = Forward(data, h, SIGMA, lab_mode)
        psi = centre(forward)
        psi += 0.05 * np.random.default_rng(4).standard_normal(psi.shape)
        lab, field = forward.lab(psi), forward.field(psi, data.view)
        plain = forward.simulator(psi, data.view)
        found = (*forward.campaigns(psi), *forward.field_and_plain(psi, data.view))
        for one, other in zip((*found, *forward.plain(psi)), (lab, field, field, plain, lab, plain),
                              strict=True):  # fmt: skip
            assert set(one) == set(data.names)
            for o in data.names:
                np.testing.assert_allclose(one[o], other[o], rtol=1e-12)
        if h.name != "none":
            assert not np.allclose(field["drawbar_pull"], plain["drawbar_pull"], rtol=1e-4)


@pytest.mark.parametrize("shift_as", ["alone", "soil"])
def test_a_shift_moves_the_parameters_and_the_zero_of_slip(data, shift_as):
    h = Hypothesis("parameter_shift", shift=0.25, shift_as=shift_as)
    forward = Forward(data, h, SIGMA)
    psi = centre(forward, 3)
    shift = 0.4 * np.random.default_rng(6).standard_normal((3, len(psi.T) - forward.n_shared))
    psi[:, forward.shift_slice] = shift
    found = forward.field(psi, data.view)
    error = (shift @ forward.shift.radius_error)[:, None]
    assert np.abs(error).max() > 1e-3
    for o in data.outputs:
        t = psi[:, forward.theta_slices[o.name]] + shift @ forward.shift.parameters[o.name].T
        conditions = o.problem.bound.model.select(data.view.conditions)
        slip = conditions["slip_ratio"]
        truly = conditions | {"slip_ratio": 1.0 - (1.0 - slip) * (1.0 - error)}
        expected = o.problem.bound.mean_response(o.priors.to_natural(t), truly)
        np.testing.assert_allclose(found[o.name], expected, rtol=1e-12)


def test_what_knows_no_slip_does_not_mind_where_its_zero_is():
    """A rut by plain Bekker, beside a pull that shows another zero of slip."""
    case = make_case(models={"drawbar_pull": "magic_formula", "rut_depth": "bekker"})
    both = campaigns(case)
    forward = Forward(both, Hypothesis("parameter_shift", shift=0.25), SIGMA)
    psi = centre(forward)
    zero = forward.shift_slice.start + int(np.argmax(forward.shift.radius_error))
    psi[:, zero] = 1.0
    found, plain = forward.field(psi, both.view), forward.simulator(psi, both.view)
    np.testing.assert_array_equal(found["rut_depth"], plain["rut_depth"])
    assert not np.allclose(found["drawbar_pull"], plain["drawbar_pull"], rtol=1e-3)


def test_form_errors_scale_what_each_effect_adds_to_those_before_it(data):
    """Of conditions first, of the output then: each by its own factor over rows."""
    names = ("slip_zero_shift", "rate_effect")
    h = joined(*(single(data, name) for name in names))
    assert [e.name for e in h.effects] == sorted(names)
    rate, zero = h.effects
    forward = Forward(data, h, SIGMA)
    psi = centre(forward, 3)
    rng = np.random.default_rng(8)
    psi[:, forward.n_shared :] += 0.3 * rng.standard_normal((3, forward.n_dim - forward.n_shared))
    plain, found = forward.simulator(psi, data.view), forward.field(psi, data.view)
    phi = [
        p.to_natural(psi[:, part])
        for p, part in zip(h.effect_priors, forward.phi_slices, strict=True)
    ]
    basis = forward.form(data.view)
    for o in data.outputs:
        bound, role = o.problem.bound, o.role
        factor = [
            np.maximum(1.0 + psi[:, part] @ b.T, 0.0)
            for part, b in zip(forward.form_slices[o.name], basis, strict=True)
        ]
        assert np.abs(factor[0] - 1.0).max() > 0.1
        assert np.abs(factor[1] - 1.0).max() > 0.1
        columns = {role_of(c): c for c in bound.model.conditions}
        given = {known: data.view.conditions[c] for known, c in columns.items()}
        theta = o.priors.to_natural(psi[:, forward.theta_slices[o.name]])

        def predicted(conditions, bound=bound, theta=theta, columns=columns):
            return bound.mean_response(theta, {columns[k]: v for k, v in conditions.items()})

        first = rate.on_conditions(phi[0], role, given, data.view)
        second = zero.on_conditions(phi[1], role, first, data.view)
        location = plain[o.name] + (predicted(first) - plain[o.name]) * factor[0]
        location = location + (predicted(second) - predicted(first)) * factor[1]
        added = rate.on_output(phi[0], role, location, data.view) - location
        np.testing.assert_allclose(found[o.name], location + added * factor[0], rtol=1e-10)


class Along(Effect):
    """An effect whose form is least certain along what it is given."""

    name = "along"
    form = ("shape",)
    outputs = ("pull",)

    def __init__(self, values) -> None:
        self.values = np.array(values, float)

    def shape(self, view):
        return np.resize(self.values, view.slip().size)


@pytest.mark.parametrize(
    ("values", "basis"),
    [
        ([2.0, 6.0, 5.0], [-1.0, 1.0, 0.5]),
        ([-6.0, -2.0, -3.0], [-1.0, 1.0, 0.5]),
        ([0.0, 2e-9], [-1.0, 1.0]),
        # What is constant to rounding is no covariate.
        ([0.0, 1e-9], None),
        ([3.0], None),
    ],
)
def test_along_its_own_covariate_it_is_on_the_fields_scale(data, values, basis):
    h = Hypothesis("along", (Along(values),), (Priors(()),))
    forward = Forward(data, h, SIGMA)
    (found,) = forward.form(data.view)
    part = forward.form_slices["drawbar_pull"][0]
    if basis is None:
        assert found.shape == (27, 0)
        assert part.stop == part.start
    else:
        np.testing.assert_allclose(found[:, 0], np.resize(basis, 27))
        assert [p.scale for p in forward.priors.entries[part]] == [0.18]


def test_beyond_the_field_the_form_of_an_effect_ends(data):
    class OverSlip(Along):
        def shape(self, view):
            return view.slip()

    h = Hypothesis("along", (OverSlip(()),), (Priors(()),))
    slip = data.view.slip()
    middle, half = 0.5 * (slip.max() + slip.min()), 0.5 * np.ptp(slip)
    u = np.array([-9.0, -1.6, -1.4, -1.0, 0.5, 1.4, 1.6, 9.0])
    elsewhere = data.at_conditions({"slip_ratio": middle + half * u})
    (found,) = Forward(data, h, SIGMA).form(elsewhere)
    np.testing.assert_allclose(found[:, 0], [-1.5, -1.5, -1.4, -1.0, 0.5, 1.4, 1.5, 1.5])


def centre_of(output) -> np.ndarray:
    return np.array([p.loc for p in output.priors.free])


def test_a_hypothesis_of_which_nothing_is_said_is_the_simulator():
    """Of a free discrepancy waves fall off from the fourth; it varies with every condition."""
    said = Hypothesis(
        "none", effects=(), effect_priors=(), shift=0.0, shift_as="alone", smooth=0.0,
        smooth_outputs=(), smooth_over="all", smooth_decay=4.0, onset_over=None, share=1.0,
    )  # fmt: skip
    assert Hypothesis("none") == said
