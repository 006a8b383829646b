"""The forward model: hypotheses, form errors, discrepancies, shifts."""

from __future__ import annotations

import tomllib
from dataclasses import replace

import numpy as np
import pytest

from calib.data.quantities import role_of
from calib.errors import CalibError
from calib.gap import discrepancy as module
from calib.gap.campaigns import Campaigns, campaigns
from calib.gap.constants import RADIUS_ERROR, SHIFTS
from calib.gap.corrected import Corrected, load_corrected, predict_columns, save_corrected
from calib.gap.describe import shifts as shift_sizes
from calib.gap.discrepancy import ZERO_OF_SLIP, Discrepancy, another_soil, quantities
from calib.gap.effects import EFFECTS
from calib.gap.fit import Fit
from calib.gap.forward import Forward
from calib.gap.hypotheses import (
    Hypothesis,
    by_parameters,
    dependences,
    effect_priors,
    joined,
    shifts,
    singles,
    unknowns,
    with_residual_discrepancy,
)
from calib.gap.mixture import Mixture
from calib.gap.noise import Noise
from calib.inference.mode import prior_widths
from calib.inference.prior_files import default_priors
from calib.models import MODELS as KNOWN
from tests.gap.cases import MODELS, NOISE, campaigns_of
from tests.gap.fits import draws_of
from tests.gap.test_hypotheses import density_campaigns, with_load

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


def test_other_conditions_use_the_same_references(data):
    forward = Forward(data, single(data, "rate_effect"), SIGMA)
    psi = centre(forward)
    psi[:, forward.phi_slices[0].start] = 0.2
    rows = {k: v[:5] for k, v in data.view.conditions.items()}
    part = forward.field(psi, data.at_conditions(rows))
    whole = forward.field(psi, data.view)
    for o in data.names:
        np.testing.assert_allclose(part[o], whole[o][:, :5], rtol=1e-12)


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
    slip, pressure = (forward.data.scaled(view, what) for what in ("slip", "pressure"))
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
    over = [forward.data.scaled(density.view, what) for what in ("cone", "water")]
    for basis in forward.form(density.view):
        np.testing.assert_array_equal(basis, np.stack([np.ones(36), *over], axis=1))


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


@pytest.mark.parametrize(("loads", "near"), [(3, 1e-12), (27, 2e-3)])
def test_along_an_ignored_condition_parameters_shift_by_so_much_in_each_row(loads, near):
    """A wrong radius acts at the shifted parameters; of many loads, linear between nine."""
    data = campaigns(with_load(np.array([5.0]), np.linspace(2.0, 8.0, loads), 0.0))
    name = "depends_on_normal_load"
    (ignored,) = singles(data, {name: dependences(data)[name]})
    h = joined(single(data, "slip_zero_shift"), by_parameters(ignored)[-1])
    assert (h.shift, h.shift_over) == (SHIFTS[-1], name)
    forward, (o,) = Forward(data, h, SIGMA), data.outputs
    assert forward.causes == (name, "slip_zero_shift")
    psi = centre(forward, 3)
    size = (3, forward.n_dim - forward.n_shared)
    psi[:, forward.n_shared :] = 0.05 * np.random.default_rng(6).standard_normal(size)
    for part in forward.form_slices[o.name]:
        psi[:, part] = 0.0
    load, slip = data.view.of("load"), data.view.slip()
    assert np.unique(load).size > loads / 2
    u = np.log(load / 5.0)

    def expected(shift, radius, phi):
        """One row after the other."""
        found = np.empty((3, slip.size))
        for i in range(slip.size):
            t = psi[:, forward.theta_slices[o.name]]
            t = t + u[i] * shift @ forward.shift.parameters[o.name].T
            error = u[i] * shift @ forward.shift.radius_error
            truly = 1.0 - (1.0 - slip[i]) * (1.0 - radius) * (1.0 - error)
            at = {"slip_ratio": truly[:, None]}
            found[:, i] = o.problem.bound.mean_response(o.priors.to_natural(t), at)[:, 0]
        return h.effects[0].on_output(phi, o.role, found, data.view)

    phi, radius = (psi[:, part] for part in forward.phi_slices)
    every = psi[:, forward.shift_slice], radius[:, 0], phi
    plain = forward.simulator(psi, data.view)[o.name]
    for left_out, kept in ((), (1, 1, 1)), (["slip_zero_shift"], (1, 0, 1)), ([name], (0, 1, 0)):
        found = forward.without(psi, data.view, *left_out)[o.name]
        right = expected(*(k * part for k, part in zip(kept, every, strict=True)))
        np.testing.assert_allclose(found, right, rtol=0.0, atol=near)
        assert np.abs(found - plain).max() > 0.02


