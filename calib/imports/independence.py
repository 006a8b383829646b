"""How alike neighbouring rows of a continuous run are, and how many independent ones they make."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

type Array = NDArray[np.float64]

# The response is smooth over a tenth of a condition's rows: a pull curve rises over no less. Noise
# that is slower than that counts as response, for one run cannot tell the two apart.
PIECES = 10
# Rows to which the response is fitted, evenly among all, so that the fit takes less than a second.
FITTED_ROWS = 20_000
# An autocorrelation time is known to a tenth or so from fifty of it (emcee's own criterion).
ENOUGH = 50


def autocorrelation_time(
    values: Array, conditions: Sequence[Array], runs: NDArray[np.int64]
) -> float:
    """Return how many neighbouring rows are worth one independent one.

    That is one plus
    twice the sum of the correlations at all distances.

    It is of what the conditions do not explain, so that a sweep is not taken for noise.

    Parameters
    ----------
    values : ndarray, shape (n,)
        Readings in the order of their measurement.
    conditions : sequence of ndarray, shape (n,)
        What they respond to.
    runs : ndarray of int, shape (n,)
        Of each row the run; runs have nothing to do with one another.

    Returns
    -------
    float
        At least 1; NaN if the rows are too few to tell.

    References
    ----------
    Goodman & Weare (2010), doi:10.2140/camcos.2010.5.65; as in `emcee.autocorr`.
    """
    from emcee.autocorr import integrated_time

    if values.size <= ENOUGH or np.ptp(values) == 0.0:
        return float("nan")
    rest = _unexplained(values, [c for c in conditions if np.ptp(c) > 0.0])
    _, run = np.unique(runs, return_inverse=True)
    rest -= (np.bincount(run, rest) / np.bincount(run))[run]
    in_runs = rest[np.argsort(run, kind="stable")]
    if not np.ptp(in_runs) > 1e-9 * np.ptp(values):
        return float("nan")
    time = max(float(integrated_time(in_runs, tol=0, has_walkers=False)[0]), 1.0)
    return time if values.size > ENOUGH * time else float("nan")


def rows_apart(times: Mapping[str, float]) -> int:
    """Return every how many rows are as good as independent, by the outputs' times.

    Twice the time less one: of noise that forgets at a steady rate the rows that are left correlate
    by 0.02 where the time is long and by 0.1 at most; it is one where the rows are independent.
    """
    longest = max((t for t in times.values() if np.isfinite(t)), default=1.0)
    return max(1, round(2.0 * longest - 1.0))


def _unexplained(values: Array, conditions: Sequence[Array]) -> Array:
    """Return what is left of values once a smooth function of the conditions is subtracted.

    The function is the sum of a cubic spline in each condition, whose coefficients change linearly
    with the others.
    """
    from scipy.interpolate import BSpline

    n = values.size
    scaled = [(c - c.mean()) / np.ptp(c) for c in conditions]
    quantiles = np.linspace(0.0, 1.0, PIECES + 1)
    knots = [np.unique(np.quantile(c, quantiles)) for c in scaled]
    knots = [np.concatenate(([k[0]] * 3, k, [k[-1]] * 3)) for k in knots]

    def design(rows: slice) -> Array:
        part = [c[rows] for c in scaled]
        columns = [np.ones((len(values[rows]), 1))]
        for i, (c, k) in enumerate(zip(part, knots, strict=True)):
            spline = BSpline.design_matrix(c, k, 3).toarray()
            others = [o for j, o in enumerate(part) if j != i]
            columns += [spline, *(spline * o[:, None] for o in others)]
        return np.hstack(columns)

    some = slice(0, n, max(1, n // FITTED_ROWS))
    fitted = design(some)
    # Splines add up to one, so the columns are dependent: the smallest coefficients are taken.
    found = np.linalg.lstsq(fitted.T @ fitted, fitted.T @ values[some], rcond=1e-10)[0]
    blocks = (slice(start, start + FITTED_ROWS) for start in range(0, n, FITTED_ROWS))
    return np.concatenate([values[rows] - design(rows) @ found for rows in blocks])
