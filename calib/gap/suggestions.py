"""Simple terms that would explain what the listed causes leave of a gap: suggestions, not causes.

The residual of an output is a constant, a part of the predicted level, one term and noise. Between
terms decides the evidence of this linear model under Zellner's prior with the information of one
row (g = n), with noise of unknown size: Liang et al. (2008), doi:10.1198/016214507000001337.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import numpy as np
from scipy.special import logsumexp, softmax

from calib.data.quantities import OUTPUTS
from calib.gap.constants import ALIKE, FOLDS, NAMED, WORTH_SAYING
from calib.gap.mixture import UNLISTED, Mixture, conditions_to_search
from calib.inference.random import generator
from calib.models.base import Array

type Kind = Literal["linear", "quadratic", "step", "product"]
# Values, and the same scaled to -1..1, shape (n,) each.
type _Conditions = Mapping[str, tuple[Array, Array]]


@dataclass(frozen=True)
class Suggestion:
    """A term that would explain the rest of an output's gap.

    Parameters
    ----------
    kind : {"linear", "quadratic", "step", "product"}
        In conditions scaled to -1..1; a step is beyond `at`.
    factor, rises : bool
        Whether it is a part of the predicted level, not added to it; the coefficient's sign.
    probability : float
        Of the term, and of those that look the same on these rows, against all others and none.
    removed : float
        Part of the squared residual that goes on rows left out, in five parts.
    """

    output: str
    kind: Kind
    columns: tuple[str, ...]
    at: float
    factor: bool
    rises: bool
    probability: float
    removed: float


def suggestions(mixed: Mixture) -> tuple[Suggestion, ...]:
    """Find terms of every output on which something unlisted probably acts, as `suggest` does."""
    data, truth = mixed.data, mixed.at(mixed.data.view, left_out=[UNLISTED])
    found: list[Suggestion] = []
    for o in data.outputs:
        touched = [o.name in fit.forward.hypothesis.smooth_outputs for fit in mixed.fits]
        if np.dot(touched, mixed.probability) < NAMED:
            continue
        level, sd = (truth.mean(v[o.name])[o.rows] for v in (truth.truth, truth.noise))
        conditions = {}
        for name in conditions_to_search(data):
            values, u = data.view.conditions[name][o.rows], data.scaled(data.view, name)
            # What a category may do is among the listed causes.
            if u is not None and np.ptp(values) > 0.0 and not data.case.covariates.get(name):
                conditions[name] = values, u[o.rows]
        residual = data.case.field[OUTPUTS[o.name]][o.rows] - level
        found += suggest(o.name, residual, level, sd, conditions)
    return tuple(found)


def suggest(
    output: str, residual: Array, level: Array, sd: Array, conditions: _Conditions
) -> list[Suggestion]:
    """Find at most three terms of one output, the most probable first.

    Parameters
    ----------
    residual, level, sd : ndarray, shape (n,)
        Reading minus prediction, prediction, and noise sd.
    """
    y, base = residual / sd, np.stack([1.0 / sd, level / sd], axis=1)
    terms = [
        (kind, columns, at, factor, shapes * base[:, int(factor)])
        for kind, columns, at, shapes in _shapes(conditions)
        for factor in (False, True)
    ]
    ln = [_ln_bayes_factors(y, base, x) for *_, x in terms]
    # A step may be anywhere; beforehand nothing is as probable as all terms together.
    evidence = [logsumexp(each) - np.log(each.size * len(terms)) for each in ln]
    nothing, *p = softmax([0.0, *evidence]).tolist()
    looks = [_without(base, x[each.argmax()]) for (*_, x), each in zip(terms, ln, strict=True)]
    looks = [x / max(float(np.linalg.norm(x)), 1e-300) for x in looks]
    # Of terms that look the same on these rows the most probable of the fewest conditions stands
    # for all.
    alike: dict[int, list[int]] = {}
    for i in sorted(range(len(p)), key=lambda i: -p[i]):
        same = next((j for j in alike if abs(looks[j] @ looks[i]) >= ALIKE), i)
        alike.setdefault(same, []).append(i)
    found = []
    for group in alike.values():
        i = min(group, key=lambda j: (len(terms[j][1]), -p[j]))
        together = sum(p[j] for j in group)
        kind, columns, at, factor, x = terms[i]
        if together >= max(nothing, WORTH_SAYING) and (removed := _removed(y, base, x)) > 0.0:
            place, up = float(at[ln[i].argmax()]), bool(looks[i] @ y > 0.0)
            found.append(Suggestion(output, kind, columns, place, factor, up, together, removed))
    found.sort(key=lambda s: -s.probability)
    return found[:3]


def _shapes(conditions: _Conditions) -> Iterator[tuple[Kind, tuple[str, ...], Array, Array]]:
    """Kind, conditions, places (k,) and shapes (k, n) of every term."""
    nowhere = np.zeros(1)
    for name, (values, u) in conditions.items():
        yield "linear", (name,), nowhere, u[None]
        yield "quadratic", (name,), nowhere, np.square(u)[None]
        distinct = np.unique(values)
        between = 0.5 * (distinct[1:] + distinct[:-1])
        yield "step", (name,), between, (values > between[:, None]).astype(np.float64)
    for (a, (_, u)), (b, (_, v)) in combinations(conditions.items(), 2):
        yield "product", (a, b), nowhere, (u * v)[None]


def _without(base: Array, values: Array) -> Array:
    """Rows (..., n) without what the base (n, b) takes up."""
    return np.asarray(values - (base @ np.linalg.lstsq(base, values.T)[0]).T)


def _ln_bayes_factors(y: Array, base: Array, x: Array) -> Array:
    """Of the base (n, b) and each of x (k, n) over the base alone, shape (k,)."""
    rest, left = _without(base, y), _without(base, x)
    n, free = y.size, y.size - np.linalg.matrix_rank(base)
    size = np.square(left).sum(axis=1)
    size[size <= 1e-9 * np.square(x).sum(axis=1)] = np.inf  # all of it is the base's
    share = np.maximum(1.0 - np.square(left @ rest) / size / max(rest @ rest, 1e-300), 0.0)
    return np.asarray(0.5 * ((free - 1) * np.log1p(n) - free * np.log1p(n * share)))


def _removed(y: Array, base: Array, x: Array) -> float:
    """Part of the squared residual that the best of x removes on rows that it was not fitted to."""
    order = generator(0, "gap", "suggestions").permutation(y.size)
    left = np.zeros(2)
    for rows in (order[fold::FOLDS] for fold in range(FOLDS)):
        seen = np.setdiff1d(order, rows)
        best = x[_ln_bayes_factors(y[seen], base[seen], x[:, seen]).argmax()]
        for i, columns in enumerate((base, np.column_stack([base, best]))):
            beta = np.linalg.lstsq(columns[seen], y[seen])[0]
            left[i] += np.square(y[rows] - columns[rows] @ beta).sum()
    return float(1.0 - left[1] / left[0])
