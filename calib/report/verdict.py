"""The verdict on one calibration, worked out here for every verb, page and file.

A card is red where there is nothing to trust: the convergence gate was not passed, or unseen rows
could not be scored. It is amber where any assumption fails (`calib.validation.assumptions`: of the
rows, of the priors, or that the bands cover unseen rows, the curve misses no pattern, the priors
expect the data, and an emulator is good enough), which it says first; where nothing was left to
validate on, or too little for any failure to show; where the prior, not the data, sets what the
prediction of unseen rows hangs on; and where the median is hardly better than the mean of the
calibrated rows.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from calib.data.quantities import output_of, role_of
from calib.inference.calibration import Calibration
from calib.inference.io import RUN
from calib.inference.problem import Problem
from calib.inference.random import generator
from calib.models.base import Array
from calib.report.constants import EXPECTED, WEAK_SKILL
from calib.report.labels import axis_of, joined, units_of
from calib.report.page.template import words
from calib.report.rows import Fitted, held_table, signs_along, x_column
from calib.validation.assumptions import checks_of, remarks_of
from calib.validation.constants import LEVEL
from calib.validation.prediction import (
    binomial_p,
    coverage_probability,
    effective_rows,
    hits,
    prior_predictive,
)
from calib.validation.residuals import Check, Range, Remark, failed
from calib.validation.scores import MOVED, PRIOR, role, standardise
from calib.validation.validate import Validation


class Where(StrEnum):
    """Where the rows that were not fitted lie, of those with a model in pressure."""

    AT = "at calibrated pressures"
    BETWEEN = "between them"
    BEYOND = "beyond them"


class Level(StrEnum):
    """How far a result can be trusted."""

    FINE = "fine"
    CARE = "with care"
    NO = "do not use"
    FAILED = "failed"


@dataclass(frozen=True)
class Evidence:
    """What a verdict is made from.

    Parameters
    ----------
    held_out : bool
        Whether rows were held out; otherwise each was left out in turn.
    hits, n : int
        Unseen rows inside the 90 % band, and all.
    low_coverage_p : float
        Probability of covering no more than that, were the bands right.
    effective : float
        Independent rows that would say as much.
    max_relative_error : float
        NaN where no row is large enough to be judged.
    prior_set : sequence of str
        Parameters whose width is the prior's.
    two_pressures : bool
        Whether a quadratic in pressure was calibrated at two pressures.
    skill : float
        Part of the scatter of unseen rows about the calibrated mean that the median removes.
    sign_changes, neighbours : int
        Of the residuals along the curve, which runs `along` a condition.
    inside : str
        The calibrated range in words.
    unseen_at : Where
        Where in pressure the unseen rows lie.
    at_pressures : str
        The two calibrated pressures and the range of the curves there.
    prior_hits, prior_n : int
        Calibrated points inside the priors' 95 % predictive band, and all.
    suspects : str
        What to check where the priors did not expect the data.
    notes : sequence of str
        What was assumed where the data do not say.
    emulator_fails : sequence of str
        Why the emulator of the simulator, if there is one, is not good enough.
    remarks : sequence of Remark
        What the rows and the posterior say of the assumptions.
    checks : sequence of Check
        Those of the rows and the priors; the coverage and the signs of residuals are of the family.
    fitted_at : sequence of float
        The two calibrated pressures, in canonical units, of the column `parabolic_in`.
    """

    converged: bool
    reasons: Sequence[str]
    held_out: bool
    hits: int
    n: int
    low_coverage_p: float
    effective: float
    rmse: float
    unit: str
    max_relative_error: float
    prior_set: Sequence[str]
    two_pressures: bool
    skill: float
    sign_changes: int
    neighbours: int
    along: str
    inside: str
    unseen_at: Where = Where.AT
    at_pressures: str = "the two calibrated pressures"
    prior_hits: int = 0
    prior_n: int = 0
    suspects: str = "the units"
    notes: Sequence[str] = ()
    emulator_fails: Sequence[str] = ()
    remarks: Sequence[Remark] = ()
    checks: Sequence[Check] = ()
    parabolic_in: str = ""
    fitted_at: Sequence[float] = ()


@dataclass(frozen=True)
class Verdict:
    """What a busy reader needs.

    Parameters
    ----------
    level : Level
    rule : str
        Which rule decided.
    headline : str
        Two or three words.
    trust, doubt : str
        What to trust, and what not.
    remarks : tuple of Remark
        Facts behind it: first those on assumptions that fail.
    where : tuple of Range
        The rows that the doubt concerns: those in any of them, all if there is none.
    held_out : str
        Which rows were not fitted, so that a prediction does not rest on all that was measured.
    """

    level: Level
    rule: str
    headline: str
    trust: str
    doubt: str
    remarks: tuple[Remark, ...] = ()
    where: tuple[Range, ...] = ()
    held_out: str = ""

    @property
    def fails(self) -> tuple[str, ...]:
        """What is said of assumptions that fail."""
        return tuple(remark.text for remark in self.remarks if remark.title)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is said in all of the remarks."""
        return tuple(remark.text for remark in self.remarks)

    @property
    def lines(self) -> tuple[str, ...]:
        """The verdict in plain words, as every verb prints it below the warnings."""
        said = f"verdict: {self.level.value}: {self.headline}"
        return said, f"trust: {self.trust}", f"do not trust: {self.doubt}"

    def for_rows(self, conditions: Mapping[str, Array]) -> tuple[str, ...]:
        """Return the doubts that concern a prediction at some conditions, canonical columns."""
        said = [r.text for r in self.remarks if r.title and r.concerns(conditions)]
        doubted = not self.where or any(part.holds(conditions) for part in self.where)
        if self.level is not Level.FINE and (said or doubted):
            said.append(f"{self.headline}: do not trust {self.doubt}")
        if self.held_out:
            said.insert(
                0, words("verdict.j2", "calib.report", part="held out", held_out=self.held_out)
            )  # fmt: skip
        return tuple(said)

    def document(self) -> dict[str, Any]:
        """Return it as JSON has it, which knows no infinity."""
        remarks = [{**asdict(r), "where": _written(r.where)} for r in self.remarks]
        return {**asdict(self), "where": _written(self.where), "remarks": remarks}

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> Verdict:
        """Return what a document says."""
        remarks = tuple(Remark(**{**r, "where": _read(r["where"])}) for r in document["remarks"])
        where = _read(document["where"])
        level = Level(document["level"])
        return cls(**{**document, "level": level, "remarks": remarks, "where": where})


