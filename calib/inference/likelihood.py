"""How measurements scatter about their prediction, and what many parameter vectors make of them.

The sum of squared residuals. Rows taken at the same conditions share their prediction mu. Of m such
rows with mean m_y,

    sum (y - mu)^2 = sum (y - m_y)^2 + m (m_y - mu)^2,

so the model is evaluated once per distinct condition.

The density where the prediction is known with an error, a few curves B, (n, j), times independent
normals of one variance v. Residuals r are normal with the covariance sigma^2 I + v B B'. With
B'B = U diag(d) U', the same for all parameters, and a = U'B'r,

    ln N = -n ln sigma - 1/2 sum_i ln(1 + v d_i / sigma^2) - n/2 ln 2 pi
           - (r'r - sum_i a_i^2 v / (sigma^2 + v d_i)) / (2 sigma^2)

The noise. By default it is normal of one standard deviation sigma. A prior file may ask for

- Student-t noise: sigma is its scale, and the degrees of freedom nu are inferred;
- a noise that depends on a condition c: ln sigma(c) = ln sigma + sigma_slope (c - m)/s, with m and
  s the mean and the sd of the condition over the rows that are calibrated on;
- normal noise that is correlated along a run: readings that are k apart have the correlation rho^k,
  an autoregression of order one, of which rows may be missing (Box, Jenkins & Reinsel 2008, Time
  Series Analysis, section 3.2). Different runs are independent. Each row depends on the others
  through its two neighbours alone (Bürkner, Gabry & Vehtari 2021, doi:10.1007/s00180-020-01045-4).

Conditions that are known with an error (`calib.inference.condition_errors`) add to the variance of
normal noise.

Natural parameters are those of the model, then nu, sigma_slope and rho if they are there, then
sigma.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln, ndtr, ndtri, stdtr, stdtrit

from calib.data import Table
from calib.data.quantities import QUANTITIES
from calib.errors import CalibError
from calib.inference.condition_errors import ConditionError, Readings, Stated, errors_of
from calib.inference.constants import CHUNK_CELLS, HALF_LN_2PI
from calib.models.base import Array, BoundModel, Conditions, Model


def in_chunks(function: Callable[[Array], Array], vectors: Array, n_rows: int) -> Array:
    """Apply a function of parameter vectors (k, d) to a few at a time, to bound the memory."""
    at_once = max(1, CHUNK_CELLS // n_rows)
    parts = range(0, max(len(vectors), 1), at_once)
    return np.concatenate([function(vectors[i : i + at_once]) for i in parts])


@dataclass(frozen=True)
class SumOfSquares:
    """Sum of squared residuals of a bound model, or of readings, on fixed data.

    Parameters
    ----------
    conditions : mapping of str to ndarray, shape (m,)
        The distinct ones, with the mean response and the number of rows at each.
    within : float
        Sum of squares of the repeats about their means.
    """

    bound: BoundModel | Readings
    conditions: Conditions
    mean: Array
    repeats: Array
    within: float

    @classmethod
    def of(
        cls, bound: BoundModel | Readings, conditions: Conditions, response: Array
    ) -> SumOfSquares:
        """Arrange conditions and responses (n,) for a bound model."""
        distinct, code, count = np.unique(
            np.stack(list(conditions.values())), axis=1, return_inverse=True, return_counts=True
        )
        mean = np.bincount(code, response) / count
        within = float(np.square(response - mean[code]).sum())
        by_name = dict(zip(conditions, distinct, strict=True))
        return cls(bound, by_name, mean, count.astype(np.float64), within)

    def __call__(self, theta: Array) -> Array:
        """Evaluate natural parameters of the model, (k, d) to (k,); NaN where it has no value."""

        def between(some: Array) -> Array:
            return self.about(self.bound.mean_response(some, self.conditions))

        return in_chunks(between, theta, self.mean.size)

    def about(self, predicted: Array) -> Array:
        """Evaluate predictions (k, m) at the distinct conditions."""
        with np.errstate(all="ignore"):
            return np.asarray(self.within + np.square(predicted - self.mean) @ self.repeats)


def log_normal(residuals: Array, variance: Array, curves: Array, sigma: Array) -> Array:
    """Evaluate the log density of residuals (k, n), shape (k,); NaN where one is.

    The coefficients of the prediction's error, along curves (n, j), have a variance (k,), the noise
    has an sd (k,).
    """
    if not np.isfinite(curves).all():
        return np.full(len(residuals), np.nan)
    squares = np.einsum("kn,kn->k", residuals, residuals)
    bad = ~(np.isfinite(squares) & np.isfinite(variance) & (sigma > 0.0))
    scale = np.where(bad, 1.0, sigma)
    ratio = (np.where(bad, 0.0, variance) / scale**2)[:, None]
    sizes, axes = np.linalg.eigh(curves.T @ curves)
    along = np.where(bad[:, None], 0.0, residuals) @ (curves @ axes)
    grown = 1.0 + ratio * np.maximum(sizes, 0.0)
    taken = (along**2 * ratio / grown).sum(axis=1)
    value = -residuals.shape[1] * (np.log(scale) + HALF_LN_2PI)
    value -= 0.5 * (np.log(grown).sum(axis=1) + (squares - taken) / scale**2)
    return np.where(bad, np.nan, value)


def log_normal_of_each(residuals: Array, variance: Array, curves: Array, sigma: Array) -> Array:
    """Evaluate the same where curves (k, n, j) are of each vector's own."""
    squares = np.square(residuals).sum(axis=1) / sigma**2
    ratio = variance / sigma**2
    taken = np.einsum("knj,kn->kj", curves, residuals)
    grown = np.eye(curves.shape[2]) + ratio[:, None, None] * np.einsum(
        "kni,knj->kij", curves, curves
    )
    bad = ~(np.isfinite(grown).all(axis=(1, 2)) & np.isfinite(squares) & (sigma > 0.0))
    grown[bad] = np.eye(curves.shape[2])
    solved = np.linalg.solve(grown, taken[..., None])[..., 0]
    squares -= ratio / sigma**2 * (taken * solved).sum(axis=1)
    value = -residuals.shape[1] * (np.log(sigma) + HALF_LN_2PI)
    value -= 0.5 * (np.linalg.slogdet(grown)[1] + squares)
    return np.where(bad, np.nan, value)


