"""Predict outputs at new conditions, with bands, from a calibration.

Held-out rows of one test share the uncertainty of one curve, so they are not independent: when it
is off, it is off for all of them. Every draw is a set of rows that the model deems possible, so
treating draws as observations gives the reference that a binomial or Kolmogorov law would give
for independent rows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import bdtr, ndtr, ndtri

from calib.batch.environment import one_thread
from calib.data import Table
from calib.data.checks import stretches
from calib.errors import CalibError
from calib.inference.likelihood import serial_of
from calib.inference.random import generator
from calib.models.base import Array
from calib.shown import Shown
from calib.validation.constants import BLOCKS, LEVELS, MIN_DEFINED, N_DRAWS
from calib.validation.questions import (
    Both,
    Chance,
    Drawn,
    Levels,
    Peak,
    Probability,
    Sample,
    Weights,
    asked,
    quantiles,
)

if TYPE_CHECKING:
    from calib.inference.calibration import Calibration
    from calib.inference.problem import Problem


@dataclass(frozen=True)
class Bands:
    """Median and central bands, arrays of shape (n,) by level."""

    median: Array
    lower: Mapping[float, Array]
    upper: Mapping[float, Array]


@dataclass(frozen=True)
class Part:
    """Draws of one problem's parameters, (size, d_all), that a prediction is made from.

    Which are alike, how many independent ones say as much, the seed and labels of their random
    numbers, and what tells the posterior that they are of, a joint one of several outputs perhaps.
    """

    problem: Problem
    natural: Array
    block: NDArray[np.intp]
    effective: float
    seed: int
    labels: tuple[str | int, ...]
    posterior: tuple[object, ...]


def _part(calibration: Calibration, size: int, *labels: str | int) -> Part:
    """Take evenly spaced draws of a calibration; walkers move alike, ensembles do not."""
    draws, report, problem = calibration.draws, calibration.draws.report, calibration.problem
    ensembles, walkers, steps, _ = draws.t.shape
    picked = calibration.picked(size)
    parts = max(1, min(BLOCKS // ensembles, steps))
    block = picked // (walkers * steps) * parts + picked % steps * parts // steps
    # Of chains that are too short to tell, one.
    ess = np.nan_to_num(np.append(report.ess_bulk, report.ess_tail), nan=1.0).min()
    return Part(
        problem, problem.theta(draws.flat[picked]), np.unique(block, return_inverse=True)[1],
        min(float(picked.size), max(float(ess), 1.0)), calibration.seed,
        (calibration.label, *labels), (calibration.seed, draws.evaluations, draws.seconds),
    )  # fmt: skip


def _weights(parts: Sequence[Part]) -> Weights:
    """Of the draws of all parts, which count alike; blocks hold some of every part."""
    block = np.concatenate([p.block for p in parts])
    effective = block.size**2 / sum(len(p.natural) ** 2 / p.effective for p in parts)
    return Weights(np.full(block.size, 1.0 / block.size), block, effective)


type _Found = list[tuple[Part, dict[str, Array], Array]]


def _locations(
    parts: Sequence[Part], table: Table, at_once: int = 2000, least: float = MIN_DEFINED
) -> Iterator[tuple[slice, Array, _Found]]:
    """Yield some rows at a time, the share of draws with a value, each part's mean responses."""
    for start in range(0, len(table), at_once):
        rows, found = slice(start, start + at_once), []
        for part in parts:
            columns = part.problem.bound.model.select(table.columns)
            at = {name: v[rows] for name, v in columns.items()}
            error = generator(part.seed, *part.labels, "emulator")  # an emulator's error, too
            found.append((part, at, part.problem.draw_mean_response(part.natural, at, error)))
        share = np.isfinite(np.concatenate([y for _, _, y in found])).mean(axis=0)
        # Where many plausible parameters give the equation no value (a quadratic in pressure
        # extrapolated below zero), the rest are no sample of anything: no value is better.
        kept = [(part, at, np.where(share >= least, y, np.nan)) for part, at, y in found]
        yield rows, share, kept


