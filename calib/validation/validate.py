"""Validate a calibration on rows that were not fitted, with Monte Carlo errors of the scores.

Of a posterior's summary they are the stated ones, of its sd ArviZ's. Scores follow from the errors
of the predictive distributions they are scores of.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from calib.arguments import takes
from calib.batch.environment import one_thread
from calib.batch.tasks import completed
from calib.data import Table, as_table
from calib.data.checks import check_conditions
from calib.data.reader import Tabular, index_of
from calib.errors import CalibError
from calib.inference.calibration import Calibration
from calib.inference.diagnostics import mcse, psis, tail_shape
from calib.inference.joint import JointCalibration
from calib.inference.problem import Problem
from calib.inference.random import generator, stream
from calib.inference.sampler import Progress, SamplerSettings, sample_posterior
from calib.models.base import Array
from calib.shown import Shown
from calib.validation.constants import LEVELS, N_DRAWS, PARETO_K_MAX, RELATIVE_ERROR_FAR
from calib.validation.prediction import row_draws
from calib.validation.scores import Scores, crps, score


@dataclass(frozen=True, repr=False)
class Validation(Shown):
    """Scores on rows that were not fitted.

    Parameters
    ----------
    method : {"held_out", "leave_one_out"}
    table : Table
        The rows that were predicted.
    observed : ndarray, shape (n,)
    draws : ndarray, shape (size, n)
        Predictive draws.
    pareto_k : ndarray, shape (n,), optional
        Of leave-one-out.
    refitted : tuple of int
        Rows that were left out by fitting again.
    elpd, elpd_se : float
        Expected log predictive density of leave-one-out and its standard error; NaN otherwise.
    unconverged : tuple of int
        Those of `refitted` whose posterior did not pass the gate.
    elpd_rows : ndarray, shape (n,), optional
        The terms of `elpd`.
    index : tuple, optional
        Labels of the rows in the data frame that was given.
    """

    method: str
    table: Table
    observed: Array
    draws: Array
    scores: Scores
    pareto_k: Array | None = None
    refitted: tuple[int, ...] = ()
    elpd: float = float("nan")
    elpd_se: float = float("nan")
    unconverged: tuple[int, ...] = ()
    elpd_rows: Array | None = None
    index: tuple[object, ...] | None = None

    def __repr__(self) -> str:
        """Say how the rows were kept apart, and how the predictions did."""
        ninety = self.scores.coverage[0.9]
        return (
            f"<Validation ({self.method}): 90 % band covers {ninety.hits} of {ninety.n}, "
            f"RMSE {self.scores.rmse:.3g}>"
        )


@takes(calibration=Calibration)
@one_thread()
def validate_held_out(calibration: Calibration, held_out: Tabular) -> Validation:
    """Score the calibration on rows it has not seen.

    Parameters
    ----------
    held_out : Table, mapping of str to array_like, or pandas.DataFrame
        With the model's conditions and its output.

    Raises
    ------
    CalibError
        If the calibrated model has no value there, however uncertain its parameters, a column
        looks, as a whole, as if it were in another unit, or all rows are among those calibrated on.

    Notes
    -----
    A parameter vector for which the equation has no value at one of the rows (a quadratic in
    pressure that is negative beyond the calibrated ones) is left out.

    Examples
    --------
    >>> import calib
    >>> pulls = calib.load_he2019("drawbar_pull")
    >>> fitted, held_out = calib.hold_out(pulls, "inflation_pressure_psi", 30)
    >>> problem = calib.build_problem("magic_formula_pressure", fitted)
    >>> calibration = calib.calibrate(problem, seed=1)
    >>> calib.validate_held_out(calibration, held_out).method
    'held_out'
    """
    model, index = calibration.problem.bound.model, index_of(held_out)
    held_out = as_table(held_out)
    fitted = calibration.problem
    known = {**fitted.conditions, model.output: fitted.table[model.output]}
    check_conditions(held_out, {n: v for n, v in known.items() if n in held_out})
    check_unseen(fitted.table, held_out, (*fitted.conditions, model.output))
    rng = generator(calibration.seed, calibration.label, "validate")
    draws = row_draws(calibration, held_out, rng)
    draws = draws[np.isfinite(draws).all(axis=1)]
    if not draws.size:
        raise CalibError(
            f"the calibrated model {model.name} has no value at the held-out rows",
            where=held_out.source,
            expected="conditions to which the equation can be extrapolated",
            hint="hold out rows inside the range of the others",
        )
    observed = held_out[model.output]
    scores = score(draws, observed, heavy=calibration.problem.heavy)
    return Validation("held_out", held_out, observed, draws, scores, index=index)


def check_unseen(fitted: Table, held_out: Table, columns: Sequence[str]) -> None:
    """Raise a CalibError if all rows to validate on are among those that are fitted."""
    if not all(name in t for t in (fitted, held_out) for name in columns):
        return
    seen, rows = ({*zip(*(t[name] for name in columns), strict=True)} for t in (fitted, held_out))
    if rows <= seen:
        raise CalibError(
            f"all {len(held_out)} rows to validate on are rows that are fitted",
            where=held_out.source,
            expected="rows that the fit has not seen",
            hint="hold rows out before the fit (calib.hold_out), or leave each out in turn "
            "(calib.leave_one_out)",
        )


@takes(calibration=Calibration, settings=SamplerSettings)
@one_thread()
def leave_one_out(
    calibration: Calibration,
    *,
    settings: SamplerSettings | None = None,
    progress: Progress | None = None,
    workers: int = 1,
    refit: bool = True,
) -> Validation:
    """Leave every row out in turn: by smoothed importance sampling, or by fitting again.

    Parameters
    ----------
    settings : SamplerSettings, optional
        For the refits.
    progress : callable, optional
        Called with rows done and rows in all.
    workers : int
        Processes for the refits, as for `calib.batch.tasks.completed`; the numbers do not depend
        on it.
    refit : bool
        Whether to fit again where importance sampling cannot be trusted; its smoothed weights are
        used otherwise, which makes too little of the rows that matter most.

    References
    ----------
    Vehtari, Gelman & Gabry (2017), doi:10.1007/s11222-016-9696-4.

    Examples
    --------
    >>> import calib
    >>> ruts = calib.load_he2019("rut_depth")
    >>> calibration = calib.calibrate(calib.build_problem("bekker", ruts), seed=1)
    >>> calib.leave_one_out(calibration, refit=False).method
    'leave_one_out'
    """
    problem = calibration.problem
    t = calibration.draws.flat
    log_likelihood = problem.log_likelihood_left_out(t)
    log_weight, k = psis(-log_likelihood.T)
    rng = generator(calibration.seed, calibration.label, "leave_one_out")
    n = problem.response.size
    drawn = np.empty((N_DRAWS, n))
    elpd = np.empty(n)
    too_large = [int(i) for i in np.flatnonzero(~(k <= PARETO_K_MAX))] if refit else []
    refits = _refits(calibration, too_large, settings, progress, workers)
    for i in range(n):
        row = problem.table.take(np.arange(n) == i)
        if i not in refits:
            weight = np.exp(log_weight[i] - log_weight[i].max())
            picked = rng.choice(t.shape[0], size=N_DRAWS, p=weight / weight.sum())
            sample = t[picked]
            elpd[i] = _log_mean(log_weight[i] + log_likelihood[:, i], log_weight[i])
        else:
            sample = refits[i][0]
            held = problem.log_likelihood_left_out(sample)[:, i]
            # Without this row, the equation may have no value at it: density zero there.
            defined = np.isfinite(held)
            elpd[i] = _log_mean(np.where(defined, held, -np.inf), np.zeros_like(held))
            sample = sample[np.resize(np.flatnonzero(defined), N_DRAWS)]
        natural = problem.theta(sample)
        here = problem.with_table(row)
        location = here.draw_mean_response(natural, here.conditions, rng)
        noisy = location + here.draw_noise(natural, rng, apart=True)
        drawn[:, i] = problem.bound.from_response(noisy)[:, 0]
    if progress is not None and not refits:
        progress(n, n)
    return Validation(
        "leave_one_out", problem.table, problem.observed, drawn,
        score(drawn, problem.observed, heavy=problem.heavy), k, tuple(refits),
        float(elpd.sum()), float(np.sqrt(n * elpd.var(ddof=1))),
        tuple(i for i, (_, passed) in refits.items() if not passed), elpd,
    )  # fmt: skip


def _refits(
    calibration: Calibration, rows: Sequence[int], settings: SamplerSettings | None,
    progress: Progress | None, workers: int,
) -> dict[int, tuple[Array, bool]]:  # fmt: skip
    """Fit again without each of some rows: draws (N_DRAWS, d), and whether they pass the gate."""
    problem, n = calibration.problem, calibration.problem.response.size
    left = {
        str(i): (
            problem.with_table(problem.table.take(np.arange(n) != i)),
            stream(calibration.seed, calibration.label, "refit", i),
            calibration.draws.mode,
            settings,
        )
        for i in rows
    }
    found = {}
    with closing(completed(_refit, left, workers=workers)) as coming:
        for task in coming:
            if task.result is None:
                raise CalibError(f"the fit without row {task.name} failed: {task.error}")
            found[int(task.name)] = task.result
            if progress is not None:
                # The other rows take no time.
                progress(n - len(rows) + len(found), n)
    return {i: found[i] for i in rows}


def _refit(
    left: tuple[Problem, np.random.SeedSequence, Array, SamplerSettings | None],
) -> tuple[Array, bool]:
    problem, seed, mode, settings = left
    again = sample_posterior(problem, seed, starts=mode[None], settings=settings)
    picked = np.linspace(0, again.flat.shape[0] - 1, N_DRAWS).astype(int)
    return again.flat[picked], again.report.passed


def _log_mean(log_value: Array, log_weight: Array) -> float:
    return float(logsumexp(log_value) - logsumexp(log_weight))


type Place = tuple[str, ...]
"""Keys from the top of a document to one of its numbers; positions in a list count from "0"."""
type Errors = dict[Place, float | None]
"""By path; None where a tail is too heavy for one."""


def posterior_errors(calibration: Calibration | JointCalibration) -> Errors:
    """Return the Monte Carlo standard errors of a posterior summary, by paths below the output."""
    names = tuple(calibration.parameters)
    stacked = np.stack([calibration.parameters[name] for name in names], axis=-1)
    sd, shape = mcse(stacked, "sd"), tail_shape(stacked)
    errors: Errors = {}
    for j, name in enumerate(names):
        stated = calibration.summary[name]
        # An end at the edge of what is possible depends on the few outermost draws.
        least = 2e-4 * (stated.hdi_upper - stated.hdi_lower)
        # Pareto shapes with which the variance of a mean exists, and of a variance: a little less.
        errors |= {
            ("posterior", name, "mean"): stated.mcse_mean if shape[j] < 0.5 else None,
            ("posterior", name, "sd"): float(sd[j]) if shape[j] < 0.2 else None,
            ("posterior", name, "median"): stated.mcse_median,
            ("posterior", name, "hdi_lower"): max(stated.mcse_hdi_lower, least),
            ("posterior", name, "hdi_upper"): max(stated.mcse_hdi_upper, least),
        }
    draws, names = calibration.draws, calibration.problem.priors.names
    internal = draws.t.reshape(-1, *draws.t.shape[2:])[..., : len(names)]
    relative = mcse(internal, "sd") / internal.std(axis=(0, 1))
    for j, name in enumerate(names):
        ratio = calibration.summary[name].sd_ratio
        if np.isfinite(ratio):
            errors["posterior", name, "posterior_to_prior_sd"] = ratio * float(relative[j])
    efficiency = max(draws.efficiency, 1e-3)
    # The evidence is estimated from at least 1500 draws of importance sampling.
    errors["sampling", "log_evidence"] = float(np.sqrt((1.0 / efficiency - 1.0) / 1500))
    return errors


def validation_errors(
    calibration: Calibration, validation: Validation, multiple: float
) -> dict[Place, float]:
    """Return the Monte Carlo standard errors of a validation's scores.

    A part p of the predictive draws has the error sqrt(p (1 - p) (1/N + 1/ESS)): N draws of the
    noise on top of ESS effective draws of the parameters; others follow from the scatter among
    groups of the draws. Rows within so many errors of the edge of a band may cross it.
    """
    draws, observed, scores = validation.draws, validation.observed, validation.scores
    n_draws, n = draws.shape
    part = float(np.sqrt(1.0 / n_draws + 1.0 / least_ess(calibration)))
    p = np.clip(scores.pit, 4.0 / n_draws, 1.0 - 4.0 / n_draws)
    pit = np.sqrt(p * (1.0 - p)) * part
    # 200 groups of random draws: the sd of scores among them is known to a twentieth.
    size = max(n_draws // 200, 1)
    groups = generator(0, "groups of draws").permutation(draws)[: n_draws - n_draws % size]
    groups = groups.reshape(-1, size, n)
    of_group = part * float(np.sqrt(size))
    medians = np.median(groups, axis=1)
    rmses = np.sqrt(np.square(medians - observed).mean(axis=1))
    errors: dict[Place, float] = {("pit", str(i)): float(pit[i]) for i in range(n)}
    errors["rmse",] = of_group * float(rmses.std())
    if np.isfinite(scores.crps):
        errors["crps",] = of_group * float(np.std([crps(g, observed).mean() for g in groups]))
    large = ~np.isnan(scores.relative_error)
    if large.any():
        relative = of_group * medians.std(axis=0)[large] / np.abs(observed[large])
        errors["max_relative_error",] = float(relative.max())
        from_edge = np.abs(np.abs(scores.relative_error[large]) - RELATIVE_ERROR_FAR)
        near = float((from_edge <= multiple * relative).sum())
        errors["n_relative_error_above_6_percent",] = near / multiple
    for level in LEVELS:
        edges = 0.5 + 0.5 * level * np.array([-1.0, 1.0])
        close = np.abs(scores.pit[:, None] - edges).min(axis=1) <= multiple * pit
        moved, name = float(close.sum()) / n / multiple, f"{100 * level:g}"
        errors["coverage", name] = moved
        # A Jeffreys interval moves a little faster than its proportion.
        errors |= {("coverage_interval", name, end): 1.5 * moved for end in ("0", "1")}
    if validation.elpd_rows is not None:
        moves = row_moves(calibration)
        errors["elpd",] = float(moves.sum(axis=1).std())
        errors["elpd_se",] = float((moves @ lever_of(validation.elpd_rows)).std())
    return {("validation", *place): error for place, error in errors.items()}


def row_moves(calibration: Calibration) -> Array:
    """By how much draws move the log density -ln E[1/p(y_i | theta)] of each row without it.

    Influences (draws, n), whose sd over the draws is the Monte Carlo error.
    """
    rows = calibration.problem.log_likelihood_left_out(calibration.draws.flat)
    inverse = np.exp(rows.min(axis=0) - rows)
    influence = inverse / inverse.mean(axis=0) - 1.0
    return np.asarray(influence / np.sqrt(least_ess(calibration)))


def lever_of(elpd: Array) -> Array:
    """Derivatives of sqrt(n var) of some rows by each of them."""
    n = elpd.size
    spread = float(np.sqrt(n * elpd.var(ddof=1)))
    return n * (elpd - elpd.mean()) / ((n - 1) * max(spread, 1e-300))


def held_error(calibration: Calibration, held: Validation) -> float:
    """Of the log of the mean density of each held-out row, summed."""
    rows = calibration.problem.with_table(held.table).log_likelihood_rows(calibration.draws.flat)
    density = np.exp(np.where(np.isfinite(rows), rows, -np.inf) - np.nanmax(rows, axis=0))
    influence = (density / density.mean(axis=0)).sum(axis=1)
    return float(influence.std() / np.sqrt(least_ess(calibration)))


def least_ess(calibration: Calibration) -> float:
    """Return the fewest effective draws of all parameters."""
    return min(float(s.ess_bulk) for s in calibration.summary.values())
