"""The verdict on one output, by explicit rules, from a few numbers.

The first rule that applies decides:

1. not converged: the convergence gate was not passed;
2. not scored: the validation has no finite error;
3. emulated badly: the emulator that stood in for a simulator is not good enough;
4. miscovered: unseen rows fell outside the 90 % band more often than chance allows;
5. misfit: residuals keep their sign along the curve for longer than chance allows;
6. unexpected: fewer than half of the calibrated points lie inside what the priors expect;
7. extrapolated: the prior, not the data, sets what the prediction of unseen rows hangs on;
8. weak: the median is hardly better than the mean of the calibrated rows;
9. fine.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from calib.data.quantities import output_of, role_of
from calib.inference.calibration import Calibration
from calib.inference.problem import Problem
from calib.inference.random import generator
from calib.report.labels import axis_of, joined, percent, plain, short
from calib.report.rows import held_table, signs_along, x_column
from calib.report.study import OutputResult, judged, prior_predictive
from calib.report.study_tasks import MAX_ROWS
from calib.validation.joint import binomial_p, coverage_probability, effective_rows, hits
from calib.validation.residuals import standardise
from calib.validation.roles import MOVED, PRIOR, role
from calib.validation.validate import Validation

_SIGNIFICANT = 0.05
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
    """

    level: Level
    rule: str
    headline: str
    trust: str
    doubt: str


def judge_evidence(e: Evidence) -> Verdict:
    """Apply the rules."""
    unseen = f"{e.hits} of {e.n} {'held-out rows' if e.held_out else 'left-out rows'}"
    error = f"{short(e.rmse)} {e.unit} rms"
    if math.isfinite(e.max_relative_error):
        error += f", {percent(e.max_relative_error)} at most"
    if not e.converged:
        return Verdict(
            Level.NO, "not converged", "NOT CONVERGED", "nothing yet",
            f"any number of this output: {'; '.join(e.reasons[:2])}. Run it with more steps, or "
            f"give priors that rule out what makes no sense",
        )  # fmt: skip
    if not math.isfinite(e.rmse):
        return Verdict(
            Level.NO, "not scored", "Not validated", f"the fit inside {e.inside}",
            "predictions of unseen rows: they could not be scored, since the model has no value "
            "for part of the posterior there",
        )  # fmt: skip
    if e.emulator_fails:
        return Verdict(
            Level.CARE, "emulated badly", "Emulator not good enough",
            f"the order of magnitude, to {error}",
            "what is said of the simulator's parameters: an emulator stood in for it, and "
            f"{'; '.join(e.emulator_fails)}",
        )  # fmt: skip
    if e.low_coverage_p < _SIGNIFICANT:
        return Verdict(
            Level.CARE, "miscovered", "Bands too narrow", f"the median, to {error}",
            f"the width of the bands: the 90 % band covered only {unseen}, which happens with "
            f"probability {short(e.low_coverage_p)} if it is right",
        )  # fmt: skip
    if e.neighbours and binomial_p(e.sign_changes, e.neighbours, 0.5) < _SIGNIFICANT:
        return Verdict(
            Level.CARE, "misfit", "Curve misses a pattern", f"the order of magnitude, to {error}",
            f"the shape of the curve: residuals change sign {e.sign_changes} times along "
            f"{e.along}, where about {e.neighbours / 2:.0f} changes would be chance",
        )  # fmt: skip
    names = joined([plain(name) for name in e.prior_set]) if e.prior_set else ""
    if e.prior_hits < _EXPECTED * e.prior_n:
        return Verdict(
            Level.CARE, "unexpected", "Data and priors disagree",
            f"the shape of the curves for {e.inside}, to {error}, once the cause is known",
            f"anything the prior has a say in: the priors did not expect these data ("
            f"{e.prior_hits} of {e.prior_n} points lie inside their 95 % band); check {e.suspects}"
            + "".join(f"; {note}" for note in e.notes),
        )  # fmt: skip
    if e.two_pressures and e.prior_set:
        return _between_two(e, names, error)
    if e.skill < _WEAK_SKILL:
        return Verdict(
            Level.CARE, "weak", "Explains little", f"the bands for {e.inside}",
            f"the median as a prediction: it removes only {percent(max(0.0, e.skill))} of the "
            f"scatter (variance) of rows it has not seen",
        )  # fmt: skip
    trust = f"median and bands for {e.inside}"
    doubt = "anything outside that range"
    if e.prior_set:
        doubt += f"; the values of {names}, which the data did not narrow"
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
    return Verdict(Level.CARE, "extrapolated", "Curvature from the prior", trust, doubt)


