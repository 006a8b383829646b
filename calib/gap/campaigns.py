"""The campaigns of a case made ready for inference: simulators bound to the rows of the lab."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from calib.data import Table
from calib.data.files import plain_number
from calib.data.headers import accepted_headers, renamed
from calib.data.quantities import OUTPUTS, QUANTITIES, columns_of, physical_role
from calib.data.units_check import fits_load
from calib.errors import CalibError
from calib.gap.case import Case
from calib.gap.covariates import Covariates
from calib.gap.effects import Effect, View
from calib.gap.noise import NoiseConditions, noise_conditions, noise_conditions_of_lab
from calib.gap.oddities import identical_rows
from calib.gap.simulated import Simulated
from calib.inference.priors import Priors
from calib.inference.problem import Problem, build_problem
from calib.models import MODELS, get_model
from calib.models.base import Array

if TYPE_CHECKING:
    from calib.gap.shifts import ShiftAs, ShiftMap

# Fewer field rows cannot tell a gap from noise; a larger ratio is a wrong unit.
MIN_FIELD_ROWS = 5
MAX_RATIO = 100.0
# What effects take for the load where none is recorded, as the shipped priors do.
_LOAD_KN = 5.0


@dataclass(frozen=True)
class OutputData:
    """One modelled output: the simulator's problem on the lab rows, and the field rows.

    Parameters
    ----------
    name : str
        Key of `calib.data.quantities.OUTPUTS`.
    problem : Problem
        On the lab rows that have the output.
    priors : Priors
        Of the model's parameters, without the noise scale.
    rows : ndarray of int
        Field rows that have the output.
    field : ndarray
        Their outputs on the scale of the response.
    """

    name: str
    problem: Problem
    priors: Priors
    rows: NDArray[np.int64]
    field: Array

    @cached_property
    def role(self) -> str:
        """The physical role by which effects know the output."""
        return physical_role(self.name)


@dataclass(frozen=True)
class Campaigns:
    """A case made ready for inference."""

    outputs: tuple[OutputData, ...]
    view: View
    lab_at: Mapping[str, NoiseConditions]
    case: Case

    @property
    def names(self) -> tuple[str, ...]:
        """Outputs in order."""
        return tuple(o.name for o in self.outputs)

    @property
    def roles(self) -> tuple[str, ...]:
        """Physical roles of the outputs, in order."""
        return tuple(o.role for o in self.outputs)

    def with_role(self, role: str) -> tuple[str, ...]:
        """Return the outputs that have a physical role."""
        return tuple(o.name for o in self.outputs if o.role == role)

    @cached_property
    def simulated(self) -> dict[str, Simulated]:
        """Every output's simulator at the rows of both campaigns."""
        tables = (self.case.lab, self.case.field)
        # Where there is none no simulator asks for their range.
        recorded = np.concatenate([_recorded(t, "pressure", np.zeros(1)) for t in tables])
        pressures = float(recorded.min()), float(recorded.max())
        return {o.name: Simulated(o, self.view, pressures) for o in self.outputs}

    @cached_property
    def covariates(self) -> Covariates:
        """Conditions scaled to the range of both campaigns."""
        return Covariates(self)

    @cached_property
    def forms(self) -> dict[Effect, tuple[Array, list[float]]]:
        """Bases of effects' form errors at the field's rows, kept as hypotheses need them."""
        return {}

    @cached_property
    def shift_maps(self) -> dict[ShiftAs, tuple[ShiftMap, list[float]]]:
        """What shifts of the parameters do, of either kind, kept as hypotheses need them."""
        return {}

    @cached_property
    def at_rows(self) -> dict[str, NoiseConditions]:
        """What the noise of every output's lab rows, then field rows, depends on."""
        field = noise_conditions(self.view)
        return {o.name: self.lab_at[o.name] + field.rows(o.rows) for o in self.outputs}

    @cached_property
    def observed(self) -> Array:
        """Lab rows, then field rows, of one output after the other, on the responses' scales."""
        return np.concatenate([v for o in self.outputs for v in (o.problem.response, o.field)])

    def at(self, table: Table) -> View:
        """Return the view of other conditions, with the same references."""
        return self.at_conditions(table.columns)

    def at_conditions(self, conditions: Mapping[str, Array]) -> View:
        """Return the view of conditions given as canonical columns.

        A covariate they lack is taken as it was in the calibration, or typically was in the
        field.
        """
        n = next(iter(conditions.values())).size
        filled = dict(conditions)
        for name, values in self.view.conditions.items():
            if name not in filled and name not in OUTPUTS.values():
                filled[name] = np.full(n, self.view.lab.get(name, float(np.nanmedian(values))))
        return replace(self.view, conditions=filled)