def _quantiles(parts: Sequence[Part], table: Table, q: Levels) -> tuple[Array, Array, Array]:
    """Quantiles of mean and reading, (q, n), and the part of the draws with a value, (n,)."""
    normals = []
    for part in parts:
        # The same noise draws for every row: its bands do not depend on the other rows. Evenly
        # spread over their quantiles, in random order, four for each draw of the parameters.
        rng, size = generator(part.seed, *part.labels), len(part.natural)
        spread = ((rng.permutation(size) + rng.uniform(size=size)) / size for _ in range(4))
        normals.append([ndtri(u)[:, None] for u in spread])
    done = []
    for _, share, found in _locations(parts, table):
        means, readings = [], []
        for (part, at, location), zs in zip(found, normals, strict=True):
            back, noise = part.problem.bound.from_response, part.problem.noise
            means.append(back(location))
            readings += [back(location + noise.of_normal(part.natural, at, z)) for z in zs]
        both = (quantiles(np.concatenate(v), q) for v in (means, readings))
        done.append((*both, share))
    mean, reading, share = (np.concatenate(v, axis=-1) for v in zip(*done, strict=True))
    return mean, reading, share


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
    _parts: tuple[Part, ...] = field(kw_only=True)
    _table: Table = field(kw_only=True)

    def __repr__(self) -> str:
        """Name the output, and say how many rows there are and how many are outside."""
        outside = sum(map(bool, self.outside))
        return (
            f"<Prediction of {self.output} at {len(self.outside)} rows, {outside} outside the "
            "calibrated range>"
        )

    def probability(self, sign: str, value: ArrayLike) -> Probability:
        """Return how probably the output lies above or below a value, with Monte Carlo errors.

        Parameters
        ----------
        sign : {">", "<"}
        value : float or array_like, shape (n,)
            In the unit of `output`: one for all rows, or one for each.

        Returns
        -------
        Probability
            Of the mean curve and of a new reading, in each row and in all rows at once.

        Raises
        ------
        CalibError
            If the value is no number.

        Examples
        --------
        >>> import calib
        >>> plates = calib.load_he2019("rut_depth")
        >>> calibration = calib.calibrate(calib.build_problem("bekker", plates), seed=1)
        >>> ruts = calib.predict(calibration, {"average_ground_pressure_kpa": [100.0, 150.0]})
        >>> deep = ruts.probability(">", 25.0)
        >>> bool(deep.mean.value[0] < deep.reading.value[0] < deep.reading.value[1])
        True
        """
        weights, (over, limit) = _weights(self._parts), asked(sign, value, len(self._table))
        everywhere, rows = np.ones((2, weights.block.size)), []
        for some, _, found in _locations(self._parts, self._table):
            values: list[list[Array]] = [[], []]
            for part, at, location in found:
                bound = part.problem.bound
                with np.errstate(divide="ignore", invalid="ignore"):
                    # All that has a logarithm is above zero.
                    least = (bound.model.response == "log") & (limit[some] <= 0.0)
                    left = np.where(least, -np.inf, bound.to_response(limit[some])) - location
                noise = part.problem.noise
                z = noise.normal_scores(left, part.natural, noise.scale(part.natural, at))
                values[0].append(np.where(np.isnan(left), np.nan, (left < 0.0) == over))
                values[1].append(ndtr(-z if over else z))
            both = [np.concatenate(v) for v in values]
            everywhere *= [v.prod(axis=1) for v in both]
            rows.append([weights.chance(v) for v in both])
        if len(self._table) > 1 and any(p.problem.noise.correlated_along for p in self._parts):
            everywhere[1] = np.nan
        mean, reading = (
            Chance(*map(np.concatenate, zip(*of, strict=True))) for of in zip(*rows, strict=True)
        )
        return Probability(mean, reading, *map(weights.chance, everywhere))

    def quantile(self, q: Levels) -> Both:
        """Return quantiles of the mean curve and of a new reading, (n,), or (q, n) of several.

        A CalibError names levels that are not between 0 and 1.
        """
        return Both(*_quantiles(self._parts, self._table, q)[:2])

    def draws(self, size: int = 1000) -> Drawn:
        """Return draws of the mean curve and of a new reading in each row, (size, n).

        In one draw all rows have the same parameters, so any function of rows may be formed of it.
        They are evenly spaced among the 4000 that bands are made from. A CalibError says if noise
        is correlated along a column that the conditions do not have.
        """
        return self._drawn(correlated=True).draws(size)

    def _drawn(self, *, correlated: bool) -> Drawn:
        """Draw mean and readings; the noise of the rows may be left independent."""
        conditions, means, readings = dict[str, Array](), [], []
        n = len(self._table)
        for _, _, found in _locations(self._parts, self._table, n):
            for part, at, location in found:
                noise, back = part.problem.noise, part.problem.bound.from_response
                along = noise.correlated_along if correlated and n > 1 else ""
                order = serial_of(along, self._table)
                drawn = noise.draw(
                    part.natural, at, generator(part.seed, *part.labels, "draws"), n, order
                )
                means.append(back(location))
                readings.append(back(location + drawn))
                conditions |= at
        weights = _weights(self._parts)
        mean, reading = (Sample(np.concatenate(v), weights) for v in (means, readings))
        return Drawn(conditions, mean, reading)

    def peak(self, over: str) -> Peak:
        """Find where the mean is largest along a condition; see `Drawn.peak`."""
        return self._drawn(correlated=False).peak(over)  # of the mean, which has no noise