def _written(ranges: Sequence[Range]) -> list[dict[str, Any]]:
    return [{k: None if v in (-math.inf, math.inf) else v for k, v in r._asdict().items()}
            for r in ranges]  # fmt: skip


def _read(ranges: Sequence[Mapping[str, Any]]) -> tuple[Range, ...]:
    return tuple(
        Range(
            r["column"], -math.inf if r["low"] is None else r["low"],
            math.inf if r["high"] is None else r["high"],
        )
        for r in ranges
    )  # fmt: skip


def _said(part: str, e: Evidence, **facts: Any) -> str:
    return words("verdict.j2", "calib.report", part=part, e=e, **facts)


# What decides where no assumption fails: the first rule that holds.
_RULES: tuple[tuple[str, Level, str, Callable[[Evidence], bool]], ...] = (
    ("not converged", Level.NO, "NOT CONVERGED", lambda e: not e.converged),
    ("not scored", Level.NO, "Not validated", lambda e: e.n > 0 and not math.isfinite(e.rmse)),
    ("extrapolated", Level.CARE, "Curvature from the prior",
     lambda e: e.two_pressures and len(e.prior_set) > 0),
    ("not validated", Level.CARE, "Not validated", lambda e: e.n == 0),
    # Were none of them covered, it would not be found.
    ("few", Level.CARE, "Too few unseen rows",
     lambda e: binomial_p(0, e.n) > LEVEL / (len(e.checks) + 2)),
    ("weak", Level.CARE, "Explains little", lambda e: e.skill < WEAK_SKILL),
    ("fine", Level.FINE, "Holds on unseen rows", lambda e: True),
)  # fmt: skip

