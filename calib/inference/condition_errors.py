"""Conditions that are known with an error, and what a model predicts at them.

The error of a condition is normal, with a stated sd s. A *reading* x scatters about the true value.
Taken for it, x flattens what depends on it (attenuation), and so would any x that is as likely as
another. So true values are themselves normal over the rows, of mean m and variance t^2. Given its
reading one is normal, of mean m + L (x - m) and variance s^2 L with the reliability
L = t^2/(t^2 + s^2): regression calibration (Fuller 1987, Measurement Error Models,
doi:10.1002/9780470316665; Carroll et al. 2006, Measurement Error in Nonlinear Models,
doi:10.1201/9781420010138). The n readings tell m and their variance v with sds sqrt(v/n) and
v sqrt(2/(n - 1)): true values are off together, along two curves. About a *set point* x true values
scatter, with the variance s^2 (Berkson 1950, doi:10.1080/01621459.1950.10483349).

The response at a row has the mean and variance of the model's at one sd to either side of what is
expected (Gauss and Hermite's two points), but not beyond what the quantity can be.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from calib.data import Table
from calib.data.quantities import QUANTITIES, convert
from calib.data.table import Column, normal, parse_header
from calib.errors import CalibError
from calib.inference.constants import HALF_LN_2PI
from calib.models.base import Array, BoundModel, Conditions

# What a prior file states: column names with their units, and an sd or the column that has it.
type Stated = tuple[tuple[str, float | str], ...]
_SD = frozenset({"sd", "std", "stdev"})


@dataclass(frozen=True)
class ConditionError:
    """The error of a condition: one sd, or the column of the data that has it for each row.

    The column is the condition's, in the unit of the sd. Mean and variance are of the readings of
    the rows that are calibrated on, the true variance is that without the errors.
    """

    column: Column
    sd: float | str
    set_point: bool
    mean: float = 0.0
    variance: float = 1.0
    true_variance: float = 1.0
    rows: int = 2

    @property
    def name(self) -> str:
        """Canonical name of the condition."""
        return self.column.quantity.canonical

    @property
    def kind(self) -> str:
        """What the recorded value is."""
        return "set point" if self.set_point else "reading"

    @property
    def reliability(self) -> float:
        """Part of the variance of the recorded values that is of true differences."""
        return self.true_variance / self.variance

    def sds(self, table: Table) -> Array:
        """Return the sd of each row in the canonical unit, (n,); a CalibError if there is none."""
        sds, lines = np.full(len(table), np.nan), list(table.lines)
        own = table.extra.get(self.sd, ()) if isinstance(self.sd, str) else None
        cells = [str(self.sd)] * len(table) if own is None else own
        for i, cell in enumerate(cells):
            with suppress(ValueError):
                sds[i] = float(cell)
        wrong = np.flatnonzero(~((sds >= 0.0) & np.isfinite(sds)))
        if wrong.size:
            raise CalibError(
                f"no error of the {self.column.quantity.word} is stated",
                where=f"{table.source}, line {lines[wrong[0]]}, column {self.sd!r}",
                expected="one sd in each of at most 10,000 rows, with a decimal point",
                hint="fill it in, or state one number: errors = {column = sd} in the prior file",
            )  # fmt: skip
        found = convert(sds, self.column.unit, self.column.quantity.unit)
        return found * (1.0 - table[self.name]) ** 2 if self.column.kappa else found

    def on(self, table: Table, where: str) -> ConditionError:
        """Return the error on the rows calibrated on; a CalibError if these can be no readings."""
        x, n = table[self.name], len(table)
        if self.set_point:
            return self
        square = float(np.mean(self.sds(table) ** 2))
        levels, variance = np.unique(x), float(x.var(ddof=1)) if n > 1 else 0.0
        repeats = 2 * levels.size <= n and np.median(np.diff(levels)) > 2.0 * np.sqrt(square)
        # Less than twice its own sd above zero, the true variance is not known to be any.
        if repeats or not variance - square > 2.0 * square * np.sqrt(2.0 / max(n - 1, 1)):
            sd, spread = (self.column.words(np.sqrt(v)) for v in (square, variance))
            found = f"the values scatter by {spread}, hardly more than their error of {sd}"
            if repeats:
                found = f"{n} rows have {levels.size} values; readings off by {sd} do not repeat"
            stem = self.column.quantity.stem
            raise CalibError(
                f"{self.column.quantity.word}: {found}", where=where,
                expected="readings that vary by more than their error, or set points",
                hint=f'if the values were set, write set_points = ["{stem}"] under [likelihood]; '
                "else state the error of one reading, take a wider range, or leave the error out",
            )  # fmt: skip
        return replace(
            self, mean=float(x.mean()), variance=variance, true_variance=variance - square, rows=n
        )

    def at(self, table: Table) -> tuple[Array, Array, Array]:
        """Expected true values and their sds, (n,), and how they are off together, (n, 0 or 2)."""
        x, squares = table[self.name], self.sds(table) ** 2
        if self.set_point:
            return x, np.sqrt(squares), np.zeros((x.size, 0))
        kept = self.true_variance / (self.true_variance + squares)
        by_mean = (1.0 - kept) * np.sqrt(self.variance / self.rows)
        by_variance = (x - self.mean) * squares / (self.true_variance + squares) ** 2
        by_variance *= self.variance * np.sqrt(2.0 / (self.rows - 1))
        expected = self.mean + kept * (x - self.mean)
        return expected, np.sqrt(squares * kept), np.stack([by_mean, by_variance], axis=1)

    def words(self) -> str:
        """Say what was taken for the error, and of what kind."""
        size = f"that the column {self.sd} has"
        if not isinstance(self.sd, str):
            size = f"of {self.sd:g} {self.column.unit_word}".rstrip()
        said = f"{self.column.quantity.word} was {'set' if self.set_point else 'read'} with an "
        said += f"error {size} (sd), which the likelihood allows for"
        if self.set_point:
            return said
        return f"{said}; {self.reliability:.1%} of its variance is true variation"


def errors_of(
    stated: Stated | None, set_points: Sequence[str], conditions: Iterable[str], table: Table,
    source: str,
) -> tuple[ConditionError, ...]:  # fmt: skip
    """Return the errors of a model's conditions on the rows of a table.

    Where none are stated, those of columns that are named after a condition and ``sd``, as
    ``slip_percent_sd``. A CalibError tells what is no condition, or cannot be allowed for.
    """
    where = f"{source}, [likelihood] errors"
    able = [QUANTITIES[c] for c in conditions if not QUANTITIES[c].range.integer]
    named = {h: column for h in table.ignored if (column := _of_sd(h)) and column.quantity in able}
    if stated is None:
        stated = tuple((h, h) for h in named)
    found: dict[str, ConditionError] = {}
    for header, sd in stated:
        column = named.get(str(sd)) or parse_header(header, where=where)
        if column is None or column.quantity not in able or column.quantity.canonical in found:
            raise CalibError(
                f"an error of {header} is stated, which is no condition of the model or has one",
                where=where, expected=", ".join(q.canonical for q in able),
                hint="name each of these once, with its unit",
            )  # fmt: skip
        q = column.quantity
        error = ConditionError(column, sd, not {q.stem, q.canonical}.isdisjoint(set_points))
        if error.sds(table).any():
            found[q.canonical] = error.on(table, where)
    set_ones = {n for e in found.values() for n in (e.name, e.column.quantity.stem)}
    if strange := {*set_points} - set_ones:
        raise CalibError(
            f"{min(strange)} is said to be a set point, but no error of it is stated",
            where=f"{source}, [likelihood] set_points", expected="errors = {column = sd}, too",
            hint="state its error, or leave it out of the set points",
        )  # fmt: skip
    return tuple(found.values())


def _of_sd(header: str) -> Column | None:
    """Return the quantity that a column name has the sd of, with its unit."""
    words = normal(header).split("_")
    if not _SD.isdisjoint(words):
        with suppress(CalibError):  # without a unit
            return parse_header("_".join(word for word in words if word not in _SD))
    return None


@dataclass(frozen=True)
class Readings:
    """A model at rows whose conditions are known with an error.

    Parameters
    ----------
    around : mapping of str to ndarray, shape (n,)
        The model's conditions as they are expected; and of each that has an error the values one
        sd to either side, its name being followed by a sign.
    columns : tuple of str
        Conditions that have an error.
    together : tuple of ndarray, shape (n, 0 or 2)
        How far the true values of each may be off together: one sd along each curve.
    """

    bound: BoundModel
    around: Conditions
    columns: tuple[str, ...]
    together: tuple[Array, ...]

    @classmethod
    def of(cls, bound: BoundModel, errors: Sequence[ConditionError], table: Table) -> Readings:
        """Return the rows of a table; a CalibError if one may be what its quantity cannot be."""
        around, together = bound.model.select(table.columns), []
        for error in errors:
            allowed = error.column.quantity.range
            middle, sd, curves = error.at(table)
            around[error.name] = middle
            around[f"{error.name}-"] = low = np.maximum(middle - sd, allowed.low)
            around[f"{error.name}+"] = np.minimum(middle + sd, allowed.high)
            together.append(curves)
            if not allowed.holds(low).all():
                line = table.lines[int(np.argmin(low))]
                raise CalibError(
                    f"the {error.column.quantity.word} there is not larger than its error",
                    where=f"{table.source}, line {line}", expected=error.column.expected,
                    hint="correct the error, or leave the row out",
                )  # fmt: skip
        return cls(bound, around, tuple(e.name for e in errors), tuple(together))

    @property
    def conditions(self) -> dict[str, Array]:
        """The model's conditions as they are expected, shape (n,) each."""
        return {name: self.around[name] for name in self.bound.model.conditions}

    @property
    def size(self) -> int:
        """Number of conditions at which the model is evaluated."""
        return (1 + 2 * len(self.columns)) * next(iter(self.around.values())).size

    def _at(self, theta: Array, around: Conditions) -> tuple[Array, Array]:
        """Mean response (k, n) of rows, and by how much one sd changes it, (k, c, n)."""
        ends = [""] + [f"{c}{sign}" for c in self.columns for sign in "-+"]
        names = self.bound.model.conditions
        at = {n: np.concatenate([around[e if e[:-1] == n else n] for e in ends]) for n in names}
        every = self.bound.mean_response(theta, at)
        every = every.reshape(len(every), len(ends), -1)
        low, high = every[:, 1::2], every[:, 2::2]
        mean = (1 - len(self.columns)) * every[:, 0] + 0.5 * (low + high).sum(axis=1)
        return mean, 0.5 * (high - low)

    def mean_response(self, theta: Array, conditions: Conditions) -> Array:
        """Mean response (k, n) at rows of `around` of the model's parameters (k, d)."""
        return self._at(theta, conditions)[0]

    def moments(self, theta: Array) -> tuple[Array, Array, Array]:
        """Mean response and what errors add to its variance, (k, n), and its curves (k, n, j)."""
        mean, change = self._at(theta, self.around)
        width = np.stack([self.around[f"{c}+"] - self.around[f"{c}-"] for c in self.columns])
        slope = 2.0 * change / np.where(width > 0.0, width, 1.0)
        curves = [slope[:, i, :, None] * curve for i, curve in enumerate(self.together)]
        return mean, np.square(change).sum(axis=1), np.concatenate(curves, axis=2)


