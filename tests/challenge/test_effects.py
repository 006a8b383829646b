"""Each mechanism must act where the contract says, in the direction that physics says."""

from __future__ import annotations

import ast
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import challenge
from calib.errors import CalibError
from challenge.effects import LISTED, UNLISTED, kind_of, needs_of, wheel_effects
from challenge.mechanics import simulate
from challenge.mechanism import Conditions, Readings
from challenge.shift import draw_shift, shifted
from tests.challenge.realities import conditions, reality


def field() -> Conditions:
    """Return a field in which every condition varies."""
    rng = np.random.default_rng(3)
    return conditions(
        30,
        slip=rng.uniform(0.02, 0.68, 30),
        inflation_kpa=rng.choice([124.1, 206.8, 289.6], 30),
        speed_m_s=rng.choice([0.06, 0.3, 1.0, 2.0], 30),
        pass_number=rng.integers(1, 5, 30).astype(float),
        water_content=rng.uniform(0.03, 0.085, 30),
        cone_index_kpa=rng.uniform(250.0, 1500.0, 30),
    )


def change(name: str, at: Conditions, seed: int = 0, share: float = 0.5) -> Readings:
    """Return what an effect of a middling strength adds to the readings."""
    family = kind_of(name).draw(np.random.default_rng(seed))
    strength = family.low * (family.high / family.low) ** share
    base = reality()
    got = simulate(base.with_mechanisms(family.at(strength)), at)
    without = simulate(base, at)
    return {key: got[key] - without[key] for key in got}


CONTRACT = {
    "slip_zero_shift", "force_offset", "sensor_drift", "pressure_gauge_bias",
    "multipass_compaction", "rate_effect", "moisture_softening", "bulldozing_resistance",
    "lug_thrust", "slip_sinkage", "rut_rebound", "post_peak_softening", "load_transfer",
    "cone_index_bias", "water_content_bias",
}  # fmt: skip


def test_every_effect_of_the_contract_is_there() -> None:
    assert set(LISTED) == CONTRACT
    assert len({kind.draw(np.random.default_rng(0)).variant for kind in UNLISTED}) >= 15


@pytest.mark.parametrize("name", sorted(CONTRACT))
def test_effect_touches_only_its_outputs(name: str) -> None:
    changed = {key for key, value in change(name, field()).items() if np.abs(value).max() > 1e-9}
    assert changed & set(kind_of(name).outputs)
    assert ("bulk_density" in changed) == (name in ("cone_index_bias", "water_content_bias"))


@pytest.mark.parametrize(
    ("name", "still"),
    [
        ("rate_effect", {"speed_m_s": 0.06}),
        ("multipass_compaction", {"pass_number": 1.0}),
        ("moisture_softening", {"water_content": 0.05}),
    ],
)
def test_covariate_effects_sleep_in_the_lab(name: str, still: dict[str, float]) -> None:
    at = replace(field(), **{key: np.full(30, value) for key, value in still.items()})
    for seed in range(4):
        for value in change(name, at, seed).values():
            assert value == pytest.approx(np.zeros(30), abs=1e-7)


@pytest.mark.parametrize(
    ("name", "output", "sign"),
    [
        ("bulldozing_resistance", "drawbar_pull", -1),
        ("lug_thrust", "drawbar_pull", 1),
        ("slip_sinkage", "rut_depth", 1),
        ("rut_rebound", "rut_depth", -1),
        ("multipass_compaction", "rut_depth", -1),
        ("post_peak_softening", "drawbar_pull", -1),
    ],
)
def test_direction_and_growth_with_slip(name: str, output: str, sign: int) -> None:
    for seed in range(4):
        at = conditions(8, slip=np.linspace(0.05, 0.65, 8), pass_number=3.0)
        got = sign * change(name, at, seed)[output]
        assert np.all(got > -1e-6)
        if name != "multipass_compaction":
            assert got[-1] > got[0]


def test_drift_begins_at_nothing_and_offset_is_constant() -> None:
    for seed in range(6):
        assert change("sensor_drift", field(), seed)["drawbar_pull"][0] == pytest.approx(0.0)
    assert np.ptp(change("force_offset", field())["drawbar_pull"]) < 1e-12


