"""Climbing in step: the same residuals, derivatives and modes as of each hypothesis by itself."""

from __future__ import annotations

from copy import copy

import numpy as np
import pytest

import calib.gap.gauss_newton as module
from calib.gap.campaigns import Campaigns, campaigns
from calib.gap.fit import Fit, Start, finished, truncated_fits
from calib.gap.forward import Forward
from calib.gap.gauss_newton import (
    Ascent,
    Residuals,
    Slope,
    Stack,
    _change,
    _directions,
    _step,
    climb,
    residuals_of_all,
    slopes,
    stacked,
    together,
)
from calib.gap.hypotheses import Hypothesis, joined, shifts, singles, split_testable, unknowns
from calib.gap.noise import Noise
from tests.gap.cases import NOISE, make_case
from tests.gap.fits import straight_line

SIGMA = {o: NOISE[o] for o in ("drawbar_pull", "rut_depth")}


@pytest.fixture(scope="module")
def data() -> Campaigns:
    return campaigns(make_case("force_offset", size={"offset": 0.12}))


@pytest.fixture(scope="module")
def problems(data) -> list[Residuals]:
    """One of every kind: none, shift, effects on conditions and outputs, free discrepancies."""
    effects = {h.name: h for h in singles(data, split_testable(data)[0])}
    free = unknowns(data)
    onset = next(h for h in free if h.onset_over is not None)
    gauge, lugs = effects["pressure_gauge_bias"], effects["lug_thrust"]
    alone, together = shifts(data)[:2]
    assert alone.shift_as != together.shift_as
    kinds = (
        Hypothesis("none"), alone, gauge, lugs, joined(gauge, lugs), free[0], onset, together,
    )  # fmt: skip
    mode = {o.name: np.array([p.loc for p in o.priors.free]) for o in data.outputs}
    return [Residuals(data, Forward(data, h, SIGMA, mode)) for h in kinds]


def drawn(problem: Residuals, size: int) -> np.ndarray:
    """Points about the middle of the priors."""
    rng = np.random.default_rng(7)
    middle = problem.clip(np.array([p.loc for p in problem.forward.priors.free]))
    middle = np.where(np.isfinite(middle), middle, 0.0)
    steps = 0.1 * problem.width * rng.standard_normal((size, middle.size))
    return problem.clip(middle + steps)


def test_all_at_once_have_the_residuals_of_each_alone(problems):
    # More points than are evaluated at once, so that there are several batches.
    asked = [(p, drawn(p, 400)) for p in problems]
    found = residuals_of_all(asked)
    assert len(found) == len(problems)
    for (problem, psi), raw in zip(asked, found, strict=True):
        alone = problem.raw(psi)
        assert np.isfinite(alone).mean() > 0.9
        np.testing.assert_allclose(raw, alone, rtol=1e-9, atol=1e-12)


def test_each_effect_is_asked_once_for_all_hypotheses_that_have_it(data):
    """Whatever conditions those before it have changed in some of them and in others not."""
    one = singles(data, split_testable(data)[0])
    both = [joined(a, b) for i, a in enumerate(one) for b in one[i + 1 :]]
    asked = []
    for h in (*one, *both):
        problem = Residuals(data, Forward(data, h, SIGMA))
        asked.append((problem, drawn(problem, 2)))
    for (problem, psi), raw in zip(asked, residuals_of_all(asked), strict=True):
        np.testing.assert_allclose(raw, problem.raw(psi), rtol=1e-9, atol=1e-12)


def test_derivatives_are_those_of_central_differences(problems):
    for problem in problems:
        psi = drawn(problem, 3)
        raw = problem.raw(psi)
        found = problem.jacobian(psi, raw, problem.raw(problem.around(psi)))
        d = psi.shape[1]
        assert found.shape == (3, d, raw.shape[1])
        for i in range(d):
            step = np.zeros(d)
            step[i] = 1e-5 * problem.width[i]
            exact = (problem.raw(psi + step) - problem.raw(psi - step)) / (2.0 * step[i])
            # One-sided differences are off by their step times the second derivative.
            scale = np.abs(exact).max() + 1e-3 / problem.width[i]
            np.testing.assert_allclose(found[:, i], exact, atol=5e-3 * scale)


def test_hypotheses_in_step_end_where_each_alone_does(problems):
    noise = {o: Noise(s) for o, s in SIGMA.items()}

    def fitted(chosen: list[Residuals]) -> list[Fit]:
        starts = [drawn(p, 8) for p in chosen]
        begun = [Start(p.forward, s, noise, 3) for p, s in zip(chosen, starts, strict=True)]
        return finished(truncated_fits(begun))

    for problem, found in zip(problems, fitted(problems), strict=True):
        (alone,) = fitted([problem])
        assert found.forward.hypothesis is problem.forward.hypothesis
        # Both stop within a hundredth of a nat of the mode.
        assert found.log_evidence == pytest.approx(alone.log_evidence, abs=0.01)


