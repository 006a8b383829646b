"""Which hypotheses a case is tested against, and how probable each is before the data."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from calib.data.quantities import OUTPUTS, QUANTITIES, role_of
from calib.errors import CalibError
from calib.gap.campaigns import Campaigns, columns_over, other_conditions
from calib.gap.case import Context, Size
from calib.gap.constants import (
    COVERED,
    ONSET,
    OTHER_SOIL_SHIFTS,
    SAME_SOIL_SHIFTS,
    SELDOM,
    SHIFTS,
    SMOOTHS,
    SOIL,
    UNDERINFLATED,
    UNUSUAL_SIZE,
    WIDER,
    WIDER_LOG,
)
from calib.gap.effects import EFFECTS, Effect
from calib.gap.effects.dependence import DependsOn, DiffersBy
from calib.gap.effects.readings import ConditionBias, Kind, Reading
from calib.inference.prior_files import (
    PriorFile,
    declared_priors,
    default_priors,
    read_priors,
)
from calib.inference.priors import Prior, Priors, prior_references

type ShiftAs = Literal["alone", "soil"]
type Setting = Literal["pressure", "speed", "passes", "water"]
# Single conditions that a discrepancy may vary with, whatever the others are.
SETTINGS: tuple[Setting, ...] = ("pressure", "speed", "passes", "water")
# Or the physical role of another condition that is recorded.
type SmoothOver = (
    Setting | Literal["slip", "level", "sinkage", "order", "before", "ripple", "all"] | str
)
type OnsetOver = Literal["slip", "level", "sinkage", "order", "water", "cone", "low_pressure"]


@dataclass(frozen=True)
class Hypothesis:
    """What may cause the gap.

    Parameters
    ----------
    name : str
        Contract name, pairs in alphabetical order.
    effects : tuple of Effect
        In alphabetical order, as in its name.
    shift : float
        Prior sd of parameter shifts in units of the parameters' own prior sds; 0 for none.
    shift_as : {"alone", "soil"}
        Whether parameters shift each by itself, or together as with another soil.
    smooth : float
        Prior sd of a free discrepancy, in units of the noise; 0 for none.
    smooth_outputs : tuple of str
        Outputs that have the free discrepancy.
    smooth_over : SmoothOver
        What it may vary with: slip, the level of the predicted output (as a saturating
        instrument would), the predicted rut depth (as layered soil would), the order of the runs
        (as weather or another stretch of ground would), how far the output is from that of the run
        before (as a recorder that lags would), slip in waves too short for the first (as lugs that
        pass would), one of inflation pressure, speed, passes and water content alone (as a wheel
        that hops at some pressure would), another recorded condition by its physical role, or
        every condition.
    smooth_decay : float
        Number of half waves from which the discrepancy's coefficients fall off.
    onset_over : OnsetOver, optional
        Instead of smooth, the discrepancy may set in beyond a threshold of one of these, water
        content and cone index among them: a step and a change of slope there. Below a threshold
        of inflation pressure, where an underinflated tyre may creep on its rim or buckle: a step,
        and a part of the output's level.
    share : float
        Part of the prior probability of its name.
    shift_over : str
        One of the effects, a dependence: parameters shift in proportion to its condition, which is
        then no cause of its own.
    """

    name: str
    effects: tuple[Effect, ...] = ()
    effect_priors: tuple[Priors, ...] = ()
    shift: float = 0.0
    shift_as: ShiftAs = "alone"
    smooth: float = 0.0
    smooth_outputs: tuple[str, ...] = ()
    smooth_over: SmoothOver = "all"
    smooth_decay: float = 4.0
    onset_over: OnsetOver | None = None
    share: float = 1.0
    shift_over: str = ""


# Conditions that listed effects are about, and those effects.
_COVERED_BY = {
    "speed": "rate_effect",
    "passes": "multipass_compaction",
    "water": "moisture_softening",
    "slip": "slip_sinkage",
}
# Roles of conditions that go with each other: who knows one of them ignores none.
_SAME: Mapping[str, set[str]] = {
    role: same
    for same in ({"pressure", "ground_pressure"}, {"water", "water_by_volume"})
    for role in same
}

type _Over = Literal["slip", "level", "sinkage", "order"]
type _Touched = tuple[str, ...]

# One output that changes beyond some slip is mostly what listed effects are, post-peak softening,
# slip sinkage and rebound: what is unlisted does so more seldom. (Beyond some run it is always a
# drift or a step, which may set in anywhere. Nobody could tell the unlisted from them.)
_LISTED_ONSETS: tuple[tuple[_Over, str], ...] = (
    ("slip", "pull"),
    ("slip", "sinkage"),
)


def split_testable(
    data: Campaigns, effects: Mapping[str, Effect] = EFFECTS
) -> tuple[dict[str, Effect], dict[str, str]]:
    """Split the effects into those the data can show and those they cannot, with the reason."""
    able, unable = {}, {}
    for name, effect in effects.items():
        reason = effect.not_testable(data.view, data.roles)
        if reason is None:
            able[name] = effect
        else:
            unable[name] = reason
    return able, unable


def effect_priors(data: Campaigns, effect: Effect) -> Priors:
    """Read an effect's priors, forces relative to the case's load."""
    references = prior_references(data.case.lab.columns) | {"normal_load_kn": data.view.load_kn}
    return read_effect_priors(effect, references)


def read_effect_priors(effect: Effect, references: Mapping[str, float]) -> Priors:
    """Read an effect's priors, relative ones to references by column, or to their defaults."""
    file: PriorFile = effect.prior_file or default_priors(f"effects/{effect.name}")
    if effect.priors:
        file = declared_priors("effect", effect.name, effect.priors, type(effect))
    return read_priors(file, effect.name, effect.parameters, references)


