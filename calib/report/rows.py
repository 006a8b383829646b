"""The rows of a result, or of a diagnosis, as figures show them: grouped into panels."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from calib.data.quantities import OUTPUTS, columns_of, role_of
from calib.data.table import Table
from calib.gap.document import GapDocument
from calib.inference.calibration import Calibration
from calib.models.base import Array
from calib.report.labels import Axis, axis_of
from calib.validation.scores import sign_changes
from calib.validation.validate import Validation


class Result(Protocol):
    """A calibration, and what it was validated on if anything."""

    @property
    def calibration(self) -> Calibration:
        """What was calibrated."""

    @property
    def validation(self) -> Validation | None:
        """How it did on rows that were not fitted, if there were any."""


class Fitted(NamedTuple):
    """A calibration and its validation, if any, where there is no more of a result.

    The predictive measurements, shape (draws, n), are at the calibration conditions.
    """

    calibration: Calibration
    validation: Validation | None
    posterior_predictive: Array | None = None


@dataclass(frozen=True)
class Group:
    """Rows, of the calibration table and of the held-out one, that share a panel.

    The panel stands for a value of a condition, NaN and None where there is none.
    """

    title: str
    held: bool
    column: str | None
    value: float
    fitted: NDArray[np.bool_]
    held_out: NDArray[np.bool_]

    @property
    def size(self) -> int:
        """How many rows it has."""
        return int(self.fitted.sum() + self.held_out.sum())


def held_table(result: Result) -> Table | None:
    """Return the rows that were held out, if any were."""
    v = result.validation
    return v.table if v is not None and v.method == "held_out" else None


def data_word(result: Result) -> str:
    """What to call the data: their label where they have one."""
    label = result.calibration.problem.table.label
    return f"{label} data" if label else "data"


def x_column(result: Result) -> str:
    """The condition along which predictions are drawn."""
    conditions = result.calibration.problem.bound.model.conditions
    return next((name for name in conditions if role_of(name) == "slip"), conditions[0])


def group_column(result: Result) -> str | None:
    """The column that tells panels apart: inflation pressure where the data have it."""
    conditions = result.calibration.problem.bound.model.conditions
    tables = [t for t in (result.calibration.problem.table, held_table(result)) if t is not None]
    pressure = next((n for n in columns_of("pressure") if all(n in t for t in tables)), None)
    values = np.concatenate([t[pressure] for t in tables]) if pressure else np.zeros(0)
    if pressure and np.unique(values).size > 1 and len(conditions) > 1:
        return pressure
    second = [name for name in conditions if name != x_column(result)]
    return second[0] if second else None


def groups(result: Result, *, most: bool = True) -> list[Group]:
    """Split the rows into at most six panels: those held out and the most populated others.

    More distinct values than twice that are pooled into thirds of the rows. Without `most` it does
    not stop at six, and every row is in a group.
    """
    column = group_column(result)
    fitted, held = result.calibration.problem.table, held_table(result)
    if column is None:
        rows = np.ones(len(fitted), dtype=bool)
        rest = np.ones(0 if held is None else len(held), dtype=bool)
        return [Group("", False, None, float("nan"), rows, rest)]
    axis = axis_of(column)
    inside, outside = fitted[column], np.empty(0) if held is None else held[column]
    found = []
    for low, high, value in _bins(np.concatenate([inside, outside])):
        mine, theirs = ((v >= low) & (v <= high) for v in (inside, outside))
        only_held = bool(theirs.any() and not mine.any())
        title = _title(axis, low, high, only_held)
        found.append(Group(title, only_held, column, value, mine, theirs))
    return _kept(found) if most else found


def signs_along(result: Result, residual: Array) -> tuple[int, int]:
    """Count sign changes of the calibrated rows' residuals along x in each group; see there."""
    x = result.calibration.problem.table[x_column(result)]
    return sign_changes(x, residual, (g.fitted for g in groups(result, most=False)))


def _kept(found: list[Group]) -> list[Group]:
    """At most six: those held out first, then the most populated; of equals, spread out."""
    if len(found) <= 6:
        return found
    held = [g for g in found if g.held][:6]
    others = [g for g in found if not g.held]
    room = 6 - len(held)
    if len({g.size for g in others}) == 1:
        picked = np.linspace(0, len(others) - 1, room).round().astype(int).tolist()
        others = [others[i] for i in picked]
    else:
        others = sorted(others, key=lambda g: -g.size)[:room]
    return sorted([*held, *others], key=lambda g: g.value)


def _title(axis: Axis, low: float, high: float, held: bool) -> str:
    a, b = axis.value_text(low), axis.value_text(high)
    name = "water " if axis.name == "Water content" else ""
    value = a if a == b else f"{a} to {b}"
    return f"{name}{value} {axis.unit}{', held out' if held else ''}"


