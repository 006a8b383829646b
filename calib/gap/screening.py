"""Rows that nothing explains: set aside before they can name a cause or hide one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calib.data import Table
from calib.data.files import plain_number
from calib.data.quantities import OUTPUTS
from calib.gap.campaigns import Campaigns, OutputData, campaigns
from calib.gap.case import Case
from calib.gap.where import check_units, without_far_conditions
from calib.gap.which import Lab, Ranking, calibrate_lab
from calib.models.base import Array

# Standardised residual beyond which a field row is set aside, and how often that is repeated.
OUTLIER = 5.0
# In the laboratory the row itself widens the noise, so the unit is a robust sd, and the bar higher.
LAB_OUTLIER = 8.0
MOST_ROUNDS = 3
# A reading so many times the spread of the laboratory's off them is none: a code for "missing", a
# misplaced decimal point. No gap is a tenth as large.
_IMPOSSIBLE = 20.0
# Beyond this a reading is named; of noise alone, one in 2000 readings is.
LEFT_OVER = 3.5


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


def without_field_outliers(data: Campaigns, ranking: Ranking) -> tuple[Campaigns, list[str]]:
    """Set field rows aside that no hypothesis explains, however good it is for the others.

    Returns
    -------
    Campaigns
        The same object where there are none.
    list of str
        What was set aside, and why.
    """
    far = _field_outliers(data, ranking)
    if not far:
        return data, []
    said = _said(data.case.field, far, _outlying(OUTLIER))
    return campaigns(without_outputs(data.case, far)), said


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
        reach = _IMPOSSIBLE * (high - low)
        off = np.abs(values - middle) > reach
        if reach > 0.0 and 0 < off.sum() < 0.5 * np.isfinite(values).sum():
            far[output] = np.flatnonzero(off).tolist()
    why = (
        f"more than {_IMPOSSIBLE:g} times the range of the calibration's readings off them; left "
        "out as no reading at all (leave the cell empty where nothing was measured)"
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


def _field_outliers(data: Campaigns, ranking: Ranking) -> dict[str, list[int]]:
    best = ranking.best(ranking.order[0])
    far = {}
    for o in data.outputs:
        found = np.abs(best.field_residuals[o.name]) > OUTLIER
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
            z = _lab_residuals(o, lab[0][o.name])
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


def _lab_residuals(o: OutputData, mode: Array) -> Array:
    """Residuals of the laboratory fit in robust sds, shape (n,)."""
    location = o.problem.bound.mean_response(o.priors.to_natural(mode[None]), o.problem.conditions)[
        0
    ]
    residual = o.problem.response - location
    robust = 1.4826 * float(np.median(np.abs(residual - np.median(residual))))
    return np.asarray(residual / max(robust, 1e-12))
