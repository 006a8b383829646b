"""Conditions that are known with an error, and what a model predicts at them.

The error of a condition is normal, with a stated sd s. A *reading* x scatters about the true value
u. Taken for the true value it flattens what depends on it (attenuation), and a flat prior on u does
not help. So u is itself taken as normal over the rows, of mean m and variance t^2. Given a reading
it is then normal, with the reliability L = t^2/(t^2 + s^2), mean m + L (x - m) and variance s^2 L:
regression calibration (Fuller 1987, Measurement Error Models, doi:10.1002/9780470316665; Carroll,
Ruppert, Stefanski & Crainiceanu 2006, Measurement Error in Nonlinear Models,
doi:10.1201/9781420010138). Of a *set point* x the true value scatters about x, with the variance
s^2 (Berkson 1950, doi:10.1080/01621459.1950.10483349).

Readings have the mean m and the variance v = t^2 + s^2, which n rows tell with sds sqrt(v/n) and
v sqrt(2/(n - 1)). So all true values are off together, along two curves for each condition.

A prediction f at a row has the mean and the variance of f at one sd to either side of the expected
value, a quadrature that is exact for a mean of f up to cubics. Beyond what a quantity can be no
true value is taken.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.data import Table
from calib.data.quantities import QUANTITIES, convert
from calib.data.table import Column, normal, parse_header
from calib.errors import CalibError
from calib.inference.constants import HALF_LN_2PI
from calib.models.base import Array, BoundModel, Conditions

# Of a prior file: what has an error, by a column name with its unit, and its sd or the column that
# has it for each row.
type Stated = tuple[tuple[str, float | str], ...]
_SD = frozenset({"sd", "std", "stdev"})


@dataclass(frozen=True)
class ConditionError:
    """The error of a condition, on data.

    Parameters
    ----------
    column : Column
        The condition, in the unit of the sd.
    sd : float or str
        One number, or the column of the data that has it for each row.
    set_point : bool
        Whether the true value scatters about the recorded one, and not the other way round.
    mean, variance : float
        Of the readings of the rows that are calibrated on.
    true_variance : float
        Of the true values there.
    rows : int
        Number of these rows.
    """

    column: Column
    sd: float | str
    set_point: bool
    mean: float = 0.0
    variance: float = 0.0
    true_variance: float = 0.0
    rows: int = 0

    @property
    def name(self) -> str:
        """Canonical name of the condition."""
        return self.column.quantity.canonical

    @property
    def reliability(self) -> float:
        """Part of the variance of the recorded values that is of true differences."""
        return 1.0 if self.set_point else self.true_variance / self.variance

    def sds(self, table: Table) -> Array:
        """Return the stated sd of each row in the canonical unit, shape (n,).

        Raises
        ------
        CalibError
            If the data have no such column, or no sd in a row of it.
        """
        cells = (str(self.sd),) * len(table)
        if isinstance(self.sd, str):
            if self.sd not in table.extra:
                raise CalibError(
                    f"the errors of {self.column.quantity.word} are to be in the column "
                    f"{self.sd!r}, which is not there",
                    where=table.source, expected=", ".join(table.extra) or "such a column",
                    hint="add the column (to at most 10,000 rows), or state one number",
                )  # fmt: skip
            cells = table.extra[self.sd]
        written = np.array([_number(cell) for cell in cells])
        wrong = np.flatnonzero(~((written >= 0.0) & np.isfinite(written)))
        if wrong.size:
            raise CalibError(
                f"the error is {cells[wrong[0]]!r}",
                where=f"{table.source}, line {table.lines[wrong[0]]}, column {self.sd!r}",
                expected="one sd: a number of at least 0, with a decimal point",
                hint="fill it in, or state one number in the prior file",
            )  # fmt: skip
        found = convert(written, self.column.unit, self.column.quantity.unit)
        return found * (1.0 - table[self.name]) ** 2 if self.column.kappa else found

    def on(self, table: Table, where: str) -> ConditionError:
        """Return the error on the rows that are calibrated on.

        Raises
        ------
        CalibError
            If readings hardly vary by more than their errors, or are set points.
        """
        x, squares = table[self.name], self.sds(table) ** 2
        if self.set_point:
            return self
        word, n = self.column.quantity.word, x.size
        stem = self.column.quantity.stem
        levels = np.unique(x)
        apart = float(np.median(np.diff(levels))) if levels.size > 1 else np.inf
        sd = float(np.sqrt(np.mean(squares)))
        if 2 * levels.size <= n and apart > 2.0 * sd:
            raise CalibError(
                f"{word} has {levels.size} different values in {n} rows, typically "
                f"{self.column.words(apart)} apart; readings with an error of "
                f"{self.column.words(sd)} (sd) do not repeat",
                where=where, expected="readings, or set points that are said to be such",
                hint=f'write set_points = ["{stem}"] under [likelihood] if the true value scatters '
                "about what was set; if the readings were averaged or rounded, leave the error out",
            )  # fmt: skip
        variance = float(x.var(ddof=1)) if n > 1 else 0.0
        true = variance - float(np.mean(squares))
        if not true > 2.0 * float(np.mean(squares)) * np.sqrt(2.0 / max(n - 1, 1)):
            raise CalibError(
                f"the readings of {word} scatter by {self.column.words(np.sqrt(variance))} (sd), "
                f"hardly more than their error of {self.column.words(sd)}: what depends on it "
                "cannot be told",
                where=where, expected="readings that vary by more than their error",
                hint="take rows over a wider range, state the error of one reading (not the spread "
                f'of all), or write set_points = ["{stem}"] if the values were set',
            )  # fmt: skip
        return replace(self, mean=float(x.mean()), variance=variance, true_variance=true, rows=n)

    def at(self, table: Table) -> tuple[Array, Array, Array]:
        """Expected true values and their sds, (n,), and how they are off together, (n, 0 or 2)."""
        x, squares = table[self.name], self.sds(table) ** 2
        if self.set_point:
            return x, np.sqrt(squares), np.zeros((x.size, 0))
        kept = self.true_variance / (self.true_variance + squares)
        by_variance = (x - self.mean) * squares / (self.true_variance + squares) ** 2
        together = (
            (1.0 - kept) * np.sqrt(self.variance / self.rows),
            by_variance * self.variance * np.sqrt(2.0 / (self.rows - 1)),
        )
        expected = self.mean + kept * (x - self.mean)
        return expected, np.sqrt(squares * kept), np.stack(together, axis=1)

    def words(self) -> str:
        """Say what was taken for the error, and of what kind."""
        word = self.column.quantity.word
        size = f"as the column {self.sd} has it"
        if not isinstance(self.sd, str):
            size = f"of {self.sd:g} {self.column.unit_word}".rstrip()
        if self.set_point:
            return f"{word} was set with an error {size} (sd), which the likelihood allows for"
        return (
            f"{word} was read with an error {size} (sd), which the likelihood allows for: "
            f"{self.reliability:.3g} of the readings' variance is of true differences"
        )


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return float("nan")


def errors_of(
    stated: Stated | None,
    set_points: Sequence[str],
    conditions: Iterable[str],
    table: Table,
    source: str,
) -> tuple[ConditionError, ...]:
    """Return the errors of a model's conditions on the rows of a table.

    Where none are stated, those in columns of the table that are named after a condition and
    ``sd``, as ``slip_percent_sd``.

    Raises
    ------
    CalibError
        If an error is stated of what is no condition, or cannot be allowed for.
    """
    where = f"{source}, [likelihood] errors"
    able = {
        c: QUANTITIES[c] for c in conditions if c in QUANTITIES and not QUANTITIES[c].range.integer
    }
    named = {h: column for h in table.ignored if (column := _of_sd(h)) is not None}
    by_column = [(h, h) for h, column in named.items() if column.quantity.canonical in able]
    found: dict[str, ConditionError] = {}
    for header, sd in by_column if stated is None else stated:
        column = named.get(str(sd)) or parse_header(header, where=where)
        if column is None or column.quantity.canonical not in able:
            raise CalibError(
                f"an error of {header} is stated, which is no condition of the model",
                where=where, expected=", ".join(able), hint="name one of these, with its unit",
            )  # fmt: skip
        name, stem = column.quantity.canonical, column.quantity.stem
        if name in found:
            raise CalibError(
                f"the error of {column.quantity.word} is stated twice", where=where,
                hint="leave one of the two out",
            )  # fmt: skip
        set_point = not {name, stem}.isdisjoint(set_points)
        error = ConditionError(column, sd, set_point)
        if error.sds(table).any():
            found[name] = error.on(table, where)
    known = {*found} | {able[name].stem for name in found}
    if strange := [name for name in set_points if name not in known]:
        raise CalibError(
            f"{strange[0]} is said to be a set point, but no error of it is stated",
            where=f"{source}, [likelihood] set_points",
            expected=", ".join(able[name].stem for name in found) or "errors = {column = sd}",
            hint="state its error, or leave it out of the set points",
        )  # fmt: skip
    return tuple(found.values())


def _of_sd(header: str) -> Column | None:
    """Return the quantity that a column name has the sd of, with its unit."""
    words = normal(header).split("_")
    if _SD.isdisjoint(words):
        return None
    try:
        return parse_header("_".join(word for word in words if word not in _SD))
    except CalibError:  # without a unit
        return None


@dataclass(frozen=True)
class Readings:
    """A model at rows whose conditions are known with an error.

    Parameters
    ----------
    bound : BoundModel
    around : mapping of str to ndarray, shape (n,)
        The model's conditions as they are expected; and of each that has an error the values
        between which it is likely, its name being followed by a sign.
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
            if allowed.low_open and (middle - sd <= allowed.low).any():
                line = table.lines[int(np.argmin(middle - sd))]
                raise CalibError(
                    f"the {error.column.quantity.word} there is not larger than its error",
                    where=f"{table.source}, line {line}", expected=error.column.expected,
                    hint="correct the error, or leave the row out",
                )  # fmt: skip
            around[error.name] = middle
            around[f"{error.name}-"] = np.maximum(middle - sd, allowed.low)
            around[f"{error.name}+"] = np.minimum(middle + sd, allowed.high)
            together.append(curves)
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
        """Mean response (k, n) of rows, and by how much their errors change it, (k, c, n)."""
        ends = [""] + [f"{c}{sign}" for c in self.columns for sign in "-+"]
        names = self.bound.model.conditions
        at = {n: np.concatenate([around[e if e[:-1] == n else n] for e in ends]) for n in names}
        every = self.bound.mean_response(theta, at)
        every = every.reshape(len(every), len(ends), -1)
        low, high = every[:, 1::2], every[:, 2::2]
        mean = (1 - len(self.columns)) * every[:, 0] + 0.5 * (low + high).sum(axis=1)
        return mean, 0.5 * (high - low)

    def mean_response(self, theta: Array, conditions: Conditions) -> Array:
        """Mean response (k, n) at rows `around`, some or all, of the model's parameters (k, d)."""
        return self._at(theta, conditions)[0]

    def moments(self, theta: Array) -> tuple[Array, Array, Array]:
        """Mean response and what the errors add to its variance, (k, n), with curves (k, n, j).

        The curves are by how much the responses are off together.
        """
        mean, change = self._at(theta, self.around)
        width = np.stack([self.around[f"{c}+"] - self.around[f"{c}-"] for c in self.columns])
        slope = 2.0 * change / np.where(width > 0.0, width, 1.0)
        curves = [slope[:, i, :, None] * curve for i, curve in enumerate(self.together)]
        return mean, np.square(change).sum(axis=1), np.concatenate(curves, axis=2)


def log_density(residuals: Array, variance: Array, curves: Array) -> Array:
    """Log density (k,) of normal residuals, variances (k, n), that are off along curves (k, n, j).

    Their covariance is diag(variance) + B B', whose determinant and inverse follow from those of
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
    pull = scaled @ residuals[..., None]
    solved = np.linalg.solve(inner, np.concatenate([pull, scaled], axis=2))
    weighted = residuals / variance - np.einsum("kjn,kj->kn", scaled, solved[..., 0])
    precision = 1.0 / variance - np.einsum("kjn,kjn->kn", scaled, solved[..., 1:])
    return residuals - weighted / precision, 1.0 / precision


def _inner(variance: Array, curves: Array) -> tuple[Array, Array]:
    """Return I + B' D^-1 B (k, j, j), and B' D^-1 (k, j, n)."""
    scaled = (curves / variance[..., None]).swapaxes(1, 2)
    eye = np.eye(curves.shape[2])
    inner = eye + scaled @ curves
    return np.where(np.isfinite(inner).all(axis=(1, 2), keepdims=True), inner, eye), scaled
