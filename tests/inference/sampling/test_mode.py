"""The search for the mode."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from calib.data import Table
from calib.inference.priors import Prior, Priors
from calib.inference.problem import build_problem
from calib.inference.sampling.mode import find_mode, find_modes, prior_widths


def box(*bounds: tuple[float, float]) -> Priors:
    return Priors(
        tuple(
            Prior(f"x{i}", "1", "a test", "nobody", "uniform", False, 0.5 * (a + b), np.inf, a, b)
            for i, (a, b) in enumerate(bounds)
        )
    )


def inside(priors: Priors, log_density):
    def log_prob(t):
        return np.where(np.isfinite(priors.log_prob(t)), log_density(t), -np.inf)

    return log_prob


def test_an_interior_mode_of_a_correlated_density() -> None:
    priors = box((-5.0, 5.0), (-500.0, 500.0))
    target = stats.multivariate_normal([1.0, -200.0], [[0.01, 0.9], [0.9, 100.0]])
    found = find_mode(inside(priors, target.logpdf), priors)
    # Within a hundredth of the marginal sds: L-BFGS-B stops on a flat top.
    assert np.all(np.abs(found - [1.0, -200.0]) < 0.01 * np.array([0.1, 10.0]))


@pytest.mark.parametrize(("sign", "corner"), [(1.0, [2.0, 3.0]), (-1.0, [-1.0, 0.0])])
def test_a_mode_at_the_bounds(sign: float, corner: list[float]) -> None:
    priors = box((-1.0, 2.0), (0.0, 3.0))
    log_prob = inside(priors, lambda t: sign * (2.0 * t[:, 0] + t[:, 1]))
    found = find_mode(log_prob, priors)
    np.testing.assert_allclose(found, corner, atol=1e-7)
    assert np.isfinite(log_prob(found[None]))[0]


def test_a_mode_at_one_bound_and_inside_the_other() -> None:
    priors = box((-1.0, 2.0), (0.0, 3.0))
    log_prob = inside(priors, lambda t: 3.0 * t[:, 0] - (t[:, 1] - 1.2) ** 2 / 0.02)
    found = find_mode(log_prob, priors)
    np.testing.assert_allclose(found, [2.0, 1.2], atol=1e-3)


def test_a_given_start_finds_a_mode_the_prior_would_miss() -> None:
    priors = box((0.0, 1.0), (0.0, 1.0), (0.0, 1.0))
    spike = np.array([0.123, 0.456, 0.789])

    def log_density(t):
        near = -0.5 * np.square((t - spike) / 1e-4).sum(axis=1)
        return np.logaddexp(near, -200.0 - np.square(t - 0.5).sum(axis=1))

    log_prob = inside(priors, log_density)
    blind = find_mode(log_prob, priors)
    assert log_prob(blind[None])[0] < -100.0
    told = find_modes(log_prob, priors, np.random.default_rng(1), starts=spike[None] + 1e-4)[0].t
    np.testing.assert_allclose(told, spike, atol=1e-6)


def test_the_better_of_two_modes_is_taken() -> None:
    priors = box((-10.0, 10.0))
    log_prob = inside(
        priors,
        lambda t: np.logaddexp(
            stats.norm.logpdf(t[:, 0], -5.0, 0.5), 3.0 + stats.norm.logpdf(t[:, 0], 5.0, 0.5)
        ),
    )
    found = find_modes(log_prob, priors, np.random.default_rng(1), starts=np.array([[-5.0]]))[0].t
    assert found[0] == pytest.approx(5.0, abs=1e-3)


def two_modes(depth: float):
    """Two normals in four dimensions, of one width, the second lower by `depth`."""
    one, other = (np.full(4, x) for x in (-3.0, 3.0))

    def log_density(t):
        return np.logaddexp(
            -0.5 * np.square((t - one) / 0.15).sum(axis=1),
            -depth - 0.5 * np.square((t - other) / 0.15).sum(axis=1),
        )

    return log_density


@pytest.mark.parametrize("seed", range(10))
def test_both_of_two_modes_are_found(seed: int) -> None:
    priors = box(*[(-10.0, 10.0)] * 4)
    log_prob = inside(priors, two_modes(5.0))
    found = find_modes(log_prob, priors, np.random.default_rng(seed))
    assert len(found) == 2
    np.testing.assert_allclose([m.t for m in found], [[-3.0] * 4, [3.0] * 4], atol=1e-2)
    np.testing.assert_allclose([m.log_prob for m in found], [0.0, -5.0], atol=1e-3)
    np.testing.assert_allclose(found[1].covariance, 0.0225 * np.eye(4), atol=1e-4)


def test_a_mode_too_low_to_matter_is_left_out() -> None:
    priors = box(*[(-10.0, 10.0)] * 4)
    log_prob = inside(priors, two_modes(20.0))
    assert len(find_modes(log_prob, priors, np.random.default_rng(1))) == 1


def test_one_mode_is_found_once(rut_tables: tuple[Table, Table]) -> None:
    problem = build_problem("modified_bekker", rut_tables[0])
    assert len(find_modes(problem.log_prob, problem.priors, np.random.default_rng(1))) == 1


def test_the_mode_of_a_real_problem_is_stationary(rut_tables: tuple[Table, Table]) -> None:
    problem = build_problem("modified_bekker", rut_tables[0])
    mode = find_mode(problem.log_prob, problem.priors)
    top = problem.log_prob(mode[None])[0]
    steps = np.random.default_rng(2).standard_normal((500, 4)) * prior_widths(problem.priors)
    for size in (1e-3, 1e-2, 0.1):
        assert np.all(problem.log_prob(mode + size * steps) < top + 1e-6)


def test_widths_are_standard_deviations_or_a_quarter_of_the_range() -> None:
    priors = Priors((
        Prior("a", "1", "r", "s", "t", False, 1.0, 0.3),
        Prior("b", "1", "r", "s", "t", False, 7.0, 0.0),
        *box((1.0, 3.0)).entries,
    ))  # fmt: skip
    np.testing.assert_allclose(prior_widths(priors), [0.3, 0.5])