def combine(
    predictions: Mapping[str, Prediction], function: Callable[..., Array], size: int = 1000
) -> Drawn:
    """Form a function of several outputs, draw by draw, such as an efficiency of pull and torque.

    Outputs of one joint posterior share their parameters draw by draw. Separate fits are taken for
    independent, which those of data in common are not.

    Parameters
    ----------
    predictions : mapping of str to Prediction
        At the same rows, by the names of the function's arguments.
    function : callable
        ``(**outputs) -> (size, m)``, each output (size, n) in the unit of its prediction.

    Returns
    -------
    Drawn
        The function of the means and of new readings, whose noise is independent.

    Raises
    ------
    CalibError
        If the predictions differ in their rows, or the function returns another shape.

    Examples
    --------
    >>> import calib
    >>> from calib.validation.prediction import combine
    >>> ruts = calib.load_he2019("rut_depth")
    >>> calibration = calib.calibrate(calib.build_problem("bekker", ruts), seed=1)
    >>> found = calib.predict(calibration, {"average_ground_pressure_kpa": [100.0, 150.0]})
    >>> deeper = combine({"rut": found}, lambda rut: rut[:, 1:] - rut[:, :1])
    >>> float(deeper.mean.probability(">", 0.0).value[0])
    1.0
    """
    drawn = {name: p.draws(size) for name, p in predictions.items()}
    conditions = {n: v for d in drawn.values() for n, v in d.conditions.items()}
    alike = all(
        np.array_equal(v, conditions[n]) for d in drawn.values() for n, v in d.conditions.items()
    )
    if not alike or len({d.mean.values.shape for d in drawn.values()}) != 1:
        raise CalibError(
            "the predictions differ in their rows or draws", where="combine",
            expected="one or more predictions at the same conditions, of as many draws",
            hint="predict all rows in one table; columns of its draws are its rows",
        )  # fmt: skip
    known = dict[object, int]()
    arguments: tuple[dict[str, Array], dict[str, Array]] = ({}, {})
    for name, d in drawn.items():
        posterior = tuple(part.posterior for part in predictions[name]._parts)
        # Chains of one seed might move alike: posteriors of their own are paired at a distance.
        by = known.setdefault(posterior, len(known)) * len(d.mean.values) // len(drawn)
        for values, of in zip(arguments, (d.mean, d.reading), strict=True):
            values[name] = np.roll(of.values, by, axis=0)
    least = min((d.mean.weights for d in drawn.values()), key=lambda w: w.effective)
    samples = []
    for values in arguments:
        with np.errstate(all="ignore"):
            found = np.asarray(function(**values), dtype=np.float64)
        if found.ndim != 2 or len(found) != least.block.size:
            raise CalibError(
                f"the function returned the shape {found.shape}", where="combine",
                expected=f"({least.block.size}, rows): a value of every draw",
                hint="work on whole arrays, whose first axis is that of the draws",
            )  # fmt: skip
        samples.append(Sample(found, least))
    return Drawn(conditions, samples[0], samples[1])


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