def campaigns(case: Case) -> Campaigns:
    """Bind a case's models to its lab rows and gather its field rows.

    Raises
    ------
    CalibError
        If no output is in both campaigns, or there are too few rows.
    """
    outputs = tuple(_output(case, name, model) for name, model in case.models.items())
    lab, field = case.lab, case.field
    if identical_rows(lab, field) == len(field):
        raise CalibError(
            "every field row is a row of the calibration, value for value", where=field.source,
            expected="measurements of another campaign", hint="name the field's own file",
        )  # fmt: skip
    load = _recorded(lab, "load", _recorded(field, "load", np.array([_LOAD_KN])))
    _check_load(lab, field)
    order = _recorded(field, "order", np.array([0.0, 1.0]))
    view = View(
        conditions=dict(field.columns),
        lab={name: float(np.nanmedian(values)) for name, values in lab.columns.items()},
        load_kn=float(np.median(load)),
        ground_exponent=_ground_exponent(lab, field),
        order_range=(float(order.min()), float(order.max())),
    )
    if case.new_conditions is not None:
        needed = {c: None for m in case.models.values() for c in get_model(m).conditions}
        case.new_conditions.must_have(*needed)
    lab_at = {o.name: noise_conditions_of_lab(o.problem.table, view) for o in outputs}
    return Campaigns(outputs, view, lab_at, case)


def _check_load(lab: Table, field: Table) -> None:
    """Refuse the load that priors of effects assume where the pulls cannot be of it."""
    pulls = [t[c] for t in (lab, field) for c in columns_of("pull") if c in t]
    if not pulls or any(c in t for t in (lab, field) for c in columns_of("load")):
        return
    largest = float(np.nanmax(np.abs(np.concatenate(pulls))))
    if not fits_load(largest, _LOAD_KN):
        raise CalibError(
            f"there is no column normal_load_kn; a load of {_LOAD_KN:g} kN was assumed, but the "
            f"largest pull is {plain_number(largest)} kN",
            where=f"{lab.source}, {field.source}",
            expected=", ".join(accepted_headers(QUANTITIES["normal_load_kn"])),
            hint="add the column normal_load_kn to the calibration or the field",
        )  # fmt: skip


def _output(case: Case, name: str, model: str) -> OutputData:
    column = OUTPUTS[name]
    if get_model(model).output != column:
        able = [m.name for m in MODELS.values() if m.output == column]
        raise CalibError(
            f"the model {model} does not predict {name}", where=f"[models] of {case.name}",
            expected=", ".join(able), hint="name a model of this output in case.toml",
        )  # fmt: skip
    for table in (case.lab, case.field):
        if column not in table or not np.isfinite(table[column]).any():
            raise CalibError(
                f"the case models {name}, but there are no values of {table.header_of(column)}",
                where=table.source,
                hint=f"{renamed(table.ignored, [column])}add the column, or take the model out of "
                "case.toml",
            )  # fmt: skip
        table.must_have(*get_model(model).conditions)
    lab = case.lab.take(np.isfinite(case.lab[column]))
    problem = build_problem(model, lab, case.priors.get(name))
    problem.noise.must_be_usual(problem.priors.source, "a diagnosis")
    rows = np.flatnonzero(np.isfinite(case.field[column]))
    _check_field(case, name, column, rows)
    response = problem.bound.to_response(case.field[column][rows])
    # The noise scale is not a parameter of the simulator: it is inferred beside it.
    return OutputData(name, problem, Priors(problem.priors.entries[:-1]), rows, response)


def _check_field(case: Case, name: str, column: str, rows: NDArray[np.int64]) -> None:
    """Refuse a field campaign that cannot be told from a mistake."""
    if rows.size < MIN_FIELD_ROWS:
        raise CalibError(
            f"{rows.size} field rows with {case.field.header_of(column)} cannot show a gap",
            where=case.field.source,
            expected=f"at least {MIN_FIELD_ROWS}",
            hint=f"measure more, or take {name} out of the case",
        )
    lab, field = (float(np.nanmedian(np.abs(t[column]))) for t in (case.lab, case.field))
    unit = QUANTITIES[column].unit
    if not 1.0 / MAX_RATIO < field / max(lab, 1e-300) < MAX_RATIO:
        raise CalibError(
            f"{QUANTITIES[column].word} is typically {plain_number(field)} {unit} in the field and "
            f"{plain_number(lab)} {unit} in the calibration",
            where=f"{case.field.source}, column {case.field.header_of(column)!r}",
            expected=f"campaigns whose outputs differ by less than a factor of {MAX_RATIO:g}",
            hint="check the units in the column names",
        )


def _recorded(table: Table, role: str, otherwise: Array) -> Array:
    """Return a column by its physical role."""
    column = next((c for c in columns_of(role) if c in table), None)
    return otherwise if column is None else table[column]


def _ground_exponent(lab: Table, field: Table) -> float:
    """D ln(ground pressure)/d ln(inflation pressure), 0.5 where the data cannot tell."""
    for table in (lab, field):
        x, y = (_recorded(table, role, np.ones(1)) for role in ("pressure", "ground_pressure"))
        if x.size == y.size:
            x, y = np.log(x), np.log(y)
            if np.ptp(x) > 1e-6:
                return float(np.clip(np.polyfit(x, y, 1)[0], 0.0, 1.5))
    return 0.5