def dependences(data: Campaigns) -> dict[str, Effect]:
    """Return what may depend on each recorded condition that a simulator ignores, by name."""
    found: dict[str, Effect] = {}
    for column, values in data.view.conditions.items():
        quantity = QUANTITIES.get(column)
        lab = data.case.lab.columns.get(column)
        if quantity is None or quantity.role != "condition" or lab is None:
            continue
        same = _SAME.get(quantity.physical, {quantity.physical})
        logs = {
            o.role: o.problem.bound.model.response == "log"
            for o in data.outputs
            if not same & set(map(role_of, o.problem.bound.model.conditions))
        }
        both = np.concatenate([values, lab])
        both = both[np.isfinite(both)]
        if logs and both.size and np.isfinite(values).all() and np.ptp(both) > 1e-9:
            effect = DependsOn(quantity.physical, quantity.stem, logs, 0.5 * float(np.ptp(both)))
            found.setdefault(effect.name, effect)
    return found | _declared(data)


def readings(data: Campaigns) -> dict[str, Effect]:
    """Return what may be wrong with readings and no listed effect is about, by name.

    Of each output gain, offset, and if the order of the runs is known drift and step; gain and
    offset of each condition of a simulator that varies, or differs from the laboratory's.
    """
    kinds: tuple[Kind, ...] = ("drift", "step") if _varies(data, "order") else ()
    found: list[Effect] = []
    taken: dict[str, tuple[str, ...]] = {}
    for o in data.outputs:
        model, column = o.problem.bound.model, OUTPUTS[o.name]
        values = np.abs(o.problem.bound.from_response(o.problem.response))
        typical = float(np.median(values)) or 1.0
        log, unit = model.response == "log", QUANTITIES[column].unit
        own: tuple[Kind, ...] = ("gain",) if o.role == "pull" else (*kinds, "gain", "offset")
        found += [Reading(kind, o.role, o.name, unit, typical, log=log) for kind in own]
        for condition in model.conditions:
            taken[condition] = (*taken.get(condition, ()), o.role)
    gauges = {"slip", "cone", *_SAME["pressure"], *_SAME["water"]}
    if data.view.column("pressure") is None:
        gauges.remove("ground_pressure")
    for column, outputs in taken.items():
        q, typical = QUANTITIES[column], abs(data.view.lab_of(role_of(column))) or 1.0
        if q.physical not in gauges:
            bias = ConditionBias(q.physical, q.stem, outputs, q.unit, typical)
            found += [bias] if bias.not_testable(data.view, data.roles) is None else []
    return {effect.name: effect for effect in found}