def predict(calibration: Calibration, table: Table) -> Prediction:
    """Predict at the conditions of a table; a CalibError names one that is missing."""
    return _predicted((_part(calibration, N_DRAWS, "predict"),), table)


def predict_stacked(parts: Sequence[tuple[float, Calibration]], table: Table) -> Prediction:
    """Predict with the mixture of several calibrations of one output, weights first, of sum 1.

    Each gives as many of the `N_DRAWS` draws as is its weight. A CalibError names a condition of
    one that has any and the table has not.
    """
    sizes = [(round(weight * N_DRAWS), c) for weight, c in parts]
    found = (_part(c, size, "predict stacked", i) for i, (size, c) in enumerate(sizes) if size)
    return _predicted(tuple(found), table)


def predict_prior(problem: Problem, table: Table) -> Prediction:
    """Predict at the conditions of a table what the priors expect, without any data.

    As a fit does, they keep out of where the equation has no value in one of the rows, unless that
    is most of them.
    """
    labels, size = (problem.bound.model.name, "prior"), 2 * N_DRAWS
    natural = problem.theta(problem.priors.sample(generator(0, *labels, "parameters"), size))
    good = np.ones(size, dtype=np.bool_)
    every = Part(problem, natural, np.zeros(size, np.intp), 1.0, 0, labels, labels)
    for _, _, ((_, _, location),) in _locations([every], table, least=0.0):
        good &= np.isfinite(location).all(axis=1)
    natural = natural[good if good.sum() >= N_DRAWS else slice(None)][:N_DRAWS]
    block = np.arange(N_DRAWS) * BLOCKS // N_DRAWS
    part = Part(problem, natural, block, float(N_DRAWS), 0, labels, labels)
    return _predicted((part,), table, prior=True)


def _predicted(parts: tuple[Part, ...], table: Table, *, prior: bool = False) -> Prediction:
    conditions, outer = dict[str, Array](), list[tuple[tuple[str, ...], ...]]()
    for part in parts:
        own = part.problem.bound.model.select(table.columns)
        conditions |= own
        outer.append(outside(own if prior else part.problem.conditions, own))
    mean, reading, share = _quantiles(parts, table, _EDGES)
    flags = (tuple(dict.fromkeys(n for f in row for n in f)) for row in zip(*outer, strict=True))
    return Prediction(
        parts[0].problem.bound.model.output, conditions, _bands(mean), _bands(reading),
        tuple(flags), share, _parts=parts, _table=table,
    )  # fmt: skip


_EDGES = [0.5, *(0.5 + half * level for half in (-0.5, 0.5) for level in LEVELS)]


def _bands(edges: Array) -> Bands:
    k = len(LEVELS)
    return Bands(
        edges[0],
        dict(zip(LEVELS, edges[1 : 1 + k], strict=True)),
        dict(zip(LEVELS, edges[1 + k :], strict=True)),
    )


def bands(draws: Array) -> Bands:
    """Median and central bands of draws, shape (size, n)."""
    return _bands(quantiles(draws, _EDGES))


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
