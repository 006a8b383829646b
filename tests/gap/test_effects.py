"""Each effect does nothing at zero size, and otherwise what its title says, where it says."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from calib.data.quantities import role_of
from calib.gap.effects import EFFECTS, Effect, View
from calib.gap.effects.base import saturating
from calib.gap.effects.dependence import DependsOn
from calib.inference.prior_files import default_priors, read_priors
from calib.models.card import text
from tests.gap.cases import make_case, parameters, simulate

OUTPUTS = ("pull", "sinkage", "density")
# Parameters that make an effect vanish when they are zero; those of its shape keep some value.
SIZES = {
    "slip_zero_shift": ("radius_error",),
    "force_offset": ("offset",),
    "sensor_drift": ("drift",),
    "sensor_step": ("jump",),
    "pressure_gauge_bias": ("gain", "offset"),
    "multipass_compaction": ("pull", "slope", "resistance", "rut", "rut_slip"),
    "rate_effect": ("pull", "slope", "resistance", "rut", "rut_slip"),
    "moisture_softening": ("pull", "slope", "resistance", "rut", "rut_slip"),
    "bulldozing_resistance": ("resistance",),
    "lug_thrust": ("thrust", "digging"),
    "slip_sinkage": ("growth",),
    "rut_rebound": ("towed", "growth"),
    "post_peak_softening": ("loss",),
    "load_transfer": ("transfer",),
    "cone_index_bias": ("gain", "offset"),
    "water_content_bias": ("gain", "offset"),
}
# A size, and the sign of the change it must make in pull and rut (None: none at all).
SOME: Mapping[str, tuple[Mapping[str, float], int | None, int | None]] = {
    "slip_zero_shift": ({"radius_error": 0.05}, 1, 1),
    "force_offset": ({"offset": 0.2}, 1, None),
    "sensor_drift": ({"drift": 0.2, "curvature": 1.0, "half_way": 1e9, "zero_at": 0.0}, 1, None),
    "sensor_step": ({"jump": 0.2, "zero_at": 0.0}, 1, None),
    "pressure_gauge_bias": ({"gain": 0.3}, -1, 1),
    "multipass_compaction": ({"pull": 0.1, "rut": -0.1}, 1, -1),
    "rate_effect": ({"pull": 0.1, "rut": -0.1}, 1, -1),
    "moisture_softening": ({"pull": -0.1, "rut": 0.1}, -1, 1),
    "bulldozing_resistance": ({"resistance": 0.05}, -1, None),
    "lug_thrust": ({"thrust": 0.1, "digging": 0.3}, 1, 1),
    "slip_sinkage": ({"growth": 0.8, "pull_loss": 0.05}, -1, 1),
    "rut_rebound": (
        {"towed": 0.05, "growth": 0.5, "slip_exponent": 1.0, "half_way": 1e9},
        None,
        -1,
    ),
    "post_peak_softening": ({"loss": 0.4, "peak_slip": 0.2, "slip_scale": 0.2}, -1, None),
    "load_transfer": ({"transfer": 0.4}, 1, 1),
}
K = 3


@pytest.fixture(scope="module")
def view() -> View:
    """Twenty rows with every covariate, all at or above the laboratory's values."""
    n = 20
    slip = np.linspace(0.05, 0.6, n)
    base = {
        "pull": np.tile(1.4 * (1.0 - np.exp(-slip / 0.1)), (K, 1)),
        "sinkage": np.tile(30.0 * (1.0 + slip), (K, 1)),
        "density": np.full((K, n), 1.5),
    }
    return View(
        conditions={
            "run_order": np.arange(n, dtype=float),
            "slip_ratio": slip,
            "inflation_pressure_psi": np.resize([18.0, 30.0, 42.0], n),
            "average_ground_pressure_kpa": np.resize([110.0, 140.0, 178.0], n),
            "speed_m_s": np.resize([0.5, 1.0, 2.0], n),
            "pass_number": np.resize([2.0, 3.0, 4.0], n),
            "gravimetric_water_content": np.linspace(0.07, 0.12, n),
            "cone_index_kpa": np.linspace(300.0, 900.0, n),
        },
        lab={"speed_m_s": 0.3, "pass_number": 1.0, "gravimetric_water_content": 0.06,
             "cone_index_kpa": 500.0},
        load_kn=5.0,
        ground_exponent=0.5,
        order_range=(0.0, n - 1.0),
        base=base,
    )  # fmt: skip


