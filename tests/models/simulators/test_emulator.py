"""Emulators: where they stand, how sure they are, and where there is nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.stats import qmc

import calib
from calib.errors import CalibError
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
from calib.models.simulators.kriging import Region
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
    squares = calib.inference.problem.Squares.of(bound, NODES, table["drawbar_pull_kn"])
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
