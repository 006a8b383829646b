"""Validate a calibration on what was not fitted: held-out rows, or each row left out in turn."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.calibration import Calibration
from calib.chains import psis
from calib.data import Table
from calib.errors import CalibError
from calib.models.base import Array
from calib.prediction import N_DRAWS, predictive_draws
from calib.sampling.sampler import Progress, SamplerSettings, sample_posterior
from calib.scores import Scores, score
from calib.streams import generator, stream

__all__ = ["Validation", "leave_one_out", "validate_held_out"]

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
    return Validation("held_out", held_out, observed, draws, score(draws, observed))


def leave_one_out(
    calibration: Calibration,
    *,
    settings: SamplerSettings | None = None,
    progress: Progress | None = None,
) -> Validation:
    """Leave every row out in turn: by smoothed importance sampling, or by fitting again.

    Parameters
    ----------
    calibration : Calibration
    settings : SamplerSettings, optional
        For the refits.
    progress : callable, optional
        Called with rows done and rows in all.

    References
    ----------
    Vehtari, Gelman & Gabry (2017), doi:10.1007/s11222-016-9696-4.
    """
    problem = calibration.problem
    t = calibration.draws.flat
    log_likelihood = problem.log_likelihood_rows(t)
    log_weight, k = psis(-log_likelihood.T)
    rng = generator(calibration.seed, calibration.label, "leave_one_out")
    n = problem.response.size
    drawn = np.empty((N_DRAWS, n))
    elpd = np.empty(n)
    refitted, unconverged = [], []
    for i in range(n):
        row = problem.table.take(np.arange(n) == i)
        if k[i] <= PARETO_K_MAX:
            weight = np.exp(log_weight[i] - log_weight[i].max())
            picked = rng.choice(t.shape[0], size=N_DRAWS, p=weight / weight.sum())
            sample = t[picked]
            elpd[i] = _log_mean(log_weight[i] + log_likelihood[:, i], log_weight[i])
        else:
            refitted.append(i)
            rest = problem.with_table(problem.table.take(np.arange(n) != i))
            seed = stream(calibration.seed, calibration.label, "refit", i)
            again = sample_posterior(
                rest, seed, starts=calibration.draws.mode[None], settings=settings
            )
            if not again.report.passed:
                unconverged.append(i)
            sample = again.flat[np.linspace(0, again.flat.shape[0] - 1, N_DRAWS).astype(int)]
            held = problem.with_table(row).log_likelihood_rows(sample)[:, 0]
            # Without this row, the equation may have no value at it: density zero there.
            defined = np.isfinite(held)
            elpd[i] = _log_mean(np.where(defined, held, -np.inf), np.zeros_like(held))
            sample = sample[np.resize(np.flatnonzero(defined), N_DRAWS)]
        natural = problem.theta(sample)
        location = problem.bound.location(natural[:, :-1], problem.bound.model.select(row.columns))
        noisy = location[:, 0] + natural[:, -1] * rng.standard_normal(N_DRAWS)
        drawn[:, i] = problem.bound.from_response(noisy)
        if progress is not None:
            progress(i + 1, n)
    return Validation(
        "leave_one_out", problem.table, problem.observed, drawn, score(drawn, problem.observed),
        k, tuple(refitted), float(elpd.sum()), float(np.sqrt(n * elpd.var(ddof=1))),
        tuple(unconverged),
    )  # fmt: skip


def _log_mean(log_value: Array, log_weight: Array) -> float:
    from scipy.special import logsumexp

    return float(logsumexp(log_value) - logsumexp(log_weight))
