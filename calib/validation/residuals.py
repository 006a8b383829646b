"""Tests of residuals at a fit, rows that lie far off, and the remarks that come of them.

The likelihood takes rows as independent, and scattered as it says, about what the conditions of the
model explain. `docs/statistics/likelihood.md` lists the tests; `remarks.toml` has the words.
"""

from __future__ import annotations

import tomllib
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from calib.data import Table
from calib.data.checks import source_of, word_of
from calib.data.files import plain_number
from calib.data.quantities import OUTPUTS, QUANTITIES
from calib.inference.mode import find_modes
from calib.inference.problem import Problem
from calib.models.base import Array
from calib.validation.constants import FEWEST, FEWEST_IN_GROUP, LEVEL, OUTLYING_LEVEL
from calib.validation.scores import holm

WORDS = tomllib.loads(Path(__file__).with_name("remarks.toml").read_text(encoding="utf-8"))


class Range(NamedTuple):
    """Values of a condition, canonical name and unit, ends included."""

    column: str
    low: float
    high: float

    def holds(self, conditions: Mapping[str, Array]) -> bool:
        """Whether any row of some conditions is inside; of a condition that is not there, yes."""
        values = conditions.get(self.column)
        return values is None or bool(((values >= self.low) & (values <= self.high)).any())


@dataclass(frozen=True)
class Remark:
    """A fact that a reader should know before believing a calibration.

    Parameters
    ----------
    text : str
        The fact with its numbers.
    title : str
        Which assumption fails, in two or three words; empty where none does.
    shifts : bool
        Whether the median is off with it, not only the width of the bands.
    where : tuple of Range
        The rows it concerns: those in any of them, all if there is none.
    """

    text: str
    title: str = ""
    shifts: bool = False
    where: tuple[Range, ...] = ()

    def concerns(self, conditions: Mapping[str, Array]) -> bool:
        """Whether it concerns any row of some conditions."""
        return not self.where or any(part.holds(conditions) for part in self.where)


class Check(NamedTuple):
    """The probability of so much or more were an assumption right, and what to say if it is not."""

    p: float
    remark: Remark


def remark(kind: str, *, where: tuple[Range, ...] = (), **fields: Any) -> Remark:
    """Return the remark of a kind, a heading of `remarks.toml`, with the fields of its text."""
    words = WORDS[kind]
    text = words["text"].format(**fields)
    return Remark(text, words.get("title", ""), words.get("shifts", False), where)


def failed(tests: Sequence[Check], level: float = LEVEL) -> tuple[Remark, ...]:
    """Return what the tests say that fail together, in their order, by Holm's (1979) procedure."""
    return tuple(
        t.remark for t, p in zip(tests, holm([t.p for t in tests]), strict=True) if p < level
    )


def linear(problem: Problem, t: Array, used: NDArray[np.bool_]) -> tuple[Array, Array, int]:
    """Residuals (n,), and the model made linear at a fit, orthonormal over the rows used.

    Where the noise depends on a condition, over its scale there in units of sigma. The design is of
    shape (n, rank), of directions that move predictions; the noise scale does not.
    """
    steps = 1e-5 * np.maximum(np.abs(t), 1.0)
    moved = np.concatenate([t[None], t + np.diag(steps), t - np.diag(steps)])
    natural = problem.theta(moved)
    relative = problem.scale(natural[:1]) / natural[0, -1]
    residuals = problem.residuals(natural) / relative
    # One-sided beside ground where the model has no value, as at the edge of an emulator.
    ends = residuals[1:].reshape(2, t.size, -1)
    there = np.isfinite(ends).all(axis=2)
    ends = np.where(there[:, :, None], ends, residuals[0])
    apart = np.maximum(there.sum(axis=0), 1) * steps
    jacobian = ((ends[1] - ends[0]) / apart[:, None]).T
    _, sizes, directions = np.linalg.svd(jacobian[used], full_matrices=False)
    rank = int(np.sum(sizes > 1e-7 * max(float(sizes[0]), 1e-300)))
    return residuals[0], jacobian @ directions[:rank].T / sizes[:rank], rank


