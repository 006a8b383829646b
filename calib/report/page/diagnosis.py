"""The page of a diagnosis: where, which, how far, for a person who has not read the code."""

from __future__ import annotations

import math
import pickle
import shlex
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from pathlib import Path, PurePath
from typing import Any

import numpy as np
from markupsafe import Markup

from calib.batch.pool import HERE
from calib.gap.campaigns import OutputData
from calib.gap.constants import (
    LEFT,
    MIN_EFFECT_SIZE,
    MIN_EFFECT_SIZE_IN_PAIR,
    MOST_LEFT,
    NAMED,
    PRIOR,
)
from calib.gap.diagnose import Diagnosis, placebos
from calib.gap.effects.dependence import PREFIX
from calib.gap.fit import Fit
from calib.gap.mixture import UNLISTED, Region
from calib.gap.odds import left_of, likelihood_tempering, probabilities
from calib.models import get_model
from calib.report.figures.plate import Plate
from calib.report.gap_evidence import (
    conditions_text,
    covered_text,
    gap_evidence,
    region_words,
    shrink_facts,
)
from calib.report.gap_facts import (
    TIE,
    GapEvidence,
    output_axis,
    output_word,
    short_name,
    title_of,
    track_record_text,
)
from calib.report.gap_verdict import Tone, advice, judge_gap, repeats_needed
from calib.report.labels import MINUS, odds_text, percent, percent_range, short
from calib.report.markup import prose
from calib.report.numbers import format_value
from calib.report.page.template import equation, parametrisation, picture, template
from calib.report.parameters import parameter_text, unit_of

# A hypothesis or a cause that is less probable is ruled out.
_POSSIBLE = 0.01


def hypothesis_groups(found: Diagnosis) -> list[dict[str, Any]]:
    """Return the hypotheses with what is known of each, grouped by how probable they are."""
    p, order = found.ranking.probability, found.ranking.order
    tied = [n for n in order if p[n] >= TIE * p[order[0]]]
    rest = [n for n in order if n not in tied]
    possible = [n for n in rest if p[n] >= _POSSIBLE]
    out = [n for n in rest if p[n] < _POSSIBLE and "+" not in n]
    sets = [n for n in rest if p[n] < _POSSIBLE and "+" in n]
    left = placebos(found).left
    first = "Tied: the data do not tell these apart"
    if len(tied) == 1:
        first = "Most probable"
    elif p[order[0]] >= NAMED:
        first = "Most probable, and what could be in its place"
    groups = (
        (first, tied),
        ("Less probable", possible),
        ("Ruled out as the only cause (below 1 %)", out),
        (f"Sets ruled out (below 1 %): {len(sets)}", sets),
    )
    return [
        {
            "heading": heading,
            "folded": heading.startswith("Sets"),
            "rows": [_row(found, name, left) for name in names],
        }
        for heading, names in groups
        if names
    ]


def prior_text(found: Diagnosis) -> str:
    """Say how probable the hypotheses were before the data."""
    prior = found.ranking.prior
    listed = [n for n in prior if n not in PRIOR and "unknown" not in n.split("+")]
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
    fit = found.ranking.best(name)
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
    """Say what parameters of effects that are not ruled out mean, their priors, and after whom."""
    p = found.ranking.probability
    rows: dict[tuple[str, str], list[str]] = {}
    for name in found.ranking.order:
        if p[name] < _POSSIBLE:
            continue
        hypothesis = found.ranking.best(name).forward.hypothesis
        for effect, priors in zip(hypothesis.effects, hypothesis.effect_priors, strict=True):
            for prior in priors.free:
                words = prior.name.replace("_", " ")
                text = (
                    prior.text.replace(" x ", " \N{MULTIPLICATION SIGN} ")
                    .replace("_kn)", ")")
                    .replace("_", " ")
                )
                said = (words, prior.reason, text + unit_of(prior), prior.source)
                rows.setdefault((effect.name, prior.name), [short_name(effect.name), *said])
    return list(rows.values())


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
            unit = " %" if prior.log else unit_of(prior)
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


