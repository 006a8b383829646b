"""Rows that nothing explains: set aside before they can name a cause or hide one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calib.data import Table
from calib.data.checks import check_conditions, mixed_units
from calib.data.files import plain_number
from calib.data.quantities import OUTPUTS, QUANTITIES, role_of
from calib.gap.campaigns import Campaigns, OutputData, campaigns, check_ratio
from calib.gap.case import Case
from calib.gap.constants import (
    FAR_CONDITION,
    FAR_FACTOR,
    FAR_PART,
    FIELD_OUTLIER,
    IMPOSSIBLE_READING,
    LAB_OUTLIER,
    LEFT_OVER,
    MOST_ROUNDS,
)
from calib.gap.fit import Fit
from calib.gap.ranking import Lab, Ranking, calibrate_lab
from calib.models import get_model
from calib.models.base import Array


def check_units(case: Case) -> None:
    """Refuse campaigns whose conditions cannot be in the same unit."""
    used = {c: None for model in case.models.values() for c in get_model(model).conditions}
    check_conditions(
        case.field, {c: case.lab[c] for c in used if c in case.lab and c in case.field}
    )
    for name in used:
        if name in case.lab and name in case.field:
            lab, field = (float(np.median(table[name])) for table in (case.lab, case.field))
            if min(lab, field) > 0.0:
                check_ratio(case, name, lab, field, "conditions")


def without_far_conditions(case: Case) -> tuple[Case, list[str]]:
    """Set rows aside whose conditions are far from those of all others, as a typing error's are.

    Their outputs are left out and the condition taken as it typically is, so that rows keep their
    numbers. What was set aside is said beside the case.
    """
    lab, field = case.lab, case.field
    said: list[str] = []
    for name in case.field:
        if role_of(name) == "order" or name in OUTPUTS.values() or name not in case.lab:
            continue
        if case.covariates.get(name):  # a category has no distances
            continue
        both = np.concatenate([lab[name], field[name]])
        far = _far(both) | _in_another_unit(name, both)
        in_lab, in_field = (np.flatnonzero(part) for part in (far[: len(lab)], far[len(lab) :]))
        if in_lab.size:
            said.append(_said_conditions(lab, name, in_lab))
            lab = _without_condition(lab, name, in_lab)
        if in_field.size:
            said.append(_said_conditions(field, name, in_field))
            field = _without_condition(field, name, in_field)
    return replace(case, lab=lab, field=field), said


def _far(values: Array) -> NDArray[np.bool_]:
    """Which values lie far from all others; none where many do, or nothing is known."""
    positive = bool(values.min() > 0.0)
    u = np.log(values) if positive else values
    order = np.sort(u)
    k = max(1, int(FAR_PART * u.size))
    if u.size < 4:
        return np.zeros(u.size, dtype=bool)
    low, high = float(order[k]), float(order[-k - 1])
    least = float(np.log(FAR_FACTOR)) if positive else max(0.5 * max(abs(low), abs(high)), 0.1)
    reach = max(FAR_CONDITION * (high - low), least)
    return np.asarray((u < low - reach) | (u > high + reach))


def _in_another_unit(name: str, values: Array) -> NDArray[np.bool_]:
    """Which few rows hold another row's value in another unit."""
    known = QUANTITIES.get(name)
    if known is None:
        return np.zeros(values.size, dtype=np.bool_)
    odd, _ = mixed_units(known, values)
    return odd & (odd.sum() <= max(1, int(FAR_PART * values.size)))


def _without_condition(table: Table, name: str, rows: NDArray[np.int64]) -> Table:
    columns = {column: np.array(values) for column, values in table.columns.items()}
    columns[name][rows] = np.median(np.delete(columns[name], rows))
    for output in OUTPUTS.values():
        if output in columns:
            columns[output][rows] = np.nan
    return replace(table, columns=columns)


def _said_conditions(table: Table, name: str, rows: NDArray[np.int64]) -> str:
    header = table.header_of(name)
    values = table.column(name).written(table[name]) if name in QUANTITIES else table[name]
    at = ", ".join(
        f"line {table.lines[row]} ({header} = {plain_number(values[row], 4)})" for row in rows
    )
    return (
        f"{table.source}, {at}: far from all other rows of both campaigns, or as in another unit; "
        "left out as a mistake (if it is none, add rows between)"
    )


def screen(case: Case, seed: int) -> tuple[Campaigns, Lab, list[str]]:
    """Set readings aside that a laboratory's calibration must not be made from.

    Returns
    -------
    Campaigns
        Of the rows that are left.
    Lab
        The simulators calibrated on what is left of the laboratory.
    list of str
        What was set aside, and why.

    Raises
    ------
    CalibError
        If the case cannot be diagnosed.
    """
    data = campaigns(case)  # refuses what cannot be diagnosed, before rows are set aside
    check_units(case)
    case, far = without_far_conditions(case)
    case, impossible = _without_impossible(case)
    said = far + impossible
    data, lab, outlying = _without_lab_outliers(campaigns(case) if said else data, seed)
    return data, lab, said + outlying