def by_role(view: View) -> dict[str, np.ndarray]:
    """Return a view's conditions as effects are given them."""
    return {role_of(column): values for column, values in view.conditions.items()}


def predict(output: str, conditions: dict[str, np.ndarray]) -> np.ndarray:
    """Predict by simple laws: pull rises with slip and falls with pressure, the rut grows."""
    slip, psi = conditions["slip"], conditions["pressure"]
    if output == "pull":
        return 1.4 * (1.0 - np.exp(-slip / 0.1)) - 0.01 * psi
    if output == "sinkage":
        return np.log(30.0 * (1.0 + slip) * (conditions["ground_pressure"] / 140.0))
    return 1.2 + 1e-4 * conditions["cone"] + conditions["water"]


def apply(name: str, size: Mapping[str, float], output: str, view: View) -> np.ndarray:
    """Return the change that an effect makes, shape (k, n)."""
    effect = EFFECTS[name]
    phi = np.tile(parameters(name, size), (K, 1))
    plain = np.tile(predict(output, by_role(view)), (K, 1))
    conditions = effect.on_conditions(phi, output, by_role(view), view)
    location = predict(output, conditions) * np.ones((K, 1))
    changed = effect.on_output(phi, output, location, view)
    assert changed.shape == (K, 20)
    return changed - plain


def test_every_effect_is_tested_here():
    assert set(SIZES) == set(EFFECTS)
    assert set(SOME) | {"cone_index_bias", "water_content_bias"} == set(EFFECTS)


@pytest.mark.parametrize("name", EFFECTS)
@pytest.mark.parametrize("output", OUTPUTS)
def test_nothing_happens_at_zero_size(name, output, view):
    # Rounding only: a few units in the last place of numbers of size one.
    np.testing.assert_allclose(
        apply(name, dict.fromkeys(SIZES[name], 0.0), output, view), 0.0, atol=1e-12
    )


@pytest.mark.parametrize("name", SOME)
def test_it_acts_in_its_direction_on_its_outputs(name, view):
    size, *signs = SOME[name]
    for output, sign in zip(("pull", "sinkage"), signs, strict=True):
        change = apply(name, size, output, view)
        if sign is None:
            np.testing.assert_allclose(change, 0.0, atol=1e-12)
        else:
            assert (sign * change >= -1e-12).all()
            assert (sign * change).max() > 0.01
    np.testing.assert_allclose(apply(name, size, "density", view), 0.0, atol=1e-12)


@pytest.mark.parametrize("name", SOME)
def test_outputs_that_it_changes_are_the_ones_it_states(name, view):
    largest = {o: np.abs(apply(name, SOME[name][0], o, view)).max() for o in OUTPUTS[:2]}
    changed = {o for o, size in largest.items() if size > 1e-9}
    stated = set(EFFECTS[name].outputs)
    # Digging deeper costs pull, but pull alone could not show slip sinkage: it states the rut.
    allowed = {"pull"} if name == "slip_sinkage" else set()
    assert stated <= changed <= stated | allowed


def test_amounts(view):
    np.testing.assert_allclose(apply("force_offset", {"offset": 0.2}, "pull", view), 0.2)
    drift = apply(
        "sensor_drift",
        {"drift": 0.2, "curvature": 1.0, "half_way": 1e9, "zero_at": 0.25},
        "pull",
        view,
    )[0]
    # Linear from the first run to the last, about its zero; the first run is taken at u = 0.001.
    np.testing.assert_allclose(drift, 0.2 * (np.arange(20) / 19.0 - 0.25), atol=3e-4)
    rate = apply("rate_effect", {"rut": 0.5}, "sinkage", view)[0]
    np.testing.assert_allclose(rate, 0.5 * np.log(view.conditions["speed_m_s"] / 0.3))
    rut = apply(
        "rut_rebound",
        {"towed": 0.1, "growth": 0.5, "slip_exponent": 1.0, "half_way": 1e9},
        "sinkage",
        view,
    )[0]
    np.testing.assert_allclose(rut, -0.1 - 0.5 * view.slip())
    lug = apply("lug_thrust", {"thrust": 0.1, "slip_scale": 0.2}, "pull", view)[0]
    np.testing.assert_allclose(lug, 0.5 * -np.expm1(-view.slip() / 0.2))