# A shape beside every colour.
TONE_MARKS = {
    Tone.FINE: "\N{HEAVY CHECK MARK}",
    Tone.CARE: "\N{BLACK UP-POINTING TRIANGLE}",
    Tone.NO: "?",
}


def render_diagnosis(
    found: Diagnosis,
    plates: Sequence[Plate],
    images: Mapping[str, bytes],
    *,
    manifest: Mapping[str, Any],
) -> str:
    """Render the page, which makes no request: style and images are inside.

    Images are PNG files by name, ``{plate.name}.png``.
    """
    evidence = gap_evidence(found)
    verdict = judge_gap(evidence)
    case = found.data.case
    files = [("Calibration", case.lab), ("Field", case.field)]
    if case.new_conditions is not None:
        files.append(("New conditions", case.new_conditions))
    return template("diagnosis.html.j2").render(
        title=f"Sim-to-real gap: {case.name}",
        verdict=verdict,
        mark=TONE_MARKS[verdict.tone],
        probability=round(100.0 * found.ranking.probability[found.ranking.order[0]]),
        data_label=case.label,
        track_record=track_record_text(found.ranking.probability[found.ranking.order[0]]),
        figures={p.name: picture(p, images.get(f"{p.name}.png", b""), p.caption) for p in plates},
        facts=_case_facts(found),
        warnings=found.warnings,
        causes=_cause_rows(evidence),
        groups=hypothesis_groups(found),
        prior=prior_text(found),
        covered=covered_text(found),
        left=f"{100.0 * LEFT:g}",
        most_left=f"{MOST_LEFT:g}",
        gap=f"{found.ranking.gap:.1f}",
        left_here=f"{left_of(found.ranking.gap):.2g}",
        coarse=f"{likelihood_tempering(found.ranking.gap):.2f}",
        before_coarsening=_before_tempering(found),
        relevant=f"{MIN_EFFECT_SIZE:g}",
        relevant_in_pair=f"{MIN_EFFECT_SIZE_IN_PAIR:g}",
        parameters=parameter_rows(found),
        simulators=simulators(found),
        best=title_of(found, found.ranking.order[0]),
        not_testable=[
            [short_name(n), title_of(found, n), reason]
            for n, reason in found.ranking.not_testable.items()
        ],
        regions=[_region_row(found, r) for r in found.regions],
        shrink=_shrink_rows(found),
        shrink_place=evidence.shrink_place,
        next_rows=next_rows(found),
        look=evidence.look,
        advice=advice(evidence),
        files=[(word, PurePath(t.source).name, len(t), t.sha256) for word, t in files],
        seed=found.seed,
        command=shlex.join(str(part) for part in manifest.get("command", ())),
        versions=manifest.get("versions", {}),
    )


def _cause_rows(evidence: GapEvidence) -> list[dict[str, str]]:
    """Return the causes that are not ruled out, and the remainder, with their shares."""
    shown = [c for c in evidence.causes if c.probability >= _POSSIBLE]
    shown += [evidence.remainder] if evidence.remainder is not None else []
    return [
        {
            "words": c.words,
            "title": c.title if c.name != UNLISTED else "of no listed shape, alone or besides",
            "probability": odds_text(c.probability),
            "share": f"{100.0 * c.share:.0f} %",
            "interval": f"{100.0 * c.interval[0]:.0f} to {100.0 * c.interval[1]:.0f} %",
        }
        for c in shown
    ]


def _region_row(found: Diagnosis, region: Region) -> list[str]:
    place, gap = region_words(found, region)
    p = region.probability
    return [output_word(region.output), place, gap, f"{p:.2f}" if p < 0.995 else "> 0.99"]


def _shrink_rows(found: Diagnosis) -> list[list[str]]:
    rows = []
    for f in shrink_facts(found):
        fraction = f"{100.0 * f.fraction:.0f} %".replace("-", MINUS)
        rows.append([f.output, f.before, f.after, f.floor, fraction, percent_range(f.interval)])
    return rows


def _before_tempering(found: Diagnosis) -> str:
    """How probable the first explanation would be if formulas were right to the last."""
    ranking = found.ranking
    return odds_text(probabilities(ranking.log_evidence, ranking.odds)[ranking.order[0]])