def with_case_effects(data: Campaigns, effects: Mapping[str, Effect]) -> dict[str, Effect]:
    """Return effects, and those that a case brings with it: dependences, and its readings'."""
    own = {**dependences(data), **readings(data)}
    return {**effects, **{name: effect for name, effect in own.items() if name not in effects}}


def prior_share(effect: Effect, listed: Collection[str]) -> float | None:
    """How probable an effect is beside a listed one that is tried in sets; None if it is such."""
    if covered(effect, listed):
        return COVERED
    return SELDOM if effect.seldom else None


def _declared(data: Campaigns) -> dict[str, Effect]:
    """Return what may depend on each column that the case declares."""
    logs = {o.role: o.problem.bound.model.response == "log" for o in data.outputs}
    found: list[Effect] = []
    for name, levels in data.case.covariates.items():
        lab, field = data.case.lab[name], data.view.conditions[name]
        if levels:
            codes, counts = np.unique(lab, return_counts=True)
            usual = int(codes[np.argmax(counts)])
            found.append(DiffersBy(name, levels, logs, usual))
        else:
            half = 0.5 * float(np.ptp(np.append(lab, field)))
            found.append(DependsOn(name, name, logs, max(half, 1e-12)))
    return {effect.name: effect for effect in found}


def covered(effect: Effect, listed: Collection[str]) -> bool:
    """Whether a dependence is on a condition that another effect which is tested is about."""
    return isinstance(effect, DependsOn) and _COVERED_BY.get(effect.role) in listed


def inseparable(data: Campaigns, effect: Effect) -> bool:
    """Whether an effect rests on a condition that differs between the campaigns only.

    Of those that are testable: what must vary in the field, and does not, differs from the
    laboratory's.
    """
    if not effect.varies or not effect.covariates:
        return False
    return bool(np.ptp(data.view.of(effect.covariates[0])) < 1e-9)


def singles(data: Campaigns, effects: Mapping[str, Effect]) -> list[Hypothesis]:
    """One hypothesis for each effect."""
    return [Hypothesis(name, (e,), (effect_priors(data, e),)) for name, e in effects.items()]


