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

from calib.arguments import takes
from calib.data.quantities import output_of, role_of
from calib.errors import CalibError
from calib.inference.calibration import Calibration
from calib.inference.io import RUN
from calib.inference.joint import NEW_GROUP
from calib.inference.joint_files import JOINT
from calib.inference.problem import Problem
from calib.inference.random import generator
from calib.models.base import Array
from calib.report.constants import EXPECTED, WEAK_SKILL
from calib.report.labels import axis_of, joined, units_of
from calib.report.page.template import words
from calib.report.rows import Fitted, held_table, signs_along, x_column
from calib.validation.assumptions import checks_of, conflicts, remarks_of
from calib.validation.constants import LEVEL
from calib.validation.prediction import (
    bias_probability,
    binomial_p,
    coverage_probability,
    effective_rows,
    hits,
    prior_predictive,
)
from calib.validation.residuals import Check, Range, Remark, failed
from calib.validation.scores import PRIOR_SET, standardise
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
    """What a verdict is made from; rows that were not fitted are called unseen."""

    converged: bool
    reasons: Sequence[str]
    held_out: bool  # whether rows were; otherwise each was left out in turn
    hits: int  # unseen rows inside the 90 % band
    n: int  # unseen rows
    low_coverage_p: float  # of covering no more than that, were the bands right
    effective: float  # independent rows that would say as much
    rmse: float
    unit: str
    max_relative_error: float  # NaN where no row is large enough to be judged
    prior_set: Sequence[str]  # parameters whose width is the prior's
    two_pressures: bool  # whether a quadratic in pressure was calibrated at two pressures
    null_rmse: float  # of the calibrated rows' mean, which knows no condition
    linear_rmse: float  # of a linear regression on the conditions, on the scale of the response
    sign_changes: int  # of the residuals along the curve
    neighbours: int
    along: str  # the condition that the curve runs along
    inside: str  # the calibrated range in words
    unseen_at: Where = Where.AT
    at_pressures: str = "the two calibrated pressures"  # with the range of the curves there
    prior_hits: int = 0  # calibrated points inside the priors' 95 % predictive band
    prior_n: int = 0
    suspects: str = "the units"  # to be checked where the priors did not expect the data
    notes: Sequence[str] = ()  # what was assumed where the data do not say
    emulator_fails: Sequence[str] = ()  # why the simulator's emulator is not good enough
    remarks: Sequence[Remark] = ()  # of the rows and the posterior on the assumptions
    checks: Sequence[Check] = ()  # of the same family as coverage and signs of residuals
    parabolic_in: str = ""  # canonical column of that quadratic
    fitted_at: Sequence[float] = ()  # its two calibrated values
    # The same errors of fitted rows, each left out in turn, where others were held out.
    loo_rmse: float = math.nan
    loo_max_relative_error: float = math.nan
    bias_p: float = 1.0  # of held-out readings so far to one side, were the bands right
    conflicts: Sequence[str] = ()  # parameters whose posterior is at the edge of the prior

    @property
    def skill(self) -> float:
        """Part of the scatter about the calibrated mean that the median removes."""
        return 1.0 - (self.rmse / self.null_rmse) ** 2 if self.null_rmse > 0.0 else math.nan


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

    def __repr__(self) -> str:
        return f"<Verdict {self.level.value}: {self.headline}; do not trust {self.doubt}>"

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
        held = [_words("held out", held_out=self.held_out)] if self.held_out else []
        return (*held, *said)

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
    ends = (-math.inf, math.inf)
    return [{k: None if v in ends else v for k, v in r._asdict().items()} for r in ranges]


def _read(ranges: Sequence[Mapping[str, Any]]) -> tuple[Range, ...]:
    open_ended: dict[str, Any] = {"low": -math.inf, "high": math.inf}
    return tuple(
        Range(**{k: open_ended[k] if v is None else v for k, v in r.items()}) for r in ranges
    )


def _words(part: str, **facts: Any) -> str:
    return words("verdict.j2", "calib.report", part=part, **facts)


# What decides where no assumption fails: the first rule that holds.
_RULES: tuple[tuple[str, Level, str, Callable[[Evidence], bool]], ...] = (
    ("not converged", Level.NO, "NOT CONVERGED", lambda e: not e.converged),
    ("not scored", Level.NO, "Not validated", lambda e: e.n > 0 and not math.isfinite(e.rmse)),
    (
        "extrapolated",
        Level.CARE,
        "Curvature from the prior",
        lambda e: e.two_pressures and len(e.prior_set) > 0,
    ),
    ("not validated", Level.CARE, "Not validated", lambda e: e.n == 0),
    # Were none of them covered, it would not be found.
    (
        "few",
        Level.CARE,
        "Too few unseen rows",
        lambda e: binomial_p(0, e.n) > LEVEL / len(_family(e)),
    ),
    ("weak", Level.CARE, "Explains little", lambda e: e.skill < WEAK_SKILL),
    ("fine", Level.FINE, "Holds on unseen rows", lambda e: True),
)

