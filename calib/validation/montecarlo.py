"""Monte Carlo standard errors of everything that is computed from posterior draws.

Of a posterior's summary they are the stated ones, of its sd ArviZ's. Scores follow from the errors
of the predictive distributions they are scores of.
"""

from __future__ import annotations

import numpy as np

from calib.inference.calibration import Calibration
from calib.inference.diagnostics import mcse, tail_shape
from calib.inference.random import generator
from calib.models.base import Array
from calib.validation.scores import LEVELS, RELATIVE_ERROR_FAR, crps
from calib.validation.validate import Validation

__all__ = [
    "Errors", "Place", "held_error", "least_ess", "lever_of", "posterior_errors", "row_moves",
    "validation_errors",
]  # fmt: skip

type Place = tuple[str, ...]
"""Keys from the top of a document to one of its numbers; positions in a list count from "0"."""
type Errors = dict[Place, float | None]
"""By path; None where a tail is too heavy for one."""

# Shapes with which the variance of a mean exists, and of a variance: a little less, as estimated.
_K_MEAN, _K_SD = 0.5, 0.2
# Of an interval's width: an end at the edge of what is possible hangs on the few outermost draws.
# Between seeds k of the rut depth's moves so far.
_END = 2e-4
# Of random draws, among which scores scatter; their sd is known to a twentieth.
_GROUPS = 200
# Draws of the round of importance sampling that estimates the evidence, at least.
_EVIDENCE_DRAWS = 1500


def posterior_errors(calibration: Calibration) -> Errors:
    """Return the Monte Carlo standard errors of a posterior summary, by paths below the output."""
    names = tuple(calibration.parameters)
    stacked = np.stack([calibration.parameters[name] for name in names], axis=-1)
    sd, shape = mcse(stacked, "sd"), tail_shape(stacked)
    errors: Errors = {}
    for j, name in enumerate(names):
        stated = calibration.summary[name]
        least = _END * (stated.hdi_upper - stated.hdi_lower)
        errors |= {
            ("posterior", name, "mean"): stated.mcse_mean if shape[j] < _K_MEAN else None,
            ("posterior", name, "sd"): float(sd[j]) if shape[j] < _K_SD else None,
            ("posterior", name, "median"): stated.mcse_median,
            ("posterior", name, "hdi_lower"): max(stated.mcse_hdi_lower, least),
            ("posterior", name, "hdi_upper"): max(stated.mcse_hdi_upper, least),
        }
    draws = calibration.draws
    internal = draws.t.reshape(-1, *draws.t.shape[2:])
    relative = mcse(internal, "sd") / internal.std(axis=(0, 1))
    for j, name in enumerate(calibration.problem.names):
        ratio = calibration.summary[name].sd_ratio
        if np.isfinite(ratio):
            errors["posterior", name, "posterior_to_prior_sd"] = ratio * float(relative[j])
    efficiency = max(draws.efficiency, 1e-3)
    errors["sampling", "log_evidence"] = float(np.sqrt((1.0 / efficiency - 1.0) / _EVIDENCE_DRAWS))
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
    size = max(n_draws // _GROUPS, 1)
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
