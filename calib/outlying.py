"""Rows that a calibration's other rows do not expect: a slip of the pen weighs as much as a row."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from calib.models.base import Array
from calib.problem import Problem

__all__ = ["OutlyingRow", "outlying_notes", "outlying_rows"]

# Probability of naming any row of data that are as the likelihood says.
LEVEL = 1e-3
_STEP = 1e-5
_MOST_NAMED = 5


@dataclass(frozen=True)
class OutlyingRow:
    """A row far off the others' calibration.

    Parameters
    ----------
    line : int
        Of the file.
    value : float
        The output measured there.
    sds : float
        Its distance from what the other rows predict, in units of that distance's sd.
    probability : float
        Of a distance as large in any row, had all the same normal noise.
    """

    line: int
    value: float
    sds: float
    probability: float


def outlying_rows(problem: Problem, t: Array) -> tuple[OutlyingRow, ...]:
    """Find rows whose externally studentised residual is too large for any of so many.

    Parameters
    ----------
    problem : Problem
    t : ndarray, shape (d,)
        Internal coordinates of a fit, for instance the posterior's mode.

    Returns
    -------
    tuple of OutlyingRow
        The farthest first; empty where too few rows would be left to judge by.

    Notes
    -----
    Cook & Weisberg (1982), Residuals and Influence in Regression, section 2.2, with the model made
    linear at the fit and Bonferroni's correction for as many rows.
    """
    residual = problem.residuals(problem.theta(t[None]))[0]
    leverage, rank = _leverage(problem, t)
    n = residual.size
    left = n - rank - 1
    if left < 2:
        return ()
    # The variance without the row, from that with it.
    alone = np.maximum(1.0 - leverage, 1e-12)
    variance = np.maximum(np.sum(residual**2) - residual**2 / alone, 0.0) / left
    with np.errstate(divide="ignore", invalid="ignore"):
        sds = np.abs(residual) / np.sqrt(variance * alone)
    probability = np.minimum(2.0 * n * stats.t.sf(sds, left), 1.0)
    # A row that a parameter of its own fits exactly cannot be judged.
    found = np.flatnonzero((probability < LEVEL) & (leverage < 1.0 - 1e-9))
    rows = [
        OutlyingRow(
            int(problem.table.lines[i]),
            float(problem.observed[i]),
            float(sds[i]),
            float(probability[i]),
        )
        for i in found
    ]
    return tuple(sorted(rows, key=lambda row: -row.sds))


def outlying_notes(problem: Problem, t: Array) -> Sequence[str]:
    """Say which rows are outlying, for a reader who may mend them."""
    rows = outlying_rows(problem, t)
    output, source = problem.bound.model.output, problem.table.source
    said = [
        f"{source}, line {row.line}: {output} = {row.value:.4g} is {row.sds:.1f} sds from what the "
        "other rows say; check the reading, for one such row moves the posterior and widens it"
        for row in rows[:_MOST_NAMED]
    ]
    more = len(rows) - _MOST_NAMED
    return [*said, f"{source}: so are {more} more"] if more > 0 else said


def _leverage(problem: Problem, t: Array) -> tuple[Array, int]:
    """Diagonal of the hat matrix of the model made linear at a fit, and its rank."""
    steps = _STEP * np.maximum(np.abs(t), 1.0)
    moved = np.concatenate([t + np.diag(steps), t - np.diag(steps)])
    location = -problem.residuals(problem.theta(moved))
    d = t.size
    jacobian = ((location[:d] - location[d:]) / (2.0 * steps)[:, None]).T
    # The noise scale moves no prediction; other columns may be alike.
    u, sizes, _ = np.linalg.svd(jacobian, full_matrices=False)
    rank = int(np.sum(sizes > 1e-7 * max(float(sizes[0]), 1e-300)))
    return np.sum(u[:, :rank] ** 2, axis=1), rank
