"""What was found about a gap, in words and few numbers: what its verdict is made from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calib.data.quantities import OUTPUTS, role_of
from calib.gap.case import words_of
from calib.gap.corrected import Shrink
from calib.gap.diagnose import Diagnosis, assumed
from calib.gap.effects import EFFECTS
from calib.gap.fit import Fit
from calib.gap.hypotheses import parameter_units
from calib.gap.identifiability import NextMeasurement
from calib.gap.mixture import UNLISTED, Included, Region
from calib.models import get_model
from calib.report.gap_facts import (
    SHOWN,
    Candidate,
    CauseFact,
    GapEvidence,
    NextFact,
    OutputRows,
    ShrinkFact,
    WhereFact,
    condition_text,
    output_axis,
    output_rows,
    output_word,
    region_text,
    short_name,
    shrink_place,
    title_of,
    unit_after,
)
from calib.report.gap_sizes import ends_text, size_sentences, where_to_look
from calib.report.gap_verdict import GapVerdict, judge_gap, over_runs
from calib.report.labels import MINUS, axis_of, joined, odds_text, short
from calib.report.parameters import parameter_text


def gap_verdict(found: Diagnosis) -> GapVerdict:
    """Say in a headline and a few sentences what a diagnosis found; nothing is drawn."""
    return judge_gap(gap_evidence(found))


def gap_evidence(found: Diagnosis) -> GapEvidence:
    """Collect what the verdict is made from."""
    ranking = found.ranking
    best = found.ranking.order[0]
    design = ranking.identifiability
    case_context = found.data.case.context
    alike = [
        short_name(b if a == best else a) for a, b in design.alike if best in (a, b)
    ]  # fmt: skip
    return GapEvidence(
        verdict=found.verdict,
        ranked=[
            Candidate(n, short_name(n), title_of(found, n), ranking.probability[n])
            for n in ranking.order
        ],
        sizes=[] if found.verdict == "ambiguous" else size_sentences(found, best),
        where=[where_fact(found, r) for r in _leading_regions(found)],
        shrink=shrink_facts(found),
        shrink_place=shrink_place(found),
        next_facts=[
            NextFact(
                (short_name(m.separates[0]), short_name(m.separates[1])),
                conditions_text(found, m),
                m.gain_nats,
            )
            for m in found.next_measurements
        ],
        alike=alike,
        smallest=max(design.detectable.values(), default=float("nan")),
        look=where_to_look(found) if best == "unknown" else "",
        causes=[_cause(found, n, c) for n, c in found.inclusion.causes.items()],
        remainder=_cause(found, UNLISTED, found.inclusion.residual_discrepancy),
        remainder_where=_remainder_where(found),
        untested=_untested(found),
        assumed=_assumed(found, ranking.best(best)),
        put_in="; ".join(_put_in(found)),
        without=_without(found),
        excluded=case_context.excluded,
        runs=over_runs(found),
        doubts=[remark.title for remark in found.doubts],
    )


def _put_in(found: Diagnosis) -> list[str]:
    """Say what was put in, with units, and what of it cannot be tested."""
    context, unable = found.data.case.context, found.ranking.not_testable
    singles = [
        group[0].forward.hypothesis for n, group in found.ranking.fits.items() if n in context.sizes
    ]
    said = context.words(parameter_units(singles))
    return said + [
        f"{short_name(n)} cannot be tested here ({unable[n]}), so that nothing follows from it"
        for n in dict.fromkeys([*context.suspected, *context.sizes])
        if n in unable
    ]


def _untested(found: Diagnosis) -> list[str]:
    """Name listed effects that a missing column keeps from being tested, in whole or in part.

    Of those on other outputs than what acts nothing is to be feared.
    """
    acting = {n for n, c in found.inclusion.causes.items() if c.probability >= 0.5}
    fits = [fit for group in found.ranking.fits.values() for fit in group]
    known = {e.name: e for fit in fits for e in fit.forward.hypothesis.effects}
    touched = {role for n in acting & set(known) for role in known[n].outputs}

    def fits_in(outputs: Sequence[str]) -> bool:
        return not touched or bool(touched & set(outputs))

    view = found.data.view
    unable = {n: EFFECTS[n] for n in found.ranking.not_testable if n in EFFECTS}
    said = [
        f"{short_name(n)} ({found.ranking.not_testable[n]})"
        for n, effect in unable.items()
        if n not in found.data.case.context.excluded
        and fits_in(effect.outputs)
        and effect.lacking(view, found.data.roles)
    ]
    for name, effect in known.items():
        lacking = [c for r in effect.covariates if r != "order" and (c := view.column(r))]
        lacking = [c for c in lacking if c not in view.lab]
        if lacking and name not in acting and fits_in(effect.outputs):
            fit = next(f for f in fits if effect in f.forward.hypothesis.effects)
            taken = joined(_assumed(found, fit)) if assumed(fit) else ""
            said.append(
                f"{short_name(name)} in part (the calibration has no {', '.join(lacking)}, "
                f"{taken and f'for which {taken} was assumed, '}so that a constant difference from "
                "it cannot be seen)"
            )
    return said


def _without(found: Diagnosis) -> str:
    """Say which causes act without what the case's context put in."""
    if found.without_context is None:
        return ""
    p = found.without_context
    leading = sorted((n for n in p if p[n] >= SHOWN), key=lambda n: -p[n])[:4]
    words = {"none": "no gap", UNLISTED: "something unlisted"}
    return joined([f"{words.get(n, short_name(n))} ({odds_text(p[n])})" for n in leading])


