"""Predict outputs at new conditions, with bands, from a calibration.

Held-out rows of one test share the uncertainty of one curve, so they are not independent: when it
is off, it is off for all of them. Every draw is a set of rows that the model deems possible, so
treating draws as observations gives the reference that a binomial or Kolmogorov law would give
for independent rows.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import bdtr, ndtri

from calib.batch.environment import one_thread
from calib.data import Table
from calib.data.checks import stretches
from calib.inference.random import generator
from calib.models.base import Array
from calib.shown import Shown
from calib.validation.constants import LEVELS, MIN_DEFINED, N_DRAWS

if TYPE_CHECKING:
    from calib.inference.calibration import Calibration
    from calib.inference.problem import Problem


@dataclass(frozen=True)
class Bands:
    """Median and central bands, arrays of shape (n,) by level."""

    median: Array
    lower: Mapping[float, Array]
    upper: Mapping[float, Array]


@dataclass(frozen=True, repr=False)
class Prediction(Shown):
    """A prediction at n conditions.

    Parameters
    ----------
    output : str
        Canonical column, with its unit.
    conditions : mapping of str to ndarray
    parameter : Bands
        Uncertainty of the parameters, and of an emulator if there is one, without the noise:
        where the mean curve lies.
    predictive : Bands
        With the noise: where a measurement would lie.
    outside : tuple of tuple of str
        For every row, the conditions that leave the calibrated range.
    defined : ndarray, shape (n,)
        Part of the posterior for which the equation has a value there; below `MIN_DEFINED`
        median and bands are NaN.
    index : tuple, optional
        Labels of the rows in the data frame that was given.
    """

    output: str
    conditions: Mapping[str, Array]
    parameter: Bands
    predictive: Bands
    outside: tuple[tuple[str, ...], ...]
    defined: Array
    index: tuple[object, ...] | None = None

    def __repr__(self) -> str:
        """Name the output, and say how many rows there are and how many are outside."""
        outside = sum(map(bool, self.outside))
        return (
            f"<Prediction of {self.output} at {len(self.outside)} rows, {outside} outside the "
            "calibrated range>"
        )


@one_thread()
def predictive_draws(
    calibration: Calibration, conditions: Mapping[str, Array], rng: np.random.Generator,
    size: int = N_DRAWS,
) -> tuple[Array, Array]:  # fmt: skip
    """Draw the mean output and a measurement, both of shape (size, n)."""
    problem = calibration.problem
    natural = problem.theta(calibration.subset(size))
    location = problem.draw_mean_response(natural, conditions, rng)
    noise = problem.noise.draw(natural, conditions, rng, location.shape[1])
    from_response = problem.bound.from_response
    return from_response(location), from_response(location + noise)


@one_thread()
def row_draws(calibration: Calibration, table: Table, rng: np.random.Generator) -> Array:
    """Draw readings of the rows of a table, errors of their conditions included, (size, n)."""
    problem = calibration.problem.with_table(table)
    natural = problem.theta(calibration.subset(N_DRAWS))
    location = problem.draw_mean_response(natural, problem.conditions, rng)
    return problem.bound.from_response(location + problem.draw_noise(natural, rng, apart=True))


def prior_predictive(problem: Problem, rng: np.random.Generator) -> Array:
    """Return measurements that the priors expect at the calibrated rows, shape (draws, n)."""
    natural = problem.theta(problem.priors.sample(rng, 1000))
    location = problem.draw_mean_response(natural, problem.conditions, rng)
    return problem.bound.from_response(location + problem.draw_noise(natural, rng))


def predict_stacked(parts: Sequence[tuple[float, Calibration]], table: Table) -> Prediction:
    """Predict with the mixture of several calibrations of one output, weights first, of sum 1.

    Each gives as many of the `N_DRAWS` draws as is its weight. A CalibError names a condition of
    one that has any and the table has not.
    """
    used = [(weight, c) for weight, c in parts if round(weight * N_DRAWS) > 0]
    means, measured, outer = [], [], []
    conditions: dict[str, Array] = {}
    for weight, c in used:
        own = c.problem.bound.model.select(table.columns)
        rng = generator(c.seed, c.label, "predict stacked")
        mean, reading = predictive_draws(c, own, rng, round(weight * N_DRAWS))
        means.append(mean)
        measured.append(reading)
        outer.append(outside(c.problem.conditions, own))
        conditions |= own
    whole = np.concatenate(means)
    share = np.isfinite(whole).mean(axis=0)
    kept = np.where(share >= MIN_DEFINED, 0.0, np.nan)
    flags = (
        tuple(dict.fromkeys(name for f in row for name in f)) for row in zip(*outer, strict=True)
    )
    return Prediction(
        used[0][1].problem.bound.model.output, conditions, bands(whole + kept),
        bands(np.concatenate(measured) + kept), tuple(flags), share,
    )  # fmt: skip


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
    problem = calibration.problem
    natural = problem.theta(calibration.subset(N_DRAWS))
    # The same noise draws for every row: its bands do not depend on the other rows.
    rng = generator(calibration.seed, calibration.label, "predict")
    # Evenly spread over their quantiles, in random order, four for each draw of the parameters.
    size = natural.shape[0]
    normals = [
        ndtri((rng.permutation(size) + rng.uniform(size=size)) / size)[:, None] for _ in range(4)
    ]
    parts = []
    at_once = 2000  # rows; of 4000 draws each
    for start in range(0, len(table), at_once):
        rows = {name: v[start : start + at_once] for name, v in conditions.items()}
        # An emulator's error, too.
        error = generator(calibration.seed, calibration.label, "predict", "emulator")
        location = problem.draw_mean_response(natural, rows, error)
        share = np.isfinite(location).mean(axis=0)
        # Where many plausible parameters give the equation no value (a quadratic in pressure
        # extrapolated below zero), the rest are no sample of anything: no value is better.
        location = np.where(share >= MIN_DEFINED, location, np.nan)
        back = problem.bound.from_response
        noises = (problem.noise.of_normal(natural, rows, z) for z in normals)
        measured = np.concatenate([back(location + noise) for noise in noises])
        parts.append((bands(back(location)), bands(measured), share))
    return Prediction(
        model.output,
        conditions,
        _join([p[0] for p in parts]),
        _join([p[1] for p in parts]),
        outside(problem.conditions, conditions),
        np.concatenate([p[2] for p in parts]),
    )


def _join(parts: Sequence[Bands]) -> Bands:
    return Bands(
        np.concatenate([b.median for b in parts]),
        {level: np.concatenate([b.lower[level] for b in parts]) for level in LEVELS},
        {level: np.concatenate([b.upper[level] for b in parts]) for level in LEVELS},
    )


def bands(draws: Array) -> Bands:
    """Median and central bands of draws, shape (size, n)."""
    edges = [0.5, *(0.5 + half * level for half in (-0.5, 0.5) for level in LEVELS)]
    quantiles = np.quantile(draws, edges, axis=0)
    if np.isnan(quantiles).any():
        # A parameter vector for which the equation has no value there is left out, not spread;
        # where none has a value, neither have the bands.
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "All-NaN slice", RuntimeWarning)
            quantiles = np.nanquantile(draws, edges, axis=0)
    k = len(LEVELS)
    return Bands(
        quantiles[0],
        dict(zip(LEVELS, quantiles[1 : 1 + k], strict=True)),
        dict(zip(LEVELS, quantiles[1 + k :], strict=True)),
    )


def smooth_bands(
    calibration: Calibration, conditions: Mapping[str, Array], *, prior: bool = False
) -> tuple[Bands, Bands]:
    """Bands of the mean output and of a measurement along a curve, of posterior or prior.

    Each draw has one noise value for the whole curve, so that its quantiles are smooth in x.
    """
    problem = calibration.problem
    rng = generator(calibration.seed, calibration.label, "figures")
    t = problem.priors.sample(rng, 1000) if prior else calibration.subset(1000)
    natural = problem.theta(t)
    size = natural.shape[0]
    z = ndtri((rng.permutation(size) + 0.5) / size)[:, None]
    location = problem.draw_mean_response(natural, conditions, rng)
    noise = problem.noise.of_normal(natural, conditions, z)
    back = problem.bound.from_response
    return bands(back(location)), bands(back(location + noise))


def median_change(calibration: Calibration, column: str) -> float:
    """Change of the median from the 10 to the 90 % point of a condition, medians of the others."""
    calibrated = calibration.problem.conditions
    at = {name: np.full(2, np.median(values)) for name, values in calibrated.items()}
    at[column] = np.quantile(calibrated[column], [0.1, 0.9])
    return float(np.diff(smooth_bands(calibration, at)[0].median)[0])


def prediction_columns(prediction: Prediction, table: Table) -> dict[str, Array | list[str]]:
    """Lay a prediction out as columns of a CSV: the table's conditions first, as given."""
    return echoed(table, prediction.output) | band_columns(prediction)


