"""The field's readings beside the calibrated and the corrected curve, over what matters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from calib.data.quantities import OUTPUTS, columns_of, role_of
from calib.gap.campaigns import Campaigns, OutputData
from calib.models.base import Array

if TYPE_CHECKING:
    from calib.gap.diagnose import Diagnosis

# Points of a curve.
_POINTS = 61
# Conditions that go together: with one of them the other changes.
_TOGETHER = ("pressure", "ground_pressure")


@dataclass(frozen=True)
class Curve:
    """One output over one condition, the others as they typically were in the field.

    Parameters
    ----------
    column : str
        The condition.
    at, before, after, lower, upper : tuple of float, shape (points,)
        The calibrated curve, and the corrected one with its 90 % band, without the noise.
    readings_at, readings : tuple of float, shape (rows,)
        The field's readings, moved to the other conditions' typical values by as much as the
        corrected model changes on the way.
    others : mapping of str to float
        Other conditions that vary, as the curves have them.
    """

    output: str
    column: str
    at: tuple[float, ...]
    before: tuple[float, ...]
    after: tuple[float, ...]
    lower: tuple[float, ...]
    upper: tuple[float, ...]
    readings_at: tuple[float, ...]
    readings: tuple[float, ...]
    others: Mapping[str, float]


def curves(found: Diagnosis) -> tuple[Curve, ...]:
    """Return the curves of each output whose models have a value all along."""
    drawn = (_curve(found, o, _what_matters(found, o)) for o in found.data.outputs)
    return tuple(curve for curve in drawn if curve is not None)


def _varying(data: Campaigns) -> list[str]:
    """Columns of recorded conditions that vary in the field; slip first, then as recorded."""
    columns = [
        name
        for name, values in data.view.conditions.items()
        if name not in OUTPUTS.values()
        and not data.case.covariates.get(name)
        and np.isfinite(values).all()
        and np.ptp(values) > 0.0
        and role_of(name) not in ("run", "label")
    ]
    return sorted(columns, key=lambda name: role_of(name) != "slip")


def _what_matters(found: Diagnosis, o: OutputData) -> str:
    """Find what the best explanation depends on, or where the gap is surest, or slip."""
    data, varying = found.data, _varying(found.data)
    effects = found.ranking.best(found.ranking.order[0]).forward.hypothesis.effects
    of_effects = [data.view.column(r) for e in effects if o.role in e.outputs for r in e.covariates]
    of_regions = [c for r in found.regions if r.output == o.name for c in r.conditions]
    of_time = [c for c in varying if role_of(c) == "order"] * bool(found.corrected.over_runs)
    wanted = [*of_effects, *of_time, *of_regions]
    return next((name for name in wanted if name in varying), next(iter(varying), ""))


def _curve(found: Diagnosis, o: OutputData, column: str) -> Curve | None:
    if not column:
        return None
    data, view = found.data, found.data.view
    field = {name: view.conditions[name][o.rows] for name in view.conditions}
    at = np.linspace(field[column].min(), field[column].max(), _POINTS)
    conditions = {
        # A value that was measured: between two pressures a model may know little.
        name: np.full(_POINTS, np.nanquantile(values, 0.5, method="lower"))
        for name, values in field.items()
    } | {column: at}
    if role_of(column) in _TOGETHER:
        known, place = np.unique(field[column], return_index=True)
        for other in (c for role in _TOGETHER for c in columns_of(role) if c in field):
            conditions[other] = np.interp(at, known, field[other][place])
    truth = found.corrected.mixture.at(data.at_conditions(conditions))
    after, drawn = truth.mean(truth.truth[o.name]), truth.truth[o.name]
    before = found.corrected.calibrated(conditions)[o.name]
    if not np.isfinite(np.concatenate([before, after])).all():
        return None
    here = found.truth.mean(found.truth.truth[o.name])[o.rows]
    there = np.interp(field[column], at, after)
    measured = data.case.field[OUTPUTS[o.name]][o.rows]
    relative = o.problem.bound.model.response == "log"
    moved = measured * there / here if relative else measured + there - here
    others = {n: float(conditions[n][0]) for n in _varying(data) if n != column}
    together = _TOGETHER if role_of(column) in _TOGETHER else ()
    low, high = (_numbers(truth.quantile(drawn, q)) for q in (0.05, 0.95))
    return Curve(
        output=o.name,
        column=column,
        at=_numbers(at),
        before=_numbers(before),
        after=_numbers(after),
        lower=low,
        upper=high,
        readings_at=_numbers(field[column]),
        readings=_numbers(moved),
        others={n: v for n, v in others.items() if role_of(n) not in ("order", *together)},
    )


def _numbers(values: Array) -> tuple[float, ...]:
    return tuple(values.tolist())
