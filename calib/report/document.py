"""The document of a study: its numbers as `summary.json` has them, and all views read them.

Page, tables, methods and files for programs are functions of `Output`: what manifest and summary
say of one output. A page shows a little more, which `page_facts` works out of the result.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any

import numpy as np

from calib.inference.calibration import Calibration, ParameterSummary
from calib.inference.estimators import PointEstimate
from calib.inference.likelihood import Noise
from calib.models import Model, get_model
from calib.models.base import Array
from calib.report.labels import Axis, axis_of, units_of
from calib.report.numbers import finite
from calib.report.reference import Reference, reference_of
from calib.report.rows import held_table
from calib.report.study import HoldOut, OutputResult, Study
from calib.report.verdict import checks_passed, judge_evidence
from calib.validation.comparison import NoisePreference
from calib.validation.constants import CONTRACTION_MIN, SENSITIVITY_MIN


def summarise(study: Study) -> dict[str, Any]:
    """Return a study's numbers as plain dictionaries.

    Keys under ``models.<output>``: ``estimates.<method>.<parameter>``, ``fit.<method>``,
    ``posterior.<parameter>``, ``prior_sensitivity``, ``validation``, ``sampling``; a failed output
    has ``error`` alone.
    """
    models: dict[str, Any] = {k: _output(r) for k, r in study.successes.items()}
    models |= {k: {"model": f.task.model, "error": f.error} for k, f in study.failures.items()}
    document = {
        "schema": "calib/summary/1",
        "seed": study.seed,
        "models": {key: models[key] for key in study.results},
    }
    plain: dict[str, Any] = finite(document)
    return plain


def _output(result: OutputResult) -> dict[str, Any]:
    problem = result.calibration.problem
    columns = (*problem.bound.model.conditions, problem.bound.model.output)
    warnings = list(judge_evidence(result.evidence).warnings)
    return {
        "model": problem.bound.model.name,
        "output": problem.bound.model.output,
        "data": {
            "source": problem.table.source,
            "label": problem.table.label,
            "n": len(problem.table),
            "n_all": len(result.task.table),
            "ranges": {name: _range(problem.table[name]) for name in columns},
            "held_out": None if result.task.held_out is None else str(result.task.held_out),
        },
        "references": dict(problem.bound.references),
        **_noise(problem.noise, result.preference),
        **_condition_errors(problem.noise),
        **({"warnings": warnings} if warnings else {}),
        **summarise_estimates(result.estimates, result.by_pressure),
        "priors": {
            p.name: {"unit": p.unit, "distribution": p.text, **_picked(p, "reason", "source")}
            for p in problem.priors.entries
        },
        "posterior": _posterior(result.calibration),
        "prior_sensitivity": _sensitivity(result),
        "validation": _validation(result),
        "sampling": _sampling(result.calibration),
    }


def _noise(noise: Noise, preference: NoisePreference | None) -> dict[str, Any]:
    """What the prior file asks for beyond normal noise of one standard deviation."""
    if noise.iid_normal or preference is None:
        return {}
    depends = {"column": noise.column, "centre": noise.centre, "spread": noise.spread}
    return {
        "noise": {
            "family": noise.family,
            "depends_on": depends if noise.column else None,
            "correlated_along": noise.correlated_along or None,
            "against_normal": {
                "elpd_difference": preference.elpd,
                **_picked(preference, "se", "preferred", "sentence"),
            },
        }
    }


def _condition_errors(noise: Noise) -> dict[str, Any]:
    """What conditions are known with an error."""
    found = {
        e.name: {"sd": e.sd, "unit": e.column.unit, "kind": e.kind, "reliability": e.reliability}
        for e in noise.errors
    }
    return {"condition_errors": found} if found else {}


def summarise_estimates(
    estimates: Sequence[PointEstimate], by_pressure: Mapping[float, Sequence[PointEstimate]]
) -> dict[str, Any]:
    """Return an output's point estimates as they stand in the summary."""
    plain: dict[str, Any] = finite(
        {
            "estimates": {e.method: dict(e.reported) for e in estimates},
            "fit": {e.method: _fit(e) for e in estimates},
            "by_pressure": {
                f"{psi:g} psi": {e.method: {**e.reported, "cost": e.cost} for e in alone}
                for psi, alone in by_pressure.items()
            },
        }
    )
    return plain


