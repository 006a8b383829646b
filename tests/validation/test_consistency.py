"""Readings are called consistent at the nominal rate, and others are found as often as is said."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice
from unittest.mock import PropertyMock, patch

import numpy as np
import pytest
from scipy.stats import binom

from calib import CalibError, Calibration, consistency
from calib.validation.prediction import predictive_draws

N = 100


def campaigns(calibration: Calibration, *, offset: float = 0.0, scatter: float = 1.0):
    """Yield what is found of campaigns that the reference deems possible, then moved."""
    problem = calibration.problem
    rng = np.random.default_rng(20260101)
    mean, measured = predictive_draws(calibration, problem.conditions, rng)
    for i in rng.permutation(len(mean))[:N]:
        readings = mean[i] + scatter * (measured[i] - mean[i]) + offset
        yield consistency(calibration, {**problem.conditions, "drawbar_pull_kn": readings})


def test_what_the_reference_deems_possible_is_consistent(pull_calibration: Calibration) -> None:
    found = list(campaigns(pull_calibration))
    # At most 5 % are rejected; so many by chance once in a thousand.
    assert sum(bool(one.differs) for one in found) <= binom.ppf(0.999, N, 0.05)
    inside = sum(one.scatter[1] <= 1.0 <= one.scatter[2] for one in found)
    assert binom.ppf(0.001, N, 0.9) <= inside <= binom.ppf(0.999, N, 0.9)


def test_an_offset_is_found_as_often_as_is_said(pull_calibration: Calibration) -> None:
    reach = next(campaigns(pull_calibration)).detectable
    found = list(campaigns(pull_calibration, offset=reach))
    named = sum("offset" in one.differs for one in found)
    # A tenth to either side of 0.8, for the normal law is near, and Monte Carlo error.
    assert binom.ppf(0.001, N, 0.7) <= named <= binom.ppf(0.999, N, 0.9)
    inside = sum(one.offset[1] <= reach <= one.offset[2] for one in found)
    assert binom.ppf(0.001, N, 0.9) <= inside <= binom.ppf(0.999, N, 0.9)
    (one, *_) = [one for one in found if "offset" in one.differs]
    assert "above it on average" in one.verdict


@pytest.mark.parametrize("scatter", [0.3, 3.0])
def test_another_scatter_is_found(pull_calibration: Calibration, scatter: float) -> None:
    found = list(islice(campaigns(pull_calibration, scatter=scatter), 40))
    assert sum("scatter" in one.differs for one in found) > 32
    assert all((one.scatter[0] > 1.0) is (scatter > 1.0) for one in found)


def test_rows_that_say_nothing_are_set_aside(pull_calibration: Calibration) -> None:
    own = pull_calibration.problem.table
    columns = {name: own[name][:6].copy() for name in own}
    columns["drawbar_pull_kn"][:4] += 0.01  # the last two are the reference's own
    columns["inflation_pressure_psi"][0] = 60.0
    found = consistency(pull_calibration, columns)
    assert (found.n, found.aside) == (3, 3)
    assert "3 rows judged, 3 set aside" in found.lines[0]
    columns["inflation_pressure_psi"][:] = 60.0
    with pytest.raises(CalibError, match="no row lies where the reference was calibrated"):
        consistency(pull_calibration, columns)
    with pytest.raises(CalibError, match="rows that are fitted"):
        consistency(pull_calibration, own)


def test_of_two_rows_no_scatter_is_judged(pull_calibration: Calibration) -> None:
    own = pull_calibration.problem.table
    found = consistency(pull_calibration, {n: own[n][:2] + 1e-6 for n in own})
    assert set(found.p) == {"offset", "coverage"}
    assert np.isnan(found.scatter[0])


def test_a_reference_that_did_not_converge_judges_nothing(pull_calibration: Calibration) -> None:
    own = pull_calibration.problem.table
    with patch.object(Calibration, "converged", PropertyMock(return_value=False)):
        found = consistency(pull_calibration, {n: own[n][:5] + 1e-6 for n in own})
    assert found.verdict.startswith("cannot be judged")
    assert replace(found, converged=True).verdict.startswith("consistent")
