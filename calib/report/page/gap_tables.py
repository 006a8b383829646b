"""Tables of a diagnosis: hypotheses with their sizes, what cannot be tested, what to measure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from calib.gap.case import OutputData
from calib.gap.diagnose import NAMED, Diagnosis
from calib.gap.effects.dependence import PREFIX
from calib.gap.fit import Fit
from calib.gap.hypotheses import LN_PRIOR
from calib.inference.priors import Prior
from calib.report.figures.gap_which import placebos
from calib.report.gap_evidence import conditions_text
from calib.report.gap_rows import (
    best_fit,
    short_name,
    title_of,
)
from calib.report.gap_verdict import TIE, odds_text, repeats_needed
from calib.report.labels import MINUS, percent
from calib.report.numbers import format_number, format_value
from calib.report.page.equations import equation, parametrisation, prose

_POSSIBLE = 0.01
# An sd above this part of the prior's says that the data did not narrow the parameter.
_NOT_NARROWED = 0.9


def hypothesis_groups(found: Diagnosis) -> list[dict[str, Any]]:
    """Return the hypotheses with what is known of each, grouped by how probable they are."""
    p, order = found.ranking.probability, found.ranking.order
    tied = [n for n in order if p[n] >= TIE * p[order[0]]]
    rest = [n for n in order if n not in tied]
    possible = [n for n in rest if p[n] >= _POSSIBLE]
    out = [n for n in rest if p[n] < _POSSIBLE and "+" not in n]
    pairs = [n for n in rest if p[n] < _POSSIBLE and "+" in n]
    left = placebos(found).left
    first = "Tied: the data do not tell these apart"
    if len(tied) == 1:
        first = "Most probable"
    elif p[order[0]] >= NAMED:
        first = "Most probable, and what could be in its place"
    groups = (
        (first, tied),
        ("Less probable", possible),
        ("Ruled out (below 1 %)", out),
        (f"Pairs ruled out (below 1 %): {len(pairs)}", pairs),
    )
    return [
        {
            "heading": heading,
            "folded": heading.startswith("Pairs"),
            "rows": [_row(found, name, left) for name in names],
        }
        for heading, names in groups
        if names
    ]


def prior_text(found: Diagnosis) -> str:
    """Say how probable the hypotheses were before the data."""
    prior = found.ranking.prior
    listed = [n for n in prior if n not in LN_PRIOR and "unknown" not in n.split("+")]
    kinds = {
        "effects by themselves": [n for n in listed if "+" not in n and not n.startswith(PREFIX)],
        "dependences on a condition": [n for n in listed if "+" not in n and n.startswith(PREFIX)],
        "pairs that were tried": [n for n in listed if n.count("+") == 1],
        "larger sets": [n for n in listed if n.count("+") > 1],
        "explanations with something unlisted besides": [
            n for n in prior if "unknown" in n.split("+") and "+" in n
        ],
    }
    parts = [f"{short_name(n)} {percent(prior[n])}" for n in ("none", "parameter_shift", "unknown")]
    for kind, names in kinds.items():
        if names:
            low, high = (percent(f(prior[n] for n in names)) for f in (min, max))
            parts.append(
                f"each of {len(names)} {kind} {high if low == high else f'{low} to {high}'}"
            )
    return ", ".join(parts)


def _row(found: Diagnosis, name: str, left: dict[str, float]) -> dict[str, Any]:
    ranking = found.ranking
    relative = ranking.log_evidence[name] - ranking.log_evidence["none"]
    return {
        "name": name,
        "words": short_name(name),
        "title": title_of(found, name),
        "probability": odds_text(ranking.probability[name]),
        "width": f"{100.0 * ranking.probability[name]:.1f}",
        "evidence": f"{relative:+.1f}".replace("-", MINUS) if name != "none" else "0",
        "left": f"{left[name]:.2f}" if name in left else "",
        "sizes": _sizes(found, name),
    }


def _sizes(found: Diagnosis, name: str) -> list[Markup]:
    fit = best_fit(found, name)
    hypothesis = fit.forward.hypothesis
    if hypothesis.shift > 0.0:
        return shift_sizes(found.data.outputs, fit)
    sd = np.sqrt(np.diag(fit.covariance))
    sizes: list[Markup] = []
    for effect, priors, part in zip(
        hypothesis.effects, hypothesis.effect_priors, fit.forward.phi_slices, strict=True
    ):
        own = [
            f"{prior.name.replace('_', ' ')} {parameter_text(prior, float(value), float(s))}"
            for prior, value, s in zip(priors.free, fit.psi[part], sd[part], strict=True)
        ]
        # Whose they are is said once, before the first.
        if len(hypothesis.effects) > 1:
            own[0] = f"{short_name(effect.name)}: {own[0]}"
        sizes += [Markup("{}").format(text) for text in own]
    return sizes


def parameter_rows(found: Diagnosis) -> list[list[str]]:
    """Say what the parameters of the effects that are not ruled out mean, and their priors."""
    p = found.ranking.probability
    rows: dict[tuple[str, str], list[str]] = {}
    for name in found.ranking.order:
        if p[name] < _POSSIBLE:
            continue
        hypothesis = best_fit(found, name).forward.hypothesis
        for effect, priors in zip(hypothesis.effects, hypothesis.effect_priors, strict=True):
            for prior in priors.free:
                words = prior.name.replace("_", " ")
                text = (
                    prior.text.replace(" x ", " \N{MULTIPLICATION SIGN} ")
                    .replace("_kn)", ")")
                    .replace("_", " ")
                )
                row = [short_name(effect.name), words, prior.reason, text + _unit_of(prior)]
                rows.setdefault((effect.name, prior.name), row)
    return list(rows.values())


def _unit_of(prior: Prior) -> str:
    """A parameter's unit, to be put after a number."""
    return "" if prior.unit in ("1", "", "dimensionless") else f" {prior.unit}"