def test_noise_does_not_depend_on_the_unit_of_a_parameter(problems):
    """A parameter in a unit a thousand times smaller: its prior is as much wider."""
    problem = problems[0]
    psi = drawn(problem, 2)
    raw = problem.raw(psi)
    around = problem.raw(problem.around(psi))
    sds = problem.sds({o: Noise(s) for o, s in SIGMA.items()})
    found = []
    for unit in (1.0, 1e-3, 1e3):
        other = copy(problem)
        other.width = problem.width / unit
        scaled = unit * problem.jacobian(psi, raw, around) / sds
        hessian = scaled @ scaled.swapaxes(1, 2) + np.diag(other.width**-2.0)
        slope = Slope(sds, scaled, psi, hessian, 1e-6 / other.width**2)
        noises = other.update_noises(raw, slope.left)
        found.append([noise.sigma for each in noises for noise in each.values()])
    np.testing.assert_allclose(found[1], found[0], rtol=1e-6)
    np.testing.assert_allclose(found[2], found[0], rtol=1e-6)


def test_derivatives_are_taken_within_a_small_part_of_a_prior(problems):
    """Not beyond a bound either: beside the upper one they are taken backwards."""
    for problem in problems:
        psi = drawn(problem, 2)
        d = psi.shape[1]
        steps = problem.around(psi).reshape(2, d, d) - psi[:, None]
        off = steps[:, ~np.eye(d, dtype=bool)]
        np.testing.assert_array_equal(off, 0.0)
        sizes = np.abs(np.diagonal(steps, axis1=1, axis2=2)) / problem.width
        np.testing.assert_allclose(sizes, 1e-4, rtol=1e-3)
        top = np.where(np.isfinite(problem.upper), problem.upper, psi[:1])
        assert (problem.around(top) <= problem.upper).all()


NOISES = {o: Noise(s, 1.0, 0.0) for o, s in SIGMA.items()}


def ascents_of(problem: Residuals, size: int) -> list[Ascent]:
    psi = drawn(problem, size)
    return [Ascent(problem, p, r, NOISES, 5) for p, r in zip(psi, problem.raw(psi), strict=True)]


def sloped(stack: Stack) -> Slope:
    """Slopes where ascents stand, by derivatives there."""
    (jacobian,) = together([stack.derivatives()])
    return slopes(stack, jacobian)


def test_slopes_are_those_of_the_cost(problems):
    """The gradient by differences of the cost; the Hessian of the residuals' derivatives."""
    for problem in problems:
        ascents = ascents_of(problem, 2)
        slope = sloped(Stack(ascents))
        sds = problem.sds(NOISES)
        np.testing.assert_array_equal(slope.sds, [sds, sds])
        for i, ascent in enumerate(ascents):
            d = ascent.psi.size
            step = 1e-5 * problem.width * np.eye(d)
            there = np.stack([ascent.psi + step, ascent.psi - step])
            up, down = (problem.costs(p, problem.raw(p), sds) for p in there)
            gradient = (up - down) / (2e-5 * problem.width)
            scale = np.abs(gradient * problem.width).max()
            np.testing.assert_allclose(
                slope.gradient[i] * problem.width, gradient * problem.width, atol=0.02 * scale
            )
            scaled = problem.jacobian(
                ascent.psi[None], ascent.raw[None], problem.raw(problem.around(ascent.psi[None]))
            )[0] / sds  # fmt: skip
            hessian = scaled @ scaled.T + np.diag(problem.precision**2)
            # Those of a discrepancy are exact, differences to eight digits.
            np.testing.assert_allclose(slope.scaled[i], scaled, rtol=1e-6, atol=1e-6)
            np.testing.assert_allclose(slope.hessian[i], hessian, rtol=1e-6, atol=1e-6)


def test_the_normal_about_a_mode_has_the_curvature_there(problems):
    """Though it may be taken from where the last step began, a hundredth of a nat away."""
    noise = {o: Noise(s) for o, s in SIGMA.items()}
    for problem in problems:
        start = Start(problem.forward, drawn(problem, 8), noise, 3)
        (found,) = finished(truncated_fits([start]))
        there = problem.raw(found.psi[None])
        slope = sloped(Stack([Ascent(problem, found.psi, there[0], dict(found.noise), 1)]))
        flat = np.where(problem.precision > 0, 0.0, problem.width**-2.0) * 1e-6
        sd = np.sqrt(np.diag(np.linalg.inv(slope.hessian[0] + np.diag(flat))))
        sd = np.minimum(sd, 0.5 * (problem.upper - problem.lower))
        np.testing.assert_allclose(np.sqrt(np.diag(found.covariance)), sd, rtol=0.05)