@pytest.mark.parametrize(("field", "farthest"), [(8.0, np.log(8.0 / 5.0)), (50.0, 1.0)])
def test_parameters_shift_along_a_condition_by_as_much_as_by_themselves_at_most(field, farthest):
    data = campaigns(with_load(np.array([5.0]), np.array([5.0, field]), 0.0))
    name = "depends_on_normal_load"
    (ignored,) = singles(data, {name: dependences(data)[name]})
    forward = Forward(data, by_parameters(ignored)[-1], SIGMA)
    assert forward.along(data.view).max() == pytest.approx(farthest)
    there = data.at_conditions({"slip_ratio": np.array([0.2]), "normal_load_kn": np.array([5.0])})
    assert forward.along(there) == pytest.approx(0.0)


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


def centre_of(output) -> np.ndarray:
    return np.array([p.loc for p in output.priors.free])


PULL = ("drawbar_pull",)


@pytest.fixture(scope="module")
def smooth() -> Campaigns:
    return campaigns_of(None)


def of(smooth: Campaigns, **kwargs) -> Discrepancy:
    lab_mode = {o.name: np.array([p.loc for p in o.priors.free]) for o in smooth.outputs}
    h = Hypothesis("unknown", smooth=1.0, smooth_outputs=PULL, **kwargs)
    return Discrepancy(smooth, h, lab_mode)


@pytest.mark.parametrize(
    "over",
    ["slip", "ripple", "level", "sinkage", "order", "pressure", "speed", "passes", "water", "all"],
)
def test_it_is_the_same_function_at_other_conditions(smooth, over):
    found = of(smooth, smooth_over=over)
    amplitudes = np.random.default_rng(1).standard_normal((3, found.sds("drawbar_pull").size))
    whole = found.at(amplitudes, np.empty(0), smooth.view, "drawbar_pull")
    rows = np.array([4, 0, 17])
    some = replace(
        smooth.view,
        conditions={k: v[rows] for k, v in smooth.view.conditions.items()},
    )
    part = found.at(amplitudes, np.empty(0), some, "drawbar_pull")
    np.testing.assert_allclose(part, whole[:, rows], atol=1e-12)


def test_it_sets_in_at_a_threshold_as_a_step_and_a_bend_of_what_it_was_before(smooth):
    found = of(smooth, onset_over="slip")
    np.testing.assert_array_equal(found.sds("drawbar_pull"), [1.0, 2.0, 0.5])
    u = found.onset_covariate(smooth.view, "drawbar_pull")
    step, bend, before = found.onset(smooth.view, "drawbar_pull", np.array([0.1]))
    far = abs(u - 0.1) > 0.6  # ten widths
    np.testing.assert_allclose(step[0, far], (u > 0.1)[far], atol=1e-4)
    np.testing.assert_allclose(bend[0, far], np.maximum(u - 0.1, 0.0)[far], atol=1e-4)
    np.testing.assert_array_equal(before, 1.0)
    all_three = found.at(np.array([[0.2, -0.3, 0.4]]), np.array([0.1]), smooth.view, "drawbar_pull")
    np.testing.assert_allclose(all_three, 0.2 * step - 0.3 * bend + 0.4)