def residual_checks(problem: Problem, t: Array) -> tuple[Check, ...]:
    """Test whether the residuals at a fit, `t` (d,), are as the likelihood has them.

    Residuals are those of the model made linear at the fit, over the noise's scale there (Student's
    as normal scores), so that the moments of linear least squares hold. Of noise that is correlated
    along a run, what each row adds to those before it is tested, without the least squares' part.
    """
    residual, design, rank = linear(problem, t, np.ones(problem.response.size, dtype=bool))
    left = residual.size - rank
    if left < FEWEST or not float(np.ptp(residual)) > 0.0:
        return ()
    natural = problem.theta(t[None])
    raw = problem.residuals(natural)
    score = problem.noise.normal_scores(raw, natural, problem.scale(natural))[0]
    leverage = np.sum(design**2, axis=1)
    if problem.serial is not None:
        mean, variance = problem.serial.before(score[None], problem.noise.own("rho", natural))
        score, leverage = ((score - mean) / np.sqrt(variance))[0], np.zeros_like(score)
    judged = leverage < 1.0 - 1e-9
    studentised = np.where(judged, score / np.sqrt(np.where(judged, 1.0 - leverage, 1.0)), np.nan)
    return (
        *unexplained(problem.table, _unused(problem), studentised),
        *(() if problem.serial is not None else autocorrelated(problem.table, score, design)),
        *_uneven(problem, studentised),
        *_heavy_tailed(problem, studentised[judged]),
    )


def unexplained(
    table: Table,
    columns: Mapping[str, NDArray[np.str_] | Array],
    residual: Array,
    *,
    title: str = "",
    hint: str = "",
) -> Iterator[Check]:
    """Whether residuals (n,), in noise sds, differ with a column of a table that is not used.

    Numbers by Spearman's rank correlation, and groups (of a category, of a number with few values,
    of quarters of the rows otherwise) by Kruskal and Wallis's (1952) test.
    """
    for header, cells in columns.items():
        numbers = _numbers(cells)
        category = bool(np.isnan(numbers).all())
        there = np.isfinite(residual) & (np.isfinite(numbers) | category)
        if there.sum() < FEWEST:
            continue
        score, x = residual[there], numbers[there]
        names = cells[there] if category else np.array([plain_number(v) for v in x])
        levels, group, count = np.unique(names, return_inverse=True, return_counts=True)
        remedy = "fit each of its values by itself, or choose a model that has it as a condition"
        if not category and count.min() < FEWEST_IN_GROUP:
            remedy = (
                "choose a model that has it as a condition or, if the readings drift along the "
                'runs, write correlated_along = "run_order" (a column) in the prior file'
            )
            group = np.searchsorted(np.quantile(x, [0.25, 0.5, 0.75]), x)
            group, count = np.unique(group, return_inverse=True, return_counts=True)[1:]
            ends = [(x[group == i].min(), x[group == i].max()) for i in range(count.size)]
            levels = np.array([f"{plain_number(a)} to {plain_number(b)}" for a, b in ends])
        # A category of one row each, as a remark, is none.
        large = np.flatnonzero(count >= (2 if category else FEWEST_IN_GROUP))
        parts = [score[group == i] for i in large]
        found = []
        if not category and np.unique(x).size > 1:
            found.append(scipy.stats.spearmanr(score, x).pvalue)
        if len(parts) > 1 and sum(map(len, parts)) >= FEWEST:
            found.append(scipy.stats.kruskal(*parts).pvalue)
        if not found or len(parts) < 2:
            continue
        means = [float(part.mean()) for part in parts]
        p = min(1.0, len(found) * float(min(found)))
        means_said = " and ".join(
            f"{means[i]:+.1f} noise sds where it is {levels[large[i]]} ({len(parts[i])} rows)"
            for i in (int(np.argmax(means)), int(np.argmin(means)))
        )
        told = remark(
            "unexplained", source=source_of(table), header=header, means=means_said,
            p=plain_number(p, 2), remedy=hint or remedy,
        )  # fmt: skip
        yield Check(p, Remark(told.text, (title or told.title).format(header), told.shifts))


def _unused(problem: Problem) -> dict[str, NDArray[np.str_] | Array]:
    """Columns of the file that neither the model nor the noise uses, other outputs left out."""
    choice = problem.noise
    own = {*problem.conditions, *OUTPUTS.values(), problem.bound.model.output}
    noise = (choice.depends_on, choice.correlated_along)
    own |= {n for n in problem.table if n in QUANTITIES and QUANTITIES[n].stem in noise}
    return unused(problem.table, own)


def unused(table: Table, own: Collection[str]) -> dict[str, NDArray[np.str_] | Array]:
    """Columns of a table as the file has them, save those whose canonical names are in `own`."""
    rest = {n: values for n, values in table.columns.items() if n not in own}
    known = {header: np.asarray(values) for header, values in table.as_in_file(rest).items()}
    # A label's numbers are codes.
    for name in (n for n in table if n in QUANTITIES and QUANTITIES[n].kind == "label"):
        header = table.header_of(name)
        if header in known and header in table.header and len(table.text) == len(table):
            at = table.header.index(header)
            known[header] = np.array([row[at] for row in table.text])
    # Tables that others put together may keep the cells of the rows they came from.
    extra = {h: np.array(cells) for h, cells in table.extra.items() if len(cells) == len(table)}
    return {**known, **extra}


