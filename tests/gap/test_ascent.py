"""Climbing in step: the same residuals, derivatives and modes as of each hypothesis by itself."""

from __future__ import annotations

import numpy as np
import pytest

from calib.gap.campaigns import Campaigns, campaigns
from calib.gap.fit import Fit, Start, finished, truncated_fits
from calib.gap.forward import Forward
from calib.gap.gauss_newton import (
    Residuals,
    residuals_of_all,
)
from calib.gap.hypotheses import Hypothesis, joined, shifts, singles, split_testable, unknowns
from calib.gap.noise import Noise
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
    alone, soil = shifts(data)[:2]
    assert alone.shift_as != soil.shift_as
    kinds = (
        Hypothesis("none"), alone, gauge, lugs, joined(gauge, lugs), free[0], onset, soil,
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
