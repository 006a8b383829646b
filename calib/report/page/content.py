"""What the page of a report says, ready for the template, and the page."""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import PurePath
from typing import Any

import numpy as np
from markupsafe import Markup

from calib.models import get_model
from calib.report.figures.collect import Drawn
from calib.report.labels import axis_of, percent, short, units_of
from calib.report.numbers import TIMES, format_number, format_value
from calib.report.page.tables import (
    estimates_grid,
    posterior_rows,
    pressure_grids,
    prior_rows,
    sensitivity_grid,
)
from calib.report.page.template import (
    equation,
    likelihood,
    parametrisation,
    picture,
    prose,
    template,
)
from calib.report.publish import Publication
from calib.report.reference import reference_of
from calib.report.rows import held_table, x_column
from calib.report.sections import Document, Section, emulation_words
from calib.report.study import Failure, OutputResult, Study
from calib.report.verdict import Evidence, Level, judge_evidence


def validation_facts(result: OutputResult, effective: float, low_p: float) -> list[list[str]]:
    """Label and value of every validation figure."""
    v, s = result.validation, result.validation.scores
    axis = axis_of(result.calibration.problem.bound.model.output)
    rmse, crps = (format_number(axis.factor * error, 3) for error in (s.rmse, s.crps))
    facts = [
        ["Root mean square error of the median", f"{rmse} {axis.unit}"],
        ["Mean CRPS", f"{crps} {axis.unit}"],
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
        facts.append(["Rows off by more than 6 %", f"{s.n_far} of {judged.size}"])
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


# A shape beside every colour.
MARKS: Mapping[str, str] = {
    Level.FINE: "\N{HEAVY CHECK MARK}",
    Level.CARE: "\N{BLACK UP-POINTING TRIANGLE}",
    Level.NO: "\N{HEAVY BALLOT X}",
    Level.FAILED: "\N{HEAVY BALLOT X}",
}

# The class of an exception says nothing to a reader of the page.
_CLASS_NAME = re.compile(r"^(?:[A-Za-z_][\w.]*(?:Error|Exception): )+")


def output_name(key: str) -> str:
    """Return the heading of an output."""
    return key.replace("_", " ").capitalize()


def failed_section(key: str, failure: Failure) -> dict[str, Any]:
    """Return what there is to say of an output that could not be worked out."""
    return {
        "key": key,
        "name": output_name(key),
        "model": get_model(failure.task.model).title,
        "failed": True,
        "error": _CLASS_NAME.sub("", failure.error),
        "level": str(Level.FAILED.value),
        "mark": MARKS[Level.FAILED],
        "headline": "Failed",
        "source": PurePath(failure.task.table.source).name,
        "label": failure.task.table.label,
        "rows": len(failure.task.table),
    }


def section(
    key: str,
    result: OutputResult,
    drawn: Drawn | None = None,
    emulation: Document | None = None,
) -> dict[str, Any]:
    """Return everything that is said of an output.

    `emulation` is the `Emulation.document` of an emulator that stood in for its simulator.
    """
    calibration = result.calibration
    problem = calibration.problem
    evidence = replace(result.evidence, emulator_fails=(emulation or {}).get("reasons", ()))
    verdict = judge_evidence(evidence)
    reference = reference_of(problem.table.label)
    names = [*problem.bound.model.reported, *(p.name for p in problem.priors.entries)]
    bound = problem.bound
    return {
        "key": key,
        "name": output_name(key),
        "model": bound.model.title,
        "failed": False,
        "level": str(verdict.level.value),
        "mark": MARKS[verdict.level],
        "headline": verdict.headline,
        "fails": [prose(text, names) for text in verdict.fails],
        "trust": prose(verdict.trust, names),
        "doubt": prose(verdict.doubt, names),
        "label": problem.table.label,
        "facts": _card_facts(result, evidence, emulation),
        "equation": equation(bound),
        "likelihood": prose(likelihood(problem, axis_of(bound.model.output).name.lower()), names),
        "parametrisation": prose(parametrisation(bound), names),
        "data": _data_facts(result),
        "assumed": [prose(note, names) for note in evidence.notes],
        "warnings": [prose(r.text, names) for r in verdict.remarks if not r.title],
        "priors": prior_rows(result),
        "prior_source": PurePath(problem.priors.source).name,
        "estimates": estimates_grid(result, reference=reference),
        "by_pressure": pressure_grids(result, reference=reference),
        "posterior": posterior_rows(result),
        "sensitivity": sensitivity_grid(result) if result.sensitivity else None,
        "sampling": sampling_facts(result),
        "validation": validation_facts(result, evidence.effective, evidence.low_coverage_p),
        "validation_title": _validation_title(result),
        "noise": result.preference and prose(result.preference.sentence, ()),
        "figures": {}
        if drawn is None
        else {
            p.name: picture(p, drawn.files.get(f"{key}_{p.name}.png", b""), prose(p.caption, names))
            | {"alt": p.caption}
            for p in drawn.plates
        },
        "converged": calibration.converged,
    }


def _validation_title(result: OutputResult) -> str:
    held = result.task.held_out
    if held_table(result) is None or held is None:
        return "Validation: each row predicted without itself (leave-one-out)"
    return f"Validation on held-out rows: {held.words}"


def _card_facts(
    result: OutputResult, evidence: Evidence, emulation: Document | None
) -> list[list[str]]:
    """The few numbers that belong on the card."""
    calibration, s = result.calibration, result.validation.scores
    report, c = calibration.draws.report, s.coverage[0.9]
    axis = axis_of(calibration.problem.bound.model.output)
    held = held_table(result) is not None
    state = "yes" if calibration.converged else "NO"
    how = f"R-hat {max(report.rhat):.3f}, ESS {min(report.ess_bulk):.0f} or more"
    error = f"{short(axis.factor * s.rmse)} {axis.unit} rms"
    if math.isfinite(evidence.max_relative_error):
        error += f", {percent(evidence.max_relative_error)} at most"
        error += f" (at {worst_row(result, along=True)})"
    repeats = repeats_words(result)
    # An interval for independent rows would claim too much for rows that share a curve.
    worth = (
        f"as much evidence as {short(evidence.effective)} independent "
        f"{'row' if evidence.effective < 1.05 else 'rows'}"
        if evidence.effective < 0.5 * s.n
        else f"95 % interval {100 * c.lower:.0f} to {100 * c.upper:.0f} %"
    )
    return [
        ["Converged", f"{state} ({how})"],
        ["Calibrated on", f"{len(calibration.problem.table)} rows"],
        [
            f"90 % band on {s.n} {'held-out' if held else 'left-out'} rows",
            f"covered {c.hits} of {c.n} ({worth})",
        ],
        ["Error of the median on those rows", error],
        *([["Repeats", repeats]] if repeats else []),
        *([["Simulator", emulation_words(emulation)]] if emulation else []),
    ]


def _data_facts(result: OutputResult) -> list[list[str]]:
    problem, held = result.calibration.problem, held_table(result)
    table = problem.table
    rows = f"{len(table)} calibrated"
    if held is not None:
        rows += f", {len(held)} held out ({result.task.held_out})"
    facts = [["Source", PurePath(table.source).name], ["Rows", rows]]
    for name in (*problem.bound.model.conditions, problem.bound.model.output):
        axis = axis_of(name)
        facts.append([axis.name, axis.range_text(table[name])])
    if table.ignored:
        facts.append(["Columns not used", ", ".join(table.ignored)])
    facts.append(["SHA-256", table.sha256])
    return facts


def render_page(
    study: Study,
    drawn: Mapping[str, Drawn],
    *,
    manifest: Mapping[str, Any],
    more: Sequence[tuple[Section[Any], str]] = (),
    paper: Publication | None = None,
) -> str:
    """Render the report, which makes no request: style and images are inside.

    Parameters
    ----------
    drawn : mapping of str to Drawn
        Figures of every output that was worked out.
    more : sequence of (Section, str)
        Sections after the outputs, with their pieces of the page as trusted HTML.
    paper : Publication, optional
        Tables and methods beside the page.
    """
    sections = []
    emulations: Mapping[str, Document] = manifest.get("emulators", {})
    for key, result in study.results.items():
        with units_of(result.task.table.header):
            sections.append(
                section(key, result, drawn.get(key), emulations.get(result.task.model))
                if isinstance(result, OutputResult)
                else failed_section(key, result)
            )
    return template("report.html.j2").render(
        title=manifest["title"],
        sections=sections,
        reconstructed=any(r.task.table.label for r in study.results.values()),
        more=[(s, Markup(html)) for s, html in more],
        paper=paper if paper is not None and paper.files else None,
        seed=study.seed,
        command=shlex.join(str(part) for part in manifest.get("command", ())),
        versions=manifest.get("versions", {}),
        settings=manifest.get("settings", {}),
        tasks=manifest.get("tasks", {}),
    )
