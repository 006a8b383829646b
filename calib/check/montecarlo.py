"""How far numbers that follow from posterior draws may be from those of other draws."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import scipy

from calib.inference.calibration import Calibration
from calib.validation.comparison import Comparison
from calib.validation.montecarlo import (
    Errors,
    Place,
    held_error,
    least_ess,
    lever_of,
    posterior_errors,
    row_moves,
    validation_errors,
)
from calib.validation.validate import Validation

MONTE_CARLO = "Monte Carlo"

# Chance of one false alarm or more in a whole check.
_FAMILY = 1e-3
# Over 24 seeds numbers moved by up to 1.4 times what ArviZ expects: walkers are not quite chains.
_SAFETY = 1.5


def multiple(n: int) -> float:
    """Return how many standard errors of a difference are allowed where `n` are looked at.

    One check in a thousand finds a difference where there is none: seven of some hundred numbers.
    """
    return float(_SAFETY * scipy.stats.norm.isf(_FAMILY / (2 * max(n, 1))))


def describe(n: int) -> str:
    """Say in words what is allowed to `n` numbers that follow from posterior draws."""
    chance = f"one false alarm in {1.0 / _FAMILY:g} checks of {n} such numbers"
    return f"{multiple(n):.1f} Monte Carlo errors of a difference ({chance}, times {_SAFETY:g})"


def drawn_in_output(calibration: Calibration, validation: Validation, n: int, steps: Any) -> Errors:
    """Return what Monte Carlo error allows to an output of a report with n drawn numbers in all.

    `steps` is the recorded length of the other run.
    """
    times = multiple(n) * _of_difference(calibration, steps)
    scores = validation_errors(calibration, validation, times)
    return _scaled(posterior_errors(calibration) | scores, times)


def drawn_in_run(calibration: Calibration, n: int, steps: Any) -> Errors:
    """Return the same for a run, and the posterior sds that its mode is judged by."""
    errors = posterior_errors(calibration)
    errors["log_evidence",] = errors.pop(("sampling", "log_evidence"))
    sds = enumerate(calibration.draws.flat.std(axis=0).tolist())
    scaled = _scaled(errors, multiple(n) * _of_difference(calibration, steps))
    return scaled | {("mode", str(j)): sd for j, sd in sds}


def drawn_in_comparison(comparison: Comparison, n: int, steps: Mapping[str, Any]) -> Errors:
    """Return the same for a comparison, by paths below ``models``; `steps` are by model.

    Differences are from the first model.
    """
    best = comparison.candidates[0]
    found: Errors = {}
    best_moves = row_moves(best.calibration)
    for c in comparison.candidates:
        times = multiple(n) * _of_difference(c.calibration, steps.get(c.model))
        moves = row_moves(c.calibration)
        lever = lever_of(best.rows - c.rows)
        # Draws of the row of the fewest are worth so many times less.
        heavy = np.sqrt(1.0 + least_ess(c.calibration) * np.square(moves).mean(axis=0).max())
        errors: Errors = {
            **_stated(validation_errors(c.calibration, c.loo, times), float(heavy)),
            ("below_best",): float(np.hypot(moves.sum(axis=1).std(), best_moves.sum(axis=1).std())),
            ("below_best_se",): float(np.hypot((moves @ lever).std(), (best_moves @ lever).std())),
            ("log_evidence",): posterior_errors(c.calibration)["sampling", "log_evidence"],
            **{("elpd_rows", str(i)): float(sd) for i, sd in enumerate(moves.std(axis=0))},
        }
        if c.held is not None:
            held = _stated(validation_errors(c.calibration, c.held, times), 1.0)
            held["elpd",] = held_error(c.calibration, c.held)
            errors |= {("held_out", *place): size for place, size in held.items()}
        found |= {(c.model, *place): size for place, size in _scaled(errors, times).items()}
    return found


def _of_difference(calibration: Calibration, steps: Any) -> float:
    """Error of the difference of two runs over that of this one, should the other be shorter."""
    known = isinstance(steps, int | float) and steps > 0
    ratio = calibration.draws.report.steps / steps if known else 1.0
    return float(np.sqrt(1.0 + np.clip(ratio, 1.0, 4.0)))


def _scaled(errors: Mapping[Place, float | None], times: float) -> Errors:
    return {place: None if error is None else times * error for place, error in errors.items()}


def _stated(errors: Mapping[Place, float], heavy: float) -> Errors:
    """Those of a validation's errors that a comparison states, as it names them."""
    times = {"elpd": 1.0, "elpd_se": 1.0, "rmse": heavy, "crps": heavy}
    found: Errors = {
        (name,): by * errors["validation", name]
        for name, by in times.items()
        if ("validation", name) in errors
    }
    return found | {("coverage_90",): errors["validation", "coverage", "90"]}
