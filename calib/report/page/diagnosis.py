"""The page of a diagnosis: where, which, how far, for a person who has not read the code."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import PurePath
from typing import Any

from calib.gap.diagnose import Diagnosis
from calib.gap.inclusion import UNLISTED
from calib.gap.relevance import RELEVANT, RELEVANT_IN_PAIR
from calib.gap.where import Region
from calib.models import get_model
from calib.report.figures.plate import Plate
from calib.report.gap_evidence import gap_evidence, region_words, shrink_facts, where_fact
from calib.report.gap_rows import (
    best_of,
    output_axis,
    output_word,
    short_name,
    title_of,
)
from calib.report.gap_verdict import (
    GapEvidence,
    Tone,
    judge_gap,
    odds_text,
)
from calib.report.labels import MINUS, short
from calib.report.page.gap_tables import (
    hypothesis_groups,
    next_rows,
    parameter_rows,
    prior_text,
    simulators,
)
from calib.report.page.pictures import picture
from calib.report.page.template import template

# A cause less probable is not shown.
_POSSIBLE = 0.01

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
        probability=round(100.0 * found.ranking.probability[best_of(found)]),
        figures={p.name: picture(p, images.get(f"{p.name}.png", b""), p.caption) for p in plates},
        facts=_case_facts(found),
        warnings=found.warnings,
        causes=_cause_rows(evidence),
        groups=hypothesis_groups(found),
        prior=prior_text(found),
        relevant=f"{RELEVANT:g}",
        relevant_in_pair=f"{RELEVANT_IN_PAIR:g}",
        parameters=parameter_rows(found),
        simulators=simulators(found),
        best=title_of(found, best_of(found)),
        not_testable=[
            [short_name(n), title_of(found, n), reason]
            for n, reason in found.ranking.not_testable.items()
        ],
        regions=[_region_row(found, r) for r in found.regions],
        shrink=_shrink_rows(found),
        unfitted=case.new_conditions is not None,
        next_rows=next_rows(found),
        look=evidence.look,
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
    fact = where_fact(found, region)
    place, gap = region_words(found, region)
    p = fact.probability
    return [output_word(region.output), place, gap, f"{p:.2f}" if p < 0.995 else "> 0.99"]


def _shrink_rows(found: Diagnosis) -> list[list[str]]:
    rows = []
    for f in shrink_facts(found):
        low, high = (f"{100.0 * v:.0f}".replace("-", MINUS) for v in f.interval)
        fraction = f"{100.0 * f.fraction:.0f} %".replace("-", MINUS)
        rows.append([f.output, f.before, f.after, f.floor, fraction, f"{low} to {high} %"])
    return rows


def _case_facts(found: Diagnosis) -> list[tuple[str, str]]:
    """What was compared with what."""
    case, facts = found.data.case, []
    for o in found.data.outputs:
        noise = found.ranking.best(best_of(found)).noise[o.name]
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
