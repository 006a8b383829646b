"""Curves between and beyond the nodes."""

from __future__ import annotations

import numpy as np

from calib.models.simulators.emulator.over import BEYOND, over_conditions


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
    assert 0.0 < np.abs(over.left_out(known)).max() < 1.0


def test_conditions_may_differ_by_vector() -> None:
    nodes = grid(10)
    known = curves(*nodes.values())
    over = over_conditions(nodes, known)
    weights = over.weights(known)
    s = np.linspace(0.1, 0.5, 12).reshape(3, 4)
    x = {"slip_ratio": s, "normal_load_kn": np.full(4, 3.0)}
    found = over.at(x, weights)
    assert found.shape == (3, 4, 3)
    one = over.at({"slip_ratio": s[1], "normal_load_kn": np.full(4, 3.0)}, weights)
    np.testing.assert_allclose(found[1], one)


def test_beyond_the_box_it_goes_on_straight_and_then_has_no_value() -> None:
    nodes = {"slip_ratio": np.linspace(0.1, 0.5, 12)}
    known = (2.0 + 3.0 * nodes["slip_ratio"])[None]
    over = over_conditions(nodes, known)
    weights = over.weights(known)
    near, far = 0.5 + 0.9 * BEYOND * 0.4, 0.5 + 1.2 * BEYOND * 0.4
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
