"""Where the gap lies: every row, and contiguous regions of the conditions.

Where the gap lies: every row, and contiguous regions of the conditions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from calib.data import Table
from calib.data.files import plain_number
from calib.data.quantities import OUTPUTS, QUANTITIES, columns_of, role_of
from calib.data.units_check import mixed_units
from calib.errors import CalibError
from calib.gap.campaigns import MAX_RATIO, Campaigns
from calib.gap.case import Case
from calib.gap.covariates import other_conditions
from calib.gap.mixture import Truth
from calib.models import get_model
from calib.models.base import Array

# Runs may come in any order and number.
_ANY = "order"
# A value is far from all others if it lies this part of their range beyond them, and by no less
# than a factor of `_LEAST_FACTOR`; of quantities that may be negative, than half their size.
_FAR = 1.5
_LEAST_FACTOR = 8.0
# Part of both campaigns that may lie off before it is the campaigns' own way.
_MOST = 0.05
# Of fewer rows nobody knows which is the odd one.
_FEWEST = 4


def check_units(case: Case) -> None:
    """Refuse campaigns whose conditions cannot be in the same unit.

    Raises
    ------
    CalibError
        Naming the column and its typical values.
    """
    for name in _used(case):
        if name not in case.lab or name not in case.field:
            continue
        lab, field = (float(np.median(table[name])) for table in (case.lab, case.field))
        if min(lab, field) <= 0.0 or 1.0 / MAX_RATIO < field / lab < MAX_RATIO:
            continue
        unit = QUANTITIES[name].unit
        raise CalibError(
            f"{QUANTITIES[name].word} is typically {plain_number(field)} {unit} in the field and "
            f"{plain_number(lab)} {unit} in the calibration",
            where=f"{case.field.source}, column {case.field.header_of(name)!r}",
            expected=f"campaigns whose conditions differ by less than a factor of {MAX_RATIO:g}",
            hint="check the units in the column names",
        )


def without_far_conditions(case: Case) -> tuple[Case, list[str]]:
    """Set rows aside whose conditions are far from those of all others, as a typing error's are.

    Their outputs are left out and the condition taken as it typically is, so that rows keep their
    numbers. What was set aside is said beside the case.
    """
    lab, field = case.lab, case.field
    said: list[str] = []
    for name in case.field:
        if role_of(name) == _ANY or name in OUTPUTS.values() or name not in case.lab:
            continue
        if case.covariates.get(name):  # a category has no distances
            continue
        both = np.concatenate([lab[name], field[name]])
        far = _far(both) | _in_another_unit(name, both)
        in_lab, in_field = (np.flatnonzero(part) for part in (far[: len(lab)], far[len(lab) :]))
        if in_lab.size:
            said.append(_said(lab, name, in_lab))
            lab = _blanked(lab, name, in_lab)
        if in_field.size:
            said.append(_said(field, name, in_field))
            field = _blanked(field, name, in_field)
    return replace(case, lab=lab, field=field), said


def _used(case: Case) -> list[str]:
    """Conditions that the case's models take."""
    found = [name for model in case.models.values() for name in get_model(model).conditions]
    return list(dict.fromkeys(found))


def _far(values: Array) -> NDArray[np.bool_]:
    """Which values lie far from all others; none where many do, or nothing is known."""
    positive = bool(values.min() > 0.0)
    u = np.log(values) if positive else values
    order = np.sort(u)
    k = max(1, int(_MOST * u.size))
    if u.size < _FEWEST:
        return np.zeros(u.size, dtype=bool)
    low, high = float(order[k]), float(order[-k - 1])
    least = float(np.log(_LEAST_FACTOR)) if positive else max(0.5 * max(abs(low), abs(high)), 0.1)
    reach = max(_FAR * (high - low), least)
    return np.asarray((u < low - reach) | (u > high + reach))


def _in_another_unit(name: str, values: Array) -> NDArray[np.bool_]:
    """Which few rows hold another row's value in another unit."""
    known = QUANTITIES.get(name)
    if known is None:
        return np.zeros(values.size, dtype=np.bool_)
    odd, _ = mixed_units(known, values)
    return odd & (odd.sum() <= max(1, int(_MOST * values.size)))


def _blanked(table: Table, name: str, rows: NDArray[np.int64]) -> Table:
    columns = {column: np.array(values) for column, values in table.columns.items()}
    columns[name][rows] = np.median(np.delete(columns[name], rows))
    for output in OUTPUTS.values():
        if output in columns:
            columns[output][rows] = np.nan
    return replace(table, columns=columns)


def _said(table: Table, name: str, rows: NDArray[np.int64]) -> str:
    header = table.header_of(name)
    values = table.column(name).written(table[name]) if name in QUANTITIES else table[name]
    at = ", ".join(
        f"line {table.lines[row]} ({header} = {plain_number(values[row], 4)})" for row in rows
    )
    return (
        f"{table.source}, {at}: far from all other rows of both campaigns, or as in another unit; "
        "left out as a mistake (if it is none, add rows between)"
    )


# Physical roles of the conditions, in the order in which a reader looks for a cause; others follow.
_ROLES = (
    "slip", "pressure", "ground_pressure", "speed", "passes", "water", "water_by_volume", "cone",
    "load", "order",
)  # fmt: skip
# The fewest rows of a region: this part of an output's rows, and two.
_FEWEST_PART, _FEWEST_ROWS = 1 / 12, 2
_MOST_REGIONS = 3
# Why a row was not judged by.
_NO_READING = "there is no reading"
_SET_ASIDE = "the reading was set aside as an outlier or as no reading at all"
_MOVED = "the conditions were set aside as a mistake; the gap is where they typically are"


@dataclass(frozen=True)
class RowGap:
    """Gap of one output at the rows of the field campaign.

    Parameters
    ----------
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
        for _ in range(_MOST_REGIONS):
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
    fewest = max(_FEWEST_ROWS, int(_FEWEST_PART * values.size))
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
