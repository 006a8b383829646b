"""Effects: their equations against independent code, signs, priors, testability."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import pytest

from calib.data.quantities import role_of
from calib.gap.effects import EFFECTS, Effect, Known, View
from calib.gap.effects.dependence import DependsOn, DiffersBy
from calib.gap.effects.readings import ConditionBias, Reading
from calib.gap.forward import Forward
from calib.gap.hypotheses import Hypothesis, effect_priors
from calib.inference.prior_files import DeclaredPriors, default_priors, read_priors
from calib.inference.priors import Priors
from calib.models.base import Array
from calib.models.card import text
from tests.gap.cases import NOISE, campaigns_of, make_case, parameters, simulate

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


@pytest.mark.parametrize("role", ["sinkage", "torque"])
@pytest.mark.parametrize(
    ("kind", "of_cell"),
    [("drift", "sensor_drift"), ("step", "sensor_step"), ("offset", "force_offset")],
)
def test_another_reading_changes_over_the_runs_as_the_drawbar_cells(kind, of_cell, role):
    """By the same equation, and no other output with it."""
    view, effect = VIEWS["everything recorded"], Reading(kind, role, "some_output", "1", 1.0)
    phi = drawn(effect)
    y = np.random.default_rng(4).normal(2.0, 1.0, (K, N))
    expected = [
        [PULL[of_cell](dict(zip(effect.parameters, phi[k], strict=True)), row, y[k, i])
         for i, row in enumerate(rows(view, k))]
        for k in range(K)
    ]  # fmt: skip
    np.testing.assert_allclose(effect.on_output(phi, role, y, view), expected, rtol=1e-12)
    assert effect.on_output(phi, "pull", y, view) is y


def test_a_gain_is_a_factor_and_an_offset_is_in_the_readings_unit_in_logarithms_too():
    view, y = VIEWS["everything recorded"], np.random.default_rng(4).uniform(1.0, 4.0, (1, N))
    five, two = np.array([[0.05]]), np.array([[2.0]])
    gain, offset = (Reading(k, "sinkage", "rut_depth", "mm", 25.0) for k in ("gain", "offset"))
    np.testing.assert_allclose(gain.on_output(five, "sinkage", y, view), 1.05 * y, rtol=1e-14)
    logs = [Reading(k, "sinkage", "r", "mm", 25.0, log=True) for k in ("gain", "offset")]
    for log, natural, phi in zip(logs, (gain, offset), (five, two), strict=True):
        read = natural.on_output(phi, "sinkage", np.exp(y), view)
        np.testing.assert_allclose(log.on_output(phi, "sinkage", y, view), np.log(read))
    low = logs[1].on_output(np.array([[-1e3]]), "sinkage", y, view)
    np.testing.assert_allclose(low, y + np.log(0.05))
    assert [p.scale for e in (gain, offset) for p in priors_of(e).free] == [0.05, 2.5]


def test_a_wrong_condition_has_a_gain_and_an_offset_and_its_sign():
    effect = ConditionBias("load", "normal_load", ("pull",), "kN", 5.0)
    load, phi = np.array([4.0, 6.0, -1.0]), np.array([[0.05, 0.2], [0.0, -50.0]])
    given = {"load": load, "slip": np.zeros(3)}
    view = VIEWS["everything recorded"]
    true = effect.on_conditions(phi, "pull", given, view)
    np.testing.assert_allclose(true["load"], [[4.4, 6.5, -0.85], [0.08, 0.12, -51.0]])
    assert true["slip"] is given["slip"]
    slip = {"slip": given["slip"]}
    assert effect.on_conditions(phi, "pull", slip, view) is slip
    assert [p.scale for p in priors_of(effect).free] == [0.05, 0.25]


def priors_of(effect: Effect) -> Priors:
    file = DeclaredPriors("priors of the effect", effect.priors)
    return read_priors(file, effect.name, effect.parameters, {})


LOGS = {"sinkage": True, "pull": False, "driving_torque": False}


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
K_effects = 3


@pytest.fixture(scope="module")
def view() -> View:
    """Twenty rows with every covariate, all at or above the laboratory's values."""
    n = 20
    slip = np.linspace(0.05, 0.6, n)
    base = {
        "pull": np.tile(1.4 * (1.0 - np.exp(-slip / 0.1)), (K_effects, 1)),
        "sinkage": np.tile(30.0 * (1.0 + slip), (K_effects, 1)),
        "density": np.full((K_effects, n), 1.5),
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
    phi = np.tile(parameters(name, size), (K_effects, 1))
    plain = np.tile(predict(output, by_role(view)), (K_effects, 1))
    conditions = effect.on_conditions(phi, output, by_role(view), view)
    location = predict(output, conditions) * np.ones((K_effects, 1))
    changed = effect.on_output(phi, output, location, view)
    assert changed.shape == (K_effects, 20)
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


@pytest.mark.parametrize("name", ["lug_thrust", "load_transfer"])
def test_the_rut_alone_does_not_show_what_acts_on_the_pull(name: str, view: View) -> None:
    assert EFFECTS[name].not_testable(view, ("sinkage",)) == "no drawbar_pull output"
    assert EFFECTS[name].not_testable(view, ("pull", "sinkage")) is None


@pytest.mark.parametrize("name", EFFECTS)
def test_an_effects_equation_names_its_parameters(name: str) -> None:
    effect = EFFECTS[name]
    written = " ".join(map(text, effect.latex))
    for parameter in effect.parameters:
        assert parameter.replace("_", " ") in written


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


def drawn_known(data, effect: Effect, output: str, *, family: bool) -> tuple[Forward, str, Array]:
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
    forward, name, psi = drawn_known(data, effect, known.output, family=True)
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
    forward, name, psi = drawn_known(data, Bogging(), "pull", family=True)
    psi[:, forward.form_slices[name][0]] *= 10.0
    full, plain = forward.field_and_plain(psi, along(data, "slip", SLIPS))
    known = np.isfinite(plain[name]).all(axis=1)
    full, plain = full[name][known], plain[name][known]
    assert ((full == 0.0) & (plain > 0.0)).any()  # some shapes reach the bound
    assert (full[plain > 0.0] >= 0.0).all()
    np.testing.assert_array_equal(full[plain <= 0.0], plain[plain <= 0.0])


def test_softening_takes_no_more_than_the_gross_thrust(data):
    effect = EFFECTS["post_peak_softening"]
    forward, name, psi = drawn_known(data, effect, "pull", family=True)
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


GROWING = [(e, k) for e, k in FACTS if k.grows_with]


@pytest.mark.parametrize(
    ("effect", "known"), GROWING, ids=[f"{e.name}-{k.output}" for e, k in GROWING]
)
def test_what_grows_grows_by_the_formula_and_in_nine_of_ten_of_its_family(data, effect, known):
    assert known.grows_with == ("slip",)
    for family, part, most in ((False, 1e-6, 0.0), (True, 0.25, 0.1)):
        forward, name, psi = drawn_known(data, effect, known.output, family=family)
        size = np.abs(added(forward, name, psi, along(data, "slip", SLIPS)))
        fall = (np.maximum.accumulate(size, axis=1) - size).max(axis=1)
        assert (fall > part * size.max(axis=1)).mean() <= most
