"""What draws of a prediction answer: probabilities, quantiles and peaks, with Monte Carlo errors.

Draws that are neighbours in a chain are alike, so a standard error comes from batch means: the
draws fall into blocks that are nearly independent, whose means scatter about the whole (Flegal &
Jones 2010, doi:10.1214/09-AOS735). Where none or all of n effective draws are above a value, no
scatter shows; the error is then that of a half draw among them, sqrt(1/2)/n, and never smaller.

Of a *mean* that is the share of the draws whose curve lies above the value. Of a *reading* each
draw counts with the probability of its noise beyond the value, which scatters less than a drawn
reading would (Rao-Blackwell).
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.data.table import parse_header
from calib.errors import CalibError
from calib.models.base import Array
from calib.validation.constants import MIN_DEFINED

type Levels = float | Sequence[float]


class Chance(NamedTuple):
    """A probability and its Monte Carlo standard error, arrays of one shape."""

    value: Array
    error: Array


class Both(NamedTuple):
    """Quantiles of the mean and of a new reading, (n,), or (q, n) of several."""

    mean: Array
    reading: Array


@dataclass(frozen=True)
class Probability:
    """How probably an output lies above or below a value: its mean, and a new reading of it.

    Parameters
    ----------
    mean, reading : Chance, shape (n,)
        Row by row; NaN where the model has no value for much of the draws.
    mean_everywhere, reading_everywhere : Chance, shape ()
        That it does so in all rows at once, one reading in each. Rows share the parameters, so this
        is no product. Of readings NaN where noise is correlated: their order counts.
    """

    mean: Chance
    reading: Chance
    mean_everywhere: Chance
    reading_everywhere: Chance


@dataclass(frozen=True)
class Weights:
    """What draws count, and which of them are alike.

    Parameters
    ----------
    weight : ndarray, shape (size,)
        Of sum one.
    block : ndarray of int, shape (size,)
        Blocks that are nearly independent, from 0.
    effective : float
        Number of independent draws that say as much.
    """

    weight: Array
    block: NDArray[np.intp]
    effective: float

    def chance(self, values: Array) -> Chance:
        """Average probabilities given each draw, (size,) or (size, n); NaN are left out."""
        known = np.isfinite(values)
        share = self.weight @ known
        blocks = self.block == np.arange(self.block.max() + 1)[:, None]
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = self.weight @ np.where(known, values, 0.0) / share
            off = np.where(known, values - mean, 0.0) / share
            sums = (blocks * self.weight) @ off
            error = np.sqrt(len(blocks) / (len(blocks) - 1) * np.square(sums).sum(axis=0))
        least, good = np.sqrt(0.5) / self.effective, share >= MIN_DEFINED
        return Chance(
            np.where(good, np.clip(mean, 0.0, 1.0), np.nan),
            np.where(good, np.fmax(error, least), np.nan),
        )

    def spread(self, size: int) -> NDArray[np.intp]:
        """Pick draws evenly, of one weight each, in their order; no more than there are."""
        n = min(size, self.weight.size)
        at = np.cumsum(self.weight).searchsorted((np.arange(n) + 0.5) / n)
        return np.asarray(np.minimum(at, self.weight.size - 1), dtype=np.intp)

    def take(self, rows: NDArray[np.intp]) -> Weights:
        """Return those of picked draws, which count alike."""
        effective = min(self.effective, float(np.unique(rows).size))
        return Weights(np.full(rows.size, 1.0 / rows.size), self.block[rows], effective)


@dataclass(frozen=True)
class Sample:
    """Draws of a quantity, ``values`` of shape (size, n); of one draw all rows belong together."""

    values: Array
    weights: Weights

    def probability(self, sign: str, value: ArrayLike) -> Chance:
        """Return how probably it lies above (">") or below ("<") a value, or one of each row."""
        return self.weights.chance(self._beyond(sign, value))

    def everywhere(self, sign: str, value: ArrayLike) -> Chance:
        """Return how probably it does so in all rows at once, shape ()."""
        return self.weights.chance(self._beyond(sign, value).prod(axis=1))

    def quantile(self, q: Levels) -> Array:
        """Return a quantile of each row, (n,), or several, (q, n); NaN of rows without a value."""
        weight = self.weights.weight
        kept = np.where(weight @ np.isfinite(self.values) >= MIN_DEFINED, self.values, np.nan)
        return quantiles(kept, q, None if np.ptp(weight) < 1e-12 else weight)

    def _beyond(self, sign: str, value: ArrayLike) -> Array:
        over, limit = asked(sign, value, self.values.shape[1])
        return np.where(np.isnan(self.values), np.nan, (self.values > limit) == over)


@dataclass(frozen=True)
class Peak:
    """Where along a condition the mean output is largest.

    Parameters
    ----------
    conditions : mapping of str to ndarray, shape (m,)
        The settings of the other conditions, in the order of their first rows.
    at : Sample, shape (size, m)
        Where, in the unit that was asked for.
    output : Sample, shape (size, m)
        The largest mean output.
    inside : Chance, shape (m,)
        That the peak is not at an end of the rows, beyond which the output may still rise.
    """

    conditions: Mapping[str, Array]
    at: Sample
    output: Sample
    inside: Chance


@dataclass(frozen=True)
class Drawn:
    """Draws of a prediction.

    Parameters
    ----------
    conditions : mapping of str to ndarray, shape (n,)
    mean : Sample, shape (size, n)
        The mean output.
    reading : Sample, shape (size, n)
        A new reading in each row, of the same parameters.
    together : bool
        Whether the noise of rows is as correlated as the model says: not in a diagnosis.
    """

    conditions: Mapping[str, Array]
    mean: Sample
    reading: Sample
    together: bool = True

    def probability(self, sign: str, value: ArrayLike) -> Probability:
        """Return how probably mean and reading lie above (">") or below ("<") a value."""
        both = self.mean, self.reading
        rows, everywhere = (
            [getattr(s, how)(sign, value) for s in both] for how in ("probability", "everywhere")
        )
        if not self.together:
            everywhere[1] = Chance(np.array(np.nan), np.array(np.nan))
        return Probability(*rows, *everywhere)

    def quantile(self, q: Levels) -> Both:
        """Return quantiles of mean and reading."""
        return Both(self.mean.quantile(q), self.reading.quantile(q))

    def draws(self, size: int) -> Drawn:
        """Return fewer of them, evenly picked, of one weight each."""
        rows = self.mean.weights.spread(size)
        weights = self.mean.weights.take(rows)
        mean, reading = (Sample(s.values[rows], weights) for s in (self.mean, self.reading))
        return replace(self, mean=mean, reading=reading)

    def peak(self, over: str) -> Peak:
        """Find where the mean is largest along a condition, in rows that agree in the others.

        Parameters
        ----------
        over : str
            The condition, by a column name with its unit. Between three rows about the largest, a
            parabola is laid.

        Raises
        ------
        CalibError
            If there is no such condition, or fewer than three values of it at a setting.
        """
        column = parse_header(over)
        name = "" if column is None else column.quantity.canonical
        if column is None or name not in self.conditions:
            raise CalibError(
                f"there is no condition {over} to look along", where="peak",
                expected=", ".join(self.conditions), hint="name one of these, in any unit",
            )  # fmt: skip
        others = {n: v for n, v in self.conditions.items() if n != name}
        x, values = self.conditions[name], self.mean.values
        stacked = np.stack([*others.values(), np.zeros_like(x)])
        _, first, group = np.unique(stacked, axis=1, return_index=True, return_inverse=True)
        group = group.ravel()
        found = []
        for g in np.argsort(first):
            rows = np.flatnonzero(group == g)
            _, own = np.unique(x[rows], return_index=True)
            if own.size < 3:
                raise CalibError(
                    f"{own.size} value{'s' * (own.size > 1)} of {over} cannot show a peak",
                    where="peak",
                    expected="three or more of each setting of the other conditions",
                    hint="give rows along it",
                )  # fmt: skip
            found.append(_vertices(x[rows[own]], values[:, rows[own]]))
        at, top, inside = (np.stack(part, axis=1) for part in zip(*found, strict=True))
        w = self.mean.weights
        settings = {n: v[np.sort(first)] for n, v in others.items()}
        written = Sample(column.written(at), w)
        return Peak(settings, written, Sample(top, w), w.chance(inside))


def _vertices(x: Array, y: Array) -> tuple[Array, Array, Array]:
    """Place and height of the largest value of curves (size, n) at x (n,), and whether inside."""
    known = np.isfinite(y).all(axis=1)
    best = np.where(known, np.argmax(y, axis=1), 1)
    middle = np.clip(best, 1, x.size - 2)
    x0, x1, x2 = (x[middle + i] for i in (-1, 0, 1))
    y0, y1, y2 = (y[np.arange(len(y)), middle + i] for i in (-1, 0, 1))
    # The parabola y1 + slope step + bend step^2, by divided differences.
    left, right = (y1 - y0) / (x1 - x0), (y2 - y1) / (x2 - x1)
    bend = (right - left) / (x2 - x0)
    slope = left + bend * (x1 - x0)
    with np.errstate(invalid="ignore", divide="ignore"):
        step = np.where(bend < 0.0, -0.5 * slope / bend, 0.0)
    # Of a curve that is highest at an end the vertex may lie just before it.
    inside = (best == middle) | ((bend < 0.0) & (x1 + step > x[0]) & (x1 + step < x[-1]))
    at = np.where(inside, x1 + step, x[best])
    top = np.where(inside, y1 + step * (slope + bend * step), y[np.arange(len(y)), best])
    at, top, within = (np.where(known, v, np.nan) for v in (at, top, inside))
    return at, top, within


def asked(sign: str, value: ArrayLike, n: int) -> tuple[bool, Array]:
    """Return whether what lies above is asked for, and what n rows are compared with, (n,)."""
    found = np.full(n, np.nan)
    with suppress(TypeError, ValueError):
        found = np.broadcast_to(np.asarray(value, dtype=np.float64), (n,))
    if sign in (">", "<") and np.isfinite(found).all():
        return sign == ">", found
    raise CalibError(
        f"{sign!r}, {value!r} is no comparison", where="probability",
        expected=f'">" or "<", and a number in the unit of the output, or {n}, one for each row',
        hint='as in probability(">", 1.2)',
    )  # fmt: skip


def quantiles(draws: Array, levels: Levels, weight: Array | None = None) -> Array:
    """Quantiles of draws (size, n), shape (q, n); draws without a value are left out."""
    q = np.asarray(levels, dtype=np.float64)
    if not ((q > 0.0) & (q < 1.0)).all():
        raise CalibError(
            f"there is no quantile {levels}", where="quantile", expected="above 0 and below 1",
            hint="0.5 is the median, 0.05 and 0.95 hold 90 % between them",
        )  # fmt: skip
    if weight is not None:
        weight = np.broadcast_to(weight[:, None], draws.shape)
        found = np.quantile(draws, q, axis=0, weights=weight, method="inverted_cdf")
        return np.asarray(np.where(np.isnan(draws).any(axis=0), np.nan, found))
    with np.errstate(invalid="ignore"):  # of what no float holds
        found = np.quantile(draws, q, axis=0)
    if np.isnan(found).any():
        # A parameter vector for which the equation has no value there is left out, not spread;
        # where none has a value, neither have the bands.
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "All-NaN slice", RuntimeWarning)
            found = np.nanquantile(draws, q, axis=0)
    return np.asarray(found)
