"""The campaigns of a case made ready for inference: simulators bound to the rows of the lab."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calib.data import Table
from calib.data.checks import fits_load
from calib.data.files import plain_number
from calib.data.quantities import OUTPUTS, QUANTITIES, columns_of, physical_role, role_of
from calib.data.table import accepted_headers, renamed
from calib.errors import CalibError
from calib.gap.case import Case
from calib.gap.constants import ASSUMED_LOAD_KN, MAX_RATIO, MIN_FIELD_ROWS
from calib.gap.effects import View
from calib.gap.noise import (
    Along,
    Noise,
    NoiseConditions,
    Whitening,
    noise_conditions,
    noise_conditions_of_lab,
)
from calib.inference.condition_errors import ConditionError
from calib.inference.likelihood import noise_of
from calib.inference.mode import find_mode
from calib.inference.priors import Priors
from calib.inference.problem import Problem, build_problem
from calib.models import MODELS, get_model
from calib.models.base import Array
from calib.models.simulators.emulator import emulator_of

# What something may vary with by itself, where it is not just one physical role: the first of them
# that is recorded and varies.
_OVER = {
    "water": ("water", "water_by_volume"),
    "pressure": ("pressure", "ground_pressure"),
    "low_pressure": ("pressure",),
}
# Roles of which a discrepancy knows what they may do.
_KNOWN = {"slip", "order", "speed", "passes", "load", "cone", *sum(_OVER.values(), ())}


def columns_over(what: str) -> tuple[str, ...]:
    """Return the columns of what something may vary with, the one to be preferred first."""
    return tuple(c for role in _OVER.get(what, (what,)) for c in columns_of(role) or (role,))


def other_conditions(view: View) -> tuple[str, ...]:
    """Return the roles of recorded conditions of which nothing more is known."""
    recorded = [QUANTITIES[c] for c in view.conditions if c in QUANTITIES]
    roles = [q.physical for q in recorded if q.role == "condition" and q.physical not in _KNOWN]
    return tuple(dict.fromkeys(roles))


class CaseSimulator:
    """One output's simulator, with its inadequacy.

    Parameters
    ----------
    view : View
        Of the field campaign.
    pressures : tuple of float
        Least and greatest inflation pressure of both campaigns.

    Attributes
    ----------
    lab, field, both : dict of str to ndarray
        The model's conditions at the rows of a campaign; at the lab's, then the field's.
    columns : dict of str to str
        Those conditions, by physical role.
    priors : tuple of Prior
        Of the free parameters, named after the output.
    n_bends : int
        Coefficients of the inadequacy.
    n_errors : int
        Coefficients of an emulator's error, standard normal beforehand, which lab and field share.
        With them the likelihood is that of the calibration (`calib.inference.likelihood`), but
        that the error's size is everywhere that where the posteriors lie: worked out for each of
        a million parameter vectors it would cost more than all the rest.
    """

    def __init__(self, o: OutputData, view: View, pressures: tuple[float, float]) -> None:
        self._bound, self._priors, self._pressures = o.problem.bound, o.priors, pressures
        self._view = view
        self.priors = tuple(replace(p, name=f"{o.name}.{p.name}") for p in o.priors.free)
        self._ranges = _misfit_ranges(o)
        self.n_bends = len(self._ranges) * (len(self._ranges) + 1) // 2
        self.lab = o.problem.conditions
        self.field = self._bound.model.select(view.conditions)
        self.columns = {role_of(c): c for c in self.field}
        self.both = {k: np.concatenate([self.lab[k], v]) for k, v in self.field.items()}
        self._emulator = emulator_of(self._bound.model)
        self._mix = self._error_of(self.both)
        self.n_errors = self._mix.shape[1]

    def conditions(self, view: View) -> dict[str, Array]:
        """Return the model's conditions of a view."""
        if view.conditions is self._view.conditions:
            return self.field
        return self._bound.model.select(view.conditions)

    def predict(self, t: Array, misfit: Array, conditions: Mapping[str, Array]) -> Array:
        """Predict on the scale of the response, shape (k, n).

        Parameters
        ----------
        t : ndarray, shape (k, d)
            Internal parameters.
        misfit : ndarray, shape (k, n_bends + n_errors)
            The former in the unit of the response.
        conditions : mapping of str to ndarray, shape (n,) or (k, n)
        """
        mean = self._bound.mean_response(self._priors.to_natural(t), conditions)
        for column, bend in enumerate(self._bends(conditions)):
            mean = mean + misfit[:, column : column + 1] * bend
        return mean

    def predict_beyond(self, t: Array, misfit: Array, conditions: Mapping[str, Array]) -> Array:
        """Predict where an effect may have taken the pressure beyond those of both campaigns.

        From there on the prediction goes on straight, as from the one end of their range to the
        other: the parabolas of the Magic Formula's coefficients are not to be trusted outside. Of
        33 true gauge errors (four seeds of the challenge) the rms error is 0.95 noise sds so, 1.5
        along the parabolas.
        """
        column = self._view.column("pressure") or ""
        pressure = conditions.get(column)
        low, high = self._pressures
        if pressure is None or low == high or pressure is self._view.conditions[column]:
            return self.predict(t, misfit, conditions)
        inside = np.clip(pressure, low, high)
        beyond = (pressure - inside) / (high - low)
        if not beyond.any():
            return self.predict(t, misfit, conditions)
        mean = self.predict(t, misfit, {**conditions, column: inside})
        # Both ends in one call, each a pressure of all vectors, for the rows that any takes beyond.
        rows = np.flatnonzero(np.atleast_2d(beyond).any(axis=0))
        twice = np.concatenate([rows, rows])
        ends = {name: v[..., twice] for name, v in conditions.items()}
        ends[column] = np.repeat([low, high], rows.size)
        at_low, at_high = np.split(self.predict(t, misfit, ends), 2, axis=1)
        mean[:, rows] += (at_high - at_low) * beyond[..., rows]
        return mean

    def _error_of(self, conditions: Mapping[str, Array]) -> Array:
        """What the coefficients of the error make of an emulator's curves, shape (j, n_errors)."""
        if self._emulator is None:
            return np.zeros((0, 0))
        root = np.sqrt(self._emulator.typical_variances)
        at = self._emulator.curves_at(conditions)[:, 1:] * root
        at = at[np.isfinite(at).all(axis=1)]
        _, size, axes = np.linalg.svd(at, full_matrices=False)
        # What stays below is less than is ever looked into, of which each axis has its cost.
        kept = size > 3.0 * self._emulator.negligible * np.sqrt(max(len(at), 1))
        return np.asarray(root[:, None] * axes[kept].T)

    def _bends(self, conditions: Mapping[str, Array]) -> list[Array]:
        """What the coefficients of the inadequacy and the error multiply, (n,) or (k, n) each."""
        scaled = [
            np.clip((_even(name, conditions[name]) - mid) / half, -2.5, 2.5)
            for name, mid, half in self._ranges
        ]
        bends = [
            u * v - (1.0 / 3.0 if i == j else 0.0)
            for i, u in enumerate(scaled)
            for j, v in enumerate(scaled[: i + 1])
        ]
        if self._emulator is None or not self.n_errors:
            return bends
        errors = self._emulator.curves_at(conditions)[..., 1:] @ self._mix
        return bends + [errors[..., j] for j in range(self.n_errors)]


