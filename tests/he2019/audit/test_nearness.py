"""Bounds on costs: no data that have Table 4's cost may leave them."""

from __future__ import annotations

import numpy as np
import pytest

from calib.he2019.audit.bounds import (
    ASSUMED_SLIPS,
    joint_bounds,
    pressure_curves,
    printed_coefficients,
    references,
)
from calib.he2019.embedded import columns
from calib.he2019.published import PUBLISHED
from calib.models.magic_formula import magic_formula


@pytest.fixture(scope="module")
def known():
    return references(PUBLISHED)


@pytest.mark.parametrize("optimal", [False, True])
def test_simulated_data_stay_within_the_bounds(known, optimal):
    rng = np.random.default_rng(1)
    for reference in known:
        other = magic_formula(ASSUMED_SLIPS, **PUBLISHED.geometric[reference.psi].values)
        low, high = (float(b[0]) for b in reference.bounds(other[None], optimal=optimal))
        errors = rng.standard_normal((4000, ASSUMED_SLIPS.size))
        # Also those that point at the other curve, where the bounds are attained.
        apart = other - reference.curve
        if optimal:
            errors -= errors @ reference.span @ reference.span.T
            apart = apart - reference.span @ (reference.span.T @ apart)
        errors = np.vstack([errors, apart, -apart])
        errors *= np.sqrt(reference.cost) / np.linalg.norm(errors, axis=1)[:, None]
        costs = np.sum((reference.curve + errors - other) ** 2, axis=1)
        assert costs.min() >= low - 1e-12
        assert costs.max() <= high + 1e-12
        assert costs[-2:] == pytest.approx([low, high])


def test_the_reconstructed_data_stay_within_the_bounds(known):
    data = columns("drawbar_pull")
    for reference in known:
        rows = data["inflation_pressure_psi"] == reference.psi
        observed = data["drawbar_pull_kn"][rows]
        other = magic_formula(ASSUMED_SLIPS, **PUBLISHED.geometric[reference.psi].values)
        cost = float(np.sum((observed - other) ** 2))
        low, high = (float(b[0]) for b in reference.bounds(other[None], optimal=True))
        assert low <= cost <= high


def test_pressure_curves_against_the_equations_written_anew():
    c = printed_coefficients(PUBLISHED)
    found = pressure_curves(c[None], np.array([18.0, 30.0]), ASSUMED_SLIPS)[0]
    for i, p in enumerate((18.0, 30.0)):
        K = 0.267 - 0.007 * p + 0.0001 * p**2
        D = 3.272 - 0.107 * p + 0.001 * p**2
        E = 0.963 - 0.139 * p - 0.0025 * p**2
        u = K / (1.554 * D) * ASSUMED_SLIPS
        assert found[i] == pytest.approx(
            D * np.sin(1.554 * np.arctan(u - E * (u - np.arctan(u)))), rel=1e-12
        )


def test_no_value_is_an_infinite_cost(known):
    c = printed_coefficients(PUBLISHED)
    c[0] = -3.272
    least, largest = joint_bounds(c[None], known, ASSUMED_SLIPS, optimal=False)
    assert least.tolist() == largest.tolist() == [np.inf]
