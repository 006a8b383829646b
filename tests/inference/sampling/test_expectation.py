"""A step of expectation maximisation, against one written draw by draw with SciPy's densities."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from calib.inference.sampling import mixture as expectation
from calib.inference.sampling.mixture import fit_mixture, moments


def draws(d: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    x = rng.standard_normal((150, d)) + 2.0 * (rng.random((150, 1)) < 0.4)
    weight = rng.exponential(size=150)
    return x, weight / weight.sum()


def start(d: int) -> expectation._Parts:
    rng = np.random.default_rng(4)
    spread = 0.3 * rng.standard_normal((3, d, d))
    covariance = spread @ spread.swapaxes(1, 2) + np.eye(d)
    return expectation._Parts(
        np.array([0.5, 0.3, 0.2]), rng.standard_normal((3, d)),
        np.linalg.cholesky(covariance), np.array([3.0, 6.0, 12.0]),
    )  # fmt: skip


@pytest.mark.parametrize("d", [1, 2, 5])
def test_one_step(d: int) -> None:
    (x, weight), parts, effective = draws(d), start(d), 120.0
    found = expectation._improved(
        parts, x.T, expectation._products(x.T), weight, effective, choose_dof=False
    )
    mass, mean, covariance = np.zeros(3), np.zeros((3, d)), np.zeros((3, d, d))
    scales = parts.choleskys @ parts.choleskys.swapaxes(1, 2)
    density = np.array([
        w * stats.multivariate_t(m, s, df=v).pdf(x)
        for w, m, s, v in zip(parts.weights, parts.means, scales, parts.dofs, strict=True)
    ])  # fmt: skip
    share = density / density.sum(axis=0) * weight
    for j in range(3):
        tail = np.zeros(len(x))
        for i in range(len(x)):
            apart = x[i] - parts.means[j]
            squared = apart @ np.linalg.solve(scales[j], apart)
            # The expected precision of a draw from a Student-t.
            tail[i] = share[j, i] * (parts.dofs[j] + d) / (parts.dofs[j] + squared)
        mass[j], mean[j] = share[j].sum(), tail @ x / tail.sum()
        scatter = sum(w * np.outer(p - mean[j], p - mean[j]) for w, p in zip(tail, x, strict=True))
        pseudo = d / effective
        covariance[j] = (scatter + 0.5 * pseudo * np.eye(d)) / (mass[j] + pseudo)
    np.testing.assert_allclose(found.weights, mass / mass.sum(), rtol=1e-10)
    np.testing.assert_allclose(found.means, mean, atol=1e-12)
    np.testing.assert_allclose(
        found.choleskys @ found.choleskys.swapaxes(1, 2), covariance, atol=1e-12
    )


def test_the_likeliest_degrees_of_freedom() -> None:
    for dof in (3.0, 30.0):
        t = stats.multivariate_t(np.zeros(2), np.eye(2), df=dof).rvs(20_000, random_state=1)
        squared = np.square(t).sum(axis=1)[None]
        found = expectation._likeliest_dof(squared, np.full((1, 20_000), 1 / 20_000), 2)
        assert found[0] == dof


def test_two_clusters_are_found_with_their_shares() -> None:
    rng = np.random.default_rng(5)
    left = rng.random(4000) < 0.25
    x = rng.standard_normal((4000, 2)) + np.where(left, -8.0, 8.0)[:, None] * [1.0, 0.0]
    weight = np.full(4000, 1 / 4000)
    mean, cholesky = moments(x, weight)
    mixture = fit_mixture(x, weight, mean, cholesky, 4000.0, rng)
    share = sum(
        w for w, c in zip(mixture.weights, mixture.components, strict=True) if c.mean[0] < 0.0
    )
    assert abs(share - left.mean()) < 0.01
    drawn = mixture.sample(rng, 20_000)
    # Wider than the clusters by design, but of their kind.
    assert 1.0 < drawn[drawn[:, 0] > 0.0, 1].std() < 1.2


def test_components_without_draws_are_dropped() -> None:
    x, weight = draws(2)
    parts = start(2)
    parts.means[2] = 500.0
    found = expectation._improved(
        parts, x.T, expectation._products(x.T), weight, 150.0, choose_dof=False
    )
    assert found.weights.size == 2
