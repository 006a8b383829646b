"""Climbing in step: the same residuals, derivatives and modes as of each hypothesis by itself."""

from __future__ import annotations

from copy import copy

import numpy as np
import pytest

from calib.gap.ascent import together
from calib.gap.case import Campaigns, campaigns
from calib.gap.fit import Fit, finish, log_joint, truncated_fit
from calib.gap.forward import Forward
from calib.gap.hypotheses import pair, shifts, singles, split_testable, unknowns
from calib.gap.hypothesis import Hypothesis
from calib.gap.noise import Noise
from calib.gap.residuals import Residuals, residuals_of_all
from tests.gap.cases import NOISE, make_case

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
    kinds = (Hypothesis("none"), shifts(data)[0], gauge, lugs, pair(gauge, lugs), free[0], onset)
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


def test_hypotheses_in_step_end_where_each_alone_does(data, problems):
    noise = {o: Noise(s) for o, s in SIGMA.items()}

    def fitted(chosen: list[Residuals]) -> list[Fit]:
        starts = [drawn(p, 8) for p in chosen]
        truncated = together(
            [
                truncated_fit(data, p.forward, s[0], noise, starts=s[1:], count=3)
                for p, s in zip(chosen, starts, strict=True)
            ]
        )
        return together([finish(group) for group in truncated])

    for problem, found in zip(problems, fitted(problems), strict=True):
        (alone,) = fitted([problem])
        assert found.forward.hypothesis is problem.forward.hypothesis
        # Both stop when a step gains less than a thousandth of a nat.
        assert found.log_evidence == pytest.approx(alone.log_evidence, abs=0.01)


def test_the_log_density_is_the_same_in_parts(data, problems):
    noise = {o: Noise(s) for o, s in SIGMA.items()}
    problem = problems[0]
    (truncated,) = together([truncated_fit(data, problem.forward, drawn(problem, 1)[0], noise)])
    psi = drawn(problem, 2500)
    whole = log_joint(truncated[0], psi)
    some = np.array([0, 1023, 1024, 2047, 2048, 2499])
    np.testing.assert_allclose(log_joint(truncated[0], psi[some]), whole[some], rtol=1e-9)


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
        noises = other.update_noises(raw, scaled, hessian)
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
