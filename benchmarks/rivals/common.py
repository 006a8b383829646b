"""What all rivals share: a case with its calibrated simulators, and the form of an answer."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from calib.data import write_table
from calib.data.quantities import OUTPUTS, role_of
from calib.gap.campaigns import Campaigns, OutputData, campaigns
from calib.gap.case import Case, read_case
from calib.gap.diagnose import verdict
from calib.gap.files import SCHEMA
from calib.gap.mixture import UNLISTED, inclusion_probability
from calib.gap.ranking import calibrate_lab
from calib.validation.prediction import echoed

type Array = NDArray[np.float64]
type Conditions = Mapping[str, Array]

SEED = 1


@dataclass(frozen=True)
class Lab:
    """One output's simulator at the laboratory's mode (d,); all on the scale of the response."""

    data: Campaigns
    output: OutputData
    mode: Array
    sd: float

    @property
    def name(self) -> str:
        """Of the output."""
        return self.output.name

    def predict(self, t: Array, conditions: Conditions) -> Array:
        """Predict at internal parameters (k, d), shape (k, n)."""
        simulated = self.data.simulated[self.name]
        nothing = np.zeros((len(t), simulated.n_bends + simulated.n_errors))
        return simulated.predict(t, nothing, self.output.problem.bound.model.select(conditions))

    def jacobian(self, t: Array, conditions: Conditions) -> Array:
        """Derivatives of the prediction by the internal parameters, shape (n, d)."""
        step = 1e-4 * np.diag(self.scales)
        ahead, behind = (self.predict(t + sign * step, conditions) for sign in (1.0, -1.0))
        return np.asarray((ahead - behind).T / (2e-4 * self.scales))

    @cached_property
    def scales(self) -> Array:
        """Prior sds of the internal parameters, (d,)."""
        free = self.output.priors.free
        return np.array([p.scale if np.isfinite(p.scale) else p.upper - p.lower for p in free])

    @cached_property
    def precision(self) -> Array:
        """Of the prior, shape (d, d)."""
        return np.diag([1.0 / p.scale**2 for p in self.output.priors.free])

    @cached_property
    def covariance(self) -> Array:
        """Of the laboratory's posterior, linearised at its mode, shape (d, d)."""
        j = self.jacobian(self.mode, self.output.problem.conditions) / self.sd
        return np.linalg.pinv(j.T @ j + self.precision, hermitian=True)

    @cached_property
    def residual(self) -> tuple[float, float]:
        """Sum of the squared residuals of the laboratory's fit, and degrees of freedom."""
        problem = self.output.problem
        off = problem.response - self.predict(self.mode[None], problem.conditions)[0]
        return float(off @ off), max(off.size - self.mode.size, 1.0)


@dataclass(frozen=True)
class Prepared:
    """A case as rivals see it: field rows, and conditions to predict (or the field's own)."""

    case: Case
    data: Campaigns
    labs: tuple[Lab, ...]

    @cached_property
    def field(self) -> Conditions:
        """Conditions of the field rows."""
        return self.data.view.conditions

    @cached_property
    def target(self) -> Conditions:
        """Conditions to predict."""
        new = self.case.new_conditions
        return self.field if new is None else self.data.at(new).conditions

    @cached_property
    def inputs(self) -> tuple[str, ...]:
        """Recorded conditions that vary in the field."""
        return tuple(
            name
            for name, v in self.field.items()
            if name not in OUTPUTS.values()
            and role_of(name) != "label"
            and np.ptp(v) > 1e-9 * max(1.0, float(np.abs(v).max()))
        )

    def scaled(self, at: Conditions) -> Array:
        """Inputs scaled to 0..1 over the field, shape (n, p); one of zeros if none varies."""
        own = self.field
        columns = [(at[c] - own[c].min()) / np.ptp(own[c]) for c in self.inputs]
        n = next(iter(at.values())).size
        return np.stack(columns, axis=1) if columns else np.zeros((n, 1))


def prepare(case: Case | Path) -> Prepared:
    """Calibrate a case's simulators on the laboratory, as `calib diagnose` does."""
    case = read_case(case) if isinstance(case, Path) else case
    data = campaigns(case)
    mode, noise = calibrate_lab(data, SEED)
    labs = tuple(Lab(data, o, mode[o.name], noise[o.name].sigma) for o in data.outputs)
    return Prepared(case, data, labs)


@dataclass(frozen=True)
class Curve:
    """One output: corrected less calibrated at its field rows, the corrected one at the target.

    Sds are those of the means; `noise` is that of a reading.
    """

    gap: Array
    gap_sd: Array
    after: Array
    after_sd: Array
    noise: float


@dataclass(frozen=True)
class Answer:
    """Probabilities of explanations, ``none`` and ``unknown`` among them, and outputs' curves."""

    probability: Mapping[str, float]
    curves: Mapping[str, Curve]
    said: Mapping[str, Any] = field(default_factory=dict)


def write(p: Prepared, answer: Answer, out: Path) -> None:
    """Write ``diagnosis.json`` and, with conditions to predict, ``fresh_prediction.csv``."""
    where, new = [], p.case.new_conditions
    columns = {} if new is None else echoed(new, *OUTPUTS.values())
    for lab in p.labs:
        c, bound, rows = answer.curves[lab.name], lab.output.problem.bound, lab.output.rows
        plain = lab.predict(lab.mode[None], p.field)[0][rows]
        gap = bound.from_response(plain + c.gap) - bound.from_response(plain)
        unit = np.abs(bound.from_response(plain + c.gap)) if bound.model.response == "log" else 1.0
        sd = np.maximum(c.gap_sd, 1e-12)
        beyond = ndtr((c.gap - c.noise) / sd) + ndtr((-c.gap - c.noise) / sd)
        where += [
            {"output": lab.name, "row": int(row), "gap": g, "gap_sd": s, "probability": q}
            for row, g, s, q in np.stack([rows, gap, sd * unit, beyond], axis=1).tolist()
        ]
        if new is not None:
            half, name = 1.6449 * np.hypot(c.after_sd, c.noise), OUTPUTS[lab.name]
            before = lab.predict(lab.mode[None], p.target)[0]
            parts = {"before": before, "after": c.after}
            parts |= {"after_lower": c.after - half, "after_upper": c.after + half}
            columns |= {f"{name}_{part}": bound.from_response(v) for part, v in parts.items()}
    probability = dict(sorted(answer.probability.items(), key=lambda item: -item[1]))
    acting = inclusion_probability(probability)
    said = [{"name": n, "probability": q, "parameters": {}} for n, q in probability.items()]
    document = {
        "schema": SCHEMA,
        "verdict": verdict(probability),
        "effects": said,
        "remainder": {"probability": acting.pop(UNLISTED, 0.0)},
        "inclusion": {name: {"probability": q} for name, q in acting.items()},
        "where": where,
        **answer.said,
    }
    out.mkdir(parents=True, exist_ok=True)
    (out / "diagnosis.json").write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    if new is not None:
        write_table(out / "fresh_prediction.csv", columns)