type Family = Literal["normal", "student_t"]
type Along = Literal["", "run_order"]


# Read where a prior file chooses a noise and says nothing of its parameters.
DEFAULT_PRIORS = """
[nu]
dist = "gamma"
shape = 2.0
rate = 0.1
lower = 1.0
unit = "1"
reason = "From tails as heavy as Cauchy's, below which a prediction has no mean, to nearly normal"
source = "Juarez & Steel (2010), doi:10.1198/jbes.2009.07145"

[rho]
dist = "uniform"
lower = 0.0
upper = 0.99
unit = "1"
reason = "From independent rows to a noise that hardly changes in a hundred rows"
source = "This project: nothing is preferred"

[sigma_slope]
dist = "normal"
mean = 0.0
sd = 0.5
unit = "1"
reason = "Over conditions that are evenly spread, noise that changes by a factor of 1/6 to 6"
source = "This project: weak, and as ready to fall as to grow"
"""


@dataclass(frozen=True)
class Noise:
    """How measurements scatter, as a prior file asks for it.

    It may depend on a quantity, or its canonical column; empty for one scale at all conditions. In
    runs neighbours may be correlated; what they are counted in, or empty for independent rows. On
    data (`noise_of`), the column that the scale depends on, its mean and its sd are known too.

    It has the errors of conditions too: as stated, with set points; and as they are on data.
    """

    family: Family = "normal"
    depends_on: str = ""
    correlated_along: Along = ""
    column: str = ""
    centre: float = 0.0
    spread: float = 1.0
    stated: Stated | None = None
    set_points: tuple[str, ...] = ()
    errors: tuple[ConditionError, ...] = ()

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the noise's parameters beside sigma."""
        there = {
            "nu": self.student, "sigma_slope": self.depends_on, "rho": self.correlated_along,
        }  # fmt: skip
        return tuple(name for name, asked in there.items() if asked)

    @property
    def iid_normal(self) -> bool:
        """Whether it is independent and normal, of one standard deviation."""
        return not (self.parameters or self.errors)

    @property
    def of_errors(self) -> Noise:
        """Normal noise of one standard deviation, with the same errors of conditions."""
        return Noise(stated=self.stated, set_points=self.set_points, errors=self.errors)

    @property
    def student(self) -> bool:
        """Whether it is Student's."""
        return self.family == "student_t"

    def must_be_iid_normal(self, source: str, what: str) -> None:
        """Raise a CalibError unless it is, for what is worked out for that noise alone."""
        if not self.iid_normal:
            raise CalibError(
                f"{what} takes normal noise of one standard deviation only"
                + (", and no errors of conditions" if self.errors else ""),
                where=f"{source}, [likelihood]",
                hint="take this table out (or leave errors = {} alone in it: no errors), and fit "
                "again what was fitted with it",
            )

    def must_be_normal_of_one_sd(
        self, source: str, what: str = "a diagnosis", *, errors: bool = True
    ) -> None:
        """Raise a CalibError unless it is, but for correlation and, if they may be, errors."""
        plain = replace(self, correlated_along="", errors=() if errors else self.errors)
        plain.must_be_iid_normal(source, what)

    def scale(self, natural: Array, conditions: Mapping[str, Array]) -> Array:
        """Return the scale at conditions: natural parameters (k, d_all) to (k, 1) or (k, n)."""
        sigma = natural[:, -1:]
        if not self.column:
            return sigma
        z = (conditions[self.column] - self.centre) / self.spread
        # What exceeds all bounds is for the density to exclude.
        with np.errstate(over="ignore", invalid="ignore"):
            return np.asarray(sigma * np.exp(self.own("sigma_slope", natural) * z))

    def own(self, name: str, natural: Array) -> Array:
        """Return a parameter of the noise's own beside sigma, shape (k, 1)."""
        names = self.parameters
        j = natural.shape[1] - 1 - len(names) + names.index(name)
        return natural[:, j : j + 1]

    def draw(
        self, natural: Array, conditions: Mapping[str, Array], rng: np.random.Generator, n: int,
        serial: Serial | None = None,
    ) -> Array:  # fmt: skip
        """Draw the noise of n readings, in an order or none, for each vector, shape (k, n)."""
        z = rng.standard_normal((natural.shape[0], n))
        if serial is not None:
            z = serial.correlate(z, self.own("rho", natural))
        if self.student:
            nu = self.own("nu", natural)
            z *= np.sqrt(nu / rng.chisquare(np.broadcast_to(nu, z.shape)))
        return self.scale(natural, conditions) * z

    def of_normal(self, natural: Array, conditions: Mapping[str, Array], z: Array) -> Array:
        """Return the noise at the quantiles of standard normals z, (k, 1) to (k, 1) or (k, n)."""
        if self.student:
            # From the tail, where a probability near one would be rounded to it.
            z = -np.sign(z) * stdtrit(self.own("nu", natural), ndtr(-np.abs(z)))
        return np.asarray(self.scale(natural, conditions) * z)

    def log_density(self, residuals: Array, natural: Array, scale: Array) -> Array:
        """Log density of residuals (k, n) of a scale, each by itself; NaN where a residual is."""
        with np.errstate(all="ignore"):
            z = residuals / scale
            if not self.student:
                return np.asarray(-0.5 * z * z - np.log(scale) - HALF_LN_2PI)
            nu = self.own("nu", natural)
            half = 0.5 * (nu + 1.0)
            constant = gammaln(half) - gammaln(0.5 * nu) - 0.5 * np.log(np.pi * nu)
            return np.asarray(constant - np.log(scale) - half * np.log1p(z * z / nu))

    def normal_scores(self, residuals: Array, natural: Array, scale: Array) -> Array:
        """Residuals (k, n) as they would stand in standard normal noise: of the same quantile."""
        z = residuals / scale
        if not self.student:
            return np.asarray(z)
        return np.asarray(-np.sign(z) * ndtri(stdtr(self.own("nu", natural), -np.abs(z))))


