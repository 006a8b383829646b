"""What a calibration assumes of its rows, tested: a warning for each assumption that fails.

The likelihood takes rows as independent, and scattered as it says. Each test has the chance
`LEVEL` of a false alarm on rows that are so; what depends on a file's contents alone has none, or
one that is stated. `docs/statistics/likelihood.md` lists them.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import scipy

from calib.data import Table
from calib.data.quantities import QUANTITIES
from calib.data.units_check import (
    column_notes,
    lines_of,
    source_of,
    spelling_notes,
    unit_notes,
    word_of,
)
from calib.inference.problem import Problem
from calib.models.base import Array
from calib.validation.outliers import linear, outlying_notes

# Chance that a test of residuals warns of rows that are as the likelihood says.
LEVEL = 1e-3
# Chance that readings agree to the last digit, from which equal rows are taken for copies.
_COPIED = 0.01
_FEWEST, _FEWEST_FOR_TAILS = 8, 20
# Draws that are looked at for an edge of where the model has a value, and what part beyond it is.
_PROBES, _MANY = 100, 0.2
_UNIT_FIRST = (
    "whether neighbouring rows are alike, the scatter even and its tails light is not judged while "
    "a column looks to be in another unit"
)


def warnings_of(problem: Problem, t: Array, draws: Array | None = None) -> tuple[str, ...]:
    """Say what a reader should mend, or know, before believing a calibration's width.

    `t` (d,) are internal coordinates of a fit to all rows, for instance the posterior's mode, and
    `draws` (k, d) those of the posterior. Of a column in another unit the priors make a misfit,
    whose residuals say nothing of the rows.
    """
    scatter = float(problem.theta(t[None])[0, -1])
    off = any(column_notes(problem.table))
    return (
        *outlying_notes(problem, t), *file_notes(problem, scatter),
        *((_UNIT_FIRST,) if off else residual_notes(problem, t)),
        *(() if draws is None else _cut_off(problem, draws)),
    )  # fmt: skip


def _cut_off(problem: Problem, draws: Array) -> Iterable[str]:
    """A posterior that ends where the model has no value, and not where the data end it.

    Draws twice as far from their mean as they are lie beyond such an edge: a fifth of them if it is
    nearer than 1.7 sds.
    """
    some = draws[:: max(1, len(draws) // _PROBES)][:_PROBES]
    mean = draws.mean(axis=0)
    t = np.concatenate([mean + 2.0 * (some - mean), mean - 2.0 * (some - mean)])
    t = t[np.isfinite(problem.priors.log_prob(t))]
    nowhere = np.isneginf(problem.log_likelihood(t))
    if nowhere.sum() <= _MANY * len(t):
        return
    # Of the side where there is none, the coordinate that is farthest off.
    away = (t[nowhere].mean(axis=0) - mean) / draws.std(axis=0)
    i = int(np.argmax(np.abs(away)))
    low, high = problem.priors.ppf(np.outer([0.16, 0.84], np.ones(t.shape[1])))[:, i]
    if draws[:, i].std() > 0.25 * (high - low):
        # Of what the data hardly tell, an edge of the model is as much assumed as the prior is.
        return
    at = f"{'large' if away[i] > 0.0 else 'small'} {problem.priors.free[i].name}"
    yield (
        f"{problem.bound.model.name}: the posterior ends where the model has no value, at {at} "
        "above all: it is cut off there, not where the data end it; mend the model there, or "
        "exclude such values by the bounds of the priors"
    )


def file_notes(problem: Problem, scatter: float) -> tuple[str, ...]:
    """Say what is odd in the rows themselves: units, names, copies, conditions that do not vary.

    `scatter` is the sd of a reading about the prediction, on the scale of the response.
    """
    found = [*column_notes(problem.table), *spelling_notes(problem.table)]
    for name, values in problem.conditions.items():
        quantity = QUANTITIES[name]
        if np.unique(values).size == 1:
            found.append(
                f"{source_of(problem.table)}: {word_of(problem.table, quantity)} is the same in "
                "all rows; what depends on it comes from the prior, and predictions elsewhere "
                "with it"
            )
        found += unit_notes(problem.table, quantity, values)
    return (*found, *_few_settings(problem), *_copies(problem, scatter))


def _few_settings(problem: Problem) -> Iterable[str]:
    """Rows at fewer different conditions than there are parameters, however many rows."""
    settings = len(np.unique(np.stack([*problem.conditions.values()], axis=1), axis=0))
    names = set(problem.bound.model.parameters)
    free = sum(prior.name in names for prior in problem.priors.free)
    if settings < free:
        yield (
            f"{source_of(problem.table)}: the rows are at {settings} different settings of the "
            f"conditions, which tell no more than so many numbers about {free} parameters; the "
            "rest comes from the prior"
        )


def _copies(problem: Problem, scatter: float) -> Iterable[str]:
    """Rows that repeat another one exactly, unless the readings are so coarse that some would."""
    table = problem.table
    at = np.stack([*problem.conditions.values()], axis=1)
    _, place, count = np.unique(at, axis=0, return_inverse=True, return_counts=True)
    rows = np.column_stack([place.ravel(), problem.observed])
    _, first, whole = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    copied = first[whole.ravel()] != np.arange(len(table))
    if not copied.any():
        return
    pairs = float((count * (count - 1) / 2.0).sum())
    # Two readings at one condition differ by a normal of sd sqrt(2) sigma, whose density at zero
    # times the last digit is the chance that they agree.
    agree = _last_digit(problem) / (2.0 * np.sqrt(np.pi) * max(scatter, 1e-300))
    if scipy.stats.poisson.sf(int(copied.sum()) - 1, pairs * min(agree, 1.0)) > _COPIED:
        return
    yield (
        f"{source_of(table)}, {lines_of(table, copied)}: {_rows(int(copied.sum()))} another one "
        "exactly; a copy counts as a measurement and narrows every width: delete it, unless it was "
        "measured"
    )


def _last_digit(problem: Problem) -> float:
    """Return the step of the readings, on the scale of the response; zero if there is none."""
    y = problem.observed
    size = float(np.abs(y).max())
    for places in range(10):
        if np.abs(y - np.round(y, places)).max() <= 1e-12 * size:
            step = 10.0**-places
            return float(step / np.median(y)) if problem.bound.model.response == "log" else step
    return 0.0


def residual_notes(problem: Problem, t: Array) -> tuple[str, ...]:
    """Say where the residuals at a fit, `t` (d,), are not as the likelihood has them.

    Residuals are those of the model made linear at the fit, over the noise's scale there (Student's
    as normal scores), so that the moments of linear least squares hold. Of noise that is correlated
    along a run, what each row adds to those before it is tested, without the least squares' part.
    """
    residual, design, rank = linear(problem, t, np.ones(problem.response.size, dtype=bool))
    left = residual.size - rank
    if left < _FEWEST or not float(np.ptp(residual)) > 0.0:
        return ()
    natural = problem.theta(t[None])
    raw = problem.residuals(natural)
    score = problem.noise.normal_scores(raw, natural, problem.conditions)[0]
    leverage = np.sum(design**2, axis=1)
    if problem.serial is not None:
        mean, variance = problem.serial.before(score[None], problem.noise.own("rho", natural))
        score, leverage = ((score - mean) / np.sqrt(variance))[0], np.zeros_like(score)
    judged = leverage < 1.0 - 1e-9
    studentised = np.where(judged, score / np.sqrt(np.where(judged, 1.0 - leverage, 1.0)), 0.0)
    return (
        *(() if problem.serial is not None else _autocorrelated(problem.table, score, design)),
        *_uneven(problem, studentised[judged], judged),
        *_heavy_tailed(problem, studentised[judged]),
    )


def _autocorrelated(table: Table, residual: Array, design: Array) -> Iterable[str]:
    """Durbin and Watson's (1951) test in the order of the file, by their beta approximation."""
    n = residual.size
    d = float(np.square(np.diff(residual)).sum() / np.square(residual).sum())
    mean, variance = durbin_watson_moments(design)
    # On (0, 4) as d is.
    x, v = mean / 4.0, variance / 16.0
    size = x * (1.0 - x) / v - 1.0
    if not scipy.stats.beta.cdf(d / 4.0, x * size, (1.0 - x) * size) < LEVEL:
        return
    r = float(np.clip(1.0 - d / mean, 0.0, 0.99))
    yield (
        f"{source_of(table)}: residuals of neighbouring rows are alike (correlation {r:.2f}), as "
        "in rows of one continuous run, or where the curve misses a pattern; the rows are worth "
        f"about {max(1.0, n * (1.0 - r) / (1.0 + r)):.0f} independent ones, not {n}, so that "
        'widths are too narrow: correlated_along = "run_order" (a column) under [likelihood] in '
        "the prior file widens them; or thin the rows, or look at the residuals"
    )