def band_columns(prediction: Prediction) -> dict[str, Array | list[str]]:
    """Lay out median and bands as columns, then what is outside the calibrated range."""
    output, columns = prediction.output, dict[str, Array | list[str]]()
    columns[f"{output}_median"] = prediction.predictive.median
    kinds = {"parameter": prediction.parameter, "predictive": prediction.predictive}
    for kind, banded in kinds.items():
        for level in LEVELS:
            columns[f"{output}_{kind}_{100 * level:g}_lower"] = banded.lower[level]
            columns[f"{output}_{kind}_{100 * level:g}_upper"] = banded.upper[level]
    columns["outside_calibrated_range"] = [
        "+".join(flags)
        + ("" if defined >= MIN_DEFINED else f" (no value: defined for {defined:.0%})")
        for flags, defined in zip(prediction.outside, prediction.defined, strict=True)
    ]
    return columns


def echoed(table: Table, *outputs: str) -> dict[str, Array | list[str]]:
    """Return the columns of a table as they were given, but for measured outputs.

    Long tables, whose text is not kept, come back in canonical columns.
    """
    if not table.text:
        return {name: v for name, v in table.columns.items() if name not in outputs}
    measured = {table.header_of(name) for name in outputs}
    given = {h: [row[j] for row in table.text] for j, h in enumerate(table.header)}
    return {h: cells for h, cells in given.items() if h not in measured}