# What decides where one fails, by the title of its remark.
_FAILS = {
    "Emulator not good enough": "emulated badly",
    "Bands too narrow": "miscovered",
    "Curve misses a pattern": "misfit",
    "Data and priors disagree": "unexpected",
}


def _family(e: Evidence) -> tuple[Check, ...]:
    """Return the checks that have a probability, which are judged together."""
    coverage = Remark(_words("coverage", e=e), "Bands too narrow")
    pattern = Remark(_words("pattern", e=e), "Curve misses a pattern", True)
    biased = Remark(_words("bias", e=e), "Predictions off to one side", True)
    signs_p = binomial_p(e.sign_changes, e.neighbours, 0.5)
    # Where predictions are off, their bands are not too narrow.
    unseen = (*([Check(e.bias_p, biased)] if e.held_out else []), Check(e.low_coverage_p, coverage))
    return (*e.checks, *unseen, Check(signs_p, pattern))


def checks_passed(e: Evidence) -> tuple[int, int]:
    """Return how many checks of rows, priors and bands pass, and how many there are."""
    family = _family(e)
    return len(family) - len(failed(family)), len(family)


def judge_evidence(e: Evidence) -> Verdict:
    """Apply the rules."""
    emulated = (_words("emulator", failure=why) for why in e.emulator_fails)
    remarks = [Remark(text, "Emulator not good enough", True) for text in emulated]
    remarks += e.remarks
    remarks += failed(_family(e))
    if e.prior_hits < EXPECTED * e.prior_n:
        remarks.append(Remark(_words("surprise", e=e), "Data and priors disagree", True))
    remarks.sort(key=lambda remark: not remark.title)
    rule, level, headline, _ = next(r for r in _RULES if r[3](e))
    fails = [remark for remark in remarks if remark.title] if level is not Level.NO else []
    facts = {"e": e, "rule": rule, "fails": fails, "shifts": any(r.shifts for r in fails)}
    trust, doubt = _words("trust", **facts), _words("doubt", **facts)
    where: tuple[Range, ...] = ()
    if fails:
        level, headline = Level.CARE, fails[0].title
        rule = _FAILS.get(headline, "assumption")
    elif rule == "extrapolated":
        where = _elsewhere(e.parabolic_in, e.fitted_at)
    return Verdict(level, rule, headline, trust, doubt, tuple(remarks), where)


def _elsewhere(column: str, values: Sequence[float]) -> tuple[Range, ...]:
    """All of a condition but some values, whatever their rounding."""
    ends = [-math.inf, *(v for value in values for v in (value, value)), math.inf]
    pairs = zip(ends[::2], ends[1::2], strict=True)
    return tuple(Range(column, low * (1.0 + 1e-9), high * (1.0 - 1e-9)) for low, high in pairs)


@takes(calibration=Calibration, validation=Validation, loo=Validation)
def verdict(
    calibration: Calibration,
    validation: Validation | None = None,
    *,
    loo: Validation | None = None,
    emulator_fails: Sequence[str] = (),
    held_out: str = "",
) -> Verdict:
    """Say in a headline what can be trusted, as the pages do; nothing is drawn.

    Parameters
    ----------
    calibration : Calibration
    validation : Validation, optional
        Of it: `calib.validate_held_out` or `calib.leave_one_out`.
    loo : Validation, optional
        `calib.leave_one_out`, where the validation is on rows held out: the worse error is stated.
    emulator_fails : sequence of str
        Why the emulator that stood in for a simulator, if one did, is not good enough.
    held_out : str
        What the rows have in common that were held out, for instance a column and its value.

    Examples
    --------
    >>> import calib
    >>> ruts = calib.load_he2019("rut_depth")
    >>> calibration = calib.calibrate(calib.build_problem("bekker", ruts), seed=1)
    >>> calib.verdict(calibration).headline
    'A column explains the residuals'
    """
    output = output_of(calibration.problem.bound.model.output)
    if calibration.part_of.endswith(NEW_GROUP):
        raise CalibError(
            f"{calibration.label} has no rows to judge it by", where="calib.verdict",
            expected="a calibration of a known group",
            hint="name a group (`JointCalibration.calibration(output, group)`), and judge new ones "
            "by rows of a group that was held out (`calib.validate_held_out`)",
        )  # fmt: skip
    prior = prior_predictive(calibration.problem, generator(calibration.seed, output, "prior"))
    evidence = gather(calibration, validation, prior, loo=loo)
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


def joint_verdicts(folder: Path) -> dict[str, Verdict]:
    """Return the verdicts of a joint folder, by output and group."""
    kept = json.loads((folder / JOINT).read_text(encoding="utf-8")).get("verdict", {})
    return {place: Verdict.of(document) for place, document in kept.items()}