def simulators(found: Diagnosis) -> list[dict[str, Any]]:
    """Return title, equation and parametrisation of each output's simulator."""
    return [
        {
            "title": o.problem.bound.model.title,
            "equation": equation(o.problem.bound),
            "parameters": prose(parametrisation(o.problem.bound), o.priors.names),
        }
        for o in found.data.outputs
    ]


def parameter_text(prior: Prior, value: float, sd: float) -> str:
    """Write a parameter, in internal coordinates, with its sd and unit.

    One that cannot be told from its bound at zero is an upper limit (95 %); one that the data did
    not narrow is called so.
    """
    unit = _unit_of(prior)
    half = prior.lower == 0.0 and prior.loc == 0.0
    spread = prior.scale * (math.sqrt(1.0 - 2.0 / math.pi) if half else 1.0)
    if not math.isfinite(prior.scale):  # uniform between its bounds
        spread = (prior.upper - prior.lower) / math.sqrt(12.0)
    narrow = math.isfinite(spread) and sd > _NOT_NARROWED * spread
    if narrow and not math.isfinite(prior.scale):
        value, sd = 0.5 * (prior.lower + prior.upper), spread
    mark = " (prior)" if narrow else ""
    if prior.log:
        centre = math.exp(value)
        if sd < 0.35:
            return f"{format_value(centre, centre * sd)}{unit}{mark}"
        low, high = (math.exp(value + z * sd) for z in (-1.645, 1.645))
        return (
            f"{format_number(centre, 2)} ({format_number(low, 2)} to {format_number(high, 2)})"
            f"{unit}{mark}"
        )
    if prior.lower == 0.0 and value < sd:
        limit = min(value + 1.645 * sd, prior.upper)
        return f"< {format_number(limit, 2)}{unit}{mark}"
    return f"{format_value(value, sd)}{unit}{mark}"


def shift_sizes(outputs: Sequence[OutputData], fit: Fit) -> list[Markup]:
    """Write the shifts of the simulators' parameters that stand out from their own sd."""
    part, shift = fit.forward.shift_slice, fit.forward.shift
    if shift is None:
        return []
    sizes = []
    for o in outputs:
        matrix = shift.parameters[o.name]
        shifts = matrix @ fit.psi[part]
        sds = np.sqrt(np.einsum("ij,jk,ik->i", matrix, fit.covariance[part, part], matrix))
        for prior, value, s in zip(o.priors.free, shifts, sds, strict=True):
            if abs(value) < 1.645 * s:
                continue
            unit = " %" if prior.log else "" if prior.unit == "1" else f" {prior.unit}"
            if prior.log:  # of a logarithm: the relative change
                value, s = 100.0 * math.expm1(value), 100.0 * math.exp(value) * s
            sign = "+" if value > 0.0 else ""
            sizes.append(
                Markup("{} {}{}{}").format(
                    prior.name, sign, format_value(float(value), float(s)), unit
                )
            )
    error = 100.0 * float(shift.radius_error @ fit.psi[part])
    s = 100.0 * float(shift.radius_error @ fit.covariance[part, part] @ shift.radius_error) ** 0.5
    if abs(error) > 1.645 * s:
        sizes.append(Markup("zero of slip {} %").format(format_value(error, s)))
    if not sizes:
        return [Markup("no parameter moves clearly")]
    together = len(sizes) > 1 and fit.forward.hypothesis.shift_as == "soil"
    return [*sizes, Markup("together, as with another soil")] if together else sizes


def next_rows(found: Diagnosis) -> list[list[str]]:
    """Return what would separate hypotheses: which, where, how telling, how many."""
    rows = []
    for m in found.next_measurements:
        repeats = repeats_needed(m.gain_nats)
        rows.append(
            [
                f"{short_name(m.separates[0])} from {short_name(m.separates[1])}",
                conditions_text(found, m),
                f"{m.gain_nats:.2f}",
                "out of reach" if repeats is None else str(repeats),
            ]
        )
    return rows