def test_a_reading_that_keeps_part_of_the_run_before(smooth):
    found = of(smooth, smooth_over="before")
    o = next(o for o in smooth.outputs if o.name == "drawbar_pull")
    theta = o.priors.to_natural(found.lab_mode["drawbar_pull"][None])
    selected = o.problem.bound.model.select(smooth.view.conditions)
    pull = o.problem.bound.mean_response(theta, selected)[0]
    as_they_are = found.at(np.array([[0.3]]), np.empty(0), smooth.view, "drawbar_pull")[0]
    np.testing.assert_allclose(np.sqrt(np.mean(as_they_are**2)), 0.3)
    # The order of the runs counts, not that of the rows.
    runs = np.random.default_rng(2).permutation(pull.size)
    order = np.empty(pull.size)
    order[runs] = np.arange(pull.size)
    shuffled = replace(smooth.view, conditions={**smooth.view.conditions, "run_order": order})
    gap = found.at(np.array([[0.3]]), np.empty(0), shuffled, "drawbar_pull")[0]
    kept = gap[runs[1:]] / (pull[runs[:-1]] - pull[runs[1:]])
    np.testing.assert_allclose(kept, kept[0])
    assert kept[0] > 0.0
    assert gap[runs[0]] == 0.0


DECAY = 3.0


def cosines(u: np.ndarray, most: int, scale: float) -> list[tuple[np.ndarray, float]]:
    """cos(j pi (u + 1)/2) of rms about one, the less probable the shorter its waves."""
    return [
        (
            np.sqrt(2.0) * np.cos(j * np.pi * (np.clip(u, -1.2, 1.2) + 1.0) / 2.0),
            scale / (1.0 + (j / DECAY) ** 2),
        )
        for j in range(1, most + 1)
    ]


def written_again(found: Discrepancy, view, over: str) -> list[tuple[np.ndarray, float]]:
    """The terms of a discrepancy of the pull: functions of the rows, and their sds."""
    u = {
        what: found.data.scaled(view, what)
        for what in ("slip", "order", "pressure", "speed", "passes", "load")
    }
    levels = {
        what: np.unique(values).size
        for what in u
        if (values := found.data.scaled(found.data.view, what)) is not None
    }
    one = [(np.ones(len(u["slip"])), 1.0)]
    if over in ("level", "sinkage"):
        name = "drawbar_pull" if over == "level" else "rut_depth"
        o = next(o for o in found.data.outputs if o.name == name)
        theta = o.priors.to_natural(found.lab_mode[name][None])

        def predicted(at) -> np.ndarray:
            return o.problem.bound.mean_response(
                theta, o.problem.bound.model.select(at.conditions)
            )[0]

        reference = predicted(found.data.view)
        level = 2.0 * (predicted(view) - reference.min()) / np.ptp(reference) - 1.0
        return one + cosines(np.clip(level, -1.5, 1.5), 8, 0.8)
    if over == "order":
        return one + cosines(u["order"], 12, 0.7)
    if over in ("pressure", "speed", "passes"):
        terms = cosines(u[over], min(levels[over] - 1, 6), 0.8)
        level = written_level(found, view)
        return [*one, *terms, (level, 0.5), *((level * b, 0.6 * w) for b, w in terms)]
    slips = cosines(u["slip"], 10, 0.7)
    terms = list(slips)
    if over == "all":
        terms += cosines(u["order"], 6, 0.5)
    bends = 2 if over == "all" else 1
    for b, w in cosines(u["pressure"], min(levels["pressure"] - 1, bends), 0.5):
        terms += [(b, w), *((b * s, w * v) for s, v in slips[:4])]
    if over == "all":
        for what in ("speed", "passes", "load"):
            if u[what] is not None:
                terms += [*cosines(u[what], 3, 0.4), (u[what] * u["slip"], 0.4)]
    return one + terms


