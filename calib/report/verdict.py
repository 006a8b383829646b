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
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from calib.data import Table
from calib.data.quantities import output_of, role_of
from calib.inference.calibration import Calibration
from calib.inference.io import RUN
from calib.inference.problem import Problem
from calib.inference.random import generator
from calib.models.base import Array
from calib.report.labels import axis_of, joined, percent, plain, short, units_of
from calib.report.rows import Result, held_table, signs_along, x_column
from calib.report.study_tasks import MAX_ROWS
from calib.validation.assumptions import checks_of, remarks_of
from calib.validation.prediction import (
    binomial_p,
    coverage_probability,
    effective_rows,
    hits,
    prior_predictive,
)
from calib.validation.residuals import LEVEL, Check, Range, Remark, failed
from calib.validation.scores import MOVED, PRIOR, role, standardise
from calib.validation.validate import Validation, leave_one_out, validate_held_out

_WEAK_SKILL = 0.5
_EXPECTED = 0.5


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
                0, f"{self.held_out} were held out of this fit, to judge it by: to predict from "
                "all that was measured, fit again without --hold-out",
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


def judge_evidence(e: Evidence) -> Verdict:
    """Apply the rules."""
    unseen = f"{e.hits} of {e.n} {'held-out rows' if e.held_out else 'left-out rows'}"
    error = f"{short(e.rmse)} {e.unit} rms"
    if math.isfinite(e.max_relative_error):
        error += f", largest error {percent(e.max_relative_error)} of the reading"
    tests = [
        *e.checks,
        Check(e.low_coverage_p, Remark(
            f"the 90 % band covered only {unseen}, which happens with probability "
            f"{short(e.low_coverage_p)} if it is right", "Bands too narrow",
        )),
        Check(binomial_p(e.sign_changes, e.neighbours, 0.5), Remark(
            f"residuals change sign {e.sign_changes} {'time' if e.sign_changes == 1 else 'times'} "
            f"along {e.along}, where about "
            f"{e.neighbours / 2:.0f} changes would be chance", "Curve misses a pattern", True,
        )),
    ]  # fmt: skip
    surprised = Remark(
        f"the priors did not expect these data ({e.prior_hits} of {e.prior_n} points lie inside "
        f"their 95 % band); check {e.suspects}" + "".join(f"; {note}" for note in e.notes),
        "Data and priors disagree", True,
    )  # fmt: skip
    remarks = (
        *(Remark(f"an emulator stood in for the simulator, and {why}",
                 "Emulator not good enough", True) for why in e.emulator_fails),
        *e.remarks, *failed(tests), *[surprised][: e.prior_hits < _EXPECTED * e.prior_n],
    )  # fmt: skip
    remarks = tuple(sorted(remarks, key=lambda remark: not remark.title))
    if not e.converged:
        return Verdict(
            Level.NO, "not converged", "NOT CONVERGED", "nothing yet",
            f"any number of this output: {'; '.join(e.reasons[:2])}. Run it with more steps, or "
            f"give priors that rule out what makes no sense", remarks,
        )  # fmt: skip
    if e.n and not math.isfinite(e.rmse):
        return Verdict(
            Level.NO, "not scored", "Not validated", f"the fit inside {e.inside}",
            "predictions of unseen rows: they could not be scored, since the model has no value "
            "for part of the posterior there", remarks,
        )  # fmt: skip
    fails = [remark for remark in remarks if remark.title]
    # Were none of them covered, it would not be found.
    few = binomial_p(0, e.n) > LEVEL / len(tests)
    found = replace(_of_assumptions_that_hold(e, error, even=not fails, few=few), remarks=remarks)
    if not fails:
        return found
    off = any(remark.shifts for remark in fails)
    trust = "the order of magnitude" if off else "the median"
    if found.rule == "extrapolated":
        trust += f" at {e.at_pressures}"
    elif e.n:
        trust += f", to {error}"
    doubted = "the medians and the width of the bands" if off else "the width of the bands"
    return replace(
        found, level=Level.CARE, rule=_RULES.get(fails[0].title, "assumption"), where=(),
        headline=fails[0].title, trust=trust,
        doubt=f"{doubted}: what they rest on does not hold; {found.doubt}",
    )  # fmt: skip


