"""Errors of conditions: attenuation, set points, densities against dense and latent ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats
from scipy.integrate import quad
from scipy.optimize import approx_fprime, minimize

import calib
from calib.checking.check import check
from calib.data import Table, table_from_arrays, write_table
from calib.errors import CalibError
from calib.inference.condition_errors import Readings
from calib.inference.io import load_calibration, save_calibration
from calib.inference.joint import build_joint
from calib.inference.likelihood import Noise, noise_of
from calib.inference.prior_files import DeclaredPriors
from calib.inference.problem import Problem, build_problem
from calib.inference.sampler import SamplerSettings
from calib.validation.comparison import noise_preference
from calib.validation.validate import leave_one_out, validate_held_out
from tests.conftest import SEED
from tests.custom_problems import normal, problem_of

# The noise is as large as what the errors do: a smaller one would bound the slope by the scatter.
SLOPE, NOISE, SPREAD = 4.0, 0.2, 0.1


def line(intercept, slope, slip):
    return intercept + slope * slip


def line_problem(slip, pull, sd: float = 0.0, *, set_point: bool = False) -> Problem:
    """A line with vague priors; one sd of all slips."""
    wide = [normal("a", 0.0, 100.0), normal("b", 0.0, 100.0), normal("sigma", -1.5, 1.0, log=True)]
    return with_error(problem_of(line, wide, slip, pull), sd, set_point=set_point)


def with_error(problem: Problem, sd: float, *, set_point: bool = False) -> Problem:
    points = ("slip",) if set_point and sd else ()
    stated = (("slip_ratio", sd),) if sd else ()
    noise = Noise(stated=stated, set_points=points)
    return replace(problem, noise=noise_of(noise, problem.bound.model, problem.table, "mine.toml"))


def drawn(rng, n: int, sd: float, *, set_point: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Slips as recorded, and pulls."""
    slip = 0.35 + SPREAD * rng.standard_normal(n)
    off = sd * rng.standard_normal(n)
    true, recorded = (slip + off, slip) if set_point else (slip, slip + off)
    return recorded, 1.0 + SLOPE * true + NOISE * rng.standard_normal(n)


def slope_of(problem: Problem) -> tuple[float, float]:
    """Slope at the mode, and its sd by the curvature there."""
    start = np.polyfit(problem.table["slip_ratio"], problem.response, 1)
    best = np.array([start[1], start[0], -2.0])

    def cost(t):
        return -float(problem.log_prob(t[None])[0])

    best = minimize(cost, best, method="Nelder-Mead", options={"xatol": 1e-6, "fatol": 1e-8}).x
    hessian = approx_fprime(best, lambda t: approx_fprime(t, cost, 1e-4), 1e-4)
    return float(best[1]), float(np.sqrt(np.linalg.inv(0.5 * (hessian + hessian.T))[1, 1]))


# The classic examples, many times over


TIMES = 60


def coverage(sd: float, declared: float, *, set_point: bool):
    """Mean slope, its sd over campaigns, the sd that is stated, and how often 90 % cover it."""
    rng, found = np.random.default_rng(7), []
    for _ in range(TIMES):
        slip, pull = drawn(rng, 40, sd, set_point=set_point)
        found.append(slope_of(line_problem(slip, pull, declared, set_point=set_point)))
    slope, stated = np.array(found).T
    covered = np.abs(slope - SLOPE) < stats.norm.ppf(0.95) * stated
    return slope.mean(), slope.std(), stated.mean(), int(covered.sum())


def test_a_slope_is_attenuated_by_the_reliability_unless_the_error_is_stated() -> None:
    sd = 0.5 * SPREAD  # a reliability of 0.8
    naive, scatter, _, hits = coverage(sd, 0.0, set_point=False)
    assert naive == pytest.approx(0.8 * SLOPE, abs=4.0 * scatter / np.sqrt(TIMES))
    low, high = stats.binom(TIMES, 0.9).ppf([1e-3, 1.0 - 1e-3])
    assert hits < low
    slope, scatter, stated, hits = coverage(sd, sd, set_point=False)
    # The estimate has a bias of the order of 1/n of its own: a tenth of its scatter.
    assert slope == pytest.approx(SLOPE, abs=0.1 * scatter + 4.0 * scatter / np.sqrt(TIMES))
    assert stated == pytest.approx(scatter, rel=0.2)
    assert low <= hits <= high


