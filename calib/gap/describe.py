"""Compute the document of a diagnosis: sizes, changes over the runs, causes, what to measure.

Sizes and bands are from posterior draws; nothing here is put into words.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePath
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax

from calib.data.quantities import OUTPUTS, role_of
from calib.gap import document as doc
from calib.gap.campaigns import OutputData, columns_over
from calib.gap.constants import WORTH_SAYING
from calib.gap.curves import curves
from calib.gap.diagnose import Diagnosis, Placebo, assumed, field_parts, placebos
from calib.gap.effects import EFFECTS, Effect
from calib.gap.fit import Fit
from calib.gap.hypotheses import parameter_units
from calib.gap.identifiability import NextMeasurement
from calib.gap.laboratory_bias import laboratory_bias
from calib.gap.mixture import (
    UNLISTED,
    Included,
    Region,
    conditions_to_search,
    false_discovery_rate,
    row_gaps,
)
from calib.gap.noise import noise_conditions
from calib.gap.odds import left_of, likelihood_tempering, probabilities
from calib.gap.same_soil import shift_if_same_soil
from calib.gap.suggestions import suggestions
from calib.inference.priors import Prior
from calib.inference.random import generator
from calib.models import get_model
from calib.models.base import Array

_N_DRAWS = 400
# The normal's 95 % point: of upper limits, and of shifts that stand out.
_Z = 1.645
# Changes below this part of the noise are not worth a sentence.
_SMALL = 0.3


def gap_document(
    found: Diagnosis, command: Sequence[str] = (), versions: Mapping[str, str] | None = None
) -> doc.GapDocument:
    """Compute all that the files, the page and the figures of a diagnosis show.

    Parameters
    ----------
    found : Diagnosis
    command, versions : optional
        What made it, for the page.

    Returns
    -------
    doc.GapDocument
    """
    data, ranking, case = found.data, found.ranking, found.data.case
    placebo, design, best = placebos(found), ranking.identifiability, ranking.order[0]
    parts = len(field_parts(data, found.seed))
    tables = [("calibration", case.lab), ("field", case.field), ("predict", case.new_conditions)]
    warnings = [w for w in found.warnings if w not in case.notes]
    for _, table in tables:
        if table is not None:  # the same wherever the case lies
            warnings = [w.replace(table.source, Path(table.source).name) for w in warnings]
    prior = ranking.prior
    sized = [
        group[0].forward.hypothesis
        for name, group in ranking.fits.items()
        if name in case.context.sizes
    ]
    return doc.GapDocument(
        name=case.name,
        label=case.label,
        headers=(*case.field.header, *case.lab.header),
        command=tuple(map(str, command)),
        versions=dict(versions or {}),
        seed=found.seed,
        files=tuple(
            doc.DataFile(role, PurePath(t.source).name, len(t), t.sha256)  # type: ignore[arg-type]
            for role, t in tables
            if t is not None
        ),
        verdict=found.verdict,  # type: ignore[arg-type]
        outputs=_outputs(found),
        explanations=tuple(_explanation(found, n, prior[n], placebo) for n in ranking.order),
        definitions=tuple(_definitions(found)),
        equations=_equations(found),
        track_record=doc.track_record(ranking.probability[best]),
        causes=tuple(_cause(found, n, c) for n, c in found.inclusion.causes.items()),
        remainder=_cause(found, UNLISTED, found.inclusion.residual_discrepancy),
        remainder_where=found.inclusion.where,
        titles={n: e.title for n, e in {**EFFECTS, **_effects(found)}.items()},
        sizes=() if found.verdict == "ambiguous" else tuple(sizes(found, best)),
        unlisted=unlisted(found) if best == UNLISTED else None,
        runs=over_runs(found),
        conditions={
            name: _numbers(data.view.conditions[name])
            for name in conditions_to_search(data)
            if name in data.view.conditions
        },
        covered=_covered(found),
        covariates=dict(case.covariates),
        regions=found.regions,
        false_discovery_rate=false_discovery_rate(found.regions),
        leading=tuple(_leading(found)),
        laboratory_bias=laboratory_bias(found.corrected.mixture, ranking.best("none")),
        suggestions=suggestions(found.corrected.mixture),
        shrink=dict(found.shrink),
        judged_on="new conditions"
        if case.new_conditions is not None
        else "rows left out"
        if parts
        else "fitted rows",
        parts=parts,
        gap=ranking.gap,
        left=left_of(ranking.gap),
        coarsening=likelihood_tempering(ranking.gap),
        uncoarsened=probabilities(ranking.log_evidence, ranking.odds)[best],
        before=placebo.before,
        next_measurements=tuple(_next(found, m) for m in found.next_measurements),
        design=doc.Design(
            dict(design.absorbed),
            dict(design.detectable),
            tuple((a, b, value) for (a, b), value in design.cosine_similarity.items()),
            tuple(design.alike),
        ),
        smallest=max(design.detectable.values(), default=math.nan),
        not_testable=dict(ranking.not_testable),
        untested=tuple(_untested(found)),
        assumed=assumed(ranking.best(best)),
        put_in=tuple(case.context.words(parameter_units(sized))),
        excluded=tuple(case.context.excluded),
        suspected=(*case.context.suspected, *case.context.sizes),
        without_context=found.without_context,
        shift_if_same_soil=shift_if_same_soil(ranking),
        doubts=tuple(remark.title for remark in found.doubts),
        notes=case.notes,
        warnings=tuple(warnings),
        unused=tuple(_unused(found)),
        curves=curves(found),
        prediction=_prediction(found),
    )


def _numbers(values: Array) -> tuple[float, ...]:
    return tuple(np.asarray(values, dtype=np.float64).tolist())


def _fits(found: Diagnosis) -> Iterator[Fit]:
    return (fit for group in found.ranking.fits.values() for fit in group)


def _effects(found: Diagnosis) -> dict[str, Effect]:
    """Effects that were fitted, by name."""
    return {e.name: e for fit in _fits(found) for e in fit.forward.hypothesis.effects}


# Outputs and rows


def _outputs(found: Diagnosis) -> tuple[doc.Output, ...]:
    data, truth, best = found.data, found.truth, found.ranking.best(found.ranking.order[0])
    before = found.corrected.calibrated(data.view.conditions)
    gathered = []
    for o, gap in zip(data.outputs, found.gaps, strict=True):
        bound = o.problem.bound
        gathered.append(
            doc.Output(
                name=o.name,
                title=bound.model.title,
                n_lab=len(o.problem.table),
                relative=bound.model.response == "log",
                noise=best.noise[o.name],
                latex=tuple(bound.model.latex),
                numbers=bound.model.numbers,
                parametrisation=bound.model.parametrisation,
                references=dict(bound.references),
                parameters=tuple(o.priors.names),
                rows=tuple(o.rows.tolist()),
                measured=_numbers(data.case.field[OUTPUTS[o.name]][o.rows]),
                before=_numbers(before[o.name][o.rows]),
                after=_numbers(truth.mean(truth.truth[o.name])[o.rows]),
                noise_sd=_numbers(truth.mean(truth.noise[o.name])[o.rows]),
                gap=_numbers(gap.gap),
                gap_sd=_numbers(gap.sd),
                probability=_numbers(gap.probability),
                residual=_numbers(best.field_residuals[o.name]),
            )
        )
    return tuple(gathered)


def _unused(found: Diagnosis) -> Iterator[doc.UnusedRow]:
    """Predict the gap at rows that were not judged by."""
    if not any(found.unused.values()):
        return
    rows = {name: np.array([*reasons], np.int64) for name, reasons in found.unused.items()}
    for g in row_gaps(found.data, found.truth, rows):
        for row, gap, sd, p in zip(g.rows, g.gap, g.sd, g.probability, strict=True):
            reason = found.unused[g.output][int(row)]
            yield doc.UnusedRow(g.output, int(row), float(gap), float(sd), float(p), reason)


def _prediction(found: Diagnosis) -> dict[str, tuple[str, ...] | tuple[float, ...]]:
    """Return the columns of predictions, beside conditions as they were written."""
    new = found.data.case.new_conditions
    if new is None:
        return {}
    columns: dict[str, tuple[str, ...] | tuple[float, ...]] = {
        name: tuple(row[j] for row in new.text) for j, name in enumerate(new.header)
    }
    if not new.text:
        columns = {name: _numbers(values) for name, values in new.columns.items()}
    if found.data.case.label:
        columns["data_label"] = (found.data.case.label,) * len(new)
    for name, predicted in found.new_predictions.items():
        column = OUTPUTS[name]
        columns[f"{column}_before"] = _numbers(predicted.before)
        columns[f"{column}_after"] = _numbers(predicted.after)
        columns[f"{column}_after_lower"] = _numbers(predicted.lower)
        columns[f"{column}_after_upper"] = _numbers(predicted.upper)
    return columns


def _leading(found: Diagnosis) -> Iterator[int]:
    """Find each output's first region, and its first along a condition of the best hypothesis."""
    effects = found.ranking.best(found.ranking.order[0]).forward.hypothesis.effects
    wanted = {found.data.view.column(role) for e in effects for role in e.covariates}
    for o in found.data.outputs:
        own = [i for i, r in enumerate(found.regions) if r.output == o.name]
        along = [i for i in own if wanted & set(found.regions[i].conditions)]
        yield from own[:1]
        if own and own[0] not in along:
            yield from along[:1]


