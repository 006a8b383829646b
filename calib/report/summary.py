"""`summary.json`: every number of a study, with its uncertainty, for machines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from calib.inference.calibration import Calibration
from calib.inference.estimators import PointEstimate
from calib.inference.noise import Noise
from calib.models.base import Array
from calib.report.numbers import finite
from calib.report.study import OutputResult, Study
from calib.report.verdict import judge_evidence
from calib.validation.comparison import NoisePreference
from calib.validation.scores import CONTRACTION_MIN, SENSITIVITY_MIN, Scores

SCHEMA = "calib/summary/1"


def summarise(study: Study) -> dict[str, Any]:
    """Return a study's numbers as plain dictionaries.

    Keys under ``models.<output>``: ``estimates.<method>.<parameter>``, ``fit.<method>``,
    ``posterior.<parameter>``, ``prior_sensitivity``, ``validation``, ``sampling``; a failed output
    has ``error`` alone.
    """
    models: dict[str, Any] = {k: _output(r) for k, r in study.successes.items()}
    models |= {k: {"model": f.task.model, "error": f.error} for k, f in study.failures.items()}
    document = {
        "schema": SCHEMA,
        "seed": study.seed,
        "models": {key: models[key] for key in study.results},
    }
    plain: dict[str, Any] = finite(document)
    return plain


def _output(result: OutputResult) -> dict[str, Any]:
    problem = result.calibration.problem
    return {
        "model": problem.bound.model.name,
        "output": problem.bound.model.output,
        "data": {
            "source": problem.table.source,
            "label": problem.table.label,
            "n": len(problem.table),
            "n_all": len(result.task.table),
            "ranges": {
                name: _range(problem.table[name])
                for name in (*problem.bound.model.conditions, problem.bound.model.output)
            },
            "held_out": None if result.task.held_out is None else str(result.task.held_out),
        },
        "references": dict(problem.bound.references),
        **_noise(problem.noise, result.preference),
        **_verdict(result),
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


def _verdict(result: OutputResult) -> dict[str, Any]:
    """What the rows, the prior and the validation say of the assumptions."""
    said = judge_evidence(result.evidence).warnings
    return {"warnings": list(said)} if said else {}


def _noise(noise: Noise, preference: NoisePreference | None) -> dict[str, Any]:
    """What the prior file asks for beyond normal noise of one standard deviation."""
    if noise.usual or preference is None:
        return {}
    depends = {"column": noise.column, "centre": noise.centre, "spread": noise.spread}
    return {
        "noise": {
            "family": noise.choice.family,
            "depends_on": depends if noise.column else None,
            "correlated_along": noise.choice.correlated_along or None,
            "against_normal": {
                "elpd_difference": preference.elpd,
                **_picked(preference, "se", "preferred", "sentence"),
            },
        }
    }


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
    v = result.validation
    return {"method": v.method, **_scores(v.scores)} | (
        {
            "elpd": v.elpd,
            "elpd_se": v.elpd_se,
            "largest_pareto_k": None if v.pareto_k is None else float(v.pareto_k.max()),
            "refitted": list(v.refitted),
            "refits_not_converged": list(v.unconverged),
        }
        if v.method == "leave_one_out"
        else {}
    )


def _scores(s: Scores) -> dict[str, Any]:
    return {
        **_picked(s, "n", "rmse", "crps", "max_relative_error"),
        "n_relative_error_above_6_percent": s.n_far,
        "coverage": {f"{100 * level:g}": c.proportion for level, c in s.coverage.items()},
        "coverage_interval": {
            f"{100 * level:g}": [c.lower, c.upper] for level, c in s.coverage.items()
        },
        "pit": s.pit.tolist(),
    }


def _sampling(calibration: Calibration) -> dict[str, Any]:
    d, problem = calibration.draws, calibration.problem
    r = d.report
    mode = problem.theta(d.mode[None])[0].tolist()
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
        "walkers": d.walkers,
        "steps": r.steps,
        "tau": float(max(r.tau)),
        "acceptance": d.acceptance,
        "evaluations": d.evaluations,
        "log_evidence": d.log_evidence,
        "mode": {
            p.name: value
            for p, value in zip(problem.priors.entries, mode, strict=True)
            if not p.fixed
        },
        "log_posterior_at_mode": float(problem.log_prob(d.mode[None])[0]),
    }