def _case_facts(found: Diagnosis) -> list[tuple[str, str]]:
    """What was compared with what."""
    case, facts = found.data.case, []
    for o in found.data.outputs:
        noise = found.ranking.best(found.ranking.order[0]).noise[o.name]
        axis = output_axis(found, o.name)
        grows = ""
        if noise.rho > 0.0:
            grows += f", growing to {short(1.0 + noise.rho * 0.5)} times that at 50 % slip"
        if noise.kappa != 0.0:
            grows += f", and as the power {-noise.kappa:g} of inflation pressure".replace(
                "-", MINUS
            )
        level = (
            f"{short(100.0 * noise.sigma)} % of the value"
            if o.problem.bound.model.response == "log"
            else f"{short(axis.factor * noise.sigma)} {axis.unit}"
        )
        facts.append(
            (
                axis.name,
                f"{get_model(case.models[o.name]).title}; {len(o.problem.table)} rows of "
                f"calibration, {o.rows.size} of the field; noise sd of a reading {level}"
                f"{grows} (both campaigns, the most probable "
                "hypothesis)",
            )
        )
    return facts


# Places of figures, in reading order, that take as long to draw as all others.
_HALF = (1, 2, 3)


def write_page(found: Diagnosis, folder: Path, manifest: Mapping[str, Any]) -> None:
    """Draw ``figures/*.png`` and write them and ``index.html`` into an existing folder.

    Of the manifest ``command`` and ``versions`` are shown, if they are there.
    """
    begin_page(found, manifest)(folder)


def begin_page(
    found: Diagnosis, manifest: Mapping[str, Any], *, pool: Executor = HERE
) -> Callable[[Path], None]:
    """Ask for the page of a diagnosis; return what waits for it and writes it into a folder."""
    # Once for all pieces: it takes longer than to hand it over. Here an effect of a script's own
    # may be in it, which cannot be pickled.
    packed = found if pool is HERE else pickle.dumps(found)
    halves = [pool.submit(_drawn, packed, half) for half in (True, False)]

    def write(folder: Path) -> None:
        by_place = halves[0].result() | halves[1].result()
        drawn = [by_place[place] for place in sorted(by_place)]
        images = {f"{plate.name}.png": image for plate, image in drawn if image}
        plates = [plate for plate, _ in drawn]
        page = pool.submit(_rendered, packed, plates, images, dict(manifest)).result()
        (folder / "figures").mkdir(exist_ok=True)
        for name, image in images.items():
            (folder / "figures" / name).write_bytes(image)
        (folder / "index.html").write_text(page, encoding="utf-8")

    return write


def _drawn(packed: Diagnosis | bytes, half: bool) -> dict[int, tuple[Plate, bytes]]:
    """Draw one half of the figures; return each by its place, without its canvas and as a file."""
    from dataclasses import replace

    from calib.report.figures.gap import GAP_FIGURES, gap_plates
    from calib.report.figures.style import png
    from calib.report.labels import units_of

    found = _unpacked(packed)
    places = {name: i for i, name in enumerate(GAP_FIGURES) if (i in _HALF) is half}
    with units_of(_headers(found)):
        plates = gap_plates(found, tuple(places))
    return {places[p.name]: (replace(p, figure=None), png(p)) for p in plates}


def _rendered(
    packed: Diagnosis | bytes,
    plates: Sequence[Plate],
    images: Mapping[str, bytes],
    manifest: Mapping[str, Any],
) -> str:
    from calib.report.labels import units_of

    found = _unpacked(packed)
    with units_of(_headers(found)):
        return render_diagnosis(found, plates, images, manifest=manifest)


def _unpacked(packed: Diagnosis | bytes) -> Diagnosis:
    found: Diagnosis = pickle.loads(packed) if isinstance(packed, bytes) else packed
    return found


def _headers(found: Diagnosis) -> tuple[str, ...]:
    """Return the column names whose units the page has: those of the field first."""
    return (*found.data.case.field.header, *found.data.case.lab.header)
