"""The report's section on the source's own gaps, and the page of each diagnosis below it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from calib.batch.pool import Pool
from calib.gap.files import write_diagnosis
from calib.he2019 import declared
from calib.he2019.gaps.find import Check, FoundGap, checks, probability_of
from calib.models import get_model
from calib.report.figures.plate import Plate
from calib.report.gap_evidence import gap_verdict
from calib.report.gap_rows import short_name
from calib.report.labels import odds_text, percent, percent_range
from calib.report.page.diagnosis import TONE_MARKS, render_diagnosis
from calib.report.page.template import data_uri, png_size, sentences, template
from calib.report.study import Progress

_CHECKS = declared("page/checks.toml")
# Numbers that not every check of a kind has.
_ABSENT = dict.fromkeys(("rmse_before_mm", "rmse_after_mm", "largest_relative_after"), 0.0)
_said = sentences(odds=odds_text)


def check_text(check: Check) -> tuple[str, str]:
    """Return the heading of a check and what it found."""
    words = _CHECKS.get(check.name)
    if words is not None:
        return words["heading"], _said(words["text"], **{**_ABSENT, **check.values})
    # The same question asked otherwise: the probabilities.
    named = ((k.removeprefix("probability_"), p) for k, p in check.values.items() if k != "rows")
    listed = ", ".join(f"{short_name(name)} {odds_text(p)}" for name, p in named)
    heading = check.name.replace("_", " ").capitalize()
    return heading, f"{check.values['rows']:.0f} field rows: {listed}"


def begin_gaps_section(
    results: Sequence[FoundGap],
    folder: Path,
    *,
    versions: Mapping[str, str],
    pdf: bool,
    pool: Pool,
) -> Callable[[Progress], str]:
    """Ask for figures and pages of the gaps in a report folder; return what waits for the section.

    The folder has ``figures/``; it gets ``figures/gap_NAME.png``, as PDF too if asked, and
    ``gaps/NAME/``, each what `calib diagnose` writes, its figures inside the page only.
    """
    pieces = [pool.submit(_write_gap, r, folder, versions, pdf) for r in results]

    def finish(tell: Progress) -> str:
        blocks = []
        for i, piece in enumerate(pieces):
            tell("the paper's own gaps: drawing", i, len(pieces))
            blocks.append(piece.result())
        tell("the paper's own gaps: drawing", len(pieces), len(pieces))
        return template("gaps.html.j2", "calib.he2019.page").render(gaps=blocks)

    return finish


def _write_gap(
    result: FoundGap, folder: Path, versions: Mapping[str, str], pdf: bool
) -> dict[str, Any]:
    # Late: where the figures are drawn, which as a rule is another process.
    from calib.he2019.figures.gaps import gap_plate
    from calib.report.figures.gap import gap_plates
    from calib.report.figures.style import pdf_bytes, png

    plate = gap_plate(result)
    image = png(plate)
    (folder / "figures" / f"gap_{plate.name}.png").write_bytes(image)
    if pdf and plate.figure is not None:
        file = folder / "figures" / f"gap_{plate.name}.pdf"
        file.write_bytes(pdf_bytes(plate.figure))
    inner = folder / "gaps" / result.gap.name
    inner.mkdir(parents=True)
    write_diagnosis(result.found, inner)
    drawn = gap_plates(result.found)
    images = {f"{p.name}.png": png(p) for p in drawn if p.figure is not None}
    page = render_diagnosis(result.found, drawn, images, manifest={"versions": versions})
    (inner / "index.html").write_text(page, encoding="utf-8")
    return _block(result, plate, image)


def _block(result: FoundGap, plate: Plate, image: bytes) -> dict[str, Any]:
    gap, found = result.gap, result.found
    verdict = gap_verdict(found)
    ranking = found.ranking
    best, case = ranking.order[0], found.data.case
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
        "mark": TONE_MARKS[verdict.tone],
        "state": verdict.state,
        "headline": verdict.headline,
        "facts": [fact for fact in verdict.facts if fact[0] not in ("Next", "Then")],
        "withheld": _withheld(result),
        "best": f"{short_name(best)} ({odds_text(ranking.probability[best])})",
        "shrink": _shrink(result),
        "checks": [check_text(check) for check in checks(result)],
        "limits": gap.limits,
        "page": f"gaps/{gap.name}/index.html",
        "caption": plate.caption,
        "uri": data_uri(image),
        "size": png_size(image),
    }


def _upper(text: str) -> str:
    return text[0].upper() + text[1:]


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
    return f"{percent(s.fraction)} ({percent_range(s.interval)})"