_RULES = {
    "Emulator not good enough": "emulated badly",
    "Bands too narrow": "miscovered",
    "Curve misses a pattern": "misfit",
    "Data and priors disagree": "unexpected",
}


def _of_assumptions_that_hold(e: Evidence, error: str, *, even: bool, few: bool) -> Verdict:
    names = joined([plain(name) for name in e.prior_set]) if e.prior_set else ""
    if e.two_pressures and e.prior_set:
        return _between_two(e, names, error)
    if not e.n:
        return Verdict(
            Level.CARE, "not validated", "Not validated", f"the fit inside {e.inside}",
            "predictions: no row was held out or left out to judge them by",
        )  # fmt: skip
    if few:
        return Verdict(
            Level.CARE, "few", "Too few unseen rows", f"the fit inside {e.inside}",
            f"predictions: {e.n} {'row' if e.n == 1 else 'rows'} cannot tell whether they hold; "
            "hold out more, or none, and each row is left out in turn",
        )  # fmt: skip
    if e.skill < _WEAK_SKILL:
        return Verdict(
            Level.CARE, "weak", "Explains little", f"the bands for {e.inside}",
            f"the median as a prediction: it removes only {percent(max(0.0, e.skill))} of the "
            f"scatter (variance) of rows it has not seen",
        )  # fmt: skip
    doubt = "anything outside that range" if even else f"anything outside {e.inside}"
    if e.prior_set:
        doubt += f"; the values of {names}, which the data did not narrow"
    trust = f"median and bands for {e.inside}, to {error}"
    return Verdict(Level.FINE, "fine", "Holds on unseen rows", trust, doubt)


def _between_two(e: Evidence, names: str, error: str) -> Verdict:
    """Say what two pressures leave open, with an error only where it was measured."""
    verb = "comes" if len(e.prior_set) == 1 else "come"
    why = f"two pressures do not determine a quadratic, so {names} {verb} from the prior"
    trust = f"the curves at {e.at_pressures}"
    if e.unseen_at is Where.BETWEEN:
        rows = f"{short(e.effective)} independent {'row' if e.effective < 1.05 else 'rows'}"
        worth = f", {e.n} rows worth {rows}," if math.isfinite(e.effective) else ""
        doubt = (
            f"the median between the two pressures, off by {error}: {why}. The width of the band "
            f"there is the prior's too, and one held-out curve{worth} cannot confirm it"
        )
    else:
        doubt = f"anything between the two pressures: nothing was measured between them, and {why}"
        if e.unseen_at is Where.BEYOND:
            doubt += f". Beyond them the median is off by {error}"
        else:
            trust += f", to {error}"
    return Verdict(
        Level.CARE, "extrapolated", "Curvature from the prior", trust, doubt,
        where=_elsewhere(e.parabolic_in, e.fitted_at),
    )  # fmt: skip


def _elsewhere(column: str, values: Sequence[float]) -> tuple[Range, ...]:
    """All of a condition but some values, whatever their rounding."""
    ends = [-math.inf, *(v for value in values for v in (value, value)), math.inf]
    pairs = zip(ends[::2], ends[1::2], strict=True)
    return tuple(Range(column, low * (1.0 + 1e-9), high * (1.0 - 1e-9)) for low, high in pairs)


@dataclass(frozen=True)
class _Pair:
    calibration: Calibration
    validation: Validation | None
    prior_predictive: Array


class Judged(Result, Protocol):
    """What evidence is gathered of: a result, and what the priors expect of its rows."""

    @property
    def prior_predictive(self) -> Array:
        """Measurements that the priors expect at its rows, shape (draws, n)."""


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
    evidence = gather(_Pair(calibration, validation, prior))
    found = judge_evidence(replace(evidence, emulator_fails=emulator_fails))
    held = held_table(_Pair(calibration, validation, prior))
    if held is None:
        return found
    at = f" ({held_out})" if held_out else ""
    return replace(found, held_out=f"{len(held)} rows{at}")