def _numbers(cells: NDArray[np.str_] | Array) -> Array:
    """Cells as numbers, NaN where one is empty; all NaN where any is text."""
    if cells.dtype.kind == "f":
        return np.asarray(cells, dtype=float)
    try:
        return np.array([float(c.strip().replace(",", ".") or "nan") for c in cells])
    except ValueError:
        return np.full(cells.size, np.nan)


def autocorrelated(table: Table, residual: Array, design: Array) -> Iterator[Check]:
    """Durbin and Watson's (1951) test in the order of the rows, by their beta approximation.

    Of residuals (n,); the columns of the design, shape (n, k), are what was fitted.
    """
    n = residual.size
    d = float(np.square(np.diff(residual)).sum() / np.square(residual).sum())
    mean, variance = durbin_watson_moments(design)
    # On (0, 4) as d is.
    x, v = mean / 4.0, variance / 16.0
    size = x * (1.0 - x) / v - 1.0
    r = float(np.clip(1.0 - d / mean, 0.0, 0.99))
    worth = max(1.0, n * (1.0 - r) / (1.0 + r))
    told = remark("dependent", source=source_of(table), r=r, worth=worth, n=n)
    yield Check(float(scipy.stats.beta.cdf(d / 4.0, x * size, (1.0 - x) * size)), told)


def durbin_watson_moments(design: Array) -> tuple[float, float]:
    """Mean and variance of Durbin and Watson's statistic under independent normal noise.

    Of d = e'Ae/e'e with A the second difference they are exact: E = P/(n - k) and
    2 (Q - P E)/((n - k)(n - k + 2)), with P and Q the traces of MA and (MA)^2, and M the
    projection on what the design leaves (doi:10.1093/biomet/38.1-2.159), whose columns, shape
    (n, k), are orthonormal and span what was fitted.
    """
    n, rank = design.shape
    left = n - rank
    steps = np.diff(design, axis=0, prepend=design[:1], append=design[-1:])
    on_design = steps[:-1] - steps[1:]
    gram = design.T @ on_design
    p = 2.0 * (n - 1) - float(np.trace(gram))
    q = 2.0 * (3 * n - 4) - 2.0 * float(np.square(on_design).sum()) + float(np.square(gram).sum())
    mean = p / left
    return mean, 2.0 * (q - p * mean) / (left * (left + 2.0))


def _uneven(problem: Problem, residual: Array) -> Iterator[Check]:
    """Whether the scatter of residuals (n,) differs with a condition.

    By Levene's test, in Brown and Forsythe's form, where every value has its group of rows;
    otherwise by Kendall's rank correlation with their sizes, which is exact for few rows.
    """
    there = np.isfinite(residual)
    for name, every in problem.conditions.items():
        score, values = residual[there], every[there]
        levels, group, count = np.unique(values, return_inverse=True, return_counts=True)
        if levels.size < 2 or name == problem.noise.column:
            continue
        quantity, column = QUANTITIES[name], problem.table.column(name)
        words: dict[str, Any] = {
            "stem": quantity.stem,
            "word": word_of(problem.table, quantity),
        }
        if count.min() < FEWEST_IN_GROUP:
            found = scipy.stats.kendalltau(np.abs(score), values)
            grows = "grows" if found.statistic > 0.0 else "falls"
            told = remark("uneven_trend", grows=grows, tau=found.statistic, **words)
            yield Check(float(found.pvalue), told)
            continue
        parts = [score[group == i] for i in range(levels.size)]
        sd = np.array([part.std(ddof=1) for part in parts])
        wide, tight = int(np.argmax(sd)), int(np.argmin(sd))
        p = float(scipy.stats.levene(*parts).pvalue)
        at = [column.words(levels[i]) for i in (wide, tight)]
        # The values that are nearer to one of the two levels than to any other.
        edges = [-np.inf, *(0.5 * (levels[1:] + levels[:-1])), np.inf]
        near = tuple(Range(name, float(edges[i]), float(edges[i + 1])) for i in (wide, tight))
        yield Check(p, remark(
            "uneven", where=near, wide=at[0], tight=at[1], sd_wide=sd[wide], sd_tight=sd[tight],
            p=plain_number(p, 2), **words,
        ))  # fmt: skip


def _heavy_tailed(problem: Problem, residual: Array) -> Iterator[Check]:
    """Anscombe and Glynn's (1983) test of the kurtosis, one-sided, for which 20 rows suffice."""
    if residual.size < 20 or problem.noise.student:
        return
    p = float(scipy.stats.kurtosistest(residual, alternative="greater").pvalue)
    kurtosis = scipy.stats.kurtosis(residual)
    yield Check(p, remark("heavy", kurtosis=kurtosis))