@pytest.mark.parametrize(
    ("curvature", "half_way"), [(0.7, 0.1), (1.0, 4.0), (2.5, 2.5), (5.0, 0.3), (7.0, 0.6)]
)
def test_a_fit_of_a_drift_begins_with_one_of_about_its_shape_size_and_zero(
    view, curvature, half_way
):
    """From a warm-up no fit gets to a drift from one level to another, whatever its size."""
    effect = EFFECTS["sensor_drift"]
    drawn = np.tile(parameters("sensor_drift", {}), (32, 1))
    true = parameters("sensor_drift", {"drift": -0.4, "curvature": curvature, "half_way": half_way,
                                       "zero_at": 0.3})  # fmt: skip
    left = effect.on_output(true, "pull", np.zeros((1, 20)), view)[0]
    seen = left.copy()
    seen[3] = np.nan
    begun = effect.begun(drawn, {"pull": seen}, view)
    off = effect.on_output(begun, "pull", np.zeros((32, 20)), view) - left
    assert np.sqrt(np.square(off).mean(axis=1)).min() < 0.1 * np.ptp(left)
    assert (begun[:, 0] < 0.0).all()
    # Its shape may be known: what was drawn of it is among the guesses, as large as suits it.
    np.testing.assert_array_equal(begun[7:, 1:3], drawn[7:, 1:3])
    assert (begun[7:, 0] != drawn[7:, 0]).all()
    np.testing.assert_array_equal(effect.begun(drawn, {"pull": np.full(20, np.nan)}, view), drawn)
    # Nothing that is left, or the same in all runs, is as good as no drift.
    for alike in (0.3, 0.0):
        begun = effect.begun(drawn, {"pull": np.full(20, alike)}, view)
        np.testing.assert_allclose(begun[:, 0], 0.0, atol=1e-12)
        assert ((begun[:, 3] > 0.0) & (begun[:, 3] < 1.0)).all()


def test_a_step_is_one_constant_before_a_run_and_another_after_it(view):
    size = {"jump": 0.3, "zero_at": 1.0 / 3.0, "change_point": 9.5 / 19.0, "duration": 1e-9}
    step = apply("sensor_step", size, "pull", view)[0]
    np.testing.assert_allclose(step, np.where(np.arange(20) < 10, -0.1, 0.2), atol=1e-6)
    # In the middle of a run it reads in between; over a longer time it rises with the runs.
    middle = apply("sensor_step", size | {"change_point": 9.0 / 19.0}, "pull", view)[0]
    assert middle[9] == pytest.approx(0.05)
    slow = apply("sensor_step", size | {"duration": 3.0 / 19.0}, "pull", view)[0]
    np.testing.assert_allclose(np.diff(slow)[8:11], 0.3 / 4.0)


def test_a_fit_of_a_step_begins_with_what_is_left_on_its_sides(view):
    effect = EFFECTS["sensor_step"]
    drawn = np.tile(parameters("sensor_step", {"change_point": 9.5 / 19.0}), (2, 1))
    left = np.where(np.arange(20) < 10, 0.3, -0.1)
    left[3] = np.nan
    begun = effect.begun(drawn, {"pull": left}, view)
    # Begun wide, a tenth of the campaign, so that the sides mix a little.
    np.testing.assert_allclose(begun[:, :2], [[-0.4, 0.75]] * 2, atol=0.06)
    np.testing.assert_allclose(begun[:, 2], 0.5)
    assert drawn[0, 0] == 0.0
    # An error of both sides alike, or none at all, is no step: it begins zeroed within itself.
    for alike in (0.3, 0.0):
        begun = effect.begun(drawn, {"pull": np.full(20, alike)}, view)
        assert np.isfinite(begun).all()
        assert ((begun[:, 1] > 0.0) & (begun[:, 1] < 1.0)).all()


def test_true_slip_from_a_wrong_rolling_radius(view):
    phi = parameters("slip_zero_shift", {"radius_error": 0.1})
    changed = EFFECTS["slip_zero_shift"].on_conditions(phi, "pull", by_role(view), view)
    np.testing.assert_allclose(1.0 - changed["slip"][0], 0.9 * (1.0 - view.slip()))


