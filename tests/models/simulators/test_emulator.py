"""Emulators and their processes: what they meet, how sure they are, where there is nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.stats import qmc

import calib
from calib.errors import CalibError
from calib.models.constants import BEYOND_NODES
from calib.models.simulators.emulator import (
    Axes,
    Emulator,
    Training,
    build_emulator,
    emulated_model,
    emulator_of,
    load_emulator,
    save_emulator,
)
from calib.models.simulators.kriging import (
    Region,
    Scales,
    correlation,
    find_scales,
    krige,
    over_conditions,
    trend_of,
)
from tests.models.simulators.examples import lab, pull

AXES = Axes(np.array([True, True]), np.log([0.5, 0.1]), np.array([0.4, 0.8]))
NODES = {name: v for name, v in lab(np.random.default_rng(0)).items() if name != "drawbar_pull_kn"}
REGION = Region(np.array([0.4, -0.3]), 0.1 * np.eye(2), 4.0)


def design(count: int) -> np.ndarray:
    return AXES.natural(4.0 * qmc.Sobol(2, rng=1).random_base2(6)[:count] - 2.0)


def made(count: int = 40, regions: tuple[Region, ...] = ()) -> Emulator:
    theta = design(count)
    if regions:
        near = REGION.centre + 0.1 * np.random.default_rng(2).standard_normal((30, 2))
        theta = np.concatenate([theta, AXES.natural(near)])
    return build_emulator(Training(theta, pull(theta, NODES), NODES), AXES, 1e-4, regions)


def test_it_predicts_and_knows_its_error() -> None:
    emulator = made()
    at = AXES.natural(np.random.default_rng(5).uniform(-1.5, 1.5, (200, 2)))
    means, variances = emulator.with_variance(at)
    true = (pull(at, NODES) - emulator.mean) @ emulator.curves.T
    z = (true - means) / np.sqrt(np.maximum(variances, 1e-18))
    assert np.sqrt(np.square(emulator.predict(at, NODES) - pull(at, NODES)).mean()) < 0.02
    assert 0.3 < np.sqrt(np.median(z[:, 0] ** 2)) / 0.67 < 2.0


def test_its_drawn_error_covers_the_simulator() -> None:
    model = calib.Model(
        name="line", title="", output="drawbar_pull_kn",
        conditions=("slip_ratio", "normal_load_kn"), parameters=("mu", "s0"),
        predict=lambda theta, x: theta[:, :1] * x["slip_ratio"],
    )  # fmt: skip
    table = calib.table_from_arrays({**NODES, "drawbar_pull_kn": NODES["slip_ratio"]})
    rng = np.random.default_rng(8)
    at = AXES.natural(rng.uniform(-1.5, 1.5, (300, 2)))
    true, held = pull(at, NODES), []
    natural = np.repeat(np.c_[at, np.ones(300)], 100, axis=0)
    for count in (12, 16, 20, 24, 32, 48):  # of one design alone much is luck
        bound = emulated_model(model, made(count)).bind(NODES)
        problem = calib.inference.problem.Problem(bound, table, calib.inference.priors.Priors(()))
        drawn = problem.draw_mean_response(natural, NODES, rng).reshape(300, 100, -1)
        low, high = np.quantile(drawn, [0.05, 0.95], axis=1)
        held.append(((low < true) & (true < high)).mean())
        # Its own prediction alone is off.
        assert np.abs(bound.mean_response(at, NODES) - true).max() > 0.1 * np.abs(high - low).max()
    assert 0.85 < np.mean(held) < 0.95


def test_where_there_are_runs_it_is_better() -> None:
    whole, both = made(), made(regions=(REGION,))
    at = AXES.natural(REGION.centre + 0.1 * np.random.default_rng(6).standard_normal((50, 2)))
    off = [np.abs(e.predict(at, NODES) - pull(at, NODES)).max() for e in (whole, both)]
    assert off[1] < 0.5 * off[0]
    expected = [e.with_variance(at)[1].sum(axis=1).mean() for e in (whole, both)]
    assert expected[1] < 0.5 * expected[0]


def test_a_region_without_value_is_learned_and_not_filled() -> None:
    theta = design(64)
    values = pull(theta, NODES)
    lost = AXES.of(theta)[:, 0] > 0.8
    values[lost] = np.nan
    emulator = build_emulator(Training(theta, values, NODES), AXES, 1e-4)
    z = np.random.default_rng(7).uniform(-1.8, 1.8, (400, 2))
    found = emulator.predict(AXES.natural(z), NODES)
    there = np.isfinite(found).all(axis=1)
    clear = np.abs(z[:, 0] - 0.8) > 0.3
    np.testing.assert_array_equal(there[clear], z[clear, 0] < 0.8)
    assert np.isnan(emulator.predict(theta[lost], NODES)).all()


def test_the_model_has_every_layout() -> None:
    model = calib.Model(
        name="line", title="", output="drawbar_pull_kn",
        conditions=("slip_ratio", "normal_load_kn"), parameters=("mu", "s0"),
        predict=lambda theta, x: theta[:, :1] * x["slip_ratio"],
    )  # fmt: skip
    emulator = made()
    bound = emulated_model(model, emulator).bind(NODES)
    assert emulator_of(model) is None
    assert emulator_of(bound.model) is emulator
    theta = design(5)
    flat = bound.mean_response(theta, NODES)
    np.testing.assert_allclose(flat, emulator.predict(theta, NODES))
    own = {name: np.tile(v, (5, 1)) for name, v in NODES.items()}
    np.testing.assert_allclose(bound.mean_response(theta, own), flat)
    table = calib.table_from_arrays({**NODES, "drawbar_pull_kn": flat[0] + 0.01})
    squares = calib.inference.problem.SumOfSquares.of(bound, NODES, table["drawbar_pull_kn"])
    expected = np.square(table["drawbar_pull_kn"] - flat).sum(axis=1)
    np.testing.assert_allclose(squares(theta), expected)


def test_it_is_the_same_from_disk(tmp_path: Path) -> None:
    emulator = made(regions=(REGION,))
    save_emulator(emulator, "wheel", tmp_path / "wheel.npz")
    save_emulator(emulator, "wheel", tmp_path / "again.npz")
    assert (tmp_path / "wheel.npz").read_bytes() == (tmp_path / "again.npz").read_bytes()
    name, loaded = load_emulator(tmp_path / "wheel.npz")
    assert name == "wheel"
    theta = design(6)
    x = {"slip_ratio": np.array([0.15, 0.33]), "normal_load_kn": np.array([3.5, 4.5])}
    np.testing.assert_allclose(loaded.predict(theta, x), emulator.predict(theta, x), rtol=1e-9)
    (tmp_path / "wheel.npz").write_bytes(b"PK not a zip")
    with pytest.raises(CalibError, match="cannot be read"):
        load_emulator(tmp_path / "wheel.npz")


def test_it_is_the_limit_of_a_wide_prior_of_the_trend() -> None:
    rng = np.random.default_rng(1)
    x, at = rng.standard_normal((40, 2)), rng.standard_normal((7, 2))
    y = np.stack([np.sin(x[:, 0]) + x[:, 1] ** 2, x[:, 0] * x[:, 1]], axis=1)
    scales = Scales(np.array([1.3, 2.1]), 1e-4)
    found = krige(x, y, scales)
    mean, unknown = found.mean_and_unknown(at)
    b, b_at, wide = trend_of(x), trend_of(at), 1e6

    def covariance(u: np.ndarray, v: np.ndarray, bu: np.ndarray, bv: np.ndarray) -> np.ndarray:
        return correlation(u, v, scales.lengths) + wide * bu @ bv.T

    k = covariance(x, x, b, b) + scales.nugget * np.eye(len(x))
    across = covariance(at, x, b_at, b)
    solved = np.linalg.solve(k, across.T)
    left = np.diag(covariance(at, at, b_at, b_at)) - np.einsum("kn,nk->k", across, solved)
    np.testing.assert_allclose(mean, solved.T @ y, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(unknown, left, rtol=0.02, atol=1e-4)
    np.testing.assert_allclose(mean, found.mean(at))


@pytest.mark.parametrize("noise", [0.05, 0.2])
def test_noise_is_told_from_shape(noise: float) -> None:
    rng = np.random.default_rng(3)
    x = np.repeat(rng.uniform(-2.0, 2.0, (40, 1)), 3, axis=0)
    y = np.sin(2.0 * x) + noise * rng.standard_normal(x.shape)
    scales = find_scales(x, y, noisy=True)
    found = krige(x, y, scales)
    at = np.linspace(-1.5, 1.5, 21)[:, None]
    assert np.sqrt(np.mean((found.mean(at) - np.sin(2.0 * at)) ** 2)) < 0.5 * noise
    assert noise / 2.0 < np.sqrt(found.variances[0] * scales.nugget) < 2.0 * noise


def test_a_constant_is_no_trouble() -> None:
    x = np.random.default_rng(4).standard_normal((12, 3))
    y = np.full((12, 2), 5.0)
    found = krige(x, y, find_scales(x, y))
    np.testing.assert_allclose(found.mean(x + 0.3), 5.0)


def curves(s: np.ndarray, w: np.ndarray) -> np.ndarray:
    return np.stack([w * (1.0 - np.exp(-s / 0.1)), w**1.2 * s, np.ones_like(s)])


def grid(n: int) -> dict[str, np.ndarray]:
    s, w = np.meshgrid(np.linspace(0.0, 0.6, n), np.linspace(2.0, 8.0, 6), indexing="ij")
    return {"slip_ratio": s.ravel(), "normal_load_kn": w.ravel()}


def test_curves_are_met_at_the_nodes_and_near_between() -> None:
    nodes = grid(14)
    known = curves(*nodes.values())
    over = over_conditions(nodes, known)
    weights = over.weights(known)
    np.testing.assert_allclose(over.at(nodes, weights), known.T, atol=1e-4)
    rng = np.random.default_rng(1)
    x = {"slip_ratio": rng.uniform(0.0, 0.6, 50), "normal_load_kn": rng.uniform(2.0, 8.0, 50)}
    true = curves(*x.values())
    np.testing.assert_allclose(over.at(x, weights), true.T, atol=0.02 * 8.0)
    # What is left out tells how far off it is between nodes, to a factor.
    assert 0.0 < np.abs(over.left_out(known)[0]).max() < 1.0


def test_beyond_the_box_it_goes_on_straight_and_then_has_no_value() -> None:
    nodes = {"slip_ratio": np.linspace(0.1, 0.5, 12)}
    known = (2.0 + 3.0 * nodes["slip_ratio"])[None]
    over = over_conditions(nodes, known)
    weights = over.weights(known)
    near, far = 0.5 + 0.9 * BEYOND_NODES * 0.4, 0.5 + 1.2 * BEYOND_NODES * 0.4
    found = over.at({"slip_ratio": np.array([0.45, near, far])}, weights)[:, 0]
    np.testing.assert_allclose(found[:2], [3.35, 2.0 + 3.0 * near], atol=2e-3)
    assert np.isnan(found[2])


def test_a_condition_that_did_not_vary_is_not_guessed() -> None:
    nodes = {"slip_ratio": np.linspace(0.1, 0.5, 8), "normal_load_kn": np.full(8, 5.0)}
    over = over_conditions(nodes, np.sin(nodes["slip_ratio"])[None])
    weights = over.weights(np.sin(nodes["slip_ratio"])[None])
    x = {"slip_ratio": np.array([0.2, 0.2]), "normal_load_kn": np.array([5.0, 6.0])}
    found = over.at(x, weights)[:, 0]
    assert np.isfinite(found[0])
    assert np.isnan(found[1])


def test_between_two_values_of_a_condition_curves_do_not_fall_back_to_their_mean():
    """Ruts that depend on load alone, at two loads: nothing else says how far a load reaches."""
    slip, load = (v.ravel() for v in np.meshgrid([0.05, 0.1, 0.2, 0.3, 0.45, 0.6], [0.6, 1.2]))
    exponents = np.linspace(0.5, 0.9, 12)[:, None]
    curves = 40.0 * load**exponents + np.random.default_rng(3).normal(0.0, 0.02, (12, 12))
    over = over_conditions({"slip": slip, "load": load}, curves)
    at = np.linspace(0.6, 1.2, 7)
    found = over.at({"slip": np.full(7, 0.25), "load": at}, over.weights(curves))
    np.testing.assert_allclose(found, (40.0 * at**exponents).T, rtol=0.05)