def _cause(found: Diagnosis, name: str, c: Included) -> CauseFact:
    words = "something unlisted" if name == UNLISTED else short_name(name)
    fits = (fit for group in found.ranking.fits.values() for fit in group)
    effects = {e.name: e for fit in fits for e in fit.forward.hypothesis.effects}
    own = effects.get(name)
    if own is None or not own.instrument:
        return CauseFact(
            name, words, title_of(found, name), c.probability, c.share, c.share_interval
        )
    same = [n for n, e in effects.items() if own.device and e.device == own.device]
    return CauseFact(
        name, words, title_of(found, name), c.probability, c.share, c.share_interval, own.check,
        _size(found, name), sorted(same) or [name],
    )  # fmt: skip


def _size(found: Diagnosis, name: str) -> str:
    """Write a fault's size in the most probable explanation that has it: "offset 0.12 ± 0.02 kN".

    Of a gauge it is both gain and offset, of which either may be wrong.
    """
    for explanation in found.ranking.order:
        fit = found.ranking.best(explanation)
        h = fit.forward.hypothesis
        for i, (effect, priors) in enumerate(zip(h.effects, h.effect_priors, strict=True)):
            if effect.name != name:
                continue
            if ends := ends_text(found, fit, i):
                return ends
            part = fit.forward.phi_slices[i]
            sds = np.sqrt(np.diag(fit.covariance))[part]
            rows = zip(priors.free, fit.psi[part], sds, strict=True)
            texts = {p.name: parameter_text(p, float(at), float(sd)) for p, at, sd in rows}
            own = [n for n in texts if n in ("gain", "offset")] or list(texts)[:1]
            told = [n for n in own if not texts[n].endswith("(prior)")]
            return joined([f"{n.replace('_', ' ')} {texts[n]}" for n in told]) if told else ""
    return ""


def _remainder_where(found: Diagnosis) -> str:
    where = found.inclusion.where[:1]
    return "".join(f"{output_word(r.output)} at {region_text(found, r)}" for r in where)


def region_words(found: Diagnosis, region: Region) -> tuple[str, str]:
    """Say where a region lies, and how large the gap is there."""
    own = output_axis(found, region.output)
    gap = own.factor * region.gap
    sign, way = (1.0, "above") if gap > 0.0 else (-1.0, "below")
    low, high = sorted(sign * own.factor * end for end in region.interval)
    spread = f"90 % interval {short(low)} to {short(high)}".replace("-", MINUS)
    text = f"{short(abs(gap))} {own.unit} {way} the simulator ({spread})"
    return region_text(found, region), text