def _range(values: Array) -> dict[str, float]:
    return {
        "lower": float(values.min()),
        "upper": float(values.max()),
        "distinct": int(np.unique(values).size),
    }


def _fit(e: PointEstimate) -> dict[str, Any]:
    return {
        **_picked(e, "cost", "cost_unit", "rmse", "rmse_unit", "r_squared"),
        "evaluations": e.n_evaluations,
        **_picked(e, "converged", "note"),
    }


def _picked(found: object, *names: str) -> dict[str, Any]:
    """Return some attributes by their names."""
    return {name: getattr(found, name) for name in names}


def _posterior(calibration: Calibration) -> dict[str, Any]:
    # Under a name that says of what the ratio is.
    spelt = {"sd_ratio": "posterior_to_prior_sd"}
    return {
        name: {spelt.get(k, k): v for k, v in asdict(s).items() if k != "name"}
        for name, s in calibration.summary.items()
    }


def _sensitivity(result: OutputResult) -> dict[str, Any]:
    return {
        "criteria": {
            "contraction_at_least": CONTRACTION_MIN,
            "power_scaling_threshold": SENSITIVITY_MIN,
        },
        "parameters": {
            name: _picked(s, "contraction", "prior", "likelihood", "identified", "reading")
            for name, s in result.sensitivity.items()
        },
    }


def _validation(result: OutputResult) -> dict[str, Any]:
    v, s = result.validation, result.validation.scores
    covered = {f"{100 * level:g}": c for level, c in s.coverage.items()}
    found = {
        "method": v.method,
        **_picked(s, "n", "rmse", "crps", "max_relative_error"),
        "n_relative_error_above_6_percent": s.n_far,
        "coverage": {level: c.proportion for level, c in covered.items()},
        "coverage_interval": {level: [c.lower, c.upper] for level, c in covered.items()},
        "pit": s.pit.tolist(),
    }
    if v.method == "leave_one_out":
        found |= {
            **_picked(v, "elpd", "elpd_se"),
            "largest_pareto_k": None if v.pareto_k is None else float(v.pareto_k.max()),
            "refitted": list(v.refitted),
            "refits_not_converged": list(v.unconverged),
        }
    return found


def _sampling(calibration: Calibration) -> dict[str, Any]:
    d, problem = calibration.draws, calibration.problem
    r = d.report
    entries, mode = problem.priors.entries, problem.theta(d.mode[None])[0].tolist()
    return {
        "converged": r.passed,
        "reasons": list(r.reasons),
        "gate": {
            "largest_rhat": float(r.rhat.max()),
            "smallest_ess_bulk": float(r.ess_bulk.min()),
            "smallest_ess_tail": float(r.ess_tail.min()),
            "smallest_steps_over_tau": float((r.steps / r.tau).min()),
        },
        "ensembles": d.t.shape[0],
        "steps": r.steps,
        "tau": float(max(r.tau)),
        **_picked(d, "walkers", "acceptance", "evaluations", "log_evidence"),
        "mode": {p.name: v for p, v in zip(entries, mode, strict=True) if not p.fixed},
        "log_posterior_at_mode": float(problem.log_prob(d.mode[None])[0]),
    }