def without_field_outliers(data: Campaigns, ranking: Ranking) -> tuple[Campaigns, list[str], bool]:
    """Set field rows aside that lie far from an explanation, however good it is for the others.

    Returns
    -------
    Campaigns
    list of str
        What was set aside.
    bool
        Whether the most probable explanation leaves it, not only all of one cause: a set may bend
        to a reading.
    """
    sure = _field_outliers(data, [ranking.best(ranking.order[0])])
    one = [ranking.best(name) for name in ranking.order if "+" not in name and name != "unknown"]
    far = sure or _field_outliers(data, one)
    if not far:
        return data, [], False
    said = _said(data.case.field, far, _outlying(FIELD_OUTLIER))
    return campaigns(without_outputs(data.case, far)), said, bool(sure)


def left_over(data: Campaigns, ranking: Ranking) -> list[str]:
    """Name the readings that the most probable hypothesis leaves far off, though not set aside."""
    best = ranking.best(ranking.order[0])
    field, said = data.case.field, []
    for o in data.outputs:
        z = best.field_residuals[o.name]
        at = ", ".join(
            f"line {field.lines[o.rows[i]]} ({z[i]:+.1f} noise sds)"
            for i in np.argsort(-np.abs(z))
            if abs(z[i]) > LEFT_OVER
        )
        if at:
            said.append(
                f"{field.source}, {at}: {o.name.replace('_', ' ')} is far from the most probable "
                "explanation; something may act there that it does not name: check these readings"
            )
    return said


def without_outputs(case: Case, rows: Mapping[str, Sequence[int] | NDArray[np.int64]]) -> Case:
    """Take outputs of field rows out of a case, their conditions left in."""
    return replace(case, field=_blanked(case.field, rows))


def _without_impossible(case: Case) -> tuple[Case, list[str]]:
    """Set readings aside that cannot be any, unless most of an output's are so."""
    lab, lab_said = _possible(case.lab, case)
    field, field_said = _possible(case.field, case)
    return replace(case, lab=lab, field=field), lab_said + field_said


def _possible(table: Table, case: Case) -> tuple[Table, list[str]]:
    """Blank one campaign's readings that cannot be any, and say which."""
    far: dict[str, list[int]] = {}
    for output in case.models:
        values = table[OUTPUTS[output]]
        low, middle, high = np.nanquantile(case.lab[OUTPUTS[output]], (0.1, 0.5, 0.9))
        reach = IMPOSSIBLE_READING * (high - low)
        off = np.abs(values - middle) > reach
        if reach > 0.0 and 0 < off.sum() < 0.5 * np.isfinite(values).sum():
            far[output] = np.flatnonzero(off).tolist()
    why = (
        f"more than {IMPOSSIBLE_READING:g} times the range of the calibration's readings off them; "
        "left out as no reading at all (leave the cell empty where nothing was measured)"
    )
    return _blanked(table, far), _said(table, far, why)


def _blanked(table: Table, rows: Mapping[str, Sequence[int] | NDArray[np.int64]]) -> Table:
    columns = {name: np.array(values) for name, values in table.columns.items()}
    for output, which in rows.items():
        columns[OUTPUTS[output]][which] = np.nan
    return replace(table, columns=columns)


def _outlying(bar: float) -> str:
    return f"more than {bar:g} noise sds off whatever the hypothesis; left out as an outlier"


def _said(table: Table, far: Mapping[str, list[int]], why: str) -> list[str]:
    """Say of each value that is set aside where in its file it is, and why."""
    said = []
    for output, rows in far.items():
        column = OUTPUTS[output]
        at = ", ".join(
            f"line {table.lines[row]} ({column} = {plain_number(table[column][row], 4)})"
            for row in rows
        )
        said.append(f"{table.source}, {at}: {why}")
    return said


def _field_outliers(data: Campaigns, fits: Sequence[Fit]) -> dict[str, list[int]]:
    """Rows of each output that are far from all of some explanations."""
    far = {}
    for o in data.outputs:
        least = np.min([np.abs(f.field_residuals[o.name]) for f in fits], axis=0)
        found = least > FIELD_OUTLIER
        if 0 < found.sum() <= _most(o.rows.size):
            far[o.name] = [int(row) for row in o.rows[found]]
    return far


def _most(n: int) -> int:
    """Many rows that lie off are a gap that is not understood, not outliers."""
    return max(1, n // 10)


def _without_lab_outliers(data: Campaigns, seed: int) -> tuple[Campaigns, Lab, list[str]]:
    """The campaigns without them, and the simulators calibrated on what is left of the lab."""
    case = data.case
    lab = calibrate_lab(data, seed)
    said: list[str] = []
    for _ in range(MOST_ROUNDS):
        far = {}
        for o in data.outputs:
            z = _robust_residuals(o, lab[0][o.name])
            found = np.abs(z) > LAB_OUTLIER
            if 0 < found.sum() <= _most(z.size):
                measured = np.flatnonzero(np.isfinite(case.lab[OUTPUTS[o.name]]))
                far[o.name] = [int(row) for row in measured[found]]
        if not far:
            break
        said += _said(case.lab, far, _outlying(LAB_OUTLIER))
        case = replace(case, lab=_blanked(case.lab, far))
        data = campaigns(case)
        lab = calibrate_lab(data, seed)
    return data, lab, said


def _robust_residuals(o: OutputData, mode: Array) -> Array:
    """Residuals of the laboratory fit in robust sds, shape (n,)."""
    residual = o.lab_residuals(mode)
    robust = 1.4826 * float(np.median(np.abs(residual - np.median(residual))))
    return np.asarray(residual / max(robust, 1e-12))