def _bins(values: Array) -> list[tuple[float, float, float]]:
    """Return lower end, upper end and middle of the groups of a condition."""
    distinct, counts = np.unique(values, return_counts=True)
    if distinct.size <= 3 or (distinct.size <= 12 and counts.max() > 1):
        return [(v, v, v) for v in distinct.tolist()]
    parts = np.array_split(np.sort(values), 3)
    return [(float(p[0]), float(p[-1]), float(np.median(p))) for p in parts]


def grid(result: Result, group: Group) -> dict[str, Array]:
    """Conditions along the x axis of a panel, the others at the panel's middle."""
    fitted, held = result.calibration.problem.table, held_table(result)
    x = x_column(result)

    def values(name: str, mine: Any = slice(None), theirs: Any = slice(None)) -> Array:
        return np.append(fitted[name][mine], np.empty(0) if held is None else held[name][theirs])

    everywhere = values(x)
    low = min(0.0, everywhere.min()) if role_of(x) == "slip" else everywhere.min()
    along = np.linspace(low, everywhere.max(), 100)
    others = [n for n in result.calibration.problem.bound.model.conditions if n != x]
    middles = {n: np.median(values(n, group.fitted, group.held_out)) for n in others}
    return {x: along, **{name: np.full(100, middle) for name, middle in middles.items()}}


# Of a diagnosis

# Half the width of a 90 % interval, in sds.
Z = 1.64


@dataclass(frozen=True)
class OutputRows:
    """Field rows of one output on the scale of its axis, arrays of shape (n,).

    The reading, the calibrated simulator before and the corrected one after; the sd of a reading;
    truth minus simulator, its sd, and the probability that it exceeds the noise.
    """

    name: str
    axis: Axis
    rows: NDArray[np.int64]
    measured: Array
    before: Array
    after: Array
    noise: Array
    gap: Array
    sd: Array
    probability: Array

    @property
    def likely(self) -> int:
        """How many rows probably have a gap."""
        return int((self.probability > 0.5).sum())

    @property
    def noise_median(self) -> float:
        """Median of the noise."""
        return float(np.median(self.noise))

    @property
    def largest(self) -> tuple[float, float, float] | None:
        """The largest gap with its 90 % interval; None where no row shows any."""
        row = int(np.abs(self.gap).argmax())
        gap, half = float(self.gap[row]), Z * float(self.sd[row])
        shows = abs(gap) + half >= 0.02 * self.noise_median
        return (gap, gap - half, gap + half) if shows else None


def output_axis(d: GapDocument, quantity: str) -> Axis:
    """Return how an output or a column is written: pulls of a small wheel in newtons."""
    column = OUTPUTS.get(quantity, quantity)
    axis = axis_of(column)
    own = [o.measured for o in d.outputs if OUTPUTS[o.name] == column]
    if own and axis.unit == "kN" and np.abs(own[0]).max() < 0.1:
        return Axis(axis.name, "N", 1000.0)
    return axis


def output_rows(d: GapDocument) -> list[OutputRows]:
    """Return the field rows of every output, as they are drawn."""
    gathered = []
    for o in d.outputs:
        axis = output_axis(d, o.name)
        values = (o.measured, o.before, o.after, o.noise_sd, o.gap, o.gap_sd)
        scaled = (axis.scale(np.array(v)) for v in values)
        found = np.array(o.rows), *scaled, np.array(o.probability)
        gathered.append(OutputRows(o.name, axis, *found))
    return gathered


def column_of(d: GapDocument, *roles: str) -> str | None:
    """Return the first recorded condition of some physical roles."""
    return next((c for role in roles for c in columns_of(role) if c in d.conditions), None)


def abscissa(d: GapDocument) -> str:
    """Return the condition along which a diagnosis is drawn."""
    return column_of(d, "slip", "order") or next(iter(d.conditions))


def panel_groups(
    d: GapDocument, rows: NDArray[np.int64]
) -> list[tuple[str, NDArray[np.bool_]]]:  # fmt: skip
    """Split rows by inflation pressure into a few panels: titles and masks."""
    column = column_of(d, "pressure")
    pressure = np.array(d.conditions[column]) if column else np.zeros(1)
    if column is None or np.ptp(pressure) == 0.0:
        return [("", np.ones(rows.size, dtype=np.bool_))]
    distinct, axis = np.unique(pressure), axis_of(column)
    if distinct.size <= 4:
        return [(f"{axis.value_text(p)} {axis.unit}", pressure[rows] == p) for p in distinct]
    edges = np.quantile(pressure, [0.0, 1.0 / 3.0, 2.0 / 3.0, 1.0])
    group = np.searchsorted(edges[1:-1], pressure[rows])
    titles = [axis.range_text(np.array(ends)) for ends in pairwise(edges)]
    return [(title, group == k) for k, title in enumerate(titles)]
