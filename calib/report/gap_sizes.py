"""How large an effect is, in the units of what it changes: sentences from posterior draws."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.data.quantities import physical_role, role_of
from calib.gap.campaigns import columns_over
from calib.gap.case import words_of
from calib.gap.diagnose import Diagnosis
from calib.gap.effects import Effect
from calib.gap.fit import Fit
from calib.gap.noise import noise_conditions
from calib.inference.random import generator
from calib.models import get_model
from calib.models.base import Array
from calib.report.gap_facts import EVERYWHERE, output_axis, output_word, region_text, unit_after
from calib.report.labels import axis_of, joined
from calib.report.numbers import format_value

_N_DRAWS = 400
# A mean change below this part of the noise is not worth a sentence.
_SMALL = 0.3
# The part of the rows at an end of a condition that stands for the end.
_END = 0.2


@dataclass(frozen=True)
class _Change:
    """Draws of truth minus simulator under one hypothesis, (draws, rows), and the noise there."""

    draws: Array
    noise: Array


def size_sentences(found: Diagnosis, name: str) -> list[str]:
    """Say what a fitted hypothesis amounts to on the field's conditions; ``none`` has no size."""
    if name == "none":
        return []
    fit = found.ranking.best(name)
    psi = fit.draws(generator(found.seed, "gap", "size", name), _N_DRAWS)
    changes = _changes(found, fit, psi)
    effects = fit.forward.hypothesis.effects
    if name == "unknown":
        return [_lead(found, fit), *_rms_sentences(found, changes, together=False)]
    if len(effects) != 1:
        return _rms_sentences(found, changes, together=len(effects) > 1)
    effect = effects[0]
    if "change_point" in effect.parameters:
        return [_step_sentence(found, fit, psi)]
    if type(effect).on_output is Effect.on_output:
        phi = fit.forward.hypothesis.effect_priors[0].to_natural(psi[:, fit.forward.phi_slices[0]])
        sentences = _instrument_sentences(found, effect, phi)
        if sentences:
            return sentences
    return _end_sentences(found, effect, changes)


def where_to_look(found: Diagnosis) -> str:
    """Say which measurements would show what an effect that is not listed goes along with."""
    fit = found.ranking.best("unknown")
    h = fit.forward.hypothesis
    # Runs cannot be repeated at their place in the order, and waves have their largest gaps apart.
    places = [] if h.smooth_over == "ripple" else found.regions
    places = [r for r in places if not any(role_of(c) == "order" for c in r.conditions)]
    stretches = [region_text(found, r) for r in places]
    narrow = [text for text in stretches if text != EVERYWHERE]
    place = f" where the gap is surest ({narrow[0]})" if narrow else ""
    if (h.onset_over or h.smooth_over) == "all":
        vary = "one condition at a time, the others held"
    elif (h.onset_over or h.smooth_over) == "before":
        vary = "in another order, and a condition several times in a row"
    elif (h.onset_over or h.smooth_over) == "order":
        vary = "of one condition every few runs, and the first runs once more at the end"
    elif h.onset_over is not None:
        vary = f"in small steps about {_threshold(found, fit)}, the other conditions held"
    elif h.smooth_over == "ripple":
        vary = "over slip in steps much smaller than the waves, the other conditions held"
    else:
        vary = f"over {_along(fit)} in small steps, the other conditions held"
    return (
        f"repeat runs{place}, and add runs {vary}; then write the suspected cause as an effect of "
        "your own (--effects)"
    )


def _along(fit: Fit) -> str:
    h = fit.forward.hypothesis
    own = {output_word(name) for name in h.smooth_outputs}
    level = f"predicted {joined(sorted(own)).lower()}"
    along = {
        "slip": "slip", "ripple": "slip", "level": f"the {level}",
        "sinkage": "the predicted rut depth", "order": "the order of the runs",
        "before": "how far the run before differed", "pressure": "inflation pressure",
        "speed": "speed", "passes": "the passes", "water": "water content",
        "all": "several conditions",
    }  # fmt: skip
    return along[h.smooth_over]


def _lead(found: Diagnosis, fit: Fit) -> str:
    """Say what an effect that is not listed goes along with: where to look for it."""
    h = fit.forward.hypothesis
    if h.onset_over is not None:
        side = "below" if h.onset_over == "low_pressure" else "beyond"
        return f"what is missing sets in {side} {_threshold(found, fit)}{_by_pressure(found, fit)}"
    on_top = ""
    if h.effects:
        on_top = f", on top of {h.effects[0].name.replace('_', ' ')}"
    elif h.shift > 0.0:
        on_top = ", on top of other parameter values"
    waves = ", in short waves" if h.smooth_over == "ripple" else ""
    return f"what is missing goes along with {_along(fit)}{_by_pressure(found, fit)}{waves}{on_top}"


def _by_pressure(found: Diagnosis, fit: Fit) -> str:
    """Say so where a predicted rut depth is nothing but pressure by another name."""
    h = fit.forward.hypothesis
    over = h.onset_over or h.smooth_over
    ruts = found.data.with_role("sinkage")
    of_rut = over == "sinkage" or (over == "level" and h.smooth_outputs == ruts)
    conditions = get_model(found.data.case.models[ruts[0]]).conditions if of_rut else ()
    alone = len(conditions) == 1 and role_of(conditions[0]) in ("pressure", "ground_pressure")
    return ", which here is a matter of pressure alone" if alone else ""