def _leading_regions(found: Diagnosis) -> list[Region]:
    """Where each output has its first region, and one along a condition of the best hypothesis."""
    effects = found.ranking.best(found.ranking.order[0]).forward.hypothesis.effects
    wanted = {found.data.view.column(role) for e in effects for role in e.covariates}
    leading = []
    for o in found.data.outputs:
        own = [r for r in found.regions if r.output == o.name]
        leading += own[:1]
        if own and not any(wanted & set(r.conditions) for r in own[:1]):
            leading += [r for r in own if wanted & set(r.conditions)][:1]
    return leading


def where_fact(found: Diagnosis, region: Region) -> WhereFact:
    """Return a region as a verdict has it."""
    place, gap = region_words(found, region)
    return WhereFact(f"{output_word(region.output)} at {place}", gap, region.probability)


def shrink_facts(found: Diagnosis) -> list[ShrinkFact]:
    """Return how far the gap of each output shrinks, on the scale of its axis."""
    facts = []
    for own in output_rows(found):
        s = scaled_shrink(found, own)
        if s is not None:
            unit = own.axis.unit
            facts.append(
                ShrinkFact(
                    output_word(own.name),
                    short(s.rmse_before),
                    f"{short(s.rmse_after)} {unit}",
                    f"{short(s.noise_floor)} {unit}",
                    s.fraction,
                    s.interval,
                )
            )
    return facts


def scaled_shrink(found: Diagnosis, own: OutputRows) -> Shrink | None:
    """Return the shrink of an output on the scale of its axis."""
    s, factor = found.shrink.get(own.name), own.axis.factor
    if s is None:
        return None
    return replace(
        s, rmse_before=s.rmse_before * factor, rmse_after=s.rmse_after * factor,
        noise_floor=s.noise_floor * factor,
    )  # fmt: skip


def conditions_text(found: Diagnosis, measurement: NextMeasurement) -> str:
    """Write the conditions of a measurement: those that vary, and that the hypotheses differ by."""
    field, lab = found.data.view.conditions, found.data.case.lab.columns
    matters = _matter(found, measurement.separates)
    measured = {role_of(column) for column in measurement.conditions}
    parts = []
    for column, value in measurement.conditions.items():
        both = np.concatenate([field[column], lab.get(column, field[column])])
        role = role_of(column)
        follows = role == "ground_pressure" and "pressure" in measured
        if np.ptp(both) == 0.0 or follows or role == "order" or role not in matters:
            continue
        parts.append(_condition(found, column, value))
    if "order" in matters & measured:
        parts.append("after the last run")
    return ", ".join(parts) or "the conditions of the field campaign"


def covered_text(found: Diagnosis) -> str:
    """Write what the two campaigns cover together, of each condition that is recorded."""
    parts = []
    for column, values in found.data.view.conditions.items():
        both = np.append(found.data.case.lab.columns.get(column, values), values)
        if column in OUTPUTS.values() or role_of(column) == "order" or not np.isfinite(both).all():
            continue
        axis, low, high = axis_of(column), float(both.min()), float(both.max())
        words = words_of(found.data.case.covariates, column, low, high)
        least = "" if low == high else f"{condition_text(column, axis.factor * low)} to "
        most = f"{condition_text(column, axis.factor * high)}{unit_after(axis)}"
        parts.append(f"{axis.name.lower()} {words or least + most}")
    return ", ".join(parts)


def _assumed(found: Diagnosis, fit: Fit) -> list[str]:
    return [_condition(found, column, value) for column, value in assumed(fit).items()]


def _condition(found: Diagnosis, column: str, value: float) -> str:
    """Write a condition, in canonical units, with its name."""
    axis = axis_of(column)
    shown = words_of(found.data.case.covariates, column, value, value)
    shown = shown or condition_text(column, axis.factor * value)
    return f"{axis.name.lower()} {shown}{unit_after(axis)}"


def _matter(found: Diagnosis, names: Sequence[str]) -> set[str]:
    """Roles of what the simulators and the effects of some hypotheses depend on."""
    models = found.data.case.models.values()
    matters = {role_of(c) for m in models for c in get_model(m).conditions}
    for name in names:
        h = found.ranking.best(name).forward.hypothesis
        if h.smooth_outputs:
            return {role_of(c) for c in found.data.view.conditions}
        matters |= {c for effect in h.effects for c in effect.covariates}
    return matters
