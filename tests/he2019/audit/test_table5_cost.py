"""The least cost of Eqs 12-15: bounds against optima of data that have Table 4's costs."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

from calib.he2019.audit.bounds import ASSUMED_SLIPS
from calib.he2019.audit.finding import Basis, Verdict
from calib.he2019.audit.pull import Bounds, assumed_slips_bound, bounds, cost_as_printed, joint_cost
from calib.he2019.embedded import columns
from calib.he2019.published import PUBLISHED
from calib.he2019.reconstruction import magic_formula_jacobian
from calib.models.magic_formula import magic_formula
from tests.he2019.audit.altered import altered

TABLES = PUBLISHED.genetic.values()


def joint_optimum(slips, pulls) -> float:
    """Fit one C and B, D, E of each pressure: Eqs 12-15 through three pressures."""
    start = np.concatenate([[1.56], *([t.values[n] for n in "BDE"] for t in TABLES)])

    def residuals(t):
        each = zip(t[1:].reshape(3, 3), slips, pulls, strict=True)
        return np.concatenate([magic_formula(x, B, t[0], D, E) - y for (B, D, E), x, y in each])

    found = least_squares(residuals, start, x_scale="jac", max_nfev=400)
    return 2.0 * float(found.cost)


@pytest.fixture(scope="module")
def at_most() -> Bounds:
    return bounds(PUBLISHED)


@pytest.fixture(scope="module")
def anywhere(at_most) -> float:
    return at_most.anywhere


def test_the_printed_cost_is_not_a_minimum(anywhere, at_most):
    found = joint_cost(PUBLISHED, 0.0709, at_most)
    assert found.verdict is Verdict.CONTRADICTED
    assert found.basis is Basis.PRINTED
    assert anywhere < 0.10495


@pytest.mark.parametrize(
    ("cost", "verdict", "basis"),
    [
        ("0.0700", Verdict.CONSISTENT, Basis.SLIPS),
        ("0.0950", Verdict.CONTRADICTED, Basis.SLIPS),
        ("0.0500", Verdict.CONTRADICTED, Basis.PRINTED),
        ("0.1500", Verdict.CONTRADICTED, Basis.PRINTED),
    ],
)  # fmt: skip
def test_another_cost_would_be_judged_otherwise(cost, verdict, basis, at_most):
    # The bounds follow from Table 4 alone.
    found = joint_cost(altered({"Table 5: cost": cost}), 0.0709, at_most)
    assert (found.verdict, found.basis) == (verdict, basis)


@pytest.mark.parametrize("seed", range(12))
def test_simulated_data_at_any_slips_have_their_optimum_below_the_bound(seed, anywhere):
    rng = np.random.default_rng(seed)
    slips, pulls = [], []
    for table in TABLES:
        # Any 14 slips 1 % apart: kinder and crueller designs than the assumed one.
        x = np.sort(rng.choice(np.arange(1, 75), 14, replace=False)) + rng.uniform(0.0, 0.5)
        errors = rng.standard_normal(14) + rng.choice([0.0, 2.0]) * np.sign(x - np.median(x))
        errors *= np.sqrt(table.quality["cost"].value) / np.linalg.norm(errors)
        slips.append(x)
        pulls.append(magic_formula(x, **table.values) + errors)
    assert joint_optimum(slips, pulls) <= anywhere


@pytest.mark.parametrize("optimal", [False, True])
def test_simulated_data_at_the_assumed_slips(optimal):
    rng = np.random.default_rng(5)
    bound = assumed_slips_bound(PUBLISHED, optimal=optimal)
    for _ in range(8):
        pulls = []
        for table in TABLES:
            errors = rng.standard_normal(ASSUMED_SLIPS.size)
            if optimal:
                q, _ = np.linalg.qr(magic_formula_jacobian(ASSUMED_SLIPS, **table.values))
                errors -= q @ (q.T @ errors)
            errors *= np.sqrt(table.quality["cost"].value) / np.linalg.norm(errors)
            pulls.append(magic_formula(ASSUMED_SLIPS, **table.values) + errors)
        assert joint_optimum([ASSUMED_SLIPS] * 3, pulls) <= bound


def test_the_reconstructed_optimum_obeys_all_bounds(anywhere):
    pulls = columns("drawbar_pull")["drawbar_pull_kn"].reshape(3, -1)
    optimum = joint_optimum([ASSUMED_SLIPS] * 3, pulls)
    assert optimum == pytest.approx(0.0709, abs=5e-5)
    strict, free = (assumed_slips_bound(PUBLISHED, optimal=o) for o in (True, False))
    assert optimum < strict < free < anywhere


def test_the_digits_as_they_stand_cost_more_than_is_printed():
    assert cost_as_printed(PUBLISHED).verdict is Verdict.CONTRADICTED
    # Were their own cost printed, it would be possible.
    assert cost_as_printed(altered({"Table 5: cost": "0.40"})).verdict is Verdict.CONSISTENT