def test_pressure_drags_ground_pressure_along(view):
    size = {"gain": np.log(1.21), "offset": 0.0, "rolling_radius": 0.0}
    phi = parameters("pressure_gauge_bias", size)
    changed = EFFECTS["pressure_gauge_bias"].on_conditions(phi, "sinkage", by_role(view), view)
    # Twenty-one per cent, to the power of a half.
    ratio = changed["ground_pressure"] / view.conditions["average_ground_pressure_kpa"]
    np.testing.assert_allclose(ratio, 1.1)
    np.testing.assert_allclose(changed["slip"][0], view.slip(), rtol=1e-12)


def test_at_another_pressure_the_wheel_rolls_on_another_radius(view):
    gain = {"gain": np.log(1.21), "offset": 0.0, "ground": 1.0, "rolling_radius": 0.05}
    changed = EFFECTS["pressure_gauge_bias"].on_conditions(
        parameters("pressure_gauge_bias", gain), "pull", by_role(view), view
    )
    larger = 0.05 * np.log(1.21)
    np.testing.assert_allclose(1.0 - changed["slip"][0], (1.0 - larger) * (1.0 - view.slip()))


@pytest.mark.parametrize(
    ("name", "role"),
    [("cone_index_bias", "cone"), ("water_content_bias", "water")],
)  # fmt: skip
def test_probes_change_what_they_read(name, role, view):
    up = EFFECTS[name].on_conditions(
        parameters(name, {"gain": 0.2, "offset": 0.0}), "density", by_role(view), view
    )
    np.testing.assert_allclose(up[role][0], np.exp(0.2) * view.of(role))
    others = {k: v for k, v in up.items() if k != role}
    assert all(v is view.of(k) for k, v in others.items())


def test_softening_begins_past_the_peak(view):
    change = apply(
        "post_peak_softening",
        {"loss": 0.4, "peak_slip": 0.3, "slip_scale": 0.2, "resistance": 0.1},
        "pull",
        view,
    )[0]
    np.testing.assert_allclose(change[view.slip() <= 0.3], 0.0, atol=1e-12)
    lost = change / (predict("pull", by_role(view)) + 0.1 * view.load_kn)
    assert (np.diff(lost[view.slip() > 0.3]) < 0.0).all()


def test_bulldozing_grows_with_sinkage_and_slip(view):
    size = {"resistance": 0.05, "sinkage_exponent": 1.0, "slip_growth": 1.0}
    change = apply("bulldozing_resistance", size, "pull", view)[0]
    assert (np.diff(change) < 0.0).all()
    shallow = replace(view, base={**view.base, "sinkage": 0.5 * view.base["sinkage"]})
    halved = apply("bulldozing_resistance", size, "pull", shallow)[0]
    np.testing.assert_allclose(halved, 0.5 * change)


def test_soil_effects_vanish_at_the_laboratorys_covariate(view):
    at_lab = {"pass_number": 1.0, "speed_m_s": 0.3, "gravimetric_water_content": 0.06}
    same = replace(
        view, conditions={**view.conditions, **{k: np.full(20, v) for k, v in at_lab.items()}}
    )
    for name in ("multipass_compaction", "rate_effect", "moisture_softening"):
        for output in ("pull", "sinkage"):
            change = apply(name, dict.fromkeys(SIZES[name], 0.2), output, same)
            np.testing.assert_allclose(change, 0.0, atol=1e-12)


def test_motion_resistance_is_of_the_load_and_rises_along_the_covariate(view):
    for name in ("multipass_compaction", "rate_effect", "moisture_softening"):
        change = apply(name, {"resistance": 0.02}, "pull", view)[0]
        h = EFFECTS[name].covariate(view)
        np.testing.assert_allclose(change, 0.02 * h * view.load_kn, atol=1e-12)
        assert np.abs(h).max() > 0.1