def test_damped_steps_solve_marquardts_equations_and_leave_a_blocked_coordinate(problems):
    problem = problems[0]
    (ascent,) = ascents_of(problem, 1)
    bounded = int(np.flatnonzero(np.isfinite(problem.lower))[0])
    dampings = np.array([[1e-3, 0.1, 10.0]])
    slope = sloped(Stack([ascent]))
    for sign in (1.0, -1.0):
        slope.gradient[0, bounded] = sign * abs(slope.gradient[0, bounded])
        psi = ascent.psi.copy()
        psi[bounded] = problem.lower[bounded]
        found = _directions(problem, psi[None], slope, dampings)[0]
        free = np.ones(psi.size, dtype=bool)
        free[bounded] = sign < 0.0  # downhill is then away from the bound
        hessian, gradient = slope.hessian[0][np.ix_(free, free)], slope.gradient[0, free]
        diagonal = (np.diag(slope.hessian[0]) + 1e-2 / problem.width**2)[free]
        for step, damping in zip(found, dampings[0], strict=True):
            expected = -np.linalg.solve(hessian + damping * np.diag(diagonal), gradient)
            np.testing.assert_allclose(step[free], expected, rtol=1e-6, atol=1e-12)
            np.testing.assert_array_equal(step[~free], 0.0)


def test_of_several_dampings_the_step_that_gains_most_is_taken(problems):
    """A tenth, ten and a thousand times the last good one; worked out again one by one."""
    problem = problems[0]
    ascents = ascents_of(problem, 3)
    before = [(a.psi, a.raw) for a in ascents]
    for ascent, damping in zip(ascents, (1e-3, 1.0, 1e-9), strict=True):
        ascent.damping = damping
    dampings = np.array([[a.damping] for a in ascents]) * [[0.1, 10.0, 1e3]]
    slope = sloped(Stack(ascents))
    (gains,) = together([_step(Stack(ascents), slope)])
    sds = problem.sds(NOISES)
    for i, (psi, raw) in enumerate(before):
        steps = _directions(problem, *(psi[None],), _only(slope, i), dampings[i : i + 1])[0]
        tried = problem.clip(psi + steps)
        costs = problem.costs(tried, problem.raw(tried), sds)
        best = int(np.nanargmin(costs))
        assert gains[i] == pytest.approx(problem.costs(psi, raw, sds) - costs[best], rel=1e-6)
        assert gains[i] > 0.0
        np.testing.assert_allclose(ascents[i].psi, tried[best])
        np.testing.assert_allclose(ascents[i].raw, problem.raw(tried[best : best + 1])[0])
        assert ascents[i].damping == pytest.approx(max(dampings[i, best], 1e-9), rel=1e-6)