def test_of_set_points_the_slope_is_right_and_the_noise_is_wider() -> None:
    sd = 0.5 * SPREAD
    slope, scatter, stated, hits = coverage(sd, sd, set_point=True)
    assert slope == pytest.approx(SLOPE, abs=4.0 * scatter / np.sqrt(TIMES))
    assert stated == pytest.approx(scatter, rel=0.2)
    low, high = stats.binom(TIMES, 0.9).ppf([1e-3, 1.0 - 1e-3])
    assert low <= hits <= high
    slip, pull = drawn(np.random.default_rng(2), 400, sd, set_point=True)
    problem = line_problem(slip, pull, sd, set_point=True)
    true = np.array([[1.0, SLOPE, np.log(NOISE)]])
    np.testing.assert_allclose(problem.scale(problem.theta(true)), np.hypot(NOISE, SLOPE * sd))


# Densities


def test_it_is_the_likelihood_of_the_bivariate_normal() -> None:
    """Of the readings and pulls together, m and t^2 by the readings: slopes agree within 2 %.

    Fuller (1987), section 1.3: with x = u + e and y = a + b u + q, and var(e) known, the maximum
    likelihood has b = m_xy / (m_xx - s^2), with the variance of (1.3.12).
    """
    sd, n = 0.5 * SPREAD, 400
    slip, pull = drawn(np.random.default_rng(3), n, sd)
    (m_xx, m_xy), (_, m_yy) = np.cov(slip, pull)
    true = m_xx - sd**2
    b = m_xy / true
    s_vv = (n - 1) / (n - 2) * (m_yy - 2.0 * b * m_xy + b * b * m_xx)
    s_uv = -b * sd**2
    variance = (m_xx * s_vv + s_uv**2) / ((n - 1) * true**2)
    slope, stated = slope_of(line_problem(slip, pull, sd))
    assert slope == pytest.approx(b, rel=0.02)
    assert stated == pytest.approx(np.sqrt(variance), rel=0.05)


@pytest.mark.parametrize("set_point", [False, True])
def test_rows_of_a_curve_are_as_by_quadrature_over_their_true_slips(set_point: bool) -> None:
    """Off by a twentieth of what neglect costs; half the error is off by less than a quarter."""

    def curve(peak, slip):
        return peak * np.tanh(slip / 0.15)

    def joint(u, m, s, y):
        return stats.norm.pdf(u, m, s) * stats.norm.pdf(y, curve(1.5, u), noise)

    rng, noise = np.random.default_rng(4), 0.05
    slip = np.linspace(0.02, 0.6, 30)
    pull = curve(1.5, slip) + noise * rng.standard_normal(30)
    priors = [normal("peak", 1.5, 0.3), normal("sigma", -3.0, 1.0, log=True)]
    t, plain = np.array([[1.5, np.log(noise)]]), problem_of(curve, priors, slip, pull)
    off = []
    for sd in (0.005, 0.01):
        kept = 1.0 if set_point else 1.0 - sd**2 / slip.var(ddof=1)
        means, s = slip.mean() + kept * (slip - slip.mean()), sd * np.sqrt(kept)
        expected = [
            np.log(quad(joint, m - 8.0 * s, m + 8.0 * s, (m, s, y), epsabs=1e-10)[0])
            for m, y in zip(means, pull, strict=True)
        ]
        found, neglected = (
            np.sqrt(np.mean((p.log_likelihood_rows(t)[0] - expected) ** 2))
            for p in (with_error(plain, sd, set_point=set_point), plain)
        )
        assert found < 0.05 * neglected
        off.append(found)
    assert off[0] < 0.25 * off[1]


def test_densities_and_draws_are_those_of_the_dense_covariance() -> None:
    sd = 0.5 * SPREAD
    slip, pull = drawn(np.random.default_rng(5), 12, sd)
    problem = line_problem(slip, pull, sd)
    t = np.array([[1.0, 4.0, -3.0], [0.8, 3.0, -2.0]])
    natural = problem.theta(t)
    readings = problem.readings
    assert readings is not None
    mean, added, curves = readings.moments(natural[:, :2])
    whole, left_out = problem.log_likelihood(t), problem.log_likelihood_left_out(t)
    for k in range(2):
        dense = np.diag(natural[k, -1] ** 2 + added[k]) + curves[k] @ curves[k].T
        joint = stats.multivariate_normal(mean[k], dense)
        assert whole[k] == pytest.approx(joint.logpdf(pull), rel=1e-9)
        for i in range(12):
            rest = np.arange(12) != i
            others = stats.multivariate_normal(mean[k, rest], dense[np.ix_(rest, rest)])
            given = joint.logpdf(pull) - others.logpdf(pull[rest])
            assert left_out[k, i] == pytest.approx(given, rel=1e-6, abs=1e-6)
    many = np.tile(natural[:1], (20_000, 1))
    noise = problem.draw_noise(many, np.random.default_rng(6))
    dense = np.diag(natural[0, -1] ** 2 + added[0]) + curves[0] @ curves[0].T
    np.testing.assert_allclose(np.cov(noise.T), dense, atol=0.05 * dense.max())