def _even(column: str, values: Array) -> Array:
    """Return a condition on its natural scale: the logarithm of a factor."""
    if column in QUANTITIES and QUANTITIES[column].of_factors:
        return np.asarray(np.log(np.maximum(values, 1e-6)))
    return values


def _misfit_ranges(o: OutputData) -> tuple[tuple[str, float, float], ...]:
    """Conditions over which a simulator may be bent, with middle and half range in the lab."""
    if o.role != "density":
        return ()
    found = []
    for name, values in o.problem.conditions.items():
        values = _even(name, values)
        half = 0.5 * float(np.ptp(values))
        if half > 1e-9 * max(1.0, float(np.abs(values).max())):
            found.append((name, 0.5 * float(values.max() + values.min()), half))
    return tuple(found)


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
    in_field : Problem, optional
        On all field rows, if conditions of either campaign are known with an error.
    along : Along, optional
        If the noise is correlated along runs.
    """

    name: str
    problem: Problem
    priors: Priors
    rows: NDArray[np.int64]
    field: Array
    along: Along | None = None
    in_field: Problem | None = None

    @cached_property
    def by_errors(self) -> tuple[Array, Array | None]:
        """What errors of conditions do to the rows of the lab, then the field, (n,) each.

        By how much the mean response is off that at the expected conditions, and the variance they
        add in units of the noise's, both where the laboratory's fit has its mode.
        """
        problem, found = self.problem, []
        if self.in_field is None:
            return np.zeros(1), None
        natural = problem.theta(find_mode(problem.log_prob, problem.priors)[None])
        theta = problem.of_model(natural)
        for part in (problem, self.in_field):
            plain = part.bound.mean_response(theta, part.conditions)
            mean, added = (
                (plain, 0.0 * plain) if part.readings is None else part.readings.moments(theta)[:2]
            )
            rows = slice(None) if part is problem else self.rows
            found.append(np.stack([mean - plain, added / natural[0, -1] ** 2])[:, 0, rows])
        shift, added = np.concatenate(found, axis=1)
        return shift, added

    @cached_property
    def role(self) -> str:
        """The physical role by which effects know the output."""
        return physical_role(self.name)

    def lab_residuals(self, mode: Array) -> Array:
        """Return the residuals of the laboratory's fit at a vector of its priors, shape (n,)."""
        natural = self.priors.to_natural(mode[None])
        return np.asarray(self.problem.residuals(natural)[0])


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
    def simulated(self) -> dict[str, CaseSimulator]:
        """Every output's simulator at the rows of both campaigns."""
        tables = (self.case.lab, self.case.field)
        # Where there is none no simulator asks for their range.
        recorded = np.concatenate([_recorded(t, "pressure", np.zeros(1)) for t in tables])
        pressures = float(recorded.min()), float(recorded.max())
        return {o.name: CaseSimulator(o, self.view, pressures) for o in self.outputs}

    def scaled(self, view: View, what: str) -> Array | None:
        """Return what something varies with, scaled to -1..1 over both campaigns.

        Parameters
        ----------
        view : View
        what : str
            See `columns_over`.

        Returns
        -------
        ndarray, shape (n,), or None
            Of speeds and the like the logarithm; None where it is lacking or constant.
        """
        columns = (self._scaled(view, name) for name in columns_over(what))
        return next((u for u in columns if u is not None), None)

    def _scaled(self, view: View, name: str) -> Array | None:
        if name not in view.conditions or name not in self.view.conditions:
            return None  # of conditions to predict, what the campaigns do not have explains nothing
        own, lab = self.view.conditions[name], self.case.lab.columns
        values, both = view.conditions[name], np.concatenate([own, lab.get(name, own)])
        if name in QUANTITIES and QUANTITIES[name].of_factors:
            values, both = np.log(np.maximum(values, 1e-6)), np.log(np.maximum(both, 1e-6))
        if np.ptp(both) < 1e-9 * max(1.0, float(np.abs(both).max())):
            return None
        mid, half = 0.5 * (both.max() + both.min()), 0.5 * np.ptp(both)
        return np.asarray(np.clip((values - mid) / half, -1.5, 1.5))

    @cached_property
    def at_rows(self) -> dict[str, NoiseConditions]:
        """What the noise of every output's lab rows, then field rows, depends on."""
        field = noise_conditions(self.view)
        return {
            o.name: replace(
                self.lab_at[o.name] + field.rows(o.rows),
                along=o.along,
                added=o.by_errors[1],
            )
            for o in self.outputs
        }

    def whitenings(self, o: OutputData, noise: Noise) -> tuple[Whitening, Whitening]:
        """Return what makes an output's residuals independent, in the lab and in the field."""
        both, n_lab = Whitening.of(noise, self.at_rows[o.name]), o.problem.response.size
        every = np.arange(both.sd.size)
        return both.take(every[:n_lab]), both.take(every[n_lab:])

    @cached_property
    def observed(self) -> Array:
        """Lab rows, then field rows, of one output after the other, on the responses' scales."""
        both = (np.append(o.problem.response, o.field) - o.by_errors[0] for o in self.outputs)
        return np.concatenate([*both])

    @cached_property
    def errors(self) -> list[tuple[Table, ConditionError]]:
        """Errors of conditions, each with its campaign."""
        pairs = [(o.problem, o.in_field) for o in self.outputs if o.in_field is not None]
        both = (self.case.lab, self.case.field)
        return [
            (t, e) for p in pairs for t, of in zip(both, p, strict=True) for e in of.noise.errors
        ]

    @property
    def said_of_errors(self) -> list[str]:
        """Say what is allowed for as errors of conditions."""
        found = dict.fromkeys(f"{table.source}: {error.words()}" for table, error in self.errors)
        if found and len(self.outputs) > 1:
            found[
                "errors of conditions are taken as independent between outputs, though readings "
                "of one row share them: the evidence is a little overstated"
            ] = None
        return [*found]

    def in_noise(self, change: Mapping[str, Array], noise: Mapping[str, Noise]) -> dict[str, Array]:
        """Return changes (k, n) of each output at its field rows, in noise sds, (k, rows)."""
        at = noise_conditions(self.view)
        return {
            o.name: change[o.name][:, o.rows] / noise[o.name].sd(at.rows(o.rows))
            for o in self.outputs
        }

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
            "every field row is a row of the calibration, value for value",
            where=field.source,
            expected="measurements of another campaign",
            hint="name the field's own file",
        )
    load = _recorded(lab, "load", _recorded(field, "load", np.array([ASSUMED_LOAD_KN])))
    _check_load(lab, field)
    order = _recorded(field, "order", np.array([0.0, 1.0]))
    view = View(
        conditions=_expected(outputs, field),
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
    if not fits_load(largest, ASSUMED_LOAD_KN):
        raise CalibError(
            f"there is no column normal_load_kn; a load of {ASSUMED_LOAD_KN:g} kN was assumed, but "
            f"the largest pull is {plain_number(largest)} kN",
            where=f"{lab.source}, {field.source}",
            expected=", ".join(accepted_headers(QUANTITIES["normal_load_kn"])),
            hint="add the column normal_load_kn to the calibration or the field",
        )


def _output(case: Case, name: str, model: str) -> OutputData:
    column = OUTPUTS[name]
    if get_model(model).output != column:
        able = [m.name for m in MODELS.values() if m.output == column]
        raise CalibError(
            f"the model {model} does not predict {name}",
            where=f"[models] of {case.name}",
            expected=", ".join(able),
            hint="name a model of this output in case.toml",
        )
    for table in (case.lab, case.field):
        if column not in table or not np.isfinite(table[column]).any():
            raise CalibError(
                f"the case models {name}, but there are no values of {table.header_of(column)}",
                where=table.source,
                hint=f"{renamed(table.ignored, [column])}add the column, or take the model out of "
                "case.toml",
            )
        table.must_have(*get_model(model).conditions)
    lab = case.lab.take(np.isfinite(case.lab[column]))
    problem = build_problem(model, lab, case.priors.get(name))
    problem.noise.must_be_normal_of_one_sd(problem.priors.source)
    rows = np.flatnonzero(np.isfinite(case.field[column]))
    _check_field(case, name, column, rows)
    response = problem.bound.to_response(case.field[column][rows])
    # What the noise has is not a parameter of the simulator: it is inferred beside it.
    own = len(problem.priors.entries) - 1 - len(problem.noise.parameters)
    priors, along = Priors(problem.priors.entries[:own]), Along.of(problem, case.field.take(rows))
    there = noise_of(problem.noise, problem.bound.model, case.field, problem.priors.source)
    some = bool(problem.noise.errors or there.errors)
    in_field = replace(problem, table=case.field, noise=there) if some else None
    return OutputData(name, problem, priors, rows, response, along, in_field)


def _expected(outputs: Sequence[OutputData], field: Table) -> dict[str, Array]:
    """Return the field's conditions, those that have an error as they are expected."""
    found: dict[str, Array] = {}
    for o in outputs:
        own = o.problem.bound.model.select(field.columns)
        for name, values in (own if o.in_field is None else o.in_field.conditions).items():
            if not np.array_equal(found.setdefault(name, values), values):
                raise CalibError(
                    f"the prior files state different errors of {QUANTITIES[name].word}",
                    where=field.source,
                    expected="one error of each condition",
                    hint="write the same errors and set_points in all prior files of the case",
                )
    return {**field.columns, **found}


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
    check_ratio(case, column, lab, field, "outputs")


def check_ratio(case: Case, column: str, lab: float, field: float, kind: str) -> None:
    """Refuse campaigns whose typical values of a column cannot be in the same unit."""
    quantity = QUANTITIES[column]
    if not 1.0 / MAX_RATIO < field / max(lab, 1e-300) < MAX_RATIO:
        raise CalibError(
            f"{quantity.word} is typically {plain_number(field)} {quantity.unit} in the field and "
            f"{plain_number(lab)} {quantity.unit} in the calibration",
            where=f"{case.field.source}, column {case.field.header_of(column)!r}",
            expected=f"campaigns whose {kind} differ by less than a factor of {MAX_RATIO:g}",
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


def identical_rows(lab: Table, field: Table) -> int:
    """Count field rows that are in the calibration too, in every column of both."""
    both = [name for name in lab if name in field]
    known = set(zip(*(lab[name].tolist() for name in both), strict=True))
    return sum(row in known for row in zip(*(field[name].tolist() for name in both), strict=True))
