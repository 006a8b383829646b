"""Where the gap lies: every row, and contiguous regions of the conditions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from calib.data import Table
from calib.data.quantities import OUTPUTS, columns_of
from calib.gap.campaigns import Campaigns
from calib.gap.covariates import other_conditions
from calib.gap.mixture import Truth
from calib.models.base import Array

__all__ = ["Region", "RowGap", "conditions_to_search", "regions", "row_gaps", "unused_rows"]

# Physical roles of the conditions, in the order in which a reader looks for a cause; others follow.
_ROLES = (
    "slip", "pressure", "ground_pressure", "speed", "passes", "water", "water_by_volume", "cone",
    "load", "order",
)  # fmt: skip
# The fewest rows of a region: this part of an output's rows, and two.
_FEWEST_PART, _FEWEST = 1 / 12, 2
_MOST = 3
# Why a row was not judged by.
_NO_READING = "there is no reading"
_SET_ASIDE = "the reading was set aside as an outlier or as no reading at all"
_MOVED = "the conditions were set aside as a mistake; the gap is where they typically are"


@dataclass(frozen=True)
class RowGap:
    """Gap of one output at the rows of the field campaign.

    Parameters
    ----------
    output : str
    rows : ndarray of int, shape (n,)
    gap, sd : ndarray, shape (n,)
        Posterior mean and sd of truth minus simulator, in the output's unit.
    probability : ndarray, shape (n,)
        That the true gap is larger than the noise. Hypotheses without a gap count with their
        probability, so that a null campaign stays quiet over all of its rows at once.
    """

    output: str
    rows: NDArray[np.int64]
    gap: Array
    sd: Array
    probability: Array


@dataclass(frozen=True)
class Region:
    """A stretch of one condition, or a value of a category, over which the gap exceeds the noise.

    Parameters
    ----------
    output : str
    conditions : mapping of str to (float, float)
        Its ends; of a category both are the place of one value in its list.
    gap : float
        Posterior mean of the mean gap over its rows, in the output's unit.
    interval : tuple of float
        Of the mean gap, 90 %.
    probability : float
        That the mean gap exceeds the noise.
    """

    output: str
    conditions: Mapping[str, tuple[float, float]]
    gap: float
    interval: tuple[float, float]
    probability: float


def conditions_to_search(data: Campaigns) -> list[str]:
    """Return the recorded conditions along which a gap may lie somewhere, in a reader's order.

    Those that the case declares come last.
    """
    roles = (*_ROLES, *other_conditions(data.view))
    known = [c for role in roles for c in columns_of(role) if c in data.view.conditions]
    return [*known, *data.case.covariates]


def row_gaps(
    data: Campaigns, truth: Truth, of: Mapping[str, NDArray[np.int64]] | None = None
) -> tuple[RowGap, ...]:
    """Gap at every field row that has the output, or at other rows of each output."""
    found = []
    for o in data.outputs:
        rows = o.rows if of is None else of[o.name]
        gap = (truth.truth[o.name] - truth.simulator[o.name])[:, rows]
        noise = truth.noise[o.name][:, rows]
        mean = truth.mean(gap)
        sd = np.sqrt(np.maximum(truth.mean(np.square(gap)) - mean**2, 0.0))
        probability = truth.mean((np.abs(gap) > noise).astype(np.float64))
        found.append(RowGap(o.name, rows, mean, sd, np.clip(probability, 0.0, 1.0)))
    return tuple(found)


def unused_rows(data: Campaigns, field: Table) -> dict[str, dict[int, str]]:
    """Return the field rows that an output was not judged by, with the reason.

    Parameters
    ----------
    data : Campaigns
        Without what was set aside.
    field : Table
        The campaign as it was read.
    """
    kept = data.case.field
    moved = np.any(
        [kept[n] != values for n, values in field.columns.items() if n not in OUTPUTS.values()],
        axis=0,
    )
    found: dict[str, dict[int, str]] = {}
    for o in data.outputs:
        read = np.isfinite(field[OUTPUTS[o.name]])
        found[o.name] = {
            int(row): _NO_READING if not read[row] else _MOVED if moved[row] else _SET_ASIDE
            for row in np.setdiff1d(np.arange(len(field)), o.rows)
        }
    return found


def regions(data: Campaigns, truth: Truth, gaps: tuple[RowGap, ...]) -> tuple[Region, ...]:
    """Contiguous stretches of a condition in which rows probably have a gap of one sign.

    The surest first; the others are sought among the rows that lie in none of those before, or
    every condition would have a stretch that is but the shadow of the first.
    """
    found: list[Region] = []
    for o, row_gap in zip(data.outputs, gaps, strict=True):
        draws = (truth.truth[o.name] - truth.simulator[o.name])[:, o.rows]
        noise = truth.noise[o.name][:, o.rows]
        left = np.ones(o.rows.size, dtype=bool)
        searched = conditions_to_search(data)
        varied = [n for n in searched if np.ptp(data.view.conditions[n][o.rows]) > 0.0]
        for _ in range(_MOST):
            best: tuple[float, Region, NDArray[np.bool_]] | None = None
            # Where none varies one stands for all rows.
            for name in varied or searched[:1]:
                values = data.view.conditions[name][o.rows]
                category = bool(data.case.covariates.get(name))
                for low, high in _stretches(values, row_gap, left, category):
                    inside = (values >= low) & (values <= high)
                    region = _region(truth, o.name, {name: (low, high)}, draws, noise, inside)
                    # As many readings of one mean gap: what tells a long stretch from a short one.
                    weight = region.probability * abs(region.gap) * np.sqrt((inside & left).sum())
                    if region.probability > 0.5 and (best is None or weight > best[0]):
                        best = (float(weight), region, inside)
            if best is None:
                break
            found.append(best[1])
            left &= ~best[2]
    return tuple(found)


def _region(
    truth: Truth, output: str, conditions: Mapping[str, tuple[float, float]], draws: Array,
    noise: Array, inside: NDArray[np.bool_],
) -> Region:  # fmt: skip
    mean = draws[:, inside].mean(axis=1)
    beyond = np.abs(mean) > noise[:, inside].mean(axis=1)
    ends = _quantile(truth, mean, 0.05), _quantile(truth, mean, 0.95)
    probability = min(float(truth.weight @ beyond), 1.0)
    return Region(output, conditions, float(truth.weight @ mean), ends, probability)


def _quantile(truth: Truth, draws: Array, q: float) -> float:
    return float(truth.quantile(draws[:, None], q)[0])


def _stretches(
    values: Array, gap: RowGap, left: NDArray[np.bool_], category: bool
) -> list[tuple[float, float]]:
    """The stretches of distinct values whose rows, those left, probably have a gap of one sign.

    Values of a category have no order, so that each is a stretch of its own.
    """
    distinct = np.unique(values)
    groups = np.array_split(distinct, distinct.size if category else min(8, distinct.size))
    rows = [(values >= group[0]) & (values <= group[-1]) & left for group in groups]
    signs = [_sign(gap, inside) for inside in rows]
    fewest = max(_FEWEST, int(_FEWEST_PART * values.size))
    found = []
    for (sign, _), run in groupby(
        range(len(groups)), key=lambda i: (signs[i], i if category else 0)
    ):
        at = list(run)
        if sign and sum(int(rows[i].sum()) for i in at) >= fewest:
            found.append((float(groups[at[0]][0]), float(groups[at[-1]][-1])))
    return found


def _sign(gap: RowGap, inside: NDArray[np.bool_]) -> float:
    """The sign of the mean gap of some rows; 0 unless a gap of that sign is probable in them."""
    if not inside.any():
        return 0.0
    sign = np.sign(gap.gap[inside].mean())
    same = gap.probability[inside] * (np.sign(gap.gap[inside]) == sign)
    return float(sign) if same.mean() > 0.5 else 0.0
