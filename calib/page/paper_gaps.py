"""The report's section on the source's own gaps, and the page of each diagnosis below it."""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, Template

from calib.figures.export import pdf_bytes, png_size
from calib.figures.gap import gap_plates
from calib.figures.gap_rows import short_name
from calib.figures.labels import short
from calib.figures.paper_gaps import gap_plate
from calib.figures.plate import Plate
from calib.gap.files import write_diagnosis
from calib.models import get_model
from calib.page.diagnosis import gap_evidence, render_diagnosis
from calib.page.gap_verdict import Tone, judge_gap, odds_text
from calib.page.paper_checks import check_text
from calib.paper_gaps.checks import checks, probability_of
from calib.paper_gaps.find import FoundGap

__all__ = ["write_gaps"]

_MARKS = {
    Tone.FINE: "\N{HEAVY CHECK MARK}",
    Tone.CARE: "\N{BLACK UP-POINTING TRIANGLE}",
    Tone.NO: "?",
}

type Progress = Callable[[str, int, int], None]
type ToPng = Callable[[Plate], bytes]


@cache
def _template() -> Template:
    environment = Environment(
        loader=PackageLoader("calib.page", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("paper_gaps.html.j2")


def write_gaps(
    results: Sequence[FoundGap],
    folder: Path,
    to_png: ToPng,
    *,
    manifest: Mapping[str, Any],
    pdf: bool = False,
    progress: Progress | None = None,
) -> str:
    """Write figures and pages of the gaps into a report folder, and return the section.

    Parameters
    ----------
    results : sequence of FoundGap
    folder : Path
        Has ``figures/``; gets ``figures/gap_NAME.png`` and ``gaps/NAME/``, each what
        `calib diagnose` writes, its figures inside the page only.
    to_png : callable
        Renders a figure.
    manifest : mapping
        Of the report, for the pages' versions.
    pdf : bool
        Whether each gap's figure also comes as PDF.
    progress : callable, optional

    Returns
    -------
    str
        HTML for `calib.page.render.render_page`.
    """
    tell = progress or (lambda what, done, planned: None)
    blocks = []
    for i, result in enumerate(results):
        tell("the paper's own gaps: drawing", i, len(results))
        plate = gap_plate(result)
        image = to_png(plate)
        (folder / "figures" / f"gap_{plate.name}.png").write_bytes(image)
        if pdf and plate.figure is not None:
            file = folder / "figures" / f"gap_{plate.name}.pdf"
            file.write_bytes(pdf_bytes(plate.figure))
        _write_diagnosis_page(result, folder / "gaps" / result.gap.name, to_png, manifest)
        blocks.append(_block(result, plate, image))
    tell("the paper's own gaps: drawing", len(results), len(results))
    return _template().render(gaps=blocks)


def _write_diagnosis_page(
    result: FoundGap, folder: Path, to_png: ToPng, manifest: Mapping[str, Any]
) -> None:
    folder.mkdir(parents=True)
    write_diagnosis(result.found, folder)
    drawn = gap_plates(result.found)
    images = {f"{p.name}.png": to_png(p) for p in drawn if p.figure is not None}
    versions = {"versions": manifest.get("versions", {})}
    page = render_diagnosis(result.found, drawn, images, manifest=versions)
    (folder / "index.html").write_text(page, encoding="utf-8")


def _block(result: FoundGap, plate: Plate, image: bytes) -> dict[str, Any]:
    gap, found = result.gap, result.found
    verdict = judge_gap(gap_evidence(found))
    ranking = found.ranking
    case = found.data.case
    return {
        "name": gap.name,
        "title": gap.title,
        "question": gap.question,
        "rows": [
            ("Model", get_model(case.models[result.output]).title),
            ("Calibration", f"{_upper(gap.lab_rows)}: {len(case.lab)} rows"),
            ("Field", f"{_upper(gap.field_rows)}: {len(case.field)} rows"),
        ],
        "tone": verdict.tone.value,
        "mark": _MARKS[verdict.tone],
        "state": verdict.state,
        "headline": verdict.headline,
        "facts": [fact for fact in verdict.facts if fact[0] != "Next"],
        "withheld": _withheld(result),
        "best": f"{short_name(ranking.order[0])} ({odds_text(_best(result))})",
        "shrink": _shrink(result),
        "checks": [check_text(check) for check in checks(result)],
        "limits": gap.limits,
        "page": f"gaps/{gap.name}/index.html",
        "caption": plate.caption,
        "uri": f"data:image/png;base64,{base64.b64encode(image).decode()}",
        "size": png_size(image),
    }


def _upper(text: str) -> str:
    return text[0].upper() + text[1:]


def _best(result: FoundGap) -> float:
    ranking = result.found.ranking
    return float(ranking.probability[ranking.order[0]])


def _withheld(result: FoundGap) -> str:
    """Say whether the effect that was withheld is the one that was found."""
    effect = result.gap.withheld
    if effect is None:
        return ""
    ranking = result.found.ranking
    words = short_name(effect)
    if ranking.order[0] == effect and result.found.verdict == "effect":
        return f"The effect that was withheld, {words}, is the one that is named."
    p = odds_text(probability_of(result.found, effect))
    return (
        f"The effect that was withheld, {words}, is not the one that is named: its probability, "
        f"alone or with another, is {p}."
    )


def _shrink(result: FoundGap) -> str:
    s = result.found.shrink.get(result.output)
    if s is None:
        return "no gap that could shrink"
    low, high = (f"{100.0 * v:.0f}".replace("-", "\N{MINUS SIGN}") for v in s.interval)
    return f"{short(100.0 * s.fraction)} % ({low} to {high} %)"