def validated(calibration: Calibration, held: Table | None) -> Validation | None:
    """Score a calibration on rows held out, or on each left out in turn; None where neither can be.

    Rows are left out by weights alone, for to fit without each takes as long as all else. Of a
    posterior that did not converge, or of more rows than a report takes, none is.
    """
    if held is not None:
        return validate_held_out(calibration, held)
    if not calibration.converged or len(calibration.problem.table) > MAX_ROWS:
        return None
    return leave_one_out(calibration, refit=False)


def keep_verdict(found: Verdict, folder: Path) -> None:
    """Add a verdict to the record of a run folder, for `calib predict`."""
    path = folder / RUN
    document = {**json.loads(path.read_text(encoding="utf-8")), "verdict": found.document()}
    path.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def kept_verdict(folder: Path) -> Verdict | None:
    """Return the verdict of a run folder, if it has one."""
    document = json.loads((folder / RUN).read_text(encoding="utf-8")).get("verdict")
    return None if document is None else Verdict.of(document)


def gather(result: Judged) -> Evidence:
    """Collect the evidence of a result, in the units of its file."""
    with units_of(result.calibration.problem.table.header):
        return _gathered(result)


def _gathered(result: Judged) -> Evidence:
    calibration, v = result.calibration, result.validation
    problem, report = calibration.problem, calibration.draws.report
    parabolic = problem.bound.model.parabolic_in
    axis = axis_of(problem.bound.model.output)
    fitted_at = np.unique(problem.table[parabolic]) if parabolic else np.zeros(0)
    changes, neighbours = signs_along(result, standardise(calibration, problem).residual)
    return Evidence(
        converged=report.passed,
        reasons=report.reasons,
        **_unseen(result, v),
        unit=axis.unit,
        prior_set=[p for p in problem.names if role(calibration, p) in (PRIOR, MOVED)],
        two_pressures=fitted_at.size == 2,
        sign_changes=changes,
        neighbours=neighbours,
        along=axis_of(x_column(result)).name.lower(),
        inside=_range_words(result),
        unseen_at=_unseen_at(problem, v) if parabolic and v and held_table(result) else Where.AT,
        at_pressures=_at_pressures(result) if parabolic else "",
        prior_hits=hits(result.prior_predictive, problem.observed, 0.95),
        prior_n=problem.observed.size,
        suspects=_suspects(problem),
        notes=problem.notes,
        remarks=remarks_of(calibration),
        checks=checks_of(calibration),
        parabolic_in=parabolic,
        fitted_at=tuple(fitted_at.tolist()),
    )


def _unseen(result: Judged, v: Validation | None) -> dict[str, Any]:
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


def _suspects(problem: Problem) -> str:
    """Name what to check where data and priors disagree."""
    pull = role_of(problem.bound.model.output) == "pull"
    return "the units and the normal load" if pull else "the units"


def _unseen_at(problem: Problem, validation: Validation) -> Where:
    column = problem.bound.model.parabolic_in
    fitted, unseen = problem.table[column], validation.table[column]
    if bool(((unseen < fitted.min()) | (unseen > fitted.max())).any()):
        return Where.BEYOND
    return Where.AT if bool(np.isin(unseen, fitted).any()) else Where.BETWEEN


def _at_pressures(result: Result) -> str:
    problem = result.calibration.problem
    column, along = problem.bound.model.parabolic_in, x_column(result)
    axis, x = axis_of(column), axis_of(along)
    words = joined([axis.value_text(float(p)) for p in np.unique(problem.table[column])])
    return f"{words} {axis.unit} for {x.name.lower()} {x.range_text(problem.table[along])}"


def _range_words(result: Result) -> str:
    parts = []
    for name, values in result.calibration.problem.conditions.items():
        axis = axis_of(name)
        parts.append(f"{axis.name.lower()} {axis.range_text(values)}")
    return joined(parts)
