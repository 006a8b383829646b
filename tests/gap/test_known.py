"""What physics says of an effect holds for its formula and for the family of shapes about it."""

from __future__ import annotations

import numpy as np
import pytest

from calib.gap.campaigns import campaigns
from calib.gap.effects import EFFECTS, Effect, Known, View
from calib.gap.forward import Forward
from calib.gap.hypotheses import Hypothesis, dependences, effect_priors
from calib.models.base import Array
from tests.gap.cases import NOISE, campaigns_of, make_case

FACTS = [(e, known) for e in EFFECTS.values() for known in e.known]
SLIPS = np.linspace(0.0, 0.65, 40)
DRAWS = 400


@pytest.fixture(scope="module")
def data():
    return campaigns_of(None)


def along(data, role: str, values: Array) -> View:
    """The field's first row, at several values of one condition."""
    rows = {c: np.full(values.size, v[0]) for c, v in data.view.conditions.items()}
    rows[data.view.column(role)] = values
    return data.at_conditions(rows)


def drawn(data, effect: Effect, output: str, *, family: bool) -> tuple[Forward, str, Array]:
    """Parameters from the priors, with the form errors or without."""
    h = Hypothesis(effect.name, (effect,), (effect_priors(data, effect),))
    forward = Forward(data, h, {o: NOISE[o] for o in data.names})
    psi = forward.priors.sample(np.random.default_rng(3), DRAWS)
    name = next(o for o, role in forward.roles.items() if role == output)
    if not family:
        psi[:, forward.form_slices[name][0]] = 0.0
    return forward, name, psi


def added(forward: Forward, name: str, psi: Array, view: View) -> Array:
    full, plain = forward.field_and_plain(psi, view)
    change = full[name] - plain[name]
    return change[np.isfinite(change).all(axis=1)]


def shown(data, effect: Effect) -> bool:
    return effect.not_testable(data.view, data.roles) is None


@pytest.mark.parametrize(("effect", "known"), FACTS, ids=[f"{e.name}-{k.output}" for e, k in FACTS])
def test_sign_and_zeros_hold_for_every_shape_of_an_effect(data, effect, known):
    if not shown(data, effect):  # water content is not recorded in this case
        assert effect.name == "moisture_softening"
        return
    forward, name, psi = drawn(data, effect, known.output, family=True)
    # Ten times the form errors: no shape of whatever size changes the sign.
    psi[:, forward.form_slices[name][0]] *= 10.0
    assert (known.sign * added(forward, name, psi, data.view) >= 0.0).all()
    for role in known.zero_at:
        none = 0.0 if role == "slip" else data.view.lab_of(role)
        at = added(forward, name, psi, along(data, role, np.array([none])))
        assert at.size > 0.8 * DRAWS
        np.testing.assert_allclose(at, 0.0, atol=1e-12)


class Bogging(Effect):
    """Takes a part of the pull that there is."""

    name = "bogging"
    title = "part of the pull is lost"
    parameters = ("loss",)
    form = ("slip",)
    known = (Known("pull", -1, at_most="the pull that there is"),)
    outputs = ("pull",)
    priors = """
model = "bogging"

[parameters.loss]
dist = "half_normal"
sd = 0.6
unit = "1"
reason = "A test's"
source = "None"
"""

    def on_output(self, phi: Array, output: str, location: Array, view: View) -> Array:
        return location - np.maximum(location, 0.0) * phi[:, :1]


def test_no_shape_takes_more_of_the_pull_than_there_is(data):
    forward, name, psi = drawn(data, Bogging(), "pull", family=True)
    psi[:, forward.form_slices[name][0]] *= 10.0
    full, plain = forward.field_and_plain(psi, along(data, "slip", SLIPS))
    known = np.isfinite(plain[name]).all(axis=1)
    full, plain = full[name][known], plain[name][known]
    assert ((full == 0.0) & (plain > 0.0)).any()  # some shapes reach the bound
    assert (full[plain > 0.0] >= 0.0).all()
    np.testing.assert_array_equal(full[plain <= 0.0], plain[plain <= 0.0])


def test_softening_takes_no_more_than_the_gross_thrust(data):
    effect = EFFECTS["post_peak_softening"]
    forward, name, psi = drawn(data, effect, "pull", family=True)
    resistance = forward.hypothesis.effect_priors[0].to_natural(psi[:, forward.phi_slices[0]])[
        :, 3:
    ]
    psi[:, forward.phi_slices[0].start] *= 3.0
    view = along(data, "slip", SLIPS)
    full, plain = forward.field_and_plain(psi, view)
    rest = -resistance * view.load_kn
    known = np.isfinite(plain[name]).all(axis=1)
    full, plain, rest = full[name][known], plain[name][known], rest[known]
    at_bound = np.isclose(full, rest, rtol=1e-12)
    assert (at_bound & (plain > rest)).any()  # some take all of it
    assert (full >= np.minimum(plain, rest) - 1e-12).all()


def test_strength_that_is_lost_past_the_peak_is_the_gross_thrusts(data):
    """A wheel that just moves itself pulls less than nothing then, by what resists its motion."""
    effect = EFFECTS["post_peak_softening"]
    forward, _, psi = drawn(data, effect, "pull", family=False)
    part = forward.phi_slices[0]
    pulls = np.array([-2.0, -0.5, 0.0, 0.7])
    view = along(data, "slip", np.full(4, 0.5))
    phi = forward.hypothesis.effect_priors[0].to_natural(psi[:, part])
    loss, peak, scale, resistance = phi.T[..., None]
    beyond = -np.expm1(-np.maximum(0.5 - peak, 0.0) / scale)
    thrust = np.maximum(pulls + resistance * view.load_kn, 0.0)
    found = effect.on_output(phi, "pull", np.tile(pulls, (DRAWS, 1)), view)
    np.testing.assert_allclose(found, pulls - thrust * loss * beyond, rtol=1e-12)
    assert (found[:, 2] < 0.0).mean() > 0.9
    assert (found[:, 0] == -2.0).mean() > 0.9


GROWING = [(e, k) for e, k in FACTS if k.grows_with]


@pytest.mark.parametrize(
    ("effect", "known"), GROWING, ids=[f"{e.name}-{k.output}" for e, k in GROWING]
)
def test_what_grows_grows_by_the_formula_and_in_nine_of_ten_of_its_family(data, effect, known):
    assert known.grows_with == ("slip",)
    for family, part, most in ((False, 1e-6, 0.0), (True, 0.25, 0.1)):
        forward, name, psi = drawn(data, effect, known.output, family=family)
        size = np.abs(added(forward, name, psi, along(data, "slip", SLIPS)))
        fall = (np.maximum.accumulate(size, axis=1) - size).max(axis=1)
        assert (fall > part * size.max(axis=1)).mean() <= most


def test_a_dependence_is_nothing_at_the_laboratorys_condition():
    data = campaigns(make_case("rate_effect"))
    effects = [e for e in dependences(data).values() if shown(data, e)]
    assert effects
    for effect in effects:
        assert [k.output for k in effect.known] == list(effect.outputs)
        for known in effect.known:
            (role,) = known.zero_at
            forward, name, psi = drawn(data, effect, known.output, family=True)
            lab = np.array([data.view.lab_of(role)])
            at = added(forward, name, psi, along(data, role, lab))
            np.testing.assert_allclose(at, 0.0, atol=1e-12)


def test_facts_compare_by_what_they_say():
    assert Known("pull", -1) == Known("pull", -1, (), ())
    assert EFFECTS["lug_thrust"].known[0].sign == 1