def written_level(found: Discrepancy, view) -> np.ndarray:
    o = next(o for o in found.data.outputs if o.name == "drawbar_pull")
    theta = o.priors.to_natural(found.lab_mode["drawbar_pull"][None])
    select = o.problem.bound.model.select
    at, reference = (
        o.problem.bound.mean_response(theta, select(v.conditions))[0]
        for v in (view, found.data.view)
    )
    return np.clip(2.0 * (at - reference.min()) / np.ptp(reference) - 1.0, -1.5, 1.5)


@pytest.mark.parametrize(
    "over", ["slip", "level", "sinkage", "order", "pressure", "speed", "passes", "all"]
)
@pytest.mark.parametrize("beyond", [False, True])
def test_terms_are_those_of_its_equations(smooth, over, beyond):
    """At the field's conditions and beyond them; what the terms are, and how large they may be."""
    found = of(smooth, smooth_over=over, smooth_decay=DECAY)
    view = smooth.view
    if beyond:
        wider = {c: v.mean() + 1.3 * (v - v.mean()) for c, v in view.conditions.items()}
        view = replace(view, conditions=wider)
    terms = written_again(found, view, over)
    sds = found.sds("drawbar_pull")
    np.testing.assert_allclose(sds, [w for _, w in terms])
    basis = found.at(np.eye(sds.size), np.empty(0), view, "drawbar_pull")
    np.testing.assert_allclose(basis, [b for b, _ in terms], atol=1e-12)


NOISE_SD = {o: NOISE[o] for o in MODELS}
SIZE = 0.25


def drawn_shifts(data, shift_as) -> dict[str, np.ndarray]:
    """Shifts of each parameter in units of its prior sd, drawn from the prior."""
    forward = Forward(data, Hypothesis("parameter_shift", shift=SIZE, shift_as=shift_as), NOISE_SD)
    psi = forward.priors.sample(np.random.default_rng(1), 40_000)[:, forward.shift_slice]
    shift = forward.shift
    assert shift is not None
    return {
        name: (psi @ shift.parameters[o.name].T)[:, i] / width
        for o in data.outputs
        for i, (name, width) in enumerate(zip(o.priors.names, prior_widths(o.priors), strict=True))
    } | {ZERO_OF_SLIP: psi @ shift.radius_error / RADIUS_ERROR}


def test_with_another_soil_they_covary_as_the_prior_file_says(data):
    file = tomllib.loads(default_priors("shifts/another_soil").read_text())["parameters"]
    ways = {name: np.array(row["ways"]) for name, row in file.items()}
    drawn = drawn_shifts(data, "soil")
    shared = {
        "K": 0.5 * (drawn["K_lo"] + drawn["K_hi"]),
        "K_difference": 0.5 * (drawn["K_hi"] - drawn["K_lo"]),
        "D": 0.5 * (drawn["D_lo"] + drawn["D_hi"]),
        "z_ref": drawn["z_ref"],
        "n0": drawn["n0"],
        "n1": drawn["n1"],
        ZERO_OF_SLIP: drawn[ZERO_OF_SLIP],
    }
    for a, x in shared.items():
        for b, y in shared.items():
            expected = ways[a] @ ways[b] + (file[a]["own"] ** 2 if a == b else 0.0)
            scale = x.std() * y.std()
            assert np.mean(x * y) == pytest.approx(SIZE**2 * expected, abs=0.03 * scale), (a, b)


def test_a_softer_soil_gives_less_pull_and_deeper_ruts(data):
    drawn = drawn_shifts(data, "soil")
    assert np.corrcoef(drawn["D_lo"], drawn["z_ref"])[0, 1] < -0.2
    assert np.corrcoef(drawn["K_lo"], drawn["D_lo"])[0, 1] > 0.3


