"""The inverse regression: the attenuation as algebra, in simulation, and in the findings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.data import hold_out
from calib.he2019.audit.finding import Verdict
from calib.he2019.audit.regressions import (
    attenuation,
    inverse_by_likelihood,
    inverse_by_print,
    inverse_findings,
    prediction_at_30,
    simulate_inverse,
    study_inverse,
)
from calib.he2019.embedded import load_he2019
from calib.he2019.estimators import rut_regression
from calib.he2019.published import PUBLISHED
from tests.he2019.audit.altered import altered


@pytest.fixture(scope="module")
def study(rut_calibration):
    return study_inverse(PUBLISHED, 2019, calibration=rut_calibration)


def test_verdicts(study):
    assert {f.key: f.verdict for f in inverse_findings(PUBLISHED, study)} == {
        "table6_inverse_regression": Verdict.CORRECTED,
        "table6_likelihood": Verdict.CORRECTED,
        "table6_prediction_at_30": Verdict.CORRECTED,
    }


def test_only_the_likelihood_depends_on_the_reconstruction(study):
    found = {f.key: f.reconstructed for f in inverse_findings(PUBLISHED, study)}
    assert found == {
        "table6_inverse_regression": False, "table6_likelihood": True,
        "table6_prediction_at_30": False,
    }  # fmt: skip


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


def test_a_good_fit_needs_no_correction(study):
    good = altered({"Table 6: r_squared": "0.990"})
    assert inverse_by_print(good).verdict is Verdict.CONFIRMED
    assert prediction_at_30(good, study).verdict is Verdict.CONSISTENT
    assert attenuation(good).holds(1.0 / 0.9903)


def test_a_held_out_pressure_far_from_the_middle_would_see_it(study):
    lengths = dict(PUBLISHED.setup.contact_length_mm)
    lengths[30] = replace(lengths[30], text="60.00")
    far = replace(PUBLISHED, setup=replace(PUBLISHED.setup, contact_length_mm=lengths))
    assert prediction_at_30(far, study).verdict is Verdict.CONSISTENT


def test_where_Eq_22_holds_the_truth_nothing_is_corrected(study):
    scattered = study.simulated * [2.0, 1.0, 1.0]
    lucky = replace(study, simulated=np.vstack([study.simulated, scattered]))
    assert inverse_by_likelihood(PUBLISHED, lucky).verdict is Verdict.CONSISTENT


def test_simulated_regressions_are_those_of_the_estimator(study):
    problem, truth = study.calibration.problem, study.direct
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


def test_without_noise_nothing_is_attenuated(study):
    exact = replace(study.direct, rmse=1e-9)
    rng = np.random.default_rng(1)
    n0, n1, r_squared = simulate_inverse(study.calibration.problem, exact, rng, size=1)[0]
    assert (n0, n1) == pytest.approx(
        (exact.reported["n0"], exact.reported["n1"]), rel=1e-5
    )  # fmt: skip
    assert r_squared == pytest.approx(1.0)


def test_posterior_statements_carry_intervals(study):
    found = inverse_by_likelihood(PUBLISHED, study)
    posterior = [q for q in found.found if "posterior" in q.name]
    assert len(posterior) == 3
    assert all(q.lower < q.value < q.upper and q.interval == "95 % HDI" for q in posterior)


def test_what_has_not_converged_decides_nothing(study):
    report = replace(study.calibration.draws.report, passed=False, reasons=("R-hat",))
    draws = replace(study.calibration.draws, report=report)
    unfinished = replace(study, calibration=replace(study.calibration, draws=draws))
    assert inverse_by_likelihood(PUBLISHED, unfinished).verdict is Verdict.UNTESTABLE
