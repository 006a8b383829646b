"""Held-out rows, and leave-one-out against really leaving every row out."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from scipy.special import logsumexp

import calib.validation.validate as validate_module
from calib.data import Table, table_from_arrays
from calib.errors import CalibError
from calib.inference.calibration import Calibration, calibrate
from calib.inference.problem import build_problem
from calib.inference.sampler import SamplerSettings
from calib.validation.validate import Validation, leave_one_out, validate_held_out

N = 9
FEW = SamplerSettings(steps=20, max_steps=20)


@pytest.fixture(scope="module")
def small() -> Calibration:
    """Nine ruts, the last of them off the line."""
    rng = np.random.default_rng(2)
    pressure = np.geomspace(60.0, 240.0, N)
    ln_rut = np.log(22.0) + np.log(pressure / 120.0) / 1.1 + 0.06 * rng.standard_normal(N)
    ln_rut[-1] += 0.12
    table = table_from_arrays(
        {"average_ground_pressure_kpa": pressure, "rut_depth_mm": np.exp(ln_rut)}, source="small"
    )
    return calibrate(build_problem("bekker", table), 5)


@pytest.fixture(scope="module")
def smoothed(small: Calibration) -> Validation:
    return leave_one_out(small)


@pytest.fixture(scope="module")
def exact(small: Calibration) -> tuple[np.ndarray, np.ndarray]:
    """Log predictive density of every row when it is not fitted, and its standard error."""
    problem = small.problem
    elpd, error = np.empty(N), np.empty(N)
    for i in range(N):
        rest = problem.with_table(problem.table.take(np.arange(N) != i))
        again = calibrate(rest, 100 + i)
        assert again.converged
        natural = rest.theta(again.draws.flat)
        row = {name: v[i : i + 1] for name, v in problem.conditions.items()}
        median = problem.bound.predict(natural[:, :-1], row)[:, 0]
        density = stats.lognorm.pdf(problem.observed[i], natural[:, -1], scale=median)
        elpd[i] = np.log(density.mean())
        error[i] = density.std() / density.mean() / np.sqrt(again.draws.report.ess_bulk.min())
    return elpd, error


def total_error(errors: np.ndarray) -> float:
    """Five standard errors of a sum of two estimates: importance sampling has the effective size
    of a few thousand of its draws, so at most three times the error of the refits."""
    return 5.0 * np.sqrt(1.0 + 9.0) * float(np.sqrt(np.square(errors).sum()))


def test_smoothed_leave_one_out_is_what_exact_refits_give(small, smoothed, exact) -> None:
    elpd, error = exact
    assert smoothed.elpd == pytest.approx(elpd.sum(), abs=total_error(error))
    assert total_error(error) < 0.5  # it can tell: the fitted rows score much better
    rows = small.problem.log_likelihood_rows(small.draws.flat)
    fitted = float((logsumexp(rows, axis=0) - np.log(rows.shape[0])).sum())
    assert smoothed.elpd < fitted - total_error(error)
    assert smoothed.elpd_se == pytest.approx(np.sqrt(N) * elpd.std(ddof=1), rel=0.2)


def test_rows_that_cannot_be_smoothed_are_refitted(
    small, exact, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(validate_module, "PARETO_K_MAX", -np.inf)
    seen: list[tuple[int, int]] = []
    found = leave_one_out(small, progress=lambda done, n: seen.append((done, n)))
    assert found.refitted == tuple(range(N))
    assert found.unconverged == ()
    assert seen == [(i + 1, N) for i in range(N)]
    elpd, error = exact
    # Both by refits: sqrt(2) times the error of one.
    bound = 5.0 * np.sqrt(2.0) * float(np.sqrt(np.square(error).sum()))
    assert found.elpd == pytest.approx(elpd.sum(), abs=bound)


@pytest.mark.slow
def test_two_workers_refit_to_the_same_numbers(small, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(validate_module, "PARETO_K_MAX", -np.inf)
    one, two = (leave_one_out(small, settings=FEW, workers=workers) for workers in (1, 2))
    assert two.refitted == one.refitted == tuple(range(N))
    assert two.unconverged == one.unconverged
    np.testing.assert_array_equal(two.draws, one.draws)
    assert (two.elpd, two.elpd_se) == (one.elpd, one.elpd_se)


def test_rows_are_refitted_where_the_shape_is_too_large(smoothed) -> None:
    assert smoothed.pareto_k.shape == (N,)
    assert set(smoothed.refitted) == set(np.flatnonzero(smoothed.pareto_k > 0.7))


def test_a_row_left_out_is_predicted_worse_than_fitted(small, smoothed) -> None:
    """The rut off the line pulls the fit towards it; without it, the prediction moves away."""
    natural = small.problem.theta(small.draws.flat)
    fitted = np.median(
        small.problem.bound.predict(natural[:, :-1], small.problem.conditions)[:, -1]
    )
    observed = small.problem.observed[-1]
    assert smoothed.scores.median[-1] < fitted < observed


def test_refits_that_do_not_converge_are_named(small, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(validate_module, "PARETO_K_MAX", -np.inf)
    found = leave_one_out(small, settings=FEW)
    assert found.unconverged == found.refitted == tuple(range(N))


def test_leave_one_out_scores_are_of_its_own_draws(small, smoothed) -> None:
    assert smoothed.method == "leave_one_out"
    assert smoothed.draws.shape == (4000, N)
    np.testing.assert_array_equal(smoothed.observed, small.problem.observed)
    error = np.median(smoothed.draws, axis=0) - smoothed.observed
    assert smoothed.scores.rmse == pytest.approx(np.sqrt(np.mean(error**2)))
    again = leave_one_out(small)
    np.testing.assert_array_equal(again.draws, smoothed.draws)


def test_held_out_rows_are_predicted_from_the_others(
    rut_calibration: Calibration, rut_tables: tuple[Table, Table]
) -> None:
    found = validate_held_out(rut_calibration, rut_tables[1])
    assert found.method == "held_out"
    assert found.refitted == ()
    assert np.isnan(found.elpd)
    np.testing.assert_array_equal(found.observed, rut_tables[1]["rut_depth_mm"])
    assert found.draws.shape == (4000, 9)
    natural = rut_calibration.problem.theta(rut_calibration.subset(4000))
    median = rut_calibration.problem.bound.predict(natural[:, :-1], rut_tables[1].columns)
    # sigma is about 0.09: a median of 4000 draws about it errs by 1.25 x 0.09/sqrt(4000) = 0.2 %.
    np.testing.assert_allclose(found.scores.median, np.median(median, axis=0), rtol=0.01)
    # Rows of one test campaign with the noise of the others: nine hits or nearly, by chance
    # fewer than six of nine once in 400.
    assert found.scores.coverage[0.9].hits >= 6


def test_beyond_the_range_vectors_without_a_value_are_left_out(
    pull_calibration: Calibration,
) -> None:
    """At 60 psi some of the quadratics have turned negative, at 400 psi most or all."""
    far = table_from_arrays(
        {
            "slip_ratio": np.array([0.1, 0.2]),
            "inflation_pressure_psi": np.full(2, 60.0),
            "drawbar_pull_kn": np.array([0.3, 0.31]),
        },
        source="far.csv",
    )
    found = validate_held_out(pull_calibration, far)
    assert 0 < len(found.draws) < 4000
    assert np.isfinite(found.draws).all()
    assert np.isfinite(found.scores.crps)


def test_no_value_at_all_is_told(
    pull_calibration: Calibration, pull_tables: tuple[Table, Table], monkeypatch
) -> None:
    monkeypatch.setattr(
        validate_module, "predictive_draws", lambda *a: (None, np.full((4000, 14), np.nan))
    )
    with pytest.raises(CalibError, match="has no value at the held-out rows") as caught:
        validate_held_out(pull_calibration, pull_tables[1])
    assert "he2019 drawbar_pull" in str(caught.value)