def durbin_watson_moments(design: Array) -> tuple[float, float]:
    """Mean and variance of Durbin and Watson's statistic under independent normal noise.

    Of d = e'Ae/e'e with A the second difference they are exact: E = P/(n - k) and
    2 (Q - P E)/((n - k)(n - k + 2)), with P and Q the traces of MA and (MA)^2, and M the
    projection on what the design leaves (doi:10.1093/biomet/38.1-2.159), whose columns, shape
    (n, k), are orthonormal and span what was fitted.
    """
    n, rank = design.shape
    left = n - rank
    on_design = _second_difference(design)
    gram = design.T @ on_design
    p = 2.0 * (n - 1) - float(np.trace(gram))
    q = 2.0 * (3 * n - 4) - 2.0 * float(np.square(on_design).sum()) + float(np.square(gram).sum())
    mean = p / left
    return mean, 2.0 * (q - p * mean) / (left * (left + 2.0))


def _second_difference(x: Array) -> Array:
    steps = np.diff(x, axis=0)
    out = np.zeros_like(x)
    out[:-1] -= steps
    out[1:] += steps
    return out


def _uneven(problem: Problem, residual: Array, judged: np.ndarray) -> Iterable[str]:
    """Spearman's rank correlation of the residuals' sizes with each condition that varies."""
    varying = {k: v[judged] for k, v in problem.conditions.items() if np.ptp(v[judged]) > 0.0}
    for name, values in varying.items():
        found = scipy.stats.spearmanr(np.abs(residual), values)
        if found.pvalue < LEVEL / len(varying):
            word, stem = word_of(problem.table, QUANTITIES[name]), QUANTITIES[name].stem
            grows = "grows" if found.statistic > 0.0 else "falls"
            yield (
                f"{source_of(problem.table)}: the scatter {grows} with {word} (rank correlation "
                f"{found.statistic:.2f}); one sigma is too wide at one end and too narrow at the "
                f'other: noise_depends_on = "{stem}" in the prior file lets it change'
            )


def _heavy_tailed(problem: Problem, residual: Array) -> Iterable[str]:
    """Anscombe and Glynn's (1983) test of the kurtosis, one-sided."""
    if residual.size < _FEWEST_FOR_TAILS or problem.noise.student:
        return
    if scipy.stats.kurtosistest(residual, alternative="greater").pvalue < LEVEL:
        yield (
            f"{source_of(problem.table)}: the residuals have heavier tails than normal noise "
            f"(excess kurtosis {scipy.stats.kurtosis(residual):.1f}); single readings then weigh "
            "too much: correct those that are wrong, or write "
            'family = "student_t" in the prior file'
        )


def _rows(n: int) -> str:
    return "this row repeats" if n == 1 else f"these {n} rows repeat"