def ends_text(found: Diagnosis, fit: Fit, i: int) -> str:
    """Say what a fault of a reading, the i-th effect of a fit, adds at the first and last run.

    Nothing of what does not go by the order of the runs, or is a factor.
    """
    h, view = fit.forward.hypothesis, found.data.view
    effect, (role, *_) = h.effects[i], h.effects[i].outputs
    o = next((o for o in found.data.outputs if o.role == role), None)
    if effect.covariates != ("order",) or o is None or o.problem.bound.model.response == "log":
        return ""
    psi = fit.draws(generator(found.seed, "gap", "size", h.name), _N_DRAWS)
    phi = h.effect_priors[i].to_natural(psi[:, fit.forward.phi_slices[i]])
    order, axis = view.of("order"), output_axis(found, o.name)
    added = effect.on_output(phi, role, np.zeros((len(phi), order.size)), view)
    first, last = (
        f"{format_value(float(d.mean()), float(d.std()))} {axis.unit}"
        for d in axis.factor * added[:, [order.argmin(), order.argmax()]].T
    )
    return f"{first} at the first run and {last} at the last"


def _threshold(found: Diagnosis, fit: Fit) -> str:
    forward, view = fit.forward, found.data.view
    h = forward.hypothesis
    output = h.smooth_outputs[0]
    if h.onset_over == "sinkage":
        output = found.data.with_role("sinkage")[0]
    u = forward.discrepancy.onset_covariate(view, output)
    if h.onset_over in ("level", "sinkage"):
        o = next(o for o in found.data.outputs if o.name == output)
        with np.errstate(all="ignore"):
            location = forward.simulator(fit.psi[None], view)[output]
        axis = output_axis(found, output)
        values = axis.factor * o.problem.bound.from_response(location)[0]
        name, unit = f"a predicted {output_word(output).lower()} of", f" {axis.unit}"
    else:
        over = h.onset_over or ""
        column = next(c for c in columns_over(over) if c in view.conditions)
        name = {
            "slip": "a slip of", "order": "run", "water": "a water content of",
            "cone": "a cone index of", "low_pressure": "an inflation pressure of",
        }[over]  # fmt: skip
        shown = axis_of(column)
        values, unit = shown.scale(view.conditions[column]), unit_after(shown)
    order = np.argsort(u)
    good = order[np.isfinite(values[order])]
    at = float(np.interp(fit.psi[forward.threshold], u[good], values[good]))
    sd = float(np.sqrt(fit.covariance[forward.threshold, forward.threshold]))
    spread = abs(float(np.interp(fit.psi[forward.threshold] + sd, u[good], values[good])) - at)
    # No data tell where between two rows it sets in.
    around = np.sort(values[good])
    i = int(np.clip(np.searchsorted(around, at), 1, around.size - 1))
    spread = max(spread, float(around[i] - around[i - 1]) / np.sqrt(12.0))
    return f"{name} {format_value(at, max(spread, 1e-3 * abs(at) + 1e-9))}{unit}"


def _changes(found: Diagnosis, fit: Fit, psi: Array) -> dict[str, _Change]:
    view = found.data.view
    at = noise_conditions(view)
    with np.errstate(all="ignore"):
        full, plain = fit.forward.field(psi, view), fit.forward.simulator(psi, view)
    changes = {}
    for o in found.data.outputs:
        bound, factor = o.problem.bound, output_axis(found, o.name).factor
        before, after = (bound.from_response(v[o.name])[:, o.rows] for v in (plain, full))
        noise = fit.noise[o.name].sd(at.rows(o.rows))
        if bound.model.response == "log":
            noise = noise * np.nanmedian(before, axis=0)
        good = np.isfinite(before).all(axis=1) & np.isfinite(after).all(axis=1)
        if good.sum() > 10:
            changes[o.name] = _Change(factor * (after - before)[good], factor * noise)
    return changes


def _rms_sentences(
    found: Diagnosis, changes: Mapping[str, _Change], *, together: bool
) -> list[str]:  # fmt: skip
    sentences = []
    for output, change in changes.items():
        rms = np.sqrt(np.square(change.draws).mean(axis=1))
        if rms.mean() < _SMALL * change.noise.mean():
            continue
        unit = output_axis(found, output).unit
        amount = format_value(float(rms.mean()), float(rms.std()))
        sentences.append(f"{output_word(output)} changes by {amount} {unit} rms")
    if sentences:
        sentences[0] = ("together: " if together else "") + sentences[0]
        sentences[-1] += " over the field rows"
    return sentences