def _covered(found: Diagnosis) -> dict[str, tuple[float, float]]:
    covered = {}
    for column, values in found.data.view.conditions.items():
        both = np.append(found.data.case.lab.columns.get(column, values), values)
        if column in OUTPUTS.values() or role_of(column) == "order" or not np.isfinite(both).all():
            continue
        covered[column] = float(both.min()), float(both.max())
    return covered


# Explanations and their parameters


def _explanation(found: Diagnosis, name: str, prior: float, placebo: Placebo) -> doc.Explanation:
    ranking = found.ranking
    fit = ranking.best(name)
    h = fit.forward.hypothesis
    shift = h.shift_as if h.shift > 0.0 and not h.shift_over else ""
    return doc.Explanation(
        name,
        ranking.probability[name],
        prior,
        ranking.log_evidence[name] - ranking.log_evidence["none"],
        placebo.left.get(name),
        tuple(p for i in range(len(fit.forward.phi_slices)) for p in _parameters(fit, i)),
        tuple(shifts(found.data.outputs, fit)),
        shift,
    )


def _parameters(fit: Fit, i: int) -> Iterator[doc.Parameter]:
    """Estimate the parameters of the i-th effect of a fit, fixed ones too."""
    priors, part = fit.forward.hypothesis.effect_priors[i], fit.forward.phi_slices[i]
    effect = fit.forward.hypothesis.effects[i].name
    sds = np.sqrt(np.diag(fit.covariance))[part]
    own = dict(zip(priors.names, zip(fit.psi[part], sds, strict=True), strict=True))
    for prior, value in zip(priors.entries, priors.to_natural(fit.psi[None, part])[0], strict=True):
        if prior.fixed:
            yield doc.Parameter(
                effect, prior.name, prior.unit, float(value), 0.0, "value", (float(value), 0.0)
            )
        else:
            yield parameter(effect, prior, *map(float, own[prior.name]))