class OutlyingRow(NamedTuple):
    """A row far off the others' calibration: its line in the file, and the output measured there.

    `sds` is its distance from what the other rows predict, in units of that distance's sd.
    """

    line: int
    value: float
    sds: float


def outlying_rows(problem: Problem, t: Array) -> tuple[OutlyingRow, ...]:
    """Find rows, the farthest first, that are too far from what the others say for any of so many.

    `t` (d,) are internal coordinates of a fit to all rows; none is found where too few would be
    left to judge by. Two that are wrong can hide each other. As in Rosner's (1983) generalised
    procedure, doi:10.1080/00401706.1983.10487848, the row of the largest externally studentised
    residual (Cook & Weisberg 1982, section 2.2, with the model made linear at the fit) is taken out
    and the others are fitted again, a few times; the last time at which it was too large by
    Bonferroni's bound says how many are suspected, and each of these must be too far from the fit
    to the rest. Long data are not fitted again: in them one row hides nothing.
    """
    n = problem.response.size
    long = n > 5000
    most = 1 if long else min(max(2, n // 10), 10)
    used, suspects = np.ones(n, dtype=bool), 0
    order: list[int] = []
    fits = [t]
    while len(order) < most:
        sds, left = _studentised(problem, fits[-1], used)
        if left < 2:
            break
        far = int(np.argmax(sds))
        order.append(far)
        if _probability(sds[far], int(used.sum()), left) < OUTLYING_LEVEL / most:
            suspects = len(order)
        used[far] = False
        fits.append(fits[-1] if long else _fitted(problem, fits[-1], used))
    if not suspects:
        return ()
    used = np.ones(n, dtype=bool)
    used[order[:suspects]] = False
    # Distances from the fit to the rest, in sds of a new row's.
    residual, design, rank = linear(problem, fits[suspects], used)
    left = int(used.sum()) - rank
    variance = max(float(np.sum(residual[used] ** 2)) / left, 1e-300)
    sds = np.abs(residual) / np.sqrt(variance * (1.0 + np.sum(design**2, axis=1)))
    probability = _probability(sds, n, left)
    rows = [
        OutlyingRow(int(problem.table.lines[i]), float(problem.observed[i]), float(sds[i]))
        for i in np.flatnonzero((probability < OUTLYING_LEVEL) & (~used | long))
    ]
    return tuple(sorted(rows, key=lambda row: -row.sds))


def outlying_notes(problem: Problem, t: Array) -> list[str]:
    """Say which rows are outlying, for a reader who may correct them."""
    rows = outlying_rows(problem, t)
    weight = "for one such row moves the posterior and widens it"
    if problem.noise.student:
        weight = "to which Student-t noise gives little weight"
    source = source_of(problem.table)
    column = problem.table.column(problem.bound.model.output)
    said = [
        f"{source}, line {row.line}: {column.header} = "
        f"{plain_number(float(column.written(row.value)), 4)} is {row.sds:.1f} sds from what the "
        f"other rows say; check the reading, {weight}"
        for row in rows[:5]
    ]
    return said + [f"{source}: so are {len(rows) - 5} more"] * (len(rows) > 5)


def _studentised(problem: Problem, t: Array, used: NDArray[np.bool_]) -> tuple[Array, int]:
    """Externally studentised residuals of the rows used, and the variance's degrees of freedom."""
    residual, design, rank = linear(problem, t, used)
    leverage = np.sum(design**2, axis=1)
    left = int(used.sum()) - rank - 1
    # A row that a parameter of its own fits exactly cannot be judged.
    judged = used & (leverage < 1.0 - 1e-9)
    alone = np.where(judged, 1.0 - leverage, 1.0)
    variance = np.maximum(np.sum(residual[used] ** 2) - residual**2 / alone, 0.0) / max(left, 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        sds = np.abs(residual) / np.sqrt(variance * alone)
    return np.where(judged, np.nan_to_num(sds, nan=0.0, posinf=1e9), 0.0), left


def _fitted(problem: Problem, t: Array, used: NDArray[np.bool_]) -> Array:
    """Fit some rows, starting at another fit."""
    some = problem.with_table(problem.table.take(used))
    # Nothing is drawn: the one start is given.
    rng = np.random.default_rng(0)
    return find_modes(some.log_prob, some.priors, rng, starts=t[None], spread=0)[0].t


def _probability(sds: Array | float, n: int, left: int) -> Any:
    """Of so large a distance in any of n rows of normal noise (Bonferroni's bound)."""
    return np.minimum(2.0 * n * scipy.stats.t.sf(sds, left), 1.0)