def test_a_small_error_is_none() -> None:
    slip, pull = drawn(np.random.default_rng(8), 30, 0.0)
    t = np.array([[1.0, 4.0, -3.0]])
    plain, small = line_problem(slip, pull), line_problem(slip, pull, 1e-7)
    assert small.log_likelihood(t)[0] == pytest.approx(plain.log_likelihood(t)[0], abs=1e-6)
    assert small.squares(t[:, :2]) == pytest.approx(plain.squares(t[:, :2]), rel=1e-5)


# Files, runs and validation

PULLS = calib.load_he2019("drawbar_pull")


def pulls(**more) -> Table:
    """Slips read with an error of 1.5 %, at three pressures that were set."""
    rng = np.random.default_rng(9)
    columns = {name: PULLS[name] for name in PULLS}
    slip = 100.0 * columns.pop("slip_ratio") + 1.5 * rng.standard_normal(len(PULLS))
    return table_from_arrays({"slip_percent": slip, **columns, **more}, source="pulls.csv")


def build(likelihood: str, table: Table | None = None, model: str = "magic_formula_pressure"):
    text = f'model = "{model}"\n[likelihood]\n{likelihood}\n'
    return build_problem(model, table or pulls(), DeclaredPriors("mine.toml", text))


def test_a_number_and_a_column_say_the_same() -> None:
    column = pulls(slip_percent_sd=np.full(len(PULLS), 1.5))
    told = [
        build("errors = {slip_percent = 1.5}"),
        build('errors = {slip_ratio = "slip_percent_sd"}', column),
        build_problem("magic_formula_pressure", column),
    ]
    t = told[0].priors.sample(np.random.default_rng(1), 5)
    values = [problem.log_likelihood(t) for problem in told]
    assert np.isfinite(values[0]).any()
    np.testing.assert_allclose(values[1:], [values[0]] * 2)
    assert "slip was read with an error of 1.5 percent (sd)" in told[0].notes[-1]
    assert "write errors = {} under [likelihood]" in told[2].notes[-1]
    left_out = build("errors = {}", column)
    assert left_out.noise.iid_normal
    kappa = table_from_arrays({
        "slip_kappa_ratio": column["slip_ratio"] / (1.0 - column["slip_ratio"]),
        **{n: v for n, v in column.columns.items() if n != "slip_ratio"},
    })  # fmt: skip
    of_kappa = build("errors = {slip_kappa_ratio = 0.02}", kappa).noise.errors[0]
    np.testing.assert_allclose(of_kappa.sds(kappa), 0.02 * (1.0 - kappa["slip_ratio"]) ** 2)


def test_several_conditions_and_uneven_noise() -> None:
    problem = build(
        'noise_depends_on = "slip"\nerrors = {slip_percent = 1.5, inflation_pressure_psi = 1.0}\n'
        'set_points = ["inflation_pressure"]'
    )
    assert [e.kind for e in problem.noise.errors] == ["reading", "set point"]
    natural = problem.theta(problem.priors.sample(np.random.default_rng(2), 400))
    theta, width = problem.of_model(natural), {"slip_ratio": 0.015, "inflation_pressure_psi": 1.0}
    assert isinstance(problem.readings, Readings)
    _, added, curves = problem.readings.moments(theta)
    good = np.isfinite(added).all(axis=1)
    expected = np.zeros_like(added)
    for name, sd in width.items():
        at, step = dict(problem.conditions), 1e-4 * sd
        ends = [
            problem.bound.mean_response(theta, {**at, name: at[name] + sign * step})
            for sign in (-1.0, 1.0)
        ]
        expected += ((ends[1] - ends[0]) / (2.0 * step) * sd) ** 2
    ratio = np.sqrt(added[good] / expected[good])
    assert np.quantile(np.abs(ratio - 1.0), 0.5) < 0.05
    assert curves.shape[2] == 2
    scale = problem.noise.scale(natural, problem.conditions)
    np.testing.assert_allclose(problem.scale(natural)[good], np.hypot(scale, np.sqrt(added))[good])