def log_density(residuals: Array, variance: Array, curves: Array) -> Array:
    """Log density (k,) of normal residuals, variances (k, n), that are off along curves (k, n, j).

    Of their covariance diag(variance) + B B' the determinant and the inverse follow from those of
    I + B' diag(1/variance) B (Woodbury).
    """
    inner, scaled = _inner(variance, curves)
    pull = scaled @ residuals[..., None]
    squares = (residuals**2 / variance).sum(axis=1)
    squares -= (pull * np.linalg.solve(inner, pull)).sum(axis=(1, 2))
    ln_det = np.log(variance).sum(axis=1) + np.linalg.slogdet(inner)[1]
    return np.asarray(-0.5 * (squares + ln_det) - residuals.shape[1] * HALF_LN_2PI)


def given_all_others(residuals: Array, variance: Array, curves: Array) -> tuple[Array, Array]:
    """Mean and variance (k, n) of each of these residuals given all others."""
    inner, scaled = _inner(variance, curves)
    solved = np.linalg.solve(inner, np.dstack([scaled @ residuals[..., None], scaled]))
    weighted = residuals / variance - np.einsum("kjn,kj->kn", scaled, solved[..., 0])
    precision = 1.0 / variance - np.einsum("kjn,kjn->kn", scaled, solved[..., 1:])
    return residuals - weighted / precision, 1.0 / precision


def _inner(variance: Array, curves: Array) -> tuple[Array, Array]:
    """Return I + B' D^-1 B, (k, j, j), and B' D^-1, (k, j, n)."""
    scaled, eye = (curves / variance[..., None]).swapaxes(1, 2), np.eye(curves.shape[2])
    inner = eye + scaled @ curves
    return np.where(np.isfinite(inner).all(axis=(1, 2), keepdims=True), inner, eye), scaled