def gather(
    calibration: Calibration,
    v: Validation | None,
    prior_predictive: Array,
    *,
    loo: Validation | None = None,
) -> Evidence:
    """Collect the evidence of a calibration, in the units of its file.

    The validation is on rows that were not fitted, if there were any, `loo` by leave-one-out beside
    it; the measurements that the priors expect at its rows have shape (draws, n).
    """
    result, problem = Fitted(calibration, v), calibration.problem
    model, parabolic = problem.bound.model, problem.bound.model.parabolic_in
    held = held_table(result)
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
        loo_errors = _errors(problem, loo)
        return Evidence(
            converged=calibration.draws.report.passed,
            reasons=calibration.draws.report.reasons,
            held_out=held is not None,
            **_unseen(problem, v),
            unit=axis_of(model.output).unit,
            prior_set=[p for p in problem.names if calibration.summary[p].sd_ratio > PRIOR_SET],
            two_pressures=fitted_at.size == 2,
            sign_changes=changes,
            neighbours=neighbours,
            along=x.name.lower(),
            inside=joined(list(ranges.values())),
            unseen_at=_unseen_at(fitted_at, held[parabolic]) if parabolic and held else Where.AT,
            at_pressures=at_pressures,
            prior_hits=hits(prior_predictive, problem.observed, 0.95),
            prior_n=problem.observed.size,
            suspects="the units" + " and the normal load" * (role_of(model.output) == "pull"),
            notes=problem.notes,
            remarks=remarks_of(calibration),
            conflicts=conflicts(calibration),
            checks=checks_of(calibration),
            parabolic_in=parabolic,
            fitted_at=tuple(fitted_at.tolist()),
            loo_rmse=loo_errors["rmse"],
            loo_max_relative_error=loo_errors["max_relative_error"],
        )


def _unseen(problem: Problem, v: Validation | None) -> dict[str, Any]:
    """Return what was found on rows that were not fitted."""
    nothing = float("nan")
    if v is None:
        scores = {
            "effective": nothing, "null_rmse": nothing, "linear_rmse": nothing,
            **_errors(problem, v),
        }  # fmt: skip
        return {"hits": 0, "n": 0, "low_coverage_p": 1.0, **scores}
    covered = v.scores.coverage[0.9]
    complete = bool(np.isfinite(v.draws).all(axis=1).any())
    null = float(np.sqrt(np.mean(np.square(v.observed - problem.observed.mean()))))
    if complete and v.method == "held_out":
        # Held-out rows share a curve, so the binomial law would raise false alarms.
        low_coverage_p = coverage_probability(v.draws, covered.hits, 0.9)
        bias_p = bias_probability(v.draws, v.scores.pit)
    else:
        low_coverage_p, bias_p = binomial_p(covered.hits, covered.n), 1.0
    return {
        "hits": covered.hits,
        "n": covered.n,
        "low_coverage_p": low_coverage_p,
        "bias_p": bias_p,
        "effective": effective_rows(v.draws) if complete else nothing,
        **_errors(problem, v),
        "null_rmse": axis_of(problem.bound.model.output).factor * null,
        "linear_rmse": axis_of(problem.bound.model.output).factor * _linear_rmse(problem, v),
    }


def _linear_rmse(problem: Problem, v: Validation) -> float:
    """Return the error of a linear regression of the response on the conditions, on the same rows.

    Left out in turn, or held out, as the model's are.
    """
    fitted = np.column_stack([np.ones(len(problem.table)), *problem.conditions.values()])
    scale = np.abs(fitted).max(axis=0)
    scale[scale == 0.0] = 1.0
    coefficients, _, rank, _ = np.linalg.lstsq(fitted / scale, problem.response)
    if v.method == "held_out":
        at = problem.bound.model.select(v.table.columns)
        new = np.column_stack([np.ones(len(v.table)), *at.values()])
        predicted = new / scale @ coefficients
    else:
        q, _ = np.linalg.qr(fitted / scale)
        leverage = np.square(q).sum(axis=1)
        residual = problem.response - fitted / scale @ coefficients
        if rank < fitted.shape[1] or leverage.max() > 1.0 - 1e-9:
            return math.nan
        predicted = problem.response - residual / (1.0 - leverage)
    error = problem.bound.from_response(predicted) - v.observed
    return float(np.sqrt(np.mean(np.square(error))))


def _errors(problem: Problem, v: Validation | None) -> dict[str, float]:
    """Return the errors of rows that were not fitted, in the unit shown; NaN without any."""
    if v is None:
        return {"rmse": math.nan, "max_relative_error": math.nan}
    factor = axis_of(problem.bound.model.output).factor
    return {"rmse": factor * v.scores.rmse, "max_relative_error": v.scores.max_relative_error}


def _unseen_at(fitted: Array, unseen: Array) -> Where:
    if bool(((unseen < fitted.min()) | (unseen > fitted.max())).any()):
        return Where.BEYOND
    return Where.AT if bool(np.isin(unseen, fitted).any()) else Where.BETWEEN