def test_ascents_of_other_hypotheses_change_no_slope_and_no_step(problems):
    """In arrays as wide as that of the most coordinates; those of one hypothesis side by side."""
    ascents = [a for problem in problems for a in ascents_of(problem, 2)]
    mixed = [*ascents[::2], *ascents[1::2]]
    (stack,) = stacked(mixed)
    group = stack.ascents
    sizes = [a.psi.size for a in group]
    assert sizes == sorted(sizes)
    assert set(group) == set(ascents)
    slope = sloped(stack)
    before = [copy(a) for a in group]
    (gains,) = together([_step(stack, slope)])
    for i, ascent in enumerate(before):
        d = ascent.psi.size
        alone = Stack([ascent])
        own = sloped(alone)
        np.testing.assert_allclose(slope.gradient[i, :d], own.gradient[0], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(slope.hessian[i, :d, :d], own.hessian[0], rtol=1e-9, atol=1e-9)
        np.testing.assert_array_equal(slope.gradient[i, d:], 0.0)
        (gain,) = together([_step(alone, own)])
        assert gains[i] == pytest.approx(gain[0], rel=1e-6)
        np.testing.assert_allclose(group[i].psi, ascent.psi, rtol=1e-6, atol=1e-9)


def _only(slope, i: int):
    return type(slope)(*(getattr(slope, n)[i : i + 1] for n in vars(slope)))


def test_where_no_step_gains_the_next_are_shorter(problems):
    """At a mode, uphill: the ascent stays, and begins with ten times the largest damping."""
    problem = problems[0]
    (ascent,) = ascents_of(problem, 1)
    slope = sloped(Stack([ascent]))
    slope.gradient[:] *= -1.0
    was = ascent.psi.copy()
    for expected in (1e-3 * 1e4, 1e5, 1e6, 1e6):
        (gains,) = together([_step(Stack([ascent]), slope)])
        assert gains == [0.0]
        np.testing.assert_array_equal(ascent.psi, was)
        assert ascent.damping == pytest.approx(expected)


def test_a_noise_has_changed_by_its_logarithm_and_by_how_it_grows():
    old = {"a": Noise(0.1, 1.0, 0.8), "b": Noise(0.2, 0.0, 0.0)}
    new = {"a": Noise(0.05, 2.5, -0.8), "b": Noise(0.2, 0.0, 0.0)}
    assert _change(old, new) == pytest.approx(np.log(2.0) + 1.5 + 1.6)
    assert _change(new, old) == pytest.approx(np.log(2.0) + 1.5 + 1.6)
    assert _change(old, {**old, "b": Noise(0.3, 0.0, 0.8)}) == pytest.approx(np.log(1.5) + 0.8)
    assert _change(old, old) == 0.0


def test_what_is_left_to_gain_is_the_costs_height_above_its_mode(problems):
    """Where the cost is a parabola; fits end where next to nothing is left."""
    noise = {o: Noise(s) for o, s in SIGMA.items()}
    for problem in problems:
        (found,) = finished(truncated_fits([Start(problem.forward, drawn(problem, 8), noise, 3)]))
        raw = problem.raw(found.psi[None])
        ascent = Ascent(problem, found.psi, raw[0], dict(found.noise), 9)
        stack = Stack([ascent])
        assert module._left_to_gain(stack, sloped(stack))[0] < 2e-2
    line = straight_line(1)
    problem = Residuals(line, Forward(line, Hypothesis("none"), SIGMA))
    sds = problem.sds(NOISES)
    psi = np.array([[0.1, 0.4], [0.5, -0.7]])
    raw = problem.raw(psi)
    stack = Stack([Ascent(problem, p, r, NOISES, 9) for p, r in zip(psi, raw, strict=True)])
    slope = sloped(stack)
    mode = psi - np.linalg.solve(slope.hessian, slope.gradient[..., None])[..., 0]
    above = problem.costs(psi, raw, sds) - problem.costs(mode, problem.raw(mode), sds)
    assert above.min() > 1.0
    np.testing.assert_allclose(module._left_to_gain(stack, slope), above, rtol=1e-5)


def test_a_climb_ends_with_a_step_from_beside_a_mode(problems, monkeypatch):
    """Where a hundredth of a nat is left to gain at most, and the noise moves less than 1 %."""
    problem = problems[0]
    start = ascents_of(problem, 1)[0]
    calm, moved = dict(NOISES), {o: Noise(1.02 * s, 1.0, 0.0) for o, s in SIGMA.items()}

    def steps_of(left, noise=calm, steps=9, gained=1.0) -> int:
        taken = []

        def step(stack, slope):
            taken.append(len(stack.ascents))
            return [gained]
            yield

        monkeypatch.setattr(module, "_step", step)
        monkeypatch.setattr(module, "_left_to_gain", lambda *_: np.array([left[len(taken)]]))
        monkeypatch.setattr(Stack, "update_noises", lambda *_: [noise])
        ascent = copy(start)
        ascent.noise, ascent.steps = dict(NOISES), steps
        climb([ascent])
        return len(taken)

    assert steps_of([0.9e-2]) == 1
    assert steps_of([1.0, 0.9e-2]) == 2
    assert steps_of([1.1e-2, 1.0, 0.5, 0.9e-3]) == 4
    # Where steps gain next to nothing, as at a kink, two of them are enough.
    assert steps_of([1.0] * 9, gained=0.9e-3) == 2
    assert steps_of([1.0] * 9, gained=1.1e-3) == 9
    # The noise that moved has settled by the step after.
    assert steps_of([0.9e-3] * 9, noise=moved) == 2
    # Of so few steps all are taken.
    assert steps_of([0.9e-3] * 3, steps=3) == 3


def test_those_that_have_ended_leave_the_others_their_steps(problems):
    """Of other hypotheses with fewer coordinates too."""
    ascents = [ascents_of(p, 1)[0] for p in problems]
    for ascent in ascents:
        ascent.steps = 40
    climb(ascents)
    before = [ascent.psi for ascent in ascents]
    more = [Ascent(a.problem, a.psi, a.raw, a.noise, 40) for a in ascents[1:]]
    fresh = ascents_of(problems[0], 1)[0]
    fresh.steps = 40
    climb([fresh, *more])
    sd = 1.0 / np.sqrt(np.diag(sloped(Stack([fresh])).hessian[0]))
    np.testing.assert_allclose((fresh.psi - before[0]) / sd, 0.0, atol=0.3)
    for ascent, psi in zip(more, before[1:], strict=True):
        assert ascent.psi.shape == psi.shape
        assert ascent.jacobian is not None
        assert ascent.jacobian.shape[0] == psi.size