# What decides where one fails, by the title of its remark.
_FAILS = {
    "Emulator not good enough": "emulated badly",
    "Bands too narrow": "miscovered",
    "Curve misses a pattern": "misfit",
    "Data and priors disagree": "unexpected",
}


def judge_evidence(e: Evidence) -> Verdict:
    """Apply the rules."""
    tests = [
        *e.checks,
        Check(e.low_coverage_p, Remark(_said("coverage", e), "Bands too narrow")),
        Check(binomial_p(e.sign_changes, e.neighbours, 0.5),
              Remark(_said("pattern", e), "Curve misses a pattern", True)),
    ]  # fmt: skip
    emulated = (_said("emulator", replace(e, emulator_fails=[why])) for why in e.emulator_fails)
    remarks = [
        *(Remark(text, "Emulator not good enough", True) for text in emulated),
        *e.remarks,
        *failed(tests),
    ]
    if e.prior_hits < EXPECTED * e.prior_n:
        remarks.append(Remark(_said("surprise", e), "Data and priors disagree", True))
    remarks.sort(key=lambda remark: not remark.title)
    rule, level, headline, _ = next(r for r in _RULES if r[3](e))
    fails = [remark for remark in remarks if remark.title] if level is not Level.NO else []
    facts = {"rule": rule, "fails": fails, "shifts": any(remark.shifts for remark in fails)}
    found = Verdict(
        level, rule, headline, _said("trust", e, **facts), _said("doubt", e, **facts),
        tuple(remarks),
    )  # fmt: skip
    if fails:
        title = fails[0].title
        return replace(
            found, level=Level.CARE, headline=title, rule=_FAILS.get(title, "assumption")
        )
    if rule == "extrapolated":
        return replace(found, where=_elsewhere(e.parabolic_in, e.fitted_at))
    return found


def _elsewhere(column: str, values: Sequence[float]) -> tuple[Range, ...]:
    """All of a condition but some values, whatever their rounding."""
    ends = [-math.inf, *(v for value in values for v in (value, value)), math.inf]
    pairs = zip(ends[::2], ends[1::2], strict=True)
    return tuple(Range(column, low * (1.0 + 1e-9), high * (1.0 - 1e-9)) for low, high in pairs)


def verdict(
    calibration: Calibration,
    validation: Validation | None = None,
    *,
    emulator_fails: Sequence[str] = (),
    held_out: str = "",
) -> Verdict:
    """Say in a headline what can be trusted, as the pages do; nothing is drawn.

    Parameters
    ----------
    calibration : Calibration
    validation : Validation, optional
        Of it: `calib.validate_held_out` or `calib.leave_one_out`.
    emulator_fails : sequence of str
        Why the emulator that stood in for a simulator, if one did, is not good enough.
    held_out : str
        What the rows have in common that were held out, for instance a column and its value.
    """
    output = output_of(calibration.problem.bound.model.output)
    prior = prior_predictive(calibration.problem, generator(calibration.seed, output, "prior"))
    evidence = gather(calibration, validation, prior)
    found = judge_evidence(replace(evidence, emulator_fails=emulator_fails))
    held = held_table(Fitted(calibration, validation))
    if held is None:
        return found
    at = f" ({held_out})" if held_out else ""
    return replace(found, held_out=f"{len(held)} rows{at}")


def keep_verdict(found: Verdict, folder: Path) -> None:
    """Add a verdict to the record of a run folder, for `calib predict`."""
    path = folder / RUN
    document = {**json.loads(path.read_text(encoding="utf-8")), "verdict": found.document()}
    path.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def kept_verdict(folder: Path) -> Verdict | None:
    """Return the verdict of a run folder, if it has one."""
    document = json.loads((folder / RUN).read_text(encoding="utf-8")).get("verdict")
    return None if document is None else Verdict.of(document)