@pytest.mark.parametrize(
    ("likelihood", "words"),
    [
        ("errors = {slip_percent = -1}", "greater than"),
        ("errors = {slip = 1.5}", "does not say the unit"),
        ("errors = {speed_m_s = 0.1}", "no condition of the model"),
        ("errors = {slip_percent = 1, slip_ratio = 0.01}", "or has one"),
        ('errors = {slip_percent = "slip_sd"}', "no error of the slip is stated"),
        ("errors = {slip_percent = 40}", "hardly more than their error of 40 percent"),
        ("errors = {inflation_pressure_psi = 0.5}", 'set_points = ["inflation_pressure"]'),
        ('set_points = ["slip"]', "no error of it is stated"),
        ('family = "student_t"\nerrors = {slip_percent = 1}', "Student-t noise"),
        ('correlated_along = "run_order"\nerrors = {slip_percent = 1}', "along a run"),
        (
            'errors = {inflation_pressure_psi = 20}\nset_points = ["inflation_pressure_psi"]',
            "not larger than its error",
        ),
    ],
)
def test_what_cannot_be_allowed_for_is_refused(likelihood: str, words: str) -> None:
    with pytest.raises(CalibError) as caught:
        build(likelihood, pulls(run_order=np.arange(len(PULLS))))
    assert words in str(caught.value)


def test_an_error_of_a_row_that_is_no_number_is_named_by_line(tmp_path: Path) -> None:
    cells = ["1.5"] * len(PULLS)
    cells[3] = "?"
    write_table(tmp_path / "pulls.csv", {**pulls().columns, "slip_percent_sd": cells})
    with pytest.raises(CalibError, match="no error of the slip") as caught:
        build_problem("magic_formula_pressure", tmp_path / "pulls.csv")
    assert "line 5, column 'slip_percent_sd'" in str(caught.value)
    with pytest.raises(CalibError, match="no errors of conditions"):
        build_joint({"magic_formula_pressure": pulls(slip_percent_sd=np.ones(len(PULLS)))})


def noisy_line_run(seed: int, n: int = 60) -> tuple[Problem, Table]:
    """Half of the rows to fit, half held out, both with readings that are off."""
    slip, pull = drawn(np.random.default_rng(seed), 2 * n, 0.5 * SPREAD)
    problem = line_problem(slip[:n], pull[:n], 0.5 * SPREAD)
    return problem, table_from_arrays({"slip_ratio": slip[n:], "drawbar_pull_kn": pull[n:]})


QUICK = SamplerSettings(max_steps=2500)


def test_held_out_readings_are_covered_and_exact_conditions_have_narrower_bands() -> None:
    problem, held = noisy_line_run(11)
    calibration = calib.calibrate(problem, SEED, settings=QUICK)
    found = validate_held_out(calibration, held)
    low, high = stats.binom(60, 0.9).ppf([1e-3, 1.0 - 1e-3])
    assert low <= found.scores.coverage[0.9].hits <= high
    loo = leave_one_out(calibration, refit=False)
    assert low <= loo.scores.coverage[0.9].hits <= high
    exact = calib.predict(calibration, held).predictive
    reading = np.quantile(found.draws, 0.95, axis=0) - np.quantile(found.draws, 0.05, axis=0)
    assert (exact.upper[0.9] - exact.lower[0.9] < 0.75 * reading).all()
    assert noise_preference(calibration) is None


def test_a_run_is_kept_and_computed_again(tmp_path: Path) -> None:
    ruts = calib.load_he2019("rut_depth")
    sd = np.where(np.arange(len(ruts)) % 2, 0.01, 0.02)
    table = table_from_arrays({**ruts.columns, "slip_ratio_sd": sd}, source="ruts.csv")
    text = 'model = "modified_bekker"\n[likelihood]\nset_points = ["slip"]\n'
    problem = build_problem("modified_bekker", table, DeclaredPriors("mine.toml", text))
    calibration = calib.calibrate(problem, SEED, settings=SamplerSettings(max_steps=2000))
    save_calibration(calibration, tmp_path / "run")
    again = load_calibration(tmp_path / "run")
    assert again.problem.noise == problem.noise
    assert check(tmp_path / "run", quick=True).exit_code == 0