def parameter(effect: str, prior: Prior, value: float, sd: float) -> doc.Parameter:
    """Summarise a parameter from its estimate in unconstrained coordinates.

    One that cannot be distinguished from its bound at zero is an upper limit (95 %).

    Parameters
    ----------
    effect : str
    prior : Prior
    value, sd : float
        Of the logarithm where the prior is of that.
    """
    half = prior.lower == 0.0 and prior.loc == 0.0
    spread = prior.scale * (math.sqrt(1.0 - 2.0 / math.pi) if half else 1.0)
    if not math.isfinite(prior.scale):  # uniform between its bounds
        spread = (prior.upper - prior.lower) / math.sqrt(12.0)
    # A logarithm's sd is relative.
    mean = math.exp(value) if prior.log else value
    found = doc.Parameter(
        effect, prior.name, prior.unit, mean, sd * mean if prior.log else sd, "value", ()
    )
    # The data did not narrow it.
    of_prior = math.isfinite(spread) and sd > 0.9 * spread
    if of_prior and not math.isfinite(prior.scale):
        value, sd = 0.5 * (prior.lower + prior.upper), spread
        mean = math.exp(value) if prior.log else value
    if prior.log and sd >= 0.35:
        ends = tuple(math.exp(value + z * sd) for z in (0.0, -_Z, _Z))
        return replace(found, form="range", shown=ends, of_prior=of_prior)
    if not prior.log and prior.lower == 0.0 and value < sd:
        limit = min(value + _Z * sd, prior.upper)
        return replace(found, form="limit", shown=(limit,), of_prior=of_prior)
    shown = (mean, mean * sd if prior.log else sd)
    return replace(found, shown=shown, of_prior=of_prior)


