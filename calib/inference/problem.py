"""Whether data are of a size that priors can say, before any work goes into them.

A problem: data, model, priors and likelihood as one log density over parameter vectors.

The likelihood: rows are independent, and on the scale of the model's response (the output itself,
or its logarithm for rut depth) each is normal about the prediction with one unknown standard
deviation sigma,

    ln L = -n ln sigma - SSE(theta)/(2 sigma^2) - (n/2) ln 2 pi  [- sum ln y for a log response],

the bracket making it a density of the output itself, so that models can be compared. A prior file
may ask for other noise (`calib.inference.likelihood`), which is evaluated row by row. Where the
prediction has an error of its own, that of an emulator, its covariance over the rows is added to
that of the noise (`calib.inference.likelihood`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from os import PathLike
from pathlib import Path

import numpy as np

from calib.arguments import takes
from calib.data import Table, as_table, check_enough, check_settings, check_varies
from calib.data.checks import check_units
from calib.data.files import plain_number
from calib.data.quantities import QUANTITIES
from calib.data.reader import Tabular
from calib.data.table import accepted_headers
from calib.errors import CalibError
from calib.inference.condition_errors import Readings, given_all_others, log_density
from calib.inference.constants import HALF_LN_2PI
from calib.inference.likelihood import (
    IID_NORMAL,
    Noise,
    Serial,
    SumOfSquares,
    in_chunks,
    log_normal,
    log_normal_of_each,
    noise_of,
    serial_of,
)
from calib.inference.prior_files import (
    DeclaredPriors,
    PriorFile,
    default_priors,
    inheritance_note,
    read_priors,
    relative_columns,
)
from calib.inference.priors import Priors, prior_references
from calib.inference.random import generator
from calib.models import Array, BoundModel, Conditions, Model, get_model
from calib.models.simulators.declaration import simulated_by


def check_scale(problem: Problem, assumed: Mapping[str, float]) -> None:
    """Raise a CalibError if the output is of a size that the priors exclude.

    Where they rest on an assumed value any size beyond what they admit tells against that. Where
    they do not, they may be wrong too, which is said after a fit: refused is what is beyond them by
    an order of magnitude.

    Parameters
    ----------
    problem : Problem
    assumed : mapping of str to float
        Columns that the priors are relative to and the data lack, with what was assumed.
    """
    low, high = _expected(problem)
    column = problem.table.column(problem.bound.model.output)
    size = float(np.quantile(np.abs(problem.observed), 0.9))
    slack = 1.0 if assumed else 10.0
    # Of a column of zeros the size tells nothing.
    if not np.isfinite([low, high]).all() or low / slack <= size <= high * slack or size == 0.0:
        return
    written = [plain_number(float(column.written(x))) for x in (low, high, size)]
    unit = f" {column.unit_word}".rstrip()
    found = (
        f"nine tenths of the {column.quantity.word}s are at most {written[2]}{unit} in size, and "
        f"the priors of {problem.bound.model.name} expect {written[0]} to {written[1]}{unit}"
    )
    if not assumed:
        relative = relative_columns(problem.priors.text) if problem.priors.text else {}
        used = dict.fromkeys(
            [problem.bound.model.output, *relative, *problem.bound.model.conditions]
        )
        raise CalibError(
            found, where=f"{problem.table.source}, column {column.header!r}",
            expected="an output of a size that the priors admit",
            hint=f"check the units of {', '.join(map(problem.table.header_of, used))}; if they are "
            "right, pass a prior file of your own that admits it (`calib priors "
            f"{problem.bound.model.name}` writes one to edit)",
        )  # fmt: skip
    taken = ", ".join(f"{QUANTITIES[n].word} {_with_unit(n, v)}" for n, v in assumed.items())
    raise CalibError(
        f"there is no column {', '.join(assumed)}; {taken} was assumed, but {found}",
        where=problem.table.source,
        expected="; ".join(", ".join(accepted_headers(QUANTITIES[name])) for name in assumed),
        hint=f"add the column {', '.join(assumed)}; if its values are not known, pass a prior file "
        "whose entries are not relative to it",
    )


def _with_unit(name: str, value: float) -> str:
    return f"{value:g} {QUANTITIES[name].unit_word}".rstrip()


def _expected(problem: Problem) -> tuple[float, float]:
    """Return between which values the priors expect the size of the output."""
    table = problem.table
    rows = np.linspace(0, len(table) - 1, min(len(table), 50)).astype(np.int64)
    some = problem.with_table(table.take(rows))
    rng = generator(0, "scale of the priors")
    with np.errstate(all="ignore"):
        natural = some.theta(some.priors.sample(rng, 2_000))
        drawn = some.draw_mean_response(natural, some.conditions, rng) + some.draw_noise(
            natural, rng
        )
        sizes = np.quantile(np.abs(some.bound.from_response(drawn)), 0.9, axis=1)
    sizes = sizes[np.isfinite(sizes)]
    if sizes.size < 1_000:
        return np.nan, np.nan
    low, high = np.quantile(sizes, [5e-4, 1.0 - 5e-4])
    return float(low), float(high)


# Mean and variance of each row given others.
type _Given = Callable[[Serial, Array, Array], tuple[Array, Array]]


@dataclass(frozen=True, repr=False)
class Problem:
    """Calibration data, a bound model and priors.

    Parameters
    ----------
    bound : BoundModel
        The model at its reference conditions.
    table : Table
        The calibration data.
    priors : Priors
        Of the model's parameters, others of the noise and its scale ``sigma``, in this order.
    notes : tuple of str
        What a reader must know about how the problem was set up.
    noise : Noise
        How a measurement scatters; normal of one standard deviation by default.
    """

    bound: BoundModel
    table: Table
    priors: Priors
    notes: tuple[str, ...] = ()
    noise: Noise = IID_NORMAL

    def __repr__(self) -> str:
        """Name the model, and say how many rows and free parameters there are."""
        rows, free = len(self.table), ", ".join(self.names)
        return f"<Problem of {self.bound.model.name} on {rows} rows; free: {free}>"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free parameters, the internal coordinates' order."""
        return self.priors.names

    @property
    def n_dim(self) -> int:
        """Number of free parameters."""
        return len(self.names)

    @cached_property
    def readings(self) -> Readings | None:
        """The rows, where conditions are known with an error."""
        errors = self.noise.errors
        return Readings.of(self.bound, errors, self.table) if errors else None

    @cached_property
    def conditions(self) -> dict[str, Array]:
        """The model's conditions, each of shape (n,); of those with an error what is expected."""
        recorded = self.bound.model.select(self.table.columns)
        return recorded if self.readings is None else self.readings.conditions

    @cached_property
    def observed(self) -> Array:
        """The measured output, shape (n,)."""
        return self.table[self.bound.model.output]

    @cached_property
    def response(self) -> Array:
        """The measured output on the scale of the response, shape (n,)."""
        return self.bound.to_response(self.observed)

    @cached_property
    def _ln_jacobian(self) -> Array:
        log = self.bound.model.response == "log"
        return -self.response if log else np.zeros_like(self.response)

    @property
    def heavy(self) -> bool:
        """Whether a measurement has no mean: a Student-t logarithm, of whatever degrees."""
        return self.noise.student and self.bound.model.response == "log"

    @cached_property
    def squares(self) -> SumOfSquares:
        """Sums of squared residuals, on the scale of the response, of natural parameters."""
        return SumOfSquares.of(*self._predictor, self.response)

    @cached_property
    def _predictor(self) -> tuple[BoundModel | Readings, Conditions]:
        """What has the mean response, and the conditions that it is asked for."""
        rows = self.readings
        return (self.bound, self.conditions) if rows is None else (rows, rows.around)

    @cached_property
    def serial(self) -> Serial | None:
        """The order of the rows, where their noise is correlated along it."""
        return serial_of(self.noise.correlated_along, self.table)

    def theta(self, t: Array) -> Array:
        """Natural parameters, sigma last, of internal ones: (k, n_dim) to (k, d_all)."""
        return self.priors.to_natural(t)

    def of_model(self, natural: Array) -> Array:
        """Return the model's part of natural parameters, shape (k, d_model)."""
        return natural[:, : len(self.bound.model.parameters)]

    def completed(self, theta: Array, sigma: float) -> Array:
        """Return natural parameters (d_all,) of the model's and a scale of the noise.

        What else the noise has is taken where its prior is.
        """
        prior = self.priors.to_natural(np.array([[p.loc for p in self.priors.free]]))[0]
        return np.concatenate([theta, prior[theta.size : -1], [sigma]])

    def residuals(self, natural: Array) -> Array:
        """Observed minus predicted on the scale of the response, shape (k, n)."""
        predictor, at = self._predictor

        def observed_minus_predicted(some: Array) -> Array:
            return self.response - predictor.mean_response(self.of_model(some), at)

        return in_chunks(observed_minus_predicted, natural, self.response.size)

    def scale(self, natural: Array) -> Array:
        """Return the scale of the rows' residuals, errors of conditions in it, (k, n or 1)."""
        scale = self.noise.scale(natural, self.conditions)
        if self.readings is None:
            return scale
        return np.hypot(scale, np.sqrt(self.readings.moments(self.of_model(natural))[1]))

    def _with_errors(self, readings: Readings, some: Array) -> tuple[Array, Array, Array]:
        """Residuals and their variances, (k, n), and what they are off along, (k, n, j)."""
        mean, added, curves = readings.moments(self.of_model(some))
        scale = self.noise.scale(some, self.conditions)
        # No scale is negative.
        variance = np.where(scale > 0.0, scale**2, np.nan) + added
        return self.response - mean, variance, curves

    def draw_mean_response(
        self, natural: Array, conditions: Conditions, rng: np.random.Generator
    ) -> Array:
        """Predict on the scale of the response, with a draw of the prediction's own error.

        Parameters
        ----------
        natural : ndarray, shape (k, d_all)
        conditions : mapping of str to ndarray, shape (n,)
        rng : Generator
            Used for an emulator only. Its error is one curve for all rows, the same whichever
            rows are asked for together.

        Returns
        -------
        ndarray, shape (k, n)
        """
        theta, uncertain = self.of_model(natural), self.bound.model.uncertain
        if uncertain is None:
            return self.bound.mean_response(theta, conditions)
        with np.errstate(all="ignore"):
            location, unknown, curves = uncertain(theta, conditions)
            error = rng.standard_normal((len(theta), curves.shape[1])) @ curves.T
            return np.asarray(location + np.sqrt(unknown)[:, None] * error)

    def log_likelihood(self, t: Array, predicted: Array | None = None) -> Array:
        """Log likelihood of internal coordinates, shape (k,); ``-inf`` where undefined.

        `predicted` are mean responses (k, m) that are known, at the conditions of `squares`.
        """
        natural, model = self.theta(t), self.bound.model
        n, sigma = self.response.size, natural[:, -1]
        # A prior may admit sigma <= 0 or predictions beyond all bounds: they become -inf below.
        with np.errstate(all="ignore"):
            if model.uncertain is not None:
                predicted, unknown, curves = model.uncertain(
                    self.of_model(natural), self.conditions
                )
                off = self.response - predicted
                if self.serial is None:
                    value = log_normal(off, unknown, curves, sigma)
                else:
                    value = self._log_serial(self.serial, off, unknown, curves, natural)
            elif self.noise.iid_normal:
                sse = (
                    self.squares(self.of_model(natural))
                    if predicted is None
                    else self.squares.about(predicted)
                )
                value = -n * (np.log(sigma) + HALF_LN_2PI) - 0.5 * sse / sigma**2
            elif (rows := self.readings) is not None:
                value = in_chunks(
                    lambda some: log_density(*self._with_errors(rows, some)), natural, rows.size
                )
            else:
                value = in_chunks(
                    lambda some: self._log_densities(some, Serial.before).sum(axis=1), natural, n
                )
        value += self._ln_jacobian.sum()
        return np.where(np.isfinite(value), value, -np.inf)

    def _log_serial(
        self, serial: Serial, off: Array, unknown: Array, curves: Array, natural: Array
    ) -> Array:
        """Log likelihood of an emulator's residuals (k, n) where the noise is correlated, (k,)."""
        rho, value = self.noise.own("rho", natural), np.empty(len(off))
        for i in np.array_split(np.arange(len(off)), 1 + off.size * (1 + curves.shape[1]) // 10**6):
            z, ln_sd = serial.whitened(off[i], rho[i])
            own = [serial.whitened(np.tile(c, (i.size, 1)), rho[i])[0] for c in curves.T]
            value[i] = log_normal_of_each(z, unknown[i], np.stack(own, axis=2), natural[i, -1])
            value[i] -= ln_sd.sum(axis=1)
        return value

    def _log_densities(self, natural: Array, given: _Given) -> Array:
        """Log density of the noise of every row given others, where it is correlated, (k, n)."""
        residuals, serial = self.residuals(natural), self.serial
        if serial is None:
            return self.noise.log_density(residuals, natural, self.scale(natural))
        with np.errstate(all="ignore"):
            scale = self.noise.scale(natural, self.conditions)
            z = residuals / scale
            mean, variance = given(serial, z, self.noise.own("rho", natural))
            squared = (z - mean) ** 2 / variance
            return -0.5 * (squared + np.log(variance)) - np.log(scale) - HALF_LN_2PI

    def log_likelihood_left_out(self, t: Array) -> Array:
        """Log density of every row given all others and the parameters, shape (k, n)."""
        if (rows := self.readings) is not None:
            residuals, *of = self._with_errors(rows, natural := self.theta(t))
            with np.errstate(all="ignore"):
                mean, variance = given_all_others(residuals, *of)
            scale = np.sqrt(variance)
            return self.noise.log_density(residuals - mean, natural, scale) + self._ln_jacobian
        if self.serial is None:
            return self.log_likelihood_rows(t)
        return self._log_densities(self.theta(t), Serial.given_all_others) + self._ln_jacobian

    def draw_noise(self, natural: Array, rng: np.random.Generator, *, apart: bool = False) -> Array:
        """Draw the noise of the rows, or of each by itself (`apart`), for each vector, (k, n).

        It has in it what errors of conditions make of the prediction.
        """
        n, serial = self.response.size, None if apart else self.serial
        if self.readings is not None:
            theta, z = self.of_model(natural), rng.standard_normal((len(natural), n))
            mean, _, curves = self.readings.moments(theta)
            noise = mean - self.bound.mean_response(theta, self.conditions)
            noise += self.scale(natural) * z
            off = rng.standard_normal((len(natural), curves.shape[2], 1))
            return noise if apart else noise + (curves @ off)[..., 0]
        return self.noise.draw(natural, self.conditions, rng, n, serial)

    def log_likelihood_rows(self, t: Array) -> Array:
        """Log likelihood of every row by itself, shape (k, n)."""
        natural, uncertain = self.theta(t), self.bound.model.uncertain
        if uncertain is None:
            residuals, scale = self.residuals(natural), self.scale(natural)
            return self.noise.log_density(residuals, natural, scale) + self._ln_jacobian
        predicted, unknown, curves = uncertain(self.of_model(natural), self.conditions)
        sigma = np.sqrt(natural[:, -1:] ** 2 + unknown[:, None] * (curves**2).sum(axis=1))
        z = (self.response - predicted) / sigma
        return np.asarray(-0.5 * z * z - np.log(sigma) - HALF_LN_2PI + self._ln_jacobian)

    def log_prob(self, t: Array) -> Array:
        """Log posterior density (unnormalised) of internal coordinates, shape (k,)."""
        t = np.atleast_2d(t)
        value = self.priors.log_prob(t)
        inside = np.isfinite(value)
        if inside.all():
            return np.asarray(value + self.log_likelihood(t))
        if inside.any():
            value[inside] += self.log_likelihood(t[inside])
        return value

    def with_table(self, table: Table) -> Problem:
        """Return the same problem, reference conditions included, with other rows."""
        return replace(self, table=table)

    def with_fixed(self, values: Mapping[str, float]) -> Problem:
        """Return the problem with some natural parameters held fixed."""
        return replace(self, priors=self.priors.fix(values))


@takes(model_name=str, prior_path=(PathLike, DeclaredPriors), fixed=Mapping)
def build_problem(
    model_name: str,
    table: Tabular,
    prior_path: PriorFile | str | None = None,
    *,
    fixed: Mapping[str, float] | None = None,
    others: int = 0,
) -> Problem:
    """Bind a model to data and read its priors.

    Parameters
    ----------
    model_name : str
        One of `calib.models.MODELS`.
    table : Table, mapping of str to array_like, or pandas.DataFrame
        Calibration data with the model's conditions and its output.
    prior_path : path or PriorFile, optional
        It may leave parameters to the model's own priors, or the shipped ones, which are taken by
        default; `notes` of the problem then says which.
    fixed : mapping of str to float, optional
        Natural parameters to hold at a value.
    others : int, optional
        Readings of other outputs that are fitted with these rows and count as well.

    Raises
    ------
    CalibError
        If a column is missing, or as in another unit; if too few rows are there, all of them at one
        setting of the conditions or with one output; if the priors do not fit the model, leave no
        parameter free, or expect outputs of quite another size.

    Examples
    --------
    >>> import calib
    >>> ruts = calib.load_he2019("rut_depth")
    >>> problem = calib.build_problem("modified_bekker", ruts)
    >>> problem.names
    ('z_ref', 'n0', 'n1', 'sigma')
    """
    model, table = get_model(model_name), as_table(table)
    table.must_have(*model.conditions, model.output)
    priors = _priors_of(model, table, prior_path)
    # With some parameters held, a fit still needs more rows than its equation has parameters.
    estimated = {p.name for p in priors.free} - {*(fixed or ())}
    least = max(len(estimated), len(model.parameters))
    check_enough(table, max(least - others, 2), model=model.name)
    check_varies(table, model.output)
    check_settings(table, model.conditions)
    problem, assumed = _set_up(model, table, priors)
    _ = problem.serial, problem.readings  # refused here, not in the middle of an estimation
    problem = problem.with_fixed(fixed) if fixed else problem
    if not problem.names:
        raise CalibError(
            f"all parameters of {model.name} are held fixed", where=priors.source,
            expected="at least one parameter to estimate; sigma, the scale of the noise, will do",
            hint='give one another distribution than dist = "fixed"',
        )  # fmt: skip
    # A simulator's runs cost too much to look at what the priors expect.
    if model.uncertain is not None or simulated_by(model.name) is None:
        check_scale(problem, assumed)
    return problem


def _priors_of(model: Model, table: Table, path: PriorFile | str | None) -> Priors:
    own = Path(path) if isinstance(path, str) else path
    names = (*model.parameters, "sigma")
    references = prior_references(table.columns)
    return read_priors(own or default_priors(model.name), model.name, names, references)


def _set_up(model: Model, table: Table, priors: Priors) -> tuple[Problem, dict[str, float]]:
    """Bind a model to a table; what priors are relative to and it lacks is assumed."""
    relative = relative_columns(priors.text)
    check_units(table, (*model.conditions, model.output, *relative))
    try:
        bound = model.bind(table.columns)
    except CalibError as error:
        raise error.within(table.source) from None
    assumed = {
        name: value
        for name, value in relative.items()
        if name not in prior_references(table.columns)
    }
    notes = [note] if (note := inheritance_note(priors, model.name)) else []
    notes += [
        f"the data have no column {name}, so priors that are relative to it assume "
        f"{_with_unit(name, value)}; give it if yours differs"
        for name, value in assumed.items()
    ]
    noise = noise_of(priors.noise, model, table, priors.source)
    if model.uncertain is not None:
        what = f"the emulator {model.name}"
        noise.must_be_normal_of_one_sd(priors.source, what, errors=False)
    notes += [error.words() for error in noise.errors]
    if noise.errors and noise.stated is None:
        notes[-1] += (
            "; if the column has something else, write errors = {} under [likelihood] in the prior "
            "file, which leaves it out"
        )
    return Problem(bound, table, priors, tuple(notes), noise), assumed


@takes(model_name=str, prior_path=(PathLike, DeclaredPriors))
def problem_without_data(
    model_name: str, at: Tabular, prior_path: PriorFile | str | None = None
) -> Problem:
    """Bind a model to conditions and read its priors, to predict before there are data.

    Conditions stand for data in what priors refer to: reference conditions, and columns that they
    are relative to. Its `notes` say so. A CalibError names a condition that is missing, as in
    another unit, or does not vary where the model needs it to.
    """
    model, table = get_model(model_name), as_table(at)
    table.must_have(*model.conditions)
    priors = _priors_of(model, table, prior_path)
    # Conditions to predict at are known.
    exact = replace(priors.noise, stated=(), set_points=())
    problem, _ = _set_up(model, table, replace(priors, noise=exact))
    said = ", ".join(f"{n} {plain_number(v)}" for n, v in problem.bound.references.items())
    own = f"the parameters refer to the conditions that are predicted at: {said}"
    return replace(problem, notes=(*problem.notes, own) if said else problem.notes)
