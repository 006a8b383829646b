"""Monte Carlo errors of what a comparison of models states."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from calib.check.montecarlo import (
    Place,
    count_drawn,
    left_out,
    lever_of,
    multiple,
    of_difference,
    posterior_errors,
    scaled,
    validation_errors,
)
from calib.models.base import Array
from calib.validation.comparison import Candidate, Comparison


def count_compared(comparison: Comparison) -> int:
    """Return how many numbers of a comparison follow from posterior draws, those of runs too."""
    held = sum(4 for c in comparison.candidates if c.held is not None)
    return held + sum(8 + c.rows.size + count_drawn(c.calibration) for c in comparison.candidates)


def drawn_in_comparison(
    comparison: Comparison, best: str, steps: Mapping[str, object]
) -> dict[Place, float | None]:
    """Return what Monte Carlo error allows to a comparison's numbers, by paths below ``models``.

    Differences are from the model `best`; `steps` are recorded lengths of the other runs, by model.
    """
    moved = {c.model: _RowErrors.of(c) for c in comparison.candidates}
    first = next(c for c in comparison.candidates if c.model == best)
    n, found = count_compared(comparison), dict[Place, float | None]()
    for c in comparison.candidates:
        times = multiple(n) * of_difference(c.calibration, steps.get(c.model))
        of_sum = np.hypot(moved[c.model].of_sum(), moved[best].of_sum())
        spread = lever_of(first.rows - c.rows)
        of_spread = np.hypot(moved[c.model].along(spread), moved[best].along(spread))
        errors = _scores(validation_errors(c.calibration, c.loo, times), moved[c.model].heavy)
        errors["below_best",] = float(of_sum)
        errors["below_best_se",] = float(of_spread)
        errors["log_evidence",] = posterior_errors(c.calibration)["sampling", "log_evidence"]
        for i, error in enumerate(moved[c.model].each.tolist()):
            errors["elpd_rows", str(i)] = error
        if c.held is not None:
            held = _scores(validation_errors(c.calibration, c.held, times), 1.0)
            held["elpd",] = _held_error(c)
            errors |= {("held_out", *place): size for place, size in held.items()}
        found |= {(c.model, *k): size for k, size in scaled(errors, times).items()}
    return found


def _scores(errors: Mapping[Place, float | None], heavy: float) -> dict[Place, float | None]:
    """Those of a validation's errors that a comparison states, as it names them.

    They are `heavy` times as large as those of draws that all weigh the same.
    """
    found: dict[Place, float | None] = {
        (name,): errors["validation", name] for name in ("elpd", "elpd_se")
        if ("validation", name) in errors
    }  # fmt: skip
    for name in ("rmse", "crps"):
        error = errors["validation", name]
        found[name,] = None if error is None else heavy * error
    found["coverage_90",] = errors["validation", "coverage", "90"]
    return found


def _held_error(c: Candidate) -> float:
    """Of the log of the mean density of each held-out row, summed."""
    if c.held is None:
        return 0.0
    problem = c.calibration.problem.with_table(c.held.table)
    rows = problem.log_likelihood_rows(c.calibration.draws.flat)
    density = np.exp(np.where(np.isfinite(rows), rows, -np.inf) - np.nanmax(rows, axis=0))
    return float((density / density.mean(axis=0)).sum(axis=1).std() / np.sqrt(_least_ess(c)))


def _least_ess(c: Candidate) -> float:
    return min(float(s.ess_bulk) for s in c.calibration.summary.values())


@dataclass(frozen=True, eq=False)
class _RowErrors:
    """Monte Carlo errors of the log density of each row without it.

    From the influence of each draw (draws, n), of mean zero, and the root of the effective sample
    size.
    """

    influence: Array
    root: float

    @classmethod
    def of(cls, c: Candidate) -> _RowErrors:
        """Of a compared model."""
        return cls(left_out(c.calibration)[0], float(np.sqrt(_least_ess(c))))

    @property
    def each(self) -> Array:
        """Of each row, shape (n,)."""
        return np.asarray(self.influence.std(axis=0) / self.root)

    @property
    def heavy(self) -> float:
        """Root of the draws over those that they are worth for the row of the fewest."""
        return float(np.sqrt(1.0 + np.square(self.influence).mean(axis=0).max()))

    def of_sum(self) -> float:
        """Of the sum over the rows."""
        return self.along(np.ones(self.influence.shape[1]))

    def along(self, lever: Array) -> float:
        """Of the rows times a lever, summed."""
        return float((self.influence @ lever).std() / self.root)