def shifts(outputs: Sequence[OutputData], fit: Fit) -> Iterator[doc.Parameter]:
    """Find the shifts of the simulators' parameters that stand out from their own sd.

    Those of logarithms are relative, in percent; so is the rolling radius, by its empty name.
    Along a condition they are those at the field's value that is farthest from the laboratory's.
    """
    part, shift = fit.forward.shift_slice, fit.forward.shift
    if shift is None:
        return
    along = fit.forward.along(fit.forward.data.view)
    far = 1.0 if along is None else float(along[np.abs(along).argmax()])
    rows = [
        (o.name, prior, row)
        for o in outputs
        if o.name in shift.parameters
        for prior, row in zip(o.priors.free, shift.parameters[o.name], strict=True)
    ]
    for output, prior, row in [*rows, ("", None, shift.radius_error)]:
        value = far * float(row @ fit.psi[part])
        sd = abs(far) * float(row @ fit.covariance[part, part] @ row) ** 0.5
        if abs(value) < _Z * sd or (prior is None and value == 0.0):
            continue
        name, unit = (prior.name, prior.unit) if prior is not None else ("", "percent")
        if prior is not None and prior.log:
            value, sd, unit = 100.0 * math.expm1(value), 100.0 * math.exp(value) * sd, "percent"
        elif prior is None:
            value, sd = 100.0 * value, 100.0 * sd
        yield doc.Parameter(output, name, unit, value, sd, "value", (value, sd))


def _equations(found: Diagnosis) -> dict[str, tuple[str, ...]]:
    """Return what the effects change that are not ruled out, words with mathematics."""
    ranking = found.ranking
    there = (name for name in ranking.order if ranking.probability[name] >= 0.01)
    effects = (e for name in there for e in ranking.best(name).forward.hypothesis.effects)
    return {e.name: e.latex for e in effects if e.latex}


def _definitions(found: Diagnosis) -> list[doc.Definition]:
    rows: dict[tuple[str, str], doc.Definition] = {}
    for name in found.ranking.order:
        if found.ranking.probability[name] < 0.01:  # ruled out
            continue
        hypothesis = found.ranking.best(name).forward.hypothesis
        for effect, priors in zip(hypothesis.effects, hypothesis.effect_priors, strict=True):
            for p in priors.free:
                row = doc.Definition(effect.name, p.name, p.unit, p.reason, p.text, p.source)
                rows.setdefault((effect.name, p.name), row)
    return [*rows.values()]


# Causes


def _cause(found: Diagnosis, name: str, c: Included) -> doc.Cause:
    effects = _effects(found)
    own = effects.get(name)
    cause = doc.Cause(name, c.probability, c.share, c.share_interval)
    if own is None or not own.instrument:
        return cause
    same = sorted(n for n, e in effects.items() if own.device and e.device == own.device)
    return replace(
        cause, check=own.check, expected=_expected(found, name), faults=tuple(same) or (name,)
    )