def test_dependence_on_a_condition_is_its_equation(view):
    """On a temperature: its difference over half its range; the pull has an additive part."""
    warm = replace(
        view, lab={**view.lab, "tyre_temperature_c": 20.0},
        conditions={**view.conditions, "tyre_temperature_c": np.linspace(20.0, 40.0, 20)},
    )  # fmt: skip
    logs = {"pull": False, "sinkage": True}
    effect = DependsOn("tyre_temperature_c", "tyre_temperature_c", logs, 10.0)
    assert effect.parameters == (
        "pull_slope", "pull_bend", "sinkage_slope", "sinkage_bend", "pull_offset",
    )  # fmt: skip
    u = effect.covariate(warm)
    np.testing.assert_allclose(u, np.linspace(0.0, 2.0, 20))
    phi = np.array([[0.3, -0.1, 0.2, 0.05, 0.02]])
    pull = effect.on_output(phi, "pull", np.full((1, 20), 1.5), warm)[0]
    np.testing.assert_allclose(pull, 1.5 * np.exp(0.3 * u - 0.1 * u**2) + 0.02 * u * 5.0)
    rut = effect.on_output(phi, "sinkage", np.full((1, 20), 3.0), warm)[0]
    np.testing.assert_allclose(rut, 3.0 + 0.2 * u + 0.05 * u**2)


@pytest.mark.parametrize("name", EFFECTS)
def test_every_effect_has_priors_with_units_and_reasons(name):
    priors = read_priors(
        default_priors(f"effects/{name}"), name, EFFECTS[name].parameters, {"normal_load_kn": 5}
    )
    assert [p.name for p in priors.entries] == list(EFFECTS[name].parameters)
    for p in priors.entries:
        assert p.unit
        assert len(p.reason) > 10
        assert len(p.source) > 3


@pytest.mark.parametrize("name", EFFECTS)
def test_no_size_rests_on_one_source(name):
    priors = read_priors(
        default_priors(f"effects/{name}"), name, EFFECTS[name].parameters, {"normal_load_kn": 5}
    )
    for p in priors.entries:
        if p.name in SIZES[name]:
            several = "; " in p.source or "), " in p.source
            assert several or "widened" in p.source, (p.name, p.source)


def test_reasons_why_an_effect_cannot_be_tested(view):
    both = ("pull", "sinkage")
    reason = EFFECTS["cone_index_bias"].not_testable(view, both)
    assert reason == "no bulk_density output"
    slow = {k: v for k, v in view.conditions.items() if k != "speed_m_s"}
    reason = EFFECTS["rate_effect"].not_testable(replace(view, conditions=slow), both)
    assert reason == "the data lack speed_m_s"
    still = {**view.conditions, "speed_m_s": np.full(20, 0.3)}
    reason = EFFECTS["rate_effect"].not_testable(replace(view, conditions=still), both)
    assert reason is not None
    assert "the same in every row, as in the calibration" in reason
    unknown = replace(view, conditions=still, lab={})
    reason = EFFECTS["rate_effect"].not_testable(unknown, both)
    assert reason == "speed_m_s is the same in every row, and the calibration has no such column"
    # Constant in the field, but not what it was in the laboratory: that can be seen.
    fast = {**view.conditions, "speed_m_s": np.full(20, 2.0)}
    assert EFFECTS["rate_effect"].not_testable(replace(view, conditions=fast), both) is None
    assert EFFECTS["load_transfer"].not_testable(view, ("sinkage",)) == "no drawbar_pull output"
    for effect in EFFECTS.values():
        assert effect.not_testable(view, OUTPUTS) is None


def test_in_a_campaign_as_the_laboratorys_some_effects_can_be_seen(view):
    """A covariate that nobody varied shows nothing, but a gauge may be wrong at any reading."""
    alike = {column: np.full(20, values[0]) for column, values in view.conditions.items()}
    same = replace(view, conditions=alike, lab={c: float(v[0]) for c, v in alike.items()})
    hidden = {
        name: reason
        for name, effect in EFFECTS.items()
        if (reason := effect.not_testable(same, OUTPUTS)) is not None
    }
    assert set(hidden) == {
        "sensor_drift", "sensor_step", "multipass_compaction", "rate_effect",
        "moisture_softening", "lug_thrust", "slip_sinkage", "rut_rebound", "post_peak_softening",
    }  # fmt: skip
    for name, reason in hidden.items():
        column = view.column(EFFECTS[name].covariates[0])
        assert reason == f"{column} is the same in every row, as in the calibration"
    # To a millionth of it, or where the laboratory did not record it.
    near = {c: v * np.resize([1.0, 1.0 + 9e-7], 20) for c, v in alike.items()}
    unknown = replace(same, conditions=near, lab={})
    for name in hidden:
        effect = EFFECTS[name]
        assert "no such column" in effect.not_testable(unknown, OUTPUTS)
        assert not effect.lacking(same, OUTPUTS)
        assert effect.lacking(unknown, OUTPUTS) == [view.column(effect.covariates[0])]
        assert not effect.lacking(unknown, ()), "its output is lacking as well"
    apart = {c: v * np.resize([1.0, 1.0 + 2e-6], 20) + 1e-11 for c, v in alike.items()}
    for name in hidden:
        told = EFFECTS[name].not_testable(replace(same, conditions=apart), OUTPUTS)
        assert told is None


