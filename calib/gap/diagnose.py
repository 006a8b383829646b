"""Diagnose a case: where the gap lies, which cause it has, how far it shrinks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, field, fields, replace
from numbers import Integral
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.arguments import takes
from calib.batch.environment import one_thread
from calib.batch.pool import HERE
from calib.data.quantities import OUTPUTS, columns_of, role_of
from calib.gap.campaigns import Campaigns, campaigns
from calib.gap.case import Case, Context, new_values, read_case, read_context
from calib.gap.constants import FOLD_DRAWS, FOLDS, MIN_FIELD_ROWS, MOST_ROUNDS, NAMED, WORTH_SAYING
from calib.gap.corrected import (
    Corrected,
    NewPrediction,
    Shrink,
    covered,
    predict_new,
    shrink,
)
from calib.gap.effects import EFFECTS, Effect, View
from calib.gap.effects.dependence import PREFIX, DependsOn
from calib.gap.effects.user import check_effects
from calib.gap.fit import Fit
from calib.gap.hypotheses import inseparable, singles, unusual_sizes, with_case_effects
from calib.gap.identifiability import Identifiability, NextMeasurement, next_measurements
from calib.gap.mixture import (
    UNLISTED,
    Inclusion,
    Region,
    RowGap,
    Truth,
    inclusion,
    inclusion_probability,
    mixture,
    regions,
    row_gaps,
    unused_rows,
)
from calib.gap.noise import noise_conditions
from calib.gap.plausibility import doubts, oddities
from calib.gap.ranking import Lab, Ranking, calibrate_lab, rank
from calib.gap.screening import left_over, screen, without_field_outliers, without_outputs
from calib.inference.random import generator
from calib.models.base import Array
from calib.shown import Shown
from calib.validation.prediction import outside
from calib.validation.residuals import Remark


@dataclass(frozen=True, repr=False)
class Diagnosis(Shown):
    """What was found for a case.

    Parameters
    ----------
    data : Campaigns
    ranking : Ranking
    verdict : {"effect", "none", "unknown", "ambiguous"}
    truth : Truth
        At the field rows.
    gaps : tuple of RowGap
    regions : tuple of Region
    shrink : mapping of str to Shrink
    new_predictions : mapping of str to NewPrediction
        Empty without conditions to predict.
    next_measurements : tuple of NextMeasurement
        What would separate hypotheses that are still in play.
    corrected : Corrected
        To predict at other conditions.
    seed : int
    inclusion : Inclusion
        Which causes act, whatever else acts, and their shares of the gap.
    without_context : mapping of str to float, optional
        How probable each cause is to act without what the case's context put in; ``none`` and
        ``unknown`` (something unlisted) among them. None without a context.
    warnings : tuple of str
        What a reader must know: of the input, what was set aside, what is extrapolated.
    unused : mapping of str to (mapping of int to str)
        Field rows that an output was not judged by, by output and row, with the reason.
    doubts : tuple of Remark
        What the most probable explanation leaves in the field, and should not; among the warnings.
    """

    data: Campaigns
    ranking: Ranking
    verdict: str
    truth: Truth
    gaps: tuple[RowGap, ...]
    regions: tuple[Region, ...]
    shrink: Mapping[str, Shrink]
    new_predictions: Mapping[str, NewPrediction]
    next_measurements: tuple[NextMeasurement, ...]
    corrected: Corrected
    seed: int
    inclusion: Inclusion
    without_context: Mapping[str, float] | None = None
    warnings: tuple[str, ...] = ()
    unused: Mapping[str, Mapping[int, str]] = field(default_factory=dict)
    doubts: tuple[Remark, ...] = ()

    def __repr__(self) -> str:
        """Name the case, the verdict and the most probable hypotheses."""
        p = self.ranking.probability
        best = ", ".join(f"{name} {p[name]:.3f}" for name in self.ranking.order[:3])
        return f"<Diagnosis of {self.data.case.name}: {self.verdict}; {best}>"


type Progress = Callable[[str, int, int], None]


@takes(case=(Case, PathLike), seed=Integral, effects=Mapping, context=Mapping)
def diagnose(
    case: Case | str | Path,
    seed: int = 1,
    *,
    context: Mapping[str, Any] | None = None,
    effects: Mapping[str, Effect] = EFFECTS,
    pool: Executor = HERE,
    progress: Progress = lambda what, done, planned: None,
) -> Diagnosis:
    """Find where a calibrated simulator misses, which effect it lacks, and what adding it gains.

    Parameters
    ----------
    case : Case or path
        A case, or the folder of one (`case.toml`, `lab.csv`, `field.csv`).
    seed : int
        Same seed, same numbers.
    context : mapping, optional
        What is known beyond the data, as the table ``[context]`` of a ``case.toml`` has it, in the
        place of the case's own: ``same_soil``, ``suspected``, ``excluded``, ``sizes``.
    effects : mapping of str to Effect, optional
        The effects to consider, by name.
    pool : Executor, optional
        Where field rows are left out, if they have to be; the numbers do not depend on it.
    progress : callable, optional
        Called with the name of a step, steps done and steps planned.

    Returns
    -------
    Diagnosis

    Raises
    ------
    CalibError
        If the case cannot be diagnosed: an output or a condition is missing, too few rows; if the
        context names what there is not; or an effect that is not calib's own does not do what an
        effect must.

    Examples
    --------
    >>> import calib
    >>> diagnosis = calib.diagnose("cases/nominal_slip")  # doctest: +SKIP
    >>> diagnosis.to_dataframe().head(3)  # doctest: +SKIP
    >>> known = {"same_soil": True, "suspected": {"lug_thrust": 0.5}, "excluded": ["rate_effect"]}
    >>> diagnosis = calib.diagnose("cases/nominal_slip", context=known)  # doctest: +SKIP
    """
    if not isinstance(case, Case):
        case = read_case(Path(case))
    if context is not None:
        case = replace(case, context=read_context(context, "calib.diagnose"))
    found = diagnose_once(case, seed, effects, progress)
    progress("leaving field rows out", 0, 1)
    found = with_unseen_rows(found, effects, pool)
    progress("leaving field rows out", 1, 1)
    return found


@one_thread()
def diagnose_once(
    case: Case,
    seed: int,
    effects: Mapping[str, Effect] = EFFECTS,
    progress: Progress = lambda what, done, planned: None,
) -> Diagnosis:
    """Diagnose a case; how far the gap shrinks is judged on the rows it was found on.

    Unless there are other conditions to predict, `with_unseen_rows` has to follow.
    """
    check_effects(effects, case)
    progress("comparing sets of causes", 0, 1)
    data, ranking, said = screened_ranking(case, seed, effects)
    progress("comparing sets of causes", 1, 1)
    progress("where, how far, what to measure next", 0, 1)
    mixed = mixture(data, ranking, seed)
    truth = mixed.at(data.view)
    gaps = row_gaps(data, truth)
    # Without conditions to predict, the field's own are the best guess at where it will be used.
    target = data.view if case.new_conditions is None else data.at(case.new_conditions)
    at_target = truth if case.new_conditions is None else mixed.at(target)
    corrected = Corrected(mixed, ranking.lab_mode)
    before = corrected.calibrated(target.conditions)
    far = shrink(data, at_target, before, at_target.means)
    causes = inclusion(mixed, ranking)
    known = with_case_effects(data, effects)
    remarks = doubts(data, ranking)
    said += [
        *_beyond(corrected, before),
        *_confounded(data, causes, known),
        *unusual_sizes(singles(data, _sized(case.context, known, ranking)), case.context),
    ]
    progress("where, how far, what to measure next", 1, 1)
    return Diagnosis(
        data,
        ranking,
        verdict(ranking.probability),
        truth,
        gaps,
        regions(data, truth, gaps),
        far,
        {} if case.new_conditions is None else predict_new(at_target, before),
        next_measurements(data, ranking.in_play, seed),
        corrected,
        seed,
        causes,
        _without_context(case, seed, effects),
        (
            *case.notes,
            *(remark.text for remark in remarks),
            *oddities(case.lab, case.field, case.models),
            *new_values(case.covariates, case.lab, case.field),
            *data.said_of_errors,
            *said,
        ),
        unused_rows(data, case.field),
        remarks,
    )


def _sized(context: Context, effects: Mapping[str, Effect], ranking: Ranking) -> dict[str, Effect]:
    """Effects whose size is known, of those that can be tested."""
    return {n: effects[n] for n in context.sizes if n not in ranking.not_testable}


def screened_ranking(
    case: Case, seed: int, effects: Mapping[str, Effect]
) -> tuple[Campaigns, Ranking, list[str]]:
    """Rank, rows set aside that nothing explains; say which."""
    data, lab, said = screen(case, seed)
    ranking = rank(data, seed, effects=effects, lab=lab)
    for _ in range(MOST_ROUNDS):
        kept, more, sure = without_field_outliers(data, ranking)
        if not more:
            break
        without = rank(kept, seed, effects=effects, lab=lab)
        # A reading that takes a cause of its own to explain is an outlier as well.
        if not sure and without.causes >= ranking.causes:
            break
        data, ranking, said = kept, without, said + more
    return data, ranking, said + left_over(data, ranking)


def with_unseen_rows(
    found: Diagnosis, effects: Mapping[str, Effect] = EFFECTS, pool: Executor = HERE
) -> Diagnosis:
    """Judge how far a gap shrinks on rows that were left out, where there is nothing to predict."""
    data = found.data
    if not found.shrink or data.case.new_conditions is not None:
        return found
    before = found.corrected.calibrated(data.view.conditions)
    predicted = _left_out(found, effects, pool)
    return replace(found, shrink=shrink(data, found.truth, before, predicted))


def _beyond(corrected: Corrected, before: Mapping[str, Array]) -> list[str]:
    """Warn of conditions to predict that neither campaign covered."""
    new = corrected.data.case.new_conditions
    if new is None:
        return []
    known = covered(corrected, new)
    beyond = Counter(c for row in outside(known, {c: new[c] for c in known}) for c in row)
    said = [
        f"{new.source}: beyond what "
        f"{'the field' if role_of(name) == 'order' else 'either campaign'} covered in {name}: "
        f"{rows} of {len(new)} rows, where what is predicted is extrapolated"
        for name, rows in beyond.items()
    ]
    columns, plain = corrected.data.case.field.columns, {*OUTPUTS.values(), *columns_of("order")}
    lacking = [n for n in columns if n not in new and n not in plain and np.ptp(columns[n]) > 0.0]
    if lacking:
        said.append(
            f"{new.source}: lacks {', '.join(lacking)}, which the field campaign has; what depends "
            "on it is not in what is predicted. Add the column"
        )
    for name, values in before.items():
        empty = int(np.isnan(values).sum())
        if empty:
            said.append(
                f"{new.source}: the simulator has no {name.replace('_', ' ')} at {empty} of "
                f"{len(new)} rows; they are left out of the shrink"
            )
    return said


def _confounded(data: Campaigns, causes: Inclusion, effects: Mapping[str, Effect]) -> list[str]:
    """Warn of causes that go with a condition which differs between the campaigns only."""
    # What a user declared is of interest, however probable it is.
    own = set(data.case.covariates)
    said, hidden = list[str](), list[str]()
    for name, effect in effects.items():
        if name not in causes.causes or not inseparable(data, effect):
            continue
        if causes.causes[name].probability >= WORTH_SAYING or own & set(effect.covariates):
            said.append(
                f"{name}: its condition is one value in the laboratory and another in the field; "
                "what depends on it cannot be separated from anything else that changed between "
                "them"
            )
        elif isinstance(effect, DependsOn):
            hidden.append(name.removeprefix(PREFIX).replace("_", " "))
    shift = causes.causes.get("parameter_shift")
    if hidden and shift is not None and shift.probability >= WORTH_SAYING:
        said.append(
            f"parameter_shift: {', '.join(hidden)} also differed between the campaigns and did not "
            "vary in the field; the simulator ignores it, and other parameter values may be its "
            "effect. Measure at several values of it in the field to find out"
        )
    return said


def _without_context(
    case: Case, seed: int, effects: Mapping[str, Effect]
) -> dict[str, float] | None:
    if not case.context:
        return None
    _, ranking, _ = screened_ranking(replace(case, context=Context()), seed, effects)
    probability = ranking.probability
    return {"none": probability["none"], **inclusion_probability(probability)}


def _left_out(found: Diagnosis, effects: Mapping[str, Effect], pool: Executor) -> dict[str, Array]:
    """Predict each field row by a diagnosis that has not seen it, hypotheses chosen anew.

    Without other conditions to predict, this is how far the correction carries beyond the rows it
    was found on. With too few rows to leave some out, the rows' own predictions stand.
    """
    data, truth, seed, design = found.data, found.truth, found.seed, found.ranking.identifiability
    folds = field_parts(data, seed)
    if not folds:
        return truth.means
    lab = calibrate_lab(data, seed)  # whatever is left out of the field
    parts = [without_outputs(data.case, {o.name: rows for o in data.outputs}) for rows in folds]
    pieces = [pool.submit(_unseen, p, data.view, seed, dict(effects), lab, design) for p in parts]
    predicted = truth.means
    for rows, piece in zip(folds, pieces, strict=True):
        for name, values in piece.result().items():
            predicted[name][rows] = values[rows]
    return predicted


def field_parts(data: Campaigns, seed: int) -> list[NDArray[np.int64]]:
    """Return the field rows in the parts that are left out in turn; none if too few would stay."""
    order = generator(seed, "gap", "folds").permutation(len(data.case.field))
    folds = [order[fold::FOLDS] for fold in range(FOLDS)]
    left = min(np.setdiff1d(o.rows, rows).size for o in data.outputs for rows in folds)
    return folds if left >= MIN_FIELD_ROWS else []


@one_thread()
def _unseen(
    case: Case,
    view: View,
    seed: int,
    effects: Mapping[str, Effect],
    lab: Lab,
    design: Identifiability,
) -> dict[str, Array]:
    """Predict all rows of a field campaign from those that a case still has."""
    part = campaigns(case)
    ranking = rank(part, seed, effects=effects, lab=lab, design=design, plenty=FOLD_DRAWS)
    return mixture(part, ranking, seed).at(view).means


def verdict(probability: Mapping[str, float]) -> str:
    """Name the outcome.

    ``none`` and ``unknown``, which is nothing but unlisted, where they are at least `NAMED`
    probable; ``effect`` where some listed cause acts so probably, whatever else acts; else
    ``ambiguous``.
    """
    for name in ("none", "unknown"):
        if probability.get(name, 0.0) >= NAMED:
            return name
    acting = inclusion_probability(probability)
    acting.pop(UNLISTED, None)
    return "effect" if max(acting.values(), default=0.0) >= NAMED else "ambiguous"


@dataclass(frozen=True)
class Placebo:
    """What each single hypothesis leaves of the gap on the field rows.

    Parameters
    ----------
    left : mapping of str to float
        Root-mean-square residual over the noise of the best hypothesis, all outputs.
    before : float
        The same for the simulator as it was calibrated.
    """

    left: dict[str, float]
    before: float

    def shrink(self, name: str) -> float:
        """Part of the misfit that a hypothesis removes."""
        return 1.0 - self.left[name] / self.before


def placebos(found: Diagnosis) -> Placebo:
    """Work out what every single hypothesis leaves on the rows it was fitted to.

    A fit's own residuals are standardised by its own noise, which a wrong hypothesis inflates:
    they are put on the noise of the best hypothesis first.
    """
    at = noise_conditions(found.data.view)
    best = found.ranking.best(found.ranking.order[0])
    rows = {o.name: o.rows for o in found.data.outputs}
    reference = {o: n.sd(at.rows(rows[o])) for o, n in best.noise.items()}
    left = {}
    for name in found.ranking.fits:
        if "+" in name and name != found.ranking.order[0]:
            continue
        fit = found.ranking.best(name)
        left[name] = _rms(
            [
                r * fit.noise[o].sd(at.rows(rows[o])) / reference[o]
                for o, r in fit.field_residuals.items()
            ]
        )
    before = found.corrected.calibrated(found.data.view.conditions)
    response = [
        (o.field - o.problem.bound.to_response(before[o.name][o.rows])) / reference[o.name]
        for o in found.data.outputs
    ]
    return Placebo(left, _rms(response))


def _rms(parts: list[Array]) -> float:
    values = np.concatenate(parts)
    return float(np.sqrt(np.nanmean(np.square(values))))


@dataclass(frozen=True)
class _Asked(View):
    """A view that notes which defaults its effects have used."""

    defaults: dict[str, float] = field(default_factory=dict)

    def lab_of(self, role: str, otherwise: float | None = None) -> float:
        """Return the median in the calibration data, and note where there is none."""
        column, value = self.column(role) or role, super().lab_of(role, otherwise)
        if column not in self.lab:
            self.defaults[column] = value
        return value


def assumed(fit: Fit) -> dict[str, float]:
    """Return what a hypothesis assumes of the calibration, by canonical column, in its unit.

    Where the assumption is wrong, the whole field differs from what its effects say by a constant
    factor or offset, which another cause may then be named for.
    """
    view = fit.forward.data.view
    asked = _Asked(**{f.name: getattr(view, f.name) for f in fields(View)})
    fit.forward.field(fit.psi[None], asked)
    return dict(asked.defaults)