def _expected(found: Diagnosis, name: str) -> doc.Expected:
    """Find a fault's size in the most probable explanation that has it.

    Of a gauge it is both gain and offset, of which either may be wrong.
    """
    for explanation in found.ranking.order:
        fit = found.ranking.best(explanation)
        for i, effect in enumerate(fit.forward.hypothesis.effects):
            if effect.name == name:
                ends = _drift_ends(found, fit, i)
                if ends is not None:
                    return ends
                free = {p.name for p in fit.forward.hypothesis.effect_priors[i].free}
                every = [p for p in _parameters(fit, i) if p.name in free]
                own = [p for p in every if p.name in ("gain", "offset")] or every[:1]
                return doc.Expected(tuple(p for p in own if not p.of_prior))
    return doc.Expected()


def _drift_ends(found: Diagnosis, fit: Fit, i: int) -> doc.Expected | None:
    """Compute what the i-th effect of a fit adds to a reading at the first and last run.

    None of what does not go by the order of the runs, or is a factor.
    """
    h, view = fit.forward.hypothesis, found.data.view
    effect, role = h.effects[i], h.effects[i].outputs[0]
    o = next((o for o in found.data.outputs if o.role == role), None)
    if effect.covariates != ("order",) or o is None or o.problem.bound.model.response == "log":
        return None
    psi = fit.draws(generator(found.seed, "gap", "size", h.name), _N_DRAWS)
    phi = h.effect_priors[i].to_natural(psi[:, fit.forward.phi_slices[i]])
    order = view.of("order")
    added = effect.on_output(phi, role, np.zeros((len(phi), order.size)), view)
    first, last = (_mean_sd(added[:, j]) for j in (order.argmin(), order.argmax()))
    return doc.Expected((), o.name, first, last)


def _mean_sd(draws: Array) -> tuple[float, float]:
    return float(draws.mean()), float(draws.std())


def _untested(found: Diagnosis) -> Iterator[doc.Untested]:
    """Find listed effects on the affected outputs that a missing column hides, even in part."""
    acting = {n for n, c in found.inclusion.causes.items() if c.probability >= 0.5}
    known, view = _effects(found), found.data.view
    touched = {role for n in acting & set(known) for role in known[n].outputs}

    def matters(effect: Effect) -> bool:
        return not touched or bool(touched & set(effect.outputs))

    for name, reason in found.ranking.not_testable.items():
        effect = EFFECTS.get(name)
        excluded = name in found.data.case.context.excluded
        if effect and not excluded and matters(effect) and effect.lacking(view, found.data.roles):
            yield doc.Untested(name, reason)
    for name, effect in known.items():
        columns = [view.column(role) for role in effect.covariates if role != "order"]
        lacking = tuple(c for c in columns if c and c not in view.lab)
        if lacking and name not in acting and matters(effect):
            fit = next(f for f in _fits(found) if effect in f.forward.hypothesis.effects)
            yield doc.Untested(name, lacking=lacking, assumed=assumed(fit))


# Changes over the order of the runs


def over_runs(found: Diagnosis) -> doc.RunTrend | None:
    """Compute how probably a reading changes over the runs, and in which form.

    Of the outputs that may, those that most probably do; None where none is at all likely to.
    """
    trends = [_over_runs(found, (o.name,)) for o in found.data.outputs]
    if len(found.data.outputs) > 1:
        trends.append(_over_runs(found, found.data.names))
    best = max(trends, key=lambda trend: trend.probability)
    return best if best.probability >= WORTH_SAYING else None


def _over_runs(found: Diagnosis, outputs: tuple[str, ...]) -> doc.RunTrend:
    roles = [o.role for o in found.data.outputs if o.name in outputs]
    # Of several outputs at once no listed effect changes the readings over the runs.
    kinds: dict[str, doc.Form] = {
        name: "step" if "change_point" in e.parameters else "drift"
        for name, e in _effects(found).items()
        if e.instrument and "order" in e.covariates and list(e.outputs) == roles
    }
    forms = dict.fromkeys(kinds.values(), 0.0)
    causes = dict.fromkeys(kinds, 0.0)
    for name, probability in found.ranking.probability.items():
        own = [c for c in name.split("+") if c in kinds]
        causes |= {c: causes[c] + probability for c in own}
        acting: set[doc.Form] = {kinds[c] for c in own}
        if len(acting) > 1:
            acting = {"both"}
        for form in acting:
            forms[form] = forms.get(form, 0.0) + probability
    forms["neither"] = _unlisted_over_runs(found, outputs)
    return doc.RunTrend(
        outputs,
        sum(forms.values()),
        tuple(sorted(forms.items(), key=lambda form: -form[1])),
        together=len(outputs) > 1,
        only=len(found.data.outputs) == 1,
        surest=max(causes.values(), default=0.0),
    )


