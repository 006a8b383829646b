"""Whether an output follows the order of the runs: by least squares of each line and each step."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.gap.ranking import change_over_runs, follows_runs
from tests.gap.cases import campaigns_of, ranking_of


def least_squares(z: np.ndarray, shape: np.ndarray) -> float:
    """Nats gained by a constant and a shape over a constant alone."""
    basis = np.stack([np.ones(z.size), shape], axis=1)
    left = z - basis @ np.linalg.lstsq(basis, z, rcond=None)[0]
    return 0.5 * z.size * float(np.log(np.square(z - z.mean()).sum() / np.square(left).sum()))


@pytest.mark.parametrize("seed", range(5))
def test_it_is_the_best_of_a_line_and_of_every_step(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(6, 40))
    order, z = rng.permutation(n) + 3.0, rng.standard_normal(n)
    z += rng.normal(0.0, 2.0) * (order > rng.uniform(4.0, n)) + rng.normal(0.0, 0.1) * order
    steps = [order > run for run in np.sort(order)[:-1]]
    expected = max(least_squares(z, shape) for shape in (order, *steps))
    assert change_over_runs(z, order) == pytest.approx(expected, rel=1e-9)


def test_a_constant_follows_nothing_and_a_perfect_step_is_finite():
    order = np.arange(10.0)
    assert change_over_runs(np.full(10, 0.3), order) == pytest.approx(0.0, abs=1e-9)
    assert 10.0 < change_over_runs((order > 4.0) * 1.0, order) < np.inf


def test_of_noise_alone_one_in_ten_campaigns_is_looked_at():
    """What is looked at without reason costs time, no more; what is not could not be probable."""
    rng = np.random.default_rng(8)
    gained = [change_over_runs(z, np.arange(30.0)) for z in rng.standard_normal((2000, 30))]
    assert np.mean(np.array(gained) > 4.0) < 0.15


def test_an_output_follows_the_runs_by_what_noise_alone_leaves_of_it():
    data, ranking = campaigns_of("sensor_drift"), ranking_of("sensor_drift")
    (none,) = ranking.fits["none"]
    assert follows_runs(data, none) == {"pull"}
    columns = {k: v for k, v in data.view.conditions.items() if k != "run_order"}
    unordered = replace(data, view=replace(data.view, conditions=columns))
    assert follows_runs(unordered, none) == set()