IID_NORMAL = Noise()


def noise_of(noise: Noise, model: Model, table: Table, source: str) -> Noise:
    """Return a noise on the rows that are calibrated on.

    Raises
    ------
    CalibError
        If the noise is to depend on what is no condition of the model, or does not vary; as
        `errors_of` does, and if errors of conditions go with other noise than they can.
    """
    conditions = model.select(table.columns)
    errors = errors_of(noise.stated, noise.set_points, conditions, table, source)
    noise = replace(noise, errors=errors)
    if errors and (noise.student or noise.correlated_along):
        kind = "Student-t noise" if noise.student else "noise that is correlated along a run"
        raise CalibError(
            f"the error of {errors[0].column.quantity.word} cannot be allowed for in {kind}",
            where=f"{source}, [likelihood]", expected="independent normal noise",
            hint="take that noise out, or write errors = {} to leave the errors out",
        )  # fmt: skip
    if not noise.depends_on:
        return noise
    stems = {QUANTITIES[name].stem: name for name in conditions}
    column = ({name: name for name in conditions} | stems).get(noise.depends_on)
    where = f"{source}, [likelihood] noise_depends_on"
    if column is None:
        raise CalibError(
            f"the noise is to depend on {noise.depends_on!r}, which is no condition of the model",
            where=where, expected=", ".join(stems), hint="name one of these",
        )  # fmt: skip
    values = conditions[column]
    spread = float(values.std())
    if not spread > 1e-9 * float(np.abs(values).max()):
        raise CalibError(
            f"the noise is to depend on {QUANTITIES[column].word}, which is the same in all rows "
            "that are fitted",
            where=where, expected="a condition that varies", hint="leave noise_depends_on out",
        )  # fmt: skip
    return replace(noise, column=column, centre=float(values.mean()), spread=spread)


