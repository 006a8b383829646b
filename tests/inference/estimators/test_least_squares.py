"""Least squares, differential evolution and what they hold."""

from __future__ import annotations

import numpy as np
import pytest

from calib.errors import CalibError
from calib.inference.estimators import estimate
from calib.inference.problem import build_problem
from calib.inference.search import hold_unidentified
from tests.inference.estimators.conftest import SLIPS, TRUTH

RNG = 11


@pytest.mark.parametrize("model", TRUTH)
def test_recovers_known_parameters(problem_of, model):
    problem, truth = problem_of(model)
    found = estimate(problem, "least_squares", np.random.default_rng(RNG))
    np.testing.assert_allclose(found.theta, truth, rtol=1e-7, atol=1e-9)
    assert found.cost < 1e-20
    assert found.r_squared == pytest.approx(1.0)
    assert found.converged
    assert set(found.reported) == set(problem.bound.model.reported)


@pytest.mark.parametrize("model", ["magic_formula", "ayers_perumpral"])
def test_all_methods_agree_on_noisy_data(problem_of, model):
    problem, _ = problem_of(model, noise=0.02)
    best = estimate(problem, "least_squares", np.random.default_rng(RNG))
    for method in ("genetic", "differential_evolution"):
        found = estimate(problem, method, np.random.default_rng(RNG))
        assert found.cost == pytest.approx(best.cost, rel=2e-3)
        assert found.cost >= best.cost * (1.0 - 1e-12)


def test_goodness_of_fit(problem_of):
    problem, _ = problem_of("modified_bekker", noise=0.05)
    found = estimate(problem, "least_squares", np.random.default_rng(RNG))
    r = problem.response - problem.bound.mean_response(found.theta, problem.conditions)[0]
    sse, n = float(r @ r), r.size
    assert found.cost == pytest.approx(sse)
    assert found.cost_unit == "1"
    assert found.rmse == pytest.approx(np.sqrt(sse / (n - 3)))
    y = problem.response
    assert found.r_squared == pytest.approx(1.0 - sse / np.sum((y - y.mean()) ** 2))
    # The optimum of a sum of squares: residuals orthogonal to every parameter's effect.
    h = 1e-6 * np.diag(found.theta)
    up = problem.bound.mean_response(found.theta + h, problem.conditions)
    down = problem.bound.mean_response(found.theta - h, problem.conditions)
    effect = (up - down) / np.linalg.norm(up - down, axis=1, keepdims=True)
    np.testing.assert_allclose(effect @ r / np.linalg.norm(r), 0.0, atol=1e-6)


@pytest.mark.parametrize(
    ("model", "fixed"),
    [
        ("magic_formula", {"C": 1.55, "Sh": 0.0, "Sv": 0.0}),
        ("magic_formula", {"G": 4.0, "D": 1.6, "Sh": 0.0, "Sv": 0.0, "sigma": 0.1}),
        ("magic_formula_pressure", {"C": 1.55, "K_bend": 0.1}),
        ("ayers_perumpral", {"C2": 0.003}),
    ],
)
@pytest.mark.parametrize("method", ["least_squares", "genetic"])
def test_free_subsets(problem_of, model, fixed, method):
    problem, truth = problem_of(model, fixed=fixed)
    found = estimate(problem, method, np.random.default_rng(RNG))
    np.testing.assert_allclose(found.theta, truth, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("method", ["least_squares", "genetic", "differential_evolution"])
def test_everything_fixed(problem_of, method):
    problem, truth = problem_of("bekker", fixed=TRUTH["bekker"])
    found = estimate(problem, method, np.random.default_rng(RNG))
    np.testing.assert_allclose(found.theta, truth)
    assert "every parameter is fixed" in found.note


def test_bends_are_held_at_two_pressures(problem_of):
    rows = np.r_[0:14, 28:42]
    problem, _ = problem_of("magic_formula_pressure", rows=rows, noise=0.02)
    names = [p.name for p in problem.priors.entries]
    for method in ("least_squares", "genetic"):
        found = estimate(problem, method, np.random.default_rng(RNG))
        assert "do not determine K_bend, D_bend, G_bend: held" in found.note
        for bend in ("K_bend", "D_bend", "G_bend"):
            assert found.theta[names.index(bend)] == problem.priors.entries[names.index(bend)].loc
        # Seven parameters were fitted, not ten.
        assert found.rmse == pytest.approx(np.sqrt(found.cost / (28 - 7)))


def test_nothing_is_held_at_three_pressures(problem_of):
    problem, _ = problem_of("magic_formula_pressure")
    assert hold_unidentified(problem)[1] == ()


def test_imitated_parameters_are_held(problem_of):
    # One ground pressure: the rut shows z_ref and n1/n0, not n0 and n1.
    columns = {"average_ground_pressure_kpa": np.full(9, 120.0),
               "slip_ratio": np.linspace(0.0, 0.2, 9)}  # fmt: skip
    problem, _ = problem_of("modified_bekker", columns=columns)
    _, held = hold_unidentified(problem)
    assert len(held) == 1
    assert held[0] in ("n0", "n1")
    found = estimate(problem, "least_squares", np.random.default_rng(RNG))
    assert found.cost < 1e-20
    assert f"do not determine {held[0]}" in found.note
    # No slip: n1 has no effect at all.
    problem, _ = problem_of(
        "modified_bekker",
        columns={"average_ground_pressure_kpa": np.linspace(80.0, 200.0, 9),
                 "slip_ratio": np.zeros(9)},
    )  # fmt: skip
    assert hold_unidentified(problem)[1] == ("n1",)


def test_many_rows_reach_the_same_optimum(problem_of):
    columns = {"slip_ratio": np.tile(SLIPS, 1500)}
    problem, _ = problem_of("magic_formula", columns=columns, noise=0.05)
    found = estimate(problem, "least_squares", np.random.default_rng(RNG))
    again = estimate(problem, "least_squares", np.random.default_rng(RNG + 1))
    assert len(problem.table) == 21_000
    assert found.cost == pytest.approx(again.cost, rel=1e-10)
    np.testing.assert_allclose(found.theta, again.theta, rtol=1e-5, atol=1e-9)


def test_note_says_when_a_bound_is_reached(problem_of):
    problem, _ = problem_of("magic_formula")
    # A pull that keeps rising has no peak to show: C ends at a bound.
    pull = 0.03 * 100.0 * SLIPS / (1.0 + 0.02 * 100.0 * SLIPS)
    table = problem.table
    columns = {**table.columns, "drawbar_pull_kn": pull}
    rising = build_problem(
        "magic_formula", type(table)(columns, "", table.lines, (), (), ""),
        fixed={"Sh": 0.0, "Sv": 0.0},
    )  # fmt: skip
    found = estimate(rising, "least_squares", np.random.default_rng(RNG))
    assert "C on the edge of the prior's bounds" in found.note


@pytest.mark.parametrize("method", ["least_squares", "genetic", "differential_evolution"])
def test_conditions_without_a_value_are_reported(problem_of, method):
    problem, _ = problem_of("bekker")
    columns = {name: values.copy() for name, values in problem.table.columns.items()}
    columns["average_ground_pressure_kpa"][3] = -1.0
    table = problem.table
    broken = problem.with_table(type(table)(columns, "broken.csv", table.lines, (), (), ""))
    with pytest.raises(CalibError, match="no value") as error:
        estimate(broken, method, np.random.default_rng(RNG))
    if method == "least_squares":
        assert error.value.where == f"broken.csv, lines {table.lines[3]}"
