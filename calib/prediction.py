"""Predict outputs at new conditions, with bands, from a calibration."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from calib.calibration import Calibration
from calib.data import Table
from calib.models.base import Array
from calib.scores import LEVELS
from calib.streams import generator

__all__ = ["Bands", "Prediction", "bands", "predict", "prediction_columns", "predictive_draws"]

N_DRAWS = 4000


@dataclass(frozen=True)
class Bands:
    """Median and central bands, arrays of shape (n,) by level."""

    median: Array
    lower: Mapping[float, Array]
    upper: Mapping[float, Array]


@dataclass(frozen=True)
class Prediction:
    """A prediction at n conditions.

    Parameters
    ----------
    output : str
        Canonical column, with its unit.
    conditions : mapping of str to ndarray
    parameter : Bands
        Uncertainty of the parameters alone: where the mean curve lies.
    predictive : Bands
        With the noise: where a measurement would lie.
    outside : tuple of tuple of str
        For every row, the conditions that leave the calibrated range.
    """

    output: str
    conditions: Mapping[str, Array]
    parameter: Bands
    predictive: Bands
    outside: tuple[tuple[str, ...], ...]


def predictive_draws(
    calibration: Calibration, conditions: Mapping[str, Array], rng: np.random.Generator,
    size: int = N_DRAWS,
) -> tuple[Array, Array]:  # fmt: skip
    """Draw the mean output and a measurement, both of shape (size, n)."""
    problem = calibration.problem
    natural = problem.theta(calibration.subset(size))
    location = problem.bound.location(natural[:, :-1], conditions)
    noise = natural[:, -1:] * rng.standard_normal(location.shape)
    from_response = problem.bound.from_response
    return from_response(location), from_response(location + noise)


def predict(calibration: Calibration, table: Table) -> Prediction:
    """Predict at the conditions of a table.

    Parameters
    ----------
    calibration : Calibration
    table : Table
        With the model's conditions.

    Returns
    -------
    Prediction

    Raises
    ------
    CalibError
        If a condition is missing.
    """
    model = calibration.problem.bound.model
    conditions = model.select(table.columns)
    rng = generator(calibration.seed, calibration.label, "predict")
    mean, measured = predictive_draws(calibration, conditions, rng)
    return Prediction(
        model.output,
        conditions,
        bands(mean),
        bands(measured),
        _outside(calibration.problem.conditions, conditions),
    )


def bands(draws: Array) -> Bands:
    """Median and central bands of draws, shape (size, n)."""
    edges = [
        0.5,
        *(0.5 - level / 2.0 for level in LEVELS),
        *(0.5 + level / 2.0 for level in LEVELS),
    ]
    # A parameter vector for which the equation has no value there is left out, not spread; where
    # none has a value, neither have the bands.
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "All-NaN slice", RuntimeWarning)
        quantiles = np.nanquantile(draws, edges, axis=0)
    k = len(LEVELS)
    return Bands(
        quantiles[0],
        dict(zip(LEVELS, quantiles[1 : 1 + k], strict=True)),
        dict(zip(LEVELS, quantiles[1 + k :], strict=True)),
    )


def prediction_columns(prediction: Prediction, table: Table) -> dict[str, Array | list[str]]:
    """Lay a prediction out as columns of a CSV: the conditions first, as they were given.

    Parameters
    ----------
    prediction : Prediction
    table : Table
        The conditions.
    """
    output = prediction.output
    columns: dict[str, Array | list[str]] = dict(table.columns)
    columns.pop(output, None)
    columns[f"{output}_median"] = prediction.predictive.median
    for kind, banded in (
        ("parameter", prediction.parameter),
        ("predictive", prediction.predictive),
    ):
        for level in LEVELS:
            columns[f"{output}_{kind}_{100 * level:g}_lower"] = banded.lower[level]
            columns[f"{output}_{kind}_{100 * level:g}_upper"] = banded.upper[level]
    columns["outside_calibrated_range"] = ["+".join(flags) for flags in prediction.outside]
    return columns


def _outside(
    calibrated: Mapping[str, Array], conditions: Mapping[str, Array]
) -> tuple[tuple[str, ...], ...]:
    n = next(iter(conditions.values())).size
    flags: list[list[str]] = [[] for _ in range(n)]
    for name, values in conditions.items():
        low, high = calibrated[name].min(), calibrated[name].max()
        slack = 1e-9 * max(abs(low), abs(high))
        for i in np.flatnonzero((values < low - slack) | (values > high + slack)):
            flags[i].append(name)
    return tuple(tuple(row) for row in flags)
