"""Tables 1 and 6: the verdict follows the figure, and would be another for another figure."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calib.data import hold_out
from calib.he2019.audit.bounds import printed
from calib.he2019.audit.finding import Verdict
from calib.he2019.audit.table6 import (
    attenuation,
    inverse_by_likelihood,
    inverse_by_print,
    log_pressure_ratio,
    prediction_at_30,
    rut_quality_findings,
    signs_of_rut,
    simulate_inverse,
    study_quality,
    within_pressure_sd,
)
from calib.he2019.audit.tables_1_to_4 import density_findings, density_range
from calib.he2019.embedded import load_he2019
from calib.he2019.estimators import rut_regression
from calib.he2019.published import PUBLISHED
from calib.inference.estimators import estimate
from calib.inference.problem import build_problem
from calib.models.soil import bulk_density
from tests.he2019.altered import altered, flipped


def judged(published):
    return {f.key: f for f in density_findings(published)}


@settings(max_examples=30)
@given(st.lists(st.floats(0, 1), min_size=6, max_size=6))
def test_every_density_lies_in_the_range(shares):
    figures = [printed(PUBLISHED.bulk_density.estimates[n]) for n in ("C1", "C2", "C3", "C4")]
    c = [float(i.lower + s * (i.upper - i.lower)) for i, s in zip(figures, shares, strict=False)]
    index, water = np.array(100.0 + 2900.0 * shares[4]), np.array(0.088 * shares[5])
    assert density_range(PUBLISHED).holds(bulk_density(index, water, *c))


@pytest.mark.parametrize(
    ("changes", "key", "verdict"),
    [
        ({"C1": "5.934e10"}, "table1_exponent_of_C1", Verdict.CORRECTED),
        # With C1 near one both signs of its exponent are alike.
        ({"C1": "5.934e-1", "C4": "13.2"}, "table1_exponent_of_C1", Verdict.CONSISTENT),
        ({"C4": "8.000", "C1": "5.934e0"}, "table1_sign_of_C3", Verdict.CONSISTENT),
        # A thousand times less: only MPa gives a soil. A thousand times more: only kPa does.
        ({"C1": "5.934e-13"}, "table1_unit_of_cone_index", Verdict.CORRECTED),
        ({"C1": "5.934e-16"}, "table1_unit_of_cone_index", Verdict.CONTRADICTED),
        ({"C1": "5.934e0"}, "table1_unit_of_cone_index", Verdict.CONSISTENT),
        # Errors below 0.24 % cannot have that RMSE; R^2 = 0.98 needs cone indices over decades.
        ({"max_relative_error": "0.0024"}, "table1_quality", Verdict.CONTRADICTED),
        ({"r_squared": "0.981"}, "table1_quality", Verdict.CONTRADICTED),
    ],
)
def test_another_table_1_would_be_judged_otherwise(changes, key, verdict):
    found = judged(altered({f"Table 1: {name}": text for name, text in changes.items()}))
    assert found[key].verdict is verdict


def test_the_other_exponent_could_hold_for_few_samples_only():
    # By brute force: errors of equal size are the smallest largest error that an RMSE allows.
    density, relative, rmse = 0.6621, 0.02945, 0.02815
    possible = [
        n for n in range(5, 200)
        if rmse * np.sqrt((n - 4) / n) <= relative * density / (1.0 - relative)
    ]  # fmt: skip
    evidence = judged(PUBLISHED)["table1_exponent_of_C1"].evidence
    assert f"only with {max(possible)} samples or fewer" in evidence


def judged_rut(published):
    return {f.key: f for f in rut_quality_findings(published, study_quality(published))}


@pytest.mark.parametrize(
    ("figure", "text", "key", "verdict"),
    [
        ("rmse", "0.171", "table6_consistency", Verdict.CONSISTENT),
        ("max_relative_error", "0.01", "table6_fitted_errors", Verdict.CONTRADICTED),
        ("max_relative_error", "0.60", "table6_fitted_errors", Verdict.CONTRADICTED),
        # Too good to be true.
        ("held_out_max_relative_error", "0.012", "table6_held_out_errors", Verdict.CONTRADICTED),
    ],
)
def test_another_table_6_would_be_judged_otherwise(figure, text, key, verdict):
    assert judged_rut(altered({f"Table 6: {figure}": text}))[key].verdict is verdict


def test_signs_of_the_rut_model():
    assert signs_of_rut(PUBLISHED).verdict is Verdict.CONFIRMED
    assert signs_of_rut(flipped("Table 6: n1")).verdict is Verdict.CONTRADICTED
    assert signs_of_rut(altered({"Table 6: k": "3.306e-5"})).verdict is Verdict.CONTRADICTED


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


def test_the_number_of_points_that_reconciles():
    study = study_quality(PUBLISHED)
    # Independent: solved for n with the digits at their ends.
    gap = np.log(266.56 / 159.43)
    ends = [3.0 / (1.0 - gap**2 * (1.0 - r) / (4.0 * s**2))
            for r, s in ((0.6305, 0.1595), (0.6295, 0.1585))]  # fmt: skip
    # The contact lengths' own digits move either end by less than one point.
    assert study.reconciled.min() == pytest.approx(np.ceil(ends[0]), abs=1)
    assert study.reconciled.max() == pytest.approx(np.floor(ends[1]), abs=1)
    assert 90 in study.reconciled
    assert 18 not in study.reconciled


def test_the_scatter_within_pressures_is_that_of_the_reconstructed_data():
    fitted, _ = hold_out(load_he2019("rut_depth"), "inflation_pressure_psi", 30.0)
    problem = build_problem("modified_bekker", fitted)
    direct = estimate(problem, "least_squares", np.random.default_rng(1))
    assert within_pressure_sd(PUBLISHED, 18) == pytest.approx(direct.rmse, rel=0.05)


def test_load_over_area_by_hand():
    found = judged_rut(PUBLISHED)["ground_pressure"].found
    for quantity, length in zip(found, (266.56, 201.59, 159.43), strict=True):
        assert quantity.value == pytest.approx(5e6 / (176.0 * length), rel=1e-5)


@pytest.fixture(scope="module")
def inverse(audit):
    return audit.inverse


def test_the_fitted_means_differ_by_R2_of_the_pressures():
    """The identity behind the correction, on the reconstructed ruts and their own regression."""
    fitted, _ = hold_out(load_he2019("rut_depth"), "inflation_pressure_psi", 30.0)
    ln_z = np.log(fitted["rut_depth_mm"] / 1000.0)
    exponent = 1.996 + 1.266 * fitted["slip_ratio"]
    low = fitted["inflation_pressure_psi"] == 18.0
    ln_p = np.log(fitted["average_ground_pressure_kpa"])
    gap = float(ln_p[~low].mean() - ln_p[low].mean())
    by_means = float((exponent * ln_z)[~low].mean() - (exponent * ln_z)[low].mean())
    assert by_means / gap == pytest.approx(0.630, abs=5e-4)


def test_corrected_exponents_bring_the_ratio_of_ruts_back():
    found = {q.name: q for q in inverse_by_print(PUBLISHED).found}
    assert found["n0, by the means of the ruts"].value == pytest.approx(1.996 / 0.630, rel=1e-5)
    fitted, _ = hold_out(load_he2019("rut_depth"), "inflation_pressure_psi", 30.0)
    ln_z, low = np.log(fitted["rut_depth_mm"]), fitted["inflation_pressure_psi"] == 18.0
    ratio = float(np.exp(ln_z[~low].mean() - ln_z[low].mean()))
    # The reconstructed pressures are 0.477 apart in logarithm, the contact lengths 0.514.
    stated = found["rut at 42 psi over rut at 18 psi, by their means"].value
    assert np.log(stated) * 0.4772 / 0.5140 == pytest.approx(np.log(ratio), rel=0.03)


def test_a_good_fit_needs_no_correction(inverse):
    good = altered({"Table 6: r_squared": "0.990"})
    assert inverse_by_print(good).verdict is Verdict.CONFIRMED
    assert prediction_at_30(good, inverse).verdict is Verdict.CONSISTENT
    assert attenuation(good).holds(1.0 / 0.9903)


def test_a_held_out_pressure_far_from_the_middle_would_see_it(inverse):
    lengths = dict(PUBLISHED.setup.contact_length_mm)
    lengths[30] = replace(lengths[30], text="60.00")
    far = replace(PUBLISHED, setup=replace(PUBLISHED.setup, contact_length_mm=lengths))
    assert prediction_at_30(far, inverse).verdict is Verdict.CONSISTENT


def test_where_Eq_22_holds_the_truth_nothing_is_corrected(inverse):
    scattered = inverse.simulated * [2.0, 1.0, 1.0]
    lucky = replace(inverse, simulated=np.vstack([inverse.simulated, scattered]))
    assert inverse_by_likelihood(PUBLISHED, lucky).verdict is Verdict.CONSISTENT


def test_simulated_regressions_are_those_of_the_estimator(inverse):
    problem, truth = inverse.calibration.problem, inverse.direct
    found = simulate_inverse(problem, truth, np.random.default_rng(3), size=1)
    # The same campaign, regressed by the package's estimator.
    v, table = truth.reported, problem.table
    slip = table["slip_ratio"]
    mean = np.log(table["average_ground_pressure_kpa"] / v["k"]) / (v["n0"] + v["n1"] * slip)
    ln_z = mean + truth.rmse * np.random.default_rng(3).standard_normal((1, slip.size))[0]
    columns = dict(table.columns) | {"rut_depth_mm": 1000.0 * np.exp(ln_z)}
    again = rut_regression(problem.with_table(replace(table, columns=columns)))
    assert found[0] == pytest.approx(
        [again.reported["n0"], again.reported["n1"], again.r_squared], rel=1e-8
    )


def test_what_has_not_converged_decides_nothing(inverse):
    report = replace(inverse.calibration.draws.report, passed=False, reasons=("R-hat",))
    draws = replace(inverse.calibration.draws, report=report)
    unfinished = replace(inverse, calibration=replace(inverse.calibration, draws=draws))
    assert inverse_by_likelihood(PUBLISHED, unfinished).verdict is Verdict.UNTESTABLE
