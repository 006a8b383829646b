"""Labels and values of what is known of a validation and of the sampling."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from calib.report.labels import axis_of, percent
from calib.report.numbers import TIMES, format_number, format_value
from calib.report.rows import held_table, x_column
from calib.report.study import OutputResult


def validation_facts(result: OutputResult, effective: float, low_p: float) -> list[list[str]]:
    """Label and value of every validation figure."""
    v, s = result.validation, result.validation.scores
    unit = axis_of(result.calibration.problem.bound.model.output).unit
    facts = [
        ["Root mean square error of the median", f"{format_number(s.rmse, 3)} {unit}"],
        ["Mean CRPS", f"{format_number(s.crps, 3)} {unit}"],
    ]
    repeats = repeats_words(result)
    if repeats:
        facts.insert(0, ["Repeats", repeats])
    judged = np.abs(s.relative_error[np.isfinite(s.relative_error)])
    if judged.size:
        at_row = percent(float(judged.max())) + f", at {worst_row(result)}"
        left = s.n - judged.size
        facts.append([
            "Largest relative error",
            at_row + (f" ({left} rows near zero left out)" if left else ""),
        ])  # fmt: skip
        facts.append(
            ["Rows off by more than 6 %", f"{int((judged > 0.06).sum())} of {judged.size}"]
        )
    if_independent = ", were the rows independent" if effective < 0.5 * s.n else ""
    for level, c in s.coverage.items():
        share, low, high = (f"{100 * x:.0f}" for x in (c.proportion, c.lower, c.upper))
        facts.append([
            f"Covered by the {100 * level:g} % band",
            f"{c.hits} of {c.n} = {share} % (95 % interval {low} to {high} %{if_independent})",
        ])  # fmt: skip
    facts.append(["Chance of covering so few at 90 %, or fewer", format_number(low_p, 2)])
    if np.isfinite(effective):
        facts.append(["Independent rows that would say as much", format_number(effective, 2)])
    if v.pareto_k is not None:
        facts += [
            ["Expected log predictive density", format_value(v.elpd, v.elpd_se)],
            ["Largest Pareto k", format_number(float(np.max(v.pareto_k)), 2)],
            ["Rows refitted (k above 0.7)", f"{len(v.refitted)} of {s.n}"],
        ]
    return facts


def repeats_words(result: OutputResult) -> str:
    """Say that a row's repeats stay when it is left out; empty where there are none."""
    if held_table(result) is not None:
        return ""
    conditions = np.column_stack(list(result.calibration.problem.conditions.values()))
    rows, distinct = conditions.shape[0], np.unique(conditions, axis=0).shape[0]
    if distinct == rows:
        return ""
    where = "condition" if distinct == 1 else "conditions"
    return f"{rows} rows at {distinct} distinct {where}; leaving one row out leaves its repeats in"


def worst_row(result: OutputResult, *, along: bool = False) -> str:
    """Conditions, or only the one along the curve, of the row with the largest relative error."""
    v = result.validation
    i = int(np.nanargmax(np.abs(v.scores.relative_error)))
    every = result.calibration.problem.bound.model.conditions
    names = (x_column(result),) if along else every
    axes = {name: axis_of(name) for name in names}
    return ", ".join(
        f"{a.name.lower()} {a.value_text(float(v.table[name][i]))} {a.unit}"
        for name, a in axes.items()
    )


def sampling_facts(result: OutputResult) -> list[list[str]]:
    """Label and value of everything that is known of the sampling."""
    d = result.calibration.draws
    r = d.report
    ensembles, few, stored, _ = d.t.shape
    facts: Mapping[str, str] = {
        "Convergence gate": "passed" if r.passed else f"NOT PASSED: {'; '.join(r.reasons)}",
        f"Ensembles {TIMES} walkers {TIMES} steps": (
            f"{ensembles} {TIMES} {d.walkers} {TIMES} {r.steps} ({few} {TIMES} {stored} stored)"
        ),
        "Largest R-hat (at most 1.01)": f"{np.max(r.rhat):.4f}",
        "Smallest ESS, bulk and tail (at least 400)": (
            f"{np.min(r.ess_bulk):.0f} and {np.min(r.ess_tail):.0f}"
        ),
        "Steps over autocorrelation time (at least 50)": format_number(
            float(np.min(r.steps / r.tau)), 3
        ),
        "Acceptance": f"{100 * d.acceptance:.0f} %",
        "Log evidence": format_number(d.log_evidence, 4),
        "Density evaluations": f"{d.evaluations:,}",
    }
    return [[label, value] for label, value in facts.items()]
