"""The straightening map: one to one, its Jacobian, and what it straightens."""

from __future__ import annotations

import numpy as np
import pytest

from calib.inference.sampling.mixture import Straightener


def funnel(size: int = 4000, seed: int = 1) -> np.ndarray:
    """Bent along the second coordinate, and as wide as exp(0.3 sds of the last)."""
    rng = np.random.default_rng(seed)
    z = rng.standard_normal((size, 3))
    scale = np.exp(0.3 * z[:, 2])
    second = scale * z[:, 1]
    return np.column_stack([5.0 + 0.4 * second**2 + scale * z[:, 0], second, 0.1 * z[:, 2]])


def fitted(t: np.ndarray) -> Straightener:
    return Straightener.fit(t, np.full(len(t), 1.0 / len(t)))


@pytest.mark.parametrize("d", [1, 2, 3])
def test_there_and_back(d: int) -> None:
    t = funnel()[:, 3 - d :]
    straightener = fitted(t)
    # Also far outside what it was fitted to.
    for scale in (1.0, 30.0):
        there, log_jacobian = straightener.straighten(scale * t)
        back, the_same = straightener.bend(there)
        np.testing.assert_allclose(back, scale * t, rtol=1e-7, atol=1e-7)
        np.testing.assert_allclose(the_same, log_jacobian, atol=1e-9)


def test_the_jacobian_is_that_of_the_map() -> None:
    t = funnel()
    straightener = fitted(t)
    step = 1e-6
    for point in t[:20]:
        sides = [
            straightener.straighten(point + side * step * np.eye(3))[0] for side in (1.0, -1.0)
        ]
        jacobian = (sides[0] - sides[1]) / (2.0 * step)
        _, log_det = straightener.straighten(point[None])
        # Central differences: to about the step's square, and rounding over the step.
        assert log_det[0] == pytest.approx(np.linalg.slogdet(jacobian)[1], abs=1e-5)


def test_what_was_bent_and_spread_is_straight_and_even() -> None:
    t = funnel()
    straightener = fitted(t)
    v, _ = straightener.straighten(t)
    # Per sd of the last coordinate; 4000 draws, and a bend that is not quite a quadratic's.
    np.testing.assert_allclose(straightener.growth[1:, 0], 0.3, atol=0.04)
    first, second, last = v.T
    for before, after in (
        ((t[:, 1] ** 2, t[:, 2]), (second**2, last)),
        ((t[:, 0], t[:, 1] ** 2), (first, second**2)),
        ((abs(t[:, 0] - t[:, 0].mean()), t[:, 2]), (abs(first), last)),
    ):
        assert abs(np.corrcoef(*before)[0, 1]) > 0.2
        assert abs(np.corrcoef(*after)[0, 1]) < 0.1


def test_a_scale_of_its_own_is_found_and_noise_is_not_mistaken_for_one() -> None:
    rng = np.random.default_rng(3)
    z = rng.standard_normal((6000, 3))
    t = np.column_stack([np.exp(0.2 * z[:, 1]) * z[:, 0], z[:, 1], z[:, 2]])
    growth = fitted(t).growth
    # In the order last to first: the first coordinate's scale grows with the second alone.
    assert growth[2, 1] == pytest.approx(0.2, abs=0.04)
    others = growth.copy()
    others[2, 1] = 0.0
    assert abs(others).max() < 0.04


def test_the_identity_leaves_everything_as_it_is() -> None:
    t = funnel(50)
    same, log_jacobian = Straightener.identity(3).straighten(t)
    np.testing.assert_array_equal(same, t)
    np.testing.assert_array_equal(log_jacobian, np.zeros(50))
    np.testing.assert_array_equal(Straightener.identity(3).bend(t)[0], t)


def test_draws_without_spread_cannot_be_straightened() -> None:
    t = funnel()
    t[:, 1] = 2.0
    with pytest.raises(np.linalg.LinAlgError):
        fitted(t)
