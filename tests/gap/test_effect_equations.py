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
from calib.gap.effects import EFFECTS, View
from calib.gap.effects.dependence import DependsOn

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
type Row = Mapping[str, float]


def view_of(*, sinkage: bool = True, lab: bool = True) -> View:
    """Return rows of every condition, backward slips and the ends of a campaign among them."""
    rng = np.random.default_rng(11)
    base = {"pull": rng.uniform(-1.0, 9.0, (K, N)), "density": rng.uniform(1.2, 1.7, (K, N))}
    if sinkage:
        base["sinkage"] = rng.uniform(5.0, 900.0, (K, N))
    return View(
        conditions={
            "run_order": np.append(np.arange(3.0, 2.0 + N), 60.0),
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


VIEWS = {
    "everything recorded": view_of(),
    "no sinkage, nothing known of the laboratory": view_of(sinkage=False, lab=False),
}


def clip(x: float, low: float, high: float) -> float:
    return min(max(x, low), high)


def growth(u: float, c: float, h: float) -> float:
    return (1.0 + h**c) * u**c / (u**c + h**c)


def over(r: Row) -> float:
    """The part of the campaign that is over."""
    return clip((r["order"] - 3.0) / (N - 2.0), 0.0, 1.2)


def sunk(r: Row) -> float:
    return r["base_sinkage"] / 30.0 if "base_sinkage" in r else 1.0 + max(r["slip"], 0.0)


def step(p: Row, r: Row) -> float:
    h = clip((over(r) - p["change_point"]) / (p["duration"] + 1.0 / (N - 2.0)) + 0.5, 0.0, 1.0)
    return p["before"] * (1.0 - h) + p["after"] * h


def transferred(p: Row, r: Row) -> float:
    return clip(1.0 + p["transfer"] * r["base_pull"] / W, 0.2, 5.0)


def deeper(p: Row, r: Row) -> float:
    return p["growth"] * max(r["slip"], 1e-4) ** p["slip_exponent"]


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
    "post_peak_softening": lambda p, r, y: y * (
        1.0 - p["loss"] * (1.0 - math.exp(-max(r["slip"] - p["peak_slip"], 0.0) / p["slip_scale"]))
    ),
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


def drawn(names: tuple[str, ...]) -> np.ndarray:
    rng = np.random.default_rng(5)
    return np.stack([rng.uniform(*POSITIVE.get(n, (-1.0, 1.0)), K) for n in names], axis=1)


def rows(view: View, k: int) -> list[dict[str, float]]:
    """Return each row of a view by roles, what is usual in the laboratory among them."""
    lab = {
        f"lab_{role_of(c)}": float(view.lab.get(c, np.median(v)))
        for c, v in view.conditions.items()
    }
    # One pass is what a laboratory makes where nothing is said.
    lab["lab_passes"] = view.lab.get("pass_number", 1.0)
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
    phi = drawn(effect.parameters)
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
    phi = drawn(effect.parameters)
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
    phi = drawn(effect.parameters)
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
    phi = 4.0 * drawn(effect.parameters)
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
