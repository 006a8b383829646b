"""Conditions that cannot be right: one row's is set aside, a column's in another unit refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calib.data import Table
from calib.data.numbers import plain_number
from calib.data.quantities import OUTPUTS, QUANTITIES, role_of
from calib.data.units_check import mixed_units
from calib.errors import CalibError
from calib.gap.campaigns import MAX_RATIO
from calib.gap.case import Case
from calib.models import get_model
from calib.models.base import Array

__all__ = ["check_units", "without_far_conditions"]

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
            allowed=f"campaigns whose conditions differ by less than a factor of {MAX_RATIO:g}",
            mend="check the units in the column names",
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