def gather(calibration: Calibration, v: Validation | None, prior_predictive: Array) -> Evidence:
    """Collect the evidence of a calibration, in the units of its file.

    Parameters
    ----------
    calibration : Calibration
    v : Validation or None
        How it did on rows that were not fitted, if there were any.
    prior_predictive : ndarray, shape (draws, n)
        Measurements that the priors expect at its rows.
    """
    result, problem = Fitted(calibration, v), calibration.problem
    model, parabolic = problem.bound.model, problem.bound.model.parabolic_in
    fitted_at = np.unique(problem.table[parabolic]) if parabolic else np.zeros(0)
    changes, neighbours = signs_along(result, standardise(calibration, problem).residual)
    with units_of(problem.table.header):
        x, axes = axis_of(x_column(result)), {n: axis_of(n) for n in problem.conditions}
        ranges = {n: f"{a.name.lower()} {a.range_text(problem.table[n])}" for n, a in axes.items()}
        at_pressures = ""
        if parabolic:
            axis = axis_of(parabolic)
            values = joined([axis.value_text(float(p)) for p in fitted_at])
            at_pressures = f"{values} {axis.unit} for {ranges[x_column(result)]}"
        return Evidence(
            converged=calibration.draws.report.passed,
            reasons=calibration.draws.report.reasons,
            **_unseen(result, v),
            unit=axis_of(model.output).unit,
            prior_set=[p for p in problem.names if role(calibration, p) in (PRIOR, MOVED)],
            two_pressures=fitted_at.size == 2,
            sign_changes=changes,
            neighbours=neighbours,
            along=x.name.lower(),
            inside=joined(list(ranges.values())),
            unseen_at=_unseen_at(problem, v)
            if parabolic and v and held_table(result)
            else Where.AT,
            at_pressures=at_pressures,
            prior_hits=hits(prior_predictive, problem.observed, 0.95),
            prior_n=problem.observed.size,
            suspects="the units and the normal load"
            if role_of(model.output) == "pull"
            else "the units",
            notes=problem.notes,
            remarks=remarks_of(calibration),
            checks=checks_of(calibration),
            parabolic_in=parabolic,
            fitted_at=tuple(fitted_at.tolist()),
        )


def _unseen(result: Fitted, v: Validation | None) -> dict[str, Any]:
    """Return what was found on rows that were not fitted."""
    nothing = float("nan")
    if v is None:
        return {
            "held_out": False, "hits": 0, "n": 0, "low_coverage_p": 1.0, "effective": nothing,
            "rmse": nothing, "max_relative_error": nothing, "skill": nothing,
        }  # fmt: skip
    problem = result.calibration.problem
    covered = v.scores.coverage[0.9]
    held = held_table(result) is not None
    complete = bool(np.isfinite(v.draws).all(axis=1).any())
    scatter = float(np.mean(np.square(v.observed - problem.observed.mean())))
    return {
        "held_out": held,
        "hits": covered.hits,
        "n": covered.n,
        "low_coverage_p": (
            # Held-out rows share a curve, so the binomial law would raise false alarms.
            coverage_probability(v.draws, covered.hits, 0.9)
            if held and complete
            else binomial_p(covered.hits, covered.n)
        ),
        "effective": effective_rows(v.draws) if complete else nothing,
        "rmse": axis_of(problem.bound.model.output).factor * v.scores.rmse,
        "max_relative_error": v.scores.max_relative_error,
        "skill": 1.0 - v.scores.rmse**2 / scatter if scatter > 0.0 else nothing,
    }


def _unseen_at(problem: Problem, validation: Validation) -> Where:
    column = problem.bound.model.parabolic_in
    fitted, unseen = problem.table[column], validation.table[column]
    if bool(((unseen < fitted.min()) | (unseen > fitted.max())).any()):
        return Where.BEYOND
    return Where.AT if bool(np.isin(unseen, fitted).any()) else Where.BETWEEN
