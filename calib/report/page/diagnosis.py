"""The page of a diagnosis: where, which, how far, for a person who has not read the code."""

from __future__ import annotations

import base64
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePath
from typing import Any

from calib.batch.pool import HERE, Pool
from calib.gap.diagnose import Diagnosis
from calib.gap.inclusion import UNLISTED, Included
from calib.gap.relevance import RELEVANT, RELEVANT_IN_PAIR
from calib.gap.where import Region
from calib.models import get_model
from calib.report.figures.export import png, png_size
from calib.report.figures.gap import GAP_FIGURES, gap_plates
from calib.report.figures.gap_rows import (
    best_fit,
    best_of,
    output_axis,
    output_rows,
    output_word,
    region_text,
    short_name,
    title_of,
)
from calib.report.figures.gap_shrink import scaled_shrink
from calib.report.figures.labels import MINUS, joined, short
from calib.report.figures.plate import Plate
from calib.report.page.gap_sizes import size_sentences, where_to_look
from calib.report.page.gap_tables import (
    conditions_text,
    hypothesis_groups,
    next_rows,
    parameter_rows,
    prior_text,
    simulators,
)
from calib.report.page.gap_verdict import (
    Candidate,
    CauseFact,
    GapEvidence,
    NextFact,
    ShrinkFact,
    WhereFact,
    judge_gap,
    odds_text,
)
from calib.report.page.template import template

__all__ = ["gap_evidence", "render_diagnosis", "write_page"]

# A cause less probable is not shown.
_POSSIBLE = 0.01

_MARKS = {
    "fine": "\N{HEAVY CHECK MARK}",
    "care": "\N{BLACK UP-POINTING TRIANGLE}",
    "no": "?",
}


def write_page(
    found: Diagnosis, folder: Path, manifest: Mapping[str, Any], *, pool: Pool = HERE
) -> None:
    """Draw the figures and write them and the page into an existing folder.

    Parameters
    ----------
    found : Diagnosis
    folder : Path
        Gets ``figures/*.png`` and ``index.html``.
    manifest : mapping
        ``command`` and ``versions``, as `calib.report.manifest.build_manifest` has them; both
        optional.
    pool : Pool, optional
        Where the first figures are drawn; the others are drawn here meanwhile.
    """
    there = pool.submit(_drawn, found, GAP_FIGURES[:3])
    drawn = _drawn(found, GAP_FIGURES[3:]) | there.result()
    plates = [drawn[name][0] for name in GAP_FIGURES if name in drawn]
    images = {f"{plate.name}.png": image for plate, image in drawn.values() if image}
    (folder / "figures").mkdir(exist_ok=True)
    for name, image in images.items():
        (folder / "figures" / name).write_bytes(image)
    page = render_diagnosis(found, plates, images, manifest=manifest)
    (folder / "index.html").write_text(page, encoding="utf-8")


def _drawn(found: Diagnosis, names: Sequence[str]) -> dict[str, tuple[Plate, bytes]]:
    """Draw figures; return each without its canvas, and as a file."""
    plates = gap_plates(found, names)
    return {p.name: (replace(p, figure=None), png(p)) for p in plates}


def render_diagnosis(
    found: Diagnosis,
    plates: Sequence[Plate],
    images: Mapping[str, bytes],
    *,
    manifest: Mapping[str, Any],
) -> str:
    """Render the page.

    Parameters
    ----------
    found : Diagnosis
    plates : sequence of Plate
    images : mapping of str to bytes
        PNG files by name, ``{plate.name}.png``.
    manifest : mapping

    Returns
    -------
    str
        HTML that makes no request: style and images are inside.
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
        mark=_MARKS[verdict.tone.value],
        probability=round(100.0 * found.ranking.probability[best_of(found)]),
        figures={p.name: _figure(p, images) for p in plates},
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


def gap_evidence(found: Diagnosis) -> GapEvidence:
    """Collect what the verdict is made from."""
    ranking = found.ranking
    best = best_of(found)
    design = ranking.isolability
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
        where=[_where_fact(found, r) for r in _leading_regions(found)],
        shrink=_shrink_facts(found),
        unfitted=found.data.case.new_conditions is not None,
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
        remainder=_cause(found, UNLISTED, found.inclusion.remainder),
        remainder_where=_remainder_where(found),
        put_in="; ".join(case_context.words()),
        without=_without(found),
    )


def _without(found: Diagnosis) -> str:
    """Say which causes act without what the case's context put in."""
    if found.without_context is None:
        return ""
    p = found.without_context
    leading = sorted((n for n in p if p[n] >= 0.05), key=lambda n: -p[n])[:4]
    words = {"none": "no gap", UNLISTED: "something unlisted"}
    return joined([f"{words.get(n, short_name(n))} ({odds_text(p[n])})" for n in leading])


def _cause(found: Diagnosis, name: str, c: Included) -> CauseFact:
    words = "something unlisted" if name == UNLISTED else short_name(name)
    return CauseFact(
        name, words, title_of(found, name), c.probability, c.share, c.share_interval
    )  # fmt: skip


def _remainder_where(found: Diagnosis) -> str:
    where = found.inclusion.where[:1]
    return "".join(f"{output_word(r.output)} at {region_text(found, r)}" for r in where)


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


def _region_words(found: Diagnosis, region: Region) -> tuple[str, str]:
    own = output_axis(found, region.output)
    gap = own.factor * region.gap
    sign, way = (1.0, "above") if gap > 0.0 else (-1.0, "below")
    low, high = sorted(sign * own.factor * end for end in region.interval)
    spread = f"90 % interval {short(low)} to {short(high)}".replace("-", MINUS)
    text = f"{short(abs(gap))} {own.unit} {way} the simulator ({spread})"
    return region_text(found, region), text


def _leading_regions(found: Diagnosis) -> list[Region]:
    """One region of each output, along a condition of the best hypothesis if there is one."""
    effects = best_fit(found, best_of(found)).forward.hypothesis.effects
    wanted = {found.data.view.column(role) for e in effects for role in e.covariates}
    leading = []
    for o in found.data.outputs:
        own = [r for r in found.regions if r.output == o.name]
        own.sort(key=lambda r: not wanted & set(r.conditions))
        leading += own[:1]
    return leading


def _where_fact(found: Diagnosis, region: Region) -> WhereFact:
    place, gap = _region_words(found, region)
    return WhereFact(f"{output_word(region.output)} at {place}", gap, region.probability)


def _region_row(found: Diagnosis, region: Region) -> list[str]:
    fact = _where_fact(found, region)
    place, gap = _region_words(found, region)
    p = fact.probability
    return [output_word(region.output), place, gap, f"{p:.2f}" if p < 0.995 else "> 0.99"]


def _shrink_facts(found: Diagnosis) -> list[ShrinkFact]:
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


def _shrink_rows(found: Diagnosis) -> list[list[str]]:
    rows = []
    for f in _shrink_facts(found):
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


def _figure(plate: Plate, images: Mapping[str, bytes]) -> dict[str, Any]:
    image = images.get(f"{plate.name}.png")
    return {
        "heading": plate.heading or plate.name.replace("_", " ").capitalize(),
        "caption": plate.caption,
        "uri": f"data:image/png;base64,{base64.b64encode(image).decode()}" if image else "",
        "size": png_size(image) if image else (0, 0),
    }