def test_the_prior_names_quantities_of_the_models_and_says_where_it_comes_from():
    known = {q for m in KNOWN.values() for q in quantities(m.parameters)}
    assert set(another_soil()) <= known | {ZERO_OF_SLIP}
    content = tomllib.loads(default_priors("shifts/another_soil").read_text())
    for key in ("unit", "reason", "source"):
        assert len(content[key]) > 5
    assert len(content["ways"]) == len(next(iter(another_soil().values()))[0])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("ways = [", "cannot be read"),
        ('unit = "1"\nreason = "x"\nsource = "y"\nways = []\n', "cannot be read"),
        (
            'unit = "1"\nreason = "x"\nsource = "y"\nways = ["a", "b"]\n'
            "[parameters.K]\nways = [1.0]\nown = 0.5\n",
            "as many loadings",
        ),
    ],
)
def test_a_damaged_prior_is_refused(tmp_path, monkeypatch, text, said):
    (tmp_path / "another_soil.toml").write_text(text)
    monkeypatch.setattr(module, "default_priors", lambda _: tmp_path / "another_soil.toml")
    with pytest.raises(CalibError, match=said):
        another_soil()


def fitted(data) -> Fit:
    """A soil that shifted by one sd of its first coordinate."""
    forward = Forward(data, Hypothesis("parameter_shift", shift=SIZE, shift_as="soil"), NOISE_SD)
    psi = np.array([p.loc for p in forward.priors.free])
    psi[forward.shift_slice.start] = SIZE
    noise = {o: Noise(s) for o, s in NOISE_SD.items()}
    return Fit(forward, noise, 0.0, {}, draws_of(psi, 1e-2 * np.eye(psi.size)))


def test_the_page_tells_the_shift_of_each_parameter_not_of_a_coordinate(data):
    fit = fitted(data)
    shift = fit.forward.shift
    assert shift is not None
    matrix = shift.parameters["drawbar_pull"]
    names = data.outputs[0].priors.names
    found = {p.name: p for p in shift_sizes(data.outputs, fit)}
    for name in ("K_lo", "K_hi"):
        i = names.index(name)
        value = 100.0 * np.expm1(SIZE * matrix[i, 0])
        assert found[name].mean == pytest.approx(value, rel=0.06)
        assert found[name].unit == "percent"


def test_a_shifted_soil_is_saved_and_loaded(data, tmp_path):
    fit = fitted(data)
    mode = {o.name: np.array([p.loc for p in o.priors.free]) for o in data.outputs}
    corrected = Corrected(Mixture(data, (fit,), (1.0,), 3), mode)
    save_corrected(corrected, tmp_path)
    loaded = load_corrected(tmp_path)
    assert loaded.mixture.fits[0].forward.hypothesis.shift_as == "soil"
    before, after = (predict_columns(c, data.case.field) for c in (corrected, loaded))
    for name in (n for n in before if "_before" in n or "_after" in n):
        np.testing.assert_allclose(after[name], before[name], rtol=1e-9)


@pytest.mark.parametrize("shift_as", ["alone", "soil"])
def test_another_zero_of_slip_is_a_wrong_rolling_radius(data, shift_as):
    shifted = Forward(data, Hypothesis("parameter_shift", shift=SIZE, shift_as=shift_as), NOISE_SD)
    assert shifted.shift is not None
    psi = np.array([[p.loc for p in shifted.priors.free]])
    # Coordinates that shift the zero of slip and no parameter.
    all_rows = np.concatenate(
        [*shifted.shift.parameters.values(), shifted.shift.radius_error[None]]
    )
    only = np.linalg.solve(all_rows, np.eye(len(all_rows))[-1])
    psi[0, shifted.shift_slice] = 0.04 * only
    (wrong,) = singles(data, {"slip_zero_shift": EFFECTS["slip_zero_shift"]})
    known = Forward(data, wrong, NOISE_SD)
    other = np.array([[p.loc for p in known.priors.free]])
    other[0, known.phi_slices[0]] = 0.04
    found, expected = (f.field(x, data.view) for f, x in ((shifted, psi), (known, other)))
    for name, values in expected.items():
        np.testing.assert_allclose(found[name], values, rtol=1e-9)
        assert not np.allclose(values, shifted.simulator(psi, data.view)[name], rtol=1e-3)