@dataclass(frozen=True)
class Output:
    """One output that was worked out, as manifest and summary have it; its key is of `OUTPUTS`."""

    key: str
    task: Mapping[str, Any]  # its entry in the manifest
    found: Mapping[str, Any]  # its entry in the summary
    facts: Mapping[str, Any] = field(default_factory=dict)  # of `page_facts`, if there is a page

    @property
    def name(self) -> str:
        """In words."""
        return self.key.replace("_", " ").capitalize()

    @property
    def model(self) -> Model:
        """That was calibrated."""
        return get_model(str(self.task["model"]))

    @property
    def model_words(self) -> str:
        """The model by its title and its place in the source, with marks."""
        model = self.model
        source = f"the source [@{model.cited}]" if model.cited else model.source
        numbers = model.numbers.replace("-", "\N{EN DASH}")
        origin = f"{numbers} of {source}" if numbers and source else source
        return f"\u201c{model.title}\u201d" + (f" ({origin})" if origin else "")

    @property
    def label(self) -> str:
        """What the data are called; empty for measurements."""
        return str(self.found["data"]["label"])

    @property
    def data_words(self) -> str:
        """What to call the data."""
        return f"{self.label} data" if self.label else "data"

    @property
    def reference(self) -> Reference:
        """What was printed on these data."""
        return reference_of(self.label)

    def axis(self, column: str = "") -> Axis:
        """Return how a column, by default the output, is shown: in the unit of the file."""
        with units_of(self.task["data"].get("header", ())):
            return axis_of(column or self.found["output"])

    @property
    def converged(self) -> bool:
        """Whether the posterior passed the gate."""
        return bool(self.found["sampling"]["converged"])

    @property
    def held_out(self) -> str:
        """Which rows were held out, in words; empty where none were."""
        held = self.task["held_out"]
        if held is None or self.found["validation"]["method"] != "held_out":
            return ""
        return HoldOut(**held).words

    @property
    def estimates_use_all_rows(self) -> bool:
        """Whether point estimates are of more rows than the posterior: the source's were."""
        data = self.found["data"]
        return self.model.estimates_all_rows and bool(data["n_all"] > data["n"])

    @property
    def n_estimated(self) -> int:
        """Of how many rows the point estimates are."""
        return int(self.found["data"]["n_all" if self.estimates_use_all_rows else "n"])

    @property
    def posterior(self) -> tuple[ParameterSummary, ...]:
        """Summaries of all parameters; NaN for what JSON has no number for."""
        read = []
        for name, entry in self.found["posterior"].items():
            known = {**entry, "sd_ratio": entry["posterior_to_prior_sd"], "name": name}
            numbers: dict[str, Any] = {f.name: known.get(f.name) for f in fields(ParameterSummary)}
            missing = {k: float("nan") for k, v in numbers.items() if v is None}
            read.append(ParameterSummary(**(numbers | missing)))
        return tuple(read)

    def hits(self, level: str) -> int:
        """Return how many rows that were not fitted the band of a level covers."""
        v = self.found["validation"]
        return round(float(v["coverage"][level]) * int(v["n"]))


def outputs(manifest: Mapping[str, Any], summary: Mapping[str, Any]) -> list[Output]:
    """Return the outputs that were worked out; those that failed are left out."""
    return [
        Output(key, manifest["tasks"][key], found)
        for key, found in summary["models"].items()
        if "error" not in found
    ]


def page_facts(result: OutputResult, emulator_fails: Sequence[str] = ()) -> dict[str, Any]:
    """Return what a page shows of a result beyond the summary: verdict, roles, single rows."""
    problem, v, held = result.calibration.problem, result.validation, held_table(result)
    evidence = replace(result.evidence, emulator_fails=emulator_fails)
    error = np.abs(v.scores.relative_error)
    judged = np.isfinite(error)
    worst = int(np.nanargmax(error)) if judged.any() else None
    conditions = np.column_stack(list(problem.conditions.values()))
    names = (*problem.conditions, problem.bound.model.output)
    with units_of(result.task.table.header):
        ranges = {n: axis_of(n).range_text(problem.table[n]) for n in names}
    return {
        "evidence": evidence,
        "verdict": judge_evidence(evidence),
        "checks": checks_passed(evidence),
        "judged": int(judged.sum()),
        "worst": {} if worst is None else {c: v.table[c][worst] for c in names},
        "distinct": None if held is not None else np.unique(conditions, axis=0).shape[0],
        "held": 0 if held is None else len(held),
        "ranges": ranges,
        "priors": problem.priors.central(0.95),
        "stored": result.calibration.draws.t.shape[1:3],
    }
