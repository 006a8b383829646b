"""Residuals of a hypothesis: bounds, cost, guesses that lie apart, derivatives, noise."""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import numpy as np
import pytest

from calib.gap.campaigns import Simulated, campaigns
from calib.gap.effects import EFFECTS
from calib.gap.forward import Forward
from calib.gap.gauss_newton import Residuals, residuals_of_all, variance_left
from calib.gap.hypotheses import Hypothesis, singles
from calib.gap.noise import Noise, most_probable
from tests.gap.cases import NOISE, campaigns_of, make_case

SIGMA = {o: NOISE[o] for o in ("drawbar_pull", "rut_depth")}


def problem_of(data, hypothesis: Hypothesis) -> Residuals:
    return Residuals(data, Forward(data, hypothesis, SIGMA))


@pytest.fixture(scope="module")
def problem() -> Residuals:
    return problem_of(campaigns_of(None), Hypothesis("none"))


@pytest.fixture(scope="module")
def bounded(problem) -> Residuals:
    """Three coordinates: between bounds, above one, and free; of widths 1, 2 and 4."""
    other = copy(problem)
    other.lower, other.upper = np.array([0.0, 1.0, -np.inf]), np.array([2.0, np.inf, np.inf])
    other.width = np.array([1.0, 2.0, 4.0])
    other.loc, other.precision = np.array([0.0, 3.0, -1.0]), np.array([0.0, 0.5, 0.25])
    return other


def test_a_guess_beyond_a_bound_is_moved_just_inside(bounded):
    found = bounded.clip(np.array([[-1.0, 0.0, -1e9], [3.0, 9.0, 1e9], [1.0, 2.0, 0.0]]))
    expected = [[1e-7, 1.0 + 2e-7, -1e9], [2.0 - 1e-7, 9.0, 1e9], [1.0, 2.0, 0.0]]
    np.testing.assert_allclose(found, expected, rtol=1e-12)


@pytest.mark.parametrize("way", [-1.0, -1e-9, 0.0, 1e-9, 1.0])
def test_a_coordinate_at_a_bound_cannot_go_beyond_it(bounded, way):
    """Within two ten-millionths of a width it is at the bound, as one is that was moved inside."""
    at_lower = np.array([[0.0, 1.0, -5.0], [2e-7, 1.0 + 3.9e-7, 0.0]])
    direction = np.full((2, 3), way)
    np.testing.assert_array_equal(
        bounded.blocked(at_lower, direction), [[way < 0.0, way < 0.0, False]] * 2
    )
    at_upper = np.array([[2.0, 1e9, 1e9], [2.0 - 2e-7, 5.0, 0.0]])
    np.testing.assert_array_equal(
        bounded.blocked(at_upper, direction), [[way > 0.0, False, False]] * 2
    )
    off = np.array([[2.1e-7, 1.0 + 4.2e-7, 0.0], [2.0 - 2.1e-7, 1.5, 0.0]])
    assert not bounded.blocked(off, direction).any()
    assert bounded.blocked(bounded.clip(np.array([[-1.0, 0.0, 0.0]])), -np.ones((1, 3)))[0, 1]


def test_the_cost_is_minus_the_log_of_likelihood_times_prior(bounded):
    rng = np.random.default_rng(1)
    psi, raw, sds = rng.normal(size=(2, 3)), rng.normal(size=(2, 5)), rng.uniform(0.1, 2.0, 5)
    expected = [
        sum(0.5 * (r / s) ** 2 + np.log(s) for r, s in zip(row, sds, strict=True))
        + 0.5 * ((p[1] - 3.0) * 0.5) ** 2
        + 0.5 * ((p[2] + 1.0) * 0.25) ** 2
        for p, row in zip(psi, raw, strict=True)
    ]
    np.testing.assert_allclose(bounded.costs(psi, raw, sds), expected)


def test_the_best_guesses_lie_apart_by_more_than_seven_tenths_of_a_width(bounded):
    at = [[0.0, 0.0, 0.0], [0.7, 1.4, 2.8], [0.0, 1.5, 0.0], [0.8, 0.0, 0.0], [-0.75, 3.0, 0.0],
          [0.0, 0.0, 9.0]]  # fmt: skip
    costs = np.array([1.0, 2.0, 3.0, 4.0, np.nan, 5.0])
    # The second is 0.7 off the first, the third 0.75 of a width of two; one without a value last.
    assert bounded.best(costs, np.array(at), 10) == [0, 2, 3, 5, 4]
    assert bounded.best(costs, np.array(at), 2) == [0, 2]
    assert bounded.best(costs[::-1], np.array(at)[::-1], 1) == [5]
    # Wherever they are.
    there = 64.0 + np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [0.0, 2.0, 0.0]])
    assert bounded.best(np.arange(3.0), there, 10) == [0, 2]


def test_derivatives_are_of_steps_that_stay_inside(bounded):
    psi = np.array([[2.0 - 1e-4, 5.0, 0.0], [2.0 - 0.9e-4, 5.0, 0.0]])
    steps = bounded.around(psi).reshape(2, 3, 3) - psi[:, None]
    # One that just reaches the bound is taken.
    expected = np.stack([np.diag([1e-4, 2e-4, 4e-4]), np.diag([-1e-4, 2e-4, 4e-4])])
    np.testing.assert_allclose(steps, expected, atol=1e-12)
    raw = np.array([[1.0, 2.0], [1.0, np.nan]])
    moved = np.array([[2.0, np.nan], [3.0, 2.0], [1.0, 0.0], [0.0, 2.0], [1.0, 2.0], [1.5, 2.0]])
    found = bounded.jacobian(psi, raw, moved)
    expected = np.array([
        [[1e4, 0.0], [2.0 / 2e-4, 0.0], [0.0, -2.0 / 4e-4]],
        [[1e4, 0.0], [0.0, 0.0], [0.5 / 4e-4, 0.0]],
    ])  # fmt: skip
    np.testing.assert_allclose(found, expected)