def unknowns(data: Campaigns) -> list[Hypothesis]:
    """Free discrepancies: of one output or all, smooth over slip, level, … or setting in there."""
    names, density, ruts = data.names, data.with_role("density"), data.with_role("sinkage")
    each: list[_Touched] = [(name,) for name in names]
    touched = each + ([names] if len(names) > 1 else [])
    of_wheel = [t for t in touched if not set(density) & set(t)]
    slipping = data.view.column("slip") is not None
    choices: list[tuple[_Over, _Touched]] = [("level", t) for t in each]
    if slipping:
        choices += [("slip", t) for t in touched]
    if ruts:
        choices += [("sinkage", t) for t in touched if t != ruts]
    remembered: list[_Touched] = []
    if _varies(data, "order"):
        choices += [("order", t) for t in touched]
        remembered = of_wheel
    rippled = of_wheel if slipping else []
    others = [role for role in other_conditions(data.view) if _varies(data, role)]
    everywhere: list[tuple[SmoothOver, _Touched]] = [
        *choices,
        *(("ripple", t) for t in rippled),
        *(("before", t) for t in remembered),
        *((over, t) for over in SETTINGS for t in of_wheel if _varies(data, over)),
        *((role, t) for role in others for t in touched),
        *(("all", t) for t in touched),
    ]
    smooth = [
        Hypothesis("unknown", smooth=size, smooth_outputs=t, smooth_over=over)
        for over, t in everywhere
        for size in SMOOTHS
    ]
    probes: tuple[OnsetOver, ...] = ("water", "cone") if density else ()
    listed = [("order", t) for t in each]
    seldom = [(over, data.with_role(role)) for over, role in _LISTED_ONSETS]
    setting_in: list[tuple[OnsetOver, _Touched]] = [
        *(choice for choice in choices if choice not in listed),
        *((over, density) for over in probes if _varies(data, over)),
    ]
    sudden = [
        Hypothesis(
            "unknown",
            smooth=ONSET,
            smooth_outputs=t,
            onset_over=over,
            share=SELDOM if (over, t) in seldom else 1.0,
        )
        for over, t in setting_in
    ]
    often = sum(h.share for h in sudden)
    # At low inflation a tyre may creep on its rim, buckle or run on it.
    soft: list[Hypothesis] = []
    if _varies(data, "low_pressure"):
        soft = [
            Hypothesis("unknown", smooth=ONSET, smooth_outputs=t, onset_over="low_pressure")
            for t in of_wheel
        ]
    onsets = 0.5 - UNDERINFLATED if soft else 0.5
    return [
        *(replace(h, share=0.5 / len(smooth)) for h in smooth),
        *(replace(h, share=onsets * h.share / often) for h in sudden),
        *(replace(h, share=UNDERINFLATED / len(soft)) for h in soft),
    ]


def _varies(data: Campaigns, over: str) -> bool:
    recorded = data.view.conditions
    return any(np.ptp(recorded[c]) > 0 for c in columns_over(over) if c in recorded)


def with_residual_discrepancy(data: Campaigns, causes: Hypothesis) -> list[Hypothesis]:
    """Listed causes, or a parameter shift, together with something that is not listed."""
    overs: list[tuple[SmoothOver, float]] = [("level", SMOOTHS[0])]
    overs += [("all", size) for size in SMOOTHS]
    if data.view.column("slip") is not None:
        overs += [("slip", size) for size in SMOOTHS]
    return [
        replace(
            causes,
            name=f"{causes.name}+unknown",
            smooth=size,
            smooth_outputs=data.names,
            smooth_over=over,
            share=causes.share / len(overs),
        )
        for over, size in overs
    ]


def widened(priors: Priors) -> Priors:
    """Return the priors of an effect that may be several times as large as it usually is."""
    entries = tuple(
        p if p.fixed else replace(p, scale=p.scale * (WIDER_LOG if p.log else WIDER))
        for p in priors.entries
    )
    return Priors(entries, priors.text, priors.source)


def shifts(data: Campaigns) -> list[Hypothesis]:
    """Other parameter values in the field, by a little or a lot, each by itself or as soils do.

    By less in the same soil: a looser place of it moves them as a softer soil does, a little.
    """
    same = data.case.context.same_soil
    sizes = {None: SHIFTS, True: SAME_SOIL_SHIFTS, False: OTHER_SOIL_SHIFTS}[same]
    kinds: dict[ShiftAs, float] = {"alone": 1.0 - SOIL, "soil": SOIL}
    if same is False:
        kinds = {"soil": 1.0}
    if set(data.roles) == {"density"}:
        kinds = {"alone": 1.0}
    return [
        Hypothesis("parameter_shift", shift=size, shift_as=kind, share=share / len(sizes))
        for size in sizes
        for kind, share in kinds.items()
    ]


def by_parameters(single: Hypothesis) -> list[Hypothesis]:
    """An effect, and if it is a dependence as often one that shifts parameters along as well."""
    if not isinstance(single.effects[0], DependsOn):
        return [single]
    half = 0.5 * single.share
    along = replace(single, shift_over=single.name, share=half / len(SHIFTS))
    return [replace(single, share=half), *(replace(along, shift=size) for size in SHIFTS)]