def test_load_transfer_agrees_with_itself() -> None:
    family = next(
        f
        for f in (kind_of("load_transfer").draw(np.random.default_rng(s)) for s in range(9))
        if f.variant == "loads"
    )
    at = conditions(6, slip=np.linspace(0.1, 0.6, 6))
    got = simulate(reality().with_mechanisms(family.at(0.5)), at)
    by_hand = simulate(reality(), replace(at, load_kn=at.load_kn + 0.5 * got["drawbar_pull"]))
    assert got["rut_depth"] == pytest.approx(by_hand["rut_depth"], rel=1e-4)


def test_slip_zero_keeps_the_labs_rolling_radius() -> None:
    family = kind_of("slip_zero_shift").draw(np.random.default_rng(0))
    at = conditions(6, slip=np.linspace(0.1, 0.6, 6), inflation_kpa=200.0)
    got = simulate(reality().with_mechanisms(family.at(0.02)), at)["drawbar_pull"]
    moved = replace(at, slip=1.0 - (1.0 - at.slip) * 1.02)
    assert got == pytest.approx(simulate(reality(), moved)["drawbar_pull"], rel=1e-9)


def test_shift_of_no_amount_changes_nothing() -> None:
    direction, _ = draw_shift(np.random.default_rng(2))
    base, at = simulate(reality(), field()), field()
    same = simulate(shifted(reality(), direction, 0.0), at)
    other = simulate(shifted(reality(), direction, 1.0), at)
    for name in base:
        assert same[name] == pytest.approx(base[name], rel=1e-9)
        assert np.abs(other[name] - base[name]).max() > 1e-4


def test_unknown_name_is_refused_and_needs_follow_the_model() -> None:
    with pytest.raises(CalibError, match="no effect named 'wind'"):
        kind_of("wind")
    assert needs_of((kind_of("slip_sinkage"),)).rut_model == "bekker"
    assert "cone_index_bias" not in wheel_effects()


def test_reality_shares_nothing_with_the_effects_that_explain_it() -> None:
    allowed = (
        "calib.errors", "calib.batch.tasks", "calib.batch.folders", "calib.data.documents",
        "calib.data.files", "calib.data.quantities", "calib.models.simulators.process",
        "calib.models.simulators.simulator",
    )  # fmt: skip
    for path in Path(challenge.__file__).parent.glob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        imported = {n.module or "" for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)}
        imported |= {a.name for n in ast.walk(tree) if isinstance(n, ast.Import) for a in n.names}
        assert {name for name in imported if name.startswith("calib")} <= {*allowed}, path.name


def oddity(variant: str, at: Conditions, seed: int = 0) -> tuple[Readings, Readings]:
    """Return the readings with and without an unlisted mechanism of a middling strength."""
    families = (kind.draw(np.random.default_rng(seed)) for kind in UNLISTED)
    family = next(f for f in families if f.variant == variant)
    base = reality()
    strength = (family.low * family.high) ** 0.5
    return simulate(base.with_mechanisms(family.at(strength)), at), simulate(base, at)


@pytest.mark.parametrize(
    ("variant", "condition", "values"),
    [
        ("power_hop", "inflation_kpa", np.linspace(60.0, 400.0, 60)),
        ("bounce", "speed_m_s", np.geomspace(0.01, 20.0, 60)),
        ("clogging", "water_content", np.linspace(0.01, 0.15, 60)),
    ],
)
def test_bands_cost_pull_inside_and_nothing_outside(
    variant: str, condition: str, values: np.ndarray
) -> None:
    at = replace(conditions(60, slip=np.full(60, 0.3)), **{condition: values})
    for seed in range(4):
        got, without = oddity(variant, at, seed)
        lost = without["drawbar_pull"] - got["drawbar_pull"]
        assert np.abs(lost[[0, -1]]).max() < 1e-3 * lost.max()
        assert np.all(np.diff(np.sign(np.diff(lost[lost > 1e-3 * lost.max()]))) <= 0)  # one hump


def test_every_second_pass_is_driven_back() -> None:
    at = conditions(4, slip=np.full(4, 0.3), pass_number=np.array([1.0, 2.0, 3.0, 4.0]))
    got, without = oddity("to_and_fro", at)
    gap = got["drawbar_pull"] - without["drawbar_pull"]
    assert gap == pytest.approx(gap[0] * np.array([1.0, -1.0, 1.0, -1.0]))
    assert abs(gap[0]) > 0.01
