"""Validate a calibration on what was not fitted: held-out rows, or each row left out in turn."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from calib.batch.tasks import completed
from calib.batch.threads import one_thread
from calib.data import Table
from calib.errors import CalibError
from calib.inference.calibration import Calibration
from calib.inference.diagnostics import psis
from calib.inference.problem import Problem
from calib.inference.random import generator, stream
from calib.inference.sampling.sampler import Progress, SamplerSettings, sample_posterior
from calib.models.base import Array
from calib.validation.prediction import N_DRAWS, predictive_draws
from calib.validation.scores import Scores, score

# Above this, importance sampling cannot be trusted to leave a row out (Vehtari et al. 2024).
PARETO_K_MAX = 0.7


@dataclass(frozen=True)
class Validation:
    """Scores on rows that were not fitted.

    Parameters
    ----------
    method : {"held_out", "leave_one_out"}
    table : Table
        The rows that were predicted.
    observed : ndarray, shape (n,)
    draws : ndarray, shape (size, n)
        Predictive draws.
    scores : Scores
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


@one_thread()
def validate_held_out(calibration: Calibration, held_out: Table) -> Validation:
    """Score the calibration on rows it has not seen.

    Parameters
    ----------
    calibration : Calibration
    held_out : Table
        With the model's conditions and its output.

    Raises
    ------
    CalibError
        If the calibrated model has no value there, however uncertain its parameters.

    Notes
    -----
    A parameter vector for which the equation has no value at one of the rows (a quadratic in
    pressure that is negative beyond the calibrated ones) is left out.
    """
    model = calibration.problem.bound.model
    rng = generator(calibration.seed, calibration.label, "validate")
    _, draws = predictive_draws(calibration, model.select(held_out.columns), rng)
    draws = draws[np.isfinite(draws).all(axis=1)]
    if not draws.size:
        raise CalibError(
            f"the calibrated model {model.name} has no value at the held-out rows",
            where=held_out.source,
            allowed="conditions to which the equation can be extrapolated",
            mend="hold out rows inside the range of the others",
        )
    observed = held_out[model.output]
    scores = score(draws, observed, heavy=calibration.problem.heavy)
    return Validation("held_out", held_out, observed, draws, scores)


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
    calibration : Calibration
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
        here = problem.bound.model.select(row.columns)
        location = problem.draw_location(natural, here, rng)
        noisy = location + problem.noise.draw(natural, here, rng, 1)
        drawn[:, i] = problem.bound.from_response(noisy)[:, 0]
    if progress is not None and not refits:
        progress(n, n)
    return Validation(
        "leave_one_out", problem.table, problem.observed, drawn,
        score(drawn, problem.observed, heavy=problem.heavy), k, tuple(refits),
        float(elpd.sum()), float(np.sqrt(n * elpd.var(ddof=1))),
        tuple(i for i, (_, passed) in refits.items() if not passed), elpd,
    )  # fmt: skip


# A problem without one of its rows, the seed, the mode with it, and how to sample.
type _Left = tuple[Problem, np.random.SeedSequence, Array, SamplerSettings | None]
# Draws without one row, shape (N_DRAWS, d), and whether they passed the gate.
type _Refit = tuple[Array, bool]


def _refits(
    calibration: Calibration, rows: Sequence[int], settings: SamplerSettings | None,
    progress: Progress | None, workers: int,
) -> dict[int, _Refit]:  # fmt: skip
    """Fit again without each of some rows."""
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


def _refit(left: _Left) -> _Refit:
    problem, seed, mode, settings = left
    again = sample_posterior(problem, seed, starts=mode[None], settings=settings)
    picked = np.linspace(0, again.flat.shape[0] - 1, N_DRAWS).astype(int)
    return again.flat[picked], again.report.passed


def _log_mean(log_value: Array, log_weight: Array) -> float:
    return float(logsumexp(log_value) - logsumexp(log_weight))
