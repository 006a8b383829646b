"""What the page says of every output, ready for the template."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import PurePath
from typing import Any

from calib.models import get_model
from calib.report.figures import Plate
from calib.report.labels import axis_of, percent, short
from calib.report.page.equations import equation, likelihood, parametrisation, prose
from calib.report.page.facts import repeats_words, sampling_facts, validation_facts, worst_row
from calib.report.page.pictures import picture
from calib.report.page.tables import (
    estimates_grid,
    posterior_rows,
    pressure_grids,
    prior_rows,
    sensitivity_grid,
)
from calib.report.reference import reference_of
from calib.report.rows import held_table
from calib.report.study import Failure, OutputResult
from calib.report.verdict import Evidence, Level, gather, judge_evidence

# A shape beside every colour.
MARKS: Mapping[str, str] = {
    Level.FINE: "\N{HEAVY CHECK MARK}",
    Level.CARE: "\N{BLACK UP-POINTING TRIANGLE}",
    Level.NO: "\N{HEAVY BALLOT X}",
    Level.FAILED: "\N{HEAVY BALLOT X}",
}

# Which exception carried a message is the programmer's business.
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
    key: str, result: OutputResult, plates: Sequence[Plate], images: Mapping[str, bytes]
) -> dict[str, Any]:
    """Return everything that is said of an output; images by ``{key}_{plate.name}.png``."""
    calibration = result.calibration
    problem = calibration.problem
    evidence = gather(result)
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
        "trust": prose(verdict.trust, names),
        "doubt": prose(verdict.doubt, names),
        "label": problem.table.label,
        "facts": _card_facts(result, evidence),
        "equation": equation(bound),
        "likelihood": prose(likelihood(problem, axis_of(bound.model.output).name.lower()), names),
        "parametrisation": prose(parametrisation(bound), names),
        "data": _data_facts(result),
        "assumed": [prose(note, names) for note in evidence.notes],
        "warnings": [prose(warning, names) for warning in result.warnings],
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
        "figures": {
            p.name: picture(p, images.get(f"{key}_{p.name}.png", b""), prose(p.caption, names))
            | {"alt": p.caption}
            for p in plates
        },
        "converged": calibration.converged,
    }


def _validation_title(result: OutputResult) -> str:
    held = result.task.held_out
    if held_table(result) is None or held is None:
        return "Validation: each row predicted without itself (leave-one-out)"
    name, _, unit = held.column.rpartition("_")
    return f"Validation on held-out rows: {name.replace('_', ' ')} {held.value:g} {unit}"


def _card_facts(result: OutputResult, evidence: Evidence) -> list[list[str]]:
    """The few numbers that belong on the card."""
    calibration, s = result.calibration, result.validation.scores
    report, c = calibration.draws.report, s.coverage[0.9]
    axis = axis_of(calibration.problem.bound.model.output)
    held = held_table(result) is not None
    state = "yes" if calibration.converged else "NO"
    how = f"R-hat {max(report.rhat):.3f}, ESS {min(report.ess_bulk):.0f} or more"
    error = f"{short(s.rmse)} {axis.unit} rms"
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