def _instrument_sentences(found: Diagnosis, effect: Effect, phi: Array) -> list[str]:
    """Compare conditions that truly held with the recorded ones."""
    sentences: dict[str, str] = {}
    view = found.data.view
    for o in found.data.outputs:
        columns = {role_of(c): c for c in o.problem.bound.model.conditions}
        recorded = {role: view.conditions[c] for role, c in columns.items()}
        true = effect.on_conditions(phi, o.role, recorded, view)
        for role, values in recorded.items():
            if true[role] is values or role in sentences:
                continue
            axis = axis_of(columns[role])
            shift = axis.scale((true[role] - values).mean(axis=1))
            own = not effect.covariates or role in effect.covariates
            if not own and abs(shift.mean()) < 2.0 * shift.std():
                continue  # it may follow, but nothing says that it does
            unit = "percentage points" if axis.unit == "%" else axis.unit
            way = "above" if shift.mean() > 0.0 else "below"
            amount = format_value(abs(float(shift.mean())), float(shift.std()))
            sentences[role] = (
                f"true {axis.name.lower()} is {amount} {unit} {way} the recorded one on average"
            )
    # Ground pressure only follows from inflation pressure.
    if "pressure" in sentences:
        sentences.pop("ground_pressure", None)
    return list(sentences.values())


def _step_sentence(found: Diagnosis, fit: Fit, psi: Array) -> str:
    """Say by how much the reading jumps, and after which run or between which."""
    (effect,), (priors,) = fit.forward.hypothesis.effects, fit.forward.hypothesis.effect_priors
    natural = priors.to_natural(psi[:, fit.forward.phi_slices[0]])
    size, at, lasts = (
        natural[:, effect.parameters.index(p)] for p in ("jump", "change_point", "duration")
    )
    (o,) = (o for o in found.data.outputs if o.role in effect.outputs)
    axis, word = output_axis(found, o.name), output_word(o.name)
    jump, unit = axis.factor * size, axis.unit
    if o.problem.bound.model.response == "log":
        jump, unit = 100.0 * np.expm1(size), "%"
    first, last = found.data.view.order_range
    way = _way(o.name, bool(jump.mean() > 0.0))
    amount = format_value(abs(float(jump.mean())), float(jump.std()))
    run, half = (
        first + float(np.median(at)) * (last - first),
        0.5 * (float(np.median(lasts)) * (last - first) + 1.0),
    )
    when = f"after run {np.floor(run):.0f} than before"
    if half > 1.0:  # not from one run to the next
        low, high = max(np.floor(run - half), first), min(np.ceil(run + half), last)
        when = f"after run {high:.0f} than up to run {low:.0f}, and changes in between"
    return f"{word} reads {amount} {unit} {way} {when}"


def _end_sentences(
    found: Diagnosis, effect: Effect, changes: Mapping[str, _Change]
) -> list[str]:  # fmt: skip
    """Say what the effect does at the end of its condition where it does most."""
    view = found.data.view
    column = next((c for c in map(view.column, effect.covariates) if c), None)
    if column is None and effect.form:
        column = view.column("slip")
    sentences = []
    for output, change in changes.items():
        rows = next(o.rows for o in found.data.outputs if o.name == output)
        where, inside = _end(found, column, rows, change)
        mean = change.draws[:, inside].mean(axis=1)
        centre, sd = float(mean.mean()), float(mean.std())
        if abs(centre) < 0.9 * np.sqrt(np.mean(np.square(change.draws.mean(axis=0)))):
            # It does most elsewhere, or has both signs there: an end would understate it.
            sentences += _rms_sentences(found, {output: change}, together=False)
            continue
        if abs(centre) < _SMALL * float(change.noise[inside].mean()):
            continue
        unit = output_axis(found, output).unit
        amount = f"{format_value(abs(centre), sd)} {unit}"
        if effect.instrument and type(effect).on_output is not Effect.on_output:
            text = f"{output_word(output)} reads {amount} {'high' if centre > 0.0 else 'low'}"
        else:
            way = _way(output, centre > 0.0)
            text = f"{output_word(output)} is {amount} {way} than simulated"
        sentences.append(f"{text} {where}")
    return sentences


def _way(output: str, up: bool) -> str:
    if physical_role(output) == "sinkage":
        return "deeper" if up else "shallower"
    return "higher" if up else "lower"


def _end(
    found: Diagnosis, column: str | None, rows: NDArray[np.int64], change: _Change
) -> tuple[str, NDArray[np.bool_]]:
    everything = np.ones(rows.size, dtype=np.bool_)
    if column is None:
        return "in all runs", everything
    values = found.data.view.conditions[column][rows]
    if np.ptp(values) == 0.0:
        return "in all runs", everything
    ends = (values <= np.quantile(values, _END), values >= np.quantile(values, 1.0 - _END))
    size = [abs(float(change.draws[:, m].mean())) / float(change.noise[m].mean()) for m in ends]
    last = int(size[1] >= size[0])
    inside = ends[last]
    if role_of(column) == "order":
        return ("at the start of the campaign", "by the end of the campaign")[last], inside
    axis = axis_of(column)
    low, high = (axis.value_text(float(f(values[inside]))) for f in (np.min, np.max))
    span = low if low == high else f"{low} to {high}"
    ends_at = float(values[inside].min()), float(values[inside].max())
    span = words_of(found.data.case.covariates, column, *ends_at) or span
    return f"at {axis.name.lower()} {span}{unit_after(axis)}", inside
