"""Each effect against its equation written again, one row and one number at a time.

Sizes are drawn wide, so that every bound of an equation is reached by some of them. Two routes to
one double-precision number differ by rounding alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import pytest

from calib.data.quantities import role_of
from calib.gap.effects import EFFECTS, Effect, View
from calib.gap.effects.dependence import DependsOn, DiffersBy, ReadingDrift, ReadingStep
from calib.inference.prior_files import DeclaredPriors, read_priors
from calib.inference.priors import Priors

N, K = 24, 16
W = 4.7
LAB = {
    "inflation_pressure_psi": 30.0, "speed_m_s": 0.4, "pass_number": 1.5,
    "gravimetric_water_content": 0.08, "cone_index_kpa": 450.0, "tyre_temperature_c": 21.0,
}  # fmt: skip
# Ranges of parameters; whatever is not here lies between -1 and 1.
POSITIVE = {
    "curvature": (0.3, 3.0), "half_way": (0.05, 20.0), "zero_at": (0.0, 1.0),
    "change_point": (0.0, 1.0), "duration": (1e-3, 0.4), "slip_scale": (0.03, 0.6),
    "peak_slip": (0.0, 0.5), "slip_exponent": (0.3, 2.0), "sinkage_exponent": (0.3, 2.0),
    "radius_error": (-0.3, 0.3),
}  # fmt: skip
# Of single effects, wide enough for the ends of their equations.
WIDE = {
    ("pressure_gauge_bias", "offset"): (-30.0, 30.0), ("load_transfer", "transfer"): (-4.0, 4.0),
    ("slip_sinkage", "growth"): (-2.0, 9.0),
}  # fmt: skip
type Row = Mapping[str, float]


def view_of(*, sinkage: bool = True, lab: bool = True) -> View:
    """Return rows of every condition, backward slips and the ends of a campaign among them."""
    rng = np.random.default_rng(11)
    base = {"pull": rng.uniform(-1.0, 9.0, (K, N)), "density": rng.uniform(1.2, 1.7, (K, N))}
    if sinkage:
        base["sinkage"] = rng.uniform(5.0, 900.0, (K, N))
    return View(
        conditions={
            "run_order": np.r_[1.0, np.arange(4.0, 2.0 + N), 60.0],
            "slip_ratio": rng.uniform(-0.1, 0.7, N),
            "inflation_pressure_psi": rng.uniform(12.0, 45.0, N),
            "average_ground_pressure_kpa": rng.uniform(80.0, 200.0, N),
            "speed_m_s": np.append(rng.uniform(0.1, 3.0, N - 1), 0.0),
            "pass_number": rng.integers(1, 9, N).astype(float),
            "gravimetric_water_content": rng.uniform(0.01, 0.3, N),
            "cone_index_kpa": rng.uniform(100.0, 900.0, N),
            "tyre_temperature_c": rng.uniform(10.0, 60.0, N),
        },
        lab=LAB if lab else {},
        load_kn=W, ground_exponent=0.45, order_range=(3.0, 1.0 + N), base=base,
    )  # fmt: skip


def brief() -> View:
    """A campaign of which the runs were counted by days: half a one from the first to the last."""
    view = view_of()
    order = 3.0 + (view.conditions["run_order"] - 3.0) / 40.0
    return replace(view, conditions=view.conditions | {"run_order": order}, order_range=(3.0, 3.5))


VIEWS = {
    "everything recorded": view_of(),
    "no sinkage, nothing known of the laboratory": view_of(sinkage=False, lab=False),
    "runs within half of one": brief(),
}


def clip(x: float, low: float, high: float) -> float:
    return min(max(x, low), high)


def growth(u: float, c: float, h: float) -> float:
    return (1.0 + h**c) * u**c / (u**c + h**c)


def over(r: Row) -> float:
    """The part of the campaign that is over."""
    return clip((r["order"] - 3.0) / r["length"], 0.0, 1.2)


def sunk(r: Row) -> float:
    return r["base_sinkage"] / 30.0 if "base_sinkage" in r else 1.0 + max(r["slip"], 0.0)


def step(p: Row, r: Row) -> float:
    h = clip((over(r) - p["change_point"]) / (p["duration"] + 1.0 / r["length"]) + 0.5, 0.0, 1.0)
    return p["jump"] * (h - p["zero_at"])


def transferred(p: Row, r: Row) -> float:
    return clip(1.0 + p["transfer"] * r["base_pull"] / W, 0.2, 5.0)


def deeper(p: Row, r: Row) -> float:
    return p["growth"] * max(r["slip"], 0.0) ** p["slip_exponent"]


def true_psi(p: Row, r: Row) -> float:
    return max(r["pressure"] * math.exp(p["gain"]) + p["offset"], 0.2 * r["pressure"])


def gauge(p: Row, r: Row) -> dict[str, float]:
    ratio = true_psi(p, r) / r["pressure"]
    return {
        "pressure": true_psi(p, r),
        "ground_pressure": r["ground_pressure"] * ratio ** (0.45 * p["ground_response"]),
        "slip": 1.0 - (1.0 - r["slip"]) * (1.0 - p["rolling_radius"] * math.log(ratio)),
    }


def cone(p: Row, r: Row) -> dict[str, float]:
    true = r["cone"] * math.exp(p["gain"]) + p["offset"] * r["lab_cone"]
    return {"cone": max(true, 0.02 * r["cone"])}


# What the conditions become: of the output where it is of one only.
CONDITIONS: Mapping[str, tuple[str, Callable[[Row, Row], dict[str, float]]]] = {
    "slip_zero_shift": (
        "", lambda p, r: {"slip": 1.0 - (1.0 - r["slip"]) * (1.0 - p["radius_error"])},
    ),
    "pressure_gauge_bias": ("", gauge),
    "cone_index_bias": ("", cone),
    "water_content_bias": (
        "", lambda p, r: {"water": max(r["water"] * math.exp(p["gain"]) + p["offset"], 0.0)},
    ),
    "load_transfer": (
        "sinkage", lambda p, r: {
            "ground_pressure": r["ground_pressure"] * transferred(p, r) ** p["pressure_exponent"]
        },
    ),
}  # fmt: skip
# How each soil effect sees its covariate; without a laboratory's value, from the field's median.
COVARIATE: Mapping[str, Callable[[Row], float]] = {
    "multipass_compaction": lambda r: math.log(r["passes"] / r["lab_passes"]),
    "rate_effect": lambda r: math.log(max(r["speed"], 1e-3) / r["lab_speed"]),
    "moisture_softening": lambda r: (r["water"] - r["lab_water"]) / 0.02,
}
PULL: Mapping[str, Callable[[Row, Row, float], float]] = {
    "force_offset": lambda p, r, y: y + p["offset"],
    "sensor_drift": lambda p, r, y: y + p["drift"]
    * (growth(max(over(r), 1e-3), p["curvature"], p["half_way"]) - p["zero_at"]),
    "sensor_step": lambda p, r, y: y + step(p, r),
    "bulldozing_resistance": lambda p, r, y: y - W * p["resistance"]
    * min(sunk(r), 20.0) ** p["sinkage_exponent"] * (1.0 + p["slip_growth"] * max(r["slip"], 0.0)),
    "lug_thrust": lambda p, r, y: y + W * p["thrust"]
    * (1.0 - math.exp(-max(r["slip"], 0.0) / p["slip_scale"])),
    "slip_sinkage": lambda p, r, y: y - W * p["pull_loss"] * sunk(r)
    * math.expm1(min(deeper(p, r), 3.0)),
    "post_peak_softening": lambda p, r, y: y - max(y + W * p["resistance"], 0.0) * p["loss"]
    * (1.0 - math.exp(-max(r["slip"] - p["peak_slip"], 0.0) / p["slip_scale"])),
    "load_transfer": lambda p, r, y: y * transferred(p, r) ** p["pull_exponent"],
}  # fmt: skip
SINKAGE: Mapping[str, Callable[[Row, Row, float], float]] = {
    "lug_thrust": lambda p, r, y: y + p["digging"] * max(r["slip"], 0.0),
    "slip_sinkage": lambda p, r, y: y + deeper(p, r),
    "rut_rebound": lambda p, r, y: y - p["towed"]
    - p["growth"] * growth(max(r["slip"], 1e-4), p["slip_exponent"], p["half_way"]),
}  # fmt: skip


def of_soil(name: str, output: str) -> Callable[[Row, Row, float], float]:
    def pull(p: Row, r: Row, y: float) -> float:
        h = COVARIATE[name](r)
        return y * math.exp(clip(p["pull"] * h, -2.0, 2.0)) + p["resistance"] * h * W

    def sinkage(p: Row, r: Row, y: float) -> float:
        return y + (p["rut"] + p["rut_slip"] * max(r["slip"], 0.0)) * COVARIATE[name](r)

    return pull if output == "pull" else sinkage


def stretched(name: str) -> Callable[[Row, Row], dict[str, float]]:
    def stretch(p: Row, r: Row) -> dict[str, float]:
        return {"slip": r["slip"] * math.exp(clip(p["slope"] * COVARIATE[name](r), -2.0, 2.0))}

    return stretch


def drawn(effect: Effect) -> np.ndarray:
    rng = np.random.default_rng(5)
    ends = [WIDE.get((effect.name, n), POSITIVE.get(n, (-1.0, 1.0))) for n in effect.parameters]
    return np.stack([rng.uniform(*end, K) for end in ends], axis=1)


def rows(view: View, k: int) -> list[dict[str, float]]:
    """Return each row of a view by roles, what is usual in the laboratory among them."""
    lab = {
        f"lab_{role_of(c)}": float(view.lab.get(c, np.median(v)))
        for c, v in view.conditions.items()
    }
    # One pass is what a laboratory makes where nothing is said.
    lab["lab_passes"] = view.lab.get("pass_number", 1.0)
    # A campaign of less than one run's length is of one.
    lab["length"] = max(view.order_range[1] - view.order_range[0], 1.0)
    return [
        lab
        | {role_of(c): float(v[i]) for c, v in view.conditions.items()}
        | {f"base_{role}": float(v[k, i]) for role, v in view.base.items()}
        for i in range(N)
    ]


def taken(view: View) -> dict[str, np.ndarray]:
    return {role_of(c): v for c, v in view.conditions.items()}


@pytest.mark.parametrize("output", ["pull", "sinkage", "density"])
@pytest.mark.parametrize("name", EFFECTS)
@pytest.mark.parametrize("which", VIEWS)
def test_conditions_become_what_the_equation_says(which: str, name: str, output: str) -> None:
    view, effect = VIEWS[which], EFFECTS[name]
    phi = drawn(effect)
    only, changes = CONDITIONS.get(name, ("", lambda p, r: {}))
    if name in COVARIATE:
        only, changes = "pull", stretched(name)
    found = effect.on_conditions(phi, output, taken(view), view)
    assert list(found) == list(taken(view))
    expected = {role: np.empty((K, N)) for role in found}
    for k in range(K):
        p = dict(zip(effect.parameters, phi[k].tolist(), strict=True))
        for i, row in enumerate(rows(view, k)):
            truth = row | (changes(p, row) if only in ("", output) else {})
            for role, values in expected.items():
                values[k, i] = truth[role]
    for role, values in found.items():
        np.testing.assert_allclose(
            np.broadcast_to(values, (K, N)), expected[role], rtol=1e-9, atol=1e-12
        )


@pytest.mark.parametrize("output", ["pull", "sinkage", "density"])
@pytest.mark.parametrize("name", EFFECTS)
@pytest.mark.parametrize("which", VIEWS)
def test_an_output_becomes_what_the_equation_says(which: str, name: str, output: str) -> None:
    view, effect = VIEWS[which], EFFECTS[name]
    phi = drawn(effect)
    location = np.random.default_rng(7).uniform(0.5, 4.0, (K, N))
    equation = {"pull": PULL, "sinkage": SINKAGE}.get(output, {}).get(name, lambda p, r, y: y)
    if name in COVARIATE and output != "density":
        equation = of_soil(name, output)
    found = effect.on_output(phi, output, location, view)
    expected = np.empty((K, N))
    for k in range(K):
        p = dict(zip(effect.parameters, phi[k].tolist(), strict=True))
        for i, row in enumerate(rows(view, k)):
            expected[k, i] = equation(p, row, float(location[k, i]))
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("name", EFFECTS)
def test_a_model_that_lacks_a_condition_is_given_no_other(name: str) -> None:
    view, effect = VIEWS["everything recorded"], EFFECTS[name]
    phi = drawn(effect)
    for output in ("pull", "sinkage", "density"):
        assert effect.on_conditions(phi, output, {}, view) == {}
        alone = {"normal": np.ones(N)}
        assert list(effect.on_conditions(phi, output, alone, view)) == ["normal"]


def test_a_dependence_has_its_bounds_and_its_logarithm() -> None:
    """On a load, by its factor: pull e^(a u + b u^2) + c u W, within e^4 either way."""
    view = VIEWS["everything recorded"]
    load = np.linspace(1.0, 12.0, N)
    view = replace(
        view, conditions=view.conditions | {"normal_load_kn": load}, lab={"normal_load_kn": 5.0}
    )
    effect = DependsOn("load", "normal_load", {"pull": False, "sinkage": True}, 3.0)
    phi = 4.0 * drawn(effect)
    u = np.log(load / 5.0)
    np.testing.assert_allclose(effect.covariate(view), u)
    p = dict(zip(effect.parameters, phi.T[:, :, None], strict=True))
    location = np.full((K, N), 1.3)
    pull = np.clip(p["pull_slope"] * u + p["pull_bend"] * u**2, -4.0, 4.0)
    assert np.abs(pull).max() == 4.0
    np.testing.assert_allclose(
        effect.on_output(phi, "pull", location, view),
        1.3 * np.exp(pull) + p["pull_offset"] * u * W,
    )
    rut = np.clip(p["sinkage_slope"] * u + p["sinkage_bend"] * u**2, -4.0, 4.0)
    np.testing.assert_allclose(effect.on_output(phi, "sinkage", location, view), 1.3 + rut)
    np.testing.assert_array_equal(effect.on_output(phi, "density", location, view), location)


def test_without_a_slip_the_wheel_is_taken_to_roll() -> None:
    view = VIEWS["no sinkage, nothing known of the laboratory"]
    rolling = replace(
        view, conditions={c: v for c, v in view.conditions.items() if c != "slip_ratio"}
    )
    np.testing.assert_array_equal(rolling.slip(), np.zeros(N))
    np.testing.assert_array_equal(rolling.sinkage(), np.ones((1, N)))


@pytest.mark.parametrize(
    ("name", "output", "ends"),
    [
        ("pressure_gauge_bias", "pull", (0.2, None)), ("cone_index_bias", "density", (0.02, None)),
        ("load_transfer", "pull", (0.2, 5.0)), ("slip_sinkage", "pull", (None, 3.0)),
    ],
)  # fmt: skip
def test_sizes_are_drawn_so_wide_that_the_ends_are_reached(name, output, ends):
    view, effect = VIEWS["everything recorded"], EFFECTS[name]
    phi = drawn(effect)
    p = dict(zip(effect.parameters, phi.T[:, :, None], strict=True))
    if name == "pressure_gauge_bias":
        psi = view.of("pressure")
        reached = (psi * np.exp(p["gain"]) + p["offset"]) / psi
    elif name == "cone_index_bias":
        cone = view.of("cone")
        reached = (cone * np.exp(p["gain"]) + p["offset"] * 450.0) / cone
    elif name == "load_transfer":
        reached = 1.0 + p["transfer"] * view.base["pull"] / W
    else:
        reached = p["growth"] * np.maximum(view.slip(), 0.0) ** p["slip_exponent"]
    low, high = ends
    assert low is None or reached.min() < low
    assert high is None or reached.max() > high


def test_a_speed_of_nearly_nothing_is_a_millimetre_a_second():
    """In the laboratory as in the field: a logarithm has no zero."""
    view = VIEWS["everything recorded"]
    speed = np.linspace(0.0, 2e-3, N)
    for lab in (0.0, 5e-4, 2e-3):
        slow = replace(view, conditions=view.conditions | {"speed_m_s": speed},
                       lab={"speed_m_s": lab})  # fmt: skip
        expected = [math.log(max(v, 1e-3) / max(lab, 1e-3)) for v in speed]
        np.testing.assert_allclose(EFFECTS["rate_effect"].covariate(slow), expected, atol=1e-12)


def test_a_fit_of_a_step_begins_with_the_means_of_its_sides():
    """Weighted by how far each run is beyond, with half a run at nothing besides."""
    view, effect = VIEWS["everything recorded"], EFFECTS["sensor_step"]
    phi = drawn(effect)
    left = np.random.default_rng(3).normal(0.1, 0.3, N)
    left[[2, 9]] = np.nan
    begun = effect.begun(phi, {"pull": left}, view)
    for k in range(K):
        wide = {"change_point": phi[k, 2], "duration": 0.1, "jump": 1.0, "zero_at": 0.0}
        beyond = [step(wide, row) for row in rows(view, k)]
        known = [i for i in range(N) if not math.isnan(left[i])]
        before = sum((1.0 - beyond[i]) * left[i] for i in known)
        before /= sum(1.0 - beyond[i] for i in known) + 0.5
        after = sum(beyond[i] * left[i] for i in known) / (sum(beyond[i] for i in known) + 0.5)
        zero_at = clip(-before / (after - before), 0.05, 0.95)
        np.testing.assert_allclose(
            begun[k], [after - before, zero_at, phi[k, 2], 0.1], rtol=1e-12
        )  # fmt: skip


@pytest.mark.parametrize("role", ["sinkage", "torque"])
@pytest.mark.parametrize(
    ("kind", "of_cell"), [(ReadingDrift, "sensor_drift"), (ReadingStep, "sensor_step")]
)
def test_another_reading_changes_over_the_runs_as_the_drawbar_cells(kind, of_cell, role):
    """By the same equation, and no other output with it."""
    view, effect = VIEWS["everything recorded"], kind(role, "some_output", "1", 1.0)
    phi = drawn(effect)
    y = np.random.default_rng(4).normal(2.0, 1.0, (K, N))
    expected = [
        [PULL[of_cell](dict(zip(effect.parameters, phi[k], strict=True)), row, y[k, i])
         for i, row in enumerate(rows(view, k))]
        for k in range(K)
    ]  # fmt: skip
    np.testing.assert_allclose(effect.on_output(phi, role, y, view), expected, rtol=1e-12)
    assert effect.on_output(phi, "pull", y, view) is y
    begun = effect.begun(phi, {role: np.full(N, 0.1), "pull": np.full(N, np.nan)}, view)
    assert np.isfinite(begun).all()


@pytest.mark.parametrize("name", EFFECTS)
def test_a_form_is_least_certain_along_its_own_covariate(name):
    view, effect = VIEWS["everything recorded"], EFFECTS[name]
    found = effect.shape(view)
    if name in COVARIATE:
        expected = [COVARIATE[name](row) for row in rows(view, 0)]
    elif name == "sensor_drift":
        expected = [over(row) for row in rows(view, 0)]
    else:
        assert found is None
        return
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def priors_of(effect: Effect) -> Priors:
    file = DeclaredPriors("priors of the effect", effect.priors)
    return read_priors(file, effect.name, effect.parameters, {})


DEPENDENCES = {
    "load": (("load", "normal_load"), {"pull_slope": (1.0, 0.3), "sinkage_slope": (0.7, 0.5),
                                       "driving_torque_slope": (0.0, 0.5)}),
    "speed": (("speed", "speed"), {"pull_slope": (0.0, 0.5), "sinkage_slope": (0.0, 0.5),
                                   "driving_torque_slope": (0.0, 0.5)}),
    "temperature": (("tyre_temperature_c", "tyre_temperature_c"),
                    {"pull_slope": (0.0, 0.3), "sinkage_slope": (0.0, 0.3),
                     "driving_torque_slope": (0.0, 0.3)}),
}  # fmt: skip
LOGS = {"sinkage": True, "pull": False, "driving_torque": False}


@pytest.mark.parametrize("which", DEPENDENCES)
def test_a_dependences_priors_are_those_of_dimensional_analysis_or_wide(which):
    """Pull goes with the load, by a factor; of what factors count nothing else is known."""
    (role, stem), slopes = DEPENDENCES[which]
    effect = DependsOn(role, stem, LOGS, 3.0)
    bends = dict.fromkeys((f"{output}_bend" for output in LOGS), (0.0, 0.15))
    wanted = slopes | bends | {"pull_offset": (0.0, 0.02)}
    assert effect.parameters == (
        "sinkage_slope", "sinkage_bend", "pull_slope", "pull_bend", "driving_torque_slope",
        "driving_torque_bend", "pull_offset",
    )  # fmt: skip
    assert effect.outputs == tuple(LOGS)
    assert effect.covariates == (role,)
    priors = priors_of(effect)
    assert {p.name: (p.loc, p.scale) for p in priors.entries} == wanted
    assert not any(p.log for p in priors.entries)


def test_a_dependence_has_each_output_by_its_own_parameters():
    """Whatever their order; what is no force has no part of the load."""
    view = VIEWS["everything recorded"]
    effect = DependsOn("tyre_temperature_c", "tyre_temperature_c", LOGS, 8.0)
    phi = 3.0 * drawn(effect)
    u = (view.of("tyre_temperature_c") - 21.0) / 8.0
    np.testing.assert_allclose(effect.covariate(view), u)
    np.testing.assert_array_equal(effect.shape(view), effect.covariate(view))
    p = dict(zip(effect.parameters, phi.T[:, :, None], strict=True))
    location = np.random.default_rng(7).uniform(0.5, 4.0, (K, N))
    change = {o: np.clip(p[f"{o}_slope"] * u + p[f"{o}_bend"] * u**2, -4.0, 4.0) for o in LOGS}
    for o in LOGS:
        assert change[o].min() == -4.0
        assert change[o].max() == 4.0
    expected = {
        "sinkage": location + change["sinkage"],
        "pull": location * np.exp(change["pull"]) + p["pull_offset"] * u * W,
        "driving_torque": location * np.exp(change["driving_torque"]),
        "density": location,
    }
    for output, wanted in expected.items():
        np.testing.assert_allclose(effect.on_output(phi, output, location, view), wanted)


@pytest.mark.parametrize("role", ["speed", "tyre_temperature_c"])
def test_what_the_laboratory_did_not_record_is_told_by_the_fields_median(role):
    view = VIEWS["no sinkage, nothing known of the laboratory"]
    values = view.of(role)
    found = DependsOn(role, role, LOGS, 5.0).covariate(view)
    middle = np.median(values)
    expected = (
        np.log(np.maximum(values, 1e-6) / middle) if role == "speed" else (values - middle) / 5.0
    )
    np.testing.assert_allclose(found, expected)


def test_a_factor_of_nothing_is_one_of_a_millionth():
    view = VIEWS["everything recorded"]
    for lab in (0.0, 0.4):
        slow = replace(view, lab={"speed_m_s": lab})
        found = DependsOn("speed", "speed", LOGS, 5.0).covariate(slow)
        expected = [math.log(max(v, 1e-6) / max(lab, 1e-6)) for v in view.of("speed")]
        np.testing.assert_allclose(found, expected)


LEVELS = ("B. Berg", "A. Lind", "Dahl & Co.")


@pytest.mark.parametrize("usual", [0, 1, 2])
def test_values_of_a_category_have_each_its_factor(usual):
    """But for the most usual, of which the others differ; a force a part of the load besides."""
    view = VIEWS["everything recorded"]
    code = np.resize([0.0, 1.0, 2.0, 1.0], N)
    view = replace(view, conditions=view.conditions | {"operator": code})
    effect = DiffersBy("operator", LEVELS, LOGS, usual)
    words = [w for j, w in enumerate(("B_Berg", "A_Lind", "Dahl_Co")) if j != usual]
    assert effect.parameters == (
        *(f"{output}_factor_{w}" for output in LOGS for w in words),
        *(f"pull_offset_{w}" for w in words),
    )
    assert effect.outputs == tuple(LOGS)
    assert effect.covariates == ("operator",)
    assert effect.name == "depends_on_operator"
    priors = priors_of(effect)
    assert [(p.loc, p.scale) for p in priors.entries] == [(0.0, 0.3)] * 6 + [(0.0, 0.02)] * 2
    others = [j for j in range(3) if j != usual]
    phi = 6.0 * drawn(effect)
    location = np.random.default_rng(7).uniform(0.5, 4.0, (K, N))
    found = {o: effect.on_output(phi, o, location, view) for o in (*LOGS, "density")}
    for k in range(K):
        p = dict(zip(effect.parameters, phi[k], strict=True))
        for i in range(N):
            y, word = location[k, i], dict(zip(others, words, strict=True)).get(int(code[i]))
            factor = {o: clip(p.get(f"{o}_factor_{word}", 0.0), -4.0, 4.0) for o in LOGS}
            expected = {
                "sinkage": y + factor["sinkage"],
                "pull": y * math.exp(factor["pull"]) + p.get(f"pull_offset_{word}", 0.0) * W,
                "driving_torque": y * math.exp(factor["driving_torque"]),
                "density": y,
            }
            for output, wanted in expected.items():
                assert found[output][k, i] == pytest.approx(wanted, rel=1e-12)


@pytest.mark.parametrize(
    ("levels", "slugs"),
    [
        (("a", "b-c", "b c"), ("b_c_1", "b_c_2")),
        (("a", "!", "?"), ("1", "2")),
        (("a", "(b)", "c"), ("b", "c")),
        (("a", "a!", "b"), ("a", "b")),
    ],
)
def test_values_are_told_apart_in_the_names_of_parameters(levels, slugs):
    effect = DiffersBy("operator", levels, {"sinkage": True}, 0)
    assert effect.parameters == tuple(f"sinkage_factor_{slug}" for slug in slugs)
