"""Table 6's goodness of fit against regressions whose R^2, RMSE and n are known."""

from __future__ import annotations

import numpy as np
import pytest

from calib.data import hold_out
from calib.he2019.audit.finding import Verdict
from calib.he2019.audit.regressions import (
    log_pressure_ratio,
    rut_quality_findings,
    study_quality,
    within_pressure_sd,
)
from calib.he2019.embedded import load_he2019
from calib.he2019.published import PUBLISHED
from calib.inference.estimators import estimate
from calib.inference.problem import build_problem
from tests.he2019.audit.altered import altered


def judged(published):
    return {f.key: f for f in rut_quality_findings(published, study_quality(published))}


@pytest.fixture(scope="module")
def study():
    return study_quality(PUBLISHED)


def test_verdicts():
    assert {key: f.verdict for key, f in judged(PUBLISHED).items()} == {
        "table6_consistency": Verdict.CONTRADICTED,
        "table6_fitted_errors": Verdict.CONSISTENT,
        "table6_held_out_errors": Verdict.CONSISTENT,
        "ground_pressure": Verdict.UNTESTABLE,
    }


@pytest.mark.parametrize(("n", "share"), [(18, 0.5), (28, 0.5), (20, 0.3), (90, 0.5)])
def test_the_identity_on_regressions(n, share):
    rng = np.random.default_rng(n)
    gap = 0.51
    y = np.where(np.arange(n) < share * n, 4.7, 4.7 + gap)
    z = 0.4 * y + 0.2 * rng.standard_normal(n)
    X = np.column_stack([np.ones(n), z, rng.uniform(0.0, 0.2, n) * z])
    left = y - X @ np.linalg.lstsq(X, y, rcond=None)[0]
    sse, sst = float(left @ left), float(np.sum((y - y.mean()) ** 2))
    known = altered(
        {"Table 6: r_squared": f"{1.0 - sse / sst:.6f}",
         "Table 6: rmse": f"{np.sqrt(sse / (n - 3)):.6f}"}
    )  # fmt: skip
    found = log_pressure_ratio(known, np.array(float(n)), share)
    assert found.holds(gap)
    assert float(found.half_width) < 1e-4


def test_the_number_of_points_that_reconciles(study):
    # Independent: solved for n with the digits at their ends.
    gap = np.log(266.56 / 159.43)
    ends = [3.0 / (1.0 - gap**2 * (1.0 - r) / (4.0 * s**2))
            for r, s in ((0.6305, 0.1595), (0.6295, 0.1585))]  # fmt: skip
    # The contact lengths' own digits move either end by less than one point.
    assert study.reconciled.min() == pytest.approx(np.ceil(ends[0]), abs=1)
    assert study.reconciled.max() == pytest.approx(np.floor(ends[1]), abs=1)
    assert 90 in study.reconciled
    assert 18 not in study.reconciled


def test_figures_that_agree_with_18_points_are_consistent():
    assert judged(altered({"Table 6: rmse": "0.171"}))["table6_consistency"].verdict is (
        Verdict.CONSISTENT
    )


def test_the_scatter_within_pressures_is_that_of_the_reconstructed_data():
    fitted, _ = hold_out(load_he2019("rut_depth"), "inflation_pressure_psi", 30.0)
    problem = build_problem("modified_bekker", fitted)
    direct = estimate(problem, "least_squares", np.random.default_rng(1))
    assert within_pressure_sd(PUBLISHED, 18) == pytest.approx(direct.rmse, rel=0.05)


@pytest.mark.parametrize("largest", ["0.01", "0.60"])
def test_fitted_errors_that_the_rmse_does_not_allow(largest):
    found = judged(altered({"Table 6: max_relative_error": largest}))
    assert found["table6_fitted_errors"].verdict is Verdict.CONTRADICTED


def test_held_out_errors_too_good_to_be_true():
    found = judged(altered({"Table 6: held_out_max_relative_error": "0.012"}))
    assert found["table6_held_out_errors"].verdict is Verdict.CONTRADICTED


def test_load_over_area_by_hand():
    found = judged(PUBLISHED)["ground_pressure"].found
    for quantity, length in zip(found, (266.56, 201.59, 159.43), strict=True):
        assert quantity.value == pytest.approx(5e6 / (176.0 * length), rel=1e-5)