def test_noise_is_of_residuals_that_lost_what_the_parameters_took_up(problem):
    """Divided by one minus the leverage, which leaves a tenth of each at least."""
    rng = np.random.default_rng(2)
    n, d = problem.data.observed.size, problem.width.size
    raw, scaled = rng.normal(size=(2, n)), rng.normal(size=(2, d, n))
    hessian = scaled @ scaled.swapaxes(1, 2) + np.diag(problem.width**-2.0)
    # Of one row the parameters know hardly anything but by itself.
    scaled[0, :, 7] *= 300.0
    hessian[0] += np.outer(scaled[0, :, 7], scaled[0, :, 7])
    found = problem.update_noises(raw, variance_left(scaled, np.linalg.inv(hessian)))
    for i in range(2):
        leverage = np.einsum("jn,jk,kn->n", scaled[i], np.linalg.inv(hessian[i]), scaled[i])
        assert (leverage[7] > 0.95) == (i == 0)
        corrected = raw[i] ** 2 / np.clip(1.0 - leverage, 0.1, None)
        for name, part in problem.parts.items():
            (expected,) = most_probable(corrected[None, part], problem.data.at_rows[name])
            assert found[i][name].sigma == pytest.approx(expected.sigma, rel=1e-4)
            assert found[i][name].rho == expected.rho
            assert found[i][name].kappa == expected.kappa


def test_readings_that_are_lacking_have_no_residual():
    """Lab rows, then the field rows that have the output; one output after the other."""
    case = make_case(None)
    pull = np.array(case.field["drawbar_pull_kn"])
    pull[[0, 5, 6]] = np.nan
    field = replace(case.field, columns={**case.field.columns, "drawbar_pull_kn": pull})
    data = campaigns(replace(case, field=field))
    problem = problem_of(data, Hypothesis("none"))
    psi = np.array([[p.loc for p in problem.forward.priors.free]])
    lab, there = problem.forward.lab(psi), problem.forward.field(psi, data.view)
    known = np.setdiff1d(np.arange(27), [0, 5, 6])
    expected = np.concatenate([
        case.lab["drawbar_pull_kn"] - lab["drawbar_pull"][0],
        pull[known] - there["drawbar_pull"][0, known],
        np.log(case.lab["rut_depth_mm"]) - lab["rut_depth"][0],
        np.log(case.field["rut_depth_mm"]) - there["rut_depth"][0],
    ])  # fmt: skip
    np.testing.assert_allclose(problem.raw(psi)[0], expected)
    assert problem.parts == {"drawbar_pull": slice(0, 54), "rut_depth": slice(54, 111)}
    sds = problem.sds({"drawbar_pull": Noise(0.1), "rut_depth": Noise(0.2)})
    np.testing.assert_allclose(sds, np.repeat([0.1, 0.2], [54, 57]))
    # All at once, hypotheses that leave the simulators' parameters alone are asked as one.
    (offset,) = singles(data, {"force_offset": EFFECTS["force_offset"]})
    other = problem_of(data, offset)
    more = np.append(psi, [[0.25]], axis=1)
    both = residuals_of_all([(problem, psi), (other, more)])
    np.testing.assert_allclose(both[0][0], expected)
    gap = np.zeros(111)
    gap[30:54] = 0.25
    np.testing.assert_allclose(both[1][0], expected - gap)


def test_no_more_than_about_a_thousand_vectors_are_predicted_at_once(problem, monkeypatch):
    asked = []
    plain = Forward.plain

    def noted(self, psi):
        asked.append(len(psi))
        return plain(self, psi)

    monkeypatch.setattr(Forward, "plain", noted)
    rng = np.random.default_rng(3)
    middle = np.array([p.loc for p in problem.forward.priors.free])

    def some(n: int) -> np.ndarray:
        return problem.clip(middle + 0.1 * problem.width * rng.standard_normal((n, middle.size)))

    for sizes, expected in (
        ((512, 512), [1024]), ((512, 513), [512, 513]), ((1100, 20, 30), [1100, 50]),
        ((400, 400, 400, 400, 400), [800, 800, 400]),
    ):  # fmt: skip
        asked.clear()
        assert [len(r) for r in residuals_of_all([(problem, some(n)) for n in sizes])] == [*sizes]
        assert asked == expected


def test_a_simulator_is_asked_once_while_its_own_parameters_stay(problem, monkeypatch):
    """As from one guess at an effect to the next, and from one difference to the next."""
    asked = []
    predict = Simulated.predict

    def noted(self, t, misfit, conditions):
        asked.append(len(t))
        return predict(self, t, misfit, conditions)

    monkeypatch.setattr(Simulated, "predict", noted)
    psi = np.array([p.loc for p in problem.forward.priors.free])
    residuals_of_all([(problem, np.tile(psi, (40, 1))), (problem, psi + np.zeros((2, 1)))])
    assert asked == [1, 1]
    asked.clear()
    moved = np.tile(psi, (5, 1))
    moved[1:4, problem.forward.theta_slices["rut_depth"].start] += [0.01, 0.02, 0.03]
    found = problem.raw(moved)
    assert asked == [1, 5]  # pull, then ruts
    for i, row in enumerate(moved):
        np.testing.assert_allclose(problem.raw(row[None])[0], found[i], rtol=1e-12)