def _unlisted_over_runs(found: Diagnosis, outputs: tuple[str, ...]) -> float:
    """Probability that something unlisted follows the order of the runs in just these outputs."""
    ranking = found.ranking
    if UNLISTED not in ranking.fits:
        return 0.0
    follows = [
        "order" in (h.smooth_over, h.onset_over) and h.smooth_outputs == outputs
        for h in (fit.forward.hypothesis for fit in ranking.fits[UNLISTED])
    ]
    weights = softmax(np.array(ranking.scores[UNLISTED]))
    return float(weights[follows].sum()) * ranking.probability[UNLISTED]


# Sizes


def sizes(found: Diagnosis, name: str) -> Iterator[doc.Size]:
    """Compute what a fitted hypothesis amounts to on the field's conditions."""
    if name == "none":
        return
    fit = found.ranking.best(name)
    psi = fit.draws(generator(found.seed, "gap", "size", name), _N_DRAWS)
    effects = fit.forward.hypothesis.effects
    changes = [(o, *_change(found, fit, psi, o)) for o in found.data.outputs]
    changes = [c for c in changes if len(c[1]) > 10]
    if name == UNLISTED or len(effects) != 1:
        for o, draws, noise in changes:
            yield from _rms(o, draws, noise, together=len(effects) > 1 and name != UNLISTED)
        return
    effect = effects[0]
    if "change_point" in effect.parameters:
        yield _step(found, fit, psi)
        return
    if type(effect).on_output is Effect.on_output:
        phi = fit.forward.hypothesis.effect_priors[0].to_natural(psi[:, fit.forward.phi_slices[0]])
        misread = _misread(found, effect, phi)
        yield from misread
        if misread:
            return
    for o, draws, noise in changes:
        yield from _end(found, effect, o, draws, noise)


def _change(found: Diagnosis, fit: Fit, psi: Array, o: OutputData) -> tuple[Array, Array]:
    """Draw truth minus simulator at the output's rows, (draws, rows); return the noise too."""
    view, bound = found.data.view, o.problem.bound
    with np.errstate(all="ignore"):
        both = fit.forward.simulator(psi, view), fit.forward.field(psi, view)
    before, after = (bound.from_response(v[o.name])[:, o.rows] for v in both)
    noise = fit.noise[o.name].sd(noise_conditions(view).rows(o.rows))
    if bound.model.response == "log":
        noise = noise * np.nanmedian(before, axis=0)
    good = np.isfinite(before).all(axis=1) & np.isfinite(after).all(axis=1)
    return (after - before)[good], noise


def _rms(
    o: OutputData, draws: Array, noise: Array, *, together: bool = False
) -> Iterator[doc.Size]:
    mean, sd = _mean_sd(np.sqrt(np.square(draws).mean(axis=1)))
    if mean >= _SMALL * noise.mean():
        yield doc.Size("rms", o.name, mean, sd, together=together)


def _misread(found: Diagnosis, effect: Effect, phi: Array) -> list[doc.Size]:
    """Compare conditions that truly held with the recorded ones."""
    view = found.data.view
    sizes: dict[str, doc.Size] = {}
    for o in found.data.outputs:
        columns = {role_of(c): c for c in o.problem.bound.model.conditions}
        recorded = {role: view.conditions[c] for role, c in columns.items()}
        true = effect.on_conditions(phi, o.role, recorded, view)
        for role, values in recorded.items():
            if true[role] is values or role in sizes:
                continue
            mean, sd = _mean_sd((true[role] - values).mean(axis=1))
            # Of a condition that only may follow, nothing is said unless the data say so.
            meant = not effect.covariates or role in effect.covariates
            if meant or abs(mean) >= 2.0 * sd:
                sizes[role] = doc.Size("condition", columns[role], mean, sd)
    # Ground pressure only follows from inflation pressure.
    if "pressure" in sizes:
        sizes.pop("ground_pressure", None)
    return [*sizes.values()]