def test_instruments_are_told_from_wheel_and_soil():
    """Of an instrument's fault what is predicted is the reading, and it can be mended."""
    assert {name for name, effect in EFFECTS.items() if effect.instrument} == {
        "slip_zero_shift", "force_offset", "sensor_drift", "sensor_step", "pressure_gauge_bias",
        "cone_index_bias", "water_content_bias",
    }  # fmt: skip


def test_an_effect_of_which_nothing_is_said_does_nothing(view):
    class LeftOut(Effect):
        name = "idle"
        outputs = ("pull",)

    effect, phi, location = LeftOut(), np.ones((K, 2)), np.ones((K, 20))
    given = by_role(view)
    assert effect.on_conditions(phi, "pull", given, view) is given
    assert effect.on_output(phi, "pull", location, view) is location
    assert effect.begun(phi, {"pull": np.ones(20)}, view) is phi
    assert effect.shape(view) is None
    assert effect.not_testable(view, ("pull",)) is None
    assert not effect.instrument


def test_signs_hold_with_the_simulators_own_curves():
    draft = make_case(noise=0.0)
    plain = simulate(draft, None)[1]
    for name in ("force_offset", "lug_thrust", "rut_rebound", "bulldozing_resistance"):
        size, *signs = SOME[name]
        acted = simulate(draft, name, size)[1]
        for output, sign in zip(("drawbar_pull", "rut_depth"), signs, strict=True):
            change = acted[output] - plain[output]
            if sign is None:
                np.testing.assert_allclose(change, 0.0, atol=1e-12)
            else:
                assert (sign * change > 0.0).all()


def test_growth_that_levels_off():
    u = np.linspace(0.01, 1.0, 50)
    one = np.ones((1, 1))
    # Far from half way it is the plain power, far beyond it a step; 0 at 0 and 1 at 1 always.
    np.testing.assert_allclose(saturating(u, 1.7 * one, 1e4 * one)[0], u**1.7, rtol=1e-5)
    steep = saturating(u, 60.0 * one, 0.5 * one)[0]
    np.testing.assert_allclose(steep[u < 0.4], 0.0, atol=1e-5)
    np.testing.assert_allclose(steep[u > 0.6], 1.0, atol=1e-4)
    assert saturating(np.ones(1), 0.6 * one, 0.2 * one) == pytest.approx(1.0)
    warm = saturating(u, one, 0.2 * one)[0]
    np.testing.assert_allclose(warm, 1.2 * u / (u + 0.2))


@pytest.mark.parametrize("name", ["lug_thrust", "load_transfer"])
def test_the_rut_alone_does_not_show_what_acts_on_the_pull(name: str, view: View) -> None:
    assert EFFECTS[name].not_testable(view, ("sinkage",)) == "no drawbar_pull output"
    assert EFFECTS[name].not_testable(view, ("pull", "sinkage")) is None


@pytest.mark.parametrize("name", EFFECTS)
def test_an_effect_names_every_output_that_it_changes(name, view):
    effect = EFFECTS[name]
    rng = np.random.default_rng(1)
    phi = rng.uniform(0.05, 0.3, (1, len(effect.parameters)))
    for output in {"pull", "sinkage", "density"} - set(effect.outputs):
        location = np.ones((1, view.slip().size))
        np.testing.assert_array_equal(effect.on_output(phi, output, location, view), location)


@pytest.mark.parametrize("name", EFFECTS)
def test_an_effects_equation_names_its_parameters(name: str) -> None:
    effect = EFFECTS[name]
    written = " ".join(map(text, effect.latex))
    for parameter in effect.parameters:
        assert parameter.replace("_", " ") in written
