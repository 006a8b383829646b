"""Residuals over the noise scale, and whether their signs run on along a curve."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaincinv, ndtri

from calib.inference.calibration import Calibration
from calib.inference.problem import Problem
from calib.models.base import Array

_N_DRAWS = 1000


@dataclass(frozen=True)
class Standardised:
    """Residuals over the noise scale, posterior means, and predictions of some rows, each (n,).

    Where the noise is Student's, normal scores: standard normal values of the same quantile.
    Residuals are on the scale of the response; the prediction is in the output's unit.
    """

    residual: Array
    predicted: Array


def standardise(calibration: Calibration, problem: Problem) -> Standardised:
    """Work residuals out at the posterior: of the problem's rows, calibrated on or others."""
    natural = problem.theta(calibration.subset(_N_DRAWS))
    location = problem.bound.location(problem.of_model(natural), problem.conditions)
    residual = np.nanmean(
        problem.noise.normal_scores(problem.response - location, natural, problem.conditions),
        axis=0,
    )
    return Standardised(residual, problem.bound.from_response(np.nanmedian(location, axis=0)))


def sign_changes(x: Array, residual: Array, groups: Iterable[NDArray[np.bool_]]) -> tuple[int, int]:
    """Count sign changes of residuals (n,) along x within each group, and neighbours in all.

    Independent residuals change sign between half of the neighbours; a curve that misses a pattern
    leaves long runs of one sign.
    """
    changes, pairs = 0, 0
    for rows in groups:
        sign = np.sign(residual[rows][np.argsort(x[rows], kind="stable")])
        changes += int((sign[1:] != sign[:-1]).sum())
        pairs += max(0, sign.size - 1)
    return changes, pairs


def normal_order(n: int) -> tuple[Array, Array, Array]:
    """Quantiles that n sorted standard normals have, and where 95 % of each of them lie."""
    i = np.arange(1.0, n + 1.0)
    low, high = (betaincinv(i, n + 1.0 - i, p) for p in (0.025, 0.975))
    middle, low, high = ndtri(np.stack([(i - 0.375) / (n + 0.25), low, high]))
    return middle, low, high