def outside(
    calibrated: Mapping[str, Array], conditions: Mapping[str, Array]
) -> tuple[tuple[str, ...], ...]:
    """Name, for each row of conditions, those that the calibrated ones do not cover."""
    flags: list[list[str]] = [[] for _ in next(iter(conditions.values()))]
    for name, values in conditions.items():
        slack = 1e-9 * float(np.abs(calibrated[name]).max())
        covered = [
            (values >= low - slack) & (values <= high + slack)
            for low, high in stretches(calibrated[name])
        ]
        for i in np.flatnonzero(~np.any(covered, axis=0)):
            flags[i].append(name)
    return tuple(tuple(row) for row in flags)


def ks_distance(pit: Array) -> Array:
    """Largest distance of the ECDF of PIT values from uniform, shape (..., n) to (...)."""
    ordered = np.sort(pit, axis=-1)
    n = ordered.shape[-1]
    above = np.arange(1, n + 1) / n - ordered
    below = ordered - np.arange(n) / n
    return np.asarray(np.maximum(above.max(axis=-1), below.max(axis=-1)))


def pit_half_width(draws: Array) -> float:
    """Half the width of the band that 95 % of the PIT values of possible rows (size, n) stay in."""
    return float(np.quantile(ks_distance(_pit_of_draws(draws)), 0.95))


def coverage_probability(draws: Array, hits: int, level: float) -> float:
    """Probability of covering no more rows than were covered, were the predictions right.

    `hits` rows are inside their central band of draws (size, n).
    """
    covered = (np.abs(_pit_of_draws(draws) - 0.5) <= 0.5 * level).sum(axis=1)
    # The draw that was observed counts among those possible, so it is never 0.
    return float((1 + (covered <= hits).sum()) / (1 + covered.size))


def bias_probability(draws: Array, pit: Array) -> float:
    """Probability of readings that lie so far to one side, were the predictions right.

    By the mean PIT of the rows (n,), beside that of draws (size, n): what rows share counts once.
    """
    found = abs(float(pit.mean()) - 0.5)
    possible = np.abs(_pit_of_draws(draws).mean(axis=1) - 0.5)
    return float((1 + (possible >= found).sum()) / (1 + possible.size))


def binomial_p(hits: int, n: int, level: float = 0.9) -> float:
    """Probability of so few hits or fewer among n independent rows; NaN of none."""
    return float(bdtr(hits, n, level)) if n else float("nan")


def hits(draws: Array, observed: Array, level: float) -> int:
    """Count the observations (n,) inside the central band of their draws (size, n)."""
    low, high = np.nanquantile(draws, [0.5 - 0.5 * level, 0.5 + 0.5 * level], axis=0)
    return int(((observed >= low) & (observed <= high)).sum())


def effective_rows(draws: Array) -> float:
    """Number of independent rows that would say as much on whether the predictions are off.

    That is n/(1 + (n - 1) r) with r the mean correlation between rows.
    """
    good = _complete(draws)
    n = good.shape[1]
    if n < 2:
        return float(n)
    correlation = np.corrcoef(good, rowvar=False)
    mean = (correlation.sum() - n) / (n * (n - 1))
    return float(n / (1.0 + (n - 1) * max(0.0, mean)))


def _complete(draws: Array) -> Array:
    return draws[np.isfinite(draws).all(axis=1)]


def _pit_of_draws(draws: Array) -> Array:
    good = _complete(draws)
    rank = good.argsort(axis=0).argsort(axis=0)
    return np.asarray((rank[:2000] + 0.5) / good.shape[0])