def verdict(calibration: Calibration, validation: Validation) -> Verdict:
    """Say in a headline what can be trusted, as the pages do; nothing is drawn.

    Parameters
    ----------
    calibration : Calibration
    validation : Validation
        Of it: `calib.validate_held_out` or `calib.leave_one_out`.
    """
    return judge_evidence(gather(judged(calibration, validation)))


def gather(result: OutputResult) -> Evidence:
    """Collect the evidence of a result."""
    calibration, v = result.calibration, result.validation
    problem, report = calibration.problem, calibration.draws.report
    covered = v.scores.coverage[0.9]
    held = held_table(result) is not None
    complete = bool(np.isfinite(v.draws).all(axis=1).any())
    parabolic = problem.bound.model.parabolic_in
    changes, neighbours = signs_along(result, standardise(calibration, problem).residual)
    scatter = float(np.mean(np.square(v.observed - problem.observed.mean())))
    axis = axis_of(problem.bound.model.output)
    return Evidence(
        converged=report.passed,
        reasons=report.reasons,
        held_out=held,
        hits=covered.hits,
        n=covered.n,
        low_coverage_p=(
            # Held-out rows share a curve, so the binomial law would raise false alarms.
            coverage_probability(v.draws, covered.hits, 0.9)
            if held and complete
            else binomial_p(covered.hits, covered.n)
        ),
        effective=effective_rows(v.draws) if complete else float("nan"),
        rmse=axis.factor * v.scores.rmse,
        unit=axis.unit,
        max_relative_error=v.scores.max_relative_error,
        prior_set=[p for p in problem.names if role(calibration, p) in (PRIOR, MOVED)],
        two_pressures=bool(parabolic) and np.unique(problem.table[parabolic]).size == 2,
        skill=1.0 - v.scores.rmse**2 / scatter if scatter > 0.0 else float("nan"),
        sign_changes=changes,
        neighbours=neighbours,
        along=axis_of(x_column(result)).name.lower(),
        inside=_range_words(result),
        unseen_at=_unseen_at(result) if parabolic and held else Where.AT,
        at_pressures=_at_pressures(result) if parabolic else "",
        prior_hits=hits(result.prior_predictive, problem.observed, 0.95),
        prior_n=problem.observed.size,
        suspects=_suspects(problem),
        notes=problem.notes,
    )


def _suspects(problem: Problem) -> str:
    """Name what to check where data and priors disagree."""
    pull = role_of(problem.bound.model.output) == "pull"
    return "the units and the normal load" if pull else "the units"


def prior_conflict(calibration: Calibration) -> tuple[str, ...]:
    """Say that data and priors disagree as a whole, by the rule of a report's card; else nothing.

    Tables of more rows than a report takes are not judged.
    """
    problem = calibration.problem
    n = problem.observed.size
    if n > MAX_ROWS:
        return ()
    rng = generator(calibration.seed, output_of(problem.bound.model.output), "prior")
    inside = hits(prior_predictive(problem, rng), problem.observed, 0.95)
    if inside >= _EXPECTED * n:
        return ()
    return (
        f"data and priors disagree: {inside} of {n} points lie inside the 95 % band that the "
        f"priors expect; check {_suspects(problem)}, then the priors",
    )


def _unseen_at(result: OutputResult) -> Where:
    column = result.calibration.problem.bound.model.parabolic_in
    fitted = result.calibration.problem.table[column]
    unseen = result.validation.table[column]
    if bool(((unseen < fitted.min()) | (unseen > fitted.max())).any()):
        return Where.BEYOND
    return Where.AT if bool(np.isin(unseen, fitted).any()) else Where.BETWEEN


def _at_pressures(result: OutputResult) -> str:
    problem = result.calibration.problem
    column, along = problem.bound.model.parabolic_in, x_column(result)
    axis, x = axis_of(column), axis_of(along)
    words = joined([axis.value_text(float(p)) for p in np.unique(problem.table[column])])
    return f"{words} {axis.unit} for {x.name.lower()} {x.range_text(problem.table[along])}"


def _range_words(result: OutputResult) -> str:
    parts = []
    for name, values in result.calibration.problem.conditions.items():
        axis = axis_of(name)
        parts.append(f"{axis.name.lower()} {axis.range_text(values)}")
    return joined(parts)