def _step(found: Diagnosis, fit: Fit, psi: Array) -> doc.Size:
    """Compute by how much the reading jumps, and after which run or between which."""
    (effect,), (priors,) = fit.forward.hypothesis.effects, fit.forward.hypothesis.effect_priors
    natural = priors.to_natural(psi[:, fit.forward.phi_slices[0]])
    jump, at, lasts = (
        natural[:, effect.parameters.index(p)] for p in ("jump", "change_point", "duration")
    )
    (o,) = (o for o in found.data.outputs if o.role in effect.outputs)
    relative = o.problem.bound.model.response == "log"
    first, last = found.data.view.order_range
    run = first + float(np.median(at)) * (last - first)
    half = 0.5 * (float(np.median(lasts)) * (last - first) + 1.0)
    ends = (math.floor(run), math.floor(run))
    if half > 1.0:  # not from one run to the next
        ends = max(math.floor(run - half), int(first)), min(math.ceil(run + half), int(last))
    mean, sd = _mean_sd(np.expm1(jump) if relative else jump)
    return doc.Size("step", o.name, mean, sd, reads=True, relative=relative, ends=ends)


def _end(
    found: Diagnosis, effect: Effect, o: OutputData, draws: Array, noise: Array
) -> Iterator[doc.Size]:
    """Compute what an effect does at the end of its condition where it does most."""
    view = found.data.view
    column = next((c for c in map(view.column, effect.covariates) if c), None)
    if column is None and effect.form:
        column = view.column("slip")
    place, inside = _most(view.conditions[column][o.rows] if column else None, draws, noise)
    mean, sd = _mean_sd(draws[:, inside].mean(axis=1))
    if abs(mean) < 0.9 * np.sqrt(np.mean(np.square(draws.mean(axis=0)))):
        # It does most elsewhere, or has both signs there: an end would understate it.
        yield from _rms(o, draws, noise)
        return
    if abs(mean) < _SMALL * float(noise[inside].mean()):
        return
    reads = effect.instrument and type(effect).on_output is not Effect.on_output
    size = doc.Size("end", o.name, mean, sd, reads=reads)
    if column is None or place == "all":
        yield size
    elif role_of(column) == "order":
        yield replace(size, place=place, column=column)
    else:
        values = view.conditions[column][o.rows][inside]
        ends = float(values.min()), float(values.max())
        yield replace(size, place="stretch", column=column, ends=ends)


def _most(
    values: Array | None, draws: Array, noise: Array
) -> tuple[Literal["all", "start", "end"], NDArray[np.bool_]]:
    """Find the end of a condition where an effect does most, in noise sds, and its rows."""
    if values is None or np.ptp(values) == 0.0:
        return "all", np.ones(noise.size, dtype=np.bool_)
    # A fifth of the rows stands for an end.
    start, end = values <= np.quantile(values, 0.2), values >= np.quantile(values, 1.0 - 0.2)
    done = [abs(float(draws[:, m].mean())) / float(noise[m].mean()) for m in (start, end)]
    return ("end", end) if done[1] >= done[0] else ("start", start)


def unlisted(found: Diagnosis) -> doc.Unlisted:
    """Find what a gap that nothing listed explains goes along with."""
    fit = found.ranking.best(UNLISTED)
    h, data = fit.forward.hypothesis, found.data
    over = h.onset_over or h.smooth_over
    beside = h.effects[0].name if h.effects else "parameter_shift" if h.shift > 0.0 else ""
    ruts = data.with_role("sinkage")
    alone = False
    if over == "sinkage" or (over == "level" and h.smooth_outputs == ruts):
        conditions = get_model(data.case.models[ruts[0]]).conditions
        alone = [role_of(c) in ("pressure", "ground_pressure") for c in conditions] == [True]
    column, threshold = ("", None) if h.onset_over is None else _threshold(found, fit)
    return doc.Unlisted(over, h.smooth_outputs, column, threshold, alone, beside, _to_repeat(found))