def joined(*causes: Hypothesis) -> Hypothesis:
    """Several effects at once, named in alphabetical order; along one at most parameters shift."""
    parts = [
        (e.name, e, p) for h in causes for e, p in zip(h.effects, h.effect_priors, strict=True)
    ]
    parts.sort(key=lambda part: part[0])
    return Hypothesis(
        "+".join(name for name, _, _ in parts),
        tuple(effect for _, effect, _ in parts),
        tuple(priors for _, _, priors in parts),
        shift=max(h.shift for h in causes),
        share=float(np.prod([h.share for h in causes])),
        shift_over=max(h.shift_over for h in causes),
    )


def with_known_size(single: Hypothesis, context: Context) -> Hypothesis:
    """Return an effect with what a context says of its size in the place of its prior."""
    known = context.sizes.get(single.name)
    if not known:
        return single
    (priors,) = single.effect_priors
    names = [p.name for p in priors.free]
    if strange := set(known) - {*names}:
        raise CalibError(
            f"{single.name} has no parameter {min(strange)!r}",
            where="[context] sizes",
            expected=", ".join(names),
            hint="correct the name",
        )
    entries = tuple(
        _known(single.name, p, known[p.name]) if p.name in known else p for p in priors.entries
    )
    return replace(single, effect_priors=(Priors(entries, priors.text, priors.source),))


def _known(effect: str, p: Prior, size: Size) -> Prior:
    """Return a prior with a known mean and sd."""
    if p.log and size.mean <= 0.0:
        raise CalibError(
            f"{effect}: {p.name} is positive",
            where="[context] sizes",
            expected="a mean above zero",
            hint="correct it",
        )
    loc, scale = _on_prior_scale(size, p)
    if not p.lower <= loc <= p.upper:
        low, high = (np.exp(end) if p.log else end for end in (p.lower, p.upper))
        raise CalibError(
            f"{effect}: {p.name} cannot be {size.mean:g}",
            where="[context] sizes",
            expected=f"a mean from {low:g} to {high:g}",
            hint="correct it, or declare an effect of your own with another prior",
        )
    return replace(p, loc=loc, scale=scale)


def unusual_sizes(single: Sequence[Hypothesis], context: Context) -> list[str]:
    """Say which known sizes are far from the usual ones, as in another unit."""
    units = parameter_units(single)
    said = []
    for h in single:
        for p in h.effect_priors[0].free:
            size = context.sizes.get(h.name, {}).get(p.name)
            if size is None:
                continue
            loc, scale = _on_prior_scale(size, p)
            apart = abs(loc - p.loc) / float(np.hypot(scale, p.scale))
            if apart > UNUSUAL_SIZE:
                low, high = (p.loc + s * p.scale for s in (-1.0, 1.0))
                low, high = (float(np.exp(e)) if p.log else e for e in (low, high))
                said.append(
                    f"[context] sizes: {h.name} is said to have {p.name} {size.mean:g} ± "
                    f"{size.sd:g}{units[h.name, p.name]}, {apart:.0f} sds from what is usual "
                    f"({low:.3g} to {high:.3g}): check its sign and unit, for the diagnosis "
                    "takes it as it is"
                )
    return said


def parameter_units(single: Sequence[Hypothesis]) -> dict[tuple[str, str], str]:
    """Return the unit of each effect's parameters, with a space before it; empty if it has none."""
    return {
        (h.name, p.name): "" if p.unit in {"1", "dimensionless", ""} else f" {p.unit}"
        for h in single
        for p in h.effect_priors[0].free
    }


def _on_prior_scale(size: Size, p: Prior) -> tuple[float, float]:
    """Mean and sd, of the logarithm where the prior is of that."""
    return (float(np.log(size.mean)), size.sd / size.mean) if p.log else (size.mean, size.sd)