@dataclass(frozen=True)
class Serial:
    """Rows in the order in which they were measured.

    Parameters
    ----------
    order : ndarray of int, shape (n,)
        Rows of the table, run by run.
    gap : ndarray, shape (n,)
        How far each of these is from the one before, with which it has the correlation rho to this
        power; infinite for the first of a run.
    """

    order: NDArray[np.intp]
    gap: Array

    def __add__(self, other: Serial) -> Serial:
        """These rows, then others, of other runs."""
        return Serial(
            np.concatenate([self.order, self.order.size + other.order]),
            np.concatenate([self.gap, other.gap]),
        )

    @property
    def before_each(self) -> NDArray[np.intp]:
        """Place of the row before each, in the rows' order; of the first of a run, any."""
        before = np.empty_like(self.order)
        before[self.order] = np.where(np.isinf(self.gap), self.order, np.roll(self.order, 1))
        return before

    def before(self, z: Array, rho: Array) -> tuple[Array, Array]:
        """Mean and variance of each row given those before it, (k, n), in the rows' order.

        Parameters
        ----------
        z : ndarray, shape (k, n)
        rho : ndarray, shape (k, 1)
        """
        r, along = rho**self.gap, z[:, self.order]
        mean = np.zeros_like(along)
        mean[:, 1:] = r[:, 1:] * along[:, :-1]
        return self._back(mean), self._back(1.0 - r * r)

    def whitened(self, z: Array, rho: Array) -> tuple[Array, Array]:
        """Noise (k, n) as if it were independent, and the log of the sds that it is divided by."""
        mean, variance = self.before(z, rho)
        return (z - mean) / np.sqrt(variance), 0.5 * np.log(variance)

    def given_all_others(self, z: Array, rho: Array) -> tuple[Array, Array]:
        """Mean and variance of each row given all others, (k, n), in the rows' order."""
        r, along = rho**self.gap, z[:, self.order]
        after = np.column_stack([r[:, 1:], np.zeros(len(r))])
        left, right = 1.0 - r * r, 1.0 - after * after
        precision = 1.0 / left + after * after / right
        mean = np.zeros_like(along)
        mean[:, 1:] += (r / left)[:, 1:] * along[:, :-1]
        mean[:, :-1] += (after / right)[:, :-1] * along[:, 1:]
        return self._back(mean / precision), self._back(1.0 / precision)

    def correlate(self, z: Array, rho: Array) -> Array:
        """Turn independent standard normals (k, n) into noise that is correlated."""
        r, along = rho**self.gap, z[:, self.order]
        for i in range(1, along.shape[1]):
            own = np.sqrt(1.0 - r[:, i] ** 2)
            along[:, i] = r[:, i] * along[:, i - 1] + own * along[:, i]
        return self._back(along)

    def _back(self, along: Array) -> Array:
        out = np.empty_like(along)
        out[:, self.order] = along
        return out


def serial_of(along: Along, table: Table) -> Serial | None:
    """Return the order of a table's rows; None where they are independent.

    Parameters
    ----------
    along : {"", "run_order"}
        That column, in each ``run`` by itself where the table has this one. Rows that are missing
        leave a gap.

    Raises
    ------
    CalibError
        If there is no such column, or it does not say the order.
    """
    if not along:
        return None
    if along not in table:
        raise CalibError(
            f"the prior file asks for noise that is correlated along {along}, and the data have no "
            "such column",
            where=table.source, expected=f"a column {along}",
            hint="add the column, with whole numbers in the order of the measurement",
        )  # fmt: skip
    place, n = table[along], len(table)
    run = table["run"] if "run" in table else np.zeros(n)
    order = np.lexsort((place, run)).astype(np.intp)
    gap = np.full(n, np.inf)
    gap[1:] = np.where(np.diff(run[order]) == 0.0, np.diff(place[order]), np.inf)
    # An empty cell is neither.
    wrong = np.flatnonzero(~(gap >= 1.0) | np.isnan(place[order] + run[order]))
    if wrong.size:
        lines = sorted(table.lines[row] for row in order[np.union1d(wrong, wrong - 1)])
        raise CalibError(
            f"{table.header_of(along)} does not say in which order the rows of a run were "
            f"measured: see line{'s' if len(lines) > 1 else ''} "
            f"{', '.join(map(str, lines[:8]))}"
            f"{' and others' if len(lines) > 8 else ''}",
            where=table.source,
            expected="a whole number in every row, another one for each row of a run",
            hint="number the rows of each run as they were measured, and label the runs (run)",
        )  # fmt: skip
    return Serial(order, gap)