def _to_repeat(found: Diagnosis) -> Region | None:
    """Find the surest narrow region; runs cannot be repeated at their place in the order."""
    if found.ranking.best(UNLISTED).forward.hypothesis.smooth_over == "ripple":
        return None  # waves have their largest gaps apart
    rows = {o.name: o.rows for o in found.data.outputs}
    for region in found.regions:
        values = {c: found.data.view.conditions[c][rows[region.output]] for c in region.conditions}
        if not any(role_of(c) == "order" for c in values) and any(
            values[c].min() < low or values[c].max() > high
            for c, (low, high) in region.conditions.items()
        ):
            return region
    return None


def _threshold(found: Diagnosis, fit: Fit) -> tuple[str, tuple[float, float]]:
    forward, view, h = fit.forward, found.data.view, fit.forward.hypothesis
    output = (
        found.data.with_role("sinkage")[0] if h.onset_over == "sinkage" else h.smooth_outputs[0]
    )
    u = forward.discrepancy.onset_covariate(view, output)
    if h.onset_over in ("level", "sinkage"):
        o = next(o for o in found.data.outputs if o.name == output)
        with np.errstate(all="ignore"):
            location = forward.simulator(fit.psi[None], view)[output]
        values, column = o.problem.bound.from_response(location)[0], OUTPUTS[output]
    else:
        column = next(c for c in columns_over(h.onset_over or "") if c in view.conditions)
        values = view.conditions[column]
    order = np.argsort(u)
    good = order[np.isfinite(values[order])]
    at = fit.psi[forward.threshold]
    sd = float(np.sqrt(fit.covariance[forward.threshold, forward.threshold]))
    mean, beyond = (float(v) for v in np.interp([at, at + sd], u[good], values[good]))
    # The data do not say where between two rows it sets in.
    around = np.sort(values[good])
    i = int(np.clip(np.searchsorted(around, mean), 1, around.size - 1))
    spread = max(abs(beyond - mean), float(around[i] - around[i - 1]) / np.sqrt(12.0))
    return column, (mean, max(spread, 1e-3 * abs(mean) + 1e-9))


# What to measure next


def repeats_needed(gain_nats: float) -> int | None:
    """Compute how many measurements make expected odds of twenty to one; None if too many."""
    if not gain_nats > 0.0:
        return None
    repeats = math.ceil(math.log(20.0) / gain_nats)
    return repeats if repeats <= 50 else None  # nobody makes more


def _next(found: Diagnosis, m: NextMeasurement) -> doc.Next:
    field, lab = found.data.view.conditions, found.data.case.lab.columns
    roles = _roles_that_matter(found, m.separates)
    measured = {role_of(column) for column in m.conditions}
    columns = []
    for column in (c for c in m.conditions if c in field):
        both, role = (
            np.concatenate([field[column], lab.get(column, field[column])]),
            role_of(column),
        )
        follows = role == "ground_pressure" and "pressure" in measured
        if np.ptp(both) > 0.0 and not follows and role != "order" and role in roles:
            columns.append(column)
    return doc.Next(
        m.separates,
        dict(m.conditions),
        m.gain_nats,
        tuple(columns),
        "order" in roles & measured,
        repeats_needed(m.gain_nats),
        m.output,
        m.expected,
    )


def _roles_that_matter(found: Diagnosis, names: Sequence[str]) -> set[str]:
    """Roles of what the simulators and the effects of some hypotheses depend on."""
    matters = {role_of(c) for m in found.data.case.models.values() for c in get_model(m).conditions}
    for name in names:
        h = found.ranking.best(name).forward.hypothesis
        if h.smooth_outputs:
            return {role_of(c) for c in found.data.view.conditions}
        matters |= {c for effect in h.effects for c in effect.covariates}
    return matters
