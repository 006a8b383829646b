"""Posteriors of several modes whose weights are known by a sum over one parameter.

The first parameter enters by a polynomial whose roots are the modes, of unequal widths; each of the
others by its distance from a parabola of the first, so that modes are bent in more dimensions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from calib.inference.diagnostics import ess
from calib.inference.problem import Problem
from calib.inference.sampling.sampler import sample_posterior
from tests.custom_problems import fixed, normal, problem_of
from tests.inference.sampling.closed_form import SIGMAS

SIGMA, BEND, OTHERS_SD = 0.05, 0.3, 3.0
# The roots, and the prior mean of the first parameter, whose prior sd is 1.
CASES = {
    "one in twenty": ((-1.0, 1.0), 1.47),
    "one in twelve": ((-1.0, 1.0), 1.194),
    "one in twenty, far": ((-3.0, 3.0), 0.49),
    "three": ((-2.0, 0.0, 1.2), 0.0),
    "four": ((-2.0, -0.7, 0.6, 2.0), 0.3),
}


@dataclass(frozen=True)
class Known:
    problem: Problem
    edges: np.ndarray
    weights: np.ndarray


def several(case: str, d: int) -> Known:
    roots, mean = CASES[case]
    polynomial = np.poly(roots)
    polynomial /= np.abs(np.polyval(np.polyder(polynomial), roots)).max()
    rows = np.arange(1, d + 1) / 100.0

    def location(*arguments):
        *q, slip = arguments
        row = np.round(100.0 * slip).astype(int) - 1
        value = np.polyval(polynomial, q[0]) + 0.0 * slip
        for j in range(1, d):
            value = np.where(row == j, q[j] + BEND * q[0] ** 2, value)
        return value

    priors = [normal("q0", mean, 1.0), *(normal(f"q{j}", 0.0, OTHERS_SD) for j in range(1, d))]
    problem = problem_of(location, (*priors, fixed("sigma", SIGMA)), rows, np.zeros(d))
    grid = np.linspace(-8.0, 8.0, 1_000_001)
    value = -0.5 * (np.polyval(polynomial, grid) / SIGMA) ** 2 - 0.5 * (grid - mean) ** 2
    value -= 0.5 * (d - 1) * (BEND * grid**2) ** 2 / (OTHERS_SD**2 + SIGMA**2)
    edges = 0.5 * (np.array(roots)[1:] + np.array(roots)[:-1])
    weights = np.bincount(np.searchsorted(edges, grid), np.exp(value - value.max()))
    return Known(problem, edges, weights / weights.sum())


def assert_in_proportion(known: Known, seed: int) -> None:
    draws = sample_posterior(known.problem, seed)
    assert draws.report.passed
    ensembles, walkers, steps, _ = draws.t.shape
    at = np.searchsorted(known.edges, draws.t[..., 0]).reshape(ensembles * walkers, steps)
    for j, weight in enumerate(known.weights):
        inside = (at == j).astype(float)
        # The effective size of this very indicator: walkers change between modes less often than
        # they move within one.
        size = min(float(ess(inside[..., None], "mean")[0]), inside.size)
        assert size > 400.0
        assert abs(inside.mean() - weight) < SIGMAS * np.sqrt(weight * (1.0 - weight) / size)


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("d", [1, 3])
def test_every_mode_has_its_weight(case: str, d: int) -> None:
    assert_in_proportion(several(case, d), seed=1)


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("d", [1, 2, 4, 8])
def test_every_mode_has_its_weight_for_every_seed(case: str, d: int) -> None:
    known = several(case, d)
    for seed in range(200 if d == 1 else 20):
        assert_in_proportion(known, seed)
